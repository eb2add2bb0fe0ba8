"""Budgets: the manager that keeps what resources use together within a capacity, such as that of a battery.

What costs something loads a share as a part. What gives something, a generator say, loads a supply as a part. The
planner decides; this module keeps the books, and carries its plans out with the calls that every manager has.
"""

from __future__ import annotations

import functools
import math
import os
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from rr_actors.base.checks import is_number
from rr_actors.base.errors import CatalogError, LoadFailed, NotFound, OverCapacity, RrError, UsageError, shown
from rr_actors.base.names import short_id
from rr_actors.base.reporting.log import Log
from rr_actors.managers.budgets.budget_record import BudgetRecord
from rr_actors.managers.budgets.gauge import Gauge
from rr_actors.managers.budgets.measures import Measure, next_capacity
from rr_actors.managers.budgets.planner import Asked, Plan, Running, Spare, plan
from rr_actors.managers.budgets.pools import Pool, Reserve, check_amount, read_pools
from rr_actors.managers.budgets.probes import probe_of
from rr_actors.managers.budgets.words import Around, gives_way, has_room, waits
from rr_actors.registrar.declarations import server
from rr_actors.registrar.engine.server import current, current_or_none
from rr_actors.registrar.engine.status import Status
from rr_actors.registrar.manager import Manager
from rr_actors.registrar.model.rows import Phase, State
from rr_actors.registrar.queries import ResourceInfo
from rr_actors.registrar.registrar import NO_FIELDS
from rr_actors.runtime.processes.control_groups import CONTROLLERS, ControlGroups

logger = Log("rr_actors.managers.budgets")

_POLL_S = 0.25  # priorities change without a call of this manager: while somebody waits, it looks again
_RETRY_S = 10.0  # a reserve that could not be loaded is not tried again for so long
_RESERVE_S = 60.0
_HELD = (Phase.LOADED, Phase.UNLOADING, Phase.UNLOAD_FAILED)


def _whose() -> str:
    callback = current_or_none()
    return "" if callback is None else callback.resource_id


def _whose_name() -> str:
    callback = current_or_none()
    return "" if callback is None else callback.name


