"""Trees: what a system is to run, a Supervisor and all below it, checked before anything of it is started."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import cast

from rr_actors.actors.entries import is_manager, put_classes, registrars_of
from rr_actors.actors.host import check_hostable
from rr_actors.core.checks import examined
from rr_actors.core.specs import ChildSpec, Supervisor, as_child_spec, starting_with
from rr_actors.directory import Directory, Status, registrar_key
from rr_actors.errors import InvalidSpec, is_a, shown


def root_of(root: object) -> Supervisor:
    """The root supervisor: `root`, or a one_for_one supervisor called "root" of the children that it lists.

    Raises:
        InvalidSpec: it is neither.
    """
    return cast("Supervisor", root) if is_a(root, Supervisor) else Supervisor(_children(root))


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
    if not is_a(root, (list, tuple, Sequence)) or is_a(root, (str, bytes, range, memoryview)):
        expected = "a Supervisor or a list of ChildSpecs"
        raise InvalidSpec(
            f"System: root: expected {expected}, got {shown(root)}", field="root", expected=expected, got=root
        )
    with examined("System: root"):
        return tuple(_each_child(root))


def _each_child(root: object) -> Iterator[ChildSpec | Supervisor]:
    for child in cast("Sequence[ChildSpec | Supervisor]", root):
        if not is_a(child, (ChildSpec, Supervisor)):  # before the next: there may be a thousand million of them
            expected = "ChildSpecs and Supervisors"
            text = f"System: root: expected {expected}, got {shown(child)} ({type(child).__name__})"
            raise InvalidSpec(text, field="root", expected=expected, got=child)
        yield child
