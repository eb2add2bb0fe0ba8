"""LocalLine: the connection of a thread to a registrar of the same process."""

from __future__ import annotations

import functools
import queue
from collections.abc import Callable
from typing import Protocol

from rr_actors.hosting.process_node import ProcessNode
from rr_actors.registrar.links.consumer_links import Consumers
from rr_actors.registrar.model.messages import Message
from rr_actors.runtime.time_limits import left_until
from rr_actors.wire.transport import Hello


class Provider(Protocol):
    """A registrar of this process, as a line sees it."""

    epoch: int
    closed: bool
    consumers: Consumers


class LocalLine:
    """An Exchange of a thread with a registrar of this process; for the registrar it is a Link.

    The calling thread itself joins a resource that is loaded and held, and leaves one that others hold, too. The loop
    decides all other messages.
    """

    def __init__(self, node: ProcessNode, registrar: Provider, hello: Hello) -> None:
        self._node = node
        self._registrar = registrar
        self.hello = hello
        self._unanswered = [None]  # only the thread that takes the entry out may answer
        self._answers: queue.SimpleQueue[Message | None] = queue.SimpleQueue()
        self.epoch = registrar.epoch

    def exchange(self, message: Message, deadline: float) -> Message:
        """Send a message and return its answer; raise TimeoutError, or ConnectionResetError once it is closed."""
        if self._registrar.closed:
            raise ConnectionResetError("the registrar is closed")
        consumers = self._registrar.consumers
        if (answer := consumers.answer_here(message, self.hello)) is not None:
            return answer
        if not self._unanswered and self._answers.empty():
            self._unanswered.append(None)
        self._node.dispatcher.hand_over(consumers.received_here, self, message)
        left_s = left_until(deadline)
        try:
            answer = self._answers.get(timeout=left_s)
        except queue.Empty:
            raise TimeoutError from None
        if answer is None:
            raise ConnectionResetError("the registrar was closed")
        return answer

    def send(self, answer: Message | None) -> None:
        """Give the answer to the waiting thread; with None, its exchange() fails."""
        try:
            self._unanswered.pop()
        except IndexError:  # there is an answer already, and no thread waits
            return
        self._answers.put(answer)

    def open_outlet(self) -> None:
        """Do nothing: any thread can answer on this line already."""

    def answering(self, message: Message) -> Callable[[], None]:
        """Return a function that gives the answer to the waiting thread."""
        return functools.partial(self.send, message)

    send_now = send

    def flush(self) -> None:
        """Do nothing: send() holds nothing back."""

    def cut(self) -> None:
        """Have exchange() of the waiting thread fail."""
        self.send(None)

    def close(self) -> None:
        """Close the line: exchange() fails if it waits, and the link carries answers that are still to come."""
        self.send(None)
        self._node.dispatcher.call(self._registrar.consumers.lost_directly, self, None)
