"""Questions of a console: the tree, the registrars, and what they have, each as a page. In a worker."""

from __future__ import annotations

import dataclasses
import itertools
import os
import time
import weakref
from collections.abc import Iterator, Sequence
from typing import Any, Literal, Protocol

import msgspec

from rr_actors.actors.messaging.dead_letters import DeadLetters
from rr_actors.actors.messaging.exit_reports import ExitReport
from rr_actors.actors.refs import ActorRef
from rr_actors.base.config import SystemConfig
from rr_actors.base.errors import NotFound, RrError, Unavailable, UsageError, text_of
from rr_actors.registrar.model.messages import readable
from rr_actors.registrar.pages import Page, QueryRow, ResourceRow, Wanted
from rr_actors.registrar.registrar import Registrar, page
from rr_actors.supervision.event_history import Record
from rr_actors.supervision.supervisor import SupervisorRef
from rr_actors.system.console.console_messages import (
    PAGE_LIMIT,
    RESPONSE_LIMIT_BYTES,
    Answer,
    Children,
    ChildRow,
    Figures,
    Find,
    Found,
    Happenings,
    Letters,
    ListChildren,
    ListDeadLetters,
    ListFigures,
    ListHistory,
    ListQueries,
    ListRegistrars,
    ListResources,
    Queries,
    Question,
    RegistrarRow,
    Registrars,
    Resources,
)
from rr_actors.system.hosting.node import Node
from rr_actors.system.recording.figures import Figure
from rr_actors.system.registrar_lookup import open_registrar, registrar_in
from rr_actors.wire.name_service import Status

_LOOK_S = 5.0
"""Seconds that one supervisor may take to answer; after that, a console shows the others without it."""
_TRACEBACK = 4000  # characters


class Viewed(Protocol):
    """The part of System that a console uses. System has the docstrings."""

    name: str
    config: SystemConfig

    @property
    def ended(self) -> ExitReport | None: ...

    def supervisor(self, path: str | None = None) -> SupervisorRef: ...

    def ref(self, id: str) -> ActorRef[Any]: ...

    def registrar(self, name: str) -> Registrar: ...

    def dead_letters(self) -> DeadLetters: ...

    def figures(self) -> list[Figure]: ...


