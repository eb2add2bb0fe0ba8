"""Monitors: an actor watches others, in whatever process they are, and hears once of the end of each, and why.

python examples/monitors.py
"""

from __future__ import annotations

import os
import signal
import tempfile
from typing import Any

import rr_actors as rr


class Worker(rr.Actor):
    def on_receive(self, message: str) -> int:
        if message == "fail":
            raise ValueError("no such device")
        if message == "end":
            self.stop()
        return os.getpid()


class Watcher(rr.Actor):
    def on_receive(self, message: Any) -> None:
        match message:
            case rr.Down(ref, reason, detail):
                print(f"{ref}: {reason}{f' ({detail})' if reason == 'abnormal' else ''}", flush=True)
            case rr.ActorRef():
                self.monitor(message)


def main() -> None:
    workers = [rr.ChildSpec(Worker, id=id, restart="temporary") for id in ("a", "b", "c", "d")]
    watcher = rr.ChildSpec(Watcher, id="watcher")
    with tempfile.TemporaryDirectory() as state, rr.System([*workers, watcher], state_dir=state) as system:
        a, b, c, _ = refs = [system.ref(worker.id) for worker in workers]
        pid = c.ask("who?")
        for ref in refs:
            system.ref("watcher").ask(ref)

        downs = [rr.monitor(ref) for ref in refs]  # the same from ordinary code
        a.tell("end")
        downs[0].wait(10)
        b.tell("fail")
        downs[1].wait(10)
        os.kill(pid, signal.SIGKILL)
        downs[2].wait(10)
        system.supervisor().terminate_child("d")
        system.ref("watcher").ask(a)  # dead already: it hears of that, too
        system.ref("watcher").ask(None)  # behind it


if __name__ == "__main__":
    main()
