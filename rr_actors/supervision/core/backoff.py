"""Backoff: how long to wait before a restart. It is off unless a ChildSpec has one. OTP's supervisor has none."""

from __future__ import annotations

from dataclasses import dataclass

from rr_actors.base.checks import check_number, invalid


@dataclass(frozen=True)
class Backoff:
    """Growing waiting times before the restarts of a child. The child's state is "restarting" meanwhile.

    The n-th restart in a row (n from 0) waits ``min(maximum_s, delay_s * factor**n)``. A random part of that, up to
    `jitter`, is taken off: children that failed together do not restart together. A child that has run for `maximum_s`
    starts again with `delay_s`. Under one_for_all and rest_for_one the child that failed delays its group.
    Delayed restarts count: the supervisor's max_restarts within max_seconds should leave room for the first ones.

    Args:
        delay_s: seconds before the first restart, at least 0.
        factor: growth from one wait to the next, at least 1.
        maximum_s: the longest wait in seconds, at least delay_s.
        jitter: 0 (none) to 1 (anything between no wait and all of it).

    Raises:
        InvalidSpec: naming the field.
    """

    delay_s: float = 0.1
    factor: float = 2.0
    maximum_s: float = 30.0
    jitter: float = 0.1

    def __post_init__(self) -> None:
        who = "Backoff"
        check_number(self.delay_s, who, "delay_s", least=0)
        check_number(self.factor, who, "factor", least=1)
        check_number(self.maximum_s, who, "maximum_s", least=0)
        check_number(self.jitter, who, "jitter", least=0, most=1)
        if self.maximum_s < self.delay_s:
            raise invalid(who, "maximum_s", f"at least delay_s ({self.delay_s:g})", self.maximum_s)

    def delay(self, attempt: int, chance: float) -> float:
        """Return the seconds before restart number `attempt` (from 0); `chance` is a random number in [0, 1]."""
        try:
            wait_s = min(self.maximum_s, self.delay_s * self.factor**attempt)
        except OverflowError:
            wait_s = self.maximum_s if self.delay_s else 0.0
        return wait_s * (1 - self.jitter * chance)
