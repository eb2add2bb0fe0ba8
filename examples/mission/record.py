"""The record of one run: where the robot was when, what was done to it, and what follows from that."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import NamedTuple

from rr_actors.system.recording.timelines import Timeline

STANDING_MPS = 0.02


class Sample(NamedTuple):
    """The robot at one moment: seconds since the run began, and metres."""

    time_s: float
    x: float
    y: float
    driven_m: float
    speed: float


@dataclass
class Fault:
    """What was done to one process, and what came of it: "lidar 1", "disconnected"."""

    name: str
    what: str
    done: str
    time_s: float
    x: float
    y: float
    driven_m: float
    serving_s: float | None = None  # from the fault until what it did is done again; None: it never was
    standing_s: float = 0.0


@dataclass
class Record:
    """What one run was like."""

    title: str
    samples: list[Sample] = field(default_factory=list[Sample])
    faults: list[Fault] = field(default_factory=list[Fault])
    outcome: str = "under way"
    time_s: float = 0.0  # until it arrived, or stood for good
    resources_left: int | None = None
    processes_left: int | None = None
    timeline: Timeline | None = None  # of the managers' lives

    @property
    def arrived(self) -> bool:
        return self.outcome == "arrived"

    def finish(self, outcome: str) -> None:
        """The robot has arrived, or will not."""
        self.outcome = outcome
        self.time_s = self.time_s or (self.samples[-1].time_s if self.samples else 0.0)
        ends = [fault.time_s for fault in self.faults[1:]] + [self.time_s]
        for fault, end in zip(self.faults, ends, strict=False):
            fault.standing_s = standing_s(self.samples, fault.time_s, end)


def standing_s(samples: list[Sample], begin_s: float, end_s: float) -> float:
    """How long the robot stood between two moments."""
    return sum(
        after.time_s - before.time_s
        for before, after in itertools.pairwise(samples)
        if begin_s <= after.time_s <= end_s and abs(after.speed) < STANDING_MPS
    )
