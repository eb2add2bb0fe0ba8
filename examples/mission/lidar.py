"""Program: a lidar. It looks around from where the robot is, ten times a second, and publishes what it measures.

SIGUSR1 disconnects its device: the program lives on, measures nothing, and is silent.
"""

from __future__ import annotations

import argparse
import random
import signal
import time

from mission.corridor import Pose, scan
from mission.wire import Publisher, Subscriber, every

PERIOD_S = 0.1
BEAMS = 61
LINE_S = 0.2  # between two lines of output


def main() -> None:
    options = _options()
    world, scans = Subscriber(options.world), Publisher(options.publish)
    chance = random.Random(options.seed)
    device = Device()
    signal.signal(signal.SIGUSR1, lambda *_: device.disconnect())
    print("scanning", flush=True)
    said_at = time.monotonic()
    for _ in every(PERIOD_S / options.speed):
        world.poll()
        scans.poll()
        if world.latest and device.is_connected:
            ranges = scan(Pose(*world.latest["pose"]), BEAMS, options.noise, chance)
            scans.publish({"time_s": world.latest["time_s"], "ranges": [round(metres, 3) for metres in ranges]})
            if time.monotonic() - said_at >= LINE_S:
                said_at = time.monotonic()
                print(f"scanned at {world.latest['time_s']:.1f} s", flush=True)


class Device:
    """What measures. It is connected again for the next program."""

    def __init__(self) -> None:
        self.is_connected = True

    def disconnect(self) -> None:
        """Have it measure nothing any more."""
        self.is_connected = False


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--world", required=True, help="socket that publishes the robot's pose")
    parser.add_argument("--publish", required=True, help="socket to publish scans at")
    parser.add_argument("--noise", type=float, default=0.01, help="standard deviation of a distance (m)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--speed", type=float, default=1.0, help="how much faster than real")
    return parser.parse_args()


if __name__ == "__main__":
    main()
