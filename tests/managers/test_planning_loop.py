"""PlanningLoop: it looks after each thing that happens, each step has one end, and an error is never its silent end."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.actors.messaging.futures import Reply
from rr_actors.managers.planning.planning_loop import Ended, PlanningLoop

Loop = PlanningLoop[str, str]
Look = Callable[[float], float | None]


class Watched:
    """A loop whose looks and failure the test waits for."""

    def __init__(self, look: Look | None = None) -> None:
        self.looks: queue.SimpleQueue[dict[str, str]] = queue.SimpleQueue()
        self.failed: queue.SimpleQueue[BaseException] = queue.SimpleQueue()
        self.ended: queue.SimpleQueue[Ended] = queue.SimpleQueue()
        self._given = look
        self.loop = Loop("test", self._look, self.failed.put)

    def _look(self, now: float) -> float | None:
        self.looks.put({key: step.what for key, step in self.loop.in_flight.items()})
        return None if self._given is None else self._given(now)

    def begin(self, reply: Reply[Any], key: str = "a") -> None:
        self.loop.tell(lambda: self.loop.begin(key, f"loads {key}", lambda: reply, self.ended.put))

    def quiet(self) -> None:
        assert self.loop.look_and_wait(60)
        while not self.looks.empty():
            self.looks.get()


@pytest.fixture
def watched() -> Iterator[Watched]:
    made = Watched()
    made.loop.start()
    yield made
    made.loop.stop()


def test_the_loop_looks_at_its_start_and_after_each_thing_that_happens(watched: Watched) -> None:
    assert watched.looks.get(timeout=60) == {}
    watched.loop.wake()
    assert watched.looks.get(timeout=60) == {}
    said = list[str]()
    watched.loop.tell(lambda: said.append("noted"))
    watched.looks.get(timeout=60)
    assert said == ["noted"]
    with pytest.raises(queue.Empty):
        watched.looks.get(timeout=0.05)  # nothing happens: no look


def test_the_loop_looks_at_the_time_that_the_last_look_has_named() -> None:
    times = list[float]()

    def look(now: float) -> float | None:
        times.append(now)
        return now + 0.05 if len(times) == 1 else None

    watched = Watched(look)
    watched.loop.start()
    for _ in range(2):
        watched.looks.get(timeout=60)
    watched.loop.stop()
    assert times[1] - times[0] >= 0.05


@pytest.mark.parametrize(
    ("end", "expected"),
    [
        (lambda reply: reply.set("on"), Ended("on")),
        (lambda reply: reply.set_exception(rr.LoadFailed("no fuel")), "no fuel"),
    ],
    ids=["value", "error"],
)
def test_a_step_is_in_flight_until_its_end_is_handled(
    watched: Watched, end: Callable[[Reply[str]], None], expected: Any
) -> None:
    watched.quiet()
    reply: Reply[str] = Reply()
    watched.begin(reply)
    assert watched.looks.get(timeout=60) == {"a": "loads a"}
    end(reply)
    ended = watched.ended.get(timeout=60)
    assert ended == expected or str(ended.error) == expected
    assert watched.looks.get(timeout=60) == {}


def test_a_step_that_cannot_begin_ends_with_the_error(watched: Watched) -> None:
    def start() -> Any:
        raise rr.LoadFailed("too many")

    watched.loop.tell(lambda: watched.loop.begin("a", "", start, watched.ended.put))
    assert str(watched.ended.get(timeout=60).error) == "too many"
    watched.quiet()
    assert not watched.loop.in_flight
    assert watched.failed.empty()


def test_a_step_that_is_withdrawn_ends_once(watched: Watched) -> None:
    reply: Reply[str] = Reply()
    withdrawn = threading.Event()
    reply.withdraw = withdrawn.set
    watched.begin(reply)
    for _ in range(2):
        watched.loop.tell(lambda: watched.loop.withdraw("a") if "a" in watched.loop.in_flight else None)
    assert watched.ended.get(timeout=60) == Ended(is_withdrawn=True)
    assert withdrawn.is_set()
    watched.quiet()
    assert watched.ended.empty()


def test_a_call_that_waits_runs_beside_the_loop(watched: Watched) -> None:
    goes_on = threading.Event()
    watched.loop.tell(lambda: watched.loop.begin_call("a", "", lambda: goes_on.wait(60), watched.ended.put))
    watched.quiet()
    assert "a" in watched.loop.in_flight
    goes_on.set()
    assert watched.ended.get(timeout=60) == Ended(True)


def test_an_unexpected_error_makes_the_manager_fail_with_it_and_ends_all_waiting() -> None:
    goes_on = threading.Event()

    def look(now: float) -> float | None:
        if goes_on.is_set():
            raise ValueError("a defect")
        return None

    watched = Watched(look)
    watched.loop.start()
    watched.quiet()
    goes_on.set()
    with pytest.raises(ValueError, match="a defect"):
        watched.loop.look_and_wait(60)
    assert str(watched.failed.get(timeout=60)) == "a defect"
    began = time.monotonic()
    assert not watched.loop.look_and_wait(60)
    assert time.monotonic() - began < 30


@pytest.mark.parametrize("begin", ["two of one key", "a call with a defect", "an end with a defect"])
def test_a_defect_of_a_step_is_loud(watched: Watched, begin: str) -> None:
    def defect(*_: object) -> Any:
        raise KeyError("a defect")

    match begin:
        case "two of one key":
            watched.begin(Reply())
            watched.begin(Reply())
        case "a call with a defect":
            watched.loop.tell(lambda: watched.loop.begin_call("a", "", defect, watched.ended.put))
        case _:
            reply: Reply[str] = Reply()
            reply.set("on")
            watched.loop.tell(lambda: watched.loop.begin("a", "", lambda: reply, defect))
    assert isinstance(watched.failed.get(timeout=60), (RuntimeError, KeyError))
