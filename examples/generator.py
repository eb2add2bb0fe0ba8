"""Generator: a reserve that starts when devices need more than there is, before any of them is switched off.

python examples/generator.py
"""

from __future__ import annotations

import tempfile
import time

import rr_actors as rr
from rr_actors.managers import Budgets, Pool, Reserve, Share, Supply

DEVICES = {"alarm": (9, 40), "pump": (8, 40), "arm": (6, 40), "camera": (4, 20), "lamp": (2, 20), "radio": (1, 20)}
POOL = Pool("watts", 100, reserve=(Reserve("devices/generator", 40, "diesel"),))


class Devices(rr.Manager):
    @rr.server("device")
    def switch_on(self, name: str) -> str:
        self.registrar.load("budgets/share", Share("watts", DEVICES[name][1]), timeout_s=60)
        return name

    @rr.server("generator")
    def start_generator(self, fuel: str) -> None:
        self.registrar.load("budgets/supply", Supply("watts", 40))


class Operator:
    def __init__(self, system: rr.System) -> None:
        self.app, self.budgets = system.open_registrar("app"), system.ref("budgets").proxy()

    def switch_on(self, *names: str) -> None:
        """Switch devices on, and look each millisecond whether all use more than there is."""
        for name in names:
            self.app.load("devices/device", name, priority=DEVICES[name][0], timeout_s=60, block=False)
        most_over, on = 0.0, set[str]()
        while not on.issuperset(names):
            (pool,) = self.budgets.pools().get()
            most_over = max(most_over, pool.used - pool.capacity)
            time.sleep(0.001)
            on = {query.response for query in self.app.queries() if query.state == "OK"}
        (pool,) = self.budgets.pools().get()
        print(f"{pool.used:g} of {pool.capacity:g} W, {most_over:g} W too much: {', '.join(sorted(on))}")


def main() -> None:
    children = [rr.ChildSpec(Budgets, id="budgets", args=([POOL], 60.0)), rr.ChildSpec(Devices, id="devices")]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        operator = Operator(system)
        operator.switch_on("radio", "lamp", "camera", "arm")
        operator.switch_on("pump")  # the generator starts, and nobody is switched off
        operator.switch_on("alarm")  # now the two that are the least urgent are


if __name__ == "__main__":
    main()
