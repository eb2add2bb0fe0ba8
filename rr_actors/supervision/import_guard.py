"""Import guard: refuses to start children whose processes would import a module that is being imported now.

A child process imports the modules that its ChildSpec refers to. If one of them starts the system while it is imported,
the child would start a system as well, and so on without end. Before that, this process would hang. The thread that
waits for the start has the module's import lock, and the worker that pickles the ChildSpec waits for that lock.
"""

from __future__ import annotations

import itertools
import sys

from rr_actors.base import pickling
from rr_actors.base.errors import UsageError
from rr_actors.runtime.processes import fork_server
from rr_actors.supervision.core.specs import ChildSpec, Supervisor

_INSTEAD = (
    "Start it when the import is over: in a function that the program calls (FastAPI: the lifespan; gunicorn: the hook "
    'post_worker_init; pytest: a fixture), or below `if __name__ == "__main__":`'
)


def in_progress() -> set[str]:
    """Return the names of the modules whose import has begun and is not over."""
    return {name for name, module in list(sys.modules.items()) if _is_initializing(module)}


def check_children_can_import(spec: ChildSpec, path: str, what: str) -> None:
    """Check that no module which the processes of this child and of those below it need is being imported now.

    Args:
        path: the child's.
        what: the call that starts it, "system 'robot': start()".

    Raises:
        UsageError: a module that such a process needs is being imported now.
        NotSerializable: the ChildSpec cannot be pickled. (It is pickled only while a module is being imported.)
    """
    inner = spec.actor_class_or_manager
    if spec.placement != "process" and not isinstance(inner, Supervisor):  # no process imports anything
        return
    if not (now := in_progress()):
        return
    if spec.placement == "process":
        for module in sorted(pickling.modules_of(spec, f"the ChildSpec of {path}")):
            # The import of "a.b.c" imports "a" and "a.b", too.
            for name in itertools.accumulate(module.split("."), "{}.{}".format):
                if name in now:
                    raise UsageError(
                        f"{what}: refused while module {name!r} is being imported: the process of {path} must import "
                        f"{module!r}, and would run this call again. {_INSTEAD}; or move what {path} needs to a module "
                        f"that can be imported without {name!r}"
                    )
    elif isinstance(inner, Supervisor):
        for child in inner.child_specs:
            check_children_can_import(child, f"{path}/{child.id}", what)


def check_no_child_imports(what: str) -> None:
    """Raise UsageError in a child process that is in the middle of an import: it would start one more system."""
    if fork_server.inherited is not None and (now := in_progress()):
        modules = ", ".join(map(repr, sorted(now)))
        raise UsageError(
            f"{what}: refused in a child process of rr_actors that is importing {modules}: each child process "
            f"would start one more system. {_INSTEAD}"
        )


def _is_initializing(module: object) -> bool:
    try:  # not by getattr: it would load a lazy module
        attributes: dict[str, object] = object.__getattribute__(module, "__dict__")
    except AttributeError:
        return False
    return getattr(attributes.get("__spec__"), "_initializing", False) is True
