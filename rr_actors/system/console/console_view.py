"""View: a running system as a console sees it, and Verb, the base of what a console can ask and do. In a worker.

A verb is declared once, as a class. Its fields are its arguments, its base names the type of its answer, and its method
_carry_out() does it. The questions are in console_questions.py, the commands in console_commands.py.
"""

from __future__ import annotations

import abc
import contextlib
import dataclasses
import itertools
import os
import threading
import time
import weakref
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Generic, Protocol, TypeVar

import msgspec

from rr_actors.actors.mailbox_refs import MailboxRef
from rr_actors.actors.messaging.dead_letters import DeadLetters
from rr_actors.actors.messaging.exit_reports import ExitReport
from rr_actors.actors.refs import ActorDeadError, ActorRef
from rr_actors.base.config import SystemConfig
from rr_actors.base.errors import ActorUnavailable, NotFound, RrError, Unavailable, UsageError, readable, shown, text_of
from rr_actors.base.names import child_meant, no_child
from rr_actors.hosting.forwarded_logs import KeptLogs
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.pages import QueryRow, ResourceRow, RowPage, Wanted
from rr_actors.registrar.registrar import Registrar, Usages, page
from rr_actors.runtime.processes.lifeline import stopped
from rr_actors.streams.stream import StreamRow
from rr_actors.supervision.supervisor import SupervisorRef
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.attention.attention_items import Silences
from rr_actors.system.console.connected_registrars import Caller, ConnectedRegistrars
from rr_actors.system.recording.event_memory import Event, EventMemory, events_below, events_of
from rr_actors.system.recording.figures import Figure
from rr_actors.system.registrar_lookup import open_registrar, registrar_in
from rr_actors.system.snapshots import ask_each, describe_supervisor
from rr_actors.wire.name_service import Presence

_LOOK_S = 5.0
"""Seconds that one supervisor may take to answer; after that, a console shows the others without it."""
_USAGE_S = 2.0
_HISTORY = 2000  # events of children
_ALIKE = 20  # queries of one name
_TITLES = 10_000
REGISTRAR = "console"
"""The registrar of the system that holds the resources that a console loads and keeps. The first such load opens it."""
_A = TypeVar("_A")


class BackedUp(Protocol):
    """What a console says of a backup. Backup has the docstrings."""

    def told(self, where: str) -> str: ...

    def facts(self, where: str) -> dict[str, Any]: ...


class Viewed(Protocol):
    """The part of System that a console uses. System has the docstrings."""

    name: str
    config: SystemConfig

    @property
    def ended(self) -> ExitReport | None: ...

    def supervisor(self, path: str | None = None) -> SupervisorRef: ...

    def ref(self, id: str) -> ActorRef[Any]: ...

    def mailbox(self, id: str) -> MailboxRef: ...

    def registrar(self, name: str) -> Registrar: ...

    def dead_letters(self) -> DeadLetters: ...

    def figures(self) -> list[Figure]: ...

    def backup(self, directory: str, *, timeout_s: float = 30.0) -> BackedUp: ...


