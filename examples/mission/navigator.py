"""How to drive along a route between walls: pure functions of pose and scan."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

from mission.corridor import ROUTE, WIDTH_M, Point, Pose, distance, turned

CRUISE = 0.5  # m/s
ARRIVED_M = 0.15
_LOOK_AHEAD_M = 0.9
_KEEP_AWAY_M = 0.35  # from what is in front
_CENTRING = 0.4  # rad/s per metre off the middle


class Command(NamedTuple):
    """What the driver is told: m/s and rad/s."""

    speed: float
    turn: float


STAND = Command(0.0, 0.0)


def steer(pose: Pose, ranges: Sequence[float], route: Sequence[Point] = ROUTE) -> Command:
    """Drive on: follow the route, keep to the middle of the corridor, and slow down before a wall."""
    if has_arrived(pose, route):
        return STAND
    target = ahead(pose, route)
    bearing = turned(math.atan2(target.y - pose.y, target.x - pose.x) - pose.heading)
    speed = CRUISE * max(0.2, math.cos(bearing))
    speed = max(0.0, min(speed, free_in_front(ranges) - _KEEP_AWAY_M, 0.1 + distance(pose, route[-1])))
    turn = 2 * speed * math.sin(bearing) / _LOOK_AHEAD_M + bearing * 0.4
    return Command(speed, turn + _CENTRING * off_centre(ranges))


def has_arrived(pose: Pose, route: Sequence[Point] = ROUTE) -> bool:
    return distance(pose, route[-1]) < ARRIVED_M


def ahead(pose: Pose, route: Sequence[Point]) -> Point:
    """The point of the route that lies a little ahead of where the robot is along it."""
    legs = list(itertools.pairwise(route))
    nearest = min(range(len(legs)), key=lambda i: distance(pose, _foot(pose, *legs[i])))
    point, left_m = _foot(pose, *legs[nearest]), _LOOK_AHEAD_M
    for _, end in legs[nearest:]:
        length = distance(point, end)
        if length >= left_m:
            return Point(point.x + (end.x - point.x) * left_m / length, point.y + (end.y - point.y) * left_m / length)
        point, left_m = end, left_m - length
    return point


def free_in_front(ranges: Sequence[float]) -> float:
    """The shortest of the beams that point ahead, within 15 degrees."""
    middle, each_side = len(ranges) // 2, len(ranges) // 12
    return min(ranges[middle - each_side : middle + each_side + 1])


def off_centre(ranges: Sequence[float]) -> float:
    """How far left the middle of the corridor is, as far as there are walls on both sides."""
    right, left = ranges[0], ranges[-1]
    return (left - right) / 2 if left + right < 1.2 * WIDTH_M else 0.0


def _foot(pose: Pose, a: Point, b: Point) -> Point:
    """The point of the leg from a to b that is nearest to the pose."""
    length = distance(a, b)
    along = ((pose.x - a.x) * (b.x - a.x) + (pose.y - a.y) * (b.y - a.y)) / length**2
    share = max(0.0, min(1.0, along))
    return Point(a.x + (b.x - a.x) * share, a.y + (b.y - a.y) * share)
