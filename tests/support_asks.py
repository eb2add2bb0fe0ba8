"""What the tests of asks between processes share: which way they go, and a connection that the test has in hand."""

from __future__ import annotations

import contextlib
import socket
import threading
import uuid
from collections.abc import Callable
from typing import Any

import pytest

from rr_actors.actors.refs import ActorRef, ref_to
from rr_actors.actors.remote.peer import Line, PendingCall
from rr_actors.actors.remote.protocol import Answered, Ask, Letter
from rr_actors.base import pickling
from rr_actors.runtime.time_limits import left_until
from rr_actors.wire.segments import Segments
from support_refs import Home


class Puts:
    """Notes each letter that is put on a line: what goes by the link."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.letters: list[Letter] = []
        put = Line.put

        def note(line: Line, letter: Letter, call: PendingCall | None = None) -> None:
            self.letters.append(letter)
            put(line, letter, call)

        monkeypatch.setattr(Line, "put", note)

    def asks(self) -> int:
        return sum(isinstance(letter, Ask) for letter in self.letters)

    def by_link(self, fn: Callable[[], Any]) -> bool:
        """Call it; whether anything went by the link for it."""
        before = len(self.letters)
        fn()
        return len(self.letters) > before


def make_actor(cls: str) -> ActorRef[Any]:
    """An actor of a class in the process that has root/factory."""
    id = f"a-{uuid.uuid4().hex[:8]}"
    factory: Any = ref_to("root/factory").proxy()
    factory.make(id, cls).get(timeout=10)
    return ref_to(f"root/{id}")


def line_of(home: Home) -> Line:
    """The only one there is."""
    (line,) = home.hub.lines()
    return line


def idle(line: Line) -> list[Any]:
    """The connections that no thread has now."""
    return line.connections.idle


def warm(ref: ActorRef[Any]) -> None:
    """What is asked next goes by a connection of its thread's own."""
    for _ in range(3):
        assert ref.ask("warm") == "warm"


def in_threads(*fns: Callable[[], Any]) -> None:
    """Call each in a thread of its own; raise what the first of them raised."""
    failures: list[BaseException] = []

    def run(fn: Callable[[], Any]) -> None:
        try:
            fn()
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=run, args=(fn,)) for fn in fns]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if failures:
        raise failures[0]


class Background:
    """A call in a thread of its own."""

    def __init__(self, fn: Callable[[], Any]) -> None:
        self._fn = fn
        self.value: Any = None
        self.error: BaseException | None = None
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self) -> None:
        try:
            self.value = self._fn()
        except BaseException as error:
            self.error = error

    def result(self, timeout: float = 10.0) -> Any:
        """What it returned; raises what it raised."""
        self.thread.join(timeout)
        assert not self.thread.is_alive(), "it has not come back"
        if self.error is not None:
            raise self.error
        return self.value


def answered(letter: Ask) -> Answered:
    return Answered(letter.call, pickling.dumps("done"))


class FakeExchange:
    """A connection of a thread; what `exchange` does is the test's. `there` is the other end."""

    epoch = 0

    def __init__(self, exchange: Callable[[Any, float], Any]) -> None:
        self.here, self.there = socket.socketpair()
        self._exchange = exchange
        self.limits: list[float | None] = []
        self.was_cut = threading.Event()
        self.parcels = Segments(0).parcels(0)

    def exchange(self, message: Any, deadline: float) -> Any:
        self.limits.append(left_until(deadline))
        return self._exchange(message, deadline)

    def fileno(self) -> int:
        return self.here.fileno()

    def leave(self) -> None:
        with contextlib.suppress(OSError):
            self.here.shutdown(socket.SHUT_WR)

    def has_ended(self) -> bool:
        with contextlib.suppress(BlockingIOError):
            while self.here.recv(1000, socket.MSG_DONTWAIT):
                pass
            return True
        return False

    def cut(self) -> None:
        self.was_cut.set()

    def close(self) -> None:
        self.here.close()

    @property
    def is_closed(self) -> bool:
        return self.here.fileno() < 0
