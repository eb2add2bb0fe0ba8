"""StreamReader: the consumer's end of a stream."""

from __future__ import annotations

import asyncio
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterable
from typing import NamedTuple, NoReturn, Self

import msgspec

from rr_actors.base.errors import NotFound, RrError, Unavailable, UsageError, did_you_mean, few, shown
from rr_actors.streams.publisher_link import PublisherLink
from rr_actors.streams.stream import Keep, Place, Stream, StreamFrame
from rr_actors.streams.stream_sockets import MOST_DEPTH, OPENED_ONCE, Hello, check_process, known_streams
from rr_actors.streams.wake import Wake

_AGAIN_S = 0.01  # a reader tries as often to connect to a manager that is being respawned,
_AGAIN_PART = 1 / 20  # or waits for this part of the time that has passed,
_AGAIN_MOST_S = 0.25  # at most so long
_OPENS_S = 30.0  # how long a resource may have no stream at all, as long as a load may take
_NEWER_S = 0.02  # so long it waits for a newer frame than one that has arrived before it asked


class Source(NamedTuple):
    """What a reader asks its query.

    Attributes:
        registrar: the one that holds the query.
        is_over: whether the query is released; raises ResourceLost.
        named: returns the streams that the response names, with their places.
        watch: has a Wake set for each status, and at the end.
        unwatch: ends that.
        has_all: whether nobody would open another stream of the resource when it was first called, or later. It is
            called after a look at the streams that there are, and does not wait: it returns False until it knows.
    """

    resource_id: str
    registrar: str
    is_over: Callable[[], bool]
    named: Callable[[], Iterable[tuple[Place, Stream]]]
    watch: Callable[[Wake], None]
    unwatch: Callable[[Wake], None]
    has_all: Callable[[], bool]


class _Wait(NamedTuple):
    """How long to wait for something to read, or for the query; None: no limit."""

    seconds: float | None


class _Found(NamedTuple):
    """A frame, and the link that it came on."""

    frame: StreamFrame
    link: PublisherLink


