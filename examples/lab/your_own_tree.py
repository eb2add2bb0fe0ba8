"""A tree of your own: you choose the strategy, the intensity, the child that is killed, and how often.

The supervisor `team` has three children. Its intensity is the number of restarts that it allows within a minute.

Look for: the children that start again with the killed one; the squares in the box of `team`, which count its restarts;
a mark at `team` itself.

Why: the strategy says which children start again with the killed one. The intensity says how often. At one kill more,
the team gives up: it stops all its children and ends, and `root` starts the whole team again.
"""

# /// lab
# place = 2
# question = "What will the supervisor team do?"
# levers = [
#     {name = "strategy", label = "strategy", choices = ["one_for_one", "one_for_all", "rest_for_one"]},
#     {name = "max_restarts", label = "intensity: restarts within 60 s", choices = [2, 0, 1, 3]},
#     {name = "kills", label = "kills", choices = [1, 2, 3, 4]},
#     {name = "child", label = "killed child", choices = ["b", "a", "c"]},
# ]
# [answers]
# "restart a" = {event = "restarted", path = "root/team/a"}
# "restart b" = {event = "restarted", path = "root/team/b"}
# "restart c" = {event = "restarted", path = "root/team/c"}
# "give up" = {event = "restarted", path = "root/team"}
# ///

from __future__ import annotations

import os
import signal
import time
from typing import Any

import rr_actors as rr


class Worker(rr.Actor):
    def on_receive(self, message: object) -> int:
        return os.getpid()


def main(
    state_dir: str, strategy: Any = "one_for_one", max_restarts: int = 2, kills: int = 1, child: str = "b"
) -> None:
    children = [rr.ChildSpec(Worker, id=id) for id in "abc"]
    team = rr.Supervisor(children, id="team", strategy=strategy, max_restarts=max_restarts, max_seconds=60)
    with rr.System([team], state_dir=state_dir) as system:
        worker = system.ref(f"root/team/{child}")
        for number in range(1, kills + 1):
            time.sleep(3)
            print(f"kill {number}: SIGKILL to {child}", flush=True)
            os.kill(worker.ask("who?", timeout=20), signal.SIGKILL)
        time.sleep(4)
