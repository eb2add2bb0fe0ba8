"""The lists of the terminal's panes, as rows of text. A pane asks only for the rows that are visible."""

from __future__ import annotations

import textwrap
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol, TypeAlias, TypeVar

from rr_actors.base.errors import NotFound, RrError, UnknownQuery, counted
from rr_actors.base.names import named, short_id, time_in
from rr_actors.hosting.forwarded_logs import LogLine
from rr_actors.managers.actions.graph_pictures import ShownGraph, shown_graph
from rr_actors.registrar.pages import HolderRow, QueryRow, ResourceRow
from rr_actors.streams.stream import StreamRow
from rr_actors.system.console import console_messages as c
from rr_actors.system.console import console_questions as questions
from rr_actors.system.console.console_connection import read_pages
from rr_actors.system.console.console_view import Verb
from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.event_texts import ago
from rr_actors.tools.explanations import bytes_text, name_of_resource, rate_text
from rr_actors.tools.process_usage import usage_of
from rr_actors.tools.tables.table import STATE_STYLES, Asks, Row
from rr_actors.tools.terminal.child_logs import line_texts
from rr_actors.tools.terminal.event_lines import EventFilter, EventLine, EventLines

LOOK_S = 10.0  # for the answer to a question
_HISTORY = 100  # records
_LOGGED = 50  # lines of a child's log
_LEVEL_STYLES = {"WARNING": "yellow", "ERROR": "red", "CRITICAL": "red"}
_A = TypeVar("_A")


@dataclass(frozen=True)
class Hasty:
    """A link to the system on which each question has a time limit."""

    link: Asks
    limit_s: float

    def ask(self, request: Verb[_A], timeout_s: float | None = None) -> _A:
        """Send a question or a command, and return its answer."""
        return self.link.ask(request, timeout_s or self.limit_s)


Lines: TypeAlias = list[Row]
"""Rows, as a class with a method `list` calls the type."""


@dataclass(frozen=True)
class Window:
    """The rows that a pane asks for: `limit` rows from number `offset` on, among the rows that contain `match`."""

    match: str = ""
    offset: int = 0
    limit: int = c.PAGE_LIMIT
    width: int = 80


@dataclass(frozen=True)
class Listed:
    """The rows of a window, the number of all rows, the registrars that could not be asked, and the columns' heads."""

    total: int
    rows: list[Row]
    notes: list[str] = field(default_factory=list[str])
    heads: str = ""


class Rows(Protocol):
    """A list that a pane can show."""

    @property
    def title(self) -> str:
        """The list's title, in a few words."""
        ...

    def list(self, link: Asks, window: Window) -> Listed:
        """Ask the system for the rows of a window. Not on a loop: it waits for the answers.

        Raises:
            RrError: the system did not answer, or no longer has the thing that is listed.
        """
        ...


@dataclass(frozen=True)
class Nothing:
    """A list without rows, while nothing is chosen."""

    @property
    def title(self) -> str:
        """No title."""
        return ""

    def list(self, link: Asks, window: Window) -> Listed:
        """Return no rows, without asking."""
        return Listed(0, [])


@dataclass(frozen=True)
class Served:
    """The resources that a registrar serves, and after them the queries that it holds at others."""

    name: str

    @property
    def title(self) -> str:
        """The registrar's name."""
        return f"{self.name}: serves and holds"

    def list(self, link: Asks, window: Window) -> Listed:
        """Ask the system for the resources and queries of a window."""

        def resources(offset: int, limit: int) -> Listed:
            page = link.ask(questions.ListResources(window.match, offset, limit, self.name), LOOK_S)
            return Listed(page.total, [_resource(row) for row in page.rows], page.notes)

        def queries(offset: int, limit: int) -> Listed:
            page = link.ask(questions.ListQueries(window.match, offset, limit, self.name), LOOK_S)
            return Listed(page.total, [_query(row) for row in page.rows], page.notes)

        return joined(window, resources, queries)


@dataclass(frozen=True)
class Past:
    """A child's state, the history of it and of all children below it, and its log lines, newest first."""

    path: str

    @property
    def title(self) -> str:
        """The child's path."""
        return f"{self.path}: now, history and log"

    def list(self, link: Asks, window: Window) -> Listed:
        """Ask the system for the child's state, history and log."""
        found = link.ask(questions.ListHistory(self.path, _HISTORY), LOOK_S)
        log, more = _log(link, self.path)
        rows = [row for place in _places(link, self.path) for row in _wrapped(_as_it_is(place), window.width, "bold")]
        happened = [(event.at, self._happened(event, window.width)) for event in found.events]
        happened += [(line.at, _logged(line, window.width)) for line in log]
        for _, shown in sorted(happened, key=lambda one: one[0])[::-1]:
            rows += shown
        if found.left_out or len(found.events) == _HISTORY:
            rows.append(
                Row(
                    "",
                    f"the newest {counted(len(found.events), 'event')}: rr-actors history {self.path} has older ones",
                )
            )
        if more:
            rows.append(Row("", f"the newest {len(log)} of {len(log) + more} log lines: rr-actors logs {self.path}"))
        return _cut(rows, window)

    def _happened(self, event: Event, width: int) -> Lines:
        line, traceback = EventLine.of(event, self.path), str(event.facts.get("traceback", ""))
        return [*_wrapped(str(line), width, style_of(line)), *_indented(traceback.rstrip().splitlines())]


