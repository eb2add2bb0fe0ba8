"""Playback: which time of a run the lab shows. It is live, or goes through what has happened, at a pace, or stands."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

PACES = (1.0, 0.5, 0.25)


@dataclass(frozen=True)
class Playback:
    """A place in a run, and how it moves. Times are seconds since the epoch.

    Attributes:
        at: the time that is shown; None for the newest.
        pace: how many seconds of the run pass in a second.
        is_paused: it stands.
    """

    at: float | None = None
    pace: float = PACES[0]
    is_paused: bool = False

    def advanced(self, by_s: float, newest: float) -> Playback:
        """Return it after so many seconds. At the newest time it is live again."""
        if self.at is None or self.is_paused:
            return self
        at = self.at + by_s * self.pace
        return replace(self, at=at) if at < newest else replace(self, at=None)

    def toggled(self, newest: float) -> Playback:
        """Return it paused, or, if it was paused, moving."""
        if self.is_paused:
            return replace(self, is_paused=False)
        return replace(self, at=newest if self.at is None else self.at, is_paused=True)

    def stepped(self, times: Iterable[float], newest: float) -> Playback:
        """Return it paused at the first of these times after the present one, or at the newest time."""
        at = newest if self.at is None else self.at
        return replace(self, at=min((time for time in times if time > at), default=newest), is_paused=True)

    def slower(self, newest: float) -> Playback:
        """Return it at half of its pace; after the slowest pace at the first one."""
        pace = PACES[(PACES.index(self.pace) + 1) % len(PACES)]
        return replace(self, at=newest if self.at is None else self.at, pace=pace)

    def again(self, first: float) -> Playback:
        """Return it moving from the beginning, at the same pace."""
        return replace(self, at=first, is_paused=False)
