"""The lists on the left of the terminal, with columns that sort them: the tree, all resources, streams and loads.

A list asks only for the rows that are visible, unless a column sorts it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Generic, Protocol, TypeVar

import msgspec

from rr_actors.base.names import named, short_id
from rr_actors.registrar.pages import CONDITIONS, LoadRow, QueryRow, ResourceRow
from rr_actors.streams.stream import StreamRow
from rr_actors.system.console import console_messages as c
from rr_actors.system.console import console_questions as questions
from rr_actors.system.console.console_client import read_pages
from rr_actors.tools.explanations import age_text, bytes_text, loads_cells, rate_text, readers_text, waiting_cells
from rr_actors.tools.process_usage import BUCKETS, RateWatch, Usage, UsageWatch
from rr_actors.tools.terminal.terminal_rows import LOOK_S, STATE_STYLES, Asks, Listed, Row, Window, joined

_SORTED = 5000  # rows: of more, the first ones are sorted
_NAME = 26  # cells that stay for a name
_CHILD_STYLES = {"running": "", "stopped": "dim", "starting": "yellow", "restarting": "yellow", "unavailable": "red"}
_Row = TypeVar("_Row")
_Shown = TypeVar("_Shown", covariant=True)
_Answer = TypeVar("_Answer", c.Resources, c.Streams)


@dataclass(frozen=True)
class _Column(Generic[_Row]):
    """A column: its head, its width in cells, the text of its cell, and the key that sorts by it, the most first.

    Without a key it sorts nothing.
    """

    head: str
    width: int
    cell: Callable[[_Row], str]
    key: Callable[[_Row], Any] | None = None


def _that_fit(columns: Sequence[_Column[_Row]], width: int) -> list[_Column[_Row]]:
    """Return the first columns, as many as a pane of this width has room for beside a name."""
    ends = itertools.accumulate(column.width for column in columns)
    return [column for column, end in zip(columns, ends, strict=True) if end <= width - _NAME]


def _heads(columns: Iterable[_Column[_Row]], sort_by: str) -> str:
    marked = ((f"▼{column.head}" if column.head == sort_by else column.head, column.width) for column in columns)
    return "".join(f"{head:>{width}}" for head, width in marked)


def _cells(columns: Iterable[_Column[_Row]], row: _Row) -> str:
    return "".join(f"{_end(column.cell(row), column.width - 1):>{column.width}}" for column in columns)


def _end(text: str, width: int) -> str:
    return text if len(text) <= width else f"{text[: width - 1]}…"


def _sorts(columns: Iterable[_Column[_Row]]) -> list[str]:
    return ["", *(column.head for column in columns if column.key is not None)]


def _next(columns: Iterable[_Column[_Row]], sort_by: str) -> str:
    sorts = _sorts(columns)
    return sorts[(sorts.index(sort_by) + 1) % len(sorts)]


def _ordered(rows: list[_Row], columns: Iterable[_Column[_Row]], sort_by: str) -> list[_Row]:
    """Return the rows by a column, the most first, and among equals as they came."""
    key = next(column.key for column in columns if column.head == sort_by)
    assert key is not None
    return sorted(rows, key=key, reverse=True)


# -- the tree --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Figures:
    """What is known of a child: its row, the usage of its process, its registrar's counts and loads a second."""

    row: c.ChildRow
    usage: Usage | None
    curve: str
    counts: Mapping[str, int]
    loads: float | None = None


_OF_CHILDREN: tuple[_Column[_Figures], ...] = (
    _Column("cpu", 8, lambda of: f"{of.usage.cpu_percent:.1f} %" if of.usage else "",
            lambda of: of.usage.cpu_percent if of.usage else -1.0),
    _Column("memory", 9, lambda of: f"{of.usage.memory_bytes / 2**20:.0f} MiB" if of.usage else "",
            lambda of: of.usage.memory_bytes if of.usage else -1),
    _Column("restarts", 9, lambda of: str(of.row.restarts or ""), lambda of: of.row.restarts),
    _Column("mailbox", 8, lambda of: _count(of.counts, "mailbox"), lambda of: of.counts.get("mailbox", -1)),
    _Column("resources", 10, lambda of: _count(of.counts, "resources"), lambda of: of.counts.get("resources", -1)),
    _Column("loads/s", 8, lambda of: "" if of.loads is None else f"{of.loads:.1f}",
            lambda of: -1.0 if of.loads is None else of.loads),
    _Column("cpu, last 5 min", BUCKETS + 1, lambda of: of.curve),
)  # fmt: skip


