"""Outlets: threads that write to a connection beside the transport that has it."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import math
import os
import queue
import socket
import threading
import time
import types
from collections import deque
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import asynccontextmanager, closing
from pathlib import Path
from typing import Any, cast

import pytest

from rr_actors.registrar.links import local_line
from rr_actors.registrar.links.local_line import LocalLine
from rr_actors.registrar.model.messages import Load, Loaded
from rr_actors.wire import unix_link
from rr_actors.wire.frames import GOODBYE, framed
from rr_actors.wire.unix_link import Outlet, UnixLink
from rr_actors.wire.unix_transport import UnixTransport
from support_transports import HELLO, KEY, LOOPS, Door, Inbox, Note, authenticated, loop_of, stream

Run = Callable[[Coroutine[Any, Any, None]], None]
LIMIT_BYTES = 16_000_000
LONG = Note(1, os.urandom(4_000_000))


def frame_of(message: Note) -> bytes:
    return framed(message, LIMIT_BYTES)


def descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


def in_thread(fn: Callable[[], object]) -> None:
    """Call it in a thread of its own, while the loop waits for that."""
    thread = threading.Thread(target=fn)
    thread.start()
    thread.join()


# -- an outlet -------------------------------------------------------------------------------------------------------


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    """A connection: the end that is written to, and its peer's."""
    here, there = socket.socketpair()
    here.setblocking(False)
    with closing(here), closing(there):
        there.settimeout(10)
        yield here, there


def read(there: socket.socket, size: int) -> bytes:
    received = b""
    while len(received) < size:
        data = there.recv(65536)
        assert data
        received += data
    return received


def test_what_the_connection_takes_is_written_and_nothing_is_left(ends: tuple[socket.socket, socket.socket]) -> None:
    here, there = ends
    outlet = Outlet(here.fileno())
    assert outlet.write(b"answer")
    assert there.recv(100) == b"answer"
    assert outlet.take_rest() == b""
    assert outlet.close() == b""


def test_what_the_connection_does_not_take_is_kept_for_the_loop(ends: tuple[socket.socket, socket.socket]) -> None:
    here, there = ends
    data = os.urandom(4_000_000)
    outlet = Outlet(here.fileno())
    assert not outlet.write(data)
    rest = outlet.take_rest()
    assert 0 < len(rest) < len(data)
    assert read(there, len(data) - len(rest)) + rest == data
    assert outlet.take_rest() == b""
    assert outlet.close() == b""


def test_all_is_kept_of_what_a_full_connection_does_not_take(ends: tuple[socket.socket, socket.socket]) -> None:
    here, _ = ends
    with contextlib.suppress(BlockingIOError):
        while True:
            here.send(bytes(65536))
    outlet = Outlet(here.fileno())
    assert not outlet.write(b"answer")
    assert outlet.close() == b"answer"
    assert outlet.take_rest() == b""


def test_what_a_lost_connection_does_not_take_is_dropped(ends: tuple[socket.socket, socket.socket]) -> None:
    here, there = ends
    outlet = Outlet(here.fileno())
    there.close()
    assert outlet.write(b"answer")
    assert outlet.close() == b""


def test_its_descriptor_is_its_own_and_given_back_once(ends: tuple[socket.socket, socket.socket]) -> None:
    here, there = ends
    before = descriptors()
    outlet = Outlet(here.fileno())
    assert descriptors() == before + 1
    here.close()
    with socket.socket():  # takes the number that has become free
        assert outlet.write(b"answer")
        assert there.recv(100) == b"answer"
    outlet.close()
    assert there.recv(100) == b""
    with socket.socketpair()[0] as other:
        outlet.close()
        assert other.fileno() >= 0
        os.fstat(other.fileno())
    assert descriptors() == before - 1


def test_a_closed_one_writes_nothing(ends: tuple[socket.socket, socket.socket]) -> None:
    here, there = ends
    outlet = Outlet(here.fileno())
    outlet.close()
    assert outlet.write(b"answer")
    here.send(b"next")
    assert there.recv(100) == b"next"


def test_without_descriptors_there_is_none(
    ends: tuple[socket.socket, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "dup", no_descriptors)
    with pytest.raises(OSError, match="Too many open files"):
        Outlet(ends[0].fileno())


def no_descriptors(_fd: int) -> int:
    raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))


# -- of a link between processes -------------------------------------------------------------------------------------


