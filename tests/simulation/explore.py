"""Small worlds walked to the end: every interleaving of a few registrars, not a sample of them.

Breadth first, from a world in which nothing has happened: each state is followed by each step that can happen in it,
and a state that is equal to one met before is not followed again. What names and numbers of events differ in does not
count. So the history of the first broken promise is a shortest one. From every state all is then mended and let go, and
the promises are checked there, as at the end of each world of chance.
"""

from __future__ import annotations

import enum
import hashlib
import pickle
import re
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import msgspec

from rr_actors.registrar.model.catalog import Catalog, Server
from simulation.budgets import Book, Budget
from simulation.network import OLD
from simulation.pending_steps import Key, Todo
from simulation.quiescence import INDEXES, come_to_rest, finish
from simulation.sim_links import TO_CONSUMER, TO_PROVIDER
from simulation.sim_registrar import SimRegistrar
from simulation.world import Step, World, describe

Factory = Callable[..., SimRegistrar]


class Person(NamedTuple):
    """Somebody who asks one registrar for something, and then does these things with the query, in this order.

    Each of `then` is a priority, "unload", or "owe": unload by a line of its own. `request`: what of.
    """

    registrar: str
    provider: str
    server: str
    then: tuple[int | str, ...] = ("unload",)
    direct: bool = False
    request: bytes = b"p"


class SmallWorld(NamedTuple):
    """What there is, what people do, and how often something may go wrong in one history.

    Args:
        layout: the servers of each registrar.
        parts: what the load callback of a server loads: registrar and server.
        people: who asks.
        statuses: what the owner of the first resource of a registrar says: registrar and state; or "revoke", "reload".
        crashes: how many processes die.
        cuts: how many links break.
        raises: how many callbacks raise.
        tires: how many people stop waiting.
        hasty: registrars that decide everything as it comes in.
        linked: whether those who ask have links to their providers before they do.
        budget: what decides when a load of a share ends, and which shares are revoked.
        rates: how fast the clock of each host goes, if the registrars are on hosts.
        ticks: how often half the time of a lease passes, and a little more.
        rounds: how often all gateways that reach each other renew their leases.
        partings: how often a partition comes between the hosts. It may heal at any time.
        stumbles: how often a gateway is killed.
    """

    layout: Mapping[str, tuple[Server, ...]]
    parts: Mapping[str, tuple[str, str]]
    people: tuple[Person, ...]
    statuses: tuple[tuple[str, str], ...] = ()
    crashes: int = 0
    cuts: int = 0
    raises: int = 0
    tires: int = 0
    hasty: frozenset[str] = frozenset()
    linked: bool = False
    budget: Budget | None = None
    rates: Mapping[str, float] | None = None
    ticks: int = 0
    rounds: int = 0
    partings: int = 0
    stumbles: int = 0


class Walk(NamedTuple):
    """How far a walk came: all states within `depth` steps were met, and `ended`: there are no others.

    `history` is that of the first broken promise, and `violation` the promise.
    """

    depth: int
    states: int
    steps: int
    ended: bool
    history: tuple[Step, ...] = ()
    violation: Exception | None = None


class _Spent(NamedTuple):
    """What has happened of that which may happen a few times only."""

    done: tuple[int, ...]  # by each person
    statuses: int = 0
    crashes: int = 0
    cuts: int = 0
    raises: int = 0
    tires: int = 0
    ticks: int = 0
    rounds: int = 0
    partings: int = 0
    stumbles: int = 0
    book: Book = Book()


class _Node(NamedTuple):
    history: tuple[Step, ...]
    spent: _Spent
    world: bytes  # pickled


def walk(
    small: SmallWorld, factory: Factory = SimRegistrar, go_on: Callable[[Walk], bool] = lambda so_far: True
) -> Walk:
    """Meet every state, or go as far as `go_on` says, which is asked at each state; or to the first broken promise."""
    world = begun(small, factory)
    first = _Node((), _Spent((0,) * len(small.people)), pickle.dumps(world))
    met = {digest(world, first.spent)}
    level, following = deque([first]), deque[_Node]()
    depth = steps = 0
    while level and go_on(so_far := Walk(depth, len(met), steps, False)):
        node = level.popleft()
        for step, spent in [*_moves(pickle.loads(node.world), small, node.spent)]:
            steps += 1
            history = (*node.history, step)
            try:
                world = pickle.loads(node.world)
                world.apply(step)
                if small.budget is not None:
                    small.budget.check(world, spent.book)
                mark = digest(world, spent)
                if mark in met:
                    continue
                met.add(mark)
                following.append(_Node(history, spent, pickle.dumps(world)))
                come_to_rest(world)
            except Exception as error:  # a Violation, or a defect that raised
                return so_far._replace(states=len(met), steps=steps, history=history, violation=error)
        if not level:
            depth += bool(following)
            level, following = following, level
    return Walk(depth, len(met), steps, not level)