def _count(counts: Mapping[str, int], name: str) -> str:
    return str(counts[name]) if name in counts else ""


@dataclass(frozen=True)
class TreeTable:
    """The supervisor tree, and after it the registrars.

    Args:
        sort_by: the head of the column that sorts the children; "": they are a tree.
    """

    sort_by: str = ""
    usages: UsageWatch = field(default_factory=UsageWatch, compare=False)
    rates: RateWatch = field(default_factory=RateWatch, compare=False)

    @property
    def title(self) -> str:
        """The word "tree", and the column that sorts it."""
        return f"children by {self.sort_by}" if self.sort_by else "tree"

    def by_next(self) -> TreeTable:
        """Return the same list, sorted by the next column."""
        return replace(self, sort_by=_next(_OF_CHILDREN, self.sort_by))

    def list(self, link: Asks, window: Window) -> Listed:
        """Ask the system for the children and registrars of a window."""
        columns = _that_fit(_OF_CHILDREN, window.width)
        ask = partial(link.ask, timeout_s=LOOK_S)
        counts: dict[str, dict[str, int]] = {}
        rates: dict[str, float | None] = {}
        if columns or self.sort_by:
            pages = read_pages(ask, questions.ListRegistrars())
            counts = {row.name: row.counts for page in pages for row in page.rows}
            rates = {name: self.rates.look(name, one["loads"]) for name, one in counts.items() if "loads" in one}

        def children(offset: int, limit: int) -> Listed:
            if self.sort_by:
                found = read_pages(ask, questions.ListChildren(window.match), _SORTED)
                everyone = self._figures([row for page in found for row in page.rows], counts, rates)
                total, wanted = len(everyone), _ordered(everyone, _OF_CHILDREN, self.sort_by)[offset : offset + limit]
            else:
                page = link.ask(questions.ListChildren(window.match, offset, limit), LOOK_S)
                total, wanted = page.total, self._figures(page.rows, counts, rates)
            as_path = bool(window.match or self.sort_by)
            return Listed(total, [_child(of, as_path, columns) for of in wanted])

        def registrars(offset: int, limit: int) -> Listed:
            page = link.ask(questions.ListRegistrars(window.match, offset, limit), LOOK_S)
            return Listed(page.total, [_registrar(row, rates.get(row.name), columns) for row in page.rows])

        return replace(joined(window, children, registrars), heads=_heads(columns, self.sort_by))

    def _figures(
        self, rows: Sequence[c.ChildRow], counts: Mapping[str, Mapping[str, int]], rates: Mapping[str, float | None]
    ) -> list[_Figures]:
        """Return the figures of children. Of several in one process, the first one has its CPU and memory."""
        seen: set[int] = set()
        figures: list[_Figures] = []
        for row in rows:
            pid = row.pid if row.pid not in seen else None
            usage = None if pid is None else self.usages.look(pid)
            curve = self.usages.curve(pid) if pid is not None and usage is not None else ""
            seen.add(row.pid or 0)
            figures.append(_Figures(row, usage, curve, counts.get(row.id, {}), rates.get(row.id)))
        return figures


def _child(of: _Figures, as_path: bool, columns: Sequence[_Column[_Figures]]) -> Row:
    row = of.row
    name = row.path if as_path else "  " * row.depth + row.id
    restarts = f"{row.restarts}x" if row.restarts and not columns else ""
    note = " ".join(filter(None, (row.state if row.state != "running" else "", restarts)))
    style = _CHILD_STYLES.get(row.state, "") or ("yellow" if row.note else "")
    return Row(f"child {row.path}", name, note, style, child=row, columns=_cells(columns, of))


