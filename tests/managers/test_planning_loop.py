"""PlanningLoop: it looks after each thing that happens, each step has one end, and an error is never its silent end."""

from __future__ import annotations

import asyncio
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import rr_actors as rr
from rr_actors.actors.messaging.futures import Reply
from rr_actors.managers.planning.planning_loop import PlanningLoop, StepEnded
from support import eventually

Loop = PlanningLoop[str, str]
Look = Callable[[float], float | None]


class Watched:
    """A loop whose looks and failure the test waits for."""

    def __init__(self, look: Look | None = None) -> None:
        self.looks: queue.SimpleQueue[dict[str, str]] = queue.SimpleQueue()
        self.failed: queue.SimpleQueue[BaseException] = queue.SimpleQueue()
        self.ended: queue.SimpleQueue[StepEnded] = queue.SimpleQueue()
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
        (lambda reply: reply.set("on"), StepEnded("on")),
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


def test_a_step_is_withdrawn_at_its_limit_and_the_loop_does_not_look_meanwhile(watched: Watched) -> None:
    watched.quiet()
    reply: Reply[str] = Reply()
    reply.withdraw = _nothing
    watched.loop.tell(lambda: watched.loop.begin("a", "loads a", lambda: reply, watched.ended.put, limit_s=0.1))
    assert watched.ended.get(timeout=60) == StepEnded(is_withdrawn=True)
    assert reply.cancelled()
    assert [watched.looks.get(timeout=60) for _ in range(2)] == [{"a": "loads a"}, {}]
    assert watched.looks.empty()


def test_a_step_that_ends_within_its_limit_is_not_withdrawn(watched: Watched) -> None:
    reply: Reply[str] = Reply()
    watched.loop.tell(lambda: watched.loop.begin("a", "loads a", lambda: reply, watched.ended.put, limit_s=60))
    reply.set("on")
    assert watched.ended.get(timeout=60) == StepEnded("on")


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
    assert watched.ended.get(timeout=60) == StepEnded(is_withdrawn=True)
    assert withdrawn.is_set()
    watched.quiet()
    assert watched.ended.empty()


def test_a_call_that_waits_runs_beside_the_loop(watched: Watched) -> None:
    goes_on = threading.Event()
    watched.loop.tell(lambda: watched.loop.begin_call("a", "", lambda: goes_on.wait(60), watched.ended.put))
    watched.quiet()
    assert "a" in watched.loop.in_flight
    goes_on.set()
    assert watched.ended.get(timeout=60) == StepEnded(True)


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


@pytest.mark.parametrize(
    "begin", ["two of one key", "a call with a defect", "a call that is cancelled", "an end with a defect"]
)
def test_a_defect_of_a_step_is_loud(watched: Watched, begin: str) -> None:
    def defect(*_: object) -> Any:
        raise KeyError("a defect")

    def cancelled() -> None:
        raise asyncio.CancelledError

    match begin:
        case "two of one key":
            watched.begin(Reply())
            watched.begin(Reply())
        case "a call with a defect":
            watched.loop.tell(lambda: watched.loop.begin_call("a", "", defect, watched.ended.put))
        case "a call that is cancelled":
            watched.loop.tell(lambda: watched.loop.begin_call("a", "", cancelled, watched.ended.put))
        case _:
            reply: Reply[str] = Reply()
            reply.set("on")
            watched.loop.tell(lambda: watched.loop.begin("a", "", lambda: reply, defect))
    assert isinstance(watched.failed.get(timeout=60), (RuntimeError, KeyError, asyncio.CancelledError))


class Steps:
    """A manager that always wants a step of each key in flight, whose steps end by the hand of the test."""

    def __init__(self, keys: Sequence[str]) -> None:
        self.begun, self.ended = Counter[str](), Counter[str]()
        self.replies: dict[str, Reply[Any]] = {}
        self.twice = list[str]()
        self.keys = list(keys)
        self.failed: queue.SimpleQueue[BaseException] = queue.SimpleQueue()
        self.loop = Loop("test", self._look, self.failed.put)

    def _look(self, now: float) -> None:
        for key in self.keys:
            if key not in self.loop.in_flight:
                self.loop.begin(key, key, lambda key=key: self._begin(key), lambda ended, key=key: self._end(key))

    def _begin(self, key: str) -> Reply[Any]:
        if self.begun[key] > self.ended[key]:
            self.twice.append(key)
        self.begun[key] += 1
        reply = self.replies[key] = Reply[Any]()
        reply.withdraw = _nothing
        return reply

    def _end(self, key: str) -> None:
        self.ended[key] += 1


def _nothing() -> None:
    """Take a step back at no cost."""


@settings(max_examples=30, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from("abc"), st.sampled_from(["value", "error", "withdraw", "cancel", "wake"])),
        max_size=12,
    )
)
def test_no_step_is_begun_twice_and_none_is_lost(events: list[tuple[str, str]]) -> None:
    steps = Steps("abc")
    steps.loop.start()
    ends = Counter[str]()
    for key, event in events:
        assert steps.loop.look_and_wait(60)
        reply, before = steps.replies[key], steps.ended[key]
        match event:
            case "value":
                reply.set(1)
            case "error":
                reply.set_exception(rr.LoadFailed("no"))
            case "withdraw":
                steps.loop.tell(lambda key=key: steps.loop.withdraw(key))
            case "cancel":
                reply.cancel()
            case _:
                steps.loop.wake()
                continue
        ends[key] += 1
        assert eventually(lambda key=key, before=before: steps.ended[key] > before)
    assert steps.loop.look_and_wait(60)
    assert steps.twice == []
    assert steps.ended == ends
    assert all(steps.begun[key] == steps.ended[key] + 1 for key in "abc")
    assert steps.failed.empty()
    steps.loop.stop()
