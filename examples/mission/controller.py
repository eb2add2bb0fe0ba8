"""Program: the robot's controller. It drives along the corridor by odometry and scans, and stands while it is blind.

It is told, as often as you like, which lidar to look through and whether to go.
"""

from __future__ import annotations

import argparse

from mission.corridor import Pose
from mission.navigator import STAND, Command, has_arrived, steer
from mission.wire import Publisher, Subscriber, every

PERIOD_S = 0.05
STALE_S = 0.3  # a scan older than this counts no more: three were missed


def main() -> None:
    options = _options()
    orders, driver = Publisher(options.listen), Subscriber(options.driver)
    lidar: Subscriber | None = None
    go = False
    print("in control", flush=True)
    for _ in every(PERIOD_S / options.speed):
        for order in orders.poll():
            go = order["go"]
            if go and (lidar is None or order["lidar"] != lidar.path):
                lidar = _look_through(order["lidar"], lidar)
        driver.poll()
        if lidar:
            lidar.poll()
        state, command = decide(driver, lidar, STALE_S / options.speed) if go else ("waiting", STAND)
        driver.send(command._asdict())
        orders.publish({"state": state})


def decide(driver: Subscriber, lidar: Subscriber | None, stale_s: float) -> tuple[str, Command]:
    """What to do now, and why."""
    if driver.latest is None or driver.age_s() > stale_s:
        return "standing: no odometry", STAND
    if lidar is None or lidar.latest is None or lidar.age_s() > stale_s:
        return "standing: no scan", STAND
    pose = Pose(*driver.latest["pose"])
    return "arrived" if has_arrived(pose) else "driving", steer(pose, lidar.latest["ranges"])


def _look_through(path: str, before: Subscriber | None) -> Subscriber:
    """Change to another lidar; the last scan of the one before still counts until it is stale."""
    lidar = Subscriber(path)
    if before is not None:
        lidar.latest, lidar.latest_at = before.latest, before.latest_at
        before.close()
    return lidar


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--driver", required=True, help="socket of the motor driver")
    parser.add_argument("--listen", required=True, help="socket to be told at, which publishes the state")
    parser.add_argument("--speed", type=float, default=1.0, help="how much faster than real")
    return parser.parse_args()


if __name__ == "__main__":
    main()
