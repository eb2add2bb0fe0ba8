"""Reserves: the resources that a Budgets manager loads when a pool needs more than it has. On the loop's thread.

Its sinks are here, too: those that it loads while there is too much.

A reserve gives by a supply whose row says what it is a part of. So what a reserve gives counts from the moment at which
its supply is there, until its release begins.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable, Mapping

import msgspec

from rr_actors.base.errors import CatalogError, UnknownQuery, text_of
from rr_actors.base.names import is_planned, made_at
from rr_actors.base.reporting.log import Log
from rr_actors.managers.budgets.books import Book
from rr_actors.managers.budgets.planner import LEAST, BudgetPlan, SpareReserve
from rr_actors.managers.budgets.pools import Pool, Reserve, Sink
from rr_actors.managers.planning.kept_record import KeptRecord
from rr_actors.managers.planning.planning_loop import PlanningLoop, StepEnded
from rr_actors.managers.planning.setbacks import Setbacks
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query, Status
from rr_actors.registrar.registrar import NO_FIELDS, Registrar, begin_planned
from rr_actors.supervision.core.specs import Backoff

logger = Log("rr_actors.managers.budgets")

_RESERVE_S = 60.0
_SETTLES_S = 2.0  # so long a supply may take to follow what it is a part of
_AGAIN = Backoff(delay_s=1.0, factor=2.0, maximum_s=30.0, jitter=0.0)


class BudgetRecord(msgspec.Struct):
    """What a Budgets manager keeps beside its catalog."""

    capacities: dict[str, tuple[float, float]] = {}  # of the pool: the file's, and the one that was set in its place
    measured: dict[str, float] = {}  # the last measured capacity of the pool
    reserves: dict[str, str] = {}  # "pool/number", of a sink "pool/sink/number": the id of the query that holds it


class _On(msgspec.Struct):
    """A reserve that is held: by which query, since when, and with which priority. Times are monotonic."""

    query: Query
    since: float
    priority: int | None = None


class Reserves:
    """The reserves of all pools, by the keys "pool/number", and their sinks, by "pool/sink/number"."""

    def __init__(
        self,
        pools: Mapping[str, Pool],
        registrar: Registrar,
        planning: PlanningLoop[tuple[str, str], str],
        record: KeptRecord[BudgetRecord],
        grace_s: float,
    ) -> None:
        """Go on with those that are held. Release those that a crash has left before they were noted."""
        self._registrar, self._planning, self._record, self._grace_s = registrar, planning, record, grace_s
        self._all: dict[str, Reserve] = {
            f"{name}/{i}": one for name, pool in pools.items() for i, one in enumerate(pool.reserve)
        }
        self._sinks = {f"{name}/sink/{i}": one for name, pool in pools.items() for i, one in enumerate(pool.sink)}
        self._both: dict[str, Reserve | Sink] = {**self._all, **self._sinks}
        self._of_pool = {name: [f"{name}/sink/{i}" for i in range(len(pool.sink))] for name, pool in pools.items()}
        self._keys = {name: [f"{name}/{i}" for i in range(len(pool.reserve))] for name, pool in pools.items()}
        self._on: dict[str, _On] = {}
        self._limits: dict[str, float] = {}  # of the pool, while a reserve stops whose supply is not known
        self._fading: dict[str, float] = {}  # resources that were released, and until when they count for nothing
        self._failed: Setbacks[str] = Setbacks(_AGAIN)
        self._owed: dict[str, str] = {}  # queries to be released, by the keys of the steps
        self._refused: Setbacks[str] = Setbacks()  # releases that could not be begun: the disk is full
        held = {query.id: query for query in registrar.queries() if not query.parent}
        kept = {key: id for key, id in record.now.reserves.items() if id in held and key in self._both}
        for key, id in kept.items():
            ran_s = max(0.0, time.time() - made_at(id))
            self._on[key] = _On(held[id], time.monotonic() - ran_s)
        if kept != record.now.reserves:
            record.now.reserves = kept
            record.save()
        self._wanted = {name: sum(key in self._on for key in keys) for name, keys in self._of_pool.items()}
        for id in filter(is_planned, held.keys() - kept.values()):
            self._owed[f"query {id}"] = id
        for server_id in sorted({one.server for one in self._both.values()}):
            registrar.on_status(server_id, self._hear)

    # -- for the books and the planner -----------------------------------------------------------------------------

    def ending(self, now: float) -> set[str]:
        """Return the resources that are being released, or were a moment ago: what they give counts for nothing."""
        self._fading = {whole: until for whole, until in self._fading.items() if until > now}
        return {one.query.resource_id for key, one in self._on.items() if key in self._owed} | set(self._fading)

    def limits(self, pool: str) -> list[float]:
        """Return capacities that a pool has at most, while a reserve stops whose supply is not known."""
        return [limit for key, limit in self._limits.items() if key in self._keys[pool]]

    def given(self, pool: str, book: Book) -> float:
        """Return what the reserves of a pool give now."""
        return math.fsum(book.supplies.get(one.query.resource_id, 0.0) for _, one in self._held(pool))

    def amounts(self, pool: str) -> dict[str, float]:
        """Return what all reserves of a pool can give, by their resources, or else their keys."""
        wholes = {key: one.query.resource_id for key, one in self._held(pool)}
        return {wholes.get(key, key): self._all[key].amount for key in self._keys[pool]}

    def starting(self, pool: str) -> int:
        """Return how many reserves of a pool are starting."""
        return sum(("start", key) in self._planning.in_flight for key in self._keys[pool])

    def failures(self, pool: str) -> list[str]:
        """Return which reserves of a pool could not be loaded, and why."""
        found: list[str] = []
        for key in self._keys[pool]:
            setback = self._failed.get(key)
            if setback is not None and key not in self._on:
                found.append(f"reserve {self._all[key].server} cannot be loaded: {setback.text}")
        return found

    def spares(self, pool: str, book: Book, now: float) -> list[SpareReserve]:
        """Return the reserves of a pool for the planner."""
        found: list[SpareReserve] = []
        for key in self._keys[pool]:
            amount, one = self._all[key].amount, self._on.get(key)
            start = self._planning.in_flight.get(("start", key))
            if start is not None:
                found.append(SpareReserve(key, amount, "starting" if now < start.since + self._grace_s else "late"))
            elif one is None:
                if self._failed.may_try(key, now):
                    found.append(SpareReserve(key, amount))
            elif key not in self._owed:
                gives = book.supplies.get(one.query.resource_id)
                if gives is None and now < one.since + _SETTLES_S:
                    found.append(SpareReserve(key, amount, "starting"))
                else:
                    may_stop = now >= one.since + self._all[key].least_on_s
                    found.append(SpareReserve(key, amount if gives is None else gives, "on", may_stop))
        return found

    def due(self, now: float) -> float | None:
        """Return when something of a reserve is due next, in time alone."""
        starts = [step.since + self._grace_s for key, step in self._planning.in_flight.items() if key[0] == "start"]
        on = [
            at
            for key, one in self._on.items()
            for at in (one.since + _SETTLES_S, one.since + self._both[key].least_on_s)
        ]
        again = [one.next_at(now) or 0.0 for one in (self._failed, self._refused)]
        times = [*starts, *on, *self._fading.values(), *again]
        return min((at for at in times if at > now), default=None)

    # -- steps -----------------------------------------------------------------------------------------------------

    def carry_out(
        self,
        pool: str,
        made: BudgetPlan,
        urgent: Callable[[list[SpareReserve]], dict[str, int]],
        book: Book,
        total: float,
        now: float,
    ) -> None:
        """Begin what a plan says of the reserves of a pool, and give each the priority of what it is for.

        Args:
            urgent: returns how urgent each of the reserves is.
            total: the capacity with what gives now.
        """
        if not self._keys[pool]:
            return
        for key in made.stop:
            self._stop(key, book, total)
        spares = self.spares(pool, book, now)
        spares = [SpareReserve(one.id, one.amount, "starting" if one.id in made.start else one.state) for one in spares]
        priorities = urgent(spares)
        for key in made.start:
            self._start(key, priorities[key])
        for key, one in self._held(pool):
            priority = min(priorities.get(key, 0), self._registrar.config.max_priority)
            if key in priorities and one.priority != priority and ("rank", key) not in self._planning.in_flight:
                set_it = functools.partial(self._registrar.set_priority, one.query, priority)
                self._planning.begin_call(("rank", key), key, set_it, functools.partial(self._ranked, one, priority))

    def _ranked(self, one: _On, priority: int, ended: StepEnded) -> None:
        one.priority = priority
        if ended.error is not None:
            logger.warning("a reserve has not the priority %d: %s", priority, text_of(ended.error))

    # -- sinks -----------------------------------------------------------------------------------------------------

    def want_sinks(self, pool: str, more: int) -> bool:
        """Want one sink more, or one less (-1). Return whether that is possible: False if all are on, or none is."""
        before = self._wanted[pool]
        self._wanted[pool] = min(max(0, before + more), len(self._of_pool[pool]))
        return self._wanted[pool] != before

    def carry_out_sinks(self, pool: str, now: float) -> None:
        """Load or release a sink, if more or fewer are on than are wanted."""
        keys = self._of_pool[pool]
        on = [key for key in keys if key in self._on and key not in self._owed]
        starting = [key for key in keys if ("start", key) in self._planning.in_flight]
        if len(on) + len(starting) < self._wanted[pool]:
            off = [key for key in keys if key not in self._on and key not in starting]
            for key in [key for key in off if self._failed.may_try(key, now)][:1]:
                self._start(key, LEAST)
        elif len(on) > self._wanted[pool] and now >= self._on[on[-1]].since + self._sinks[on[-1]].least_on_s:
            self._owed[on[-1]] = self._on[on[-1]].query.id

    # -- both ------------------------------------------------------------------------------------------------------

    def _start(self, key: str, priority: int) -> None:
        reserve = self._both[key]
        request = NO_FIELDS if reserve.request is None else reserve.request
        priority = min(priority, self._registrar.config.max_priority)
        load = functools.partial(begin_planned, self._registrar, reserve.server, request)
        start = functools.partial(load, priority=priority, timeout_s=None)
        started = functools.partial(self._started, key, priority)
        self._planning.begin(("start", key), key, start, started, limit_s=_RESERVE_S)

    def _started(self, key: str, priority: int, ended: StepEnded) -> None:
        if ended.value is None:
            self._note_failure(key, text_of(ended.error) if ended.error is not None else f"not within {_RESERVE_S:g} s")
            return
        one = self._on[key] = _On(ended.value, time.monotonic(), priority)
        self._failed.forget(key)
        self._fading.pop(one.query.resource_id, None)
        self._record.now.reserves[key] = one.query.id
        self._record.save()
        try:
            if self._registrar.fetch_state(one.query) is State.FATAL:  # the status came before
                self._give_up(key, "it has failed")
        except UnknownQuery:
            self._give_up(key, "it was lost")

    def _note_failure(self, key: str, why: str) -> None:
        pool, _, what = key.partition("/")
        kind = "sink" if what.startswith("sink/") else "reserve"
        logger.warning("pool %s: %s %s cannot be loaded: %s", pool, kind, self._both[key].server, why)
        self._failed.note(key, time.monotonic(), text=why)

    def _hear(self, status: Status) -> None:
        """Give up a reserve that has failed."""
        if status.state is State.FATAL:
            self._planning.tell(functools.partial(self._lose, status.query_id, status.message))

    def _lose(self, query_id: str, why: str) -> None:
        for key, one in list(self._on.items()):
            if one.query.id == query_id:
                self._give_up(key, why)

    def _give_up(self, key: str, why: str) -> None:
        if key not in self._owed:
            self._failed.note(key, time.monotonic(), text=why)
            self._owed[key] = self._on[key].query.id

    def _stop(self, key: str, book: Book, total: float) -> None:
        one = self._on[key]
        if book.supplies.pop(one.query.resource_id, None) is None:
            self._limits[key] = total - self._all[key].amount
        self._owed[key] = one.query.id

    def release(self, now: float) -> None:
        """Begin the releases that are owed. While the disk is full, try again: nobody else would."""
        for key, query_id in self._owed.items():
            if ("stop", key) not in self._planning.in_flight and self._refused.may_try(key, now):
                start = functools.partial(self._registrar.unload, query_id, block=False)
                self._planning.begin(("stop", key), key, start, functools.partial(self._released, key))

    def _released(self, key: str, ended: StepEnded) -> None:
        if isinstance(ended.error, CatalogError):  # the registrar has logged it
            self._refused.note(key, time.monotonic())
            return
        if ended.error is not None and not isinstance(ended.error, UnknownQuery):
            logger.warning("a reserve cannot be released: %s", text_of(ended.error))
        del self._owed[key]
        self._refused.forget(key)
        self._limits.pop(key, None)
        one = self._on.pop(key, None)
        if one is not None:
            self._fading[one.query.resource_id] = time.monotonic() + _SETTLES_S
            self._record.now.reserves.pop(key, None)
            self._record.save()

    def _held(self, pool: str) -> list[tuple[str, _On]]:
        return [(key, self._on[key]) for key in self._keys[pool] if key in self._on and key not in self._owed]
