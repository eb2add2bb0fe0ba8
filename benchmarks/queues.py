"""What a Queue, a Pipe and a queue of a Manager take beside an ask: `python -m benchmarks.queues`.

Round trips between two processes of the context "forkserver", in microseconds; each is the least of five medians.
"""

from __future__ import annotations

import multiprocessing
import statistics
import tempfile
import time
from collections.abc import Callable
from typing import Any

import rr_actors as rr

_ROUNDS = 5
_SIZES = ((100, 1_000), (1_000_000, 60))
_CONTEXT = multiprocessing.get_context("forkserver")


class Echo(rr.Actor):
    """Answers with what it was asked."""

    def on_receive(self, message: Any) -> Any:
        return message


def echo(take: Callable[[], bytes | None], put: Callable[[bytes], None]) -> None:
    """Give back what comes, until None comes."""
    while (message := take()) is not None:
        put(message)


def _queue_echo(there: Any, back: Any) -> None:
    echo(there.get, back.put)


def _pipe_echo(end: Any) -> None:
    echo(end.recv, end.send)


def _microseconds(call: Callable[[], object], times: int) -> float:
    call()
    medians: list[float] = []
    for _ in range(_ROUNDS):
        seconds: list[float] = []
        for _ in range(times):
            began = time.perf_counter()
            call()
            seconds.append(time.perf_counter() - began)
        medians.append(statistics.median(seconds))
    return min(medians) * 1e6


def _through_queues(there: Any, back: Any, payload: bytes, times: int) -> float:
    process = _CONTEXT.Process(target=_queue_echo, args=(there, back))
    process.start()
    found = _microseconds(lambda: (there.put(payload), back.get()), times)
    there.put(None)
    process.join()
    return found


def _through_a_pipe(payload: bytes, times: int) -> float:
    here, there = _CONTEXT.Pipe()
    process = _CONTEXT.Process(target=_pipe_echo, args=(there,))
    process.start()
    found = _microseconds(lambda: (here.send(payload), here.recv()), times)
    here.send(None)
    process.join()
    return found


def _by_asks(payload: bytes, times: int) -> float:
    with (
        tempfile.TemporaryDirectory(prefix="rr-bench-") as directory,
        rr.System([rr.ChildSpec(Echo, id="echo")], state_dir=directory) as system,
    ):
        actor = system.ref("echo")
        return _microseconds(lambda: actor.ask(payload), times)


def main() -> None:
    """Print all figures."""
    for size, times in _SIZES:
        payload = bytes(size)
        with _CONTEXT.Manager() as manager:
            proxies = _through_queues(manager.Queue(), manager.Queue(), payload, times)
        figures = {
            "two queues": _through_queues(_CONTEXT.Queue(), _CONTEXT.Queue(), payload, times),
            "pipe": _through_a_pipe(payload, times),
            "two queues of a manager": proxies,
            "ask": _by_asks(payload, times),
        }
        for name, found in figures.items():
            print(f"{size:>9,} bytes, {name:<24} {found:>10,.1f} µs")


if __name__ == "__main__":
    main()
