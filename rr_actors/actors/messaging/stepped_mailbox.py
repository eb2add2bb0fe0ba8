"""SteppedMailbox: the mailbox of an actor in a system that was started for debugging. It can be paused and stepped.

An actor takes its next message here, so this is where it is held up. What it handles at the moment it finishes. As for
sys:suspend of OTP, what comes waits, up to the mailbox's limit, and a supervisor can still stop the actor.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from pykka._envelope import Envelope as PykkaEnvelope

from rr_actors.actors.messaging.mailbox import Mailbox, is_stop
from rr_actors.base.errors import UsageError

Handled = Callable[[PykkaEnvelope[Any] | None], None]
"""Called with the message that was handled; with None if the actor has ended before it took one."""


class SteppedMailbox(Mailbox):
    """A mailbox that gives its messages one by one while it is paused."""

    def __init__(self, owner: str, limit: int, *, opens_packed: bool = False) -> None:
        super().__init__(owner, limit, opens_packed=opens_packed)
        self.is_paused = False
        self._asked: Handled | None = None  # of a step that has no message yet
        self._stepped: tuple[Handled, PykkaEnvelope[Any]] | None = None  # the step whose message is being handled

    def pause(self) -> None:
        """Keep all messages from now on, but for a supervisor's stop. From any thread."""
        with self._lock:
            self.is_paused = True

    def resume(self) -> None:
        """Give messages again. From any thread."""
        with self._lock:
            self.is_paused = False
        self._wake()

    def step(self, handled: Handled) -> bool:
        """Give one message, and call handled() with it when the actor has handled it; return False if none waits.

        From any thread. handled() must not raise: the actor's own thread calls it.

        Raises:
            UsageError: it is not paused, or the last step has not ended.
        """
        with self._lock:
            if not self.is_paused:
                raise UsageError(f"{self._owner}: it is not paused, so it cannot be stepped; pause it first")
            if self._asked is not None or self._stepped is not None:
                raise UsageError(f"{self._owner}: its last step has not ended: its handler has not returned")
            if self.empty():
                return False
            self._asked = handled
        self._wake()
        return True

    def next(self) -> PykkaEnvelope[Any] | None:
        """Take the next message; None if there is none, or it is paused."""
        self._end_step()
        with self._lock:
            lane = self._next_lane()
            if lane is None:
                return None
            taken = lane.popleft()
            if self._asked is not None and not _overtakes(taken):
                self._stepped, self._asked = (self._asked, taken), None
            return taken

    def rest(self) -> bool:
        """Note that the actor rests; return False if it has a message to handle."""
        with self._lock:
            self._at_rest = self._next_lane() is None
            return self._at_rest

    def close(self) -> list[PykkaEnvelope[Any]]:
        """Refuse messages from now on, and return those that were not handled."""
        left = super().close()
        self._end_step()
        asked, self._asked = self._asked, None
        if asked is not None:
            asked(None)
        return left

    def _next_lane(self) -> deque[PykkaEnvelope[Any]] | None:
        """Return where the next message is that the actor may have. With the lock."""
        lane = self._control or self.waiting
        if not lane:
            return None
        if not self.is_paused or self._asked is not None:
            return lane
        for at, envelope in enumerate(self._control):
            if _overtakes(envelope):  # also Downs, which wait as other messages do
                self._control.rotate(-at)
                return self._control
        return None

    def _end_step(self) -> None:
        stepped, self._stepped = self._stepped, None
        if stepped is not None:
            stepped[0](stepped[1])

    def _wake(self) -> None:
        """Schedule the actor if it rests and has a message to handle."""
        with self._lock:
            schedule = self._schedule
            if not self._at_rest or schedule is None or self._next_lane() is None:
                return
            self._at_rest, self._due = False, True
        self._rouse(schedule)


def _overtakes(envelope: PykkaEnvelope[Any]) -> bool:
    return is_stop(envelope.message) and getattr(envelope.message, "reason", "normal") == "shutdown"
