"""Budgets: the manager that keeps what resources use together within a capacity, such as that of a battery.

What costs something loads a share as a part. What gives something, a generator say, loads a supply as a part. The rows
of the catalog say who has what (books.py), and the planner decides. The planning loop looks, and begins the steps.
"""

from __future__ import annotations

import asyncio
import functools
import math
import os
import time
from collections.abc import Sequence
from typing import Any

import msgspec

from rr_actors.actors.actor_tables import TableColumn, table
from rr_actors.base.errors import LoadFailed, NotFound, OverCapacity, UnknownQuery, UsageError, is_a, shown, text_of
from rr_actors.base.names import made_at
from rr_actors.base.reporting.log import Log
from rr_actors.managers.budgets.books import Book, Books, most_of
from rr_actors.managers.budgets.gauge import Gauge
from rr_actors.managers.budgets.measures import Measure, next_capacity, surplus
from rr_actors.managers.budgets.planner import LEAST, AskedShare, BudgetPlan, plan, urgencies
from rr_actors.managers.budgets.pools import Pool, check_amount, read_pools
from rr_actors.managers.budgets.requests import PoolInfo, Share, Supply, check_request
from rr_actors.managers.budgets.reserves import BudgetRecord, Reserves
from rr_actors.managers.budgets.rings import RingWait, one_to_refuse, without_ground
from rr_actors.managers.budgets.words import NAMED, Around, gives_way, has_room, waits
from rr_actors.managers.planning.kept_record import KeptRecord
from rr_actors.managers.planning.last_good import still_standing
from rr_actors.managers.planning.planning_loop import PlanningLoop, StepEnded
from rr_actors.managers.planning.probes import probe_of
from rr_actors.managers.planning.setbacks import Setbacks
from rr_actors.registrar.declarations import server
from rr_actors.registrar.manager import Manager
from rr_actors.registrar.model.rows import Phase
from rr_actors.registrar.registrar import begin_revocation, on_happened, served
from rr_actors.registrar.servers.callback_context import Current, current
from rr_actors.runtime.processes.control_groups import CONTROLLERS, ControlGroups
from rr_actors.runtime.time_limits import LONGEST_GRACE_S

logger = Log("rr_actors.managers.budgets")

_HOLDS_S = 1.0  # a share that has waited for so long is passed over by nobody who comes after it
_SAYS_S = 1.0  # those who are far behind hear so often that those ahead have changed
_NEAR = 10  # the first ones hear at once
_LOOKED_S = 30.0
_RECORD_S = 1.0  # how soon what was set, and the disk has refused, is written again
_TOO_MUCH = "there is too much"
_CAPACITY = "pool %s: its probe %s; the capacity stays %g"


class _Waiting(msgspec.Struct, eq=False):
    """A share that waits, of a run of its load callback, `me`. Times are by the monotonic clock.

    `said`: behind whom it waits, and when it was told that.
    """

    id: str
    share: Share
    me: Current
    since: float
    until: float
    answer: asyncio.Future[None]
    to: asyncio.AbstractEventLoop
    said: str = ""
    said_at: float = 0.0

    def end(self, error: Exception | None) -> None:
        """Answer the load callback, from another thread."""
        self.to.call_soon_threadsafe(_settle, self.answer, error)


