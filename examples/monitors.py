"""Monitors: an actor watches others, in whatever process they are, and hears once of the end of each, and why.

python examples/monitors.py
"""

from __future__ import annotations

import tempfile
import time
from typing import Any

import rr_actors as rr


class Worker(rr.Actor):
    def on_receive(self, message: str) -> None:
        if message == "fail":
            raise ValueError("no such device")
        if message == "end":
            self.stop()


class Watcher(rr.Actor):
    heard = 0

    def on_receive(self, message: Any) -> int:
        match message:
            case rr.Down(ref, reason, detail):
                print(f"{ref}: {reason}{f' ({detail})' if reason == 'abnormal' else ''}", flush=True)
                self.heard += 1
            case rr.ActorRef():
                self.monitor(message)
        return self.heard


def main() -> None:
    workers = [rr.ChildSpec(Worker, id=id, restart="temporary") for id in ("a", "b", "c", "d")]
    watcher = rr.ChildSpec(Watcher, id="watcher")
    with tempfile.TemporaryDirectory() as state, rr.System([*workers, watcher], state_dir=state) as system:
        a, b, c, _ = refs = [system.ref(worker.id) for worker in workers]
        watching = system.ref("watcher")
        for ref in refs:
            watching.ask(ref)
        downs = [rr.monitor(ref) for ref in refs]  # the same from ordinary code
        a.tell("end")
        downs[0].wait(10)
        b.tell("fail")
        downs[1].wait(10)
        c.kill()  # SIGKILL
        downs[2].wait(10)
        system.supervisor().terminate_child("d")
        watching.ask(a)  # dead already: it hears of that, too
        while watching.ask("how many?") < 5:
            time.sleep(0.01)


if __name__ == "__main__":
    main()
