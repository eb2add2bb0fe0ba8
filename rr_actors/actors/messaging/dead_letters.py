"""Dead letters: messages of this process that reached no actor. They are counted, reported, and the newest are kept.

The text of a message is made in the thread that records it, never on the loop: a message's `__repr__` is users' code.
Messages without a text (Lost) do not wait for that code: another process may send them faster than it returns.
A log line comes at most every LOG_EVERY_S seconds, and only for letters whose sender got no error. At most
EVENTS_A_SECOND letters a second reach the listener.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from rr_actors.base.checks import SupervisorLook
from rr_actors.base.errors import Unavailable, shown
from rr_actors.base.reporting.log import Log
from rr_actors.runtime import event_loop

logger = Log("rr_actors")

KEPT = 1000
"""How many letters are kept; older ones are dropped."""

LOG_EVERY_S = 5.0
EVENTS_A_SECOND = 100

LOST_WITH = "lost with its process at "
"""Why a message is lost that was on its way when the receiver's process ended. The receiver may have begun with it."""


class DeadLetter(msgspec.Struct, frozen=True):
    """A message that reached no actor.

    Attributes:
        to: the actor's path, or its class and URN.
        message: its repr, shortened; or its size, if it was lost between two processes.
        why: "has ended", "is being started again" ...
        at: the time, in seconds since the epoch.
        pid: the process that noticed it.
    """

    to: str
    message: str
    why: str
    at: float
    pid: int

    def __str__(self) -> str:
        when = time.strftime("%H:%M:%S", time.localtime(self.at))
        return f"{when} to {self.to}: {self.message} ({self.why})"


class DeadLetters(msgspec.Struct, frozen=True):
    """The dead letters of a system or a process.

    Attributes:
        count: their number.
        letters: the newest of them, oldest first.
    """

    count: int
    letters: list[DeadLetter]

    def __str__(self) -> str:
        return "\n".join([f"{self.count} dead letters", *map(str, self.letters)])


Listener = Callable[[DeadLetter, int], None]
"""Called from any thread with a letter, and the number of letters so far."""


class Office:
    """The dead letters of a process. From any thread."""

    def __init__(self) -> None:
        self.count = 0
        self.listener: Listener | None = None
        self._lock = threading.Lock()
        self._kept: deque[tuple[int, DeadLetter]] = deque(maxlen=KEPT)
        self._logged_at = float("-inf")
        self._unlogged = 0
        self._second = 0
        self._told = 0

    def letters(self, after: int = 0) -> DeadLetters:
        """Return the letters after the first `after` ones."""
        with self._lock:
            return DeadLetters(self.count - after, [letter for number, letter in self._kept if number > after])

    def record(self, to: str, messages: Sequence[Any], why: str, *, unheard: int) -> None:
        """Record messages that did not reach one actor, for one reason. `unheard`: how many senders get no error.

        A question about a supervisor's tree is none of them: consoles ask many, also while a system stops.
        """
        messages = [message for message in messages if not isinstance(message, SupervisorLook)]
        process = event_loop.current()
        at = time.time()
        if process is not None and process.is_loop_thread() and not all(type(message) is Lost for message in messages):
            try:
                process.workers.serial("dead letters", self._record, to, messages, why, unheard, at)
                return
            except Unavailable:  # no thread is free, or the process ends: letters without texts are better than none
                messages = [Lost(type(message).__name__) for message in messages]
        self._record(to, messages, why, unheard, at)

    def _record(self, to: str, messages: Sequence[Any], why: str, unheard: int, at: float) -> None:
        letters = [DeadLetter(to, shown(message), why, at, os.getpid()) for message in messages[-KEPT:]]
        if not letters:
            return
        with self._lock:
            self.count += len(messages)
            count = self.count
            self._kept.extend((count - len(letters) + number, letter) for number, letter in enumerate(letters, 1))
            unlogged = self._may_log(unheard)
            told = self._may_tell(len(letters)) if self.listener is not None else 0
            telling = letters[len(letters) - told :]
        if unlogged:
            more = f"; {unlogged} since the last such line" if unlogged > 1 else ""
            logger.warning("dead letter to %s: %s (%s)%s", to, letters[-1].message, why, more)
        for letter in telling:
            listener = self.listener
            if listener is not None:
                listener(letter, count)

    def _may_log(self, more: int) -> int:
        """Return how many letters to log in a line now; 0: no line is due. With the lock."""
        self._unlogged += more
        now = time.monotonic()
        if not more or now - self._logged_at < LOG_EVERY_S:
            return 0
        unlogged, self._unlogged, self._logged_at = self._unlogged, 0, now
        return unlogged

    def _may_tell(self, wanted: int) -> int:
        second = int(time.monotonic())
        if second != self._second:
            self._second, self._told = second, 0
        allowed = min(wanted, EVENTS_A_SECOND - self._told)
        self._told += allowed
        return allowed


office = Office()
"""The dead letters of this process."""


class Collection:
    """The dead letters of a system: those of this process from now on, and those that others report."""

    def __init__(self) -> None:
        self._before = office.count
        self._elsewhere: deque[DeadLetter] = deque(maxlen=KEPT)
        self._counts: dict[int, int] = {}

    def heard(self, event: dict[str, Any]) -> None:
        """Note a letter of another process, and its count, from plain data."""
        if event["pid"] != os.getpid():
            letter = DeadLetter(event["to"], event["message"], event["why"], event["at"], event["pid"])
            self._elsewhere.append(letter)
            self._counts[letter.pid] = max(event["count"], self._counts.get(letter.pid, 0))

    def all(self) -> DeadLetters:
        """Return the letters of all processes, oldest first."""
        here = office.letters(self._before)
        letters = sorted([*here.letters, *self._elsewhere.copy()], key=lambda letter: letter.at)
        return DeadLetters(here.count + sum(list(self._counts.values())), letters[-KEPT:])


class Lost(msgspec.Struct, frozen=True):
    """Stands for a message without a text, such as a packed one; `what` describes it: "12 bytes"."""

    what: str

    def __repr__(self) -> str:
        return f"<{self.what}>"