def _registrar(row: c.RegistrarRow, loads: float | None, columns: Sequence[_Column[_Figures]]) -> Row:
    note = row.status if row.status != "up" else f"{len(row.servers)} server{'' if len(row.servers) == 1 else 's'}"
    style = "cyan" if row.status == "up" else "dim"
    if unheard := row.counts.get("unheard"):
        note = f"{unheard} unheard"
    cells = _cells(columns, _Figures(c.ChildRow("", 0, "", ""), None, "", row.counts, loads))
    return Row(f"registrar {row.name}", f"@{row.name}", row.error or note, style, registrar=row.name, columns=cells)


# -- all resources, streams and loads ----------------------------------------------------------------------------------

_OF_RESOURCES: tuple[_Column[ResourceRow], ...] = (
    _Column("state", 11, lambda row: row.condition,
            lambda row: -CONDITIONS.index(row.condition)),
    _Column("holders", 9, lambda row: str(row.holder_count), lambda row: row.holder_count),
    _Column("priority", 10, lambda row: row.needed, lambda row: -1001 if row.priority is None else row.priority),
    _Column("id", 10, lambda row: short_id(row.id)),
    _Column("held by", 22, lambda row: row.held_by),
)  # fmt: skip


@dataclass(frozen=True)
class AllResources:
    """The resources of all registrars.

    Args:
        sort_by: the head of the column that sorts them, the worst state first; "": as their registrars have them.
    """

    sort_by: str = ""

    @property
    def title(self) -> str:
        """The word "resources", and the column that sorts them."""
        return f"resources by {self.sort_by}" if self.sort_by else "resources"

    def by_next(self) -> AllResources:
        """Return the same list, sorted by the next column."""
        return AllResources(_next(_OF_RESOURCES, self.sort_by))

    def list(self, link: Asks, window: Window) -> Listed:
        """Ask the system for the resources of a window; to sort them, for the first 5,000."""
        pages = _pages(link, questions.ListResources(window.match), self.sort_by, window)
        return _listed(pages, _OF_RESOURCES, self.sort_by, window, _resource)


def _resource(row: ResourceRow, columns: Sequence[_Column[ResourceRow]]) -> Row:
    note = "" if columns or row.condition == "OK" else row.condition
    only = row.holders[0].query_id if row.holder_count == 1 else ""
    style = STATE_STYLES.get(row.condition, "")
    cells = _cells(columns, row)
    return Row(row.id, row.name, note, style, resource=row.id, query=only, name=row.name, columns=cells)


_OF_STREAMS: tuple[_Column[StreamRow], ...] = (
    _Column("rate", 10, rate_text, lambda row: row.info.rate_hz),
    _Column("bytes", 13, bytes_text, lambda row: row.info.bytes_per_s),
    _Column("readers", 9, lambda row: str(row.info.consumers or ""), lambda row: row.info.consumers),
    _Column("missed", 9, lambda row: str(row.info.missed or ""), lambda row: row.info.missed),
    _Column("age", 10, age_text),
    _Column("read by", 22, readers_text),
)


@dataclass(frozen=True)
class AllStreams:
    """The open streams of all registrars.

    Args:
        sort_by: the head of the column that sorts them; "": as their registrars have them.
    """

    sort_by: str = ""

    @property
    def title(self) -> str:
        """The word "streams", and the column that sorts them."""
        return f"streams by {self.sort_by}" if self.sort_by else "streams"

    def by_next(self) -> AllStreams:
        """Return the same list, sorted by the next column."""
        return AllStreams(_next(_OF_STREAMS, self.sort_by))

    def list(self, link: Asks, window: Window) -> Listed:
        """Ask the system for the streams of a window; to sort them, for the first 5,000."""
        pages = _pages(link, questions.ListStreams(window.match), self.sort_by, window)
        return _listed(pages, _OF_STREAMS, self.sort_by, window, _stream)


def _stream(row: StreamRow, columns: Sequence[_Column[StreamRow]]) -> Row:
    info, of = row.info, named(row.info.server, row.request)
    note = "" if columns else rate_text(row)
    return Row(info.id, f"{info.name}  {of}", note, resource=info.resource_id, name=of, columns=_cells(columns, row))


