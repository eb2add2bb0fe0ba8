"""What the probes of many resources cost their manager in CPU, beside one without health and a thread pool."""

from __future__ import annotations

import tempfile
import time
from concurrent.futures import ThreadPoolExecutor

import rr_actors as rr
from benchmarks.table import Row

_CALLS = 2_000


class Cameras(rr.Manager):
    """Has the same resources twice, with health and without; says what CPU time its process has taken."""

    probes = 0

    def __init__(self, every_s: float) -> None:
        super().__init__()
        self._health = rr.Health(every_s=every_s, timeout_s=5.0)

    def on_start(self) -> None:
        register = self.registrar.register_server
        register("probed", self.open, recovery="keep", health=self._health, probe=self.look)
        register("bare", self.open, recovery="keep")

    def open(self, number: int) -> int:
        return number

    def look(self, number: int, response: int) -> None:
        self.probes += 1

    def cpu(self) -> tuple[float, int]:
        return time.process_time(), self.probes

    def pool_call_s(self) -> float:
        """Return the CPU time of a call by a thread pool that is waited for."""
        with ThreadPoolExecutor(1) as pool:
            pool.submit(self.cpu).result()
            began = time.process_time()
            for _ in range(_CALLS):
                pool.submit(self.cpu).result()
            return (time.process_time() - began) / _CALLS


def health(size: int, rounds: int, every_s: float) -> list[Row]:
    """Hold `size` resources, and measure their manager for some rounds of probes, one every so many seconds."""
    bare_s, _, call_s = _measured("bare", size, rounds, every_s)
    probed_s, probes, _ = _measured("probed", size, rounds, every_s)
    whole_s, each_s = rounds * every_s, max(probed_s - bare_s, 0.0) / max(probes, 1)
    return [
        Row(f"{size:,} resources without health, CPU", 100 * bare_s / whole_s, "% of a core"),
        Row(f"{size:,} probed every {every_s:g} s, CPU", 100 * probed_s / whole_s, "% of a core", at_most=5),
        Row("a call by a thread pool, CPU", call_s * 1e6, "µs"),
        Row("a probe, CPU", each_s * 1e6, "µs", ratio=each_s / call_s, against="call"),
    ]


def _measured(server: str, size: int, rounds: int, every_s: float) -> tuple[float, int, float]:
    """Return the CPU time that the manager has taken in these rounds, its probes, and the CPU time of a pool's call."""
    with (
        tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir,
        rr.System(
            [rr.ChildSpec(Cameras, id="cameras", kwargs={"every_s": every_s})], name="bench", state_dir=state_dir
        ) as system,
    ):
        manager = system.ref("cameras").proxy()
        system.open_registrar("app").load_all((f"cameras/{server}", number) for number in range(size))
        time.sleep(every_s)  # the round in which not all were loaded
        cpu_s, probes = manager.cpu().get()
        time.sleep(rounds * every_s)
        cpu_after_s, probes_after = manager.cpu().get()
        return cpu_after_s - cpu_s, probes_after - probes, manager.pool_call_s().get(timeout=60)