class Budgets(Manager):
    """Serves `share` and `supply`: admits shares while they fit, and makes room for those of higher priority.

    A share that does not fit, and may not wait, fails with OverCapacity. The holders of what gives way hear FATAL with
    `status.reason == "revoked"`, and have `grace_s` seconds.
    """

    _rr_side_by_side = True

    def __init__(self, file_or_pools: str | os.PathLike[str] | Sequence[Pool], grace_s: float = 5.0) -> None:
        """Take pools from a TOML file, or as they are given.

        Raises:
            ConfigError: the file cannot be read, or a pool is wrong. `.file`, `.key`, `.expected`, `.got`
        """
        self._pools = read_pools(file_or_pools, self._rr_beginning())
        check_amount(None, "grace_s", grace_s)
        self._grace_s = min(grace_s, LONGEST_GRACE_S)
        self._waiting: dict[str, _Waiting] = {}
        self._admitted: set[str] = set()  # shares whose rows do not say yet that they are loaded
        self._leaving: set[str] = set()  # shares that were chosen to give way
        self._why: dict[str, str] = {}  # the text of their revocation
        self._refused: Setbacks[str] = Setbacks()  # revocations that could not begin
        self._infos: list[PoolInfo] = []
        self._who: dict[str, dict[str, Any]] = {}  # of each pool, the shares by priority and those who wait
        self._measured = dict.fromkeys(self._pools, math.inf)
        self._problems = dict.fromkeys(self._pools, "")  # of the probes
        self._planning: PlanningLoop[tuple[str, str], str] = PlanningLoop("budgets", self._look, self._rr_failed)
        self._gauges = [
            Gauge(
                pool.measure,
                probe_of(pool.measure.probe),
                functools.partial(self._heard, name, pool.measure),
                functools.partial(self._troubled, name),
            )
            for name, pool in self._pools.items()
            if pool.measure is not None
        ]

    def on_start(self) -> None:
        """Go on with what was held, and with the reserves; look whether all of it still fits."""
        self._record = KeptRecord(
            self.registrar.directory / "budgets.json", BudgetRecord
        )  # if damaged, reserves start again
        now = self._record.now
        standing = still_standing(now.capacities, {name: pool.capacity for name, pool in self._pools.items()})
        if standing != now.capacities:
            now.capacities = standing
            self._record.save()
        for name, pool in self._pools.items():
            if pool.measure is not None:
                self._measured[name] = now.measured.get(name, math.inf)
        self._reserves = Reserves(self._pools, self.registrar, self._planning, self._record, self._grace_s)
        on_happened(self.registrar, self._planning.wake)
        self._planning.start()
        for gauge in self._gauges:
            gauge.start()

    def on_stop(self) -> None:
        """Measure no more, and begin nothing."""
        for gauge in self._gauges:
            gauge.stop()
        self._planning.stop()

    # -- messages --------------------------------------------------------------------------------------------------

    def set_capacity(self, pool: str, capacity: float) -> None:
        """Set what a pool has without its supplies, also after a restart, until the file says something else.

        With a measure it is the most that the pool has.

        If that is less than what is held, a reserve is started, or the lowest priorities are revoked. If the disk
        refuses it, it holds all the same, and is written when there is room; a crash before that forgets it.

        Raises:
            NotFound: there is no such pool. `.id`, `.known`
            ConfigError: `capacity` is no number of at least 0.
        """
        check_amount(None, "capacity", capacity)
        configured = self._pool(pool).capacity
        self._planning.tell(functools.partial(self._set, pool, configured, capacity))
        self._planning.look_and_wait(_LOOKED_S)

    def _set(self, pool: str, configured: float, capacity: float) -> None:
        self._record.now.capacities[pool] = (configured, capacity)
        self._record.save()

    def pools(self) -> list[PoolInfo]:
        """Return all pools as they are now."""
        self._planning.look_and_wait(_LOOKED_S)
        return list(self._infos)

    @table(
        "pools",
        TableColumn("name", "pool"),
        TableColumn("used", kind="bar", of="capacity"),
        TableColumn("free", kind="number"),
        TableColumn("shares", "by priority"),
        TableColumn("waiting", kind="number"),
        TableColumn("who_waits", "who waits", "long"),
        TableColumn("enforced", kind="yes"),
        TableColumn("problem", kind="problem"),
    )
    def pool_rows(self) -> list[dict[str, Any]]:
        """Return all pools as they are now, with the shares that are held by priority, and who waits."""
        infos = self.pools()
        return [msgspec.structs.asdict(info) | {"free": info.free} | self._who.get(info.name, {}) for info in infos]

    def on_receive(self, message: Any) -> list[dict[str, Any]]:
        """Answer who asks for the pools by a message."""
        match message:
            case {"pools": None}:
                return self.pool_rows()
            case _:
                raise UsageError(f"{self.registrar.name}: expected a question to Budgets, got {shown(message)}")

    # -- servers ---------------------------------------------------------------------------------------------------

    @server("share", recovery="keep")
    async def load_share(self, request: Share) -> float:
        """Return the amount when the pool has room for it."""
        check_request(request)
        self._pool(request.pool)
        me, now = current(), time.monotonic()
        # the row knows when the wait has begun: a crash gives nobody more time, nor another place
        waited_s = max(0.0, time.time() - made_at(me.resource_id)) if me.attempt > 1 else 0.0
        loop = asyncio.get_running_loop()
        since = now - waited_s
        one = _Waiting(me.resource_id, request, me, since, since + request.wait_s, loop.create_future(), loop)
        self._planning.tell(functools.partial(self._ask, one))
        try:
            await one.answer
        finally:
            self._planning.tell(functools.partial(self._forget, one))
        return request.amount

    @server("supply", recovery="keep")
    def load_supply(self, request: Supply) -> float:
        """Return the amount, which is added to the capacity when this is loaded."""
        check_request(request)
        self._pool(request.pool)
        return request.amount

    def _pool(self, name: str) -> Pool:
        if not is_a(name, str) or name not in self._pools:
            known = tuple(sorted(self._pools))
            text = f"no pool {shown(name)}: expected one of {', '.join(known) or 'none'}"
            raise NotFound(text, id=name, known=known)
        return self._pools[name]

    # -- waiting, on the loop's thread -----------------------------------------------------------------------------

    def _ask(self, one: _Waiting) -> None:
        self._admitted.discard(one.id)  # an earlier run of the load was, and was withdrawn
        self._waiting[one.id] = one

    def _forget(self, one: _Waiting) -> None:
        if self._waiting.get(one.id) is one:
            del self._waiting[one.id]

    def _admit(self, id: str) -> None:
        one = self._waiting.pop(id)
        self._admitted.add(id)
        if one.said:
            one.me.progress(1.0, has_room(one.share.pool, one.share.amount, max(0.0, time.monotonic() - one.since)))
        one.end(None)

    def _refuse(self, books: Books, id: str, free: float, why: str = "") -> None:
        one = self._waiting.pop(id)
        share, server_id = one.share, f"{self.registrar.name}/share"
        if id not in books.of or not books.of[id].holders:
            one.end(LoadFailed(f"share of {share.pool!r}: its load was withdrawn", server=server_id))
            return
        book = books.pools[share.pool]
        holders = tuple(dict.fromkeys(name for share in book.shares.values() for name in share.holders))
        said = why or "; ".join(
            [f"held by {', '.join(sorted(holders)) or 'nobody'}", *self._reserves.failures(share.pool)]
        )
        details = {"pool": share.pool, "asked": share.amount, "free": free, "holders": holders}
        one.end(OverCapacity(f"{self._room(book, share, free)}; {said}", server=server_id, **details))

    def _room(self, book: Book, share: Share, free: float) -> str:
        total = self._total(share.pool, book)
        return f"pool {shown(share.pool)}: asked {share.amount:g}, free {free:g} of {total:g}"

    # -- looking ---------------------------------------------------------------------------------------------------

    def _look(self, now: float) -> float | None:
        """Compare what is wanted with what is there, begin what follows, and return when to look again."""
        books = Books(self._pools, served(self.registrar), self._admitted, self._reserves.ending(now))
        self._clean(books)
        self._refuse_in_vain(books, now)
        waiting: dict[str, list[_Waiting]] = {name: [] for name in self._pools}
        for id in sorted(self._waiting):
            waiting[self._waiting[id].share.pool].append(self._waiting[id])
        due = [self._plan(books, name, waiting[name], now) for name in self._pools]
        self._revoke(books, now)
        self._reserves.release(now)
        self._infos = [
            self._info(books, name, sum(one.id in self._waiting for one in waiting[name])) for name in self._pools
        ]
        self._who = {name: self._shares(books, name, waiting[name]) for name in self._pools}
        retry_at = None if self._record.catch_up() else now + _RECORD_S
        later = [
            at
            for at in (retry_at, *due, self._reserves.due(now), self._refused.next_at(now))
            if at is not None and at > now
        ]
        return min(later, default=None)

    def _shares(self, books: Books, name: str, waiting: Sequence[_Waiting]) -> dict[str, Any]:
        by_priority = books.pools[name].by_priority()
        return {
            "by_priority": by_priority,
            "shares": [f"{priority}: {amount:g}" for priority, amount in by_priority.items()],
            "who_waits": [books.name_of(one.id) for one in waiting if one.id in self._waiting],
        }

    def _clean(self, books: Books) -> None:
        """Forget what the rows say by now, and what has gone."""
        self._admitted = {id for id in self._admitted if id in books.of and books.of[id].phase is Phase.LOADING}
        self._leaving = {id for id in self._leaving if id in books.of}
        self._why = {id: why for id, why in self._why.items() if id in self._leaving}
        self._refused.keep_only(self._leaving)

    def _refuse_in_vain(self, books: Books, now: float) -> None:
        """Refuse those who wait in rings, and those who lose another share, at once."""
        holds = books.holds(self._leaving)
        waits_now = [
            RingWait(id, one.share.pool, books.of[id].whole, one.share.amount, books.of[id].priority, one.since)
            for id, one in self._waiting.items()
            if id in books.of and books.of[id].whole
        ]
        for wait in without_ground(holds, waits_now):
            self._refuse_now(books, wait, "what it is for loses a share of another pool", now)
        while True:
            left = [wait for wait in waits_now if wait.id in self._waiting]
            most = {name: self._most(name, book) for name, book in books.pools.items()}
            ring = one_to_refuse(most, holds, left)
            if not ring:
                return
            others = ", ".join(
                f"{books.name_of(wait.id)} waits for pool {shown(wait.pool)}" for wait in ring[1:][:NAMED]
            )
            why = f"a ring: what it is for has a share that others wait for, and {others or 'it waits for more of it'}"
            self._refuse_now(books, ring[0], f"{why}; load the shares of several pools in one order", now)

    def _refuse_now(self, books: Books, wait: RingWait, why: str, now: float) -> None:
        """Refuse one before its pool is planned."""
        waiting = [one for one in self._waiting.values() if one.share.pool == wait.pool]
        _, made = self._made(books, wait.pool, waiting, now)
        self._refuse(books, wait.id, made.free[wait.id], why)

    def _plan(self, books: Books, name: str, waiting: list[_Waiting], now: float) -> float | None:
        """Plan for one pool, and begin what the plan says. Return when to plan again."""
        book, total = books.pools[name], self._total(name, books.pools[name])
        waiting = [one for one in waiting if one.id in self._waiting]
        running = book.running(self._leaving)
        asked, made = self._made(books, name, waiting, now)
        for id in made.admit:
            book.shares[id] = books.of[id]
            self._admit(id)
        for id in made.refuse:
            self._refuse(books, id, made.free[id])
        if made.revoke:
            stays = math.fsum(one.amount for one in running if not one.leaving)
            less = total if stays > total else None
            for id in made.revoke:
                needing = [one for one in made.wait if _is_above(books, one, id)]
                self._why[id] = gives_way(name, less, needing, books.name_of)
            self._leaving.update(made.revoke)
        own = min(self._capacity(name), self._measured[name])
        stay = [one for one in book.running(self._leaving) if not one.leaving]
        needed = [one for one in asked if one.id in self._waiting]
        others = own + book.given() - self._reserves.given(name, book)
        self._reserves.carry_out_sinks(name, now)
        self._reserves.carry_out(name, made, lambda spares: urgencies(others, stay, needed, spares), book, total, now)
        told_at = self._say(books, name, made, now)
        times = [told_at, *(one.until for one in waiting), *(one.since + _HOLDS_S for one in waiting)]
        return min((at for at in times if at > now), default=None)

    def _made(
        self, books: Books, name: str, waiting: Sequence[_Waiting], now: float
    ) -> tuple[list[AskedShare], BudgetPlan]:
        """Return what those who wait ask for, and the plan for one pool."""
        book = books.pools[name]
        most = self._most(name, book)
        asked = [self._asked(books, one, most, now) for one in waiting]
        total, policy = self._total(name, book), self._pools[name].policy
        spares = self._reserves.spares(name, book, now)
        return asked, plan(total, policy, book.running(self._leaving), asked, spares)

    def _asked(self, books: Books, one: _Waiting, most: float, now: float) -> AskedShare:
        row = books.of.get(one.id)
        wanted = row is not None and bool(row.holders)
        priority = row.priority if row is not None else None
        may_wait = wanted and one.share.amount <= most * (1 + 1e-9) and now < one.until
        holds = now >= one.since + _HOLDS_S and priority is not None and priority > LEAST
        return AskedShare(one.id, one.share.amount, priority, one.since, may_wait, holds)

    def _say(self, books: Books, name: str, made: BudgetPlan, now: float) -> float:
        """Tell those who wait behind whom. Return when to tell those who are far behind."""
        book, again_at = books.pools[name], 0.0
        leaving = [id for id, one in book.shares.items() if id in self._leaving or one.is_lost]
        holding = [id for id in book.shares if id not in leaving] if len(leaving) < len(book.shares) else []
        starting = self._reserves.starting(name)
        for at, id in enumerate(made.wait):
            one = self._waiting[id]
            if at >= _NEAR and one.said and now < one.said_at + _SAYS_S:
                again_at = max(again_at, one.said_at + _SAYS_S)
                continue
            around = Around(made.wait[: min(at, NAMED)], max(0, at - NAMED), leaving, holding, starting)
            said = waits(self._room(book, one.share, made.free[id]), around, books.name_of)
            if said != one.said:
                one.said, one.said_at = said, now
                one.me.progress(0.0, said)  # an event; `rr-actors why`, `loads` and `resources` show it, too
        return again_at

    def _revoke(self, books: Books, now: float) -> None:
        """Begin the revocations of the shares that were chosen. One that was admitted just now is not loaded yet."""
        for id in self._leaving:
            one, key = books.of[id], ("revoke", id)
            begins = one.phase is Phase.LOADED and not one.is_lost and self._refused.may_try(id, now)
            if begins and key not in self._planning.in_flight:
                why = self._why.get(id, "")
                start = functools.partial(begin_revocation, self.registrar, id, why, self._grace_s)
                self._planning.begin(key, id, start, functools.partial(self._revoked, id))

    def _revoked(self, id: str, ended: StepEnded) -> None:
        if ended.error is not None and not isinstance(ended.error, UnknownQuery):
            if self._refused.get(id) is None:
                logger.warning("a share cannot be revoked, and is tried again: %s", text_of(ended.error))
            self._refused.note(id, time.monotonic(), text=text_of(ended.error))

    # -- capacities ------------------------------------------------------------------------------------------------

    def _capacity(self, name: str) -> float:
        """Return the capacity that was set, or else the configured one."""
        configured = self._pools[name].capacity
        return self._record.now.capacities.get(name, (configured, configured))[1]

    def _total(self, name: str, book: Book) -> float:
        """Return the capacity with what gives now."""
        own = min(self._capacity(name), self._measured[name])
        return min([own + book.given(), *self._reserves.limits(name)])

    def _most(self, name: str, book: Book) -> float:
        most = max(self._pools[name].capacity, self._capacity(name))
        return most_of(most, book, self._reserves.amounts(name))

    def _info(self, books: Books, name: str, waiting: int) -> PoolInfo:
        book = books.pools[name]
        enforced = name in CONTROLLERS and name in ControlGroups.of_this_process().limits()
        return PoolInfo(name, self._total(name, book), book.used(), waiting, self._problems[name], enforced)

    def _heard(self, pool: str, measure: Measure, reading: float) -> None:
        """Take a reading of a pool's probe, on the gauge's thread."""
        self._planning.tell(functools.partial(self._take, pool, measure, reading))

    def _take(self, pool: str, measure: Measure, reading: float) -> None:
        self._balance(pool, measure, reading)
        capacity = next_capacity(measure, self._capacity(pool), self._measured[pool], reading)
        if capacity != self._measured[pool]:
            self._measured[pool] = self._record.now.measured[pool] = capacity
            self._record.save()

    def _balance(self, pool: str, measure: Measure, reading: float) -> None:
        """Have sinks loaded or released, and say once that there is too much and no sink is left."""
        more = surplus(measure, reading)
        changes = more != 0 and self._reserves.want_sinks(pool, more)
        problem = f"{_TOO_MUCH}: its probe reads {reading:g}, and no sink is left" if more > 0 and not changes else ""
        before = self._problems[pool]
        if before and not problem:
            logger.info(
                "pool %s: %s",
                pool,
                "it has not too much any more" if _is_surplus(before) else "its probe answers again",
            )
        elif problem and not _is_surplus(before):
            logger.warning("pool %s: %s", pool, problem)
        self._problems[pool] = problem

    def _troubled(self, pool: str, problem: str) -> None:
        """Keep the last measured capacity, and say once what is wrong. On the gauge's thread."""
        self._planning.tell(functools.partial(self._note_trouble, pool, problem))

    def _note_trouble(self, pool: str, problem: str) -> None:
        if self._problems[pool] != problem:
            self._problems[pool] = problem
            info = next((info for info in self._infos if info.name == pool), None)
            logger.warning(_CAPACITY, pool, problem, self._capacity(pool) if info is None else info.capacity)


def _is_surplus(problem: str) -> bool:
    return problem.startswith(_TOO_MUCH)


def _settle(answer: asyncio.Future[None], error: Exception | None) -> None:
    if answer.done():  # the load was withdrawn meanwhile
        return
    if error is None:
        answer.set_result(None)
    else:
        answer.set_exception(error)


def _is_above(books: Books, one: str, other: str) -> bool:
    """Return whether a share has a higher priority than another."""
    upper = books.of[one].priority if one in books.of else None
    lower = books.of[other].priority
    return upper is not None and (lower is None or upper > lower)
