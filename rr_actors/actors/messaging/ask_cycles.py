"""Asking: which actor's handler waits for which actor's reply, so that a ring of them is an error instead of a hang.

There are two records, since neither sees all waits. `_waits` has every handler of this process that waits for a reply,
also on a future of an earlier ask. Across processes, every blocking ask carries the chain of blocked askers.

The error is a UsageError. Its `.ring` has the names of the actors.
"""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Generator
from contextvars import ContextVar
from typing import NamedTuple, Protocol

import msgspec

from rr_actors.base.errors import UsageError


class Target(NamedTuple):
    """An actor in a ring: the URN that identifies it, and its name for people."""

    urn: str
    name: str


Chain = tuple[Target, ...]
"""The actors that are blocked until the message is answered, the first asker first."""


class Activity(msgspec.Struct, eq=False):
    """One run of a handler. It is not `active` once the handler has returned: a task left behind blocks no actor.

    `starts_in`: of a run of on_start the task that runs it, or the number of its thread; else None.
    `message`: the id of the message that is handled, if it is recorded; else "".
    """

    target: Target
    chain: Chain
    active: bool = True
    starts_in: object = None
    message: str = ""


class Awaited(Protocol):
    """A reply that a handler waits for."""

    target: Target | None

    def done(self) -> bool: ...


activity: ContextVar[Activity | None] = ContextVar("rr_actors_activity", default=None)
"""The handler that the current code belongs to."""

INSTEAD = "start a thread for it, and return"
"""What code can do that would wait for its own end."""

_lock = threading.Lock()
_waits: dict[str, list[Awaited]] = {}  # by the urn of the actor whose handler waits


def chain() -> Chain:
    """Return the chain that a blocking ask of the current handler must carry."""
    me = activity.get()
    return () if me is None or not me.active else (*me.chain, me.target)


@contextlib.contextmanager
def asking_as(name: str) -> Generator[None]:
    """Have asks within the `with` block carry this name: that of a connected program, which is no actor."""
    token = activity.set(Activity(Target(f"asker:{name}", name), ()))
    try:
        yield
    finally:
        activity.reset(token)


def asker() -> str | None:
    """Return the name of the actor or connected program that asks, "" if it is not known; None outside of a handler."""
    me = activity.get()
    if me is None or not me.active or me.starts_in is not None:
        return None
    return me.chain[-1].name if me.chain else ""


def here() -> object:
    """Return the task that runs the current code, or the number of the thread if no task does."""
    return threading.get_ident() if asyncio._get_running_loop() is None else asyncio.current_task()


def starting() -> Target | None:
    """Return the actor whose on_start runs the current code, and waits while it waits.

    None in a thread or a task that on_start has begun: on_start may return before that.
    """
    me = activity.get()
    starts = me is not None and me.active and me.starts_in is not None and me.starts_in == here()
    return me.target if me is not None and starts else None


def check_ring(target: Target) -> None:
    """Raise UsageError if `target` waits, directly or by way of others, for the current handler."""
    me = activity.get()
    if me is not None and me.active:
        with _lock:
            _check(me, target)


def check_chain(target: Target, asked_by: Chain) -> None:
    """Raise UsageError if `target` is itself blocked until a message with the chain `asked_by` is answered."""
    for position, blocked in enumerate(asked_by):
        if blocked.urn == target.urn:
            raise _ring_error([*(other.name for other in asked_by[position:]), target.name])


def check_end(urn: str, what: str) -> None:
    """Raise UsageError if the call `what` ends the actor `urn`, and it or one below it waits for the call."""
    for asker in chain():
        if f"{asker.urn}/".startswith(f"{urn}/"):
            text = f"{what} waits for the end of {asker.name}, which waits for this call: it would wait for itself"
            raise UsageError(f"{text}; {INSTEAD}")


def begin_wait(awaited: Awaited) -> str | None:
    """Note that the current handler waits for `awaited`, or raise as check_ring(). Pass the result to end_wait()."""
    me = activity.get()
    if me is None or not me.active or awaited.target is None:
        return None
    with _lock:  # one lock for check and entry: if two waits close a ring at once, the second sees the first
        _check(me, awaited.target)
        _waits.setdefault(me.target.urn, []).append(awaited)
    return me.target.urn


def end_wait(urn: str | None, awaited: Awaited) -> None:
    """Note that a handler has its reply, or waits no more; `urn` is the result of begin_wait()."""
    if urn is None:
        return
    with _lock:
        waits = _waits[urn]
        waits.remove(awaited)
        if not waits:
            del _waits[urn]


def waits_of(urn: str) -> list[str]:
    """Return the names of the actors whose replies the handler of this actor waits for. From any thread."""
    with _lock:
        waits = list(_waits.get(urn, ()))
    return [awaited.target.name for awaited in waits if awaited.target is not None and not awaited.done()]


def _check(me: Activity, target: Target) -> None:
    check_chain(target, (*me.chain, me.target))
    path = _path(target, me.target.urn)
    if path is not None:
        raise _ring_error([me.target.name, *path])


def _path(start: Target, goal_urn: str) -> list[str] | None:
    """Return the names from `start` to the goal, where each actor waits for the next; None if there is no path."""
    seen = {start.urn}
    to_visit = [(start.urn, [start.name])]
    while to_visit:
        here_urn, names = to_visit.pop()
        for awaited in _waits.get(here_urn, ()):
            following = awaited.target
            if following is None or awaited.done():  # answered: the waiting handler has not woken up yet
                continue
            if following.urn == goal_urn:
                return [*names, following.name]
            if following.urn not in seen:
                seen.add(following.urn)
                to_visit.append((following.urn, [*names, following.name]))
    return None


def _ring_error(ring: list[str]) -> UsageError:
    if len(ring) == 2 and ring[0] == ring[1]:
        text = f"{ring[0]} asks itself and would wait for ever; use tell(), or call the method directly"
    else:
        text = f"a ring of asks would wait for ever: {' → '.join(ring)}; one of them must use tell(), or not wait"
    return UsageError(text, ring=tuple(ring))
