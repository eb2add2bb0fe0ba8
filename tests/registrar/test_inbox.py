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

from rr_actors.registrar.engine.inbox import Inbox, Item


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
        self.put_back: set[Any] = set()

    def _take_up(self, items: list[Item]) -> None:
        if self.refused:
            self.inbox.put_back(items)
            self.put_back.update(what for what, _ in items)
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


class Placed:
    """What an inbox should be like: which items wait, which of them were put, and whether the loop is to come."""

    def __init__(self) -> None:
        self.reader = Reader()
        self.waiting: list[int] = []
        self.pressing: set[int] = set()
        self.numbers = itertools.count()

    def step(self, step: str) -> None:
        inbox, loop = self.reader.inbox, self.reader.loop
        match step:
            case "put":
                number = next(self.numbers)
                self.pressing.add(number)
                inbox.put(number)
            case "note":
                inbox.note(next(self.numbers))
            case "turn":
                loop.turn()
            case "wait":
                loop.turn(0.02)
            case "catch up":
                inbox.catch_up()
            case "foreign":  # decided by itself and not committed: it was never taken out
                number = next(self.numbers)
                inbox.put_back([(number, None)])
                self.reader.put_back.add(number)
            case _:
                self.reader.refused = step == "refuse"

    def look(self) -> None:
        """It is quiet if nothing waits that was put, or put back, or is before one that was."""
        items = [what for what, _ in self.reader.inbox]
        back = self.reader.put_back | self.pressing
        assert self.reader.inbox.is_quiet is not any(item in back for item in items), items


STEPS = ["put", "note", "turn", "wait", "catch up", "refuse", "accept"]


@given(st.lists(st.sampled_from(STEPS), max_size=60))
def test_nothing_is_lost_doubled_or_reordered(steps: list[str]) -> None:
    placed = Placed()
    reader = placed.reader
    for step in steps:
        placed.step(step)
        placed.look()
    reader.refused = False
    reader.loop.turn(1.0)
    assert reader.taken == list(range(next(placed.numbers)))
    assert len(reader.inbox) == 0
    assert reader.inbox.is_quiet


@given(st.lists(st.sampled_from([*STEPS, "foreign"]), max_size=60))
def test_what_was_put_is_taken_up_whatever_was_put_back_before_it(steps: list[str]) -> None:
    placed = Placed()
    reader = placed.reader
    for step in steps:
        placed.step(step)
        placed.look()
    reader.refused = False
    reader.loop.turn(1.0)
    assert sorted(reader.taken) == list(range(next(placed.numbers)))
    assert reader.inbox.is_quiet


@given(st.lists(st.sampled_from(["put", "note", "turn", "wait", "catch up"]), max_size=60))
def test_while_nothing_is_refused_one_turn_takes_up_what_was_put_and_a_look_what_was_noted(steps: list[str]) -> None:
    placed = Placed()
    for step in steps:
        placed.step(step)
    placed.step("turn")
    assert placed.reader.inbox.is_quiet
    assert placed.pressing <= set(placed.reader.taken)
    placed.step("wait")
    assert len(placed.reader.inbox) == 0


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


# -- whether it is quiet ---------------------------------------------------------------------------------------------


def watched(reader: Reader, act: Callable[[], None] | None = None) -> list[tuple[str, bool]]:
    """Whether the inbox is quiet while its items are being decided, and while what follows is done."""
    seen: list[tuple[str, bool]] = []

    def take_up(items: list[Item]) -> Callable[[], None]:
        reader.parts.append([what for what, _ in items])
        seen.append(("deciding", inbox.is_quiet))

        def follows() -> None:
            seen.append(("acting", inbox.is_quiet))
            if act is not None:
                act()

        return follows

    inbox = reader.inbox = Inbox(cast(Any, reader.loop), take_up, threading.RLock())
    return seen


def test_what_was_put_is_not_quiet_until_it_is_decided_and_quiet_while_the_loop_acts_on_it(reader: Reader) -> None:
    seen = watched(reader)
    assert reader.inbox.is_quiet
    reader.inbox.put("put")
    assert not reader.inbox.is_quiet
    reader.loop.turn()
    assert seen == [("deciding", False), ("acting", True)]
    assert reader.inbox.is_quiet


def test_what_was_only_noted_leaves_it_quiet_all_the_time(reader: Reader) -> None:
    seen = watched(reader)
    reader.inbox.note("noted")
    assert reader.inbox.is_quiet
    reader.loop.turn(0.02)
    assert seen == [("deciding", True), ("acting", True)]


def test_a_note_behind_what_was_put_waits_and_leaves_it_quiet(reader: Reader) -> None:
    seen = watched(reader, act=lambda: reader.inbox.note("noted") if len(reader.parts) == 1 else None)
    reader.inbox.put("put")
    reader.loop.turn()
    assert seen == [("deciding", False), ("acting", True)]
    assert (len(reader.inbox), reader.inbox.is_quiet) == (1, True)
    reader.loop.turn(0.02)
    assert reader.parts == [["put"], ["noted"]]


