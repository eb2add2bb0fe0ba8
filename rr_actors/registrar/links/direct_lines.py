"""Direct lines: a thread that loads or unloads for itself exchanges messages with the provider without its own loop.

The shortest way: the caller's thread writes the request and reads the answer; only the provider commits. The consumer's
registrar is told after the answer has come, without being woken; of what is under way it is told at once if something
comes in that may be about it (a status that overtakes the answer). A line that breaks hands over to the client, which
sends again.

Only for loads without a parent: a probe that looks for rings must not overtake the load it follows
(registrar/core/loading.py).
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, Protocol
from weakref import WeakSet

from rr_actors.base.errors import RrError
from rr_actors.registrar.model.messages import Load, Message
from rr_actors.runtime.thread_wakeup import new_bell
from rr_actors.wire.name_service import Status
from rr_actors.wire.transport import Hello

KIND = "direct"
_IDLE_LIMIT = 16
_QUICK = 8  # local lines of a process that take file descriptors
_DIAL_S = 0.1  # a provider that takes longer to shake hands is busy, or hangs: the client has more patience


class Line(Protocol):
    """One exchange at a time."""

    epoch: int

    def exchange(self, message: Message, timeout_s: float | None) -> Message:
        """Send and return the answer.

        Raises:
            TimeoutError: no answer in time; the line is not to be used again.
            OSError: the line is broken; the message may have arrived.
            NotSerializable: too long for a frame; the line is as it was.
        """
        ...

    def close(self) -> None:
        """Let it go."""
        ...


def exchange_recorded(line: Line, registrar: Any, provider: str, message: Message, timeout_s: float | None) -> Message:
    """As `line.exchange`, and both messages are recorded.

    Args:
        registrar: the actor of the registrar whose message it is.
    """
    recorder = registrar.node.recorder
    recorder.message("sent", registrar.name, provider, message)
    answer = line.exchange(message, timeout_s)
    recorder.message("received", registrar.name, provider, answer)
    return answer


class LocalLine:
    """A line to a registrar in this process: it is a link to it, too.

    Args:
        quick: whether it may take file descriptors to be quicker (thread_wakeup.py).
    """

    local = True

    def __init__(self, node: Any, registrar: Any, hello: Hello, *, quick: bool) -> None:
        self._node = node
        self._registrar = registrar
        self.hello = hello
        self._unanswered = [None]  # whoever takes it out answers, and nobody else
        self._answers: deque[Message | None] = deque()
        self._bell = new_bell(quick=quick)
        self.epoch: int = registrar.epoch

    def exchange(self, message: Message, timeout_s: float | None) -> Message:
        """See Line."""
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
        """As a link of the registrar: the answer."""
        self._tell(message)

    def _tell(self, answer: Message | None) -> None:
        try:
            self._unanswered.pop()
        except IndexError:  # it has been rung, and nobody waits any more
            return
        self._answers.append(answer)
        self._bell.ring()

    def open_outlet(self) -> None:
        """As a link: any thread can answer as it is."""

    def answering(self, message: Message) -> Callable[[], None]:
        """As a link."""
        return functools.partial(self._tell, message)

    send_now = send

    def flush(self) -> None:
        """As a link: nothing is held back."""

    def close(self) -> None:
        """As a link: without an answer, the exchange has failed. As a line: what it waits for is answered otherwise."""
        self._tell(None)
        self._node.dispatcher.call(self._registrar.consumers.lost_directly, self)


_counting = threading.Lock()  # of threads that dial at once
_quick_lines: WeakSet[LocalLine] = WeakSet()


class DirectLines:
    """The lines of one registrar, by provider. From any thread."""

    def __init__(self, registrar: Any) -> None:
        self._registrar = registrar
        self._node = registrar.node
        self._idle: dict[str, list[Line]] = {}
        self._closed = False
        self.sequence = itertools.count(registrar.catalog.seq + 1)

    def take(self, provider: str) -> Line | None:
        """Return a line to a provider that is known and reconciled; None if the long way is to be taken.

        That way it is written, before anything is asked for, that the provider is one to look for after a crash.
        """
        catalog = self._registrar.catalog
        up = catalog.up.get(provider)
        if up is None or provider not in catalog.peers:
            return None
        if self._closed or self._node.dispatcher.closed:  # in a forked child all this is its parent's
            return None
        idle = self._idle.get(provider)
        while idle:
            try:
                line = idle.pop()
            except IndexError:  # another thread was faster
                break
            if line.epoch == up.epoch:
                return line
            line.close()
        return self._dial(provider)

    def give_back(self, provider: str, line: Line) -> None:
        """Keep a line for the next."""
        idle = self._idle.setdefault(provider, [])
        if len(idle) >= _IDLE_LIMIT:
            line.close()
            return
        idle.append(line)
        if self._closed:  # perhaps since all that were there have been let go
            self._let_go()

    def _dial(self, provider: str) -> Line | None:
        node = self._node
        hello = Hello(KIND, provider, self._registrar.name, self._registrar.epoch)
        here = node.registrars.get(provider)
        if here is not None:
            return self._local(here, hello) if here.serving else None
        entry = node.find(provider)
        if entry is None or entry.status is not Status.UP:
            return None
        try:
            return node.transport.dial(entry.address, hello, _DIAL_S)
        except RrError:
            return None

    def _local(self, registrar: Any, hello: Hello) -> LocalLine:
        with _counting:
            quick = len(_quick_lines) < _QUICK
            line = LocalLine(self._node, registrar, hello, quick=quick)
            if quick:
                _quick_lines.add(line)
        return line

    def close(self) -> None:
        """Let all idle lines go, and make no more."""
        self._closed = True
        self._let_go()

    def _let_go(self) -> None:
        for idle in list(self._idle.values()):  # to which threads add, and which they empty
            while idle:
                with contextlib.suppress(IndexError):
                    idle.pop().close()