class View:
    """A running system, as a console sees it. From workers.

    Args:
        system: held weakly, so that a dropped system is noticed.
        memory: what has happened in it.
        child_logs: the last log lines of its children.
        shut_down: stops the system, in a thread of its own.

    Attributes:
        connected: the registrars of connected programs.
        silences: what is not to be shown of what needs attention.
    """

    def __init__(
        self, system: Viewed, node: Node, memory: EventMemory, child_logs: KeptLogs, shut_down: Callable[[], None]
    ) -> None:
        self._system = weakref.ref(system)
        self.node = node
        self.memory = memory
        self.child_logs = child_logs
        self.shut_down = shut_down
        self.connected = ConnectedRegistrars()
        self.silences = Silences()
        self._opening = threading.Lock()
        self._titles: dict[str, str] = {}  # of the requests of queries, by the ids of these
        self.since = time.time()
        self._began = time.monotonic()

    @property
    def system(self) -> Viewed:
        """Return the system that the console looks at; raise Unavailable if it was dropped."""
        if (system := self._system()) is None:
            raise Unavailable("the system was dropped, and is being stopped")
        return system

    # -- the tree --------------------------------------------------------------------------------------------------

    def children(self, match: str = "", offset: int = 0, limit: int = c.PAGE_LIMIT) -> c.Children:
        """Return a page of the tree."""
        rows = [row for row in self._walk() if match in row.path]
        return c.Children(len(rows), rows[offset : offset + limit])

    def _walk(self) -> Iterator[c.ChildRow]:
        if (ended := self.system.ended) is not None:  # what has ended is not asked: that would make a dead letter
            events = self.memory.of_children(_HISTORY, self.memory.began)
            yield from _last_seen(events, self.system.supervisor().path, readable(ended.detail))
            return
        state = {"state": "running", "pid": os.getpid()}
        root = describe_supervisor(SupervisorRef(self.system.supervisor().path, timeout_s=_LOOK_S), text_of)
        notes = self.node.directory.notes()
        for row in _rows(root | state | {"up_s": time.monotonic() - self._began}):
            said = "" if row.type == "supervisor" else notes.get(row.id, "")
            yield msgspec.structs.replace(row, note=readable(said)) if said else row

    def history(self, path: str) -> list[Event]:
        """Return the newest events of the child at `path` and of all below it, oldest first."""
        events = self.memory.of_children(_HISTORY)
        if path and self.system.ended is None:
            with contextlib.suppress(NotFound, Unavailable):
                return events_below(events, self.path_of(path))
        return events_of(events, path)

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

    def logging_child(self, child: str) -> tuple[str, str]:
        """Return the path of a child that a path or id names, also of one that has left, and why it has no log lines.

        Raises:
            NotFound: there is no such child, or several have the id.
        """
        logged = self.child_logs.paths()
        if (path := child_meant(child, logged)) is not None:
            return path, ""
        rows = {row.path: row for row in self._walk()}
        if (path := child_meant(child, rows)) is None:
            raise no_child(child, {*rows, *logged})
        if not self.system.config.logging:
            return path, "with SystemConfig(logging=False) a child's records go to its standard error"
        return path, _no_log(path, rows)

    def running_child(self, child: str) -> str:
        """Return the path of a child that runs or starts, which a path or id names.

        Raises:
            NotFound: there is no such child, or several have the id.
            Unavailable: it does not run.
        """
        if (path := child_meant(child, self.node.stacks.paths())) is not None:
            return path
        rows = {row.path: row for row in self._walk()}
        if (path := child_meant(child, rows)) is None:
            raise no_child(child, rows)
        if rows[path].pid is None:
            raise Unavailable(f"{path}: it has no process now: it is {rows[path].state}")
        return path

    def at_mailbox(self, actor: str, do: Callable[[MailboxRef], _A]) -> _A:
        """Do something with the mailbox of an actor.

        Raises:
            NotFound: there is no such actor.
            ActorUnavailable: it has ended.
        """
        try:
            return do(self.system.mailbox(actor))
        except ActorDeadError as error:
            raise ActorUnavailable(f"{shown(actor)}: {error}", id=actor) from error

    # -- registrars --------------------------------------------------------------------------------------------------

    def up(self, registrar: str) -> list[str]:
        """Return the names of the registrars that can be asked: this one, or all that are up.

        Raises:
            UnknownRegistrar: the system has no registrar of this name.
        """
        if registrar:
            self.registrar(registrar)
            return [registrar]
        return [name for name, status in self.node.statuses().items() if status is Presence.UP]

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

    def holder(self, name: str) -> Registrar:
        """Return the registrar that holds what a console loads: this one, or with "" the console's own."""
        if not name:
            with self._opening:
                if self.node.status_of(REGISTRAR) in (None, Presence.GONE, Presence.DORMANT):
                    return self.open_registrar(REGISTRAR)
        return self.system.registrar(name or REGISTRAR)

    def described(self, name: str) -> c.RegistrarRow:
        """Return a registrar's row. One that does not answer has an error in it."""
        status = self.node.status_of(name)
        if status is not Presence.UP:
            entry = self.node.find(name)
            contents = f"dormant{entry.because}" if entry is not None and status is Presence.DORMANT else ""
            return c.RegistrarRow(name, (status or Presence.GONE).value, error=contents)
        try:
            registrar = self.registrar(name)
            return c.RegistrarRow(name, status.value, registrar.servers(), registrar.stats())
        except RrError as error:
            return c.RegistrarRow(name, status.value, error=readable(text_of(error)))

    def page(self, wanted: Wanted, registrar: str = "") -> tuple[RowPage, list[str]]:
        """Return a page over one registrar or all that are up, and notes on registrars that do not answer.

        All are asked at once how many rows they have, and then those with rows in the page for these.
        """
        names = self.up(registrar)
        if len(names) == 1:
            pages, notes = self._pages({names[0]: wanted})
            return self._titled(_joined(list(pages.values()))), notes
        pages, notes = self._pages(dict.fromkeys(names, msgspec.structs.replace(wanted, offset=0, limit=0)))
        rows, more = self._pages(_parts(pages, wanted))
        return self._titled(_joined(list((pages | rows).values()))), notes + more

    def _titled(self, page: RowPage) -> RowPage:
        """Return a page with the titles of its queries. Their providers are asked for them, once for each query."""
        unknown: dict[str, list[str]] = {}
        for row in page.queries:
            if row.id not in self._titles:
                unknown.setdefault(row.server.partition("/")[0], []).append(row.id)
        up = self.node.statuses() if unknown else {}
        asked = {name: Wanted("titles", ids=tuple(ids)) for name, ids in unknown.items() if up.get(name) is Presence.UP}
        for found in self._pages(asked)[0].values() if asked else ():
            self._titles |= found.titles
        while len(self._titles) > _TITLES:
            del self._titles[next(iter(self._titles))]
        if not any(self._titles.get(row.id) for row in page.queries):
            return page
        rows = [msgspec.structs.replace(row, title=self._titles.get(row.id, "")) for row in page.queries]
        return msgspec.structs.replace(page, queries=rows)

    def _pages(self, wanted: Mapping[str, Wanted]) -> tuple[dict[str, RowPage], list[str]]:
        """Return a page of each registrar that answers, in the order of `wanted`, and notes on the others."""

        def ask(name: str) -> RowPage | RrError:
            try:
                return page(self.registrar(name), wanted[name])
            except RrError as error:
                return error

        names = list(wanted)
        answers = list(zip(names, ask_each(names, ask), strict=True))
        pages = {name: answer for name, answer in answers if not isinstance(answer, RrError)}
        return pages, [readable(text_of(answer)) for _, answer in answers if isinstance(answer, RrError)]

    def load_reports(self, registrar: str) -> dict[str, str]:
        """Return the last reports of a registrar's load callbacks, by the queries that wait; none if it is gone."""
        try:
            return self.page(Wanted("loads"), registrar)[0].said
        except RrError:
            return {}

    def usages(
        self, resources: Sequence[tuple[str, str]], notes: list[str]
    ) -> tuple[dict[str, dict[str, float]], dict[str, str]]:
        """Return the usage of resources by their ids, and why others are not known. Each is (registrar, id).

        Add notes on registrars that do not answer. A registrar has _USAGE_S for all its callbacks.
        """

        def ask(name: str) -> Usages | RrError:
            try:
                return self.registrar(name).usage(of=[id for one, id in resources if one == name], timeout_s=_USAGE_S)
            except RrError as error:
                return error

        usages, failures = dict[str, dict[str, float]](), dict[str, str]()
        for found in ask_each(list(dict.fromkeys(name for name, _ in resources)), ask):
            if isinstance(found, RrError):
                notes.append(readable(text_of(found)))
            else:
                usages |= found
                failures |= found.failures
        return usages, failures

    def find(self, id: str, registrar: str = "") -> c.Found:
        """Return the resources and queries with this id, or else those whose ids begin or end with it.

        The name of a resource stands for its id: "cameras/camera "/dev/video7"", also as it is shortened for people.
        """
        if not id:
            raise UsageError("expected the id or name of a query or resource, or four characters of an id, got nothing")
        server, space, request = id.partition(" ")
        if space and "/" in server:
            part = request.partition("…")[0]
            found, notes = self.page(Wanted("resources", part, limit=c.PAGE_LIMIT), server.partition("/")[0])
            rows = [row for row in found.resources if id in _names(row)]
            return c.Found(rows or self._as_its_holder_names_it(id, part), [], notes)
        found, notes = self.page(Wanted("id", id), registrar)
        resources, queries = found.resources, found.queries
        if any(row.id == id for row in (*resources, *queries)):
            resources = [row for row in resources if id in (row.id, *(holder.query_id for holder in row.holders))]
            queries = [row for row in queries if row.id == id]
        return c.Found(resources, queries, notes)

    def _as_its_holder_names_it(self, name: str, part: str) -> list[ResourceRow]:
        """Return the resource of this name at its holders: they have 60 in a request that its server reads as 60.0."""
        queries = self.page(Wanted("queries", part, limit=c.PAGE_LIMIT))[0].queries
        named = [row for row in queries if name in _names(row)]
        found = ask_each(
            named[:_ALIKE], lambda row: self.page(Wanted("id", row.id), row.server.partition("/")[0])[0].resources
        )
        return list({row.id: row for rows in found for row in rows}.values())


