"""Inbox: what waits for a registrar's actor, and when it is taken up: in parts, each of which is one commit."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import Any

from rr_actors.runtime.event_loop import Dispatcher

_AT_ONCE = 128  # with more, those who wait for the first answers do not wait for the last ones
_TOO_MANY = 512  # notes: threads that never wait make more and more; others some 200 from one look to the next
_LOOK_SOON_S = 0.01
_A_TURN = 16  # of what was noted; then other things have their turn
_A_BREATH = 4  # a thread that loads meanwhile waits for no more than these
_RETRY_S = 0.25


Item = tuple[Any, str | None]
"""A message and the registrar that sent it, or a command of this process and None."""
TakeUp = Callable[[list[Item]], Callable[[], None] | None]


class Inbox:
    """Messages and commands in the order in which they came.

    put() has the loop take them up in its next turn; what is noted waits for whatever is put next, or is looked at
    soon. On the loop, but for note() and is_quiet.

    Args:
        take_up: called on the loop with the next items, to decide them; what it returns is called when they are
            counted as decided, and does what follows.
        deciding: the lock of who decides anything.
    """

    def __init__(self, dispatcher: Dispatcher, take_up: TakeUp, deciding: AbstractContextManager[Any]) -> None:
        self._dispatcher = dispatcher
        self._take_up = take_up
        self._deciding = deciding
        self._items: deque[Item] = deque()
        self._taken = 0  # so many have been taken out: the place of the first that is left
        self._decided = 0  # so many of these are decided
        self._pressing = 0  # the place behind the last that was not only noted
        self._awake = False  # a turn of the loop will take up what is pressing
        self._held_up = False  # what could not be done is tried again later, and nothing before it
        self._noted = False  # there will be a look

    def __len__(self) -> int:
        return len(self._items)

    def __iter__(self) -> Iterator[Item]:
        return iter(list(self._items))  # to which threads append

    @property
    def is_quiet(self) -> bool:
        """Whether nothing but some notes is waiting, or being decided. While it is asked `deciding` is held.

        It is not when it is full.
        """
        return self._decided >= self._pressing and len(self._items) < _TOO_MANY

    @property
    def is_full(self) -> bool:
        """Whether so much was noted that the loop needs time: whoever goes on by the loop gives it that."""
        return len(self._items) >= _TOO_MANY

    def put(self, what: Any, sender: str | None = None) -> None:
        """Add an item and have it taken up."""
        if self._decided >= self._pressing:
            with self._deciding:  # who has found it quiet notes what follows from that before this
                self._pressing = self._decided + 1
        self._items.append((what, sender))
        self._pressing = self._taken + len(self._items)
        if not self._awake:
            self._awake = True
            self._dispatcher.loop.call_soon(self._wake)

    def note(self, what: Any, sender: str | None = None) -> None:
        """Add an item without waking the loop for it. From any thread."""
        self._items.append((what, sender))
        if not self._noted:
            self._noted = True
            self._dispatcher.call(self._look_soon)

    def put_back(self, items: list[Item]) -> None:
        """Put what could not be done before everything else, and let it be for a moment."""
        with self._deciding:
            self._items.extendleft(reversed(items))
            self._taken -= len(items)
            self._decided = min(self._decided, self._taken)
            self._pressing = max(self._pressing, self._taken + len(items))
        if not self._held_up:
            self._awake = self._held_up = True
            self._dispatcher.loop.call_later(_RETRY_S, self._wake_again)

    def catch_up(self) -> None:
        """Take up all there is, now."""
        for _ in range(0, len(self._items), _AT_ONCE):
            self._take_next(_AT_ONCE)

    def clear(self) -> None:
        """Forget everything."""
        self._items.clear()
        self._pressing = self._decided

    def _take_next(self, count: int) -> None:
        if self._items:
            count = min(len(self._items), count)
            self._taken += count
            act = self._take_up([self._items.popleft() for _ in range(count)])
            self._decided = self._taken
            if act is not None:
                act()

    def _wake(self) -> None:
        self._take_next(_AT_ONCE)
        if self._held_up:
            return
        if self._decided < self._pressing:
            self._dispatcher.loop.call_soon(self._wake)
        else:
            self._awake = False

    def _wake_again(self) -> None:
        self._held_up = False
        self._wake()

    def _look_soon(self) -> None:
        self._dispatcher.loop.call_later(_LOOK_SOON_S, self._look)

    def _look(self) -> None:
        self._look_at(len(self._items))

    def _look_at(self, left: int) -> None:
        """Take up so many, a few in each turn of the loop; what is noted meanwhile has its own look."""
        left = min(left, len(self._items))  # catch_up() may have been faster
        for _ in range(0, min(left, _A_TURN), _A_BREATH):
            if self._awake:
                break  # a turn of the loop takes up the rest, or what was put back has to wait first
            self._take_next(_A_BREATH)
            os.sched_yield()  # to that thread: Python's lock, and the core
        if left > _A_TURN and not self._awake:
            self._dispatcher.loop.call_soon(self._look_at, left - _A_TURN)
            return
        self._noted = False  # first: who notes something from now on has it looked at
        if self._items:
            self._noted = True
            self._look_soon()