def begun(small: SmallWorld, factory: Factory) -> World:
    """Return the world before anybody has asked for anything: all registrars are up."""
    world = World(dict(small.layout), factory, small.hasty, dict(small.rates or {}))
    for person in small.people if small.linked else ():
        world.registrars[person.registrar].want(person.provider)
    finish(world)
    return world


def picture(small: SmallWorld, history: tuple[Step, ...], factory: Factory = SimRegistrar) -> list[str]:
    """Draw a history: a column for each registrar, an arrow for each message that arrives."""
    world = begun(small, factory)
    column = {name: number * _WIDTH for number, name in enumerate(small.layout)}
    lines = ["".join(name.ljust(_WIDTH) for name in column).rstrip()]
    try:
        for step in history:
            lines.append(_drawn(world, column, step))
            world.apply(step)
        lines.append("everything is mended, and comes to rest")
        come_to_rest(world)
    except Exception as error:  # the last step: what the walk has found
        lines.append(f"=> {error}")
    return lines


def _drawn(world: World, column: Mapping[str, int], step: Step) -> str:
    if step[0] != "net":
        owner = step[2] if step[0] == "load" else step[1]
        return f"{_lanes(column, column[owner])}{describe(step)}"
    consumer, provider = column[step[1]], column[step[2]]
    start, end = (provider, consumer) if step[3] == TO_CONSUMER else (consumer, provider)
    return f"{_lanes(column, min(start, end))}{_arrow(_arrives(world, *step[1:]), end - start)}"


_WIDTH = 28


def _lanes(column: Mapping[str, int], until: int) -> str:
    return "".join("|".ljust(_WIDTH) for place in column.values() if place < until)


def _arrow(text: str, length: int) -> str:
    line = f" {text} ".center(max(abs(length) - 3, 0), "-")
    return f"|{line}->" if length >= 0 else f"|<-{line}"


def _arrives(world: World, consumer: str, provider: str, way: int) -> str:
    """Say what arrives next on a link."""
    if way == OLD:
        queue = world.old[consumer, provider].ways[TO_PROVIDER]
    elif way == TO_PROVIDER:
        queue = world.registrars[provider].links[consumer].ways[way]
    else:
        queue = world.registrars[consumer].clients[provider].link.ways[way]
    if not queue:
        return "the link is cut"
    return f"{type(queue[0]).__name__} {getattr(queue[0], 'query_id', '')}".strip()


# -- what can happen -------------------------------------------------------------------------------------------------


_CALLS = ("revoke", "reload")
"""What an owner does to a resource, beside saying a state."""


def _moves(world: World, small: SmallWorld, spent: _Spent) -> Iterator[tuple[Step, _Spent]]:
    if small.budget is not None:
        for step, book in small.budget.moves(world, spent.book):
            yield step, spent._replace(book=book)
    if small.rates is not None:
        yield from _of_hosts(world, small, spent)
    for key in world.todo.keys:
        if small.budget is None or not small.budget.decides(key):
            yield from _goes_on(world, small, spent, key)
    for number, person in enumerate(small.people):
        if (step := _next_of(person, number, spent.done[number])) is not None and _is_possible(world, step):
            done = (*spent.done[:number], spent.done[number] + 1, *spent.done[number + 1 :])
            yield step, spent._replace(done=done)
    if spent.statuses < len(small.statuses):
        name, state = small.statuses[spent.statuses]
        for resource in [*world.registrars[name].catalog.resources][:1]:
            if world.registrars[name].state == "up":
                step = ("own", name, state, resource) if state in _CALLS else ("own", name, "status", resource, state)
                yield step, spent._replace(statuses=spent.statuses + 1)
    if spent.crashes < small.crashes:
        for name, registrar in world.registrars.items():
            if registrar.state in ("up", "starting"):
                yield ("crash", name), spent._replace(crashes=spent.crashes + 1)
    if spent.cuts < small.cuts:
        for name, registrar in world.registrars.items():
            for provider, peering in registrar.clients.items():
                if not peering.link.cut:
                    yield ("cut", name, provider, 0, 0), spent._replace(cuts=spent.cuts + 1)


_TICK = 56
"""Tenths of a second: a little more than half the time for which a provider keeps what it has heard nothing of."""