class View:
    """A running system, as a console sees it. From workers.

    Args:
        system: held weakly, so that a dropped system is noticed.
    """

    def __init__(self, system: Viewed, node: Node) -> None:
        self._system = weakref.ref(system)
        self.node = node
        self.since = time.time()
        self._began = time.monotonic()

    @property
    def system(self) -> Viewed:
        """Return the system that the console looks at; raise Unavailable if it was dropped."""
        if (system := self._system()) is None:
            raise Unavailable("the system was dropped, and is being stopped")
        return system

    def answer(self, question: Question) -> Answer:
        """Answer a question about the system.

        Raises:
            RrError: the part that the question is about does not exist, or does not answer.
        """
        match question:
            case ListChildren(match, offset, limit):
                return self.children(match, offset, limit)
            case ListRegistrars(match, offset, limit):
                names = [name for name in self.node.statuses() if match in name]
                return Registrars(len(names), [self._registrar(name) for name in names[offset : offset + limit]])
            case ListResources(match, offset, limit, registrar):
                found, notes = self._page("resources", registrar, match, offset, limit)
                return Resources(found.total, found.resources[: _room_for(found.resources, notes)], notes)
            case ListQueries(match, offset, limit, registrar):
                found, notes = self._page("queries", registrar, match, offset, limit)
                return Queries(found.total, found.queries, notes)
            case Find(id, registrar):
                return self.find(id, registrar)
            case ListHistory(path, limit):
                records = [_fitting(record) for record in self._history(path)[-limit:]]
                older = len(records) - _room_for(records[::-1])
                return Happenings(records[older:], older)
            case ListDeadLetters(limit):
                letters = self.system.dead_letters()
                return Letters(letters.count, letters.letters[-limit:])
            case ListFigures():
                return Figures(self.system.figures())

    # -- the tree --------------------------------------------------------------------------------------------------

    def children(self, match: str = "", offset: int = 0, limit: int = PAGE_LIMIT) -> Children:
        """Return a page of the tree."""
        rows = [row for row in self._walk() if match in row.path]
        return Children(len(rows), rows[offset : offset + limit])

    def _walk(self) -> Iterator[ChildRow]:
        root = self.system.supervisor().path
        ended = self.system.ended
        row = ChildRow(root, 0, "supervisor", "running" if ended is None else "stopped", os.getpid())
        yield from self._supervisor(msgspec.structs.replace(row, up_s=time.monotonic() - self._began))

    def _supervisor(self, row: ChildRow) -> Iterator[ChildRow]:
        try:
            described = SupervisorRef(row.path, timeout_s=_LOOK_S).describe()
        except Exception as error:  # the supervisor is stopped or restarting, or its process does not answer in time
            state = "unavailable" if row.state == "running" else row.state
            yield msgspec.structs.replace(row, state=state, error=readable(text_of(error)))
            return
        recent, most = described["recent_restarts"], described["max_restarts"]
        strategy = f"{described['strategy']}, {most} in {described['max_seconds']:g} s"
        yield msgspec.structs.replace(row, strategy=strategy, max_restarts=most, recent_restarts=recent)
        for child in described["children"]:
            how = child["type"], child["state"], child["pid"], child["restarts"], child["up_s"]
            below = ChildRow(f"{row.path}/{child['id']}", row.depth + 1, *how)
            if below.type == "supervisor" and below.state == "running":
                yield from self._supervisor(below)
            else:
                yield below

    def _history(self, path: str) -> list[Record]:
        """Return the records of the child at `path` and of all below it, oldest first."""
        paths = [row.path for row in self._walk() if row.type == "supervisor" and not row.error]
        place = self.path_of(path) if path else ""
        records: list[Record] = []
        for supervisor in paths:
            try:
                records += SupervisorRef(supervisor, timeout_s=_LOOK_S).history()
            except Exception as error:
                if supervisor == place:
                    raise Unavailable(f"supervisor {supervisor}: {text_of(error)}") from error
        chosen = [record for record in records if not place or f"{record.path}/".startswith(f"{place}/")]
        return sorted(chosen, key=lambda record: record.at)

    def path_of(self, child: str) -> str:
        """Return the path of a child that is given by its path or its id.

        Raises:
            NotFound: there is no such child, or several have the id.
        """
        root = self.system.supervisor().path
        if child == root:
            return root
        path = self.system.ref(child).path
        if path is None:
            raise NotFound(f"{child}: it is not in the tree", id=child)
        return path

    # -- registrars --------------------------------------------------------------------------------------------------

    def up(self, registrar: str) -> list[str]:
        """Return the names of the registrars that can be asked: this one, or all that are up.

        Raises:
            UnknownRegistrar: the system has no registrar of this name.
        """
        if registrar:
            self.registrar(registrar)
            return [registrar]
        return [name for name, status in self.node.statuses().items() if status is Status.UP]

    def registrar(self, name: str) -> Registrar:
        """Return a registrar, or a handle on it that does not wait for a restart.

        Raises:
            UnknownRegistrar, InvalidName: the system has no registrar of this name.
        """
        return registrar_in(self.node, name, patient=False)

    def open_registrar(self, name: str) -> Registrar:
        """Open a registrar as registrar_lookup.open_registrar() does; its catalog is removed when it is closed."""
        config = dataclasses.replace(self.system.config.registrar(name), erase_on_destruct=True)
        return open_registrar(self.node, name, config, self.system)

    def _registrar(self, name: str) -> RegistrarRow:
        status = self.node.status_of(name)
        if status is not Status.UP:
            return RegistrarRow(name, (status or Status.GONE).value)
        try:
            registrar = self.registrar(name)
            return RegistrarRow(name, status.value, registrar.servers(), registrar.stats())
        except RrError as error:
            return RegistrarRow(name, status.value, error=readable(text_of(error)))

    def _page(
        self, what: Literal["resources", "queries", "id"], registrar: str, match: str, offset: int = 0, limit: int = 0
    ) -> tuple[Page, list[str]]:
        """Return a page over several registrars, and notes on registrars that do not answer."""
        total, resources, queries, notes = 0, list[ResourceRow](), list[QueryRow](), list[str]()
        for name in self.up(registrar):
            wanted = Wanted(what, match, max(0, offset - total), limit - len(resources) - len(queries))
            try:
                found = page(self.registrar(name), wanted)
            except RrError as error:
                notes.append(readable(text_of(error)))
            else:
                total += found.total
                resources += found.resources
                queries += found.queries
        return Page(total, resources, queries), notes

    def find(self, id: str, registrar: str = "") -> Found:
        """Return the resources and queries with this id, or if there are none, those whose ids begin with it."""
        if not id:
            raise UsageError("expected the id of a query or resource, or four characters of its beginning, got nothing")
        found, notes = self._page("id", registrar, id)
        resources, queries = found.resources, found.queries
        if any(row.id == id for row in (*resources, *queries)):
            resources = [row for row in resources if id in (row.id, *(holder.query_id for holder in row.holders))]
            queries = [row for row in queries if row.id == id]
        return Found(resources, queries, notes)


def _room_for(rows: Sequence[ResourceRow | Record], notes: Sequence[str] = ()) -> int:
    """Return how many of these rows, from the first on, have room in an answer with the notes: texts may be long."""
    limit = RESPONSE_LIMIT_BYTES - len(msgspec.msgpack.encode(notes))
    sizes = itertools.accumulate(len(msgspec.msgpack.encode(row)) for row in rows)
    return sum(size <= limit for size in sizes)


def _fitting(record: Record) -> Record:
    """Return a record with texts that can be sent."""
    cut = record.traceback[-_TRACEBACK:]
    return msgspec.structs.replace(record, detail=readable(record.detail), traceback=readable(cut))
