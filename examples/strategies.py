"""The four strategies side by side: one child of three is killed; who is started again?

python examples/strategies.py
"""

from __future__ import annotations

import os
import tempfile
import threading
from typing import Any

import rr_actors as rr


class Worker(rr.Actor):
    def on_receive(self, message: object) -> int:
        return os.getpid()


def supervisor(strategy: Any) -> rr.Supervisor:
    dynamic = strategy == "simple_one_for_one"
    ids = ["worker"] if dynamic else ["a", "b", "c"]
    return rr.Supervisor([rr.ChildSpec(Worker, id=id) for id in ids], id=strategy, strategy=strategy)


def show(system: rr.System, strategy: str) -> None:
    here = system.supervisor(f"root/{strategy}")
    if strategy == "simple_one_for_one":  # it begins without children: they are made from its template
        for _ in range(3):
            here.start_child([])
    first, second, third = here.which_children()[::-1]  # newest first, as in OTP
    before = {child.id: child.pid for child in (first, second, third)}
    last = third if strategy in ("one_for_all", "rest_for_one") else second  # of those that are started again
    back = threading.Event()

    def heard(event: dict[str, Any]) -> None:
        if event["event"] == "restarted" and event["path"] == f"{here.path}/{last.id}":
            back.set()

    unsubscribe = system.subscribe(heard)
    second.kill()
    back.wait(10)
    unsubscribe()
    marks = ["new" if child.pid != before[child.id] else "-" for child in here.which_children()[::-1]]
    print(f"{strategy:20}" + "".join(f"{mark:>6}" for mark in marks), flush=True)


if __name__ == "__main__":
    strategies = ("one_for_one", "one_for_all", "rest_for_one", "simple_one_for_one")
    root = [supervisor(strategy) for strategy in strategies]
    with tempfile.TemporaryDirectory() as state, rr.System(root, state_dir=state) as system:
        print(f"{'SIGKILL to b':20}     a     b     c", flush=True)
        for strategy in strategies:
            show(system, strategy)
