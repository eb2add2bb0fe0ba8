"""Trials: the thread that loads alternatives on trial, and says when one has been well for long enough."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterable, Mapping

from msgspec.structs import replace

from rr_actors.base.errors import RegistrarDown, RrError
from rr_actors.base.reporting.log import Log
from rr_actors.managers.choices.planning import UNKNOWN, Choice, Plan, Standing, failed, plan
from rr_actors.managers.planning.blame import is_own_failure, is_own_fault
from rr_actors.managers.planning.retries import Retries
from rr_actors.managers.planning.searches import release_soon
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query, Status, StatusCallback

logger = Log("rr_actors.managers.choices")

_LOOK_S = 1.0  # no server says to Choices that it comes

FAILED = (State.ERROR, State.FATAL)


class Trials:
    """What is known of each alternative by its key, and the trials that run. From any thread."""

    def __init__(
        self,
        changed: threading.Condition,
        settle_s: float,
        choices: Callable[[], Mapping[str, Choice]],
        load: Callable[[str, StatusCallback], Query],
        take: Callable[[str, str], None],
        has_news: Callable[[], bool],
        strays: Callable[[], Iterable[Query]],
    ) -> None:
        """Begin with start().

        Args:
            changed: guards what `choices` returns; its lock may be taken again by the thread that has it.
            choices: returns the choices as they are. With the lock.
            load: loads an alternative, not as a part of anything. Without the lock.
            take: has a choice take an alternative. Without the lock.
            has_news: returns whether alternatives may have come or gone. It is asked once a second. With the lock.
            strays: returns what the trials of the process before have left. A provider that is away says only later
                that it has one, so this is asked at the start, and once a second. With the lock.
        """
        self._changed = changed
        self._settle_s = settle_s
        self._choices, self._load, self._take, self._has_news, self._strays = choices, load, take, has_news, strays
        self._standings: dict[str, Standing] = {}
        self._queries: dict[str, Query] = {}
        self.retries = Retries[str]()
        self._counted: dict[str, str] = {}  # the last failure of each that is not used again
        self._is_new = False
        self._is_stopped = False

    def start(self) -> None:
        """Release the strays, and start the thread."""
        with self._changed:
            self._release_strays()
        threading.Thread(target=self._run, name="choices", daemon=True).start()

    def stop(self) -> None:
        """End the thread, soon."""
        with self._changed:
            self._is_stopped = True
            self.retries.stop()
            self._changed.notify_all()

    def look(self) -> None:
        """Plan again: something has changed."""
        with self._changed:
            self._is_new = True
            self._changed.notify_all()

    def standings(self) -> dict[str, Standing]:
        """Return what is known of the alternatives that have failed or are on trial."""
        with self._changed:
            return dict(self._standings)

    def well_beside(self, id: str) -> set[str]:
        """Return what is loaded and has not failed, on trial or for another choice than this one. With the lock."""
        now = time.monotonic()
        used = {choice.present for other, choice in self._choices().items() if other != id and not choice.failing}
        rested = {key for key in used if self._standings.get(key, UNKNOWN).retry_at <= now}
        return rested | self._queries.keys()

    def used(self, key: str) -> None:
        """Note that a choice uses an alternative from now on. What it says after that is another failure."""
        with self._changed:
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
        with self._changed:
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

    # -- the thread ------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        while True:
            with self._changed:
                if self._is_stopped:
                    return
                self._is_new = False
                now = time.monotonic()
                made = plan(self._choices(), self._standings, now, self._settle_s)
                self._begin(made)
            for id, key in made.take.items():
                self._take(id, key)
            self._wait(made.look_at)

    def _wait(self, until: float | None) -> None:
        """Wait until something has happened or is due."""
        with self._changed:
            while not (self._is_new or self._is_stopped):
                left_s = _LOOK_S if until is None else min(_LOOK_S, until - time.monotonic())
                if left_s <= 0:
                    return
                if not self._changed.wait(left_s):
                    self._release_strays()
                    if self._has_news():
                        return

    def _release_strays(self) -> None:
        with contextlib.suppress(RegistrarDown):  # it has just been stopped
            for query in self._strays():
                release_soon(query)

    def _begin(self, made: Plan) -> None:
        for key in made.load:
            self._standings[key] = replace(self._standings.get(key, UNKNOWN), trial="loading")
            self._in_thread(lambda key=key: self._try(key))
        for key in made.end:
            self._standings[key] = replace(self._standings[key], trial="")
            self._end(key)

    def _end(self, key: str) -> None:
        query = self._queries.pop(key, None)
        if query is not None:
            release_soon(query)

    def _try(self, key: str) -> None:
        """Load an alternative on trial, and note how that ended."""
        try:
            query = self._load(key, self._heard)
        except RrError as error:
            logger.info("%s cannot be loaded again yet: %s", key, error)
            with self._changed:
                self._standings[key] = replace(self._standings[key], trial="")
                self.failed(key, is_own=is_own_fault(error))
            return
        with self._changed:
            self._queries[key] = query
            self._counted.pop(key, None)
            self._standings[key] = replace(self._standings[key], trial="loaded", well_since=time.monotonic())
            if query.state in FAILED or query.released:  # the status came before the query was known
                self._failed_on_trial(key, query.resource_id)
            self.look()

    def _heard(self, status: Status) -> None:
        """End a trial that fails. On the query's own callback."""
        if status.state not in FAILED:
            return
        with self._changed:
            for key, query in self._queries.items():
                if query.id == status.query_id:
                    self._failed_on_trial(key, status.resource_id, is_own=is_own_failure(status))
                    return

    def _failed_on_trial(self, key: str, failure_id: str, *, is_own: bool = True) -> None:
        self.failed(key, failure_id, is_own=is_own)
        self._standings[key] = replace(self._standings[key], trial="")
        self._end(key)

    def _in_thread(self, do: Callable[[], None]) -> None:
        def run() -> None:
            try:
                do()
            except RrError as error:
                logger.info("choices: a trial ended early: %s", error)

        threading.Thread(target=run, name="choices-trial", daemon=True).start()
