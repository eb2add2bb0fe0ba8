"""Module watcher: restarts the children of a running system whose modules have changed on disk.

A child's module is the file that has its class. If the file is not valid Python, the child runs on, and the log says
why.
"""

from __future__ import annotations

import sys
from pathlib import Path

from rr_actors.base.errors import NotFound, RrError
from rr_actors.base.folder import read_plain
from rr_actors.base.reporting.log import Log
from rr_actors.supervision.core.specs import ChildSpec, Supervisor
from rr_actors.system.system import System

logger = Log("rr_actors.watch")

LOOK_S = 0.5
"""Seconds between two looks. A changed file is read when it has not changed again between two looks."""

_Stamp = tuple[int, int]


class SavedFile:
    """A file that somebody edits. look() says when it has been saved."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._known = self._seen = _stamp(file)

    def look(self) -> bool:
        """Return whether the file has changed since this was last true, and is whole.

        It is whole if it has not changed between two looks. A file that is not there has not changed.
        """
        before, self._seen = self._seen, _stamp(self._file)
        if self._seen is None or self._seen == self._known or self._seen != before:
            return False
        self._known = self._seen
        return True


class ModuleWatcher:
    """Watches the modules of a system whose tree it is given. One thread may use it.

    It does not watch children that were added later, nor children in threads of the application's process: their
    module is imported already.
    """

    def __init__(self, system: System, tree: Supervisor) -> None:
        self._system = system
        self._children: dict[Path, list[tuple[str, str]]] = {}
        self._forgotten: dict[str, ChildSpec] = {}  # temporary children that were stopped here and have not started yet
        self._collect(tree, tree.id)
        self._files = {file: SavedFile(file) for file in self._children}

    def _collect(self, supervisor: Supervisor, path: str) -> None:
        for spec in supervisor.child_specs:
            inner = spec.actor_class_or_manager
            if isinstance(inner, Supervisor):
                self._collect(inner, f"{path}/{spec.id}")
                continue
            file = getattr(sys.modules.get(inner.__module__), "__file__", None)
            if file is not None and spec.placement == "process":
                self._children.setdefault(Path(file), []).append((path, spec.id))

    def look(self) -> list[str]:
        """Restart the children whose modules have changed, and return their paths."""
        restarted: list[str] = []
        for file, children in self._children.items():
            if not self._files[file].look():
                continue
            try:
                compile(read_plain(file), str(file), "exec")
            except (OSError, SyntaxError, ValueError) as error:
                logger.error("%s has changed, and cannot be loaded; its children run on: %s", file, error)
                continue
            restarted += [path for where, id in children if (path := self._restart(file, where, id))]
        return restarted

    def _restart(self, file: Path, where: str, id: str) -> str:
        path = f"{where}/{id}"
        try:
            supervisor = self._system.supervisor(where)
            if path not in self._forgotten and supervisor.which_child(id).state != "stopped":
                spec = supervisor.get_childspec(id)
                supervisor.terminate_child(id)
                if spec.restart == "temporary":  # its supervisor has forgotten it
                    self._forgotten[path] = spec
            if path in self._forgotten:
                supervisor.start_child(self._forgotten[path])
                del self._forgotten[path]
            else:
                supervisor.restart_child(id)
        except NotFound:  # the child was deleted, or was temporary and has ended
            return ""
        except RrError as error:
            logger.error("%s: %s has changed, and it does not start: %s", path, file.name, error)
            return ""
        logger.info("%s: restarted, as %s has changed", path, file.name)
        return path


def _stamp(file: Path) -> _Stamp | None:
    try:
        found = file.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size
