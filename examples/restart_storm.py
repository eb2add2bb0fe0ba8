"""A restart storm: a child that always fails is restarted as often as its supervisor allows, and not once more.

Restart intensity is a sliding window: more than max_restarts restarts within max_seconds, and the supervisor stops its
other children and ends itself, with the reason "shutdown". Whoever supervises it decides what comes next.

python examples/restart_storm.py
"""

from __future__ import annotations

import tempfile
import threading
from typing import Any

import rr_actors as rr


class Broken(rr.Actor):
    def on_start(self) -> None:
        self.actor_ref.tell("work")

    def on_receive(self, message: object) -> None:
        raise ValueError("the device does not answer")


class Innocent(rr.Actor):
    pass


def main() -> None:
    ended = threading.Event()

    def show(event: dict[str, Any]) -> None:
        if event["event"] in ("exited", "restarted", "stopped"):
            print(f"{event['path']}: {event['event']} {event.get('reason', '')}".rstrip(), flush=True)
        if event["event"] == "gave_up":
            print(f"{event['restarts']} restarts needed within 5 s, 3 allowed: it gives up", flush=True)
        if event["event"] == "ended":
            print(f"the supervisor has ended: {event['reason']}", flush=True)
            ended.set()

    children = [rr.ChildSpec(Innocent, id="innocent"), rr.ChildSpec(Broken, id="broken")]
    root = rr.Supervisor(children, max_restarts=3, max_seconds=5.0)
    with tempfile.TemporaryDirectory() as state:
        system = rr.System(root, state_dir=state)
        system.subscribe(show)
        try:
            with system:
                ended.wait(20)
        except rr.SupervisionError as error:  # a program that does not catch it ends with exit code 1
            print(f"the program hears it, too: {type(error.__cause__).__name__}", flush=True)


if __name__ == "__main__":
    main()
