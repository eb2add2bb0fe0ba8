"""Brownout: devices share 100 W, and there is not enough for all.

Each device is a resource, and holds a share of the pool as long as it is on. The operator gives each a priority, from 1
for the radio to 5 for the arm. For a device that was switched off he asks again, and it waits for room.

Look for: the resources that are unloaded before the pump is on; the ones that come back, and in which order, when there
is power again.

Why: a share of a higher priority takes the room of the least urgent ones, as many as it needs and no more. Of two
equal ones nobody gives way. When there is room again, the most urgent of those that wait gets it first.
"""

# /// lab
# place = 13
# question = "Five devices of priorities 1 to 5 use all there is, 20 W each. Which are switched off for the pump?"
# levers = [
#     {name = "priority", label = "priority of the pump, which needs 40 W", choices = [9, 2]},
#     {name = "capacity", label = "then as much is left, in W", choices = [60, 80, 40]},
# ]
# [answers]
# radio = {prints = "radio is switched off for the pump"}
# lamp = {prints = "lamp is switched off for the pump"}
# camera = {prints = "camera is switched off for the pump"}
# arm = {prints = "arm is switched off for the pump"}
# "nobody: the pump waits" = {}
# ///

from __future__ import annotations

import time

import rr_actors as rr
from rr_actors.managers import Budgets, Pool, Share

WATTS = {"radio": 20, "lamp": 20, "camera": 20, "map": 20, "arm": 20, "pump": 40}


class Devices(rr.Manager):
    @rr.server("device")
    def switch_on(self, name: str) -> str:
        self.registrar.load("budgets/share", Share("watts", WATTS[name], wait_s=60), timeout_s=90)
        return name


class Operator:
    def __init__(self, system: rr.System) -> None:
        self.app, self.step = system.open_registrar("app"), ""

    def switch_on(self, name: str, priority: int) -> None:
        def on_status(status: rr.Status) -> None:
            if status.reason == "revoked":
                print(f"{name} is switched off {self.step}", flush=True)
                self.switch_on(name, priority)

        self.app.load("devices/device", name, priority=priority, on_status=on_status, timeout_s=90, block=False)

    def next(self, step: str) -> None:
        self.step = step
        print(step, flush=True)

    def show(self) -> None:
        time.sleep(4)
        print("on:", *sorted(query.response for query in self.app.queries() if query.state == "OK"), flush=True)


def main(state_dir: str, priority: int = 9, capacity: int = 60) -> None:
    children = [rr.ChildSpec(Budgets, id="budgets", args=([Pool("watts", 100)],)), rr.ChildSpec(Devices, id="devices")]
    with rr.System(children, state_dir=state_dir) as system:
        operator, budgets = Operator(system), system.ref("budgets").proxy()
        time.sleep(2)
        for number, name in enumerate(("radio", "lamp", "camera", "map", "arm")):
            operator.switch_on(name, priority=number + 1)
        operator.show()
        operator.next("for the pump")
        operator.switch_on("pump", priority)
        operator.show()
        operator.next(f"for {capacity} W")
        budgets.set_capacity("watts", capacity).get()
        operator.show()
        operator.next("100 W again")
        budgets.set_capacity("watts", 100).get()
        operator.show()
