"""Trials: the planning of a Choices manager, which loads alternatives on trial and says which to return to."""

from __future__ import annotations

import functools
import math
import threading
import time
from collections.abc import Callable, Iterable, Mapping

from msgspec.structs import replace

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base.reporting.log import Log
from rr_actors.managers.choices.planning import UNKNOWN, ChoiceState, Plan, Standing, failed, plan
from rr_actors.managers.planning.blame import is_own_failure, is_own_fault
from rr_actors.managers.planning.planning_loop import PlanningLoop, StepEnded
from rr_actors.managers.planning.retries import Retries
from rr_actors.managers.planning.searches import release_soon
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query, Status, StatusCallback

logger = Log("rr_actors.managers.choices")

_LOOK_S = 1.0  # no server says to Choices that it comes

_NOTHING = Plan((), (), {}, None)

FAILED = (State.ERROR, State.FATAL)


class Trials:
    """What is known of each alternative by its key, and the trials that run. From any thread."""

    def __init__(
        self,
        lock: threading.RLock,
        settle_s: float,
        choices: Callable[[], Mapping[str, ChoiceState]],
        load: Callable[[str, StatusCallback], Reply[Query]],
        take: Callable[[str, str], None],
        has_news: Callable[[], bool],
        strays: Callable[[], Iterable[Query]],
        fail: Callable[[BaseException], object],
    ) -> None:
        """Begin with start().

        Args:
            lock: guards what `choices` returns.
            choices: returns the choices as they are. With the lock.
            load: begins to load an alternative, not as a part of anything. Without the lock.
            take: has a choice take an alternative. Without the lock.
            has_news: returns whether alternatives may have come or gone. It is asked once a second. With the lock.
            strays: returns what the trials of the process before have left. A provider that is away says only later
                that it has one, so this is asked at the start, and once a second. Without the lock.
            fail: makes the manager fail, as PlanningLoop says.
        """
        self._lock = lock
        self._settle_s = settle_s
        self._choices, self._load, self._take, self._has_news, self._strays = choices, load, take, has_news, strays
        self._standings: dict[str, Standing] = {}
        self._queries: dict[str, Query] = {}
        self.retries = Retries[str]()
        self._counted: dict[str, str] = {}  # the last failure of each that is not used again
        self._is_new = True
        self._due_at = self._strays_at = 0.0
        self._loop: PlanningLoop[str, None] = PlanningLoop("choices", self._look, fail)

    def start(self) -> None:
        """Begin to plan."""
        self._loop.start()

    def stop(self) -> None:
        """Plan no more."""
        self.retries.stop()
        self._loop.stop()

    def look(self) -> None:
        """Plan again: something has changed."""
        self._is_new = True
        self._loop.wake()

    def standings(self) -> dict[str, Standing]:
        """Return what is known of the alternatives that have failed or are on trial."""
        with self._lock:
            return dict(self._standings)

    def well_beside(self, id: str) -> set[str]:
        """Return what is loaded and has not failed, on trial or for another choice than this one. With the lock."""
        now = time.monotonic()
        used = {choice.present for other, choice in self._choices().items() if other != id and not choice.failing}
        rested = {key for key in used if self._standings.get(key, UNKNOWN).retry_at <= now}
        return rested | self._queries.keys()

    def used(self, key: str) -> None:
        """Note that a choice uses an alternative from now on. What it says after that is another failure."""
        with self._lock:
            self.retries.used(key)
            self._counted.pop(key, None)

    def failed(self, key: str, failure_id: str = "", *, began: float | None = None, is_own: bool = True) -> bool:
        """Note that an alternative has failed. Its trial ends.

        Args:
            failure_id: several choices may hear of one failure; it counts once.
            began: when the load that failed was begun. One that others began before the last failure is the same load.
            is_own: whether the alternative itself is to blame.

        Returns:
            Whether it counts.
        """
        with self._lock:
            now, standing = time.monotonic(), self._standings.get(key, UNKNOWN)
            if began is not None and began <= (standing.failed_at or -1.0):
                return False
            if failure_id:
                if self._counted.get(key) == failure_id:
                    return False
                self._counted[key] = failure_id
            self._standings[key] = failed(standing, now, self._settle_s)
            if is_own:
                self.retries.failed(key)
            self._end(key)
            self.look()
            return True

    # -- the loop --------------------------------------------------------------------------------------------------

    def _look(self, now: float) -> float:
        if now >= self._strays_at:
            self._strays_at = now + _LOOK_S
            for query in self._strays():
                release_soon(query)
        made = self._planned(now)
        for key in made.load:
            start = functools.partial(self._load, key, self._heard)
            self._loop.begin(key, None, start, functools.partial(self._tried, key))
        for id, key in made.take.items():
            self._take(id, key)
        return min(now + _LOOK_S, self._due_at)

    def _planned(self, now: float) -> Plan:
        """Return what to begin now, which is noted; nothing if nothing has happened and nothing is due."""
        with self._lock:
            if not (self._is_new or now >= self._due_at or self._has_news()):
                return _NOTHING
            self._is_new = False
            made = plan(self._choices(), self._standings, now, self._settle_s)
            self._due_at = math.inf if made.look_at is None else made.look_at
            for key in made.load:
                self._standings[key] = replace(self._standings.get(key, UNKNOWN), trial="loading")
            for key in made.end:
                self._standings[key] = replace(self._standings[key], trial="")
                self._end(key)
            return made

    def _end(self, key: str) -> None:
        query = self._queries.pop(key, None)
        if query is not None:
            release_soon(query)

    def _tried(self, key: str, load: StepEnded) -> None:
        """Note how the load of an alternative on trial has ended."""
        with self._lock:
            if load.error is not None:
                logger.info("%s cannot be loaded again yet: %s", key, load.error)
                self._standings[key] = replace(self._standings[key], trial="")
                self.failed(key, is_own=is_own_fault(load.error))
                return
            query: Query = load.value
            self._queries[key] = query
            self._counted.pop(key, None)
            self._standings[key] = replace(self._standings[key], trial="loaded", well_since=time.monotonic())
            if query.state in FAILED or query.released:  # the status came before the query was known
                self._failed_on_trial(key, query.resource_id)
            self._is_new = True

    def _heard(self, status: Status) -> None:
        """End a trial that fails. On the query's own callback."""
        if status.state not in FAILED:
            return
        with self._lock:
            for key, query in self._queries.items():
                if query.id == status.query_id:
                    self._failed_on_trial(key, status.resource_id, is_own=is_own_failure(status))
                    return

    def _failed_on_trial(self, key: str, failure_id: str, *, is_own: bool = True) -> None:
        self.failed(key, failure_id, is_own=is_own)
        self._standings[key] = replace(self._standings[key], trial="")
        self._end(key)