class Share(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The request for a part of a pool. Load it as a part, in the load callback of what needs it.

    Attributes:
        pool: the pool's name.
        amount: how much of it, at least 0.
        wait_s: how many seconds it may wait for others to release theirs. Room that is being made by a reserve, or by
            others that are revoked, is waited for in any case. `timeout_s` of the load should be longer.
        instance: a name that distinguishes requests that are otherwise the same, which would be one share. By default
            the resource whose callback makes the request.
        whose: for people, the name of what the share is for. By default that of the same resource.
    """

    pool: str
    amount: float
    wait_s: float = 0.0
    instance: str = msgspec.field(default_factory=_whose)
    whose: str = msgspec.field(default_factory=_whose_name)


class Supply(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The request to add to a pool's capacity while it is held. Load it as a part, as the last of the load callback."""

    pool: str
    amount: float
    instance: str = msgspec.field(default_factory=_whose)


_REQUESTS = {"share": Share, "supply": Supply}


class PoolInfo(msgspec.Struct, frozen=True):
    """A pool at one moment: `capacity` with its supplies, `used`, and how many loads are `waiting`.

    `problem`: what is wrong with the probe of its measure; meanwhile the last measured capacity holds. `enforced`:
    external programs can use no more of it than their shares. That is so of the pools "cpu" and "memory_bytes", where
    control groups can be made.
    """

    name: str
    capacity: float
    used: float
    waiting: int
    problem: str = ""
    enforced: bool = False

    @property
    def free(self) -> float:
        """What is left of the capacity, at least 0."""
        return max(0.0, self.capacity - self.used)


class _Waiting(msgspec.Struct):
    """A share that is being loaded. `admitted` is set when it is decided; `said`: behind whom it waits until then."""

    share: Share
    since: float
    deadline: float
    said: str = ""
    admitted: bool | None = None
    error: LoadFailed | None = None


class _Book(msgspec.Struct):
    """One pool: its shares and supplies by resource id, who waits, and its reserves."""

    pool: Pool
    capacity: float
    measured: float = math.inf
    problem: str = ""  # of its probe
    shares: dict[str, float] = {}
    since: dict[str, float] = {}
    supplies: dict[str, float] = {}
    waiting: dict[str, _Waiting] = {}
    leaving: set[str] = set()
    starting: dict[str, float] = {}  # reserves, and when what is over the capacity cannot wait for them any more
    stopping: dict[str, float] = {}  # the capacity without the reserve, until it has stopped
    failed: dict[str, float] = {}  # reserves that could not be loaded, and when they may be tried again
    looked: float = -math.inf

    def total(self) -> float:
        """Return the capacity with the supplies, without those that are about to end."""
        own = min(self.capacity, self.measured)
        return min([own + math.fsum(self.supplies.values()), *self.stopping.values()])

    def info(self) -> PoolInfo:
        name = self.pool.name
        enforced = name in CONTROLLERS and name in ControlGroups.of_this_process().limits()
        return PoolInfo(name, self.total(), self.used(), len(self.waiting), self.problem, enforced)

    def used(self) -> float:
        return math.fsum(self.shares.values())

    def free(self) -> float:
        return max(0.0, self.total() - self.used())


class Budgets(Manager):
    """Serves `share` and `supply`: admits shares while they fit, and makes room for those of higher priority.

    A share that does not fit, and may not wait, fails with OverCapacity. The holders of what gives way hear FATAL with
    `status.reason == "revoked"`, and have `grace_s` seconds.
    """

    def __init__(self, file_or_pools: str | os.PathLike[str] | Sequence[Pool], grace_s: float = 5.0) -> None:
        """Take pools from a TOML file, or as they are given.

        Raises:
            ConfigError: the file cannot be read, or a pool is wrong. `.file`, `.key`, `.expected`, `.got`
        """
        self._pools = read_pools(file_or_pools, self._beginning())
        check_amount(None, "grace_s", grace_s)
        self._grace_s = grace_s
        self._changed = threading.Condition(threading.RLock())
        self._gauges = [
            Gauge(
                pool.measure,
                probe_of(pool.measure.probe),
                functools.partial(self._measured, name, pool.measure),
                functools.partial(self._troubled, name),
            )
            for name, pool in self._pools.items()
            if pool.measure is not None
        ]

    def on_start(self) -> None:
        """Go on with what was held, and with the reserves; look whether all of it still fits."""
        with self._changed:
            held = {query.id: query for query in self.registrar.queries() if not query.parent}
            known = {f"{name}/{i}" for name, pool in self._pools.items() for i in range(len(pool.reserve))}
            for key, query_id in self._record.reserves().items():
                if query_id not in held or key not in known:
                    self._keep(self._record.drop_reserve, key)
            for query_id in set(held) - set(self._record.reserves().values()):
                self._in_thread(self._release, query_id)
            for server_id in sorted({reserve.server for pool in self._pools.values() for reserve in pool.reserve}):
                self.registrar.on_status(server_id, self._reserve_status)
            for name in self._books:
                self._settle(name)
        for gauge in self._gauges:
            gauge.start()

    def on_stop(self) -> None:
        """Measure no more."""
        for gauge in self._gauges:
            gauge.stop()

    # -- messages --------------------------------------------------------------------------------------------------

    def set_capacity(self, pool: str, capacity: float) -> None:
        """Set what a pool has without its supplies, also after a restart, until the file says something else.

        With a measure it is the most that the pool has.

        If that is less than what is held, a reserve is started, or the lowest priorities are revoked.

        Raises:
            NotFound: there is no such pool. `.id`, `.known`
            ConfigError: `capacity` is no number of at least 0.
        """
        check_amount(None, "capacity", capacity)
        with self._changed:
            book = self._book(pool)
            self._record.set_capacity(pool, book.pool.capacity, capacity)
            book.capacity = capacity
            self._settle(pool)

    def pools(self) -> list[PoolInfo]:
        """Return all pools as they are now."""
        with self._changed:
            return [book.info() for book in self._books.values()]

    def on_receive(self, message: Any) -> list[dict[str, Any]]:
        """Answer what `rr-actors budgets` asks."""
        match message:
            case {"pools": None}:
                return [msgspec.structs.asdict(info) | {"free": info.free} for info in self.pools()]
            case _:
                raise UsageError(f"{self.registrar.name}: expected a question to Budgets, got {shown(message)}")

    # -- servers ---------------------------------------------------------------------------------------------------

    @server("share", recovery="keep")
    def load_share(self, request: Share) -> float:
        """Return the amount when the pool has room for it."""
        id = current().resource_id
        _check_request(request.amount, "amount")
        _check_request(request.wait_s, "wait_s")
        with self._changed:
            book = self._book(request.pool)
            now = time.monotonic()
            one = _Waiting(request, time.time(), now + request.wait_s)
            book.waiting[id] = one
            try:
                self._wait(request.pool, id, one)
            finally:
                del book.waiting[id]
        return request.amount

    @load_share.unload
    def unload_share(self, request: Share, response: float | None) -> None:
        """Free the amount."""
        with self._changed:
            for book in self._books.values():
                book.leaving.discard(current().resource_id)
                if book.shares.pop(current().resource_id, None) is not None:
                    del book.since[current().resource_id]
                    self._settle(book.pool.name)

    @server("supply", recovery="keep")
    def load_supply(self, request: Supply) -> float:
        """Add the amount to the capacity."""
        _check_request(request.amount, "amount")
        with self._changed:
            self._book(request.pool).supplies[current().resource_id] = request.amount
            self._settle(request.pool)
        return request.amount

    @load_supply.unload
    def unload_supply(self, request: Supply, response: float | None) -> None:
        """Take the amount from the capacity again."""
        with self._changed:
            for book in self._books.values():
                if book.supplies.pop(current().resource_id, None) is not None:
                    self._settle(book.pool.name)

    # -- waiting ---------------------------------------------------------------------------------------------------

    def _wait(self, pool: str, id: str, one: _Waiting) -> None:
        """Return when the share is admitted; with the lock, which is free meanwhile.

        Raises:
            OverCapacity: the pool has no room for it.
            LoadFailed: nobody wants it any more.
        """
        book = self._books[pool]
        if len(book.waiting) == 1 and one.share.amount <= book.total() - book.used():
            self._admit(book, id)  # without a look at the priorities
            return
        self._settle(pool)
        said = ""
        while one.admitted is None:
            if said != (said := one.said):
                current().progress(0.0, said)  # an event; `rr-actors why`, `loads` and `resources` show it, too
            self._changed.wait(_POLL_S)
            if one.admitted is None and time.monotonic() - book.looked >= _POLL_S:
                self._settle(pool)
        if one.error is not None:
            raise one.error
        if said:
            current().progress(1.0, has_room(pool, one.share.amount, max(0.0, time.time() - one.since)))

    def _admit(self, book: _Book, id: str) -> None:
        one = book.waiting[id]
        book.shares[id], book.since[id], one.admitted = one.share.amount, one.since, True

    def _refuse(self, book: _Book, id: str, infos: dict[str, ResourceInfo]) -> None:
        one = book.waiting[id]
        one.admitted = False
        if id in infos and not infos[id].holders:
            one.error = LoadFailed(f"share of {one.share.pool!r}: its load was withdrawn", server=self._share_id())
            return
        holders = tuple(name for id in book.shares if id in infos for name in infos[id].holders)
        text = f"{self._room(book, one.share)}; held by {', '.join(sorted(set(holders))) or 'nobody'}"
        details = {"pool": one.share.pool, "asked": one.share.amount, "free": book.free(), "holders": holders}
        one.error = OverCapacity(text, server=self._share_id(), **details)

    @staticmethod
    def _room(book: _Book, share: Share) -> str:
        return f"pool {shown(share.pool)}: asked {share.amount:g}, free {book.free():g} of {book.total():g}"

    def _share_id(self) -> str:
        return f"{self.registrar.name}/share"

    # -- plans -----------------------------------------------------------------------------------------------------

    def _settle(self, pool: str) -> None:
        """Plan for a pool, and begin what the plan says. With the lock."""
        book = self._books[pool]
        book.looked = time.monotonic()
        if not book.waiting and book.used() <= book.total() and not self._held_reserves(book):
            return
        infos = {info.id: info for info in self.registrar.resources()}
        running = [
            Running(id, amount, infos[id].priority, book.since[id], id in book.leaving)
            for id, amount in book.shares.items()
            if id in infos
        ]
        asked = [self._asked(book, id, one, infos) for id, one in book.waiting.items() if one.admitted is None]
        self._carry_out(book, infos, plan(book.total(), book.pool.policy, running, asked, self._spares(book)))
        self._changed.notify_all()

    def _look(self, pool: str) -> None:
        with self._changed:
            self._settle(pool)

    def _asked(self, book: _Book, id: str, one: _Waiting, infos: dict[str, ResourceInfo]) -> Asked:
        most = max(book.pool.capacity, book.capacity) + math.fsum(book.supplies.values())
        most += math.fsum(spare.amount for spare in self._spares(book) if spare.state != "on")
        info = infos.get(id)
        wanted = info is not None and bool(info.holders)
        may_wait = wanted and one.share.amount <= most and time.monotonic() < one.deadline
        return Asked(id, one.share.amount, info.priority if info is not None else None, one.since, may_wait)

    def _carry_out(self, book: _Book, infos: dict[str, ResourceInfo], made: Plan) -> None:
        for id in made.admit:
            self._admit(book, id)
        for id in made.refuse:
            self._refuse(book, id, infos)
        reasons = {id: self._reason(book, id, infos, made) for id in made.revoke}
        for id, why in reasons.items():
            book.leaving.add(id)
            self._in_thread(self._revoke, book, id, why)
        for key in made.start:
            book.starting[key] = time.monotonic() + self._grace_s
            self._in_thread(self._start_reserve, book, key)
        for key in made.stop:
            book.stopping[key] = book.total() - self._reserve(book, key).amount
            self._in_thread(self._stop_reserve, book, key)
        holding = [id for id in book.shares if id not in book.leaving]
        for at, id in enumerate(made.wait):
            one, around = book.waiting[id], Around(made.wait[:at], [*book.leaving], holding, len(book.starting))
            one.said = waits(self._room(book, one.share), around, functools.partial(_name, infos))

    def _reason(self, book: _Book, id: str, infos: dict[str, ResourceInfo], made: Plan) -> str:
        """Return why a share is revoked."""
        stays = math.fsum(amount for one, amount in book.shares.items() if one not in book.leaving)
        less = book.total() if stays > book.total() else None
        needing = [one for one in made.wait if _is_above(infos, one, id)]
        return gives_way(book.pool.name, less, needing, functools.partial(_name, infos))

    def _revoke(self, book: _Book, id: str, why: str) -> None:
        """Revoke a share, and return when it is gone. A share that was admitted a moment ago may not be loaded yet."""
        while True:
            try:
                self.registrar.revoke(id, why, grace_s=self._grace_s)
                return
            except (UsageError, CatalogError):  # it is not loaded yet, or is revoked already; or the disk is full
                with self._changed:
                    if id not in book.shares:
                        return
                    self._changed.wait(_POLL_S)

    def _start_reserve(self, book: _Book, key: str) -> None:
        reserve = self._reserve(book, key)
        request = NO_FIELDS if reserve.request is None else reserve.request
        late = threading.Timer(self._grace_s, self._in_thread, (self._look, book.pool.name))
        late.daemon = True
        late.start()
        try:
            query = self.registrar.load(reserve.server, request, timeout_s=_RESERVE_S)
        except RrError as error:
            logger.warning("pool %s: reserve %s cannot be loaded: %s", book.pool.name, reserve.server, error)
            query = None
        finally:
            late.cancel()
        with self._changed:
            book.starting.pop(key, None)
            if query is None:
                book.failed[key] = time.monotonic() + _RETRY_S
            else:
                self._keep(self._record.keep_reserve, key, query.id)
                if query.fetch_state() == State.FATAL:  # the status came before the record
                    self._give_up(book, key)
            self._settle(book.pool.name)

    def _stop_reserve(self, book: _Book, key: str) -> None:
        with self._changed:
            query_id = self._record.reserves()[key]
        self._release(query_id)
        with self._changed:
            self._keep(self._record.drop_reserve, key)
            book.stopping.pop(key, None)
            self._settle(book.pool.name)

    def _release(self, query_id: str) -> None:
        """Release a reserve. While the disk is full, try again: nobody else would."""
        while True:
            try:
                self.registrar.unload(query_id)
                return
            except CatalogError:  # the registrar has logged it
                time.sleep(_POLL_S)
            except RrError as error:
                logger.warning("a reserve cannot be released: %s", error)
                return

    def _keep(self, keep: Callable[..., None], *facts: object) -> None:
        """Keep something beside the catalog. While the disk is full it is not: the next change keeps it, too."""
        try:
            keep(*facts)
        except OSError as error:
            logger.warning("%s: %s%r is not on disk: %s", self.registrar.name, keep.__name__, facts, error)

    def _reserve_status(self, status: Status) -> None:
        """Give up a reserve that has failed: its supply goes with it."""
        if status.state is not State.FATAL:
            return
        with self._changed:
            for book in self._books.values():
                for key, query_id in self._held_reserves(book).items():
                    if query_id == status.query_id:
                        self._give_up(book, key)

    def _give_up(self, book: _Book, key: str) -> None:
        if key not in book.stopping:
            book.failed[key] = time.monotonic() + _RETRY_S
            book.stopping[key] = math.inf
            self._in_thread(self._stop_reserve, book, key)

    def _spares(self, book: _Book) -> list[Spare]:
        now, spares = time.monotonic(), list[Spare]()
        held = self._held_reserves(book)
        for i, reserve in enumerate(book.pool.reserve):
            key = f"{book.pool.name}/{i}"
            if key in book.starting:
                spares.append(Spare(key, reserve.amount, "starting" if now < book.starting[key] else "late"))
            elif key in held and key not in book.stopping:
                spares.append(Spare(key, reserve.amount, "on"))
            elif key not in held and book.failed.get(key, 0.0) <= now:
                spares.append(Spare(key, reserve.amount))
        return spares

    def _held_reserves(self, book: _Book) -> dict[str, str]:
        return {key: id for key, id in self._record.reserves().items() if key.rpartition("/")[0] == book.pool.name}

    @staticmethod
    def _reserve(book: _Book, key: str) -> Reserve:
        return book.pool.reserve[int(key.rpartition("/")[2])]

    def _in_thread(self, do: Callable[..., None], *args: object) -> None:
        """Run what waits for others in a thread of its own; it ends early if the registrar is closed meanwhile."""

        def run() -> None:
            try:
                do(*args)
            except RrError as error:
                logger.info("%s: %s ended early: %s", self.registrar.name, do.__name__, error)

        threading.Thread(target=run, name="budgets", daemon=True).start()

    # -- measures --------------------------------------------------------------------------------------------------

    def _measured(self, pool: str, measure: Measure, reading: float) -> None:
        """Take a reading of a pool's probe."""
        with self._changed:
            book = self._books[pool]
            if book.problem:
                logger.info("pool %s: its probe answers again", pool)
                book.problem = ""
            capacity = next_capacity(measure, book.capacity, book.measured, reading)
            if capacity == book.measured:
                return
            book.measured = capacity
            self._settle(pool)
            self._keep(self._record.keep_measured, pool, capacity)

    def _troubled(self, pool: str, problem: str) -> None:
        """Keep the last measured capacity, and say once what is wrong."""
        with self._changed:
            book = self._books[pool]
            if book.problem != problem:
                book.problem = problem
                logger.warning("pool %s: its probe %s; the capacity stays %g", pool, problem, book.total())

    # -- books -----------------------------------------------------------------------------------------------------

    def _book(self, pool: str) -> _Book:
        if pool not in self._books:
            known = tuple(sorted(self._books))
            text = f"no pool {shown(pool)}: expected one of {', '.join(known) or 'none'}"
            raise NotFound(text, id=pool, known=known)
        return self._books[pool]

    @functools.cached_property
    def _record(self) -> BudgetRecord:
        configured = {name: pool.capacity for name, pool in self._pools.items()}
        return BudgetRecord(self.registrar.directory / "budgets.json", configured)

    @functools.cached_property
    def _books(self) -> dict[str, _Book]:
        """The books; at first of what the catalog has: a callback that runs again after a crash needs all of it."""
        books = {name: self._new_book(pool) for name, pool in self._pools.items()}
        for info in self.registrar.resources():
            if info.phase not in _HELD or info.server not in _REQUESTS:
                continue
            request = msgspec.convert(info.request, _REQUESTS[info.server])  # a dict until its server is there again
            book = books.get(request.pool)
            if book is None:
                continue
            if info.server == "supply":
                book.supplies[info.id] = request.amount
                continue
            book.shares[info.id], book.since[info.id] = request.amount, float(len(book.shares))
            if info.status is State.FATAL:
                book.leaving.add(info.id)
        return books

    def _new_book(self, pool: Pool) -> _Book:
        measured = math.inf if pool.measure is None else self._record.measured(pool.name)
        return _Book(pool, self._record.capacity(pool.name, pool.capacity), measured)


def _name(infos: dict[str, ResourceInfo], id: str) -> str:
    """Return what a share is for, with its priority, for people."""
    if (info := infos.get(id)) is None:
        return f"share {short_id(id)}"
    share = msgspec.convert(info.request, Share)
    name = share.whose or share.instance or ", ".join(dict.fromkeys(info.holders)) or "nobody"
    return f"{name} ({'standby' if info.priority is None else f'priority {info.priority}'})"


def _is_above(infos: dict[str, ResourceInfo], one: str, other: str) -> bool:
    """Return whether a share has a higher priority than another."""
    upper = infos[one].priority if one in infos else None
    lower = infos[other].priority
    return upper is not None and (lower is None or upper > lower)


def _check_request(value: float, field: str) -> None:
    if not is_number(value) or value < 0:
        expected = "a number of at least 0"
        raise UsageError(f"{field}: expected {expected}, got {shown(value)}", field=field, expected=expected, got=value)