@dataclass(frozen=True)
class Neighbours:
    """A resource: its state, its holders, its streams, its actions if it is a graph, and the parts it depends on.

    Args:
        id: the resource's, or that of a query on it: who waits for a load does not know the resource yet.
    """

    id: str
    name: str = field(default="", compare=False)

    @property
    def title(self) -> str:
        """The resource's name."""
        return f"{self.name or short_id(self.id)}: holders and parts"

    def list(self, link: Asks, window: Window) -> Listed:
        """Ask the system for the resource, its streams and its parts.

        Raises:
            UnknownQuery: the resource is unloaded.
        """
        found = link.ask(questions.Find(self.id), LOOK_S).resources
        if not found:
            raise UnknownQuery(f"{self.name or f'resource {short_id(self.id)}'}: it is unloaded", query_id=self.id)
        resource = found[0]
        rows = [*_wrapped(resource.name, window.width, "bold"), *_how(resource, window.width)]
        rows.append(Row("", f"id {short_id(resource.id)}", style="dim"))
        rows.append(Row("", f"held by {resource.holder_count}:" if resource.holder_count else "nobody holds it"))
        rows += [_holder(link, holder) for holder in resource.holders]
        if resource.holder_count > len(resource.holders):
            rows.append(Row("", f"  and by {resource.holder_count - len(resource.holders)} more"))
        rows += _actions(graph_of(link, resource))
        streams = link.ask(questions.ListStreams(resource.id, registrar=resource.server.partition("/")[0]), LOOK_S).rows
        rows += [_stream(row) for row in streams]
        if resource.part_count:
            rows.append(Row("", f"depends on {resource.part_count}:"))
        for part in resource.parts:
            queries = [row for row in link.ask(questions.Find(part), LOOK_S).queries if row.id == part]
            rows += map(_part, queries)
        if resource.part_count > len(resource.parts):
            rows.append(Row("", f"  and on {resource.part_count - len(resource.parts)} more"))
        return _cut(rows, window)


def _part(row: QueryRow) -> Row:
    """Return the row of a part; with its state, unless it is well: a bad state comes from below."""
    note = row.hold if row.state == "OK" else f"{row.hold}, {row.state}"
    return Row(row.id, f"  {row.name}", note, STATE_STYLES.get(row.state, ""), resource=row.resource_id, name=row.name)


def graph_of(link: Asks, row: ResourceRow) -> ShownGraph | None:
    """Return the run of the graph of actions that a resource is; None if it is none."""
    registrar, _, server = row.server.partition("/")
    return shown_graph(link.ask(questions.ReadResponse(row.id, registrar), LOOK_S).text) if server == "graph" else None


def _actions(graph: ShownGraph | None) -> Lines:
    if graph is None:
        return []
    facts = {name: ", ".join(filter(None, (state, graph.notes.get(name)))) for name, state in graph.states.items()}
    styles = {"ERROR": "red", "RUNNING": "bold", "UNINITIALIZED": "dim"}
    rows = [Row("", f"  {name}", fact, style=styles.get(graph.states[name], "")) for name, fact in facts.items()]
    return [Row("", f"graph {graph.state}:"), *rows]


def _stream(row: StreamRow) -> Row:
    by = f"{row.info.consumers} read it" if row.readers else "nobody reads it"
    figures = ", ".join(filter(None, (rate_text(row), bytes_text(row))))
    return Row("", f"stream {row.info.name}: {by}", figures)


@dataclass(frozen=True)
class Happenings:
    """The newest events, newest first. The filter is what EventFilter.parse() reads."""

    known: EventLines = field(compare=False)

    @property
    def title(self) -> str:
        """The word "events"."""
        return "events"

    def list(self, link: Asks, window: Window) -> Listed:
        """Return the lines of a window, without asking."""
        lines = self.known.lines(EventFilter.parse(window.match))[::-1]
        shown = lines[window.offset : window.offset + window.limit]
        return Listed(len(lines), [Row("", str(line), style=style_of(line)) for line in shown])


def style_of(line: EventLine) -> str:
    """Return Rich's words for the colour of a line: that of its status, or red for a bad end."""
    if line.kind in _BAD or line.how.startswith(("killed", "abnormal")):
        return "red"
    return STATE_STYLES.get(line.how.partition(" ")[0], "")


