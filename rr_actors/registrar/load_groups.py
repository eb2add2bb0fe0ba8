"""Groups of loads: either all of a group are held, or none is; and the queries that a group results in.

All loads of a group begin at once. When one fails, the held ones are released, and the others are withdrawn. Then the
caller gets the first error.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, Self, cast

import msgspec

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base.errors import RrError, Unavailable, UnknownQuery, UsageError, shown
from rr_actors.base.names import ServerId
from rr_actors.base.values.canonical import encode
from rr_actors.registrar.loads import Loads, Unloads, with_notes
from rr_actors.registrar.queries import Query, StatusCallback
from rr_actors.runtime.shielding import Flag, shielded


class Queries(tuple[Query, ...]):
    """The queries of load_all(), in the order of the requests. As a context manager it unloads them at the end."""

    __slots__ = ()

    def unload(self, *, timeout_s: float | None = 30.0) -> None:
        """Release all queries that are still held, newest first, and return when that is done.

        Args:
            timeout_s: seconds to wait for each query, if its provider is down.

        Raises:
            RrError: the first error that Query.unload() raised, after all have been tried; the others are its notes.
        """
        errors: list[RrError] = []
        for query in reversed(self):
            try:
                query.unload_if_held(timeout_s=timeout_s)
            except RrError as error:
                errors.append(error)
        if errors:
            raise with_notes(errors)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.unload()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        await asyncio.to_thread(self.unload)


class Wanted(NamedTuple):
    """One request of a group, checked and ready to be sent."""

    server: ServerId
    request: bytes
    shown: str


def wanted(requests: Iterable[tuple[str, Any]], target: Callable[[object], ServerId]) -> list[Wanted]:
    """Return the requests of a group, checked and ready to be sent.

    Raises:
        UsageError, InvalidName, NotSerializable: one of them is no pair of a server and a request that can be sent.
    """
    found: list[Wanted] = []
    for number, pair in enumerate(iterated(requests), 1):
        if not isinstance(pair, (tuple, list)) or len(cast("tuple[Any, ...]", pair)) != 2:
            expected = 'expected a pair ("registrar/server", request)'
            raise UsageError(f"load_all: request {number}: {expected}, got {shown(cast('object', pair))}")
        server, request = cast("tuple[Any, Any]", pair)
        found.append(Wanted(target(server), encode(request), shown(request)))
    return found


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


class Group(msgspec.Struct):
    """The loads of one load_all(): wait() or result() begins them all."""

    loads: Loads
    unloads: Unloads
    requests: Sequence[Wanted]
    parent: str
    on_status: StatusCallback | None
    timeout_s: float | None
    replies: list[Reply[Query]] = []

    def wait(self) -> Queries:
        """Load all requests, and return their queries when all are held.

        Raises:
            RrError: the error of the first load that failed; nothing is held.
        """
        if not self.requests:
            return Queries()
        self.loads.calls.dispatcher.check_may_block(f"{self.loads.actor.name}.load_all()")
        settled = Flag()
        try:
            self._begin(settled.set)
            settled.wait()
            failed = self._failed()
            if failed is None:
                return Queries(reply.get() for reply in self.replies)
            raise self._error(failed, shielded(self._undo))
        except BaseException:  # such as KeyboardInterrupt: the caller never gets the queries
            self._undo()
            raise

    async def result(self) -> Queries:
        """Load all requests as wait() does, awaited on any event loop. If it is cancelled, nothing stays held."""
        if not self.requests:
            return Queries()
        loop = asyncio.get_running_loop()
        settled = asyncio.Event()

        def settle() -> None:
            try:
                loop.call_soon_threadsafe(settled.set)
            except RuntimeError:  # the event loop is closed, with the task that waited
                self._undo()

        try:
            self._begin(settle)
            await settled.wait()
            failed = self._failed()
            if failed is None:
                return Queries(reply.get() for reply in self.replies)
            raise await asyncio.to_thread(self._error, failed, self._undo())
        except BaseException:
            self._undo()
            raise

    def _begin(self, settled: Callable[[], object]) -> None:
        """Begin all loads. `settled` is called when one has failed, and when all have ended."""
        left = itertools.count(len(self.requests) - 1, -1)

        def ended(reply: Reply[Query]) -> None:
            if not next(left) or _error_of(reply) is not None:
                settled()

        for server, request, _ in self.requests:
            self.replies.append(self.loads.future(server, request, self.parent, self.on_status, self.timeout_s))
            self.replies[-1].add_done_callback(ended)

    def _failed(self) -> tuple[int, RrError] | None:
        """Return the place and error of the first load that failed, or None."""
        errors = map(_error_of, self.replies)
        return next(((place, error) for place, error in enumerate(errors) if error is not None), None)

    def _undo(self) -> list[Reply[None]]:
        """Release the held queries, newest first, and withdraw the other loads; return the futures of the releases."""
        undone: list[Reply[None]] = []
        while self.replies:
            reply = self.replies.pop()
            if not reply.cancel() and _error_of(reply) is None:
                with contextlib.suppress(Unavailable):  # the loop has ended, and with it all that this process holds
                    undone.append(self.unloads.future(reply.get().id, self.timeout_s))
        return undone

    def _error(self, failed: tuple[int, RrError], undone: Sequence[Reply[None]]) -> RrError:
        """Return the error, with notes that name its request and what was not released. Wait for all of `undone`."""
        place, error = failed
        server, _, request = self.requests[place]
        error.add_note(f"load_all: request {place + 1} of {len(self.requests)}, {server} with {request}")
        errors = [error]
        for reply in undone:
            try:
                reply.get()
            except UnknownQuery:
                continue  # the provider has released the query meanwhile
            except RrError as refusal:
                errors.append(refusal)
        return with_notes(errors)


def _error_of(load: Reply[Query]) -> RrError | None:
    """Return the error of a load that has failed; None if it is held, withdrawn, or still loading."""
    return cast("RrError | None", load.exception()) if load.done() and not load.cancelled() else None
