"""Health: how a server's resources are probed, and which state follows from the results.

This part is pure. It decides on a sequence of results, and has no clock. Its counters are in memory only: a process
that is respawned counts anew.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from rr_actors.base.checks import check_number, invalid
from rr_actors.base.errors import is_a
from rr_actors.registrar.model.rows import State

SHORTEST_S, LONGEST_S = 0.01, 86_400.0
LOOK_S = 1.0
"""Seconds within which a resource with a Health of its own is found, and probed for the first time."""
_NOT_WELL = (State.WARNING, State.ERROR)


class Health(msgspec.Struct, frozen=True):
    """How the loaded resources of a server are probed, for ``@rr.server(..., health=rr.Health(...))``.

    A probe is one run of the server's health callback. One that returns None finds the resource well. One that raises,
    or has not returned within `timeout_s`, is a failure.

    Attributes:
        every_s: seconds from one probe of a resource to the next.
        timeout_s: seconds after which a probe that has not returned is a failure.
        warn_after: probes in a row that do not find the resource well, after which it has the state WARNING.
        fail_after: failures in a row after which it has the state ERROR.
        pass_after: probes in a row that find it well, after which it has the state OK again.
        fatal_after_s: seconds of failures in a row after which it is lost, with the state FATAL. None: never.
        fatal_after: failures in a row after which it is lost. None: never.

    Raises:
        InvalidSpec: a number is wrong.
    """

    every_s: float = 1.0
    timeout_s: float = 1.0
    warn_after: int = 1
    fail_after: int = 3
    pass_after: int = 1
    fatal_after_s: float | None = None
    fatal_after: int | None = None

    def __post_init__(self) -> None:
        self._check_seconds("every_s", self.every_s)
        self._check_seconds("timeout_s", self.timeout_s)
        if self.fatal_after_s is not None:
            self._check_seconds("fatal_after_s", self.fatal_after_s, ", or None")
        for field in ("warn_after", "fail_after", "pass_after"):
            check_count(getattr(self, field), "health", field)
        if self.fatal_after is not None:
            check_count(self.fatal_after, "health", "fatal_after", also=", or None")
        if self.warn_after > self.fail_after:
            raise invalid("health", "warn_after", f"at most fail_after, {self.fail_after}", self.warn_after)

    def _check_seconds(self, field: str, seconds: object, also: str = "") -> None:
        check_number(seconds, "health", field, least=SHORTEST_S, most=LONGEST_S, also=also)


class HealthOf(msgspec.Struct, frozen=True):
    """How each resource of a ready-made manager's server is probed.

    Attributes:
        of: returns the Health of a resource by its id; None: it is not probed. The event loop calls it, so it must not
            block.
    """

    of: Callable[[str], Health | None]


def check_count(count: object, who: str, field: str, also: str = "") -> None:
    """Check that a count is a whole number, 1 or more; `also` names an alternative, for the error."""
    if not is_a(count, int) or is_a(count, bool) or count < 1:
        raise invalid(who, field, f"a whole number, 1 or more{also}", count)


class ProbeResult(msgspec.Struct, frozen=True):
    """The result of a probe. ERROR is a failure. `message` is text for people."""

    state: State
    message: str = ""


WELL = ProbeResult(State.OK)


class ProbeCounts(msgspec.Struct, frozen=True):
    """The results of a resource's latest probes.

    Attributes:
        state: what the probes have said of the resource: OK, WARNING, ERROR or FATAL.
        unwell: the latest results in a row that were not OK.
        failed: the latest failures in a row.
        passed: the latest results in a row that were OK.
        unfailed: the latest results in a row that were no failures.
        failing_since: when the first of the latest failures in a row was found; None if the latest was no failure.
    """

    state: State
    unwell: int = 0
    failed: int = 0
    passed: int = 0
    unfailed: int = 0
    failing_since: float | None = None


def first_counts(state: State) -> ProbeCounts:
    """Return the counters of a resource that has this state, and is not probed yet."""
    return ProbeCounts(state if state in _NOT_WELL else State.OK)


def judged(health: Health, counts: ProbeCounts, found: ProbeResult, now_s: float) -> tuple[ProbeCounts, State | None]:
    """Return the counters after one more result, and the state to announce; None if it has not changed.

    Args:
        now_s: the time of the result, by a clock that never goes back.
    """
    counted = _counted(counts, found.state, now_s)
    state = _state_after(health, counted, found.state, now_s)
    if state is counts.state:
        return counted, None
    return msgspec.structs.replace(counted, state=state), state


def _counted(counts: ProbeCounts, found: State, now_s: float) -> ProbeCounts:
    if found is State.OK:
        return ProbeCounts(counts.state, passed=counts.passed + 1, unfailed=counts.unfailed + 1)
    if found is State.WARNING:
        return ProbeCounts(counts.state, unwell=counts.unwell + 1, unfailed=counts.unfailed + 1)
    since = now_s if counts.failing_since is None else counts.failing_since
    return ProbeCounts(counts.state, unwell=counts.unwell + 1, failed=counts.failed + 1, failing_since=since)


def _state_after(health: Health, counts: ProbeCounts, found: State, now_s: float) -> State:
    """Return the state of a resource after its latest result, which `counts` has already."""
    if found is State.FATAL or _is_lost(health, counts, now_s):
        return State.FATAL
    if counts.failed >= health.fail_after:
        return State.ERROR
    if counts.passed >= health.pass_after:
        return State.OK
    if counts.state is State.OK and counts.unwell >= health.warn_after:
        return State.WARNING
    if counts.state is State.ERROR and counts.unwell and counts.unfailed >= health.pass_after:
        return State.WARNING  # it works again, though not well
    return counts.state


def _is_lost(health: Health, counts: ProbeCounts, now_s: float) -> bool:
    if health.fatal_after is not None and counts.failed >= health.fatal_after:
        return True
    limit_s, since = health.fatal_after_s, counts.failing_since
    return limit_s is not None and since is not None and now_s - since >= limit_s
