"""Streams when something goes wrong: what is lost is counted, what can go on does, and nothing waits for ever."""

from __future__ import annotations

import asyncio
import gc
import os
import pickle
import resource
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
import uvloop

import rr_actors as rr
from rr_actors.streams.stream_sockets import known_streams
from support import Gate, eventually, kill, pid_of, wait_respawned
from support_inside import on_loop
from support_interrupts import interrupted

Start = Callable[..., rr.System]

MB = 2**20


class Boards(rr.Manager):
    """Each resource has the streams of its request."""

    def __init__(self) -> None:
        self.streams: dict[str, rr.Publisher] = {}
        self.sent: list[int] = []
        self.threads: list[threading.Thread] = []

    @rr.server("board", recovery="reload")
    def open_board(self, names: list[str]) -> list[rr.Stream]:
        for name in names:
            self.streams[name] = rr.current().open_stream(name)
        return [self.streams[name].stream for name in names]

    @open_board.unload
    def close_board(self, names: list[str], response: list[rr.Stream]) -> None: ...

    @rr.server("once")
    def open_once(self) -> None:
        self.streams["once"] = rr.current().open_stream("once")

    @rr.server("plain", recovery="reload")
    def open_plain(self) -> None:
        self.streams["plain"] = rr.current().open_stream("plain")

    def on_receive(self, message: Any) -> None:
        raise RuntimeError(message)

    def publish(self, name: str, *values: object, timeout_s: Any = None) -> list[int]:
        return [self.streams[name].publish(value, timeout_s=timeout_s) for value in values]

    def publish_buffers(self, name: str, size: int, count: int, timeout_s: float | None = None) -> list[int]:
        return [self._publish_buffer(name, size, fill % 256, timeout_s) for fill in range(count)]

    def _publish_buffer(self, name: str, size: int, fill: int, timeout_s: float | None) -> int:
        return self.streams[name].publish(pickle.PickleBuffer(bytearray([fill]) * size), timeout_s=timeout_s)

    def publish_buffers_in_thread(self, name: str, size: int, count: int) -> None:
        """Publish without a limit of time, in a thread."""

        def run() -> None:
            for fill in range(count):
                self.sent.append(self._publish_buffer(name, size, fill % 256, None))

        self.threads.append(threading.Thread(target=run, daemon=True))
        self.threads[-1].start()

    def results(self) -> list[int]:
        for thread in self.threads:
            thread.join(20)
        return self.sent

    def loan_in_time(self, name: str, timeout_s: float) -> float:
        began = time.monotonic()
        with self.streams[name].loan((300, 300), "u1", timeout_s=timeout_s) as picture:
            picture[:] = 1
        return time.monotonic() - began

    def publish_in_child(self, name: str) -> str:
        """Have a child of fork publish; return what it raises."""
        return in_child(lambda: self.streams[name].publish(1))

    def wanted(self, name: str) -> int:
        return self.streams[name].row("", "").info.consumers

    def pid(self) -> int:
        return os.getpid()

    def take_no_descriptors(self) -> None:
        self.limits = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, self.limits[1]))

    def take_descriptors(self) -> None:
        resource.setrlimit(resource.RLIMIT_NOFILE, self.limits)

    def cpu_s(self) -> float:
        return time.process_time()


def in_child(run: Callable[[], object]) -> str:
    """Return what a function raises in a child of fork, or what it returns, as text."""
    read, write = os.pipe()
    pid = os.fork()
    if not pid:
        try:
            shown = repr(run())
        except BaseException as error:
            shown = f"{type(error).__name__}: {error}"
        os.write(write, shown.encode())
        os._exit(0)
    os.close(write)
    with os.fdopen(read) as pipe:
        shown = pipe.read()
    os.waitpid(pid, 0)
    return shown


@dataclass
class Pair:
    left: rr.Stream
    right: rr.Stream


@dataclass
class Part:
    resource_id: str
    name: str


