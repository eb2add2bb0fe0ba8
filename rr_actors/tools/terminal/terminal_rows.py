"""The lists of the terminal's panes, as rows of text. A pane asks only for the rows that are visible."""

from __future__ import annotations

import textwrap
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

from rr_actors.base.errors import RrError, UnknownQuery
from rr_actors.registrar.pages import Holder, QueryRow, ResourceRow
from rr_actors.system.console import console_messages as c
from rr_actors.tools.explanations import ago, record_line, since
from rr_actors.tools.process_usage import usage_of

_LOOK_S = 10.0  # for the answer to a question
_HISTORY = 100  # records
_A = TypeVar("_A")


class Asks(Protocol):
    """An object that answers questions to the system: a ConsoleLink."""

    def ask(self, request: c.Request, expected: type[_A], timeout_s: float | None = None) -> _A:
        """Send a request, and return its answer."""
        ...


@dataclass(frozen=True)
class Row:
    """A line of a pane.

    Attributes:
        key: the id of the thing that it shows; the cursor stays on the row of the same key.
        text, note: at the left and the right of the line.
        style: Rich's words for its colour.
        child, registrar, resource: the thing that Enter opens; None or "" for none.
        query: the query that `unload` releases on this row.
    """

    key: str
    text: str
    note: str = ""
    style: str = ""
    child: c.ChildRow | None = None
    registrar: str = ""
    resource: str = ""
    query: str = ""


@dataclass(frozen=True)
class Window:
    """The rows that a pane asks for: `limit` rows from number `offset` on, among the rows that contain `match`."""

    match: str = ""
    offset: int = 0
    limit: int = c.PAGE_LIMIT
    width: int = 80


@dataclass(frozen=True)
class Listed:
    """The rows of a window, the number of all rows, and the registrars that could not be asked."""

    total: int
    rows: list[Row]
    notes: list[str] = field(default_factory=list[str])


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
class Tree:
    """The supervisor tree, and after it the registrars."""

    @property
    def title(self) -> str:
        """The word "tree"."""
        return "tree"

    def list(self, link: Asks, window: Window) -> Listed:
        """Ask the system for the children and registrars of a window."""

        def children(offset: int, limit: int) -> Listed:
            page = link.ask(c.ListChildren(window.match, offset, limit), c.Children, _LOOK_S)
            return Listed(page.total, [_child(row, bool(window.match)) for row in page.rows])

        def registrars(offset: int, limit: int) -> Listed:
            page = link.ask(c.ListRegistrars(window.match, offset, limit), c.Registrars, _LOOK_S)
            return Listed(page.total, [_registrar(row) for row in page.rows])

        return _joined(window, children, registrars)


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
            page = link.ask(c.ListResources(window.match, offset, limit, self.name), c.Resources, _LOOK_S)
            return Listed(page.total, [_resource(row) for row in page.rows], page.notes)

        def queries(offset: int, limit: int) -> Listed:
            page = link.ask(c.ListQueries(window.match, offset, limit, self.name), c.Queries, _LOOK_S)
            return Listed(page.total, [_query(row) for row in page.rows], page.notes)

        return _joined(window, resources, queries)


@dataclass(frozen=True)
class Past:
    """A child's state, and the history of it and of all children below it, newest first."""

    path: str

    @property
    def title(self) -> str:
        """The child's path."""
        return f"{self.path}: history"

    def list(self, link: Asks, window: Window) -> Listed:
        """Ask the system for the child's state and history."""
        records = link.ask(c.ListHistory(self.path, _HISTORY), c.Happenings, _LOOK_S).records
        rows = [row for place in _places(link, self.path) for row in _wrapped(_as_it_is(place), window.width, "bold")]
        for record in reversed(records):
            style = "red" if record.reason in ("abnormal", "killed") or record.event == "start_failed" else ""
            rows += _wrapped(record_line(record, self.path), window.width, style)
            rows += [Row("", f"    {line}", style="dim") for line in record.traceback.rstrip().splitlines()]
        return _cut(rows, window)


