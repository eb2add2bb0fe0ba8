"""Asking: which actor's handler waits for which actor's reply, so that a ring of them is an error instead of a hang.

Two records, since neither sees everything. Within a process: `_waits`, exact, of every handler that waits for a reply,
for futures asked for earlier too. Across processes: the chain of blocked askers, which every blocking ask carries.

The error is a UsageError. Its `.ring` has the names of the actors.
"""

from __future__ import annotations

import threading
from contextvars import ContextVar
from typing import NamedTuple, Protocol

from rr_actors.base.errors import UsageError


class Target(NamedTuple):
    """An actor, as rings speak of it: what identifies it, and what people call it."""

    urn: str
    name: str


Chain = tuple[Target, ...]
"""The actors that are blocked until the message is answered, the first asker first."""


class Activity:
    """One handler of one actor at work. Not `active` once it has returned: a task it left behind blocks nobody."""

    __slots__ = ("active", "chain", "target")

    def __init__(self, target: Target, chain: Chain) -> None:
        self.target = target
        self.chain = chain
        self.active = True


class Awaited(Protocol):
    """What a handler waits for: a reply."""

    target: Target | None

    def done(self) -> bool: ...


activity: ContextVar[Activity | None] = ContextVar("rr_actors_activity", default=None)
"""The handler that the current code belongs to."""

_lock = threading.Lock()
_waits: dict[str, list[Awaited]] = {}  # by the urn of the actor whose handler waits


def chain() -> Chain:
    """The chain that a blocking ask from here must carry."""
    me = activity.get()
    return () if me is None or not me.active else (*me.chain, me.target)


def check_ring(target: Target) -> None:
    """Raise UsageError if `target` waits, directly or around a ring, for the handler that asks here."""
    me = activity.get()
    if me is not None and me.active:
        with _lock:
            _check(me, target)


def check_chain(target: Target, asked_by: Chain) -> None:
    """Raise UsageError if `target` is itself blocked until a message with the chain `asked_by` is answered."""
    for position, blocked in enumerate(asked_by):
        if blocked.urn == target.urn:
            raise _ring_error([*(other.name for other in asked_by[position:]), target.name])


def begin_wait(awaited: Awaited) -> str | None:
    """Note that the current handler waits for `awaited`, or raise as check_ring(). end_wait() takes what it returns."""
    me = activity.get()
    if me is None or not me.active or awaited.target is None:
        return None
    with _lock:  # one lock for check and entry: of two that close a ring at once, the second sees the first
        _check(me, awaited.target)
        _waits.setdefault(me.target.urn, []).append(awaited)
    return me.target.urn


def end_wait(urn: str | None, awaited: Awaited) -> None:
    """The handler has its reply, or has given up."""
    if urn is None:
        return
    with _lock:
        waits = _waits[urn]
        waits.remove(awaited)
        if not waits:
            del _waits[urn]


def _check(me: Activity, target: Target) -> None:
    check_chain(target, (*me.chain, me.target))
    path = _path(target, me.target.urn)
    if path is not None:
        raise _ring_error([me.target.name, *path])


def _path(start: Target, goal_urn: str) -> list[str] | None:
    """The names from `start` along who waits for whom to the goal; None if that is not where it leads."""
    came_from: dict[str, Target | None] = {start.urn: None}
    to_visit = [start]
    while to_visit:
        here = to_visit.pop()
        for awaited in _waits.get(here.urn, ()):
            following = awaited.target
            if following is None or awaited.done():  # answered: its waiter just has not woken up yet
                continue
            if following.urn == goal_urn:
                return [*_names_to(here, came_from), following.name]
            if following.urn not in came_from:
                came_from[following.urn] = here
                to_visit.append(following)
    return None


def _names_to(end: Target, came_from: dict[str, Target | None]) -> list[str]:
    names: list[str] = []
    here: Target | None = end
    while here is not None:
        names.append(here.name)
        here = came_from[here.urn]
    return names[::-1]


def _ring_error(ring: list[str]) -> UsageError:
    if len(ring) == 2 and ring[0] == ring[1]:
        text = f"{ring[0]} asks itself and would wait for ever; use tell(), or call the method directly"
    else:
        text = f"a ring of asks would wait for ever: {' → '.join(ring)}; one of them must use tell(), or not wait"
    return UsageError(text, ring=tuple(ring))
