"""Inbox: what a registrar's actor takes up, in which order, and when."""

from __future__ import annotations

import heapq
import itertools
import threading
from collections.abc import Callable
from functools import partial
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rr_actors.actors.inbox import Inbox, Item


class ManualLoop:
    """A dispatcher and its loop, turned by hand."""

    def __init__(self) -> None:
        self.loop = self
        self.now = 0.0
        self._calls: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = itertools.count()

    def call(self, fn: Callable[[], None]) -> None:
        self.call_later(0.0, fn)

    def call_soon(self, fn: Callable[..., None], *args: Any) -> None:
        self.call_later(0.0, fn, *args)

    def call_later(self, delay_s: float, fn: Callable[..., None], *args: Any) -> None:
        heapq.heappush(self._calls, (self.now + delay_s, next(self._numbers), partial(fn, *args)))

    def turn(self, seconds: float = 0.0) -> None:
        """Do what is due until `seconds` from now."""
        until = self.now + seconds
        while self._calls and self._calls[0][0] <= until:
            self.now, _, fn = heapq.heappop(self._calls)
            fn()
        self.now = until


class Reader:
    """Takes up what is in an inbox; what is `refused` it puts back."""

    def __init__(self) -> None:
        self.loop = ManualLoop()
        self.inbox = Inbox(cast(Any, self.loop), self._take_up, threading.RLock())
        self.parts: list[list[Any]] = []
        self.refused = False

    def _take_up(self, items: list[Item]) -> None:
        if self.refused:
            self.inbox.put_back(items)
        else:
            self.parts.append([what for what, _ in items])

    @property
    def taken(self) -> list[Any]:
        return [what for part in self.parts for what in part]


@pytest.fixture
def reader() -> Reader:
    return Reader()


def test_what_comes_in_one_turn_of_the_loop_is_taken_up_together(reader: Reader) -> None:
    for number in range(10):
        reader.inbox.put(number, "sender")
    assert reader.parts == []
    reader.loop.turn()
    assert reader.parts == [list(range(10))]
    assert len(reader.inbox) == 0


def test_of_very_many_so_many_are_taken_up_in_each_turn(reader: Reader) -> None:
    for number in range(300):
        reader.inbox.put(number)
    reader.loop.turn()
    assert [len(part) for part in reader.parts] == [128, 128, 44]
    assert reader.taken == list(range(300))


def test_what_is_noted_is_taken_up_before_what_is_put_next(reader: Reader) -> None:
    reader.inbox.note("noted")
    reader.loop.turn()
    assert reader.parts == []
    reader.inbox.put("put")
    reader.loop.turn()
    assert reader.parts == [["noted", "put"]]


def test_what_is_noted_is_looked_at_soon_and_a_little_at_a_time(reader: Reader) -> None:
    for number in range(50):
        reader.inbox.note(number)
    reader.loop.turn(0.1)
    assert reader.taken == list(range(50))
    assert max(len(part) for part in reader.parts) <= 16


def test_what_is_noted_during_a_look_waits_for_the_next(reader: Reader) -> None:
    """Else threads that load all the time would have the loop beside them all the time."""

    def load_again(items: list[Item]) -> None:
        reader.parts.append([what for what, _ in items])
        inbox.note("later")

    inbox = reader.inbox = Inbox(cast(Any, reader.loop), load_again, threading.RLock())
    for number in range(48):
        inbox.note(number)
    reader.loop.turn(0.015)
    assert reader.taken == list(range(48))
    assert len(inbox) == 12
    reader.loop.turn(0.01)
    assert reader.taken == [*range(48), *["later"] * 12]


def test_between_the_parts_of_a_look_other_things_have_their_turn(reader: Reader) -> None:
    taken: list[int] = []
    for number in range(100):
        reader.inbox.note(number)
    reader.loop.turn(0.0)
    reader.loop.call_later(0.01, lambda: taken.append(len(reader.taken)))
    reader.loop.turn(0.02)
    assert taken == [16]
    assert len(reader.taken) == 100


def test_a_look_ends_where_catching_up_has_taken_up_the_rest(reader: Reader, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each breath gives Python's lock away, which a thread that computes keeps for some milliseconds."""
    breaths: list[int] = []
    monkeypatch.setattr("os.sched_yield", lambda: breaths.append(len(reader.taken)))
    for number in range(400):
        reader.inbox.note(number)
    reader.loop.turn(0.0)
    reader.loop.call_later(0.01, reader.inbox.catch_up)
    reader.loop.turn(0.1)
    assert reader.taken == list(range(400))
    assert breaths == [4, 8, 12, 16]


def test_catching_up_takes_up_all_at_once(reader: Reader) -> None:
    for number in range(300):
        reader.inbox.note(number)
    reader.inbox.catch_up()
    assert reader.taken == list(range(300))


def test_what_is_put_back_is_tried_again_later_and_the_rest_waits_behind_it(reader: Reader) -> None:
    reader.refused = True
    reader.inbox.put("first")
    reader.loop.turn()
    reader.inbox.put("second")
    reader.inbox.note("third")
    reader.refused = False
    reader.loop.turn(0.1)
    assert reader.parts == []
    reader.loop.turn(0.3)
    assert reader.parts == [["first", "second", "third"]]


def test_while_nothing_can_be_done_the_loop_does_not_spin(reader: Reader) -> None:
    reader.refused = True
    tried: list[float] = []
    refuse = reader._take_up
    reader.inbox._take_up = lambda items: (tried.append(reader.loop.now), refuse(items))[1]
    for number in range(300):
        reader.inbox.put(number)
    reader.loop.turn(10.0)
    assert 30 <= len(tried) <= 45


@given(st.lists(st.sampled_from(["put", "note", "turn", "wait", "catch up", "refuse", "accept"]), max_size=60))
def test_nothing_is_lost_doubled_or_reordered(steps: list[str]) -> None:
    reader = Reader()
    numbers = itertools.count()
    for step in steps:
        match step:
            case "put":
                reader.inbox.put(next(numbers))
            case "note":
                reader.inbox.note(next(numbers))
            case "turn":
                reader.loop.turn()
            case "wait":
                reader.loop.turn(0.02)
            case "catch up":
                reader.inbox.catch_up()
            case _:
                reader.refused = step == "refuse"
    reader.refused = False
    reader.loop.turn(1.0)
    assert reader.taken == list(range(next(numbers)))
    assert len(reader.inbox) == 0


def test_what_is_put_back_during_a_look_is_not_tried_again_in_the_same_look() -> None:
    reader = Reader()
    tries: list[list[Any]] = []

    def take_up(items: list[Item]) -> None:
        tries.append([what for what, _ in items])
        reader.inbox.put_back(items)

    inbox = reader.inbox = Inbox(cast(Any, reader.loop), take_up, threading.RLock())
    for number in range(16):
        inbox.note(number)
    reader.loop.turn(0.1)
    assert tries == [[0, 1, 2, 3]]
    assert [what for what, _ in inbox] == list(range(16))
