"""Rebinding: a camera gives ranges until it is killed, then a lidar, later the camera again. One loop reads them all.

python examples/rebinding.py
"""

from __future__ import annotations

import os
import signal
import tempfile
import threading
import time

import rr_actors as rr
from rr_actors.managers import Alternative, Choices, Choose


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


RATES = {"camera": 60, "lidar": 30}  # readings in a second
SENSORS = [Alternative("range", f"{name}/sensor", provides={"rate_hz": rate}) for name, rate in RATES.items()]


def main() -> None:
    children = [rr.ChildSpec(Sensors, id=name, args=(rate,)) for name, rate in RATES.items()]
    children.append(rr.ChildSpec(Choices, id="choices", args=(SENSORS, 1.0)))
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        choice = system.open_registrar("app").load("choices/choice", Choose("range", {"rate_hz": ">=10"}, ["rate_hz"]))
        began = last = since = time.monotonic()
        used, seen = [""], {name: set[int]() for name in RATES}
        for reading in choice.stream("ranges", timeout_s=30):
            (name, pid), now = reading.value, time.monotonic()
            if name != used[-1]:
                print(f"{now - began:4.1f} s  {name:<6}  after {(now - last) * 1000:3.0f} ms", flush=True)
                used, since = [*used, name], now
                if len(used) == 2:  # the first
                    threading.Timer(1.0, os.kill, (pid, signal.SIGKILL)).start()
            seen[name].add(int(10 * (now - began)))
            last = now
            if len(used) == 4 and now > since + 1:
                break
        for name, tenths in seen.items():
            print(f"{name:<6}  " + "".join("█" if i in tenths else " " for i in range(max(tenths) + 1)))


if __name__ == "__main__":
    main()
