"""Rebinding: a loop reads one of two sensors, and that is killed.

A choice is a resource with one part: the sensor in use. A camera gives 60 readings in a second, a lidar 30. The
consumer asks for the kind "range", and prefers many readings. One loop reads them all.

Look for: the choice, and which part it has; the camera's new process, and how long it is there before it is used.

Why: the choice looks for another sensor that gives enough readings, and takes it as its part. Its holder keeps the
choice, and the loop reads on. The camera comes back with a new process, and is on trial for the settling time before
the choice returns to it. If no sensor gives enough, the choice is lost.
"""

# /// lab
# place = 16
# question = "A loop reads the camera, until that is killed. What will the loop read then?"
# levers = [
#     {name = "settle_s", label = "seconds that the camera must be well before it is used", choices = [3.0, 30.0]},
#     {name = "at_least_hz", label = "readings in a second that the consumer needs", choices = [10, 50]},
# ]
# [answers]
# "the lidar, and later the camera again" = {prints = "it has read: camera, lidar, camera."}
# "the lidar, to the end" = {prints = "it has read: camera, lidar."}
# "nothing: it ends with an error" = {prints = "the loop ends: "}
# ///

from __future__ import annotations

import os
import signal
import threading
import time

import rr_actors as rr
from rr_actors.managers import Alternative, Choices, Choose

RATES = {"camera": 60, "lidar": 30}  # readings in a second
RUNS_S = 16.0


class Sensors(rr.Manager):
    def __init__(self, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self.off: dict[str, threading.Event] = {}  # by the id of the resource: there may be two for a while

    @rr.server("sensor", recovery="lost")  # a sensor does not outlive its process
    def open_sensor(self) -> rr.Stream:
        me = rr.current()
        ranges, off = me.open_stream("ranges"), threading.Event()

        def run() -> None:
            while not off.wait(1 / self.rate_hz):
                ranges.publish((self.registrar.name, os.getpid()))

        threading.Thread(target=run, daemon=True).start()
        self.off[me.resource_id] = off
        return ranges.stream

    @open_sensor.unload
    def close_sensor(self, response: rr.Stream | None) -> None:
        if off := self.off.pop(rr.current().resource_id, None):
            off.set()


def read(choice: rr.Query[object]) -> None:
    used, last, began = [""], time.monotonic(), time.monotonic()
    for reading in choice.stream("ranges", timeout_s=30):
        (name, pid), now = reading.value, time.monotonic()
        if name != used[-1]:
            used.append(name)
            print(f"reads the {name}, {(now - last) * 1000:.0f} ms after the reading before", flush=True)
            if len(used) == 2:  # the first
                threading.Timer(4, os.kill, (pid, signal.SIGKILL)).start()
        last = now
        if now > began + RUNS_S:
            break
    print(f"it has read: {', '.join(used[1:])}.", flush=True)


def main(state_dir: str, settle_s: float = 3.0, at_least_hz: int = 10) -> None:
    sensors = [Alternative("range", f"{name}/sensor", provides={"rate_hz": rate}) for name, rate in RATES.items()]
    children = [rr.ChildSpec(Sensors, id=name, args=(rate,)) for name, rate in RATES.items()]
    children.append(rr.ChildSpec(Choices, id="choices", args=(sensors, settle_s)))
    with rr.System(children, state_dir=state_dir) as system:
        wanted = Choose("range", {"rate_hz": f">={at_least_hz}"}, ["rate_hz"])
        choice = system.open_registrar("app").load("choices/choice", wanted)
        try:
            read(choice)
        except rr.ResourceLost as error:
            print(f"the loop ends: {error}", flush=True)
            time.sleep(4)