class StreamReader:
    """The consumer's end of a stream: an iterator, an async iterator and a context manager of its frames.

    The iteration ends when the query is released, and raises ResourceLost when the resource is lost. While the manager
    is respawned it waits for the stream to be opened again. If a new response names another stream, it goes on with
    that. Errors of one frame, such as a class that cannot be imported here, and TimeoutError end nothing.

    One thread or task at a time reads it, or several that take turns.

    Raises:
        UsageError: an argument is not what Query.stream() says; or no name is given, and there are several streams.
        NotFound: the resource has streams, and none of this name. `.id`, `.known`
        Unavailable: there is no descriptor for it.
    """

    _is_watching = False

    def __init__(
        self, source: Source, chosen: str | Stream | None, keep: Keep, depth: int, timeout_s: float | None
    ) -> None:
        name = chosen.name if isinstance(chosen, Stream) else chosen
        what = "stream" if name is None else f"stream {name!r}"
        if keep not in ("latest", "all"):
            raise UsageError(f"{what}: keep: expected 'latest' or 'all', got {shown(keep)}")
        if type(depth) is not int or not 1 <= depth <= MOST_DEPTH:
            raise UsageError(f"{what}: depth: expected 1 to {MOST_DEPTH}, got {shown(depth)}")
        self._pid = os.getpid()
        self._source = source
        self._chosen = chosen
        self._name = name
        self._place: Place | None = None  # of the chosen stream in the response
        self._what = what
        self._hello = Hello(keep, depth, source.registrar)
        self._timeout_s = timeout_s
        self._stream: Stream | None = None
        self._before: Stream | None = None  # which it read until now
        self._link: PublisherLink | None = None
        self._last: int | None = None  # the number of the last frame of this stream
        self._opened_at = 0.0  # when its last publisher had opened it
        self._publisher = 0  # the process of the last publisher of this stream
        self._apart_at: float | None = time.monotonic()  # since when it has no publisher
        self._is_once = False  # nobody opens the stream again
        self._is_unbound = True
        self._is_closed = False
        self._is_over = False  # the query is released
        self._end: RrError | None = None
        self._is_told = False  # that it is closed
        self._looking = threading.Lock()  # for short: no thread waits with it
        self._thread = 0  # the thread that has it
        self._turns: weakref.WeakKeyDictionary[asyncio.AbstractEventLoop, asyncio.Lock] = weakref.WeakKeyDictionary()
        try:
            self._wake = Wake()
        except OSError as error:
            raise Unavailable(f"{what} cannot be read: {error}") from error
        self._is_watching = True
        source.watch(self._wake)
        try:
            self._bind()
            self._connect()
            if self._link is None:
                self._check_known()
        except BaseException:
            self.close()
            raise

    def _reads(self) -> Stream | None:
        """Return the stream that is read now; None: the resource has none yet."""
        return self._stream

    # -- the iteration -------------------------------------------------------------------------------------------------

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> StreamFrame:
        wake, began = self._begin(), time.monotonic()
        try:
            found = self._look(began, is_first=True)
            while isinstance(found, _Wait):
                wake.wait(self._links(), found.seconds)
                found = self._look(began)
        except BaseException:
            self._leave()
            raise
        if found is None:
            raise StopIteration
        found.link.is_taken, found.link.claim = True, None  # no call stands between this and the end
        return found.frame

    def __aiter__(self) -> Self:
        return self

    async def __anext__(self) -> StreamFrame:
        wake = self._begin()
        async with self._turns.setdefault(asyncio.get_running_loop(), asyncio.Lock()):  # a loop waits for a socket once
            began = time.monotonic()
            try:
                found = self._look(began, is_first=True)
                while isinstance(found, _Wait):
                    await wake.wait_async(self._links(), found.seconds)
                    found = self._look(began)
            except BaseException:
                self._leave()
                raise
        if found is None:
            raise StopAsyncIteration
        found.link.is_taken, found.link.claim = True, None  # no call stands between this and the end
        return found.frame

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._is_told = True
        self.close()

    def __del__(self) -> None:
        if self._is_watching and os.getpid() == self._pid:
            self._release()

    def close(self) -> None:
        """End the iteration, from any thread. A loop that runs ends; another call of next() raises UsageError.

        Raises:
            UsageError: this process is a child of the one that has the reader.
        """
        check_process(self._pid, self._what)
        self._is_closed = True
        if self._thread != threading.get_ident():  # else this is a finalizer within a look, which ends it
            with self._looking:
                self._release()

    def _begin(self) -> Wake:
        """Begin a call; return what wakes it."""
        check_process(self._pid, self._what)
        if self._is_closed and self._is_told:
            raise UsageError(f"{self._what}: the reader is closed: call stream() of the query again")
        return self._wake

    def _leave(self) -> None:
        """Have the publisher know that nobody waits for a frame any more."""
        if self._thread != threading.get_ident():
            with self._looking:
                if self._link is not None:
                    self._link.leave()

    def _links(self) -> tuple[PublisherLink, ...]:
        """Return what to wait for. It stays open while somebody has it, also if another thread closes the reader."""
        link = self._link
        return () if link is None or not link.is_open else (link,)

    def _release(self) -> None:
        """Give everything back, and wake all that wait."""
        self._part()
        self._source.unwatch(self._wake)
        self._wake.set()

    # -- a look: with the lock -----------------------------------------------------------------------------------------

    def _look(self, began: float, *, is_first: bool = False) -> _Found | _Wait | None:
        """Return a frame, or how long to wait for one; None: there will be none. It does not wait."""
        me = threading.get_ident()
        if self._thread == me:
            raise UsageError(f"{self._what}: this thread reads it already: next() in a signal handler or a finalizer")
        with self._looking:
            self._thread = me
            try:
                if is_first and self._link is not None:
                    self._link.begin()
                return self._looked(began)
            finally:
                self._thread = 0
                if self._is_closed:
                    self._release()

    def _looked(self, began: float) -> _Found | _Wait | None:
        if self._has_ended():
            return None
        self._bind_if_told()
        now = time.monotonic()
        for _ in range(2):  # once more if the publisher has ended
            self._connect(now)
            if (link := self._link) is None:
                break
            if (until := link.looks_until(now)) is not None:
                return _Wait(max(0.0, until - now))
            link.ask()
            if (frame := link.take()) is not None:
                return _Found(frame, link)
            if link.is_open:
                break
            self._part()
        left_s = None if self._timeout_s is None else began + self._timeout_s - now
        if left_s is not None and left_s <= 0:
            raise TimeoutError(f"{self._what}: no frame within {self._timeout_s:g} s{self._why()}")
        if self._link is not None:
            return _Wait(left_s)
        self._check_known(now)
        apart_s = now - (self._apart_at or now)
        again_s = min(_AGAIN_MOST_S, max(_AGAIN_S, apart_s * _AGAIN_PART))
        return _Wait(again_s if left_s is None else min(again_s, left_s))

    def _bind_if_told(self) -> None:
        was, self._is_unbound = self._is_unbound, True  # also if a signal handler raises meanwhile
        if not self._wake.take() and not was:
            self._is_unbound = False
        if self._is_unbound or self._stream is None:  # nothing tells it that a stream is opened
            self._bind()
            self._is_unbound = False

    def _has_ended(self) -> bool:
        """Return whether there will be no frame; raise the error that the iteration has ended with."""
        if self._end is None and not self._is_over:
            try:
                self._is_over = self._source.is_over()
            except RrError as error:
                self._end = error
        if self._end is not None:
            self._release()
            raise self._end.with_traceback(None)
        if self._is_over or self._is_closed:
            self._is_told = self._is_told or self._is_closed
            self._release()
            return True
        return False

    def _why(self) -> str:
        """Return what is known of why there is no frame."""
        link = self._link
        if link is not None:
            return f": {link.note}" if link.note else ""
        return f": its publisher has ended, and {OPENED_ONCE}" if self._is_once else ""

    def _bind(self) -> None:
        """Find the stream that is meant now: one that the response names, or one of the resource's own."""
        stream = self._meant()
        if stream != self._stream:
            self._part()
            if self._publisher:
                self._before = self._stream
            self._stream, self._last, self._opened_at = stream, None, 0.0
            self._publisher, self._is_once = 0, False
            self._apart_at = time.monotonic()

    def _meant(self) -> Stream | None:
        own, named = self._source.resource_id, dict(self._source.named())
        if isinstance(self._chosen, Stream):
            return self._meant_in(named, self._chosen)
        if self._name is not None:
            there = list(dict.fromkeys(stream for stream in named.values() if stream.name == self._name))
            if len(there) > 1:
                raise UsageError(
                    f"resource {own} has {len(there)} streams {self._name!r}: give the rr.Stream of the response"
                )
            return there[0] if there else Stream(own, self._name)
        there = list(dict.fromkeys(named.values())) or [
            Stream(own, name) for name, is_open in known_streams(own).items() if is_open
        ]
        if len(there) > 1:
            names = few(map(repr, sorted(stream.name for stream in there)))
            raise UsageError(f"resource {own} has several streams: give the name of one, of {names}")
        return there[0] if there else self._stream

    def _meant_in(self, named: dict[Place, Stream], chosen: Stream) -> Stream:
        """Return the stream that has the place now that the chosen one had in the response."""
        if self._place is None:
            self._place = next((place for place, stream in named.items() if stream == chosen), None)
        if self._place is not None:
            return named.get(self._place, self._stream or chosen)
        if chosen.resource_id != self._source.resource_id:
            raise UsageError(f"{self._what}: neither the resource nor its response has {chosen}")
        return chosen

    def _check_known(self, now: float | None = None) -> None:
        """Raise an error if there is no hope: nobody opens it any more, or nobody has opened it for long."""
        apart_s = 0.0 if now is None or self._apart_at is None else now - self._apart_at
        if self._publisher:
            if self._is_once and apart_s > _OPENS_S:
                self._is_over_with(Unavailable(f"{self._what}: its publisher has ended, and {OPENED_ONCE}"))
            return
        own = self._source.resource_id
        resource_id = own if self._stream is None else self._stream.resource_id
        known = known_streams(resource_id)
        name = None if self._stream is None else self._stream.name
        if name in known or (name is None and any(known.values())):  # one was opened after the look: the next finds it
            return
        # It asks after it has looked: a manager that runs then, and has run since the load, ran at the look, too.
        if any(known.values()) or apart_s > _OPENS_S or (resource_id == own and self._source.has_all()):
            names = few(map(repr, sorted(known))) or "none"
            text = f"resource {resource_id} has no {self._what}; there are: {names}"
            self._is_over_with(NotFound(text + did_you_mean(name, known), id=name or "", known=tuple(sorted(known))))

    def _is_over_with(self, error: RrError) -> NoReturn:
        self._end = error
        raise error

    def _connect(self, now: float | None = None) -> None:
        """Connect to the publisher, if it is there."""
        if self._stream is None or self._link is not None:
            return
        try:
            hello = msgspec.structs.replace(self._hello, before=self._before)
            link = PublisherLink(self._stream, hello, self._last, self._opened_at)
        except OSError:
            return
        is_new = self._publisher and link.pid != self._publisher
        self._is_once = self._is_once and not is_new
        self._link, self._before, self._publisher, self._apart_at = link, None, link.pid, None

    def _part(self) -> None:
        """Have no publisher any more."""
        link, self._link = self._link, None
        if link is not None:
            link.settle()
            self._last, self._opened_at = link.last, link.opened_at
            self._is_once = self._is_once or link.opened_once  # else one that a dying publisher did not take in
            self._apart_at = time.monotonic()
            link.close()


stream_of = StreamReader._reads  # pyright: ignore[reportPrivateUsage]  # same file
