"""Gate: lets so many callbacks in at a time. The others wait outside, first come, first served.

A serial manager has a gate for one, so that its callbacks and messages have `self` for themselves, as those of any
actor. A callback inside that waits for a load, an unload or a reply lets another one in meanwhile. It comes in again
before those that wait outside. So managers that load from each other in a ring do not wait for each other for ever.
"""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import Callable, Coroutine, Generator
from contextvars import ContextVar
from typing import Any

from rr_actors.runtime.user_loop import COROUTINE, closing
from rr_actors.runtime.workers import is_async

Begin = Callable[[], bool]
"""Begins what has waited for room, without waiting itself; returns False if that cannot begin any more."""

Enter = Callable[[Begin], None]


class Gate:
    """Lets at most `most` callbacks in at a time. From any thread."""

    def __init__(self, most: int) -> None:
        self._lock = threading.Lock()
        self._free = most
        self._returning: deque[Begin] = deque()  # those that were inside before
        self._outside: deque[Begin] = deque()

    def enter(self, begin: Begin) -> None:
        """Call `begin` when there is room: now, or in the thread that makes room."""
        self._enter(self._outside, begin)

    def come_back(self, begin: Begin) -> None:
        """Call `begin` when there is room, before those that have not been inside yet."""
        self._enter(self._returning, begin)

    def leave(self) -> None:
        """Make room for another one."""
        while True:
            with self._lock:
                waiting = self._returning or self._outside
                if not waiting:
                    self._free += 1
                    return
                begin = waiting.popleft()
            if begin():
                return

    def _enter(self, waiting: deque[Begin], begin: Begin) -> None:
        with self._lock:
            if not self._free:  # while there is room, nobody waits
                waiting.append(begin)
                return
            self._free -= 1
        if not begin():
            self.leave()

    def around(self, fn: Callable[..., Any], *, enters: bool) -> Callable[..., Any]:
        """Return a function that calls `fn` inside, and then leaves. A coroutine that `fn` gives is awaited inside.

        Args:
            enters: whether it enters first, and waits for that; else its caller has entered for it.
        """

        async def run_async(*args: Any, begun: Coroutine[Any, Any, Any] | None = None) -> Any:
            cancelled = await _wait_async(self.enter) if enters and begun is None else None
            visit = _Visit(self, asyncio.current_task())
            token = _visit.set(visit)
            try:
                if cancelled is not None:
                    raise cancelled
                return await (begun or fn(*args))
            finally:
                _visit.reset(token)
                visit.end()

        def run(*args: Any) -> Any:
            if enters:
                _wait(self.enter)
            visit = _Visit(self, threading.get_ident())
            token = _visit.set(visit)
            try:
                answer = fn(*args)
            except BaseException:
                visit.end()
                raise
            finally:
                _visit.reset(token)
            if type(answer) is COROUTINE:
                return closing(answer, run_async(begun=answer))
            visit.end()
            return answer

        return run_async if is_async(fn) else run


class _Visit:
    """A callback that is inside a gate.

    Attributes:
        owner: the task that runs it, or the identifier of its thread. What others do in its context, such as a task
            that it has begun, lets nobody in.
        is_out: whether it waits for something, and has let another one in.
    """

    __slots__ = ("gate", "is_out", "owner")

    def __init__(self, gate: Gate, owner: object) -> None:
        self.gate, self.owner, self.is_out = gate, owner, False

    def end(self) -> None:
        if not self.is_out:  # else it was dropped while it waited, as its process ends
            self.gate.leave()


_visit: ContextVar[_Visit | None] = ContextVar("rr_gate", default=None)


class LettingIn:
    """A block in which the calling callback waits: if it is inside a gate, another one may come in. For threads."""

    __slots__ = ("_visit",)

    def __enter__(self) -> None:
        self._visit = None if _visit.get() is None else _gone_out(threading.get_ident())

    def __exit__(self, *_error: object) -> None:
        if (visit := self._visit) is not None:
            _wait(visit.gate.come_back)
            visit.is_out = False


def letting_in(wait: Generator[Any, Any, None]) -> Generator[Any, Any, None]:
    """Await what a task waits for; if it is inside a gate, another callback may come in meanwhile."""
    visit = None if _visit.get() is None else _gone_out(asyncio.current_task())
    if visit is None:
        yield from wait
        return
    try:
        yield from wait
    except GeneratorExit:  # the task is dropped
        raise
    except BaseException:
        yield from _back(visit).__await__()
        raise
    yield from _back(visit).__await__()


def _gone_out(caller: object) -> _Visit | None:
    """Let another callback in, if the caller is the owner of a visit; return that visit."""
    visit = _visit.get()
    if visit is None or visit.is_out or visit.owner != caller:
        return None
    visit.is_out = True
    visit.gate.leave()
    return visit


def _wait(enter: Enter) -> None:
    room = threading.Lock()
    room.acquire()

    def begin() -> bool:
        room.release()
        return True

    enter(begin)
    room.acquire()


async def _back(visit: _Visit) -> None:
    cancelled = await _wait_async(visit.gate.come_back)
    visit.is_out = False
    if cancelled is not None:
        raise cancelled


async def _wait_async(enter: Enter) -> asyncio.CancelledError | None:
    """Enter, and return when that has happened; the error if the task was cancelled meanwhile."""
    loop = asyncio.get_running_loop()
    room: asyncio.Future[None] = loop.create_future()

    def begin() -> bool:
        try:
            loop.call_soon_threadsafe(room.set_result, None)
        except RuntimeError:  # the loop is closed, and its tasks are dropped
            return False
        return True

    enter(begin)
    cancelled: asyncio.CancelledError | None = None
    while not room.done():
        try:
            await asyncio.shield(room)
        except asyncio.CancelledError as error:
            cancelled = error
    return cancelled
