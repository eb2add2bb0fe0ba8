"""Through managers that depend on one another: a status from a leaf to the top, a priority from the top to a leaf."""

from __future__ import annotations

import tempfile
import threading
import time

import rr_actors as rr
from benchmarks.measure import Samples
from benchmarks.table import Row

MANAGERS = 5
AIM_MS = 10.0
DEEP = 50
DEEP_AIM_MS = 50.0
_PATIENCE_S = 10.0


class Link(rr.Manager):
    """Its one resource depends on the next manager's, the last one's on the leaf."""

    def __init__(self, below: str) -> None:
        self._below = below

    @rr.server("link")
    def load_link(self, request: int) -> int:
        self.registrar.load(self._below, request)
        return request

    @rr.server("level")
    def load_level(self, request: int) -> int:
        """Load the next level down, at the next manager; below the last one is the leaf."""
        number = request % MANAGERS + 1
        below = ("leaf/thing", 0) if request == 1 else (f"m{number}/level", request - 1)
        self.registrar.load(*below)
        return request


class _Arrivals:
    """Counts callbacks, and knows when the last of them came."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._left = 0
        self._done = threading.Event()

    def expect(self, callbacks: int) -> None:
        self._left = callbacks
        self._done.clear()

    def came(self, _news: object) -> None:
        with self._lock:
            self._left -= 1
            if self._left == 0:
                self._done.set()

    def wait(self) -> None:
        if not self._done.wait(_PATIENCE_S):
            raise TimeoutError(f"{self._left} have not heard of it after {_PATIENCE_S:g} s")


def _managers() -> list[rr.ChildSpec]:
    belows = ["leaf/thing", *(f"m{number}/link" for number in range(1, MANAGERS))]
    return [rr.ChildSpec(Link, id=f"m{number}", args=(below,)) for number, below in enumerate(belows, 1)]


def status_chain(consumers: int, times: int) -> list[Row]:
    """From send_status() at the leaf to the callback of the last of so many consumers; each manager has a process."""
    arrivals = _Arrivals()
    seconds: list[float] = []
    with (
        tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir,
        rr.System(_managers(), name="bench", state_dir=state_dir) as system,
    ):
        leaf = system.open_registrar("leaf")
        leaf.register_server("thing", load=lambda request: request)
        for number in range(consumers):
            system.open_registrar(f"c{number}").load(f"m{MANAGERS}/link", 0, on_status=arrivals.came)
        (thing,) = leaf.resources()
        for number in range(times + 1):
            arrivals.expect(consumers)
            start = time.perf_counter()
            leaf.send_status(thing, rr.Status(rr.State.WARNING, str(number)))
            arrivals.wait()
            seconds.append(time.perf_counter() - start)
    taken = Samples(tuple(seconds[1:]))  # the first starts the threads of the callbacks
    return [
        Row(
            f"status from a leaf through {MANAGERS} managers to {consumers} consumers",
            taken.median * 1e3,
            "ms",
            taken.p99 * 1e3,
            at_most=AIM_MS,
        )
    ]


def priority_chain(times: int) -> list[Row]:
    """From ``query.priority = 5`` at the top of a graph until the leaf has it; each level is in another process."""
    arrivals = _Arrivals()
    seconds: list[float] = []
    with (
        tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir,
        rr.System(_managers(), name="bench", state_dir=state_dir) as system,
    ):
        leaf = system.open_registrar("leaf")
        leaf.register_server("thing", load=lambda request: request)
        top = system.open_registrar("top").load(f"m{DEEP % MANAGERS + 1}/level", DEEP - 1)
        (thing,) = leaf.resources()

        def hear(event: dict[str, object]) -> None:
            if event["event"] == "priority" and event["resource_id"] == thing.id:
                arrivals.came(event)

        system.subscribe(hear)
        for number in range(times + 1):
            arrivals.expect(1)
            start = time.perf_counter()
            top.priority = number + 1
            arrivals.wait()
            seconds.append(time.perf_counter() - start)
    taken = Samples(tuple(seconds[1:]))
    name = f"a priority from the top of a graph {DEEP} deep, through {MANAGERS} processes, to its leaf"
    return [Row(name, taken.median * 1e3, "ms", taken.p99 * 1e3, at_most=DEEP_AIM_MS)]
