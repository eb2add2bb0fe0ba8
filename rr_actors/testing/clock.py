"""ManualClock: a Clock whose hands are moved by the test."""

from __future__ import annotations


class ManualClock:
    """Stands still until `advance` or `jump` is called; see rr_actors.clock."""

    def __init__(self, monotonic_s: float = 0.0, wall_s: float = 1_700_000_000.0) -> None:
        self._monotonic_s = monotonic_s
        self._wall_s = wall_s

    def monotonic(self) -> float:
        """Seconds that never go backwards."""
        return self._monotonic_s

    def wall(self) -> float:
        """Seconds since the epoch; may jump."""
        return self._wall_s

    def advance(self, seconds: float) -> None:
        """Let time pass.

        Raises:
            ValueError: less than none.
        """
        if seconds < 0:
            raise ValueError(f"advance: expected 0 s or more, got {seconds}; jump() moves the wall clock back")
        self._monotonic_s += seconds
        self._wall_s += seconds

    def jump(self, seconds: float) -> None:
        """Set the wall clock, forward or back; no time passes."""
        self._wall_s += seconds
