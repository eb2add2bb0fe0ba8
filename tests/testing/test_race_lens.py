"""Which accesses of two callbacks race, and what is noted of a manager's dicts and sets."""

from __future__ import annotations

import copy
import json
import pickle
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from contextvars import copy_context
from typing import Any

import pytest

from rr_actors.testing.race_lens import Race, RaceLens
from rr_actors.testing.seen_manager import SEEN


class Owner:
    """Stands for a manager: an object with locks."""

    def __init__(self) -> None:
        self.lock, self.other = threading.RLock(), threading.Lock()


class Callbacks:
    """Callbacks a and b, which run until the test ends them. Each access is made as the test says."""

    def __init__(self, *, takes_turns: tuple[bool, bool] = (False, False)) -> None:
        self.races: list[Race] = []
        self.lens = RaceLens(self.races.append)
        self.owner = Owner()
        self._contexts = {}
        self._ends = {}
        for name, turns in zip("ab", takes_turns, strict=True):
            self._contexts[name] = copy_context()
            self._ends[name] = self._contexts[name].run(self._begin, name, turns)

    def _begin(self, name: str, turns: bool) -> ExitStack:
        stack = ExitStack()
        stack.enter_context(self.lens.run(name, takes_turns=turns))
        return stack

    def end(self, name: str) -> None:
        self._contexts[name].run(self._ends[name].close)

    def access(self, name: str, what: str, key: object = None) -> None:
        self._contexts[name].run(self._access, what, key)

    def _access(self, what: str, key: Any) -> None:
        self.lens.note(self.owner, "count", key, writes=what == "w", frame=sys._getframe(0))

    def found(self) -> list[tuple[str, str]]:
        return [(race.first.callback, race.second.callback) for race in self.races]


@pytest.fixture
def both() -> Generator[Callbacks]:
    callbacks = Callbacks()
    yield callbacks
    for name in "ab":
        callbacks.end(name)


@pytest.mark.parametrize(
    ("accesses", "races"),
    [
        (["a r", "b r"], []),
        (["a r", "b w"], [("a", "b")]),
        (["a w", "b r"], [("a", "b")]),
        (["a w", "a r", "a w"], []),
        (["a w", "a ends", "b w"], []),
        (["a w 1", "b w 2"], []),
        (["a w 1", "b w 1"], [("a", "b")]),
        (["a w", "b w 1"], []),  # the dict was replaced: another of its items
    ],
)
def test_two_accesses_race_if_one_writes_while_both_run(accesses: list[str], races: list[Any], both: Callbacks) -> None:
    for name, what, *key in map(str.split, accesses):
        if what == "ends":
            both.end(name)
        else:
            both.access(name, what, *key)

    assert both.found() == races


@contextmanager
def holding(lock: Any) -> Generator[None]:
    with lock:
        yield


@pytest.mark.parametrize("name", ["lock", "other"])
def test_a_lock_that_is_held_at_both_keeps_them_apart(name: str, both: Callbacks) -> None:
    for callback in "ab":
        with holding(getattr(both.owner, name)):
            both.access(callback, "w")

    assert both.found() == []


def test_a_lock_at_one_access_alone_does_not(both: Callbacks) -> None:
    with both.owner.lock:
        both.access("a", "w")
    both.access("b", "r")

    assert both.found() == [("a", "b")]


def test_two_locks_do_not(both: Callbacks) -> None:
    with both.owner.lock:
        both.access("a", "w")
    with both.owner.other:
        both.access("b", "w")

    assert both.found() == [("a", "b")]


GLOBAL = threading.Lock()


def test_a_lock_of_the_module_counts(both: Callbacks) -> None:
    for callback in "ab":
        with GLOBAL:
            both.access(callback, "w")

    assert both.found() == []


@pytest.mark.parametrize(
    ("accesses", "races"),
    [
        (["a r", "a w", "b r", "b w"], []),  # each in one turn
        (["a r", "b w", "a w"], [("b", "a")]),  # b's write is lost
        (["b w", "a r", "a w"], []),
        (["a w", "b w", "a w"], []),
        (["a r", "b w", "a r"], []),
    ],
)
def test_of_two_that_take_turns_a_write_is_lost(accesses: list[str], races: list[Any]) -> None:
    callbacks = Callbacks(takes_turns=(True, True))
    for name, what in map(str.split, accesses):
        callbacks.access(name, what)
    for name in "ab":
        callbacks.end(name)

    assert callbacks.found() == races


def test_a_thread_and_one_that_takes_turns_race_as_threads_do() -> None:
    callbacks = Callbacks(takes_turns=(True, False))
    callbacks.access("a", "r")
    callbacks.access("b", "w")
    for name in "ab":
        callbacks.end(name)

    assert callbacks.found() == [("a", "b")]


def test_a_pair_of_lines_is_told_once(both: Callbacks) -> None:
    for _ in range(3):
        for callback in "ab":
            both.access(callback, "w")

    assert len(both.found()) == 1


def test_without_a_callback_nothing_is_noted(both: Callbacks) -> None:
    both.access("a", "w")
    both.lens.note(both.owner, "count", None, writes=True, frame=sys._getframe(0))

    assert both.found() == []


COPIES: list[Callable[[Any], Any]] = [copy.copy, copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))]


@pytest.mark.parametrize("copied", COPIES, ids=["copy", "deepcopy", "pickle"])
@pytest.mark.parametrize("kind", ["dict", "set"])
def test_what_is_seen_leaves_the_manager_as_a_plain_one(kind: str, copied: Callable[[Any], Any]) -> None:
    plain: Any = {"left": 1} if kind == "dict" else {"left"}
    seen = SEEN[type(plain)](plain)
    seen.note = lambda key, writes: None

    assert type(copied(seen)) is type(plain)
    assert copied(seen) == plain == seen


def test_a_seen_dict_is_json() -> None:
    seen = SEEN[dict]({"left": 1})
    seen.note = lambda key, writes: None

    assert json.loads(json.dumps(seen)) == {"left": 1}