@pytest.fixture(params=LOOPS)
def run(request: pytest.FixtureRequest) -> Iterator[Run]:
    with loop_of(request.param) as loop:
        yield lambda scenario: loop.run_until_complete(asyncio.wait_for(scenario, 40))


@asynccontextmanager
async def opened(directory: Path) -> AsyncIterator[tuple[UnixLink, Inbox, asyncio.StreamReader]]:
    """A provider's link, who hears what comes on it, and its peer's end, at which nobody reads."""
    transport = UnixTransport(directory, KEY, {"registrar": Note})
    door = Door()
    try:
        await transport.listen(door)
        async with stream(directory / transport.address) as (reader, writer):
            await authenticated(reader, writer)
            inbox = await door.opened()
            yield cast(UnixLink, inbox.link), inbox, reader
    finally:
        await transport.close()


def answering(link: UnixLink, message: Note) -> Callable[[], None]:
    answer = link.answering(message)
    assert answer is not None
    return answer


def test_a_thread_answers_while_the_loop_does_something_else(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Outlet] = []

    def noted(fd: int) -> Outlet:
        made.append(Outlet(fd))
        return made[-1]

    monkeypatch.setattr(unix_link, "Outlet", noted)

    async def scenario() -> None:
        async with opened(tmp_path) as (link, _, reader):
            link.open_outlet()
            link.open_outlet()
            assert len(made) == 1
            sent = threading.Event()
            answer = answering(link, Note(5))
            in_thread(lambda: (answer(), sent.set()))
            assert sent.is_set()
            expected = frame_of(Note(5))
            assert await reader.readexactly(len(expected)) == expected

    run(scenario())


def test_a_long_answer_arrives_whole_at_a_peer_that_reads_slowly_and_what_the_loop_sends_next_behind_it(
    run: Run, tmp_path: Path
) -> None:
    async def scenario() -> None:
        async with opened(tmp_path) as (link, _, reader):
            link.open_outlet()
            for _ in range(3):
                answer = answering(link, LONG)
                in_thread(answer)
                expected = frame_of(LONG)
                received = b""
                while len(received) < len(expected):
                    received += await reader.read(100_000)
                    await asyncio.sleep(0)
                assert received == expected
                link.send(Note(2))
                link.flush()
                assert await reader.readexactly(len(frame_of(Note(2)))) == frame_of(Note(2))

    run(scenario())


def test_a_link_that_is_closed_while_an_answer_is_half_written_sends_all_of_it_before_its_goodbye(
    run: Run, tmp_path: Path
) -> None:
    async def scenario() -> None:
        async with opened(tmp_path) as (link, _, reader):
            link.open_outlet()
            in_thread(answering(link, LONG))
            link.close()
            assert await reader.read() == frame_of(LONG) + GOODBYE

    run(scenario())


def test_an_answer_that_comes_when_the_link_is_closed_is_dropped(run: Run, tmp_path: Path) -> None:
    async def scenario() -> None:
        async with opened(tmp_path) as (link, _, reader):
            link.open_outlet()
            answer = answering(link, Note(5))
            link.close()
            assert link.answering(Note(5)) is None
            in_thread(answer)
            link.open_outlet()
            assert await reader.read() == GOODBYE

    run(scenario())


def test_a_link_whose_peer_has_gone_is_lost_once_whatever_a_thread_answers(run: Run, tmp_path: Path) -> None:
    async def scenario() -> None:
        transport = UnixTransport(tmp_path, KEY, {"registrar": Note})
        door = Door()
        await transport.listen(door)
        async with stream(tmp_path / transport.address) as (reader, writer):
            await authenticated(reader, writer)
            inbox = await door.opened()
            link = cast(UnixLink, inbox.link)
            link.open_outlet()
            answer = answering(link, LONG)
        in_thread(answer)
        await inbox.is_lost()
        in_thread(answer)
        assert link.answering(Note(1)) is None
        await transport.close()
        assert len(inbox.lost_reasons) == 1

    run(scenario())


