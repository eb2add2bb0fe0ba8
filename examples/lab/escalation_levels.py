"""Escalation: failures at the lowest of three supervisors.

The motor is killed, as often as you choose. Above it are the supervisors `wheel`, `base` and `root`. Each allows one
restart within a minute.

Look for: what starts again at each kill: the motor alone, or more.

Why: each supervisor has a window of its own. At the second kill `wheel` gives up, and `base` starts the battery and the
wheel again, as it is one_for_all. The new wheel allows one restart again, so the third kill costs the motor alone. At
the fourth the wheel gives up once more. That is one restart too many for `base`, and `root` starts everything again.
"""

# /// lab
# place = 4
# question = "The motor is killed. Which supervisors will be started again in the end?"
# levers = [
#     {name = "kills", label = "kills", choices = [4, 1, 2, 3]},
# ]
# [answers]
# wheel = {event = "restarted", path = "root/base/wheel"}
# base = {event = "restarted", path = "root/base"}
# "none: the motor alone" = {}
# ///

from __future__ import annotations

import os
import signal
import time

import rr_actors as rr


class Part(rr.Actor):
    def on_receive(self, message: object) -> int:
        return os.getpid()


def main(state_dir: str, kills: int = 4) -> None:
    wheel = rr.Supervisor([rr.ChildSpec(Part, id="motor")], id="wheel", max_restarts=1, max_seconds=60)
    parts: list[rr.ChildSpec | rr.Supervisor] = [rr.ChildSpec(Part, id="battery"), wheel]
    base = rr.Supervisor(parts, id="base", strategy="one_for_all", max_restarts=1, max_seconds=60)
    with rr.System(rr.Supervisor([base], max_restarts=1, max_seconds=60), state_dir=state_dir) as system:
        motor = system.ref("root/base/wheel/motor")
        for number in range(1, kills + 1):
            time.sleep(4)
            print(f"kill {number}: SIGKILL to the motor", flush=True)
            os.kill(motor.ask("who?", timeout=20), signal.SIGKILL)
        time.sleep(5)
