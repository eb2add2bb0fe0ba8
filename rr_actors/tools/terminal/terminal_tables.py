"""The lists on the left of the terminal, with columns that sort them: the tree with its registrars, and all resources.

A list asks only for the rows that are visible, unless a column sorts it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Generic, TypeVar

from rr_actors.base.names import short_id
from rr_actors.registrar.pages import ResourceRow
from rr_actors.system.console import console_messages as c
from rr_actors.system.console import console_questions as questions
from rr_actors.system.console.console_client import read_pages
from rr_actors.tools.process_usage import BUCKETS, Usage, UsageWatch
from rr_actors.tools.terminal.terminal_rows import LOOK_S, STATE_STYLES, WORST, Asks, Listed, Row, Window, joined

_SORTED = 5000  # rows: of more, the first ones are sorted
_NAME = 28  # cells that stay for a name
_CHILD_STYLES = {"running": "", "stopped": "dim", "starting": "yellow", "restarting": "yellow", "unavailable": "red"}
_Row = TypeVar("_Row")


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
    """What is known of a child: its row, the usage of its process, and the counts of its registrar."""

    row: c.ChildRow
    usage: Usage | None
    curve: str
    counts: Mapping[str, int]


_OF_CHILDREN: tuple[_Column[_Figures], ...] = (
    _Column("cpu", 9, lambda of: f"{of.usage.cpu_percent:.1f} %" if of.usage else "",
            lambda of: of.usage.cpu_percent if of.usage else -1.0),
    _Column("memory", 10, lambda of: f"{of.usage.memory_bytes / 2**20:.0f} MiB" if of.usage else "",
            lambda of: of.usage.memory_bytes if of.usage else -1),
    _Column("restarts", 10, lambda of: str(of.row.restarts or ""), lambda of: of.row.restarts),
    _Column("mailbox", 9, lambda of: _count(of.counts, "mailbox"), lambda of: of.counts.get("mailbox", -1)),
    _Column("resources", 11, lambda of: _count(of.counts, "resources"), lambda of: of.counts.get("resources", -1)),
    _Column("cpu, last 5 min", BUCKETS + 2, lambda of: of.curve),
)  # fmt: skip


def _count(counts: Mapping[str, int], name: str) -> str:
    return str(counts[name]) if name in counts else ""


@dataclass(frozen=True)
class Tree:
    """The supervisor tree, and after it the registrars.

    Args:
        sort_by: the head of the column that sorts the children; "": they are a tree.
    """

    sort_by: str = ""
    usages: UsageWatch = field(default_factory=UsageWatch, compare=False)

    @property
    def title(self) -> str:
        """The word "tree", and the column that sorts it."""
        return f"children by {self.sort_by}" if self.sort_by else "tree"

    def by_next(self) -> Tree:
        """Return the same list, sorted by the next column."""
        return replace(self, sort_by=_next(_OF_CHILDREN, self.sort_by))

    def list(self, link: Asks, window: Window) -> Listed:
        """Ask the system for the children and registrars of a window."""
        columns = _that_fit(_OF_CHILDREN, window.width)
        ask = partial(link.ask, timeout_s=LOOK_S)
        counts: dict[str, dict[str, int]] = {}
        if columns or self.sort_by:
            pages = read_pages(ask, questions.ListRegistrars())
            counts = {row.name: row.counts for page in pages for row in page.rows}

        def children(offset: int, limit: int) -> Listed:
            if self.sort_by:
                found = read_pages(ask, questions.ListChildren(window.match), _SORTED)
                everyone = self._figures([row for page in found for row in page.rows], counts)
                total, wanted = len(everyone), _ordered(everyone, _OF_CHILDREN, self.sort_by)[offset : offset + limit]
            else:
                page = link.ask(questions.ListChildren(window.match, offset, limit), LOOK_S)
                total, wanted = page.total, self._figures(page.rows, counts)
            as_path = bool(window.match or self.sort_by)
            return Listed(total, [_child(of, as_path, columns) for of in wanted])

        def registrars(offset: int, limit: int) -> Listed:
            page = link.ask(questions.ListRegistrars(window.match, offset, limit), LOOK_S)
            return Listed(page.total, [_registrar(row, columns) for row in page.rows])

        return replace(joined(window, children, registrars), heads=_heads(columns, self.sort_by))

    def _figures(self, rows: Sequence[c.ChildRow], counts: Mapping[str, Mapping[str, int]]) -> list[_Figures]:
        """Return the figures of children. Of several in one process, the first one has its CPU and memory."""
        seen: set[int] = set()
        figures: list[_Figures] = []
        for row in rows:
            pid = row.pid if row.pid not in seen else None
            usage = None if pid is None else self.usages.look(pid)
            curve = self.usages.curve(pid) if pid is not None and usage is not None else ""
            seen.add(row.pid or 0)
            figures.append(_Figures(row, usage, curve, counts.get(row.id, {})))
        return figures


def _child(of: _Figures, as_path: bool, columns: Sequence[_Column[_Figures]]) -> Row:
    row = of.row
    name = row.path if as_path else "  " * row.depth + row.id
    restarts = f"{row.restarts}x" if row.restarts and not columns else ""
    note = " ".join(filter(None, (row.state if row.state != "running" else "", restarts)))
    style = _CHILD_STYLES.get(row.state, "")
    return Row(f"child {row.path}", name, note, style, child=row, columns=_cells(columns, of))


def _registrar(row: c.RegistrarRow, columns: Sequence[_Column[_Figures]]) -> Row:
    note = row.status if row.status != "up" else f"{len(row.servers)} server{'' if len(row.servers) == 1 else 's'}"
    style = "cyan" if row.status == "up" else "dim"
    if unheard := row.counts.get("unheard"):
        note = f"{unheard} unheard"
    cells = _cells(columns, _Figures(c.ChildRow("", 0, "", ""), None, "", row.counts))
    return Row(f"registrar {row.name}", f"@{row.name}", row.error or note, style, registrar=row.name, columns=cells)


# -- all resources ---------------------------------------------------------------------------------------------------

_OF_RESOURCES: tuple[_Column[ResourceRow], ...] = (
    _Column("state", 11, lambda row: row.condition,
            lambda row: -WORST.index(row.condition)),
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
        columns = _that_fit(_OF_RESOURCES, window.width)
        if self.sort_by:
            found = read_pages(partial(link.ask, timeout_s=LOOK_S), questions.ListResources(window.match), _SORTED)
            pages = list(found)
            everyone = [row for page in pages for row in page.rows]
            wanted = _ordered(everyone, _OF_RESOURCES, self.sort_by)[window.offset : window.offset + window.limit]
            total, notes = len(everyone), pages[-1].notes
            if pages[0].total > total:
                notes = [*notes, f"{pages[0].total - total} more: choose with /"]
        else:
            page = link.ask(questions.ListResources(window.match, window.offset, window.limit), LOOK_S)
            total, wanted, notes = page.total, page.rows, page.notes
        rows = [_resource(row, columns) for row in wanted]
        return Listed(total, rows, notes, _heads(columns, self.sort_by))


def _resource(row: ResourceRow, columns: Sequence[_Column[ResourceRow]]) -> Row:
    note = "" if columns or row.condition == "OK" else row.condition
    only = row.holders[0].query_id if row.holder_count == 1 else ""
    style = STATE_STYLES.get(row.condition, "")
    cells = _cells(columns, row)
    return Row(row.id, row.name, note, style, resource=row.id, query=only, name=row.name, columns=cells)
