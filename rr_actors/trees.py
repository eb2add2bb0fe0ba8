"""Trees: what a system is to run, a Supervisor and all below it, checked before anything of it is started."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from rr_actors.actors.entries import is_manager, put_classes, registrars_of
from rr_actors.actors.host import check_hostable
from rr_actors.core.specs import ChildSpec, Supervisor, as_child_spec, starting_with
from rr_actors.directory import Directory, Status, registrar_key
from rr_actors.errors import InvalidSpec, shown


def root_of(root: object) -> Supervisor:
    """The root supervisor: `root`, or a one_for_one supervisor called "root" of the children that it lists.

    Raises:
        InvalidSpec: it is neither.
    """
    return root if isinstance(root, Supervisor) else Supervisor(_children(root))


def check_tree(supervisor: Supervisor, path: str) -> None:
    """That every child can be hosted, and that no two managers would have the same registrar.

    Raises:
        InvalidSpec: naming the child and the field.
    """
    for spec in supervisor.child_specs:
        inner = spec.actor_class_or_manager
        if isinstance(inner, Supervisor):
            check_tree(inner, f"{path}/{spec.id}")
        else:
            check_hostable(inner, f"{path}/{spec.id}", spec.args, spec.kwargs)
    names = manager_names(supervisor)
    for name in names:
        if names.count(name) > 1:
            expected = "registrar names unique in the tree (a manager's child id is its registrar's name)"
            text = f"Supervisor {path}: id: expected {expected}, got {name!r} twice"
            raise InvalidSpec(text, field="id", expected=expected, got=name)


def manager_names(supervisor: Supervisor) -> list[str]:
    """The child ids of the managers at or below it, which are their registrars' names."""
    return registrars_of(as_child_spec(supervisor), supervisor.id)


def announce(supervisor: Supervisor, directory: Directory) -> None:
    """Say in the directory that all managers at or below it are STARTING, and of what classes they are.

    Raises:
        ConfigError: the directory cannot be written.
    """
    for where, spec in starting_with(as_child_spec(supervisor), supervisor.id):
        if is_manager(spec):
            name = where.rpartition("/")[2]
            put_classes(directory, name, spec)
            directory.mark(registrar_key(name), Status.STARTING)


def _children(root: object) -> tuple[ChildSpec | Supervisor, ...]:
    if isinstance(root, str | bytes) or not isinstance(root, Sequence):
        expected = "a Supervisor or a list of ChildSpecs"
        raise InvalidSpec(
            f"System: root: expected {expected}, got {shown(root)}", field="root", expected=expected, got=root
        )
    return tuple(cast("Sequence[ChildSpec | Supervisor]", root))
