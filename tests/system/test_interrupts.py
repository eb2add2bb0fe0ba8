"""A sample of tests/support_interrupts.py: Ctrl-C between any two steps of a call ends the call, and no more."""

from __future__ import annotations

import gc
import os
import sys
import threading

import pytest

from rr_actors.runtime.thread_wakeup import EventBell
from support_interrupts import HANDLERS, interrupted, run_all, scenes, system_scenes

_QUICK = (
    *("load here", "load elsewhere", "join here", "unload here", "unload elsewhere", "unload_all"),
    *("load_all", "load_all, of which one fails"),
    *("ask near", "ask far", "tell near", "queries"),
)


@pytest.mark.slow
@pytest.mark.timeout(120)
@pytest.mark.parametrize("name", _QUICK)
def test_a_call_that_is_interrupted_leaves_nothing_wedged_and_nothing_held_by_nobody(name: str) -> None:
    (result,) = run_all([name], 60, 1).values()
    assert result.found == []
    assert result.tried == 60
    assert result.raised > 30  # on a busy machine a call ends at an earlier point than it did when they were counted


@pytest.mark.slow
@pytest.mark.timeout(120)
@pytest.mark.parametrize("name", ["tell near", "load here", "unload elsewhere"])
def test_what_a_signals_handler_raises_may_be_an_exception_like_any(name: str) -> None:
    """A time limit's, say: `except Exception` must not take it for an error of what was called."""
    (result,) = run_all([name], 200, 1, raising="Exception", together=20).values()
    assert result.found == []
    assert result.tried == 200


@pytest.mark.timeout(120)
@pytest.mark.parametrize("raising", HANDLERS)
def test_interrupted_lines_to_another_process_leave_no_descriptor_open(raising: str) -> None:
    results = run_all(["load and unload elsewhere"], 600, 1, raising=raising, together=20)
    assert [found for result in results.values() for found in result.found] == []
    assert results["load and unload elsewhere"].tried == 600


@pytest.mark.timeout(120)
@pytest.mark.parametrize("what", ["start", "stop"])
def test_a_system_whose_start_or_stop_is_interrupted_can_be_started_again(what: str) -> None:
    (result,) = run_all([f"{what} a system of nothing"], 12, 1).values()
    assert result.found == []
    assert result.raised == result.tried == 12


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_a_flag_that_is_set_before_the_act_that_undoes_it_is_found() -> None:
    results = run_all(["queries"], 0, 1, plant="flag before the act")  # each point once
    assert any("afterwards" in found or "wedged" in found for found in results["queries"].found)


def test_the_interrupt_comes_at_each_point_of_a_call_and_nowhere_else() -> None:
    steps: list[str] = []
    lock = threading.Lock()

    def work() -> None:
        with lock:
            steps.append("in")
        steps.append("out")

    ends: list[list[str]] = []
    for point in range(1, 6):
        steps.clear()
        told = interrupted(work, point)
        assert not lock.locked()
        if told.was_raised:
            ends.append(list(steps))
    assert ends == [["in"], ["in"], ["in", "out"]]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # an interrupt in __del__ goes nowhere
def test_a_bell_whose_making_is_interrupted_leaves_no_descriptor_open() -> None:
    bells: list[EventBell] = []

    def make() -> None:
        bells.append(EventBell())

    points = interrupted(make, sys.maxsize).points
    bells.clear()
    gc.collect()  # of what other tests have left
    before = len(os.listdir("/proc/self/fd"))
    raised = [interrupted(make, point).was_raised for point in range(1, points + 1)]
    bells.clear()
    gc.collect()  # errors refer to frames
    assert len(os.listdir("/proc/self/fd")) == before
    assert sum(raised) >= 4


def test_each_scene_has_a_name_of_its_own() -> None:
    names = [*(scene.name for scene in scenes()), *(scene.name for scene in system_scenes())]
    assert len(names) == len(set(names))
