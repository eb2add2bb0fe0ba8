"""A hung child: its process lives and does not answer. Its heartbeat finds it, and it is replaced.

A slow callback is no reason: the heartbeat asks the process's loop, on which no code of yours runs.

python examples/hung_child.py
"""

from __future__ import annotations

import ctypes
import os
import tempfile
import threading
import time

import rr_actors as rr


class Worker(rr.Actor):
    def on_receive(self, message: object) -> object:
        if message == "be slow":
            time.sleep(2.5)
        if message == "hang":
            ctypes.PyDLL(None).sleep(3600)  # keeps the interpreter to itself: no other thread of the process runs
        return os.getpid()


def main() -> None:
    children = [rr.ChildSpec(Worker, id="worker", heartbeat_s=1.0)]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        worker = system.ref("worker")
        first = worker.ask("who?")
        print("slow for two heartbeats, and still the same:", worker.ask("be slow") == first, flush=True)

        replaced = threading.Event()
        system.subscribe(lambda event: replaced.set() if event["event"] == "restarted" else None)
        print("now it hangs, for ever", flush=True)
        worker.tell("hang")
        replaced.wait(10)
        print("replaced by another process:", worker.ask("who?") != first, flush=True)
        (record,) = [record for record in system.supervisor().history() if record.event == "exited"]
        print("why:", record.detail, flush=True)


if __name__ == "__main__":
    main()