def test_without_descriptors_or_an_answer_that_can_travel_it_is_left_to_the_loop(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scenario() -> None:
        async with opened(tmp_path) as (link, _, reader):
            assert link.answering(Note(1)) is None
            with monkeypatch.context() as patch:
                patch.setattr(os, "dup", no_descriptors)
                link.open_outlet()
            assert link.answering(Note(1)) is None
            link.send(Note(1))
            link.flush()
            assert await reader.readexactly(len(frame_of(Note(1)))) == frame_of(Note(1))
            link.open_outlet()
            assert link.answering(Note(1)) is not None
            assert link.answering(Note(1, bytes(17 * 1024 * 1024))) is None
            assert link.answering(object()) is None

    run(scenario())


def test_no_descriptor_is_left_of_many_links(run: Run, tmp_path: Path) -> None:
    async def scenario() -> None:
        async def once(number: int) -> None:
            async with opened(tmp_path) as (link, _, reader):
                link.open_outlet()
                in_thread(answering(link, Note(number)))
                await reader.readexactly(len(frame_of(Note(number))))
                if number % 3 == 0:
                    link.close()
                elif number % 3 == 1:
                    link.abort(None)

        await once(0)
        before = descriptors()
        for number in range(60):
            await once(number)
        for _ in range(1000):  # the loop closes them a turn or two later
            if descriptors() <= before:
                return
            await asyncio.sleep(0.003)
        raise AssertionError("descriptors are left open")

    run(scenario())


# -- of a line within a process ---------------------------------------------------------------------------------------


class Provider:
    """Dispatcher and registrar of a local line; what is handed over `answer` deals with."""

    epoch = 1
    closed = False

    def __init__(self) -> None:
        self.dispatcher = self.consumers = self
        self.answer: Callable[[LocalLine], object] = lambda line: None

    def call(self, *_: object) -> None: ...

    def answer_here(self, _message: object, _hello: object) -> None: ...

    def received_here(self, *_: object) -> None: ...

    def lost_directly(self, _line: LocalLine) -> None: ...

    def hand_over(self, _fn: object, line: LocalLine, _message: object) -> None:
        self.answer(line)


@pytest.fixture
def provider() -> Provider:
    return Provider()


class Answers(queue.SimpleQueue[Any]):
    """Counts the answers that were ever in it."""

    newest: Answers

    def __init__(self) -> None:
        super().__init__()
        self.count = 0
        Answers.newest = self

    def put(self, item: Any, block: bool = True, timeout: float | None = None) -> None:
        self.count += 1
        super().put(item, block, timeout)


@pytest.fixture
def line(provider: Provider, monkeypatch: pytest.MonkeyPatch) -> LocalLine:
    monkeypatch.setattr(local_line, "queue", types.SimpleNamespace(SimpleQueue=Answers, Empty=queue.Empty))
    both: Any = provider
    return LocalLine(both, both, HELLO)


LOAD = Load("q", "thing", b"", "app", "", 0, 1)
LOADED = Loaded("q", "q", b"")


def together(*calls: Callable[[], object]) -> None:
    """Make each call in a thread of its own, all at once."""
    barrier = threading.Barrier(len(calls))
    threads = [threading.Thread(target=lambda call=call: (barrier.wait(), call())) for call in calls]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def test_of_threads_that_answer_a_line_and_close_it_at_once_one_is_heard(provider: Provider, line: LocalLine) -> None:
    answers, heard = Answers.newest, list[int]()
    calls: deque[Callable[[], object]] = deque([line.answering(LOADED), line.answering(LOADED), line.close])

    def answer(_line: LocalLine) -> None:
        calls.rotate()
        before = answers.count
        together(*calls)
        heard.append(answers.count - before)

    provider.answer = answer
    for _ in range(100):
        with contextlib.suppress(ConnectionResetError):
            assert line.exchange(LOAD, math.inf) == LOADED
    assert heard == [1] * 100


def test_a_line_that_was_answered_is_asked_again_and_hears_nothing_of_before(
    provider: Provider, line: LocalLine
) -> None:
    for number in range(3):
        loaded = Loaded(f"q{number}", "q", b"")
        provider.answer = lambda line, loaded=loaded: line.answering(loaded)()
        assert line.exchange(LOAD, math.inf) == loaded
        line.answering(LOADED)()
        line.send(LOADED)
        assert Answers.newest.empty()


def test_nobody_is_told_anything_by_a_line_that_was_left(provider: Provider, line: LocalLine) -> None:
    with pytest.raises(TimeoutError):
        line.exchange(LOAD, time.monotonic())
    line.close()
    line.answering(LOADED)()
    line.close()
    assert Answers.newest.count == 1
