"""Program: the motor driver. It turns the wheels as it is told, gently, and stops when nobody tells it any more."""

from __future__ import annotations

import argparse

from mission.corridor import wheels
from mission.wire import Publisher, Subscriber, every

PERIOD_S = 0.04
STALE_S = 0.3  # a command older than this counts no more
ACCELERATION = 1.0  # m/s^2


def main() -> None:
    options = _options()
    motors, orders = Subscriber(options.motors), Publisher(options.listen)
    target, age_s = (0.0, 0.0), 0.0
    current = (0.0, 0.0)
    print("driving", flush=True)
    for elapsed_s in every(PERIOD_S / options.speed):
        dt_s = elapsed_s * options.speed
        age_s += dt_s
        for order in orders.poll():
            target, age_s = wheels(order["speed"], order["turn"]), 0.0
        if age_s > STALE_S:
            target = (0.0, 0.0)
        current = approach(current, target, ACCELERATION * dt_s)
        motors.poll()
        motors.send({"wheels": current})
        if motors.latest:
            orders.publish({"pose": motors.latest["pose"]})  # odometry


def approach(current: tuple[float, float], target: tuple[float, float], step: float) -> tuple[float, float]:
    """Wheel speeds on the way from `current` to `target`, the difference between the wheels without delay."""
    now, then = sum(current) / 2, sum(target) / 2
    speed = now + max(-step, min(step, then - now))
    half = (target[1] - target[0]) / 2
    return speed - half, speed + half


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--motors", required=True, help="socket of the world's motors")
    parser.add_argument("--listen", required=True, help="socket to be told at, which publishes odometry")
    parser.add_argument("--speed", type=float, default=1.0, help="how much faster than real")
    return parser.parse_args()


if __name__ == "__main__":
    main()