@dataclass(frozen=True)
class Neighbours:
    """A resource: its state, its holders, and the parts on which it depends."""

    id: str

    @property
    def title(self) -> str:
        """The beginning of the resource's id."""
        return f"resource {self.id[:12]}: holders and parts"

    def list(self, link: Asks, window: Window) -> Listed:
        """Ask the system for the resource and its parts.

        Raises:
            UnknownQuery: the resource is unloaded.
        """
        found = [row for row in link.ask(c.Find(self.id), c.Found, _LOOK_S).resources if row.id == self.id]
        if not found:
            raise UnknownQuery(f"resource {self.id}: it is unloaded", query_id=self.id)
        resource = found[0]
        rows = [*_wrapped(f"{resource.server} {resource.request}", window.width, "bold"), *_how(resource, window.width)]
        rows.append(Row("", f"held by {resource.holder_count}:" if resource.holder_count else "nobody holds it"))
        rows += [_holder(holder) for holder in resource.holders]
        if resource.holder_count > len(resource.holders):
            rows.append(Row("", f"  and by {resource.holder_count - len(resource.holders)} more"))
        if resource.part_count:
            rows.append(Row("", f"depends on {resource.part_count}:"))
        for part in resource.parts:
            queries = [row for row in link.ask(c.Find(part), c.Found, _LOOK_S).queries if row.id == part]
            rows += [
                Row(row.id, f"  {row.server} {row.request}", row.hold, resource=row.resource_id) for row in queries
            ]
        if resource.part_count > len(resource.parts):
            rows.append(Row("", f"  and on {resource.part_count - len(resource.parts)} more"))
        return _cut(rows, window)


def refused(error: RrError, window: Window) -> Listed:
    """Return an error of the system as rows."""
    rows = _wrapped(str(error), window.width, "red")
    return Listed(len(rows), rows[window.offset : window.offset + window.limit])


def _joined(window: Window, *lists: Callable[[int, int], Listed]) -> Listed:
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


def _places(link: Asks, path: str) -> list[c.ChildRow]:
    """Return the child of this path, or none if it was forgotten. The system also lists paths that contain it."""
    seen = 0
    while True:
        page = link.ask(c.ListChildren(path, seen), c.Children, _LOOK_S)
        seen += len(page.rows)
        found = [row for row in page.rows if row.path == path]
        if found or not page.rows or seen >= page.total:
            return found


def _as_it_is(row: c.ChildRow) -> str:
    usage = None if row.pid is None else usage_of(row.pid)
    parts = (
        row.state,
        "" if row.pid is None else f"pid {row.pid}",
        "" if row.up_s is None else f"up {ago(row.up_s)}",
        f"{row.restarts} restart{'' if row.restarts == 1 else 's'}",
        "" if usage is None else f"{usage.cpu_percent:.1f} % CPU, {usage.memory_bytes / 2**20:.0f} MiB",
        row.strategy,
        row.error,
    )
    return ", ".join(filter(None, parts))


def _age(id: str) -> str:
    at = since(id)
    return "" if at is None else ago(max(0.0, time.time() - at))


_CHILD_STYLES = {"running": "", "stopped": "dim", "starting": "yellow", "restarting": "yellow", "unavailable": "red"}
_STATE_STYLES = {"WARNING": "yellow", "ERROR": "red", "FATAL": "red"}


def _child(row: c.ChildRow, as_path: bool) -> Row:
    name = row.path if as_path else "  " * row.depth + row.path.rpartition("/")[2]
    restarts = f"{row.restarts}x" if row.restarts else ""
    note = " ".join(filter(None, (row.state if row.state != "running" else "", restarts)))
    return Row(f"child {row.path}", name, note, _CHILD_STYLES.get(row.state, ""), child=row)


def _registrar(row: c.RegistrarRow) -> Row:
    note = row.status if row.status != "up" else f"{len(row.servers)} server{'' if len(row.servers) == 1 else 's'}"
    style = "cyan" if row.status == "up" else "dim"
    return Row(f"registrar {row.name}", f"@{row.name}", row.error or note, style, registrar=row.name)


def _resource(row: ResourceRow) -> Row:
    state = row.condition
    held = row.holders[0].origin if row.holder_count == 1 else f"{row.holder_count} holders"
    only = row.holders[0].query_id if row.holder_count == 1 else ""
    text = f"{row.server.partition('/')[2]} {row.request}"
    note = f"{'' if state == 'OK' else state + ' '}{held}"
    return Row(row.id, text, note, _STATE_STYLES.get(state, ""), resource=row.id, query=only)


def _query(row: QueryRow) -> Row:
    note = "" if row.hold == "held" else row.hold
    return Row(row.id, f"-> {row.server} {row.request}", note, resource=row.resource_id, query=row.id)


def _holder(holder: Holder) -> Row:
    text = f"  {holder.origin}, for {f'resource {holder.parent[:12]}' if holder.parent else 'itself'}"
    return Row(holder.query_id, text, _age(holder.query_id), resource=holder.parent, query=holder.query_id)


def _how(resource: ResourceRow, width: int) -> list[Row]:
    state = resource.condition
    said = f"{state}: {resource.message}" if resource.message else state
    age = _age(resource.id)
    return _wrapped(f"{said}{f', for {age}' if age else ''}", width, _STATE_STYLES.get(state, ""))
