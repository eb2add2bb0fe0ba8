"""A frozen child: its process lives, and stands still. No signal says so.

A supervisor with a heartbeat asks the child's process twice in that time whether it still answers.

Look for: the number of the process, before and after the pause; the reason of its end in the events, if it ends.

Why: a process that has not answered for as long as its heartbeat counts as hung. It is killed, and another one is
started. Without a heartbeat, or with one that is longer than the pause, it goes on as if nothing had happened, and
what was asked meanwhile is answered late.
"""

# /// lab
# place = 7
# question = "The process stands still for 6 s. What will become of it?"
# levers = [
#     {name = "heartbeat_s", label = "heartbeat in seconds; 0 is none", choices = [1.0, 3.0, 0.0]},
# ]
# [answers]
# "another process takes its place" = {event = "restarted", path = "root/lidar"}
# "it goes on after that" = {}
# ///

from __future__ import annotations

import os
import signal
import time

import rr_actors as rr


class Lidar(rr.Actor):
    def on_receive(self, message: object) -> int:
        return os.getpid()


def main(state_dir: str, heartbeat_s: float = 1.0) -> None:
    lidar = rr.ChildSpec(Lidar, id="lidar", heartbeat_s=heartbeat_s or None)
    with rr.System([lidar], state_dir=state_dir) as system:
        first = system.ref("lidar").ask("who?", timeout=20)
        time.sleep(3)
        print(f"SIGSTOP: process {first} stands still", flush=True)
        os.kill(first, signal.SIGSTOP)
        time.sleep(6)
        try:
            os.kill(first, signal.SIGCONT)
            print(f"SIGCONT: process {first} goes on", flush=True)
        except ProcessLookupError:
            print(f"process {first} is no longer there", flush=True)
        second = system.ref("lidar").ask("who?", timeout=20)
        print("the same process answers" if second == first else f"process {second} answers", flush=True)
        time.sleep(4)
