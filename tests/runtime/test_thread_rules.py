"""What is declared of threads is checked while the tests run, and costs nothing otherwise."""

from __future__ import annotations

import os
import subprocess
import sys
import threading

import pytest

from rr_actors.runtime import thread_rules
from rr_actors.runtime.event_loop import acquire, release


@thread_rules.on_loop
class Part:
    def __init__(self) -> None:
        self.lock = threading.RLock()

    def act(self) -> str:
        return "done"

    @thread_rules.any_thread
    def look(self) -> str:
        return "seen"

    @thread_rules.with_lock
    def change(self) -> str:
        return "changed"


def test_what_belongs_to_the_loop_runs_there_alone() -> None:
    part, dispatcher = Part(), acquire()

    async def act() -> str:
        return part.act()

    try:
        assert dispatcher.run(act()) == "done"
        with pytest.raises(AssertionError, match=r"Part\.act: called in thread 'MainThread'"):
            part.act()
        assert part.look() == "seen"
    finally:
        release()
    assert len(thread_rules.broken) == 1
    thread_rules.broken.clear()


def test_what_needs_the_lock_is_called_with_it() -> None:
    part = Part()
    with part.lock:
        assert part.change() == "changed"
    with pytest.raises(AssertionError, match=r"Part\.change: called without the lock"):
        part.change()
    thread_rules.broken.clear()


def test_a_declaration_changes_nothing_outside_of_the_tests() -> None:
    script = """
from rr_actors.runtime.thread_rules import any_thread, on_loop, with_lock

def act(): ...
class Part:
    def act(self): ...
before = dict(vars(Part))
assert on_loop(act) is with_lock(act) is any_thread(act) is act and not vars(act)
assert on_loop(Part) is Part and dict(vars(Part)) == before
"""
    environment = {name: value for name, value in os.environ.items() if name != thread_rules.CHECK}
    subprocess.run([sys.executable, "-c", script], env=environment, check=True)
