"""Generator: all of a battery is used, and more is needed.

The battery gives 100 W. A generator can give 40 W more. The pool names it as its reserve. It starts only if it has
fuel. The pump needs 40 W, and later the alarm 40 W more.

Look for: what the generator does while the pump waits; what becomes of the others when the alarm comes.

Why: a reserve is loaded when room is needed, before anybody is switched off, and released when it is not needed any
more. Only if it cannot be loaded, or is used already, do the least urgent ones give way.
"""

# /// lab
# place = 14
# question = "All 100 W are used, and the pump needs 40 more. What will happen?"
# levers = [
#     {name = "fuel", label = "the generator has fuel", choices = ["yes", "no"]},
# ]
# [answers]
# "the generator starts, and nobody is switched off" = {prints = "the generator runs"}
# "the arm, of the highest priority, is switched off" = {prints = "arm is switched off for the pump"}
# "the radio and the lamp are switched off" = {prints = "lamp is switched off for the pump"}
# ///

from __future__ import annotations

import functools
import time

import rr_actors as rr
from rr_actors.managers import Budgets, Pool, Reserve, Share, Supply

WATTS = {"radio": 20, "lamp": 20, "camera": 20, "arm": 40, "pump": 40, "alarm": 40}


class Devices(rr.Manager):
    def __init__(self, has_fuel: bool) -> None:
        self.has_fuel = has_fuel

    @rr.server("device")
    def switch_on(self, name: str) -> str:
        self.registrar.load("budgets/share", Share("watts", WATTS[name], wait_s=20), timeout_s=60)
        return name

    @rr.server("generator")
    def start_generator(self) -> None:
        time.sleep(2)
        if not self.has_fuel:
            raise OSError("no fuel")
        self.registrar.load("budgets/supply", Supply("watts", 40))
        print("the generator runs", flush=True)


def main(state_dir: str, fuel: str = "yes") -> None:
    pool = Pool("watts", 100, reserve=(Reserve("devices/generator", 40),))
    children = [
        rr.ChildSpec(Budgets, id="budgets", args=([pool],)),
        rr.ChildSpec(Devices, id="devices", args=(fuel == "yes",)),
    ]
    step = "in the beginning"

    def hear(name: str, status: rr.Status) -> None:
        if status.reason == "revoked":
            print(f"{name} is switched off {step}", flush=True)

    with rr.System(children, state_dir=state_dir) as system:
        app = system.open_registrar("app")
        time.sleep(2)
        for number, name in enumerate(WATTS):
            if name in ("pump", "alarm"):
                step = f"for the {name}"
                print(step, flush=True)
            heard = functools.partial(hear, name)
            app.load("devices/device", name, priority=number + 1, on_status=heard, timeout_s=60)
            if name in ("arm", "pump", "alarm"):
                time.sleep(4)
