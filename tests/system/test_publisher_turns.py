"""A publisher, and two of its threads that hear the same readers: its own, and one that has the turn meanwhile."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import pytest

from rr_actors.streams.publisher import Publisher
from rr_actors.streams.stream import Stream
from rr_actors.streams.stream_sockets import address_of
from rr_actors.wire.segments import Segments
from support import eventually
from support_inside import readers_of


class Interleaved(deque[Callable[[], None]]):
    """Tasks of which the next is left to the test's thread; before that does it, the publisher's thread polls again."""

    def __init__(self) -> None:
        super().__init__()
        self.taken, self.polled, self.heard = threading.Event(), threading.Event(), threading.Event()

    def append(self, task: Callable[[], None]) -> None:
        super().append(task)
        if threading.current_thread() is not threading.main_thread():
            self.taken.wait(10)

    def popleft(self) -> Callable[[], None]:
        task = super().popleft()
        self.taken.set()
        if threading.current_thread() is threading.main_thread():
            assert self.polled.wait(10)
        return task


def test_a_new_reader_is_not_taken_for_one_that_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    publisher = Publisher(Stream("resource", "turns"), Segments(0))
    publisher.let_in(lambda *_: None)
    address, tasks = address_of(publisher.stream), Interleaved()

    class Epoll:
        def __init__(self, ready: Any) -> None:
            self._ready = ready

        def __getattr__(self, name: str) -> Any:
            return getattr(self._ready, name)

        def poll(self, timeout: float | None = None) -> list[tuple[int, int]]:
            """Return what is ready, what ends last; after the second poll of the publisher's thread wait."""
            ready = sorted(self._ready.poll(timeout), key=lambda one: one[1])
            if timeout != 0 and tasks.taken.is_set():
                tasks.polled.set()
                tasks.heard.wait(10)
            return ready

    def connected() -> socket.socket:
        end = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        end.connect(address)
        return end

    first = connected()
    eventually(lambda: readers_of(publisher) == 1)
    monkeypatch.setattr(publisher, "_ready", Epoll(publisher._ready))
    other = connected()  # after this one the publisher's thread polls as above
    eventually(lambda: readers_of(publisher) == 2)
    monkeypatch.setattr(publisher, "_tasks", tasks)
    first.close()
    eventually(lambda: tasks)
    second = connected()
    publisher._work()
    tasks.heard.set()
    poll = select.poll()
    poll.register(second, select.POLLRDHUP)
    assert poll.poll(500) == []
    for end in (other, second):
        with contextlib.suppress(OSError):
            end.close()
    publisher.close()