_OF_LOADS: tuple[_Column[LoadRow], ...] = (
    _Column("mean", 9, lambda row: loads_cells(row)[6], lambda row: row.mean_s),
    _Column("p95", 9, lambda row: loads_cells(row)[7], lambda row: row.p95_s),
    _Column("loads", 10, lambda row: loads_cells(row)[1], lambda row: row.loads),
    _Column("shared", 10, lambda row: loads_cells(row)[2], lambda row: row.shared),
    _Column("waited", 10, lambda row: loads_cells(row)[3], lambda row: row.waited),
    _Column("failed", 8, lambda row: loads_cells(row)[4], lambda row: row.failed),
    _Column("longest", 9, lambda row: loads_cells(row)[8], lambda row: row.longest_s),
)


@dataclass(frozen=True)
class AllLoads:
    """The loads that wait now, and after them how often and how long the loads of each server waited.

    Args:
        sort_by: the head of the column that sorts the servers; "": as their registrars have them.
    """

    sort_by: str = ""

    @property
    def title(self) -> str:
        """The word "loads", and the column that sorts the servers."""
        return f"loads by {self.sort_by}" if self.sort_by else "loads: those that wait, and each server's"

    def by_next(self) -> AllLoads:
        """Return the same list, with the servers sorted by the next column."""
        return AllLoads(_next(_OF_LOADS, self.sort_by))

    def list(self, link: Asks, window: Window) -> Listed:
        """Ask the system for the loads that wait and the servers of a window."""
        ask = partial(link.ask, timeout_s=LOOK_S)
        found = link.ask(questions.ListLoads(window.match, window.offset, window.limit), LOOK_S)
        servers = _ordered(found.servers, _OF_LOADS, self.sort_by) if self.sort_by else found.servers
        columns = _that_fit(_OF_LOADS, window.width)
        first = max(0, window.offset - found.total)
        rows = [_waiting(ask, row) for row in found.rows]
        rows += [_loads(row, columns) for row in servers[first : first + window.limit - len(rows)]]
        return Listed(found.total + len(servers), rows, found.notes, _heads(columns, self.sort_by))


def _waiting(ask: Callable[[questions.Find], c.Found], row: QueryRow) -> Row:
    who, what, whose, how_long, because = waiting_cells(ask, row)
    text = f"{who} waits for {what}, for {whose}{because and f': {because}'}"
    return Row(row.id, text, how_long, "yellow", resource=row.resource_id or row.id, query=row.id, name=row.name)


def _loads(row: LoadRow, columns: Sequence[_Column[LoadRow]]) -> Row:
    note = "" if columns or not row.longest_s else f"p95 {loads_cells(row)[7]}"
    return Row(f"loads {row.server}", row.server, note, columns=_cells(columns, row))


class _Page(Protocol[_Shown]):
    @property
    def total(self) -> int: ...

    @property
    def rows(self) -> Sequence[_Shown]: ...

    @property
    def notes(self) -> Sequence[str]: ...


def _pages(link: Asks, request: questions.Listing[_Answer], sort_by: str, window: Window) -> list[_Answer]:
    """Ask for the rows of a window; if they are sorted, for the first 5,000."""
    if sort_by:
        return [*read_pages(partial(link.ask, timeout_s=LOOK_S), request, _SORTED)]
    return [link.ask(msgspec.structs.replace(request, offset=window.offset, limit=window.limit), LOOK_S)]


def _listed(
    pages: Sequence[_Page[_Row]],
    columns: Sequence[_Column[_Row]],
    sort_by: str,
    window: Window,
    draw: Callable[[_Row, Sequence[_Column[_Row]]], Row],
) -> Listed:
    """Return the rows of a window, with the columns that fit."""
    wanted, total, notes = [row for page in pages for row in page.rows], pages[0].total, [*pages[-1].notes]
    if sort_by:
        if total > len(wanted):
            notes.append(f"{total - len(wanted)} more: choose with /")
        total = len(wanted)
        wanted = _ordered(wanted, columns, sort_by)[window.offset : window.offset + window.limit]
    fitting = _that_fit(columns, window.width)
    return Listed(total, [draw(row, fitting) for row in wanted], notes, _heads(fitting, sort_by))
