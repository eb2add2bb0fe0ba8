"""Managers that all load from one another at once: what many of them get done together, beside two.

Twice: with as much in flight between any two of them as between the two, and with as much in flight for each manager,
so that what it sends to one other goes to 49 in as many pieces. All three do as many loads, enough for seconds: what is
loaded gets into the tables then.
"""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

import rr_actors as rr
from benchmarks import placement
from benchmarks.measure import interleaved
from benchmarks.table import Row
from benchmarks.workload import PAYLOAD
from benchmarks.yardsticks import in_turn, pipe_echoes

_PAIR_AT_LEAST = 0.8
_EACH_AT_LEAST = 0.4  # no two loads share a read, a commit or a write then (docs/performance.md)
_IN_FLIGHT = 64
_ROUNDS = 3
_ECHOES = 20_000
_LIMIT_S = 120.0


@dataclass(frozen=True)
class Drive:
    """Load so many from these peers in turn, some of them at once; another nonce is another request."""

    peers: list[str]
    loads: int
    in_flight: int
    nonce: int


class Trader(rr.Manager):
    """Offers an echo, and loads from its peers when told to."""

    @rr.server("echo")
    def load_echo(self, request: int) -> int:
        return request

    @rr.server("drive")
    def drive(self, request: Drive) -> int:
        """Load from the peers in turn and let go again; returns the number of this process's threads."""
        # A thread of its own: what it loads is not this resource's.
        threads: list[int] = []
        thread = threading.Thread(target=lambda: threads.append(_trade(self.registrar, request)))
        thread.start()
        thread.join()
        return threads[0]


def _trade(registrar: rr.Registrar, request: Drive) -> int:
    waiting: deque[Any] = deque()
    for number in range(request.loads):
        if len(waiting) == request.in_flight:
            waiting.popleft().get()
        waiting.append(registrar.load(f"{request.peers[number % len(request.peers)]}/echo", 0, block=False))
    for future in waiting:
        future.get()
    threads = len(os.listdir("/proc/self/task"))
    registrar.unload_all()
    return threads


def exchange(many: int, loads: int) -> list[Row]:
    """Loads a second of two managers and of `many`, the same number of loads in all; and what raw pipes do then."""
    few_rate, few_threads = _measure(2, loads, _IN_FLIGHT)
    pair_rate, pair_threads = _measure(many, loads, _IN_FLIGHT * (many - 1))
    many_rate, many_threads = _measure(many, loads, _IN_FLIGHT)
    what = f"{many} managers in full exchange, {_IN_FLIGHT} loads in flight for each"
    return [
        Row(f"2 managers in full exchange, {_IN_FLIGHT} loads in flight for each", few_rate, "/s"),
        _beside(few_rate, f"{what} pair", pair_rate, _PAIR_AT_LEAST),
        _beside(few_rate, what, many_rate, _EACH_AT_LEAST),
        Row("threads in each process, 2 managers", few_threads, ""),
        Row(f"threads in each process, {many} managers", max(pair_threads, many_threads), "", at_most=few_threads + 1),
        *_floor(many),
    ]


def _beside(few_rate: float, what: str, rate: float, at_least: float) -> Row:
    return Row(what, rate, "/s", ratio=rate / few_rate, against="2 managers", at_least=at_least)


def _floor(many: int) -> list[Row]:
    """What one echo costs if two children are asked in turn, and if `many` are: processes cool each other's caches.

    On one core where that can be chosen: in a full exchange no core sleeps, and here nobody is to wait for one to wake.
    """
    where = placement.placements()[0]
    with placement.here(where), pipe_echoes(PAYLOAD, many) as calls:
        taken = interleaved({"few": in_turn(calls[:2]), "many": in_turn(calls)}, times=_ECHOES)
    few_s, many_s = taken["few"].median, taken["many"].median
    return [
        Row(f"raw pipe echoes, 2 children in turn, {where}", 1 / few_s, "/s"),
        Row(
            f"raw pipe echoes, {many} children in turn, {where}",
            1 / many_s,
            "/s",
            ratio=few_s / many_s,
            against="2 children",
        ),
    ]


def _measure(managers: int, loads: int, in_flight: int) -> tuple[float, float]:
    names = [f"t{number}" for number in range(managers)]
    specs = [rr.ChildSpec(Trader, id=name) for name in names]
    with (
        tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir,
        rr.System(specs, name="bench", state_dir=state_dir) as system,
    ):
        app = system.open_registrar("app")
        _drive(app, names, managers * (managers - 1), in_flight, 0)  # everybody connects to everybody
        taken = [_drive(app, names, loads, in_flight, nonce) for nonce in range(1, _ROUNDS + 1)]
    return max(rate for rate, _ in taken), max(threads for _, threads in taken)


def _drive(app: rr.Registrar, names: list[str], loads: int, in_flight: int, nonce: int) -> tuple[float, int]:
    start = time.perf_counter()
    futures: list[Any] = []
    for name in names:
        request = Drive([peer for peer in names if peer != name], loads // len(names), in_flight, nonce)
        futures.append(app.load(f"{name}/drive", request, timeout_s=_LIMIT_S, block=False))
    threads = max(future.get(timeout=_LIMIT_S).response for future in futures)
    return loads / (time.perf_counter() - start), threads
