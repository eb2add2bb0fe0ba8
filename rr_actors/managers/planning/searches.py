"""Searches: a callback looks for the first of some candidates that can be had, and its holders hear if that takes long.

A replacement loads each candidate beside the part, as no part of anything: a second part could not be told from the
first. Then `replace_part` joins what is loaded, in one commit. What a crash leaves of such loads belongs to nothing,
and the next process releases it. What people have loaded by hand with the same registrar stays theirs.
"""

from __future__ import annotations

import contextlib
import contextvars
import itertools
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from itertools import groupby
from typing import Any, Generic, NamedTuple, NoReturn, TypeVar, cast

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base.errors import LoadFailed, RegistrarDown, RrError, Unavailable, UnknownQuery
from rr_actors.base.names import is_planned, parse_server
from rr_actors.base.reporting.log import Log
from rr_actors.base.scarcity import wanted_by
from rr_actors.managers.planning.hedging import HEDGE_S, first_of
from rr_actors.managers.planning.retries import GIVEN_UP, Retries
from rr_actors.managers.planning.setbacks import BACKOFF
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query, Status
from rr_actors.registrar.registrar import Registrar, begin_planned
from rr_actors.registrar.servers.callback_context import current

logger = Log("rr_actors.managers")

C = TypeVar("C")
K = TypeVar("K")
R = TypeVar("R")
T = TypeVar("T")

_LOOK_S = 0.01  # between two looks at whether a registrar is closed


class CandidateLoad(NamedTuple):
    """What is loaded for a candidate."""

    server: str
    request: Any
    timeout_s: float


class Search(Generic[C]):
    """One search of the callback that makes it. In a status callback use it within `telling()`.

    Attributes:
        id: of the resource whose callback runs.
        tried: why each candidate before could not be had.
        wanted: what the machine had no more of for a candidate of this pass, "ENOSPC: ..."; "": it had all.
        decided_at: when it was decided what to load, by the monotonic clock.
    """

    def __init__(
        self,
        registrar: Registrar,
        retries: Retries[K],
        key: Callable[[C], K],
        name: Callable[[C], str],
        text: Callable[[str], str] = str,
    ) -> None:
        """`key` and `name` are a candidate's for `retries` and for people; `text` completes what the holders hear."""
        self._registrar, self._name, self._text = registrar, name, text
        self._wait_s: Callable[[C], float | None] = lambda one: retries.wait_s(key(one))
        self._rest: Callable[[C], float | None] = lambda one: retries.rest(key(one), name(one), self.say)
        self._pause = retries.pause
        self.id = current().resource_id
        self.tried: list[str] = []
        self.wanted = ""
        self.decided_at = time.monotonic()
        self._lock = threading.Lock()
        self._is_over = self._has_said = False

    # -- the holders -----------------------------------------------------------------------------------------------

    @contextlib.contextmanager
    def telling(self, after_s: float, what: str) -> Generator[None]:
        """Tell the holders `what` with WARNING if nothing is found, or said, within so many seconds.

        Say nothing after that.
        """

        def tell() -> None:
            if not self._has_said:
                self.say(what)

        late = threading.Timer(after_s, contextvars.copy_context().run, (tell,))  # a part of this callback
        late.daemon = True
        late.start()
        try:
            yield
        finally:
            late.cancel()
            with self._lock:
                self._is_over = True

    def say(self, what: str) -> None:
        """Tell the holders WARNING while nothing is found."""
        with self._lock, contextlib.suppress(RrError):  # it is being unloaded
            if not self._is_over:
                self._has_said = True
                self._registrar.send_status(self.id, Status(State.WARNING, self._text(what)))

    # -- trying ----------------------------------------------------------------------------------------------------

    def first(
        self,
        in_turn: Iterable[C],
        begin: Callable[[C], Reply[Query]],
        take: Callable[[C, Query], T],
        failed: Callable[[C, Exception], object],
        *,
        check: Callable[[], object] = lambda: None,
        hedge_s: float = HEDGE_S,
    ) -> T | None:
        """Return what `take` makes of the first candidate that can be had; None if there is none.

        The next candidate is tried beside one that hangs. One that has failed again and again rests before it is tried,
        and is given up after some tries.

        Args:
            begin: begins to load a candidate, as_part() or beside().
            take: uses what is loaded. If it raises, the candidate has failed.
            failed: called with a candidate that cannot be had, and why. What it raises ends the search.
            check: called when one has failed, and each time that nothing has answered for `hedge_s`. What it raises
                ends the search.
            hedge_s: after so many seconds the next candidate is tried beside one that hangs.

        Raises:
            UnknownQuery: `take` says that the resource is being unloaded.
        """

        def begin_rested(one: C) -> Reply[Query]:
            waited_s = self._rest(one)
            if waited_s is None:
                raise _GivenUp(GIVEN_UP)
            if waited_s:
                self.decided_at = time.monotonic()
            return begin(one)

        def note(one: C, error: Exception) -> None:
            check()
            self.tried.append(f"{self._name(one)}: {error}")
            self.wanted = self.wanted or wanted_by(error)
            if not isinstance(error, _GivenUp):
                failed(one, error)

        def note_beside(one: C, error: Exception) -> None:
            logger.info("%s is tried again if all else fails: %s", self._name(one), error)
            check()

        untried = iter(in_turn)
        while True:
            won = first_of(
                untried,
                begin_rested,
                release=release_soon,
                on_failed=note,
                on_failed_beside=note_beside,
                on_slow=lambda _: check(),
                rest_s=lambda one: self._wait_s(one) or 0.0,
                hedge_s=hedge_s,
            )
            if won is None:
                return None
            try:
                with self._lock:  # a WARNING comes before the UPDATE, or not at all
                    taken = take(won.candidate, won.value)
                    self._is_over = True
            except RrError as error:
                release_soon(won.value)
                if isinstance(error, UnknownQuery):
                    raise
                note(won.candidate, error)
            else:
                return taken

    def until_had(self, search: Callable[[], T | None]) -> T | None:
        """Return what one pass over the candidates finds. While the machine has no more of what one needs, pass again.

        The holders hear WARNING, and each pass waits longer. A pass that finds nothing while the manager stops decides
        nothing.

        Raises:
            UnknownQuery: the resource is being unloaded.
            RegistrarDown: the manager has stopped. The next process hears the status again.
        """
        before, said = list(self.tried), ""
        for count in itertools.count():
            self.wanted = ""
            found = search()
            if found is not None:
                return found
            if self.wanted and said != self.wanted:
                said = self.wanted
                self.say(f"no other one can be started now, and that is tried again: {said}")
            if not self._pause(BACKOFF.delay(count, 0.0) if self.wanted else 0.0):
                self._await_close()
            if not self.wanted:
                return None
            self.check_wanted()
            self.tried[:] = before
        return None

    def _await_close(self) -> NoReturn:
        """Wait until the registrar is closed: until then what the callback returns would be committed.

        Raises:
            UnknownQuery, RegistrarDown: as check_wanted().
        """
        while True:
            self.check_wanted()
            time.sleep(_LOOK_S)

    def as_part(self, load: CandidateLoad) -> Reply[Query]:
        """Begin to load a part of the resource whose callback runs."""
        reply = self._registrar.load(load.server, load.request, timeout_s=load.timeout_s, block=False)
        return cast("Reply[Query]", reply)

    def beside(self, load: CandidateLoad) -> Reply[Query]:
        """Begin to load as no part of anything, as urgently as the resource is needed."""
        priority = next((info.priority for info in self._registrar.resources() if info.id == self.id), None)
        return begin_planned(self._registrar, load.server, load.request, timeout_s=load.timeout_s, priority=priority)

    def swap(self, status: Status, part: Query | None, load: CandidateLoad, response: Callable[[Query], R]) -> R:
        """Put what is loaded beside in the place of the part; return the new response."""
        spare = self._registrar.replace_part(
            status, load.request, load.server, part=part, response=response, timeout_s=load.timeout_s
        )
        return response(spare)

    def check_wanted(self) -> None:
        """Check that the resource is still served.

        Raises:
            UnknownQuery: it is being unloaded.
            RegistrarDown: this process stops. The next one hears the status again.
        """
        self._registrar.children(self.id)