def test_something_put_behind_notes_is_not_quiet_until_all_of_them_are_decided(reader: Reader) -> None:
    seen = watched(reader)
    for number in range(130):
        reader.inbox.note(number)
    reader.inbox.put("put")
    assert not reader.inbox.is_quiet
    reader.loop.turn()
    assert [len(part) for part in reader.parts] == [128, 3]
    assert seen == [("deciding", False), ("acting", False), ("deciding", False), ("acting", True)]


def test_what_is_put_while_the_loop_acts_is_taken_up_in_its_next_turn(reader: Reader) -> None:
    seen = watched(reader, act=lambda: reader.inbox.put("next") if len(reader.parts) == 1 else None)
    reader.inbox.put("put")
    reader.loop.turn()
    assert reader.parts == [["put"], ["next"]]
    assert seen == [("deciding", False), ("acting", True)] * 2
    assert reader.inbox.is_quiet


def test_what_is_put_while_the_loop_acts_on_notes_wakes_it(reader: Reader) -> None:
    watched(reader, act=lambda: reader.inbox.put("put") if len(reader.parts) == 1 else None)
    reader.inbox.note("noted")
    reader.loop.turn(0.0)
    reader.loop.turn(0.01)
    assert reader.parts == [["noted"], ["put"]]
    assert reader.inbox.is_quiet


def test_it_is_not_quiet_with_something_put_back(reader: Reader) -> None:
    reader.refused = True
    reader.inbox.note("noted")
    reader.loop.turn(0.02)
    assert not reader.inbox.is_quiet
    reader.refused = False
    reader.loop.turn(0.3)
    assert reader.inbox.is_quiet
    assert reader.taken == ["noted"]


def test_with_part_of_it_put_back_it_is_not_quiet_until_the_last_is_decided(reader: Reader) -> None:
    seen = watched(reader)
    inbox = reader.inbox
    take_up = inbox._take_up
    inbox._take_up = inbox.put_back
    for number in range(130):
        inbox.put(number)
    reader.loop.turn()
    assert (len(inbox), inbox.is_quiet) == (130, False)
    inbox._take_up = take_up
    reader.loop.turn(0.3)
    assert [len(part) for part in reader.parts] == [128, 2]
    assert seen == [("deciding", False), ("acting", False), ("deciding", False), ("acting", True)]
    assert reader.taken == list(range(130))


def test_what_was_never_taken_out_may_be_put_back_before_notes(reader: Reader) -> None:
    for number in range(3):
        reader.inbox.note(number)
    reader.inbox.put_back([("foreign", "app")])
    assert not reader.inbox.is_quiet
    reader.loop.turn(0.1)
    assert reader.parts == []
    reader.loop.turn(0.2)
    assert reader.taken == ["foreign", 0, 1, 2]
    assert reader.inbox.is_quiet
    reader.inbox.put("next")
    assert not reader.inbox.is_quiet
    reader.loop.turn()
    assert reader.inbox.is_quiet
    assert reader.taken[-1] == "next"


def test_catching_up_makes_it_quiet_also_of_what_was_put_back(reader: Reader) -> None:
    reader.inbox.put_back([("foreign", "app")])
    reader.inbox.put("put")
    reader.inbox.note("noted")
    reader.inbox.catch_up()
    assert reader.taken == ["foreign", "put", "noted"]
    assert reader.inbox.is_quiet
    reader.inbox.put("next")
    assert not reader.inbox.is_quiet
    reader.loop.turn(0.3)
    assert reader.taken[-1] == "next"
    assert reader.inbox.is_quiet


def test_cleared_it_is_quiet_and_takes_up_what_is_put_next(reader: Reader) -> None:
    reader.inbox.note("noted")
    reader.inbox.put("put")
    reader.inbox.clear()
    assert reader.inbox.is_quiet
    reader.loop.turn()
    reader.inbox.put("next")
    assert not reader.inbox.is_quiet
    reader.loop.turn()
    assert reader.parts == [["next"]]


def test_full_of_notes_it_is_not_quiet(reader: Reader, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rr_actors.registrar.engine.inbox._TOO_MANY", 10)
    for number in range(10):
        assert reader.inbox.is_quiet
        reader.inbox.note(number)
    assert not reader.inbox.is_quiet
    reader.loop.turn(0.05)
    assert reader.inbox.is_quiet


def test_who_has_found_it_quiet_notes_what_follows_before_whatever_is_put(reader: Reader) -> None:
    """A thread that decides holds the lock; whoever puts waits for it."""
    deciding = threading.RLock()
    inbox = reader.inbox = Inbox(cast(Any, reader.loop), reader._take_up, deciding)
    reader.inbox = inbox
    put = threading.Thread(target=inbox.put, args=("put",))
    with deciding:
        assert inbox.is_quiet
        put.start()
        put.join(0.05)
        assert put.is_alive()
        assert inbox.is_quiet
        inbox.note("noted")
    put.join()
    assert not inbox.is_quiet
    reader.loop.turn()
    assert reader.parts == [["noted", "put"]]
