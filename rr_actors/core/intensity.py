"""Restart intensity: how many restarts count, over a sliding window, and when they are too many.

OTP's manual: more than `intensity` restarts within `period` seconds end the supervisor. Inclusive on both sides: a
restart exactly max_seconds old still counts, and exactly max_restarts of them are still allowed.
"""

from __future__ import annotations

from rr_actors.core.tree import Restart
from rr_actors.errors import RestartIntensityExceeded


def within(restarts: tuple[Restart, ...], now: float, max_seconds: float) -> tuple[Restart, ...]:
    """Those that still count at `now`."""
    return tuple(restart for restart in restarts if now <= restart.at + max_seconds)


def exceeded(
    path: str, restarts: tuple[Restart, ...], limit: int, max_seconds: float, now: float
) -> RestartIntensityExceeded:
    """The error for too many, naming each: the child, how many seconds ago, and why."""
    listed = [(restart.id, now - restart.at, restart.reason) for restart in restarts]
    text = "; ".join(f"{id} {ago:.3g} s ago: {reason}" for id, ago, reason in listed)
    needed = f"{len(restarts)} restart{'s' if len(restarts) > 1 else ''}"
    return RestartIntensityExceeded(
        f"supervisor {path}: {needed} needed within {max_seconds:g} s, {limit} allowed: {text}",
        supervisor=path,
        restarts=listed,
        limit=limit,
        max_seconds=max_seconds,
    )