class _GivenUp(LoadFailed):
    """It has failed too often to be tried again."""


def groups(in_turn: Sequence[C], is_alone: Callable[[C], bool]) -> Iterator[Sequence[C]]:
    """Yield the candidates in turn, in groups of those that may be tried beside each other."""
    numbered = enumerate(in_turn, 1)
    for _, group in groupby(numbered, key=lambda one: one[0] if is_alone(one[1]) else 0):
        yield [one for _, one in group]


def release(query: Query) -> None:
    """Release a query, and wait for its provider. If that refuses, the log says so: its holder releases it later."""
    try:
        query.unload_if_held()
    except RrError as error:
        logger.info("%s cannot be released now: %s", query.server_id, error)


def release_soon(query: Query) -> None:
    """Release a query as release() does, in a thread of its own."""
    threading.Thread(target=release, args=(query,), name="release", daemon=True).start()


def release_strays(registrar: Registrar, server: str, begun: str) -> None:
    """Release what the process before has loaded itself of a server, beside parts, in a thread of its own.

    Its provider may know more of that than the catalog here, so the thread waits for it.

    Args:
        begun: an id that this process made before it loaded anything: ids grow with the time.
    """
    provider = parse_server(server).registrar

    def release_all() -> None:
        with contextlib.suppress(RrError):  # nothing is held there, or this process stops
            _agree(registrar, provider)
            for query in strays(registrar, begun):
                if query.server_id == server:
                    query.unload_if_held()

    threading.Thread(target=release_all, name="strays", daemon=True).start()


def _agree(registrar: Registrar, provider: str) -> None:
    """Wait until the catalog here and the provider's have agreed on what is held there."""
    while True:
        try:
            registrar.fetch_queries(provider)
        except RegistrarDown:
            raise
        except Unavailable:  # it is away for long
            time.sleep(HEDGE_S)
        else:
            return


def strays(registrar: Registrar, begun: str) -> list[Query]:
    """Return what a process before this one has loaded itself, by begin_planned(), and is held still."""
    return [query for query in registrar.queries() if is_planned(query.id) and query.id < begun]
