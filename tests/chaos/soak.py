"""Soak: measure the memory, descriptors and threads of every process under a constant load, and find growth.

With churn, managers are killed, stopped and started, and added and removed meanwhile.
"""

from __future__ import annotations

import os
import random
import signal
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from chaos.report import Tally
from chaos.victim_managers import PATIENCE_S, Maker, Want
from chaos.victim_system import MANAGERS, ROOT_MAKERS, Plant
from rr_actors.base.errors import RrError
from rr_actors.supervision.core.specs import ChildSpec

_WARM_UP = 0.25  # the part of the samples that is left out
_FEWEST_POINTS = 4  # that a line is laid through
ENOUGH_SAMPLES = 8
"""So many samples leave enough points for a line, when those of the warm-up are left out."""
_LIMITS = {
    "USS (MiB)": 2.0,
    "descriptors": 3.0,
    "threads": 3.0,
    "catalog (KiB)": 1024.0,  # its -wal alone may have 4 MiB
    "state directory (KiB)": 2048.0,
    "state directory (files)": 30.0,
}
"""How much each figure may grow over the samples, by a straight line through them."""
_CONSUMERS = "this process"
_REMEMBERED_MIB = 18.0
"""An addition for the consumers' process: each of its 3 registrars remembers up to 20,000 statuses of 300 bytes."""
_GUESTS = 5  # names for the managers that are added and removed


class Sample(NamedTuple):
    """One figure of one process at one time."""

    at: float
    who: str
    what: str
    value: float


class Soak:
    """The samples of a plant."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self._series: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)

    def sample(self) -> None:
        """Take one sample of every process, and of the state directory."""
        at = time.monotonic()
        census = self._plant.census()
        processes = {**census.managers, _CONSUMERS: os.getpid()}
        processes |= {f"fork server {n}": pid for n, pid in enumerate(census.fork_servers, 1)}
        processes |= {f"supervisor {n}": pid for n, pid in enumerate(census.others, 1)}
        for who, pid in processes.items():
            try:
                for what, value in _figures(pid):
                    self._series[who, what].append((at, value))
            except OSError:
                continue  # the process has ended
        for catalog in self._plant.state_dir.glob("*/catalog.sqlite3"):
            size = sum(map(_size_of, catalog.parent.glob("catalog.*")))  # its -wal and journal as well
            self._series[catalog.parent.name, "catalog (KiB)"].append((at, size / 1024))
        files = [file for file in self._plant.state_dir.rglob("*") if not file.is_dir()]
        self._series["all", "state directory (files)"].append((at, len(files)))
        self._series["all", "state directory (KiB)"].append((at, sum(map(_size_of, files)) / 1024))

    def growth(self) -> tuple[list[str], list[str]]:
        """Return a line for each kind of figure, and a line for each figure that grew too much."""
        worst: dict[str, tuple[float, str]] = {}
        grown: list[str] = []
        for (who, what), points in self._series.items():
            looked_at = points[int(len(points) * _WARM_UP) :]
            if len(looked_at) < _FEWEST_POINTS:
                continue
            growth = slope(looked_at) * (looked_at[-1][0] - looked_at[0][0])
            line = f"{who}: {what} {looked_at[0][1]:.1f} to {looked_at[-1][1]:.1f}, by a line {growth:+.2f}"
            if what not in worst or growth > worst[what][0]:
                worst[what] = (growth, line)
            limit = _LIMITS[what] + (_REMEMBERED_MIB if (who, what) == (_CONSUMERS, "USS (MiB)") else 0.0)
            if growth > limit:
                grown.append(f"grows: {line}, over the limit of {limit:g}")
        return [f"largest growth of {what}: {line}" for what, (_, line) in sorted(worst.items())], grown


class Churn:
    """Kills, restarts, or adds and removes managers of a plant, one at a time.

    Args:
        every_s: the mean seconds between two.
    """

    def __init__(self, plant: Plant, tally: Tally, seed: int, every_s: float) -> None:
        self._plant = plant
        self._tally = tally
        self._plan = random.Random(seed)
        self._every_s = every_s
        self._due = time.monotonic()
        self._guests = 0

    def step(self) -> None:
        """Replace one manager, if it is time."""
        if time.monotonic() < self._due:
            return
        self._due = time.monotonic() + self._plan.uniform(0.0, 2 * self._every_s)
        deed = self._plan.choice([self._kill, self._restart, self._invite])
        self._tally.fault(deed())

    def _kill(self) -> str:
        name = self._plan.choice(MANAGERS)
        pid = self._plant.census().managers.get(name)
        if pid is not None:
            self._plant.mark.signal(pid, signal.SIGKILL)
        return "SIGKILL to a manager"

    def _restart(self) -> str:
        name = self._plan.choice([*ROOT_MAKERS])
        self._plant.system.supervisor().terminate_child(name)
        self._plant.start_again(name)
        return "a manager stopped and started"

    def _invite(self) -> str:
        """Add a manager, use it, and remove it for good; a small catalog and an entry of its name stay."""
        self._guests += 1
        name, supervisor = f"guest-{self._guests % _GUESTS}", self._plant.system.supervisor()
        app = self._plant.consumers[0].app
        try:
            supervisor.start_child(ChildSpec(Maker, id=name, args=(str(self._plant.journal_dir),)))
            app.load(f"{name}/thing", Want(1), timeout_s=PATIENCE_S).unload(timeout_s=PATIENCE_S)
            supervisor.terminate_child(name)
            supervisor.delete_child(name)
        except RrError as error:
            self._tally.violation(f"{name}: could not be used: {error!r}")
        return "a manager added, used and removed"


def _size_of(path: Path) -> int:
    try:
        return path.stat(follow_symlinks=False).st_size
    except FileNotFoundError:
        return 0  # removed meanwhile, for instance as it was folded


def _figures(pid: int) -> Iterator[tuple[str, float]]:
    pages = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    private = sum(int(line.split()[1]) for line in pages if line.startswith(("Private_Clean:", "Private_Dirty:")))
    yield "USS (MiB)", private / 1024
    yield "descriptors", len(os.listdir(f"/proc/{pid}/fd"))
    yield "threads", len(os.listdir(f"/proc/{pid}/task"))


def slope(points: list[tuple[float, float]]) -> float:
    """Return the slope of the straight line nearest to the points."""
    mean_x = sum(x for x, _ in points) / len(points)
    mean_y = sum(y for _, y in points) / len(points)
    spread = sum((x - mean_x) ** 2 for x, _ in points)
    return sum((x - mean_x) * (y - mean_y) for x, y in points) / spread if spread else 0.0