def _names(row: ResourceRow | QueryRow) -> set[str]:
    """Return all names of a resource: shortened for people, whole, and with its request in the place of its title."""
    return {row.name, f"{row.server} {row.text}", f"{row.server} {row.request}"}


def _parts(pages: Mapping[str, RowPage], wanted: Wanted) -> dict[str, Wanted]:
    """Return which rows of a page each registrar has, given how many rows it has in all, and of which keys."""
    runs = [(key, name, count) for name, found in pages.items() for key, count in found.counts or [(0.0, found.total)]]
    runs.sort(key=lambda run: run[0], reverse=True)  # those of one key stay in the order of the registrars
    parts, before = dict[str, Wanted](), 0
    passed = Counter[str]()
    for _, name, count in runs:
        begin, end = max(wanted.offset, before), min(wanted.offset + wanted.limit, before + count)
        if begin < end:
            first = parts.get(name) or msgspec.structs.replace(wanted, offset=passed[name] + begin - before, limit=0)
            parts[name] = msgspec.structs.replace(first, limit=first.limit + end - begin)
        passed[name] += count
        before += count
    return parts


def _joined(pages: Sequence[RowPage]) -> RowPage:
    """Return the rows of several registrars as one page, in the order of their keys."""

    def rows(of: Callable[[RowPage], Sequence[_A]]) -> list[_A]:
        found = [one for page in pages for one in zip(page.keys or itertools.repeat(0.0), of(page), strict=False)]
        return [row for _, row in sorted(found, key=lambda one: one[0], reverse=True)]

    return RowPage(
        sum(found.total for found in pages),
        rows(lambda found: found.resources),
        [row for found in pages for row in found.queries],
        [row for found in pages for row in found.servers],
        [row for found in pages for row in found.loads],
        rows(lambda found: found.streams),
        next((found.response for found in pages if found.response), ""),
        {id: text for found in pages for id, text in found.said.items()},
    )


