"""Steps: count the bytecodes that a call takes. The count is the same on every machine, however busy."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import FrameType
from typing import Any, TypeVar

from rr_actors.runtime import event_loop

T = TypeVar("T")


class _Steps:
    """Counts the bytecodes of each thread whose trace function it is."""

    def __init__(self) -> None:
        self.count = 0

    def __call__(self, frame: FrameType, event: str, _: Any) -> Any:
        frame.f_trace_opcodes, frame.f_trace_lines = True, False
        self.count += event == "opcode"
        return self


def steps_of(work: Callable[[], T]) -> tuple[int, T]:
    """Return how many bytecodes of Python `work` takes in this thread, and what it returns."""
    steps = _Steps()
    before = sys.gettrace()
    sys.settrace(steps)
    try:
        result = work()
    finally:
        sys.settrace(before)
    return steps.count, result


def steps_on_loop(work: Callable[[], object]) -> int:
    """Return how many bytecodes of Python the event loop takes, while `work` runs in this thread."""
    steps = _Steps()

    async def trace(function: Any) -> None:
        sys.settrace(function)

    dispatcher = event_loop.acquire()
    try:
        dispatcher.run(trace(steps))
        work()
        dispatcher.run(trace(None))
    finally:
        event_loop.release()
    return steps.count
