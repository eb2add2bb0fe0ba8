"""Entries: a supervisor's entries in the directory for its children and for all actors below them.

A child itself writes that it is UP. Its supervisor writes every other status, since a dead child cannot.
"""

from __future__ import annotations

from rr_actors.base.checks import invalid
from rr_actors.base.errors import NameTaken, RrError
from rr_actors.base.names import CLIENTS
from rr_actors.base.reporting.log import Log
from rr_actors.registrar.declarations import class_names
from rr_actors.registrar.manager import Manager
from rr_actors.supervision.core.specs import ChildSpec, starting_with
from rr_actors.wire.name_service import Directory, Presence, Turn, actor_key, registrar_key
from rr_actors.wire.unix_sockets import pid_of

logger = Log("rr_actors.supervision")


class Entries:
    """The part of the directory below one supervisor."""

    def __init__(self, directory: Directory) -> None:
        self._directory = directory

    def mark(self, spec: ChildSpec, path: str, status: Presence, why: str = "", turn: Turn | None = None) -> list[str]:
        """Mark a child, its registrar and all below it with a status. Return the registrars if the status is GONE.

        `turn` is the child's. All below a child that is STARTING are due: it starts them one after another.
        An error is logged: the directory may be gone, with the system.
        """
        try:
            for where, child in starting_with(spec, path):
                self._mark_one(child, where, status, why, turn)
                turn = Turn.DUE if status is Presence.STARTING else None
        except RrError as error:
            logger.error("%s: could not be marked %s in the directory: %s", path, status.value, error)
        return registrars_of(spec, path) if status is Presence.GONE else []

    def announce(self, spec: ChildSpec, path: str) -> None:
        """Mark the top of a tree, which has no supervisor, and all below it as STARTING, or raise ConfigError."""
        for where, child in starting_with(spec, path):
            self._mark_one(child, where, Presence.STARTING, turn=Turn.DUE)

    def _mark_one(self, spec: ChildSpec, path: str, status: Presence, why: str = "", turn: Turn | None = None) -> None:
        self._directory.mark(actor_key(path), status, why, turn)
        if (manager := manager_of(spec)) is not None:
            name = path.rpartition("/")[2]
            if status is Presence.STARTING:  # others find it by its classes: `load(Cameras.open_camera, ...)`
                self._directory.put_classes(name, class_names(manager))
            self._directory.mark(registrar_key(name), status, why)

    def check_names(self, spec: ChildSpec, path: str) -> None:
        """Check that no registrar of a new child exists already, below another supervisor or opened by hand.

        Raises:
            NameTaken: one does; it is left alone.
            InvalidSpec: one has a client's name, or a renamed_from.
        """
        for where in renamed_managers(spec, path):
            expected = "None in a child that is added at run time: the others have loaded from it under its old id"
            raise invalid(f"start_child: {path}", "renamed_from", expected, where)
        names = registrars_of(spec, path)
        check_managers(names, f"start_child: {path}")
        for name in names:
            entry = self._directory.lookup(registrar_key(name))
            if entry is not None and entry.status not in (Presence.GONE, Presence.DORMANT):
                text = f"start_child: {path}: a registrar {name!r} is in the system already; choose another id"
                raise NameTaken(text, name=name)

    def pid_of(self, path: str) -> int | None:
        """Return the id of the process of the actor at `path`, as its own entry says; None if it is not up."""
        return self._pid(actor_key(path))

    def pids_below(self, path: str) -> list[int]:
        """Return the ids of the processes of the actors below `path`."""
        pids = {self._pid(key) for key in self._directory.actors_below(path)}
        return [pid for pid in pids if pid is not None]

    def _pid(self, key: str) -> int | None:
        entry = self._directory.lookup(key)
        return pid_of(entry.address) if entry is not None and entry.status is Presence.UP else None

    def forget_dynamic(self, spec: ChildSpec, path: str, managers: set[str]) -> list[str]:
        """Mark the children that were added at run time below `path` as GONE: their supervisor there has died.

        Args:
            managers: the paths of the managers that were running below it.

        Returns: the registrars of those managers that will not come back.
        """
        static = {where for where, _ in starting_with(spec, path)}
        known = {actor_key(where) for where in static}
        try:
            for key in self._directory.actors_below(path):
                if key not in known:
                    self._directory.mark(key, Presence.GONE)
        except RrError as error:
            logger.error("%s: what was below it could not be marked gone in the directory: %s", path, error)
        return [manager.rpartition("/")[2] for manager in managers - static]


def manager_of(spec: ChildSpec) -> type[Manager] | None:
    """Return the child's class if it is a Manager, which has a registrar."""
    what = spec.actor_class_or_manager
    return what if isinstance(what, type) and issubclass(what, Manager) else None


def check_managers(names: list[str], where: str) -> None:
    """Raise InvalidSpec for a manager with a client's name: its registrar would be given up with its application."""
    for name in names:
        if name.startswith(CLIENTS):
            expected = f"a manager's id that does not begin with {CLIENTS!r}, as those of clients do (rr.connect())"
            raise invalid(where, "id", expected, name)


def renamed_managers(spec: ChildSpec, path: str) -> dict[str, str]:
    """Return the earlier ids of managers among the child at `path` and all that start with it, by their present ids.

    Raises:
        InvalidSpec: a child that has an earlier id is no manager.
    """
    found: dict[str, str] = {}
    for where, child in starting_with(spec, path):
        if child.renamed_from is not None:
            if manager_of(child) is None:
                raise invalid(where, "renamed_from", "None, as only managers leave something", child.renamed_from)
            found[where.rpartition("/")[2]] = child.renamed_from
    return found


def registrars_of(spec: ChildSpec, path: str) -> list[str]:
    """Return the registrars of the child at `path` and of all that start with it. They are named like the managers."""
    return [where.rpartition("/")[2] for where, child in starting_with(spec, path) if manager_of(child) is not None]