def _of_hosts(world: World, small: SmallWorld, spent: _Spent) -> Iterator[tuple[Step, _Spent]]:
    """Return what may happen to the hosts: time passes, leases are renewed or end, a partition comes or heals."""
    hosts = world.hosts
    if spent.ticks < small.ticks:
        yield ("tick", _TICK), spent._replace(ticks=spent.ticks + 1)
    if spent.rounds < small.rounds:
        yield ("round",), spent._replace(rounds=spent.rounds + 1)
    if world.apart:
        yield ("heal",), spent
    elif spent.partings < small.partings:
        names = tuple(registrar.name for registrar in world.on(hosts.names[0]))
        for how in ("hold", "cut"):
            yield ("part", names, how), spent._replace(partings=spent.partings + 1)
    for b, given in hosts.given.items():
        for a, lease in given.items():
            if lease.is_over(hosts.clock(b)):
                yield ("lapse", b, a, 1), spent
        if spent.stumbles < small.stumbles:
            yield ("stumble", b), spent._replace(stumbles=spent.stumbles + 1)
        if hosts.knows(b):
            yield ("known", b), spent


def _goes_on(world: World, small: SmallWorld, spent: _Spent, key: Key) -> Iterator[tuple[Step, _Spent]]:
    kind = key[0]
    if kind == "wake":
        yield key, spent
        if len(world.registrars[key[1]].inbox) > 1:
            yield (*key, 1), spent
        if spent.crashes < small.crashes:
            for fault in ("before", "after"):
                yield (*key, 1_000_000, fault), spent._replace(crashes=spent.crashes + 1)
    elif kind == "call":
        run = world.registrars[key[1]].runs[key]
        whole = run.resource
        part = small.parts.get(whole.server) if whole is not None else None
        if key[2] in ("load", "reload") and whole is not None and part is not None and not run.subs:
            yield (*key, "sub", *part, whole.request), spent
        else:
            yield (*key, "ok"), spent
        if spent.raises < small.raises and key[2] != "hear":
            yield (*key, "raise"), spent._replace(raises=spent.raises + 1)
    elif kind in ("tire", "late"):
        if spent.tires < small.tires:
            yield key, spent._replace(tires=spent.tires + 1)
    elif kind == "dial":
        if world.registrars[key[2]].state not in ("down", "stopped"):  # else nothing comes of it
            yield key, spent
    else:
        yield key, spent


def _next_of(person: Person, number: int, done: int) -> Step | None:
    query_id = f"q{number}"
    if not done:
        return ("load", query_id, person.registrar, person.provider, person.server, person.request, person.direct)
    if done > len(person.then):
        return None
    what = person.then[done - 1]
    if isinstance(what, str):
        return (what, person.registrar, query_id)
    return ("rank", person.registrar, query_id, what)


def _is_possible(world: World, step: Step) -> bool:
    """Whether a person can do this now: who asks needs a process, and everything else a query that is held."""
    registrar = world.registrars[step[2] if step[0] == "load" else step[1]]
    if registrar.state not in ("up", "starting"):
        return False
    return step[0] == "load" or step[2] in registrar.catalog.held


# -- states that are equal -------------------------------------------------------------------------------------------

_EVENT = re.compile(r"\be\d+\b")
_DERIVED = frozenset((*INDEXES, "tables", "_index", "name"))
"""Of a catalog: what follows from its rows, or never changes."""
_APART = frozenset(
    ("world", "trace", "events", "tickets", "layout", "hasty", "offers", "budget", "acknowledged", "_ways")
)
"""Of a world and its processes: what only names, counts or finds, and what never changes."""
_PLAIN = frozenset((str, bytes, int, float, bool, type(None)))


def digest(world: World, spent: tuple[object, ...]) -> bytes:
    """Return the same bytes for worlds that go on in the same way, however their events are named."""
    named: dict[str, str] = {}

    def rename(old: re.Match[str]) -> str:
        return named.setdefault(old[0], f"e:{len(named)}")

    text = repr((spent, _plain(world)))
    if world.events:
        text = _EVENT.sub(rename, text)
    return hashlib.blake2b(text.encode(), digest_size=16).digest()


def _plain(value: Any) -> Any:
    """Return what `repr` shows in the same way for equal states: without addresses, and in one order."""
    kind = type(value)
    if kind in _PLAIN or isinstance(value, msgspec.Struct | enum.Enum):
        return value
    if isinstance(value, dict):
        return [(key, _plain(value[key])) for key in _in_order(value)]
    if isinstance(value, set | frozenset):
        return _in_order(value)
    if isinstance(value, Todo):
        return _in_order(value.keys)
    if isinstance(value, tuple | list | deque):
        return [_plain(each) for each in value]
    if callable(value):
        return None
    names = kind.__slots__ if hasattr(kind, "__slots__") else vars(value)
    left_out = _DERIVED if kind is Catalog else _APART
    there = [(name, each) for name in names if name not in left_out and (each := getattr(value, name, None))]
    return [(name, _plain(each)) for name, each in there]


def _in_order(values: Any) -> list[Any]:
    try:
        return sorted(values)
    except TypeError:  # of several types
        return sorted(values, key=repr)
