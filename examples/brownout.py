"""Brownout: devices share 100 W. When that is not enough, the least urgent are switched off, and later on again.

python examples/brownout.py
"""

from __future__ import annotations

import tempfile

import rr_actors as rr
from rr_actors.managers import Budgets, Pool, Share

DEVICES = {"pump": (9, 40), "arm": (8, 20), "map": (6, 20), "camera": (4, 20), "lamp": (2, 20), "radio": (1, 20)}


class Devices(rr.Manager):
    @rr.server("device")
    def switch_on(self, name: str) -> str:
        self.registrar.load("budgets/share", Share("watts", DEVICES[name][1], wait_s=60), timeout_s=90)
        return name


class Operator:
    def __init__(self, system: rr.System) -> None:
        self.app, self.budgets = system.open_registrar("app"), system.ref("budgets").proxy()
        self.most = 0.0

    def switch_on(self, name: str) -> None:
        def on_status(status: rr.Status) -> None:
            if status.reason == "revoked":
                self.switch_on(name)

        priority = DEVICES[name][0]
        self.app.load("devices/device", name, priority=priority, on_status=on_status, timeout_s=90, block=False)

    def show(self, what: str, *names: str) -> None:  # when these alone are on; meanwhile it looks how much is in use
        while set(names) != {query.response for query in self.app.queries() if query.state != "FATAL"}:
            self.most = max(self.most, self.budgets.pools().get()[0].used)
        print(f"{what:<20} {', '.join(names)}", flush=True)


def main() -> None:
    children = [rr.ChildSpec(Budgets, id="budgets", args=([Pool("watts", 100)],)), rr.ChildSpec(Devices, id="devices")]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        operator = Operator(system)
        for name in ("radio", "lamp", "camera", "map", "arm"):
            operator.switch_on(name)
        operator.show("100 W", "radio", "lamp", "camera", "map", "arm")
        operator.switch_on("pump")
        operator.show("the pump needs 40 W", "camera", "map", "arm", "pump")
        print(f"at most {operator.most:g} W were in use")
        operator.budgets.set_capacity("watts", 60).get()
        operator.show("60 W", "arm", "pump")
        operator.budgets.set_capacity("watts", 100).get()
        operator.show("100 W again", "camera", "map", "arm", "pump")


if __name__ == "__main__":
    main()
