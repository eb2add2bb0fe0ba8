"""A restart storm against the intensity window: a child that always fails, and a supervisor that counts.

A supervisor allows some restarts within some seconds. `branch` has a child that fails again and again, and an innocent
one. `root`, above it, allows one restart.

Look for: the squares in the boxes of `branch` and `root`, which fill up; what becomes of the innocent child.

Why: at one restart more than it allows, `branch` stops all its children, the innocent one too, and ends. `root` starts
it again, once. The new `branch` fails in the same way, and that is one restart too many for `root`: it ends, and with
it the whole tree.
"""

# /// lab
# place = 3
# question = "The child broken fails again and again. Which of them will give up?"
# levers = [
#     {name = "max_restarts", label = "intensity: restarts within 15 s", choices = [3, 1, 2]},
# ]
# [answers]
# branch = {event = "restarted", path = "root/branch"}
# "root, too" = {prints = "the tree has ended: shutdown"}
# "none of them" = {}
# ///

from __future__ import annotations

import time

import rr_actors as rr


class Broken(rr.Actor):
    def on_start(self) -> None:
        self.actor_ref.tell("work")

    def on_receive(self, message: object) -> None:
        time.sleep(1.5)
        raise ValueError("the device does not answer")


class Innocent(rr.Actor):
    pass


def main(state_dir: str, max_restarts: int = 3) -> None:
    children = [rr.ChildSpec(Innocent, id="innocent"), rr.ChildSpec(Broken, id="broken")]
    branch = rr.Supervisor(children, id="branch", max_restarts=max_restarts, max_seconds=15)
    with rr.System(rr.Supervisor([branch], max_restarts=1, max_seconds=60), state_dir=state_dir) as system:
        print(f"broken fails 1.5 s after each start; restarts allowed within 15 s: {max_restarts}", flush=True)
        system.wait(60)
        print(f"the tree has ended: {system.ended.reason if system.ended else 'not yet'}", flush=True)
        time.sleep(3)
        system.stop()  # else the end of the block would raise that the tree has given up