class Pairs(rr.Manager):
    """A response with two streams of one name, and one that only looks like a stream."""

    @rr.server("pair")
    def load_pair(self) -> Pair:
        boards = [self.registrar.load(Boards.open_board, [side, "eyes"]).response for side in ("left", "right")]
        return Pair(boards[0][1], boards[1][1])

    @rr.server("arm")
    def load_arm(self) -> Part:
        self.torques = rr.current().open_stream("torques")
        return Part(rr.current().resource_id, "other")


@pytest.fixture
def system(start: Start) -> rr.System:
    return start(rr.ChildSpec(Boards, id="boards"))


@pytest.fixture
def boards(system: rr.System) -> Any:
    return system.ref("boards").proxy()


def load(system: rr.System, *names: str) -> rr.Query[Any]:
    return system.open_registrar("app").load(Boards.open_board, [*names])


def when_wanted(boards: Any, name: str = "a", count: int = 1) -> None:
    def wanted() -> bool:
        try:
            return boards.wanted(name).get() == count
        except (rr.ActorUnavailable, rr.ActorDeadError, KeyError):  # it is being respawned
            return False

    eventually(wanted)


# -- the publisher ends ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("keep", ["latest", "all"])
def test_reading_goes_on_when_the_manager_was_killed_before_its_first_large_frame_was_read(
    system: rr.System, boards: Any, keep: Any
) -> None:
    reader = load(system, "a").stream("a", keep=keep, timeout_s=20)
    when_wanted(boards)
    if keep == "latest":
        assert asyncio.run(first_within(reader, 0.05)) is None  # so the publisher may send one
    assert boards.publish_buffers("a", MB, 1).get() == [1]

    os.kill(boards.pid().get(), signal.SIGKILL)

    values: list[object] = []  # that of the killed process is among them if it could still be opened

    def read() -> None:
        while "after" not in values:
            values.append(next(reader).value)

    reading = threading.Thread(target=read)
    reading.start()
    when_wanted(boards)
    assert boards.publish("a", "after").get() == [1]
    reading.join(20)
    assert values[-1:] == ["after"]
    values.clear()
    reader.close()


async def first_within(reader: rr.StreamReader, limit_s: float) -> rr.StreamFrame | None:
    try:
        return await asyncio.wait_for(anext(reader), limit_s)
    except TimeoutError:
        return None


@pytest.mark.parametrize("before", [2, 5])
@pytest.mark.parametrize("placement", ["process", "thread"])
def test_frames_of_the_next_manager_that_a_busy_reader_did_not_get_are_missed(
    start: Start, placement: Any, before: int
) -> None:
    system = start(rr.ChildSpec(Boards, id="boards", placement=placement))
    boards = system.ref("boards").proxy()
    with load(system, "a").stream("a", keep="all", timeout_s=20, depth=5) as reader:
        when_wanted(boards)
        boards.publish("a", *range(before)).get()
        assert [next(reader).value for _ in range(before)] == [*range(before)]
        if placement == "process":
            kill(system, "boards")
        else:
            system.ref("boards").tell("crash")
        eventually(lambda: when_back(lambda: boards.publish("a", 1, 2, 3).get()) == [0, 0, 0])
        reading = threading.Thread(target=lambda: frames.append(next(reader)))
        frames: list[rr.StreamFrame] = []
        reading.start()
        when_wanted(boards)
        boards.publish("a", "after").get()
        reading.join(20)

    assert [(frame.value, frame.number, frame.missed) for frame in frames] == [("after", 4, 3)]


def when_back(call: Callable[[], Any]) -> Any:
    try:
        return call()
    except (rr.ActorUnavailable, rr.ActorDeadError, KeyError):
        return None


