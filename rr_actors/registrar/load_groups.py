"""Groups: loads that are held together or not at all, and the queries that come of them.

All are asked for at once. When one fails, those that are held are released and the others are withdrawn; then the
caller hears of the first failure.
"""

from __future__ import annotations

import asyncio
import functools
import threading
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple, Self, cast

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base.errors import RrError, UnknownQuery, UsageError, shown
from rr_actors.base.names import ServerId, parse_server
from rr_actors.base.values.canonical import encode
from rr_actors.registrar.loads import Loading, Loads, Unloads, with_notes
from rr_actors.registrar.model.rows import Held
from rr_actors.registrar.queries import Query, StatusCallback


class Queries(tuple[Query, ...]):
    """What load_all() holds, in the order of the requests. As a context manager it unloads all of them at the end."""

    __slots__ = ()

    def unload(self, *, timeout_s: float | None = 30.0) -> None:
        """Release all that are still held, newest first, and return when that is done.

        Args:
            timeout_s: seconds to wait for each of them, if its provider is down.

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
    """One of the requests: checked, and ready to be sent."""

    server: ServerId
    request: bytes
    shown: str


def wanted(requests: Iterable[tuple[str, Any]]) -> list[Wanted]:
    """Return the requests, checked.

    Raises:
        UsageError, InvalidName, NotSerializable: one of them is no pair of a server and a request that can be sent.
    """
    found: list[Wanted] = []
    for number, pair in enumerate(_iterated(requests), 1):
        if not isinstance(pair, (tuple, list)) or len(cast("tuple[Any, ...]", pair)) != 2:
            expected = 'expected a pair ("registrar/server", request)'
            raise UsageError(f"load_all: request {number}: {expected}, got {shown(cast('object', pair))}")
        server, request = cast("tuple[Any, Any]", pair)
        found.append(Wanted(parse_server(server), encode(request), shown(request)))
    return found


def _iterated(requests: Any) -> Iterable[Any]:
    try:
        return iter(requests)
    except TypeError:
        text = f'load_all: expected a list of pairs ("registrar/server", request), got {shown(requests)}'
        raise UsageError(text) from None


class Group:
    """One call of load_all(). `settled` is called on the loop, once: when all are held, or the first has failed."""

    def __init__(self, loads: Loads, unloads: Unloads, requests: Sequence[Wanted], settled: Callable[[], None]) -> None:
        self._unloads = unloads
        self._loads = loads
        self._requests = requests
        self._settled = settled
        self._loadings: list[Loading] = []
        self._left = len(requests)
        self._failed: tuple[int, RrError] | None = None

    def begin(self, parent: str, on_status: StatusCallback | None, timeout_s: float | None) -> None:
        """Ask for all of them."""
        try:
            for number, (server, request, _) in enumerate(self._requests):
                ended = functools.partial(self._ended, number)
                self._loadings.append(self._loads.start(server, request, parent, on_status, timeout_s, ended))
        except BaseException:
            self.undo()
            raise

    def _ended(self, number: int, _held: Held | None, error: RrError | None) -> None:
        self._left -= 1
        if self._failed is not None:
            return
        if error is not None:
            self._failed = (number, error)
        if error is not None or not self._left:
            self._settled()

    @property
    def failed(self) -> bool:
        """Whether one of them has failed."""
        return self._failed is not None

    def queries(self) -> Queries:
        """Return what is held."""
        return Queries(loading.query for loading in self._loadings)

    def undo(self, timeout_s: float | None = 30.0) -> list[Reply[None]]:
        """Release what is held, newest first, and withdraw the rest; return what waits for the releases."""
        replies: list[Reply[None]] = []
        for loading in reversed(self._loadings):
            if loading.is_held:
                replies.append(self._unloads.future(loading.query.id, timeout_s))
            elif not loading.is_done:
                loading.give_up("another request of the same load_all() has failed, or its caller was interrupted")
        return replies

    def error(self, undone: Sequence[Reply[None]]) -> RrError:
        """Return the first error, which says whose it is, and what could not be released. Waits for all of `undone`."""
        assert self._failed is not None
        number, error = self._failed
        server, _, request = self._requests[number]
        error.add_note(f"load_all: request {number + 1} of {len(self._requests)}, {server} with {request}")
        errors = [error]
        for reply in undone:
            try:
                reply.get()
            except UnknownQuery:
                continue  # its provider has taken it away meanwhile
            except RrError as refusal:
                errors.append(refusal)
        return with_notes(errors)


def wait(
    loads: Loads,
    unloads: Unloads,
    requests: Sequence[Wanted],
    parent: str,
    on_status: StatusCallback | None,
    timeout_s: float | None,
) -> Queries:
    """Load all, and return when they are held.

    Raises:
        RrError: how the first of them failed; none is held.
    """
    if not requests:
        return Queries()
    loads.calls.dispatcher.check_may_block(f"{loads.actor.name}.load_all()")
    settled = threading.Event()
    group = Group(loads, unloads, requests, settled.set)
    group.begin(parent, on_status, timeout_s)
    try:
        settled.wait()
    except BaseException:  # KeyboardInterrupt, say: nobody will hold them
        group.undo(timeout_s)
        raise
    if not group.failed:
        return group.queries()
    raise group.error(group.undo(timeout_s))


async def result(
    loads: Loads,
    unloads: Unloads,
    requests: Sequence[Wanted],
    parent: str,
    on_status: StatusCallback | None,
    timeout_s: float | None,
) -> Queries:
    """As wait(), awaited on whatever loop this runs. Cancelled, it releases and withdraws all.

    Raises:
        RrError: how the first of them failed; none is held.
    """
    if not requests:
        return Queries()
    loop = asyncio.get_running_loop()
    settled = asyncio.Event()

    def settle() -> None:
        try:
            loop.call_soon_threadsafe(settled.set)
        except RuntimeError:  # closed, with the task that waited
            group.undo(timeout_s)

    group = Group(loads, unloads, requests, settle)
    group.begin(parent, on_status, timeout_s)
    try:
        await settled.wait()
    except asyncio.CancelledError:
        group.undo(timeout_s)
        raise
    if not group.failed:
        return group.queries()
    undone = group.undo(timeout_s)
    for reply in undone:
        try:
            await reply
        except RrError:
            continue  # error() tells of it
    raise group.error(undone)
