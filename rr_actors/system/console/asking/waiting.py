"""Waiting until a child of a running system, or a resource, is in a state: for any program."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator

from rr_actors.base.errors import NotRunning, Unavailable, UsageError, few, shown
from rr_actors.base.names import child_meant
from rr_actors.runtime.time_limits import deadline_of, left_until, time_limit
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.console_connection import ConsoleConnection
from rr_actors.system.console.console_questions import Find

CHILD_STATES = ("running", "starting", "restarting", "stopped")
RESOURCE_STATES = ("OK", "UPDATE", "WARNING", "ERROR", "FATAL", "loaded", "loading", "unloading", "paused", "revoked")
GONE = "gone"

_AGAIN_S = 0.1  # between two attempts to reach a system that does not run yet
_LOOKS_S = 0.02  # between two looks at one that does
_TICK_S = 0.5  # while nothing happens, so often


def wait_for(connect: Callable[[], ConsoleConnection], target: str, wanted: str, timeout_s: float) -> tuple[bool, str]:
    """Wait until a child or a resource is in a state.

    Args:
        target: a child's id or path, or a resource's name, or its id or a part of that.
        wanted: one of CHILD_STATES, RESOURCE_STATES (of upper or lower case) or GONE: there is none of this name; "":
            the child runs, or the resource is loaded.

    Returns:
        Whether it was in time, and the state that was seen last.

    Raises:
        NotRunning: no system runs, or it has ended meanwhile, and `wanted` is not GONE.
        UsageError: no such state is known, or several children (NotFound) or resources have this name.
    """
    check_state(wanted, "state")
    deadline = time.monotonic() + timeout_s
    accepted = {wanted.lower()} if wanted else {"running", "loaded"}
    states = [GONE]
    try:
        with connect() as asking, connect() as hearing:
            for _ in _looks(hearing, deadline):
                states = _states_of(asking, target)
                if not accepted.isdisjoint(map(str.lower, states)):
                    return True, states[0]
    except NotRunning:
        if GONE not in accepted:
            raise
        return True, GONE
    return False, states[0]


def check_state(wanted: str, field: str) -> None:
    """Raise UsageError if there is no such state; `field` is how the caller names it. "" is one."""
    known = (*CHILD_STATES, *RESOURCE_STATES, GONE)
    if wanted and wanted.lower() not in map(str.lower, known):
        raise UsageError(f"{field}: expected {', '.join(known)}, got {shown(wanted)}")


def patiently(connect: Callable[[], ConsoleConnection], deadline: float) -> ConsoleConnection:
    """Connect to a system, which need not run yet.

    Raises:
        NotRunning: no system ran until the deadline, a time of time.monotonic().
    """
    while True:
        try:
            return connect()
        except NotRunning:
            if time.monotonic() > deadline:
                raise
            time.sleep(_AGAIN_S)


def _looks(hearing: ConsoleConnection, deadline: float) -> Iterator[None]:
    """Yield at once, and then whenever something may have changed, until the time limit.

    Raises:
        NotRunning: the system has ended.
    """
    looked_at = 0.0
    for _ in hearing.follow(c.Follow(), _TICK_S):
        now = time.monotonic()
        if now - looked_at > _LOOKS_S or now > deadline:
            yield
            looked_at = now
        if now > deadline:
            return
    raise NotRunning(f"the system in {hearing.welcome.state_dir} has ended")


def child_of(asking: ConsoleConnection, target: str) -> c.ChildRow | None:
    """Return the child of this path or id; None if there is none.

    Raises:
        NotFound: several children have this id.
    """
    rows = {row.path: row for row in asking.children().rows}
    path = child_meant(target, rows)
    return None if path is None else rows[path]


def _states_of(asking: ConsoleConnection, target: str) -> list[str]:
    """Return the state of the child of this name, or the last status and the phase of the resource; else GONE."""
    if (child := child_of(asking, target)) is not None:
        return [child.state]
    resources = asking.ask(Find(target)).resources
    if len(resources) > 1:  # those that are queued wait for the other one
        resources = [row for row in resources if row.phase != "queued"] or resources
    if len(resources) > 1:
        several = few(f"{row.name} ({row.id})" for row in resources)
        raise UsageError(f"{shown(target)}: several resources have this in their ids: {several}; give more of the id")
    return [resources[0].condition, resources[0].state, resources[0].phase] if resources else [GONE]


def waited_for(
    connect: Callable[[], ConsoleConnection],
    target: str,
    wanted: str,
    timeout_s: float | None,
    is_so: Callable[[str], bool] = lambda _state: True,
) -> str:
    """Wait as wait_for() does, and return the state.

    Args:
        is_so: says of a state that it is that of now, and not of a moment ago.

    Raises:
        Unavailable: it was not in time; the text has the state that was seen last.
    """
    deadline = deadline_of(time_limit(timeout_s))
    while True:
        left_s = left_until(deadline)
        done, seen = wait_for(connect, target, wanted, math.inf if left_s is None else left_s)
        if done and is_so(seen):
            return seen
        if left_until(deadline) == 0:
            expected, but = wanted or "running or loaded", ", and does not answer" if done else ""
            raise Unavailable(f"{target}: expected {expected} within {timeout_s:g} s, it is {seen}{but}")
        time.sleep(_LOOKS_S)
