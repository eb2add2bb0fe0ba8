"""The tables of the supervisor tree: children with the usage of their processes, and registrars."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from rr_actors.base.errors import counted
from rr_actors.registrar.pages import ServerRow
from rr_actors.system.console import console_messages as c
from rr_actors.system.console import console_questions as questions
from rr_actors.system.console.console_connection import read_pages
from rr_actors.system.recording.event_texts import ago
from rr_actors.tools.process_usage import BUCKETS, RateWatch, Usage, UsageWatch, facts_of
from rr_actors.tools.tables.table import Asks, Column, Look, Row, Rows, Table

_NO_CHILD, _NO_REGISTRAR = c.ChildRow("", 0, "", ""), c.RegistrarRow("", "")
_NONE: Mapping[str, int] = {}
_STYLES = {"running": "", "stopped": "dim", "starting": "yellow", "restarting": "yellow", "unavailable": "red"}


@dataclass(frozen=True)
class Figures:
    """What is known of a child or a registrar.

    Attributes:
        row: the child.
        name: the child's name: below its supervisor, or its path.
        usage: that of its process; None for another child of the same process than the first.
        curve: the CPU of the last five minutes.
        counts, loads: of its registrar: the counts, and the loads a second.
        registrar: the registrar; None for a child.
        parts: if they were asked for, its registrar and the servers of that.
    """

    row: c.ChildRow
    name: str
    usage: Usage | None
    curve: str
    counts: Mapping[str, int]
    loads: float | None
    registrar: c.RegistrarRow | None = None
    parts: tuple[Figures, ...] = ()

    @property
    def cpu(self) -> str:
        """The CPU as a text: "4.2 %"."""
        return f"{self.usage.cpu_percent:.1f} %" if self.usage else ""

    @property
    def memory(self) -> str:
        """The memory as a text: "35 MiB"."""
        return f"{self.usage.memory_bytes / 2**20:.0f} MiB" if self.usage else ""

    @property
    def rate(self) -> str:
        """The loads a second as a text."""
        return "" if self.loads is None else f"{self.loads:.1f}"


_KEYS: dict[str, Callable[[Figures], float]] = {
    "up": lambda of: of.row.up_s or 0.0,
    "restarts": lambda of: of.row.restarts,
    "cpu": lambda of: of.usage.cpu_percent if of.usage else -1.0,
    "memory": lambda of: of.usage.memory_bytes if of.usage else -1,
    "mailbox": lambda of: of.counts.get("mailbox", -1),
    "resources": lambda of: of.counts.get("resources", -1),
    "loads/s": lambda of: -1.0 if of.loads is None else of.loads,
}
_COLUMNS: tuple[Column[Figures], ...] = (
    Column("child", lambda of: of.name),
    Column("state", lambda of: of.row.state),
    Column("pid", lambda of: "" if of.row.pid is None else str(of.row.pid), right=True),
    Column("up", lambda of: "" if of.row.up_s is None else ago(of.row.up_s), right=True, sorts=True),
    Column("restarts", lambda of: str(of.row.restarts), right=True, views="verb", sorts=True),
    Column("restarts", lambda of: str(of.row.restarts or ""), 9, right=True, views="top", sorts=True),
    Column("cpu", lambda of: of.cpu, 8, right=True, sorts=True),
    Column("memory", lambda of: of.memory, 9, sorts=True),
    Column("mailbox", lambda of: str(of.counts.get("mailbox", "")), 8, views="top", sorts=True),
    Column("resources", lambda of: str(of.counts.get("resources", "")), views="top", sorts=True),
    Column("loads/s", lambda of: of.rate, 8, views="top", sorts=True),
    Column("cpu, last 5 min", lambda of: of.curve, BUCKETS + 1, views="top"),
    Column("", lambda of: of.row.error or of.row.note or of.row.strategy, gives_way=True),
)


class TreeTables:
    """The tables of the tree for one viewer, who looks again and again.

    A process's CPU is that since the last look; at the first look, since its start. The viewer measures it, so the
    children are sorted here.
    """

    def __init__(self) -> None:
        self._usages, self._rates = UsageWatch(), RateWatch()
        narrow = ("cpu", "memory", "restarts", "mailbox", "resources", "loads/s", "cpu, last 5 min")
        self.children = Table(
            "children", _COLUMNS, self._children, _child, narrow,
            named=lambda of: of.row.path, facts=lambda of: facts_of(of.row), below=lambda of: of.parts,
        )  # fmt: skip
        self.registrars = Table("registrars", _COLUMNS, self._registrars, _registrar, narrow)

    def _children(self, asks: Asks, look: Look) -> Rows[Figures]:
        counts = {}
        if look.live:
            counts = {
                row.name: row.counts for page in read_pages(asks.ask, questions.ListRegistrars()) for row in page.rows
            }
        if key := _KEYS.get(look.sort):
            everyone = [row for page in read_pages(asks.ask, questions.ListChildren(look.match)) for row in page.rows]
            rows = look.cut(sorted(self.figures(everyone, counts, as_path=True), key=key, reverse=True))
        else:
            page = asks.ask(questions.ListChildren(look.match, look.offset, look.limit))
            rows = Rows(page.total, self.figures(page.rows, counts, as_path=bool(look.match)))
        return Rows(rows.total, _with_parts(asks, rows.rows)) if look.parts else rows

    def figures(
        self, rows: Sequence[c.ChildRow], counts: Mapping[str, Mapping[str, int]], *, as_path: bool
    ) -> list[Figures]:
        """Return the figures of children, given the counts of registrars by name, as they are now."""
        seen: set[int] = set()
        figures: list[Figures] = []
        for row in rows:
            name = row.path if as_path else "  " * row.depth + row.id
            pid = None if row.pid in seen else row.pid
            usage = None if pid is None else self._usages.look(pid)
            curve = self._usages.curve(pid) if pid is not None and usage is not None else ""
            seen.add(row.pid or 0)
            of = counts.get(row.id, _NONE)
            figures.append(Figures(row, name, usage, curve, of, self._rate(row.id, of)))
        return figures

    def _rate(self, name: str, counts: Mapping[str, int]) -> float | None:
        return self._rates.look(name, counts["loads"]) if "loads" in counts else None

    def _registrars(self, asks: Asks, look: Look) -> Rows[Figures]:
        page = asks.ask(questions.ListRegistrars(look.match, look.offset, look.limit))
        rows = [
            Figures(_NO_CHILD, "", None, "", row.counts, self._rate(row.name, row.counts), row) for row in page.rows
        ]
        return Rows(page.total, rows)


def _with_parts(asks: Asks, children: Sequence[Figures]) -> list[Figures]:
    """Return the children, each with its parts: its registrar and the servers of that."""
    registrars = {row.name: row for page in read_pages(asks.ask, questions.ListRegistrars()) for row in page.rows}
    servers: dict[str, list[ServerRow]] = {}
    for server in asks.ask(questions.ListServers()).rows:
        servers.setdefault(server.server.partition("/")[0], []).append(server)
    shown: list[Figures] = []
    for child in children:
        registrar = registrars.get(child.row.id) if child.row.type != "supervisor" else None
        rows = [] if registrar is None else _parts(child.row, registrar, servers.get(registrar.name, ()))
        as_path = child.name == child.row.path
        names = [row.path if as_path else "  " * row.depth + row.id for row in rows]
        parts = [Figures(row, name, None, "", _NONE, None) for row, name in zip(rows, names, strict=True)]
        shown.append(replace(child, parts=tuple(parts)))
    return shown


def _parts(child: c.ChildRow, registrar: c.RegistrarRow, servers: Sequence[ServerRow]) -> list[c.ChildRow]:
    path, state = f"{child.path}/registrar", "running" if registrar.status == "up" else registrar.status
    waiting = registrar.counts.get("mailbox", 0)
    note = registrar.error or (f"{waiting} wait" if waiting else "")
    rows = [c.ChildRow(path, child.depth + 1, "registrar", state, note=note)]
    for server in servers:
        if "/" in server.server:  # else it is the registrar itself
            place = f"{path}/servers/{server.server.partition('/')[2]}"
            rows.append(c.ChildRow(place, child.depth + 2, "server", state, note=_doing(server)))
    return rows


def _doing(server: ServerRow) -> str:
    """Return what a server does now, for people."""
    count = sum(server.states.values())
    resources = counted(count, "resource") if count else ""
    runs = ", ".join(f"{count} {role}" for role, count in sorted(server.runs.items()))
    waiting = f"{server.waiting} wait" if server.waiting else ""
    return "; ".join(filter(None, (f"runs {runs}" if runs else "", waiting, resources)))


def _child(of: Figures, has_columns: bool) -> Row:
    row = of.row
    restarts = f"{row.restarts}x" if row.restarts and not has_columns else ""
    note = " ".join(filter(None, (row.state if row.state != "running" else "", restarts)))
    return Row(
        f"child {row.path}", of.name, note, _STYLES.get(row.state, "") or ("yellow" if row.note else ""), child=row
    )


def _registrar(of: Figures, has_columns: bool) -> Row:
    row = of.registrar or _NO_REGISTRAR
    note = row.status if row.status != "up" else counted(len(row.servers), "server")
    if unheard := of.counts.get("unheard"):
        note = f"{unheard} unheard"
    return Row(
        f"registrar {row.name}",
        f"@{row.name}",
        row.error or note,
        "cyan" if row.status == "up" else "dim",
        registrar=row.name,
    )


def tables() -> tuple[Table[Figures], ...]:
    """Return the tables of the tree, for one viewer."""
    tree = TreeTables()
    return tree.children, tree.registrars