def test_a_stream_that_no_callback_opens_again_is_warned_of_and_its_readers_end(
    system: rr.System, boards: Any, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rr_actors.streams.stream_reader._OPENS_S", 0.5)
    once = system.open_registrar("app").load("boards/once")
    reader = once.stream("once", timeout_s=20)
    when_wanted(boards, "once")
    eventually(lambda: "boards/once has recovery='keep' and no recover callback" in caplog.text)
    boards.publish("once", "before").get()

    assert next(reader).value == "before"
    os.kill(boards.pid().get(), signal.SIGKILL)

    for _ in range(2):
        with pytest.raises(rr.Unavailable, match="nobody opens the stream again"):
            next(reader)


def test_two_streams_of_one_name_are_told_apart_by_the_stream_itself(start: Start) -> None:
    system = start(rr.ChildSpec(Boards, id="boards"), rr.ChildSpec(Pairs, id="pairs"))
    app = system.open_registrar("app")
    pair = app.load(Pairs.load_pair)
    with pytest.raises(rr.UsageError, match="has 2 streams 'eyes': give the rr"):
        pair.stream("eyes")
    for stream in (pair.response.left, pair.response.right):
        reader = pair.stream(stream, timeout_s=0)
        with pytest.raises(TimeoutError):
            next(reader)
        reader.close()
    with pytest.raises(rr.UsageError, match="neither the resource nor its response"):
        pair.stream(rr.Stream("0" * 32, "eyes"))
    with app.load(Pairs.load_arm).stream(timeout_s=0) as reader, pytest.raises(TimeoutError, match="stream: no frame"):
        next(reader)


@pytest.mark.parametrize("name", [b"\0caf\xe9", b"\0new\nline"])
def test_any_name_of_a_socket_on_the_machine_does_no_harm(system: rr.System, boards: Any, name: bytes) -> None:
    query = load(system, "a")
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(name)
        with query.stream(timeout_s=20), pytest.raises(rr.NotFound, match="did you mean 'a'"):
            query.stream("aa")


# -- tasks and time limits ---------------------------------------------------------------------------------------------


def test_tasks_that_wait_for_quiet_streams_hold_no_thread(system: rr.System, boards: Any) -> None:
    names = [f"quiet{number}" for number in range(40)]
    query = load(system, "busy", *names)

    async def read_busy() -> tuple[object, str]:
        waiting = [asyncio.create_task(anext(query.stream(name))) for name in names]
        reader = query.stream("busy")
        arriving = asyncio.create_task(anext(reader))
        while not arriving.done():
            await asyncio.to_thread(lambda: boards.publish("busy", "frame").get())
        for task in waiting:
            task.cancel()
        await asyncio.gather(*waiting, return_exceptions=True)
        return arriving.result().value, await asyncio.to_thread(lambda: "ran")

    assert asyncio.run(asyncio.wait_for(read_busy(), 20)) == ("frame", "ran")


def test_tasks_of_several_loops_read_one_stream(system: rr.System, boards: Any) -> None:
    with load(system, "a").stream("a", keep="all", timeout_s=20) as reader:
        when_wanted(boards)
        numbers: list[int] = []

        async def read() -> None:
            while True:
                numbers.append((await anext(reader)).number)

        def run() -> None:
            with pytest.raises(StopAsyncIteration):
                asyncio.run(read())

        threads = [threading.Thread(target=run, daemon=True) for _ in range(3)]
        for thread in threads:
            thread.start()
        for _ in range(20):
            boards.publish("a", *range(10)).get(timeout=20)
        eventually(lambda: len(numbers) == 200)
    for thread in threads:
        thread.join(20)
        assert not thread.is_alive()
    assert sorted(numbers) == [*range(1, 201)]


def test_a_cancelled_task_loses_no_frame(system: rr.System, boards: Any) -> None:
    numbers: list[int] = []
    with load(system, "a").stream("a", keep="all", depth=50) as reader:
        when_wanted(boards)
        publishing = threading.Thread(target=lambda: [boards.publish("a", *range(20)).get() for _ in range(20)])
        publishing.start()

        async def read() -> None:
            while len(numbers) < 400:
                if (frame := await first_within(reader, 0.0005)) is not None:
                    numbers.append(frame.number)
                    assert frame.missed == 0

        asyncio.run(asyncio.wait_for(read(), 30))
        publishing.join()
    assert numbers == [*range(1, 401)]


@pytest.mark.parametrize("size", [10, 100_000])
def test_the_frame_after_a_time_out_is_the_newest_there_is(system: rr.System, boards: Any, size: int) -> None:
    with load(system, "a").stream("a", timeout_s=0.2) as reader:
        when_wanted(boards)
        with pytest.raises(TimeoutError):
            next(reader)
        boards.publish("a", *(bytes([number]) * size for number in range(50))).get()
        frame = next(reader)
        assert (frame.value[0], frame.number, frame.missed) == (49, 50, 0)
        boards.publish("a", "next").get()
        assert next(reader).value == "next"


def test_a_time_limit_of_0_looks_once(system: rr.System, boards: Any) -> None:
    with load(system, "a").stream("a", timeout_s=0) as reader:
        when_wanted(boards)
        with pytest.raises(TimeoutError, match="no frame within 0 s"):
            next(reader)
        boards.publish("a", "there").get()
        assert next(reader).value == "there"


@pytest.mark.parametrize("limit", ["1", -1, float("nan")])
def test_a_time_limit_of_publish_is_checked(system: rr.System, boards: Any, limit: Any) -> None:
    load(system, "a")
    with pytest.raises(rr.UsageError, match="timeout_s: expected seconds, 0 or more"):
        boards.publish("a", 1, timeout_s=limit).get()
    assert boards.publish("a", 1, timeout_s=1e10).get() == [0]


# -- memory ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("readers", [1, 3])
def test_the_publisher_waits_for_memory_that_readers_of_all_frames_have_still_to_read(
    start: Start, readers: int
) -> None:
    system = start(rr.ChildSpec(Boards, id="boards"), config=rr.SystemConfig(segments_limit_bytes=16 * MB))
    boards = system.ref("boards").proxy()
    query = load(system, "a")
    reads = [query.stream("a", keep="all", depth=64, timeout_s=20) for _ in range(readers)]
    when_wanted(boards, count=readers)
    boards.publish_buffers_in_thread("a", MB, 60).get()

    frames: list[rr.StreamFrame] = []
    for number in range(1, 61):
        frames = [next(reader) for reader in reads]
        assert [(frame.number, frame.missed) for frame in frames] == [(number, 0)] * readers
        assert all(frame.value[0] == number - 1 for frame in frames)

    assert boards.results().get() == [readers] * 60
    del frames
    for reader in reads:
        reader.close()


def test_a_frame_that_fits_nowhere_is_missed_and_everybody_hears_why(
    start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    system = start(
        rr.ChildSpec(Boards, id="boards", placement="thread"), config=rr.SystemConfig(segments_limit_bytes=0)
    )
    boards = system.ref("boards").proxy()
    with load(system, "a").stream("a", keep="all", timeout_s=0.5) as reader:
        when_wanted(boards)
        assert boards.publish("a", bytes(130_000), bytes(140_000), bytes(220_000), 1).get() == [1, 0, 0, 1]
        assert [next(reader).missed for _ in range(2)] == [0, 2]
        assert boards.publish("a", bytes(6_000_000)).get() == [0]
        with pytest.raises(TimeoutError, match="there is no shared memory, and a frame of 6000"):
            next(reader)
        assert boards.publish("a", 2).get() == [1]
        assert next(reader).value == 2
        assert boards.wanted("a").get() == 1
    assert caplog.text.count("its readers miss frames") == 1


def test_a_reader_that_is_stuck_is_waited_for_once(system: rr.System, boards: Any) -> None:
    query = load(system, "a")
    stuck = query.stream("a", keep="all", depth=1)
    when_wanted(boards)
    assert boards.publish("a", 1).get() == [1]

    began = time.monotonic()
    assert boards.publish("a", *range(20), timeout_s=0.3).get() == [0] * 20
    assert time.monotonic() - began < 3
    assert boards.loan_in_time("a", 0.1).get() < 3

    assert next(stuck).value == 1
    reading = threading.Thread(target=lambda: next(stuck))  # which says that it can take one
    reading.start()
    eventually(lambda: boards.publish("a", "again", timeout_s=0.3).get() == [1])
    reading.join()
    stuck.close()


# -- finalizers, signal handlers, children of fork ---------------------------------------------------------------------


def test_publish_in_a_finalizer_waits_for_nobody(start: Start) -> None:
    system = start(rr.ChildSpec(Boards, id="boards", placement="thread"))
    boards = system.ref("boards").proxy()
    with load(system, "a").stream("a", timeout_s=20):
        when_wanted(boards)
        publisher = system.ref("boards").proxy().streams.get()["a"]
        ended = threading.Event()

        def publish() -> None:
            for number in range(300):
                cycle: list[object] = [Closing(publisher, number)]
                cycle.append(cycle)
                del cycle
                publisher.publish([{}, [], number])
            ended.set()

        thread = threading.Thread(target=publish, daemon=True)
        before = gc.get_threshold()
        gc.set_threshold(7)
        try:
            thread.start()
            assert ended.wait(20)
        finally:
            gc.set_threshold(*before)
        assert system.streams()[0].consumers == 1


class Closing:
    """Publishes a last note when it is collected."""

    def __init__(self, publisher: rr.Publisher, number: int) -> None:
        self._publisher = publisher
        self._number = number

    def __del__(self) -> None:
        self._publisher.publish(f"closed {self._number}")


def test_a_signal_handler_publishes_while_the_main_thread_does(start: Start) -> None:
    system = start(rr.ChildSpec(Boards, id="boards", placement="thread"))
    boards = system.ref("boards").proxy()
    with load(system, "a").stream("a", timeout_s=20) as reader:
        when_wanted(boards)
        publisher = boards.streams.get()["a"]
        rung: list[int] = []
        before = signal.signal(signal.SIGALRM, lambda *_: rung.append(publisher.publish("from the handler")))
        signal.setitimer(signal.ITIMER_REAL, 0.002, 0.002)
        try:
            for number in range(500):
                publisher.publish(number)
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
            signal.signal(signal.SIGALRM, before)
        assert rung
        publisher.publish("last")
        assert next(reader).missed >= 0


READER = """
import os, sys, time
import rr_actors as rr

with rr.connect(sys.argv[1]) as connection:
    reader = connection.open_registrar("reader").load("boards/board", ["a"]).stream("a", keep="all", depth=2)
    if not (pid := os.fork()):
        time.sleep(600)
    print(pid, flush=True)
    next(reader)
    print("read", flush=True)
    time.sleep(600)
"""


def test_a_killed_reader_holds_up_nobody_although_its_child_of_fork_lives(system: rr.System, boards: Any) -> None:
    with load(system, "a").stream("a", keep="all", depth=200, timeout_s=20) as other:
        command = [sys.executable, "-c", READER, system.state_dir]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as reader:
            assert reader.stdout is not None
            child = int(reader.stdout.readline())
            try:
                when_wanted(boards, count=2)
                boards.publish("a", "first").get()
                assert reader.stdout.readline() == "read\n"
                reader.kill()
                when_wanted(boards, count=1)
                assert sum(boards.publish("a", *range(100)).get()) == 100
                assert [next(other).value for _ in range(101)] == ["first", *range(100)]
            finally:
                reader.kill()
                os.kill(child, signal.SIGKILL)


def test_a_reader_that_cannot_be_accepted_takes_no_time_of_the_manager(system: rr.System, boards: Any) -> None:
    query = load(system, "a")
    boards.publish("a", "before").get()
    boards.take_no_descriptors().get()
    with query.stream("a", timeout_s=0.3) as reader:
        with pytest.raises(TimeoutError):
            next(reader)  # it has knocked
        assert boards.wanted("a").get() == 0
        before = boards.cpu_s().get()
        time.sleep(1)  # the time is what is measured
        assert boards.cpu_s().get() - before < 0.15
        boards.take_descriptors().get()
        when_wanted(boards)
        boards.publish("a", "after").get()
        assert next(reader).value == "after"


def test_a_child_of_fork_uses_no_end_of_a_stream(start: Start) -> None:
    system = start(rr.ChildSpec(Boards, id="boards"))
    boards = system.ref("boards").proxy()
    with load(system, "a").stream("a", timeout_s=20) as reader:
        when_wanted(boards)
        assert f"UsageError: stream 'a': process {os.getpid()} has opened it" in in_child(lambda: next(reader))
        assert in_child(reader.close).startswith("UsageError")
        assert "has opened it, and this is another" in boards.publish_in_child("a").get()
        assert boards.publish("a", "goes on").get() == [1]
        assert next(reader).value == "goes on"


# -- interrupts --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [10, 100_000])
@pytest.mark.parametrize("keep", ["latest", "all"])
def test_publish_that_is_interrupted_anywhere_breaks_nothing(start: Start, size: int, keep: Any) -> None:
    system = start(rr.ChildSpec(Boards, id="boards", placement="thread"))
    boards = system.ref("boards").proxy()
    with load(system, "a").stream("a", keep=keep, depth=1000, timeout_s=20) as reader:
        when_wanted(boards)
        publisher = boards.streams.get()["a"]
        point, where = 0, "at first"
        while where:
            point += 1
            where = interrupted(lambda: publisher.publish(bytes(size)), point).where
        publisher.publish("last")
        while next(reader).value != "last":
            pass
        for number in range(20):
            assert publisher.publish(bytes([number]) * size) == 1
            assert next(reader).value == bytes([number]) * size


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("keep", ["latest", "all"])
def test_a_loan_that_is_interrupted_anywhere_breaks_nothing_and_leaves_no_memory(start: Start, keep: Any) -> None:
    size = 300_000  # too long for a packet: without shared memory it would be missed
    config = rr.SystemConfig(segments_limit_bytes=40 * size)
    system = start(rr.ChildSpec(Boards, id="boards", placement="thread"), config=config)
    boards = system.ref("boards").proxy()
    with load(system, "a").stream("a", keep=keep, depth=5, timeout_s=20) as reader:
        when_wanted(boards)
        publisher = boards.streams.get()["a"]

        def lend(fill: int) -> None:
            with publisher.loan((size,), "u1", timeout_s=5) as picture:
                picture[:] = fill

        lend(1)  # an import of numpy that is interrupted cannot be repeated
        next(reader)
        point, where = 0, "at first"
        while where:
            point += 1
            where = interrupted(lambda: lend(1), point).where
            publisher.publish(point)
            while not isinstance(next(reader).value, int):
                pass
        assert point > 40
        gc.collect()  # errors refer to pictures
        lend(255)
        while isinstance(value := next(reader).value, int) or value[0] != 255:
            pass
        for number in range(60):
            lend(number)
            assert next(reader).value[0] == number


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # an interrupt in __del__ goes nowhere
@pytest.mark.parametrize("size", [10, 100_000])
@pytest.mark.parametrize("keep", ["latest", "all"])
def test_next_that_is_interrupted_anywhere_loses_no_frame(start: Start, size: int, keep: Any) -> None:
    system = start(rr.ChildSpec(Boards, id="boards", placement="thread"))
    boards = system.ref("boards").proxy()
    with load(system, "a").stream("a", keep=keep, depth=4, timeout_s=20) as reader:
        when_wanted(boards)
        point, where, number = 0, "at first", 0
        while where:
            point += 1
            number += 1
            assert boards.publish("a", bytes([number % 256]) * size).get() == [1]
            frames: list[rr.StreamFrame] = []
            where = interrupted(lambda: frames.append(next(reader)), point).where  # noqa: B023
            if not frames:
                frames = [next(reader)]
            assert (frames[0].number, frames[0].missed, frames[0].value[0]) == (number, 0, number % 256)
        assert point > 20
    gc.collect()  # errors refer to frames


def asked(query: rr.Query[Any], name: str | None) -> None:
    """Ask for a stream that the resource does not have. Reading waits a minute for a frame, or for the stream."""
    with query.stream(name, timeout_s=60) as reader:
        next(reader)


@pytest.mark.parametrize("name", ["images", None])
@pytest.mark.parametrize("placement", ["process", "thread"])
def test_a_resource_without_a_stream_says_so_at_once(start: Start, placement: Any, name: str | None) -> None:
    app = start(rr.ChildSpec(Boards, id="boards", placement=placement)).open_registrar("app")
    with app.load("boards/board", []) as board:
        began = time.monotonic()
        with pytest.raises(rr.NotFound, match=r"there are: none"):
            asked(board, name)
    assert time.monotonic() - began < 15


def test_a_stream_of_a_manager_that_has_crashed_since_the_load_is_waited_for(start: Start) -> None:
    system = start(rr.ChildSpec(Boards, id="boards"))
    app = system.open_registrar("app")
    with app.load("boards/board", []) as before:
        wait_respawned(system, "boards", kill(system, "boards"))
        with app.load("boards/board", [], priority=1) as joined:
            assert joined.resource_id == before.resource_id
            with pytest.raises(rr.NotFound):  # this load began after the crash
                asked(joined, None)
        with before.stream(timeout_s=1.0) as reader, pytest.raises(TimeoutError):
            next(reader)


def test_a_stream_is_waited_for_before_the_event_loop_has_heard_of_the_crash(system: rr.System, boards: Any) -> None:
    app, gate = system.open_registrar("app"), Gate()
    with app.load("boards/board", ["a"]) as board:
        busy = threading.Thread(target=on_loop, args=(app, gate))
        pid = pid_of(system, "boards")
        busy.start()
        gate.wait_arrived()
        os.kill(pid, signal.SIGKILL)
        eventually(lambda: known_streams(board.resource_id) == {})
        try:
            reader = board.stream("a", timeout_s=30)
        finally:
            gate.open()
        busy.join()
        reads_on(boards, reader)


def test_a_stream_is_waited_for_while_its_manager_in_a_thread_crashes(start: Start) -> None:
    system = start(rr.ChildSpec(Boards, id="boards", placement="thread"))
    boards = system.ref("boards").proxy()
    with load(system, "a") as board:
        system.ref("boards").tell("crash")
        while known_streams(board.resource_id):
            pass
        reads_on(boards, board.stream("a", timeout_s=30))


def test_the_only_stream_of_a_crashed_manager_needs_no_name(system: rr.System, boards: Any) -> None:
    with system.open_registrar("app").load(Boards.open_plain) as plain:
        kill(system, "boards")
        eventually(lambda: known_streams(plain.resource_id) == {})
        reads_on(boards, plain.stream(timeout_s=30), "plain")


def reads_on(boards: Any, reader: rr.StreamReader, name: str = "a") -> None:
    """Check that the reader gets what is published when it has come."""

    def publish() -> None:
        when_wanted(boards, name)
        boards.publish(name, "again").get()

    publishing = threading.Thread(target=publish)
    publishing.start()
    with reader:
        assert next(reader).value == "again"
    publishing.join()


@pytest.mark.parametrize("new_loop", [asyncio.new_event_loop, uvloop.new_event_loop])
def test_a_reader_that_is_closed_while_a_task_waits_takes_no_other_socket_along(
    system: rr.System, boards: Any, new_loop: Callable[[], asyncio.AbstractEventLoop]
) -> None:
    async def close_and_receive(board: rr.Query[Any]) -> bytes:
        reader = board.stream("a")
        waiting = asyncio.ensure_future(anext(reader, None))
        await asyncio.to_thread(when_wanted, boards)
        await asyncio.to_thread(reader.close)
        here, there = socket.socketpair()  # they would have the descriptor of the reader's connection
        with here, there:
            here.setblocking(False)
            receiving = asyncio.ensure_future(asyncio.get_running_loop().sock_recv(here, 10))
            await waiting
            there.send(b"received")
            return await asyncio.wait_for(receiving, 10)

    with load(system, "a") as board, asyncio.Runner(loop_factory=new_loop) as runner:
        for _ in range(5):
            assert runner.run(close_and_receive(board)) == b"received"
