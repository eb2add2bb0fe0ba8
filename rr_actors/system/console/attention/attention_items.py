"""The rules of what needs attention: a pure function over what a console knows of a system.

`needs_attention` decides, `attention_sources.py` collects what it needs. `rr-actors attention`, `top` and the web page
show the same items.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Literal

import msgspec

from rr_actors.base.errors import counted
from rr_actors.base.names import in_short, named, short_id, time_in
from rr_actors.registrar.pages import LoadRow, QueryRow, ResourceRow
from rr_actors.streams.stream import StreamRow
from rr_actors.system.console.console_messages import ChildRow
from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.event_texts import ago

Severity = Literal["FATAL", "ERROR", "WARNING"]
SEVERITIES: tuple[Severity, ...] = ("FATAL", "ERROR", "WARNING")
"""How bad an item may be, the worst first."""
_SEVERITIES: dict[str, Severity] = {one: one for one in SEVERITIES}
DEATHS_S = 600.0
"""The seconds in which a child that dies twice needs attention."""
_WAIT_S, _TIMES_P95 = 5.0, 10.0
_POOL, _MAILBOX, _STREAM = 0.9, 0.5, 0.5
_DISK_FREE, _DISK_BYTES = 0.05, 2**30  # nearly full: less than 5 % and less than 1 GiB
_NAMED = 4  # of whom it touches
_WIDTH = 500  # characters of a sentence: 500 items fit one answer, however long the statuses are


class AttentionItem(msgspec.Struct, frozen=True, omit_defaults=True):
    """One thing that needs attention.

    Attributes:
        id: names the item as long as it lasts: "resource:01a2...", "child:root/cameras".
        severity: "FATAL", "ERROR" or "WARNING".
        kind: "resource", "deaths", "given up", "frozen", "stopped", "unavailable", "load", "pool", "kept", "choice",
            "stream", "mailbox", "disk" or "note".
        what: one sentence, of at most 500 characters: of a longer one the beginning and the end.
        name: the path of a child, or the name of a resource, a pool or a stream.
        since: seconds since the epoch; None: not known.
        touches: the paths, registrars and resources that it touches, the first ones. `touched`: how many there are.
        command: the command that leads on, without `rr-actors`.
        resource: the id of the resource that it is about; "" for none.
    """

    id: str
    severity: Severity
    kind: str
    what: str
    name: str
    since: float | None = None
    touches: tuple[str, ...] = ()
    touched: int = 0
    command: str = ""
    resource: str = ""


class PoolUse(msgspec.Struct, frozen=True):
    """A pool of a Budgets, which is the child at `path`."""

    path: str
    name: str
    capacity: float
    used: float
    waiting: int
    problem: str = ""


class KeptThing(msgspec.Struct, frozen=True):
    """What a Keeper, the child at `path`, keeps: how many replicas are wanted and ready, and why others are not."""

    path: str
    name: str
    wanted: int
    ready: int
    why: str = ""
    detail: str = ""


class Choice(msgspec.Struct, frozen=True):
    """A choice of a Choices, which is the child at `path`: the alternative in use, and those in the order of trial."""

    path: str
    id: str
    kind: str
    present: str
    allowed: tuple[str, ...] = ()
    by_hand: str = ""
    why: str = ""


class Fill(msgspec.Struct, frozen=True):
    """How full something is: `used` of `limit`; a mailbox in messages, a disk in bytes."""

    name: str
    used: float
    limit: float


class Known(msgspec.Struct, frozen=True):
    """What a console knows of a system at the moment `now`.

    Attributes:
        children: the supervisor tree.
        events: those of children, oldest first.
        troubled: resources in WARNING, ERROR or FATAL, as many as were asked for; `troubled_total`: how many there are.
        waiting, loads: the loads that wait, and how long those of each server took.
        standing: the line in which the load callback of a server stands, by the server.
        began: when resources got their states, by their ids.
    """

    now: float
    children: Sequence[ChildRow] = ()
    events: Sequence[Event] = ()
    troubled: Sequence[ResourceRow] = ()
    troubled_total: int = 0
    waiting: Sequence[QueryRow] = ()
    loads: Sequence[LoadRow] = ()
    standing: Mapping[str, str] = {}
    began: Mapping[str, float] = {}
    pools: Sequence[PoolUse] = ()
    kept: Sequence[KeptThing] = ()
    choices: Sequence[Choice] = ()
    streams: Sequence[StreamRow] = ()
    mailboxes: Sequence[Fill] = ()
    disks: Sequence[Fill] = ()


def needs_attention(known: Known) -> list[AttentionItem]:
    """Return what needs attention, the worst first, and of what is equally bad the newest last."""
    items = [
        *_of_resources(known),
        *_of_children(known),
        *_of_loads(known),
        *_of_planners(known),
        *_of_streams(known),
        *_of_fills(known),
    ]
    items = [msgspec.structs.replace(item, what=in_short(item.what, _WIDTH)) for item in items]
    return sorted(items, key=lambda item: (SEVERITIES.index(item.severity), item.since or known.now, item.id))


# -- resources -------------------------------------------------------------------------------------------------------


def _of_resources(known: Known) -> Iterator[AttentionItem]:
    rows = {row.id: row for row in known.troubled}
    wholes: dict[str, list[str]] = defaultdict(list)
    for row in rows.values():
        for part in row.part_resources:
            if part in rows:
                wholes[part].append(row.id)
    begun = {row.id for row in rows.values() if not any(part in rows for part in row.part_resources)}
    for id in begun or rows:  # a ring has no beginning
        row = rows[id]
        reached = list(_reached(id, wholes))
        holders = [holder.origin for one in (id, *reached) for holder in rows[one].holders if not holder.parent]
        touches = list(dict.fromkeys([*(rows[one].name for one in reached), *holders]))
        more = row.holder_count - len(row.holders)
        severity = _SEVERITIES.get(row.state, "WARNING")
        said = f": {row.message}" if row.message else ""
        spread = f"; {counted(len(reached), 'resource')} above it {'is' if len(reached) == 1 else 'are'} not well"
        yield AttentionItem(
            f"resource:{id}", severity, "resource", f"{row.name} is in {row.state}{said}{spread if reached else ''}",
            row.name, known.began.get(id), tuple(touches[:_NAMED]), len(touches) + more, f"why {short_id(id)}", id,
        )  # fmt: skip
    if (left := known.troubled_total - len(rows)) > 0:
        what = f"{left:,} more resources are in WARNING, ERROR or FATAL"
        yield AttentionItem(
            "resources:more", "WARNING", "resource", what, "resources", command="resources --sort-by state"
        )


def _reached(id: str, wholes: Mapping[str, Sequence[str]]) -> Iterator[str]:
    seen, ahead = {id}, [id]
    while ahead:
        for whole in wholes.get(ahead.pop(0), ()):
            if whole not in seen:
                seen.add(whole)
                ahead.append(whole)
                yield whole


# -- children --------------------------------------------------------------------------------------------------------

_DIED = frozenset(("abnormal", "killed"))


def _is_death(event: Event) -> bool:
    return event.event == "start_failed" or (event.event == "exited" and event.facts.get("reason") in _DIED)


def _of_children(known: Known) -> Iterator[AttentionItem]:
    rows = {row.path: row for row in known.children}
    newest: dict[str, Event] = {}
    deaths: dict[str, list[Event]] = defaultdict(list)
    for event in known.events:
        if event.path:
            newest[event.path] = event
        if _is_death(event) and known.now - event.at <= DEATHS_S:
            deaths[event.path].append(event)
    for path, row in rows.items():
        yield from _of_child(row, rows, newest.get(path), deaths[path])


def _of_child(
    row: ChildRow, rows: Mapping[str, ChildRow], newest: Event | None, deaths: Sequence[Event]
) -> Iterator[AttentionItem]:
    path, at = row.path, newest.at if newest is not None else None
    touches = tuple(one for one in rows if one.startswith(f"{path}/"))

    def item(kind: str, severity: Severity, what: str, command: str, since: float | None = at) -> AttentionItem:
        return AttentionItem(
            f"{kind}:{path}", severity, kind, what, path, since, touches[:_NAMED], len(touches), command
        )

    if row.state == "unavailable":
        if row.error.startswith("stopped by a signal"):
            yield item("frozen", "ERROR", f"{path} is frozen: {row.error}", f"stack {path}")
        else:
            yield item("unavailable", "ERROR", f"{path} does not answer: {row.error}", f"stack {path}")
    elif row.state == "stopped" and row.depth == 0:
        yield item("given up", "FATAL", f"the system has ended: {row.error}", f"history {path}")
    elif row.state == "stopped" and newest is not None:
        detail = newest.facts.get("detail") or newest.facts.get("error") or newest.facts.get("reason", "")
        if newest.event == "gave_up" or _is_death(newest):
            yield item("given up", "ERROR", f"{path} is given up: {detail}", f"history {path}")
        elif newest.event == "stopped":
            yield item("stopped", "WARNING", f"{path} was stopped, and stays stopped until restart", f"restart {path}")
    if len(deaths) > 1:
        above = rows.get(path.rpartition("/")[0])
        window = ""
        if above is not None and above.strategy:
            left = max(0, above.max_restarts - above.recent_restarts)
            window = f"; {left} of {above.max_restarts} restarts are left ({above.strategy})"
        span = ago(max(0.0, deaths[-1].at - deaths[0].at))
        last = deaths[-1].facts.get("detail") or deaths[-1].facts.get("error") or deaths[-1].facts.get("reason", "")
        what = f"{path} died {len(deaths)} times within {span}, last of {last}{window}"
        yield item("deaths", "ERROR" if window.startswith("; 0 ") else "WARNING", what, f"history {path}", deaths[0].at)
    if row.note:
        yield item("note", "WARNING", f"{path}: {row.note}", f"logs {path}")


# -- loads -----------------------------------------------------------------------------------------------------------


def _of_loads(known: Known) -> Iterator[AttentionItem]:
    p95 = {row.server: row.p95_s for row in known.loads}
    late: dict[tuple[str, str], list[QueryRow]] = defaultdict(list)
    for row in known.waiting:
        if is_late(row, known.now, p95.get(row.server, 0.0)):
            late[row.server, row.request].append(row)
    for (server, _), rows in late.items():
        first = min(rows, key=lambda row: row.id)
        since = time_in(first.id) or known.now
        usual = f", usually {p95[server]:.2g} s at most" if p95.get(server) else ""
        line = known.standing.get(server, "")
        stands = f"; the callback stands in {line}" if line else f": {first.said}" if first.said else ""
        what = f"a load of {first.name} has waited for {ago(known.now - since)}{usual}{stands}"
        touches = tuple(dict.fromkeys(row.origin for row in rows))
        registrar = server.partition("/")[0]
        command = f"stack {registrar}" if line else f"why {short_id(first.id)}"
        yield AttentionItem(
            f"load:{first.id}", "WARNING", "load", what, first.name, since, touches[:_NAMED], len(touches), command,
            first.resource_id,
        )  # fmt: skip


def is_late(row: QueryRow, now: float, p95_s: float) -> bool:
    """Return whether a load waits for longer than ten times the p95 of its server; 5 s where no load has ended yet."""
    at = time_in(row.id)
    return at is not None and now - at > (_TIMES_P95 * p95_s if p95_s else _WAIT_S)


# -- planners, streams, mailboxes, disks -----------------------------------------------------------------------------


def _of_planners(known: Known) -> Iterator[AttentionItem]:
    for pool in known.pools:
        if pool.problem:
            what = f"pool {pool.name}: its measure fails: {pool.problem}"
            yield AttentionItem(
                f"pool:{pool.path}:{pool.name}:problem", "WARNING", "pool", what, pool.name, command="budgets"
            )
        if pool.used > _POOL * pool.capacity:
            share = f"{100 * pool.used / pool.capacity:.0f} %" if pool.capacity > 0 else "more than all"
            waits = f"; {counted(pool.waiting, 'load')} wait{'s' if pool.waiting == 1 else ''} for room"
            amounts = f"{pool.used:g} of {pool.capacity:g}{waits if pool.waiting else ''}"
            what = f"pool {pool.name} has {share} in use: {amounts}"
            severity: Severity = "ERROR" if pool.used > pool.capacity else "WARNING"
            command = f"budgets --budgets {pool.path}"
            yield AttentionItem(f"pool:{pool.path}:{pool.name}", severity, "pool", what, pool.name, command=command)
    for kept in known.kept:
        if kept.ready < kept.wanted:
            why = ": ".join(filter(None, (kept.why, kept.detail)))
            what = f"{kept.name} has {kept.ready} of {counted(kept.wanted, 'replica')} ready{why and f': {why}'}"
            severity = "WARNING" if kept.ready else "ERROR"
            command = f"keep diff --keeper {kept.path}"
            yield AttentionItem(f"kept:{kept.path}:{kept.name}", severity, "kept", what, kept.name, command=command)
    for choice in known.choices:
        best = choice.by_hand or next(iter(choice.allowed), choice.present)
        if choice.present != best:
            why = f": {choice.why}" if choice.why else ""
            what = f"choice of {choice.kind} has {choice.present or 'nothing'} in place of {best}{why}"
            severity = "WARNING" if choice.present else "ERROR"
            item = AttentionItem(f"choice:{choice.id}", severity, "choice", what, choice.kind)
            yield msgspec.structs.replace(item, command=f"choices --choices {choice.path}", resource=choice.id)


def _of_streams(known: Known) -> Iterator[AttentionItem]:
    for row in known.streams:
        info = row.info
        if info.best_hz > 0 and info.rate_hz < _STREAM * info.best_hz:
            rates = f"gives {info.rate_hz:.3g} frames/s, gave {info.best_hz:.3g}"
            what = f"stream {info.name} of {named(info.server, row.request)} {rates}"
            since = None if info.age_s is None or info.rate_hz else known.now - info.age_s
            touches = tuple(dict.fromkeys(reader.registrar for reader in row.readers))
            item = AttentionItem(f"stream:{info.id}", "WARNING", "stream", what, info.name, since, touches[:_NAMED])
            yield msgspec.structs.replace(
                item, touched=len(touches), command=f"streams {info.name}", resource=info.resource_id
            )


def _of_fills(known: Known) -> Iterator[AttentionItem]:
    for box in known.mailboxes:
        if box.used > _MAILBOX * box.limit:
            what = f"the mailbox of {box.name} has {box.used:,.0f} messages, its limit is {box.limit:,.0f}"
            yield AttentionItem(
                f"mailbox:{box.name}", "WARNING", "mailbox", what, box.name, command=f"mailbox {box.name}"
            )
    for disk in known.disks:
        free = disk.limit - disk.used
        if free < min(_DISK_FREE * disk.limit, _DISK_BYTES):
            what = f"the disk of {disk.name} is nearly full: {free / 2**20:,.0f} MiB are free"
            yield AttentionItem(f"disk:{disk.name}", "ERROR", "disk", what, disk.name)


# -- silence ---------------------------------------------------------------------------------------------------------


class Silences:
    """The items that are not shown for a while, kept in the process of the system. Any thread may call it."""

    def __init__(self) -> None:
        self._until: dict[str, float] = {}

    def add(self, id: str, for_s: float) -> float:
        """Silence an item, and return until when, in seconds since the epoch; with 0 it is shown again."""
        until = time.time() + for_s
        if for_s > 0:
            self._until[id] = until
        else:
            self._until.pop(id, None)
        return until

    def now(self) -> dict[str, float]:
        """Return which items are silenced, and until when; those that were are forgotten."""
        now = time.time()
        for id, until in list(self._until.items()):
            if until <= now:
                self._until.pop(id, None)
        return dict(self._until)


def counts_text(items: Iterable[AttentionItem], silenced: Collection[str] = ()) -> str:
    """Return the head of a list of items: "all is well", or "2 need attention: 1 ERROR, 1 WARNING"."""
    counts = Counter(item.severity for item in items)
    total = sum(counts.values())
    hidden = f" ({len(silenced)} silenced)" if silenced else ""
    if not total:
        return f"all is well{hidden}"
    listed = ", ".join(f"{counts[one]} {one}" for one in SEVERITIES if counts[one])
    return f"{total} need{'s' if total == 1 else ''} attention: {listed}{hidden}"
