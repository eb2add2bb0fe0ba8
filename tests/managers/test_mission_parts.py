"""The mission's parts by themselves: corridor, steering, driver, record, figures, table and views."""

from __future__ import annotations

import io
import math
import random
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))

from mission import corridor, driver, figures, navigator, table, view, wire
from mission.corridor import CORNER, GOAL, ROUTE, START, Point, Pose
from mission.record import Fault, Record, Sample, standing_s
from rich.console import Console


def test_wheels_of_equal_speed_drive_straight_and_of_opposite_speed_turn_on_the_spot() -> None:
    assert corridor.moved(Pose(1, 2, 0), 0.5, 0.5, 2.0) == pytest.approx((2, 2, 0))
    x, y, heading = corridor.moved(Pose(1, 2, 0), -0.2, 0.2, 0.5)
    assert (x, y) == pytest.approx((1, 2))
    assert heading == pytest.approx(0.5)


def test_wheel_speeds_and_motion_are_each_others_inverse() -> None:
    left, right = corridor.wheels(0.4, 0.3)
    pose = corridor.moved(Pose(0, 0, 0), left, right, 1e-3)
    assert math.hypot(pose.x, pose.y) == pytest.approx(0.4e-3)
    assert pose.heading == pytest.approx(0.3e-3)


def test_a_robot_that_turns_while_it_drives_comes_round_in_a_circle() -> None:
    pose, radius = Pose(0, 0, 0), 0.5
    steps = 1000
    for _ in range(steps):
        pose = corridor.moved(pose, *corridor.wheels(0.5, 0.5 / radius), math.tau * radius / 0.5 / steps)
    assert (pose.x, pose.y) == pytest.approx((0, 0), abs=1e-3)


@pytest.mark.parametrize(
    ("pose", "angle", "metres"),
    [
        (Pose(0, 0, 0), math.pi / 2, 1.0),
        (Pose(0, 0.5, 0), -math.pi / 2, 1.5),
        (Pose(5, 0, 0), 0.0, CORNER.x + 1 - 5),
        (Pose(5, 0, math.pi), 0.0, 6.0),
        (Pose(*CORNER, math.pi / 2), 0.0, GOAL.y + 1),
        (Pose(*CORNER, math.pi / 2), math.pi / 2, corridor.RANGE_M),  # back along the way it came: too far to see
    ],
)
def test_a_beam_is_as_long_as_the_way_to_the_wall(pose: Pose, angle: float, metres: float) -> None:
    assert corridor.free_way(pose, angle) == pytest.approx(min(metres, corridor.RANGE_M))


def test_a_scan_looks_from_right_to_left_and_is_as_noisy_as_asked() -> None:
    ranges = corridor.scan(Pose(3, 0.25, 0), 61, 0.0, random.Random(1))
    assert len(ranges) == 61
    assert (ranges[0], ranges[-1]) == pytest.approx((1.25, 0.75))
    noisy = corridor.scan(Pose(3, 0.25, 0), 61, 0.05, random.Random(1))
    assert noisy == corridor.scan(Pose(3, 0.25, 0), 61, 0.05, random.Random(1))
    assert 0.0 < max(abs(a - b) for a, b in zip(ranges, noisy, strict=True)) < 0.25


def test_inside_is_between_the_walls() -> None:
    assert corridor.is_inside(START)
    assert corridor.is_inside(CORNER)
    assert corridor.is_inside(GOAL)
    assert not corridor.is_inside(Point(0, 1.2))
    assert not corridor.is_inside(Point(5, 5))


@pytest.mark.parametrize("seed", range(3))
def test_steering_leads_to_the_goal_without_coming_near_a_wall(seed: int) -> None:
    chance = random.Random(seed)
    pose, current, nearest = Pose(*START, 0.0), (0.0, 0.0), math.inf
    step, command = 0, navigator.STAND
    for step in range(3000):
        if step % 5 == 0:
            ranges = corridor.scan(pose, 61, 0.03, chance)
            command = navigator.steer(pose, ranges)
        current = driver.approach(current, corridor.wheels(*command), 0.02)
        pose = corridor.moved(pose, *current, 0.02)
        nearest = min(nearest, *(corridor.free_way(pose, angle / 2) for angle in range(13)))
        if navigator.has_arrived(pose):
            break
    assert navigator.has_arrived(pose)
    assert step * 0.02 < 40
    assert nearest > 0.5


def test_steering_stops_before_what_is_in_front() -> None:
    assert navigator.steer(Pose(2, 0, 0), [0.3] * 61).speed == 0.0
    assert navigator.steer(Pose(2, 0, 0), [8.0] * 61).speed == pytest.approx(navigator.CRUISE)


