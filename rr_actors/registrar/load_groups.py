"""Groups of loads: either all of a group are held, or none is; and the queries that a group results in.

All loads of a group begin at once. When one fails, the held ones are released, and the others are withdrawn. Then the
caller gets the first error.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import itertools
from collections.abc import Callable, Generator, Iterable, Sequence
from typing import Any, NamedTuple, Protocol, Self, cast

from rr_actors.actors.messaging.futures import Reply, fail
from rr_actors.base.errors import RrError, Unavailable, UnknownQuery, UsageError, shown
from rr_actors.base.names import ServerId
from rr_actors.base.values.canonical import encode
from rr_actors.registrar.arguments import LoadOptions
from rr_actors.registrar.loads import Loading, Loads, Unloads, with_notes
from rr_actors.registrar.queries import Query, begin_unload, patience_s, raise_or_note, unload_if_held_async
from rr_actors.runtime.event_loop import check_asyncio


class Queries(tuple[Query, ...]):
    """The queries of load_all(), in the order of the requests. As a context manager it unloads them at the end."""

    __slots__ = ()

    def unload(self, *, timeout_s: float | None = 30.0) -> None:
        """Release all queries that are still held, newest first, and return when that is done.

        Args:
            timeout_s: seconds to wait for a provider that is down. The queries after one whose provider is down are
                released all at once.

        Raises:
            RrError: the first error that Query.unload() raised, after all have been tried; the others are its notes.
        """
        errors: list[RrError] = []
        left = list(self)
        try:
            while left and not _is_late(errors):
                with _kept(errors):
                    left.pop().unload_if_held(timeout_s=timeout_s)
        finally:  # also if it is interrupted: the others go on by themselves
            begun = [begin_unload(query, timeout_s) for query in reversed(left)]
        for unloading in begun:
            with _kept(errors), contextlib.suppress(UnknownQuery):  # it is released meanwhile
                unloading.get()
        if errors:
            raise with_notes(errors)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        try:
            self.unload()
        except RrError as refusal:
            raise_or_note(refusal, error)

    async def __aenter__(self) -> Self:
        check_asyncio("async with Queries")
        return self

    async def __aexit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        errors: list[RrError] = []
        left, timeout_s = list(self), patience_s(error)
        try:
            while left and not _is_late(errors):
                with _kept(errors):
                    await unload_if_held_async(left.pop(), timeout_s)
        finally:  # also if it is cancelled: the others go on by themselves
            begun = [begin_unload(query, timeout_s) for query in reversed(left)]
        for unloading in begun:
            with _kept(errors), contextlib.suppress(UnknownQuery):  # it is released meanwhile
                await unloading
        if errors:
            raise_or_note(with_notes(errors), error)


@contextlib.contextmanager
def _kept(errors: list[RrError]) -> Generator[None]:
    try:
        yield
    except RrError as error:
        errors.append(error)


def _is_late(errors: Sequence[RrError]) -> bool:
    return any(isinstance(error, Unavailable) for error in errors)


class LoadWanted(NamedTuple):
    """One request of a group, checked and ready to be sent."""

    server: ServerId
    request: bytes
    shown: str


def wanted(
    requests: Iterable[tuple[str, Any]], target: Callable[[object], ServerId], encode: Callable[[Any], bytes] = encode
) -> list[LoadWanted]:
    """Return the requests of a group, checked and ready to be sent.

    Raises:
        UsageError, InvalidName, NotSerializable: one of them is no pair of a server and a request that can be sent.
    """
    found: list[LoadWanted] = []
    for number, pair in enumerate(iterated(requests), 1):
        if not isinstance(pair, (tuple, list)) or len(cast("tuple[Any, ...]", pair)) != 2:
            expected = 'expected a pair ("registrar/server", request)'
            raise UsageError(f"load_all: request {number}: {expected}, got {shown(cast('object', pair))}")
        server, request = cast("tuple[Any, Any]", pair)
        found.append(LoadWanted(target(server), encode(request), shown(request)))
    return found


def note_request(error: RrError, requests: Sequence[LoadWanted], place: int) -> None:
    """Note on the error of a load which request of the group it was."""
    server, _, request = requests[place]
    error.add_note(f"load_all: request {place + 1} of {len(requests)}, {server} with {request}")


def iterated(requests: Any) -> Iterable[Any]:
    """Return an iterator over the requests of a group.

    Raises:
        UsageError: they are not iterable.
    """
    try:
        return iter(requests)
    except TypeError:
        text = f'load_all: expected a list of pairs ("registrar/server", request), got {shown(requests)}'
        raise UsageError(text) from None


class GroupWays(Protocol):
    """The ways to load all of several requests, or none."""

    def wait(self) -> Queries:
        """Load all requests, and return their queries when all are held."""
        ...

    async def awaited(self) -> Queries:
        """Load all requests, awaited on any event loop. If it is cancelled, nothing stays held."""
        ...


class Group:
    """The loads of one load_all(): begin() begins them all, and returns the future of their queries.

    All changes to a group are made on the loop.
    """

    def __init__(
        self, loads: Loads, unloads: Unloads, requests: Sequence[LoadWanted], parent: str, options: LoadOptions
    ) -> None:
        self._loads = loads
        self._unloads = unloads
        self._requests = requests
        self._parent = parent
        self._options = options
        self._loadings: list[Loading] = []
        self._loaded = 0
        self._over = False
        self._reply: Reply[Queries] = Reply()

    def begin(self) -> Reply[Queries]:
        """Begin all loads, and return a future, which is set when all are held, or when one has failed.

        It has the error of the first load that failed. By then what was held is released.
        """
        calls = self._loads.calls
        calls.check_open()
        self._reply.withdraw = self._withdraw
        calls.dispatcher.call(self._begin)
        return self._reply

    def wait(self) -> Queries:
        """Load all requests, and return their queries when all are held.

        Raises:
            RrError: the error of the first load that failed; nothing is held.
        """
        self._check_order()
        self._loads.calls.dispatcher.check_may_block(f"{self._loads.actor.name}.load_all()")
        try:
            return self.begin().take()
        except RrError:
            raise
        except BaseException:  # such as KeyboardInterrupt: the caller never gets the queries
            self._withdraw()
            raise

    async def awaited(self) -> Queries:
        """Load all requests as wait() does, awaited on any event loop. If it is cancelled, nothing stays held."""
        self._check_order()
        loop = asyncio.get_running_loop()
        try:
            reply = self.begin()
            reply.when_set(lambda: self._withdraw() if loop.is_closed() else None)
            return await reply
        except RrError:
            raise
        except BaseException:
            self._withdraw()
            raise
        finally:
            self._reply.forget_error()

    def _check_order(self) -> None:
        for server, _, _ in self._requests:
            self._loads.check_order(server, self._parent)

    def _withdraw(self) -> None:
        """Release and withdraw all, as no caller waits any more."""
        with contextlib.suppress(Unavailable):  # the loop has ended, and with it all that this process holds
            self._loads.calls.dispatcher.call(self._undo)

    def _begin(self) -> None:
        try:
            for server, request, _ in self._requests:
                self._loadings.append(self._loads.begin(server, request, self._parent, self._options))
        except RrError as error:  # the registrar has been closed just now
            self._over = True
            self._undo()
            fail(self._reply, error)
            return
        for loading in self._loadings:
            loading.when_set(functools.partial(self._ended, loading))
        if not self._loadings:
            self._reply.set(Queries())

    def _ended(self, loading: Reply[Query]) -> None:
        if self._over:
            return
        error = error_of_load(loading)
        self._over = error is not None or loading.cancelled()
        if error is not None:
            place = next(place for place, other in enumerate(self._loadings) if other is loading)
            note_request(error, self._requests, place)
            self._fail_after([error], self._undo())
            return
        self._loaded += 1
        if self._loaded == len(self._loadings):
            self._over = True
            self._reply.set(Queries(loading.query for loading in self._loadings))

    def _undo(self) -> list[Reply[None]]:
        """Release the held queries, newest first, and withdraw the other loads; return the futures of the releases."""
        self._over = True
        undone: list[Reply[None]] = []
        while self._loadings:
            loading = self._loadings.pop()
            if not loading.cancel() and error_of_load(loading) is None:
                undone.append(self._unloads.begin(loading.query.id, self._options.timeout_s))
        return undone

    def _fail_after(self, errors: list[RrError], undone: Sequence[Reply[None]]) -> None:
        """Set the first error when all of `undone` have ended, with notes of what was not released."""
        left = itertools.count(len(undone) - 1, -1)

        def ended(released: Reply[None]) -> None:
            refusal = released.exception()
            if isinstance(refusal, RrError) and not isinstance(refusal, UnknownQuery):  # else it is released meanwhile
                errors.append(refusal)
            if not next(left):
                fail(self._reply, with_notes(errors))

        for released in undone:
            released.when_set(functools.partial(ended, released))
        if not undone:
            fail(self._reply, with_notes(errors))


def error_of_load(load: Reply[Query]) -> RrError | None:
    """Return the error of a load that has failed; None if it is held, withdrawn, or still loading."""
    return cast("RrError | None", load.exception()) if load.done() and not load.cancelled() else None
