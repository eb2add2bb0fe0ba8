"""Escalation through three levels: what the lowest supervisor cannot cure, the next one tries by a wider restart.

python examples/escalation.py
"""

from __future__ import annotations

import os
import queue
import signal
import tempfile
from typing import Any

import rr_actors as rr


class Motor(rr.Actor):
    def on_receive(self, message: object) -> int:
        return os.getpid()


def main() -> None:
    wheel = rr.Supervisor([rr.ChildSpec(Motor, id="motor")], id="wheel", max_restarts=1, max_seconds=60)
    both: list[rr.ChildSpec | rr.Supervisor] = [rr.ChildSpec(Motor, id="battery"), wheel]
    base = rr.Supervisor(both, id="base", strategy="one_for_all", max_restarts=1, max_seconds=60)
    restarted: queue.Queue[str] = queue.Queue()

    def show(event: dict[str, Any]) -> None:
        if event["event"] == "gave_up":
            print(f"  {event['path'].rpartition('/')[0]}: gives up", flush=True)
        if event["event"] == "restarted":
            print(f"  {event['path']}: restarted", flush=True)
            restarted.put(event["path"])

    with tempfile.TemporaryDirectory() as state:
        system = rr.System(rr.Supervisor([base], max_restarts=1), state_dir=state)
        system.subscribe(show)
        with system:
            motor = system.ref("root/base/wheel/motor")
            for cured_by in ("root/base/wheel/motor", "root/base/wheel", "root/base/wheel/motor", "root/base"):
                print("SIGKILL to the motor", flush=True)
                os.kill(motor.ask("who?"), signal.SIGKILL)
                while restarted.get(timeout=10) != cured_by:
                    pass
            print(system.tree(), flush=True)


if __name__ == "__main__":
    main()