def test_steering_turns_towards_the_middle_and_the_route() -> None:
    scan = corridor.scan(Pose(2, 0.4, 0), 61, 0.0, random.Random(1))
    assert navigator.steer(Pose(2, 0.4, 0), scan).turn < 0
    assert navigator.ahead(Pose(CORNER.x, 0, 0), ROUTE).y > 0.5
    assert navigator.has_arrived(Pose(*GOAL, 0))


def test_the_driver_changes_speed_gently_and_direction_at_once() -> None:
    assert driver.approach((0.0, 0.0), (0.5, 0.5), 0.1) == pytest.approx((0.1, 0.1))
    assert driver.approach((0.5, 0.5), (0.0, 0.0), 0.1) == pytest.approx((0.4, 0.4))
    assert driver.approach((0.2, 0.2), (0.1, 0.3), 0.1) == pytest.approx((0.1, 0.3))


# -- the wire ------------------------------------------------------------------------------------------------------


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 5
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)


def test_messages_go_both_ways_and_a_publisher_that_comes_again_is_found_again(tmp_path: Path) -> None:
    path = str(tmp_path / "s")
    subscriber = wire.Subscriber(path)
    assert subscriber.poll() == []
    for turn in range(2):
        publisher = wire.Publisher(path)
        subscriber.send({"hello": turn})
        until(lambda: publisher.poll() == [{"hello": turn}])  # noqa: B023
        publisher.publish({"turn": turn})
        until(lambda: subscriber.poll() == [{"turn": turn}])  # noqa: B023
        assert subscriber.latest == {"turn": turn}
        assert subscriber.age_s() < 1
        publisher.close()
        until(lambda: subscriber.poll() == [] and not subscriber.is_connected)
    subscriber.close()


def test_who_reads_too_slowly_misses_messages_but_gets_no_halves(tmp_path: Path) -> None:
    path = str(tmp_path / "s")
    publisher, subscriber = wire.Publisher(path), wire.Subscriber(path)
    subscriber.poll()
    publisher.poll()
    for number in range(2000):
        publisher.publish({"number": number, "filling": "x" * 1000})
    seen: list[wire.Message] = []

    def has_caught_up() -> bool:
        publisher.publish({"number": 2000, "filling": ""})
        seen.extend(subscriber.poll())
        return seen[-1]["number"] == 2000

    until(has_caught_up)
    assert len(seen) < 2000
    assert all(len(message["filling"]) in (0, 1000) for message in seen)
    publisher.close()
    subscriber.close()


# -- what is made of a run -------------------------------------------------------------------------------------------


@pytest.fixture
def record() -> Record:
    record = Record("with faults")
    for i in range(100):
        stands = 40 <= i < 60
        record.samples.append(Sample(i * 0.1, i * 0.05, 0.0, i * 0.05, 0.0 if stands else 0.5))
    record.faults = [
        Fault("F1", "lidar 1", "disconnected", 1.0, 0.5, 0.0, 0.5, 0.12),
        Fault("F2", "motor driver", "killed", 3.5, 1.75, 0.0, 1.75, 0.2),
    ]
    record.resources_left = record.processes_left = 0
    record.finish("arrived")
    return record


def test_standing_time_counts_for_the_fault_before_it(record: Record) -> None:
    assert [fault.standing_s for fault in record.faults] == pytest.approx([0.0, 2.0])
    assert record.time_s == pytest.approx(9.9)
    assert standing_s(record.samples, 0.0, 4.5) == pytest.approx(0.6)


def test_the_table_puts_the_thesis_beside_what_was_measured(record: Record) -> None:
    stopped = Record("without recovery", record.samples, record.faults[:1], resources_left=0, processes_left=0)
    stopped.finish("stopped at F1")
    stopped.faults = [Fault("F1", "lidar 1", "disconnected", 1.0, 0.5, 0.0, 0.5)]
    out = Console(file=io.StringIO(), width=110)
    out.print(table.make_table([record, stopped], 1.0))
    text = out.file.getvalue()  # type: ignore[attr-defined]
    for expected in ("43 s", "9.9 s", "stopped at F1 after 9.9 s", "2.00 s", "200 ms", "5 s", "processes left"):
        assert expected in text
    assert "F1 lidar 1 disconnected: standing" in text
    assert "simulated robot; start-up of real devices not included" in text


def test_the_figures_are_written(record: Record, tmp_path: Path) -> None:
    for path in figures.draw([record], tmp_path / "out"):
        assert path.read_bytes().startswith(b"\x89PNG")


def test_the_map_shows_the_robot_the_faults_and_the_goal(record: Record) -> None:
    text = str(view.draw_map(record))
    for sign in ("●", "★", "F1", "F2", "░"):
        assert sign in text