def _last_seen(events: list[Event], root: str, why: str) -> Iterator[c.ChildRow]:
    """Yield the rows of a tree that has ended, as its events tell."""
    yield c.ChildRow(root, 0, "supervisor", "stopped", error=why)
    newest = {event.path: event.facts for event in events if event.path != root}
    restarts = Counter(event.path for event in events if event.event == "restarted")
    for path in sorted(newest, key=lambda path: path.split("/")):
        if newest[path].get("state") is not None:
            kind = "supervisor" if newest[path].get("kind") == "supervisor" else "worker"
            yield c.ChildRow(path, path.count("/"), kind, "stopped", restarts=restarts[path])


def _no_log(path: str, rows: Mapping[str, c.ChildRow]) -> str:
    """Say in which process a child runs that has none of its own; "" for another."""
    hosts = [above for above in rows if f"{path}/".startswith(f"{above}/") and rows[above].pid == rows[path].pid]
    if rows[path].pid is None or hosts == [path]:
        return ""
    if "/" in hosts[0]:
        return f"it runs in the process of {hosts[0]}, whose log has its records"
    return "it runs in the application's process, whose own logging has its records"


def _rows(node: Mapping[str, Any], depth: int = 0) -> Iterator[c.ChildRow]:
    """Yield the rows of a child and of all below it, each supervisor before its children."""
    paused = "" if node["pid"] is None else stopped(node["pid"])
    error, most = paused or node.get("error", ""), node.get("max_restarts", 0)
    state = "unavailable" if error and node["state"] == "running" else node["state"]
    row = c.ChildRow(node["path"], depth, node["type"], state, node["pid"], node.get("restarts", 0), node["up_s"])
    if error:
        row = msgspec.structs.replace(row, error=readable(error))
    elif "strategy" in node:
        strategy = f"{node['strategy']}, {most} in {node['max_seconds']:g} s"
        counts = {"recent_restarts": node["recent_restarts"], "excused_restarts": node["excused_restarts"]}
        row = msgspec.structs.replace(row, strategy=strategy, max_restarts=most, **counts)
    yield row
    for child in node.get("children", ()):
        yield from _rows(child, depth + 1)


def room_for(
    rows: Sequence[ResourceRow | c.UsageRow | StreamRow | Event | c.TableRow], notes: Sequence[str] = ()
) -> int:
    """Return how many of these rows, from the first on, have room in an answer with the notes: texts may be long."""
    limit = c.RESPONSE_LIMIT_BYTES - len(msgspec.msgpack.encode(notes))
    sizes = itertools.accumulate(len(msgspec.msgpack.encode(row)) for row in rows)
    return sum(size <= limit for size in sizes)


class Verb(c.Message, Generic[_A], frozen=True):
    """What a console can ask or do; Verb[Children] is answered with Children."""

    def carry_out(self, view: View, caller: Caller) -> _A:
        """Answer the question, or do what is asked for, and return what was done. In a worker.

        Raises:
            RrError: it cannot be done; nothing was changed, or the error says what was.
        """
        return self._carry_out(view, caller)

    @abc.abstractmethod
    def _carry_out(self, view: View, caller: Caller) -> _A: ...


class Look(Verb[_A], frozen=True):
    """A question about the rows of a tree or of registrars. A system that is stopping refuses it: they fall apart."""


class Command(Verb[_A], frozen=True):
    """A verb that changes something. A system that is stopping refuses it."""
