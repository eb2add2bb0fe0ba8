"""Crash: a manager's process is killed with SIGKILL; its supervisor respawns it, and it comes back with its catalog.

python examples/crash.py
"""

from __future__ import annotations

import os
import signal
import tempfile
from dataclasses import dataclass

import rr_actors as rr


@dataclass(frozen=True)
class Counter:
    start: int
    pid: int


class Counters(rr.Manager):
    @rr.server("counter")
    def load_counter(self, request: int) -> Counter:
        print(f"process {os.getpid()} makes counter {request}", flush=True)
        return Counter(request, os.getpid())

    @load_counter.recover
    def recover_counter(self, request: int, response: Counter) -> Counter:
        print(f"process {os.getpid()} finds counter {request} again", flush=True)
        return response


def main() -> None:
    children = [rr.ChildSpec(Counters, id="counters")]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        app = system.open_registrar("app")
        before = app.load("counters/counter", 7)

        print(f"SIGKILL to process {before.response.pid}", flush=True)
        os.kill(before.response.pid, signal.SIGKILL)

        fresh = app.load("counters/counter", 8)  # waits until the manager is back
        print("killed, and back in another process:", fresh.response.pid != before.response.pid, flush=True)
        again = app.load("counters/counter", 7)
        print("the counter kept its place:", again.resource_id == before.resource_id, flush=True)
        print("nothing was loaded twice:", again.response == before.response, flush=True)


if __name__ == "__main__":
    main()