def refused(error: RrError, window: Window) -> Listed:
    """Return an error of the system as rows."""
    rows = _wrapped(str(error), window.width, "red")
    return Listed(len(rows), rows[window.offset : window.offset + window.limit])


def joined(window: Window, *lists: Callable[[int, int], Listed]) -> Listed:
    """Return a window on several lists in a row. Each is asked only for its part, and for its number of rows."""
    total, rows, notes = 0, list[Row](), list[str]()
    for ask in lists:
        wanted = window.limit - len(rows)
        part = ask(max(0, window.offset - total), max(1, wanted))
        rows += part.rows[: max(0, wanted)]
        notes += part.notes
        total += part.total
    return Listed(total, rows, notes)


def _cut(rows: list[Row], window: Window) -> Listed:
    if window.match:
        rows = [row for row in rows if window.match in row.text or window.match in row.note]
    return Listed(len(rows), rows[window.offset : window.offset + window.limit])


def _wrapped(text: str, width: int, style: str = "") -> list[Row]:
    lines = textwrap.wrap(text, max(20, width), subsequent_indent="    ")
    return [Row("", line, style=style) for line in lines]


def _indented(lines: Iterable[str]) -> list[Row]:
    return [Row("", f"    {line}", style="dim") for line in lines]


def _logged(line: LogLine, width: int) -> list[Row]:
    first, *more = line_texts(line)
    return [*_wrapped(first, width, _LEVEL_STYLES.get(line.level, "")), *_indented(more)]


def _log(link: Asks, path: str) -> tuple[list[LogLine], int]:
    """Return the newest log lines of a child, and how many older ones there are; none if it has left with its lines."""
    try:
        found = link.ask(questions.ListLog(path, limit=_LOGGED), LOOK_S)
    except NotFound:
        return [], 0
    return found.lines, found.total - len(found.lines)


def _places(link: Asks, path: str) -> list[c.ChildRow]:
    """Return the child of this path, or none if it was forgotten. The system also lists paths that contain it."""
    pages = read_pages(partial(link.ask, timeout_s=LOOK_S), questions.ListChildren(path))
    return next(([row] for page in pages for row in page.rows if row.path == path), list[c.ChildRow]())


def _as_it_is(row: c.ChildRow) -> str:
    usage = None if row.pid is None else usage_of(row.pid)
    parts = (
        row.state,
        "" if row.pid is None else f"pid {row.pid}",
        "" if row.up_s is None else f"up {ago(row.up_s)}",
        counted(row.restarts, "restart"),
        "" if usage is None else f"{usage.cpu_percent:.1f} % CPU, {usage.memory_bytes / 2**20:.0f} MiB",
        row.strategy,
        row.error,
        row.note,
    )
    return ", ".join(filter(None, parts))


def _age(id: str) -> str:
    at = time_in(id)
    return "" if at is None else ago(max(0.0, time.time() - at))


_BAD = frozenset(("load_failed", "unload_failed", "pause_failed", "start_failed", "gave_up", "dead_letter"))


def _resource(row: ResourceRow) -> Row:
    state = row.condition
    held = row.holders[0].origin if row.holder_count == 1 else counted(row.holder_count, "holder")
    only = row.holders[0].query_id if row.holder_count == 1 else ""
    text = named(row.server.partition("/")[2], row.text)
    note = f"{'' if state == 'OK' else state + ' '}{held}{_priority(row.priority) if row.holder_count else ''}"
    return Row(row.id, text, note, STATE_STYLES.get(state, ""), resource=row.id, query=only, name=row.name)


def _query(row: QueryRow) -> Row:
    note = "" if row.hold == "held" else row.hold
    return Row(row.id, f"-> {row.name}", note, resource=row.resource_id, query=row.id, name=row.name)


def _holder(link: Asks, holder: HolderRow) -> Row:
    name = name_of_resource(partial(link.ask, timeout_s=LOOK_S), holder.parent, holder.origin) if holder.parent else ""
    text = f"  {holder.origin}, for {name or 'itself'}"
    text += _priority(holder.priority)
    if holder.unheard:
        text = f"{text}, {holder.unheard} unheard"
    return Row(holder.query_id, text, _age(holder.query_id), resource=holder.parent, query=holder.query_id, name=name)


def _priority(priority: int | None) -> str:
    return ", standby" if priority is None else f", priority {priority}" if priority else ""


def _how(resource: ResourceRow, width: int) -> list[Row]:
    state = resource.condition
    said = f"{state}: {resource.message}" if resource.message else state
    age = _age(resource.id)
    return _wrapped(f"{said}{f', for {age}' if age else ''}", width, STATE_STYLES.get(state, ""))
