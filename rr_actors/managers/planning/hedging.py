"""Hedging: candidates are tried in their order, and the next one beside one that does not answer."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterable
from typing import Generic, TypeVar

import msgspec

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base.errors import RrError

C = TypeVar("C")
T = TypeVar("T")

HEDGE_S = 1.0
"""So many seconds a candidate is alone; then the next one is tried beside it."""


class Won(msgspec.Struct, Generic[C, T], frozen=True):
    """The candidate that answered first, and its value."""

    candidate: C
    value: T


def first_of(
    candidates: Iterable[C],
    begin: Callable[[C], Reply[T]],
    *,
    release: Callable[[T], object],
    on_failed: Callable[[C, Exception], object],
    on_slow: Callable[[C], object] = lambda _: None,
    hedge_s: float = HEDGE_S,
) -> Won[C, T] | None:
    """Try the candidates in their order; return the first that answers with a value, or None if all have failed.

    The next candidate begins when one has failed, at once, or when the last one has not answered within `hedge_s`
    seconds. Those that are slower than the winner are withdrawn. Order the candidates with Setbacks.ready_first(), so
    that what is loaded and well comes first.

    Args:
        begin: begins a candidate, and does not wait: ``registrar.load(..., block=False)``. It runs on the calling
            thread, so a load that begins in a callback is a part. An RrError of it is a failure of the candidate.
        release: gives back the value of one that answered, although another had won. It should not wait.
        on_failed: called with each candidate that has failed, and its error. What it raises ends the trying: a
            callback whose `stopping` is set should raise the error.
        on_slow: called with each candidate that has not answered within `hedge_s`, before the next one begins. Tell the
            holders WARNING.

    Raises:
        Exception: what `on_failed` raises. All that is in flight is withdrawn.
    """
    left = iter(candidates)
    answered: queue.SimpleQueue[Reply[T]] = queue.SimpleQueue()
    replies: list[tuple[C, Reply[T]]] = []
    won: Reply[T] | None = None
    hedge_at: float | None = time.monotonic()  # when the next one begins; None: there is none

    def begin_next() -> float | None:
        for candidate in left:
            try:
                reply = begin(candidate)
            except RrError as error:
                on_failed(candidate, error)
                continue
            replies.append((candidate, reply))
            reply.add_done_callback(answered.put)
            return time.monotonic() + hedge_s
        return None

    try:
        hedge_at = begin_next()
        while replies:
            try:
                answered.get(timeout=None if hedge_at is None else max(0.0, hedge_at - time.monotonic()))
            except queue.Empty:
                on_slow(replies[-1][0])
                hedge_at = begin_next()
                continue
            for candidate, reply in [one for one in replies if one[1].done()]:
                error = reply.exception()
                if error is None:
                    won = reply
                    return Won(candidate, reply.result())
                replies.remove((candidate, reply))
                on_failed(candidate, error if isinstance(error, Exception) else RrError(str(error)))
                hedge_at = begin_next()
        return None
    finally:
        for _, reply in replies:
            if reply is not won and not reply.cancel():
                reply.add_done_callback(lambda late: late.exception() is None and release(late.result()))
