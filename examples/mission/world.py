"""Program: the world. It knows where the robot is, moves it as its wheels turn, and publishes the pose.

The motors listen to whoever is connected to MOTORS, and stop when nobody is: a driver that dies leaves the robot
standing where it is, and its successor finds it there.
"""

from __future__ import annotations

import argparse

from mission.corridor import START, Pose, distance, is_inside, moved
from mission.wire import Publisher, every

STEP_S = 0.02


def main() -> None:
    options = _options()
    poses, motors = Publisher(options.poses), Publisher(options.motors)
    pose, driven, clock = Pose(*START, 0.0), 0.0, 0.0
    left = right = 0.0
    print("the world is there", flush=True)
    for elapsed_s in every(STEP_S / options.speed):
        for order in motors.poll():
            left, right = order["wheels"]
        if not motors.clients:
            left = right = 0.0
        dt_s = elapsed_s * options.speed
        there = moved(pose, left, right, dt_s)
        if is_inside(there):  # else it pushes against the wall
            driven += distance(pose, there)
            pose = there
        clock += dt_s
        message = {"time_s": clock, "pose": pose, "speed": (left + right) / 2, "driven_m": driven}
        motors.publish(message)
        poses.poll()
        poses.publish(message)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", required=True, help="socket that publishes the robot's pose")
    parser.add_argument("--motors", required=True, help="socket of the motors, which publishes it to the driver")
    parser.add_argument("--speed", type=float, default=1.0, help="how much faster than real")
    return parser.parse_args()


if __name__ == "__main__":
    main()
