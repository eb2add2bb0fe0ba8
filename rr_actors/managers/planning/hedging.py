"""Hedging: candidates are tried in their order, and the next one beside one that does not answer."""

from __future__ import annotations

import itertools
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
    on_failed_beside: Callable[[C, Exception], object] | None = None,
    on_slow: Callable[[C], object] = lambda _: None,
    rest_s: Callable[[C], float] = lambda _: 0.0,
    hedge_s: float = HEDGE_S,
) -> Won[C, T] | None:
    """Try the candidates in their order; return the first that answers with a value, or None if all have failed.

    The next candidate begins when one has failed, at once, or when the last one has not answered within `hedge_s`
    seconds. Those that are slower than the winner are withdrawn. One that fails beside another may have failed because
    of that one: if all else fails, it is tried once more, alone. Order the candidates with Setbacks.ready_first(), so
    that what is loaded and well comes first.

    Args:
        begin: begins a candidate, and does not wait: ``registrar.load(..., block=False)``. It runs on the calling
            thread, so a load that begins in a callback is a part. An RrError of it is a failure of the candidate.
        release: gives back the value of one that answered, although another had won. It should not wait.
        on_failed: called with each candidate that has failed, and its error. What it raises ends the trying: a
            callback whose `stopping` is set should raise the error.
        on_failed_beside: called instead if the candidate is tried once more. None: `on_failed` is called.
        on_slow: called with the last candidate, each time that nothing has answered for `hedge_s`, before the next one
            begins. What it raises ends the trying.
        rest_s: returns for how long a candidate is still to be left alone, when others are in flight. If none is,
            `begin` itself has to wait.

    Raises:
        Exception: what a callback raises. All that is in flight is withdrawn.
    """
    untried, turn, again = iter(candidates), list[C](), list[C]()  # `turn`: the next one, while it rests
    answered: queue.SimpleQueue[Reply[T]] = queue.SimpleQueue()
    replies: list[tuple[C, Reply[T]]] = []
    won: Reply[T] | None = None

    def failed(candidate: C, error: Exception) -> None:
        if not replies:
            on_failed(candidate, error)
        else:
            again.append(candidate)
            (on_failed_beside or on_failed)(candidate, error)

    def start(candidate: C) -> bool:
        try:
            reply = begin(candidate)
        except RrError as error:
            failed(candidate, error)
            return False
        replies.append((candidate, reply))
        reply.add_done_callback(answered.put)
        return True

    def begin_next() -> float:
        """Return when to begin another one if nothing answers."""
        while turn or (turn.extend(itertools.islice(untried, 1)) or turn):
            wait_s = rest_s(turn[0]) if replies else 0.0
            if wait_s > 0:
                return time.monotonic() + wait_s
            if start(turn.pop()):
                break
        return time.monotonic() + hedge_s

    try:
        next_at = begin_next()
        while replies or again:
            if not replies:  # all else has failed
                start(again.pop(0))
                continue
            try:
                answered.get(timeout=max(0.0, next_at - time.monotonic()))
            except queue.Empty:
                on_slow(replies[-1][0])
                next_at = begin_next()
                continue
            for candidate, reply in [one for one in replies if one[1].done()]:
                error = reply.exception()
                if error is None:
                    won = reply
                    return Won(candidate, reply.result())
                replies.remove((candidate, reply))
                failed(candidate, error if isinstance(error, Exception) else RrError(str(error)))
                next_at = begin_next()
        return None
    finally:
        for _, reply in replies:
            if reply is not won and not reply.cancel():
                reply.add_done_callback(lambda late: late.exception() is None and release(late.result()))
