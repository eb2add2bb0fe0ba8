"""The corridor around a corner, and a differential-drive robot's motion and sight in it: pure functions.

Metres, seconds, radians; x to the east, y to the north, heading 0 to the east, counter-clockwise.
"""

from __future__ import annotations

import math
import random
from typing import NamedTuple

WIDTH_M = 2.0
WHEEL_BASE_M = 0.4
RANGE_M = 8.0  # how far a lidar sees


class Point(NamedTuple):
    x: float
    y: float


class Pose(NamedTuple):
    x: float
    y: float
    heading: float


START = Point(0.0, 0.0)
CORNER = Point(8.5, 0.0)
GOAL = Point(8.5, 7.0)
ROUTE = (START, CORNER, GOAL)

_HALF = WIDTH_M / 2
OUTLINE = (  # the walls, one after the other, closed
    Point(START.x - 1.0, -_HALF),
    Point(CORNER.x + _HALF, -_HALF),
    Point(CORNER.x + _HALF, GOAL.y + 1.0),
    Point(CORNER.x - _HALF, GOAL.y + 1.0),
    Point(CORNER.x - _HALF, _HALF),
    Point(START.x - 1.0, _HALF),
)
WALLS = tuple(zip(OUTLINE, OUTLINE[1:] + OUTLINE[:1], strict=True))


def distance(a: Point | Pose, b: Point | Pose) -> float:
    return math.hypot(a.x - b.x, a.y - b.y)


def turned(angle: float) -> float:
    """The same angle between -pi and pi."""
    return math.remainder(angle, math.tau)


def moved(pose: Pose, left: float, right: float, dt_s: float) -> Pose:
    """Where a robot is after its wheels have run at these speeds (m/s) for `dt_s` seconds."""
    speed, turn = (left + right) / 2, (right - left) / WHEEL_BASE_M
    heading = pose.heading + turn * dt_s / 2  # half-way: second order, so that the step hardly matters
    return Pose(
        pose.x + speed * dt_s * math.cos(heading),
        pose.y + speed * dt_s * math.sin(heading),
        turned(pose.heading + turn * dt_s),
    )


def wheels(speed: float, turn: float) -> tuple[float, float]:
    """Speeds of the left and right wheel (m/s) that give this speed (m/s) and turn rate (rad/s)."""
    return speed - turn * WHEEL_BASE_M / 2, speed + turn * WHEEL_BASE_M / 2


def is_inside(point: Point | Pose) -> bool:
    """Whether a point is between the walls."""
    return (START.x - 1.0 < point.x < CORNER.x + _HALF and abs(point.y) < _HALF) or (
        abs(point.x - CORNER.x) < _HALF and -_HALF < point.y < GOAL.y + 1.0
    )


def free_way(pose: Pose, angle: float) -> float:
    """How far it is from the robot to the nearest wall, in the direction `angle` from its heading."""
    dx, dy = math.cos(pose.heading + angle), math.sin(pose.heading + angle)
    nearest = RANGE_M
    for a, b in WALLS:
        ex, ey = b.x - a.x, b.y - a.y
        across = dx * ey - dy * ex
        if abs(across) < 1e-9:
            continue  # parallel
        ax, ay = a.x - pose.x, a.y - pose.y
        along_ray, along_wall = (ax * ey - ay * ex) / across, (ax * dy - ay * dx) / across
        if along_ray >= 0.0 and -1e-9 <= along_wall <= 1.0 + 1e-9:
            nearest = min(nearest, along_ray)
    return nearest


def scan(pose: Pose, beams: int, noise_m: float, chance: random.Random) -> list[float]:
    """Distances to the walls, from `-pi/2` to `pi/2` around the heading, as a lidar measures them."""
    return [
        max(0.0, free_way(pose, math.pi * (i / (beams - 1) - 0.5)) + chance.gauss(0.0, noise_m)) for i in range(beams)
    ]
