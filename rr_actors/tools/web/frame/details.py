"""What a drawer says of the chosen thing: what it is, because of what, who is touched, and what happened to it."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from rr_actors.base.errors import NotFound, UnknownQuery
from rr_actors.base.names import short_id, time_in
from rr_actors.hosting.forwarded_logs import LogLine
from rr_actors.registrar.pages import LoadRow, ResourceRow
from rr_actors.system.console import console_messages as c
from rr_actors.system.console import console_questions as questions
from rr_actors.system.console.console_connection import read_pages
from rr_actors.system.recording.event_texts import ago, clock
from rr_actors.tools.explanations import seconds_text
from rr_actors.tools.process_usage import usage_of
from rr_actors.tools.tables.table import Asks, Row
from rr_actors.tools.terminal.child_logs import line_texts
from rr_actors.tools.terminal.event_lines import EventFilter, EventLine
from rr_actors.tools.terminal.terminal_rows import LOOK_S, Hasty, Neighbours, Served, Window, style_of
from rr_actors.tools.web.frame.page_addresses import Address, Kind

_ROWS = 300  # of a section
_EVENTS = 100
_LOGGED = 50  # lines of a child's log
_CHAIN = 12  # resources of a chain: each is a question to a registrar
_WIDE = 100_000  # characters: the browser breaks the lines
_LEVELS = {"WARNING": "yellow", "ERROR": "red", "CRITICAL": "red"}
_BAD = ("WARNING", "ERROR", "FATAL")

Lines = Callable[[EventFilter], Sequence[EventLine]]


@dataclass(frozen=True)
class Link:
    """A name that leads to the thing of that name."""

    text: str
    kind: Kind = ""
    name: str = ""


@dataclass(frozen=True)
class Fact:
    """What is known of a thing, in a word and a value; `is_code`: the value is a text for programs."""

    head: str
    value: Link
    is_code: bool = False


@dataclass(frozen=True)
class Place:
    """A place of a chain, from where a state began up to the application that hears of it."""

    link: Link
    state: str
    note: str


@dataclass(frozen=True)
class Told:
    """What happened at a time, or what was logged then; `more`: further lines, as of a traceback."""

    at: str
    text: str
    style: str = ""
    more: tuple[str, ...] = ()


@dataclass(frozen=True)
class Detail:
    """All that a drawer says.

    Attributes:
        state, title, note: its head; the state is "" for what has none.
        facts: what it is.
        chain: who is touched by it.
        rows: its holders and parts, or what it serves and holds, under the head `rows_head`.
        told: what happened to it, newest first.
        log: of its process, oldest first; `logger`: whose it is.
        more: where older ones are.
    """

    state: str
    title: str
    note: str = ""
    facts: tuple[Fact, ...] = ()
    chain: tuple[Place, ...] = ()
    rows_head: str = ""
    rows: tuple[Row, ...] = ()
    told: tuple[Told, ...] = ()
    logger: Link = Link("")
    log: tuple[Told, ...] = ()
    more: tuple[str, ...] = ()


def detail_of(asks: Asks, address: Address, lines: Lines) -> Detail:
    """Ask the system for all that is said of what an address has chosen. Not on a loop: it waits for the answers.

    Raises:
        RrError: the system did not answer, or no longer has the thing.
    """
    hasty = Hasty(asks, LOOK_S)
    made = {"child": _child, "resource": _resource, "server": _server, "registrar": _registrar}
    return made[address.kind](hasty, address.name, lines)


def _child(asks: Asks, path: str, lines: Lines) -> Detail:
    row = next((row for row in _children(asks, path) if row.path == path), None)
    found = asks.ask(questions.ListHistory(path, _EVENTS))
    told = tuple(_happened(EventLine.of(event, path), str(event.facts.get("traceback", ""))) for event in found.events)
    log, older = _log(asks, path)
    more: list[str] = []
    if found.left_out or len(found.events) == _EVENTS:
        more.append(f"the newest {len(found.events)} events: rr-actors history {path} has older ones")
    if older:
        more.append(f"the newest {len(log)} of {len(log) + older} log lines: rr-actors logs {path}")
    served: tuple[Row, ...] = ()
    if row is not None and row.type != "supervisor" and any(one.name == row.id for one in _registrars(asks, row.id)):
        served = tuple(Served(row.id).list(asks, Window("", 0, _ROWS, _WIDE)).rows)
    state = "gone" if row is None else row.state
    facts = () if row is None else tuple(_of_child(row))
    head = "What it serves and holds" if served else ""
    return Detail(state, path, "", facts, (), head, served, told[::-1], Link(path, "child", path), log, tuple(more))


def _of_child(row: c.ChildRow) -> Iterator[Fact]:
    usage = None if row.pid is None else usage_of(row.pid)
    above = row.path.rpartition("/")[0]
    texts = (
        ("because", row.error or row.note),
        ("process", "" if row.pid is None else f"pid {row.pid}"),
        ("up", "" if row.up_s is None else ago(row.up_s)),
        ("restarts", str(row.restarts)),
        ("window", f"{row.recent_restarts} of {row.max_restarts} restarts are used" if row.max_restarts else ""),
        ("usage", "" if usage is None else f"{usage.cpu_percent:.1f} % CPU, {usage.memory_bytes / 2**20:.0f} MiB"),
        ("strategy", row.strategy),
        ("type", row.type),
    )
    yield from (Fact(head, Link(text)) for head, text in texts if text)
    if above:
        yield Fact("supervisor", Link(above, "child", above))


def _resource(asks: Asks, id: str, lines: Lines) -> Detail:
    found = asks.ask(questions.Find(id)).resources
    if not found:
        raise UnknownQuery(f"resource {short_id(id)}: it is unloaded", query_id=id)
    row = found[0]
    registrar = row.server.partition("/")[0]
    manager = next((child for child in _children(asks, registrar) if child.id == registrar), None)
    log = _log(asks, manager.path)[0] if manager is not None else ()
    rows = Neighbours(row.id, row.name).list(asks, Window("", 0, _ROWS, _WIDE)).rows
    below = itertools.dropwhile(lambda one: not one.text.startswith(("held by", "nobody holds")), rows)
    told = tuple(_happened(line, "") for line in lines(EventFilter.of(text=row.name)))
    loaded = time_in(row.id)
    note = f"id {short_id(row.id)} · {'loaded' if row.phase == 'loaded' else row.phase}"
    facts = (
        Fact("because", Link(row.message)),
        Fact("request", Link(row.request), is_code=True),
        Fact("response", Link(row.response), is_code=True),
        Fact("server", Link(row.server, "server", row.server)),
        Fact(
            "manager", Link(manager.path, "child", manager.path) if manager else Link(registrar, "registrar", registrar)
        ),
        Fact(
            "since", Link("" if loaded is None else f"{clock(loaded)[:-4]}, for {ago(max(0.0, time.time() - loaded))}")
        ),
    )
    return Detail(
        row.condition,
        row.name,
        note,
        tuple(fact for fact in facts if fact.value.text),
        tuple(_chain(asks, row)),
        "Holders and parts",
        tuple(below),
        told[::-1],
        Link(manager.path, "child", manager.path) if manager else Link(registrar),
        log,
    )


def _server(asks: Asks, server: str, lines: Lines) -> Detail:
    registrar = server.partition("/")[0]
    page = asks.ask(questions.ListResources(f"{server}", 0, _ROWS, registrar, "state"))
    rows = [row for row in page.rows if row.server == server]
    states: dict[str, int] = {}
    for row in rows:
        states[row.condition] = states.get(row.condition, 0) + 1
    worst = rows[0].condition if rows else ""
    loads = next(
        (row for row in asks.ask(questions.ListLoads(server, 0, 1, registrar)).servers if row.server == server), None
    )
    counted = ", ".join(f"{count} {state}" for state, count in states.items())
    facts = [
        Fact("resources", Link(counted or "none")),
        Fact("registrar", Link(registrar, "registrar", registrar)),
        *(_of_loads(loads) if loads is not None else ()),
    ]
    told = tuple(_happened(line, "") for line in lines(EventFilter.of(server=server)))
    return Detail(worst, server, "server", tuple(facts), (), "Its resources", tuple(map(_as_row, rows)), told[::-1])


def _of_loads(row: LoadRow) -> Iterator[Fact]:
    yield Fact("loads", Link(f"{row.loads:,}, {row.shared:,} shared, {row.failed:,} failed"))
    yield Fact("wait now", Link(f"{row.loading:,}"))
    if row.longest_s:
        times = (("mean", row.mean_s), ("p95", row.p95_s), ("longest", row.longest_s))
        yield Fact("times", Link(", ".join(f"{head} {seconds_text(value)}" for head, value in times)))


def _registrar(asks: Asks, name: str, lines: Lines) -> Detail:
    row = next((row for row in _registrars(asks, name) if row.name == name), None)
    manager = next((child for child in _children(asks, name) if child.id == name), None)
    rows = Served(name).list(asks, Window("", 0, _ROWS, _WIDE)).rows
    facts = [Fact("servers", Link(one, "server", one)) for one in (row.servers if row else ())]
    if manager is not None:
        facts.append(Fact("manager", Link(manager.path, "child", manager.path)))
    if row is not None and row.error:
        facts.append(Fact("because", Link(row.error)))
    told = tuple(_happened(line, "") for line in lines(EventFilter.of(server=name)))
    state = "gone" if row is None else row.status
    return Detail(state, name, "registrar", tuple(facts), (), "What it serves and holds", tuple(rows), told[::-1])


def _as_row(row: ResourceRow) -> Row:
    return Row(row.id, row.name, "" if row.condition == "OK" else row.condition, resource=row.id, name=row.name)


def _chain(asks: Asks, row: ResourceRow) -> Iterator[Place]:
    """Yield the places from where the state of a resource began up to those who hold it for themselves."""
    began, asked = row, 0
    while row.condition in _BAD and began.part_resources and asked < _CHAIN:
        asked += 1
        below = [part for id in began.part_resources[:_CHAIN] for part in asks.ask(questions.Find(id)).resources]
        worse = next((part for part in below if part.condition in _BAD), None)
        if worse is None:
            break
        began = worse
    queue, seen, apps = [began], {began.id}, dict[str, Place]()
    while queue and len(seen) <= _CHAIN:
        one = queue.pop(0)
        note = "began here" if one is began and row.condition in _BAD else _held(one)
        yield Place(Link(one.name, "resource", one.id), one.condition, note)
        for holder in one.holders:
            if not holder.parent:
                unheard = f"{holder.unheard} unheard" if holder.unheard else "holds it for itself"
                apps[holder.origin] = Place(Link(holder.origin, "registrar", holder.origin), "", unheard)
            elif holder.parent not in seen:
                seen.add(holder.parent)
                queue += asks.ask(questions.Find(holder.parent)).resources[:1]
    yield from apps.values()


def _held(row: ResourceRow) -> str:
    at = time_in(row.id)
    return "" if at is None else f"held {ago(max(0.0, time.time() - at))}"


def _children(asks: Asks, match: str) -> list[c.ChildRow]:
    return [row for page in read_pages(asks.ask, questions.ListChildren(match)) for row in page.rows]


def _registrars(asks: Asks, match: str) -> list[c.RegistrarRow]:
    return [row for page in read_pages(asks.ask, questions.ListRegistrars(match)) for row in page.rows]


def _log(asks: Asks, path: str) -> tuple[tuple[Told, ...], int]:
    """Return the newest log lines of a child, and how many older ones there are; none if it has left with its lines."""
    try:
        found = asks.ask(questions.ListLog(path, limit=_LOGGED))
    except NotFound:
        return (), 0
    return tuple(map(_logged, found.lines)), found.total - len(found.lines)


def _logged(line: LogLine) -> Told:
    first, *more = line_texts(line)
    return Told("", first, _LEVELS.get(line.level, ""), tuple(more))


def _happened(line: EventLine, traceback: str) -> Told:
    text = str(line).removeprefix(clock(line.at)).strip()
    return Told(clock(line.at)[:-4], text, style_of(line), tuple(traceback.rstrip().splitlines()))
