"""LocalLine: what a thread's own connection is to a registrar of the same process."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable
from typing import Any

from rr_actors.registrar.model.messages import Load, Message
from rr_actors.runtime.thread_wakeup import Bell, LockBell
from rr_actors.wire.transport import Hello


class LocalLine:
    """An Exchange with a registrar of this process: it is a Link to it, too.

    The calling thread joins by itself what is loaded and held. The loop does the rest.
    """

    def __init__(self, node: Any, registrar: Any, hello: Hello) -> None:
        self._node = node
        self._registrar = registrar
        self.hello = hello
        self._unanswered = [None]  # who takes it out answers, and nobody else
        self._answers: deque[Message | None] = deque()
        self._bell: Bell = LockBell()
        self.epoch: int = registrar.epoch

    def exchange(self, message: Message, timeout_s: float | None) -> Message:
        """Send a message and return the one that comes back; see Exchange."""
        if self._registrar.closed:
            raise ConnectionResetError("the registrar is closed")
        consumers = self._registrar.consumers
        origin, epoch = self.hello.origin, self.hello.epoch
        if type(message) is Load and (joined := self._registrar.join_here(message, epoch)) is not None:
            return joined
        if not self._unanswered and not self._answers:
            self._unanswered.append(None)
        self._node.dispatcher.hand_over(consumers.received_directly, origin, epoch, self, message)
        if not self._bell.wait(-1 if timeout_s is None else max(0.0, timeout_s)):
            raise TimeoutError
        answer = self._answers.popleft()
        if answer is None:
            raise ConnectionResetError("the registrar was closed")
        return answer

    def send(self, message: Message) -> None:
        """As a Link of the registrar: the answer."""
        self._tell(message)

    def _tell(self, answer: Message | None) -> None:
        try:
            self._unanswered.pop()
        except IndexError:  # it has been rung, and nobody waits any more
            return
        self._answers.append(answer)
        self._bell.ring()

    def open_outlet(self) -> None:
        """As a Link: any thread can answer as it is."""

    def answering(self, message: Message) -> Callable[[], None]:
        """As a Link."""
        return functools.partial(self._tell, message)

    send_now = send

    def flush(self) -> None:
        """As a Link: nothing is held back."""

    def cut(self) -> None:
        """Have the thread that waits hear that it is lost; see Exchange."""
        self._tell(None)

    def close(self) -> None:
        """As a Link: without an answer, the exchange has failed. As an Exchange: its question is answered otherwise."""
        self._tell(None)
        self._node.dispatcher.call(self._registrar.consumers.lost_directly, self, None)
