"""A restart storm against the intensity window: a child that always fails, and a supervisor that counts.

A supervisor allows some restarts within some seconds. At one more, it stops all its children and ends. The supervisor
above it decides what follows: here it starts the whole branch again, once.

Look for: the squares in the box of `branch`, which fill up; its innocent child, which is stopped with it; then the
squares of `root`. In the end nothing runs.
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
        print(f"broken fails 1.5 s after each start; {max_restarts} restarts within 15 s are allowed", flush=True)
        system.wait(60)
        print(f"the tree has ended: {system.ended.reason if system.ended else 'not yet'}", flush=True)
        time.sleep(3)
        system.stop()  # else the end of the block would raise that the tree has given up
