"""What a supervisor writes that outlives it: entries in the directory, and the records of its kept children.

Entries: for its children and for all actors below them. A child itself writes that it is UP. Its supervisor writes
every other status, since a dead child cannot. Records: of the children of a dynamic supervisor that have ids of their
own (storage/child_records.py).
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from rr_actors.base import pickling
from rr_actors.base.checks import invalid
from rr_actors.base.errors import (
    CatalogDamaged,
    CatalogError,
    CatalogVersion,
    InvalidSpec,
    NameTaken,
    RrError,
    StartFailed,
    few,
)
from rr_actors.base.names import CONNECTED
from rr_actors.base.reporting.log import Log
from rr_actors.base.scarcity import wanted_by
from rr_actors.registrar.declarations import class_names
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.manager import Manager
from rr_actors.runtime.callback_errors import described_error
from rr_actors.runtime.time_limits import wait_while_running
from rr_actors.storage.child_records import ChildRecord, ChildRecords
from rr_actors.supervision.core.specs import ChildSpec, Supervisor, as_child_spec, starting_with
from rr_actors.supervision.core.state import KeptChild
from rr_actors.wire.name_service import Directory, Presence, Turn, actor_key, registrar_key
from rr_actors.wire.unix_sockets import pid_of

logger = Log("rr_actors.supervision")


_ORPHANS = (
    "%s: its children %s are on disk, and start again when the tree has this supervisor; to forget them, remove %s"
)


class Entries:
    """The part of the directory below one supervisor. With the children that dynamic supervisors below it have kept."""

    def __init__(self, directory: Directory, records: ChildRecords) -> None:
        self._directory = directory
        self._records = records

    def starting_with(self, spec: ChildSpec, path: str) -> Iterator[tuple[str, ChildSpec]]:
        """Yield what specs.starting_with() yields, and the kept children of each dynamic supervisor after it.

        Raises:
            CatalogError: their records cannot be listed.
        """
        for where, child in starting_with(spec, path):
            yield where, child
            inner = child.actor_class_or_manager
            if isinstance(inner, Supervisor) and inner.strategy == "simple_one_for_one":
                template = as_child_spec(inner.children[0])
                for id in self._records.ids(where):
                    yield from self.starting_with(replace(template, id=id), f"{where}/{id}")

    def registrars_of(self, spec: ChildSpec, path: str) -> list[str]:
        """Return the registrars of the child at `path`, and of all that start with it or are kept below it."""
        try:
            return _registrars_among(self.starting_with(spec, path))
        except RrError as error:
            logger.error("%s: what is kept below it is not known: %s", path, error)
            return registrars_of(spec, path)

    def mark(self, spec: ChildSpec, path: str, status: Presence, why: str = "", turn: Turn | None = None) -> list[str]:
        """Mark a child, its registrar and all below it with a status. Return the registrars if the status is GONE.

        `turn` is the child's. All below a child that is STARTING are due: it starts them one after another. So are all
        below one that is STOPPED and due.
        An error is logged: the directory may be gone, with the system.
        """
        try:
            for where, child in self.starting_with(spec, path):
                self._mark_one(child, where, status, why, turn)
                turn = Turn.DUE if status is Presence.STARTING or turn is Turn.DUE else None
        except RrError as error:
            logger.error("%s: could not be marked %s in the directory: %s", path, status.value, error)
        return self.registrars_of(spec, path) if status is Presence.GONE else []

    def announce(self, spec: ChildSpec, path: str) -> None:
        """Mark the top of a tree, which has no supervisor, and all below it as STARTING.

        Raises:
            InvalidSpec: a kept child has the id of another manager.
            CatalogError: what is kept cannot be listed.
            ConfigError: the directory cannot be written.
        """
        managers: dict[str, str] = {}
        for where, child in self.starting_with(spec, path):
            if manager_of(child) is not None and (other := managers.setdefault(child.id, where)) != where:
                text = f"{where} is kept on disk from an earlier run, and {other} has its id: choose another for that"
                raise InvalidSpec(text, field="id", expected="an id that no kept child has", got=child.id)
            self._mark_one(child, where, Presence.STARTING, turn=Turn.DUE)

    def tell_of_orphans(self, spec: ChildSpec, path: str) -> None:
        """Log each supervisor that is not in the tree now, and whose children are on disk.

        Raises:
            CatalogError: what is kept cannot be listed.
        """
        there = {where for where, _ in self.starting_with(spec, path)}
        for below in self._records.supervisors():
            above = f"{path}/{below}" if below else path
            if above not in there and (ids := self._records.ids(above)):
                logger.warning(_ORPHANS, above, few(ids), self._records.place(above))

    def mark_dormant(self, spec: ChildSpec, path: str, why: str) -> None:
        """Mark the registrars of a kept child that does not start as DORMANT: its catalogs are there, and not open."""
        try:
            for name in self.registrars_of(spec, path):
                self._directory.mark(registrar_key(name), Presence.DORMANT, why)
        except RrError as error:
            logger.error("%s: could not be marked dormant in the directory: %s", path, error)

    def _mark_one(self, spec: ChildSpec, path: str, status: Presence, why: str = "", turn: Turn | None = None) -> None:
        self._directory.mark(actor_key(path), status, why, turn)
        if (manager := manager_of(spec)) is not None:
            name = path.rpartition("/")[2]
            if status is Presence.STARTING:  # others find it by its classes: `load(Cameras.open_camera, ...)`
                self._directory.put_classes(name, class_names(manager))
            self._directory.mark(registrar_key(name), status, why, turn if status is Presence.STOPPED else None)

    def check_names(self, spec: ChildSpec, path: str) -> None:
        """Check that no registrar of a new child exists already, below another supervisor or opened by hand.

        Raises:
            NameTaken: one does; it is left alone.
            InvalidSpec: one has a connection's name, or a renamed_from.
        """
        for where in renamed_managers(spec, path):
            expected = "None in a child that is added at run time: the others have loaded from it under its old id"
            raise invalid(f"start_child: {path}", "renamed_from", expected, where)
        names = self.registrars_of(spec, path)
        check_managers(names, f"start_child: {path}")
        for name in names:
            entry = self._directory.lookup(registrar_key(name))
            if entry is not None and entry.status not in (Presence.GONE, Presence.DORMANT):
                text = f"start_child: {path}: a registrar {name!r} is in the system already; choose another id"
                raise NameTaken(text, name=name)

    def pid_of(self, spec: ChildSpec, path: str) -> int | None:
        """Return the id of the process of the child at `path`, as its own entry says; None if it is not up.

        A manager's registrar is up a moment before the manager itself, and its supervisor hears so later.
        """
        registrar = None if manager_of(spec) is None else self._pid(registrar_key(path.rpartition("/")[2]))
        return registrar or self._pid(actor_key(path))

    def pids_below(self, path: str) -> list[int]:
        """Return the ids of the processes of the actors below `path`."""
        pids = {self._pid(key) for key in self._directory.actors_below(path)}
        return [pid for pid in pids if pid is not None]

    def _pid(self, key: str) -> int | None:
        entry = self._directory.lookup(key)
        return pid_of(entry.address) if entry is not None and entry.status is Presence.UP else None

    def forget_dynamic(self, spec: ChildSpec, path: str, managers: set[str]) -> list[str]:
        """Mark the children that were added at run time below `path` as GONE, except for those that are kept.

        Their supervisor there has died.

        Args:
            managers: the paths of the managers that were running below it.

        Returns: the registrars of those managers that will not come back.
        """
        try:
            static = {where for where, _ in self.starting_with(spec, path)}
            known = {actor_key(where) for where in static}
            for key in self._directory.actors_below(path):
                if key not in known:
                    self._directory.mark(key, Presence.GONE)
        except RrError as error:
            logger.error("%s: what was below it could not be marked gone in the directory: %s", path, error)
            return []
        return [manager.rpartition("/")[2] for manager in managers - static]


class KeptChildren:
    """The kept children of the supervisor at `path`, from one incarnation of it to the next. On the loop.

    Workers read and write their records, one after another.

    Attributes:
        records: of all supervisors of the system.
    """

    def __init__(self, node: Node, path: str) -> None:
        self.records = ChildRecords(node.info.state_dir)
        self._node = node
        self._path = path
        self._ids: set[str] = set()
        self._one_by_one = asyncio.Lock()

    def has(self, id: str) -> bool:
        """Return whether the child has a record, or will have one when its start begins."""
        return id in self._ids

    async def read(self) -> list[KeptChild]:
        """Return the children that earlier incarnations of the supervisor have left, in the order of their records.

        One whose record is damaged, or whose arguments cannot be unpickled, is lost, and comes last.

        Raises:
            CatalogError: the records cannot be listed, or not be read because something outside is missing.
        """
        run = self._node.dispatcher.workers.run
        async with self._one_by_one:
            ids = await run(self.records.ids, self._path)
            self._ids.update(ids)
            found: list[tuple[int, KeptChild]] = []
            lost: list[KeptChild] = []
            for id in ids:
                try:
                    record = await run(self.records.read, self._path, id)
                    found.append((record.at_ns, KeptChild(id, await self._arguments(record))))
                except (CatalogDamaged, CatalogVersion, StartFailed) as error:
                    lost.append(KeptChild(id, lost=error))
                except CatalogError as error:
                    if wanted_by(error):
                        raise
                    lost.append(KeptChild(id, lost=error))
        return [child for _, child in sorted(found, key=lambda each: each[0])] + lost

    async def _arguments(self, record: ChildRecord) -> tuple[Any, ...]:
        """Unpickle the arguments of a child. This runs code of users, which may be of another version by now."""
        reading = asyncio.ensure_future(self._node.dispatcher.workers.run(pickling.loads, record.args))
        limit_s = self._node.config.start_timeout_s
        await wait_while_running(reading, limit_s)
        where = f"{self._path}/{record.id}"
        what = f"{where}: the arguments that start_child() was given are on disk, and cannot be read now"
        if not reading.done():
            raise StartFailed(f"{what}: that had not ended after {limit_s:g} s (start_timeout_s)", id=where)
        try:
            return reading.result()
        except Exception as failure:
            error = await described_error(failure)
            raise StartFailed(f"{what}: {error}", id=where) from error

    async def write(self, id: str, args: tuple[Any, ...]) -> None:
        """Commit the record of a child.

        Raises:
            NotSerializable: its arguments cannot be pickled.
            CatalogError: it cannot be written.
        """
        self._ids.add(id)
        async with self._one_by_one:
            await self._node.dispatcher.workers.run(self._write, id, args)

    def _write(self, id: str, args: tuple[Any, ...]) -> None:
        if (place := self._node.info.place) is not None:
            place.check()
        blob = pickling.dumps(args, f"the arguments of {self._path}/{id}")
        self.records.write(self._path, id, blob, time.time_ns(), synced=self._is_synced(id))

    def _is_synced(self, id: str) -> bool:
        return self._node.config.registrar(id).durability == "power"

    async def remove(self, ids: Sequence[str]) -> None:
        """Remove the records of children that have ended for good.

        Raises:
            CatalogError: one cannot be removed.
        """
        self._ids.difference_update(ids)
        synced = any(map(self._is_synced, ids))
        async with self._one_by_one:
            await self._node.dispatcher.workers.run(lambda: self.records.remove(self._path, ids, synced=synced))

    async def remove_below(self, path: str) -> None:
        """Remove the records of a supervisor below this one that is gone for good. An error is logged."""
        try:
            await self._node.dispatcher.workers.run(self.records.remove_below, path)
        except RrError as error:
            logger.error("%s: its children will come back if it does: %s", path, error)


def manager_of(spec: ChildSpec) -> type[Manager] | None:
    """Return the child's class if it is a Manager, which has a registrar."""
    what = spec.actor_class_or_manager
    return what if isinstance(what, type) and issubclass(what, Manager) else None


def check_managers(names: list[str], where: str) -> None:
    """Raise InvalidSpec for a manager with a connection's name: its application's end would give up its registrar."""
    for name in names:
        if name.startswith(CONNECTED):
            whose = "as those of connected programs do (rr.connect())"
            expected = f"a manager's id that does not begin with {CONNECTED!r}, {whose}"
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
    return _registrars_among(starting_with(spec, path))


def _registrars_among(children: Iterator[tuple[str, ChildSpec]]) -> list[str]:
    return [where.rpartition("/")[2] for where, child in children if manager_of(child) is not None]
