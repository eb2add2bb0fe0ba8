"""Streams of resources, from managers in processes and threads to those who hold the resources."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import itertools
import os
import pickle
import signal
import subprocess
import sys
import threading
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.wire.segment_slots import PAGE_BYTES
from support import TESTS, eventually

Start = Callable[..., rr.System]


@dataclass
class Feed:
    images: rr.Stream
    pid: int


class Cameras(rr.Manager):
    """Each resource is a camera with the streams "images" and "notes". A message makes it publish."""

    @rr.server("camera", recovery="reload")
    def open_camera(self, device: str) -> Feed:
        self.images = rr.current().open_stream("images")
        self.notes = rr.current().open_stream("notes")
        return Feed(self.images.stream, os.getpid())

    @open_camera.unload
    def close_camera(self, device: str, response: Feed) -> None: ...

    @rr.server("twice")
    def open_twice(self) -> None:
        rr.current().open_stream("images")
        rr.current().open_stream("images")

    @rr.server("late")
    def open_late(self) -> None: ...

    @open_late.unload
    def close_late(self) -> None:
        rr.current().open_stream("images")

    def publish(self, *values: object, timeout_s: float | None = None) -> list[int]:
        return [self.images.publish(value, timeout_s=timeout_s) for value in values]

    def publish_buffers(self, size: int, *fills: int) -> list[int]:
        """Publish buffers, which readers share."""
        return [self.images.publish(pickle.PickleBuffer(bytearray([fill]) * size), timeout_s=5) for fill in fills]

    def publish_loans(self, size: int, *fills: int) -> None:
        """Fill arrays in place."""
        for fill in fills:
            with self.images.loan((size // 4, 4), "u1") as picture:
                picture[:] = fill

    def misuse_loans(self, how: str) -> None:
        loan = self.images.loan((3, 4), object if how == "objects" else "u1")
        with loan as picture:
            if how == "error":
                raise LookupError("no picture")
        if how == "again":
            with loan:
                pass
        picture[0] = 1

    def keep_loan(self, size: int, fill: int) -> None:
        """Fill half of an array in place, and keep the loan."""
        self.loan = self.images.loan(size, "u1")
        self.loan.__enter__()[: size // 2] = fill

    def wanted(self) -> bool:
        return self.images.wanted

    def segments(self) -> list[int]:
        """Return the segments that this process has made or mapped, by their inodes."""
        return sorted(segments_in(os.getpid()))

    def shared_bytes(self) -> int:
        """Return how much memory the segments of this process take."""
        fds = [f"/proc/self/fd/{fd}" for fd in os.listdir("/proc/self/fd")]
        found = [os.stat(fd) for fd in fds if os.path.exists(fd) and "memfd:rr_actors" in os.readlink(fd)]
        return sum({stat.st_ino: stat.st_blocks * 512 for stat in found}.values())


class Boards(rr.Manager):
    """Each resource has the streams of its request. In a second life, a file lets it open all but the first."""

    def __init__(self) -> None:
        self.streams: dict[str, rr.Publisher] = {}
        self.threads: list[threading.Thread] = []
        self.sent: list[list[int]] = []

    @rr.server("board", recovery="reload")
    def open_board(self, names: list[str]) -> None:
        lived, at_gate, gate = (Path(self.registrar.directory, name) for name in ("lived", "at_gate", "gate"))
        for number, name in enumerate(names):
            if number and lived.exists():
                at_gate.touch()
                eventually(gate.exists)
            self.streams[name] = rr.current().open_stream(name)
        if names[-1] == "last":
            lived.touch()

    def publish(self, name: str, value: object) -> int:
        return self.streams[name].publish(value)

    def publish_in_threads(self, name: str, *values: list[object]) -> None:
        """Publish each list of values in a thread of its own."""

        def run(these: list[object]) -> None:
            self.sent.append([self.streams[name].publish(value) for value in these])

        threads = [threading.Thread(target=run, args=(these,)) for these in values]
        self.threads += threads
        for thread in threads:
            thread.start()

    def results(self) -> list[list[int]]:
        for thread in self.threads:
            thread.join(20)
        return self.sent

    def publishing(self) -> int:
        return sum(thread.is_alive() for thread in self.threads)

    def is_wanted(self, name: str) -> bool:
        return self.streams[name].wanted

    def pid(self) -> int:
        return os.getpid()

    def open_late(self) -> None:
        self.late.open_stream("late")

    @rr.server("keeper")
    def keep_current(self) -> None:
        self.late = rr.current()


class Robots(rr.Manager):
    """A robot's response names the stream of the board that it has: first the board "a", then "b"."""

    @rr.server("robot")
    def load_robot(self) -> rr.Stream:
        return self.stream_of("a")

    def stream_of(self, name: str) -> rr.Stream:
        return rr.Stream(self.registrar.load(Boards.open_board, [name, "eyes"]).resource_id, "eyes")

    @load_robot.status
    def robot_status(self, status: rr.Status) -> None:
        if status.query_id and status.state is rr.State.FATAL:
            self.registrar.replace_part(
                status, ["b", "eyes"], response=lambda part: rr.Stream(part.resource_id, "eyes")
            )

    def update(self, resource_id: str) -> None:
        self.registrar.update_response(resource_id, self.stream_of("b"))


class Watchers(rr.Manager):
    """Holds a camera, and takes no frame of it."""

    @rr.server("watch")
    def watch(self, device: str) -> int:
        camera = self.registrar.load(Cameras.open_camera, device)
        self.reader = camera.stream("images", keep="all", depth=2)
        return os.getpid()

    def hold(self, frames: int) -> None:
        self.held: list[rr.StreamFrame] = []
        while len(self.held) < frames:
            if isinstance((frame := next(self.reader)).value, memoryview):
                self.held.append(frame)


def segments_in(pid: int) -> set[int]:
    """Return the segments of shared memory that a process has mapped, by their inodes; none if it has ended."""
    try:
        lines = Path(f"/proc/{pid}/maps").read_text().splitlines()
    except OSError:
        return set()
    return {int(line.split()[4]) for line in lines if "memfd:rr_actors" in line}


def users_of(segments: list[int]) -> list[int]:
    """Return the processes of the machine that have these segments mapped."""
    pids = [int(name) for name in os.listdir("/proc") if name.isdecimal()]
    return [pid for pid in pids if segments_in(pid).intersection(segments)]


@pytest.fixture(params=["process", "thread"])
def system(request: pytest.FixtureRequest, start: Start) -> rr.System:
    return start(rr.ChildSpec(Cameras, id="cameras", placement=request.param))


@pytest.fixture
def camera(system: rr.System) -> rr.Query[Feed]:
    return system.open_registrar("app").load(Cameras.open_camera, "a")


def published(system: rr.System, *values: object, timeout_s: float | None = None) -> list[int]:
    return system.ref("cameras").proxy().publish(*values, timeout_s=timeout_s).get()


def is_wanted(system: rr.System) -> bool:
    return system.ref("cameras").proxy().wanted().get()


def read(system: rr.System, camera: rr.Query[Feed], **options: Any) -> rr.StreamReader:
    reader = camera.stream("images", timeout_s=20, **options)
    eventually(lambda: is_wanted(system))
    return reader


def until_all_read(system: rr.System, *readers: rr.StreamReader) -> None:
    """Wait until values reach all these readers, and read what there is."""
    numbers = itertools.count()
    sent: list[int] = []

    def all_get_it() -> bool:
        sent.append(next(numbers))
        return published(system, sent[-1]) == [len(readers)]

    eventually(all_get_it)
    for reader in readers:
        while next(reader).value != sent[-1]:
            pass


def when_back(publish: Callable[[], Any]) -> Any:
    try:
        return publish()
    except (rr.ActorUnavailable, rr.ActorDeadError, AttributeError, KeyError):  # no stream is open yet
        return None


class Reading:
    """Reads a stream to its end in a thread."""

    def __init__(self, reader: rr.StreamReader) -> None:
        self.values: list[object] = []
        self.error: Exception | None = None
        self._reader = reader
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            for frame in self._reader:
                self.values.append(frame.value)
        except Exception as error:
            self.error = error

    def ended(self) -> bool:
        self._thread.join(10)
        return not self._thread.is_alive()


def test_a_holder_reads_each_frame_that_the_manager_publishes(system: rr.System, camera: rr.Query[Feed]) -> None:
    large = bytes(range(256)) * 10_000
    assert camera.response.images == rr.Stream(camera.resource_id, "images")
    assert published(system, "nobody reads") == [0]

    with read(system, camera, keep="all") as reader:
        assert published(system, "a", large) == [1, 1]
        frames = [next(reader), next(reader)]

    assert [frame.value for frame in frames] == ["a", large]
    assert [frame.number for frame in frames] == [2, 3]
    assert [frame.missed for frame in frames] == [0, 0]
    assert 0 <= frames[0].age_s < 60


def test_a_slow_reader_gets_the_newest_frame_and_how_many_it_missed(system: rr.System, camera: rr.Query[Feed]) -> None:
    with read(system, camera) as reader:
        published(system, "first")
        assert next(reader).value == "first"
        assert published(system, *(bytes([number]) * 100_000 for number in range(50))) == [1] * 50

        frame = next(reader)

    assert frame.value == bytes([49]) * 100_000
    assert frame.missed == 49


def test_a_publisher_waits_for_a_reader_of_all_frames_no_longer_than_it_says(
    system: rr.System, camera: rr.Query[Feed]
) -> None:
    with read(system, camera, keep="all", depth=2) as reader:
        assert published(system, 1, 2, 3, timeout_s=0.05) == [1, 1, 0]
        assert [next(reader).value, next(reader).value] == [1, 2]
        reading = Reading(reader)
        eventually(lambda: published(system, 4, timeout_s=1) == [1])
        eventually(lambda: 4 in reading.values)
        camera.unload()
        assert reading.ended()


def test_the_iteration_ends_when_the_query_is_released(system: rr.System, camera: rr.Query[Feed]) -> None:
    reading = Reading(read(system, camera))

    camera.unload()

    assert reading.ended()
    assert reading.error is None
    assert published(system, "after its close") == [0]


def test_the_iteration_raises_when_the_resource_is_lost(system: rr.System, camera: rr.Query[Feed]) -> None:
    reading = Reading(read(system, camera))

    system.registrar("cameras").unload(camera.resource_id, force=True)

    assert reading.ended()
    assert isinstance(reading.error, rr.ResourceLost)


def test_tasks_read_streams(system: rr.System, camera: rr.Query[Feed]) -> None:
    async def first() -> object:
        async for frame in reader:
            return frame.value
        return None

    reader = read(system, camera)
    published(system, "a")

    assert asyncio.run(first()) == "a"


def test_a_cancelled_task_leaves_no_thread_that_waits_and_the_reader_goes_on(
    system: rr.System, camera: rr.Query[Feed]
) -> None:
    async def give_up() -> None:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(anext(reader), 0.05)

    reader = camera.stream("images")
    asyncio.run(give_up())  # waits for its threads at the end

    eventually(lambda: is_wanted(system))
    published(system, "a")
    assert next(reader).value == "a"


def test_reading_goes_on_when_the_manager_was_killed(start: Start) -> None:
    system = start(rr.ChildSpec(Cameras, id="cameras"))
    camera = system.open_registrar("app").load(Cameras.open_camera, "a")
    reader = read(system, camera)
    published(system, "before")
    assert next(reader).value == "before"
    reading = Reading(reader)

    os.kill(camera.response.pid, signal.SIGKILL)
    eventually(lambda: when_back(lambda: published(system, "after")) == [1])

    eventually(lambda: "after" in reading.values)
    camera.unload()
    assert reading.ended()
    assert reading.error is None


def test_a_killed_reader_holds_up_nobody(start: Start) -> None:
    system = start(rr.ChildSpec(Cameras, id="cameras"), rr.ChildSpec(Watchers, id="watchers"))
    camera = system.open_registrar("app").load(Cameras.open_camera, "a")
    pid = system.open_registrar("other").load(Watchers.watch, "a").response
    eventually(lambda: is_wanted(system))
    assert published(system, *range(2), timeout_s=5) == [1, 1]

    os.kill(pid, signal.SIGKILL)

    with camera.stream("images", keep="all", depth=1000, timeout_s=20) as reader:
        eventually(lambda: published(system, "seen", timeout_s=5) == [1])
        assert next(reader).value == "seen"


MB = 2**20


def start_cameras(start: Start, limit: int) -> tuple[rr.System, rr.Query[Feed]]:
    """Return a system with a camera whose streams may take so much memory."""
    children = rr.ChildSpec(Cameras, id="cameras"), rr.ChildSpec(Watchers, id="watchers")
    system = start(*children, config=rr.SystemConfig(segments_limit_bytes=limit))
    return system, system.open_registrar("app").load(Cameras.open_camera, "a")


def test_all_readers_have_the_same_memory_and_cannot_write_it(start: Start) -> None:
    system, camera = start_cameras(start, 32 * MB)
    cameras = system.ref("cameras").proxy()
    readers = [camera.stream("images", keep="all", depth=1000, timeout_s=20) for _ in range(4)]
    until_all_read(system, *readers)

    frames: list[rr.StreamFrame] = []
    for number in range(20):
        assert cameras.publish_buffers(MB, number).get() == [4]
        frames = [next(reader) for reader in readers]
        assert [bytes(frame.value) == bytes([number]) * MB for frame in frames] == [True] * 4

    assert cameras.shared_bytes().get() < 3 * MB
    with pytest.raises(TypeError):
        frames[0].value[0] = 1
    for reader in readers:
        reader.close()


def test_an_array_that_was_filled_in_place_is_published(system: rr.System, camera: rr.Query[Feed]) -> None:
    cameras = system.ref("cameras").proxy()
    cameras.publish_loans(MB, 1).get()  # nobody reads
    with read(system, camera, keep="all") as reader:
        for size in (4, 1000, MB):
            cameras.publish_loans(size, 2, 3).get()
            frames = [next(reader), next(reader)]
            assert [frame.value.shape for frame in frames] == [(size // 4, 4)] * 2
            assert [bool((frame.value == fill).all()) for frame, fill in zip(frames, (2, 3), strict=True)] == [True] * 2
            assert not frames[0].value.flags.writeable
        del frames


def test_loans_take_the_memory_of_the_frames_in_use_and_no_more(start: Start) -> None:
    system, camera = start_cameras(start, 32 * MB)
    cameras = system.ref("cameras").proxy()
    readers = [camera.stream("images", keep="all", depth=1000, timeout_s=20) for _ in range(2)]
    until_all_read(system, *readers)

    for number in range(20):
        cameras.publish_loans(MB, number).get()
        assert [bool((next(reader).value == number).all()) for reader in readers] == [True] * 2

    assert cameras.shared_bytes().get() < 3 * MB
    for reader in readers:
        reader.close()


def test_the_memory_of_frames_is_given_back_when_a_stream_is_idle(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rr_actors.wire.segments.IDLE_S", 0.02)
    system = start(rr.ChildSpec(Cameras, id="cameras", placement="thread"))
    camera = system.open_registrar("app").load(Cameras.open_camera, "front")
    cameras = system.ref("cameras").proxy()
    with read(system, camera, keep="all") as frames:
        cameras.publish_buffers(2**22, 1, 2).get()
        next(frames)
        held = next(frames)
        eventually(lambda: cameras.shared_bytes().get() < 2**22 + 2**16)  # the page of the head, and what is held
        assert bytes(held.value) == bytes([2]) * 2**22
        del held
        eventually(lambda: cameras.shared_bytes().get() <= PAGE_BYTES)
        cameras.publish_buffers(2**22, 3).get()
        assert bytes(next(frames).value) == bytes([3]) * 2**22


@pytest.mark.parametrize(
    ("how", "error", "text"),
    [
        ("objects", rr.UsageError, "has Python objects"),
        ("error", LookupError, "no picture"),
        ("again", rr.UsageError, "a loan is for one block"),
        ("written after its block", ValueError, "read-only"),
    ],
)
def test_a_loan_that_is_misused_says_so(
    system: rr.System, camera: rr.Query[Feed], how: str, error: type[Exception], text: str
) -> None:
    with read(system, camera, keep="all") as reader:
        with pytest.raises(error, match=text):
            system.ref("cameras").proxy().misuse_loans(how).get()
        published(system, "next")
        values = [next(reader).value]
        if how in ("again", "written after its block"):
            values = [next(reader).value]

    assert values == ["next"]


def test_a_loan_without_numpy_says_what_to_install(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    system = start(rr.ChildSpec(Cameras, id="cameras", placement="thread"))
    system.open_registrar("app").load(Cameras.open_camera, "a")
    monkeypatch.setitem(sys.modules, "numpy", None)

    with pytest.raises(rr.UsageError, match="pip install numpy"):
        system.ref("cameras").proxy().publish_loans(4, 1).get()


@pytest.mark.parametrize("end", ["reader closes", "query is released", "publisher is killed"])
def test_a_frame_in_hand_stays_as_it_is(start: Start, end: str) -> None:
    system, camera = start_cameras(start, 32 * MB)
    cameras = system.ref("cameras").proxy()
    reader = read(system, camera)
    other = system.open_registrar("other").load(Cameras.open_camera, "a")
    cameras.publish_buffers(MB, 7).get()
    frame = next(reader)

    if end == "reader closes":
        reader.close()
    elif end == "query is released":
        camera.unload()
        assert list(reader) == []
    else:
        os.kill(camera.response.pid, signal.SIGKILL)
    reading = Reading(other.stream("images"))
    eventually(lambda: sum(when_back(lambda: cameras.publish_buffers(MB, 9).get()) or [0]) > 0)
    for count in range(1, 6):
        eventually(lambda: len(reading.values) >= count)  # noqa: B023 (it ends before the next turn)
        cameras.publish_buffers(MB, 9).get()
    other.unload()
    assert reading.ended()
    assert all(value == bytes([9]) * MB for value in reading.values)

    assert bytes(frame.value) == bytes([7]) * MB
    reader.close()
    reading.values.clear()
    del frame  # else errors that replies keep would hold it


def test_a_reader_that_keeps_frames_takes_the_memory_of_no_other(start: Start) -> None:
    system, camera = start_cameras(start, 16 * MB)
    cameras = system.ref("cameras").proxy()
    keeps, reads = (camera.stream("images", keep="all", depth=1000, timeout_s=20) for _ in range(2))
    until_all_read(system, keeps, reads)

    kept: list[rr.StreamFrame] = []
    for number in range(30):
        sent = cameras.publish_buffers(MB, number).get()
        assert bytes(next(reads).value) == bytes([number]) * MB
        if sent == [2]:
            kept.append(next(keeps))

    assert 2 <= len(kept) <= 5
    assert all(bytes(frame.value) == bytes([number]) * MB for number, frame in enumerate(kept))
    kept.clear()
    eventually(lambda: cameras.publish_buffers(MB, 99).get() == [2])
    assert next(keeps).missed > 20
    keeps.close()
    reads.close()


def test_the_memory_of_a_killed_reader_comes_back(start: Start) -> None:
    system, camera = start_cameras(start, 6 * MB)
    cameras, watchers = system.ref("cameras").proxy(), system.ref("watchers").proxy()
    pid = system.open_registrar("other").load(Watchers.watch, "a").response
    reader = camera.stream("images", timeout_s=20)
    holding = watchers.hold(2)
    eventually(lambda: cameras.publish("both are there").get() == [2])
    assert cameras.publish_buffers(2 * MB, 1, 2).get() == [2, 2]
    holding.get()
    while next(reader).value != bytes([2]) * 2 * MB:
        pass
    assert cameras.publish_buffers(3 * MB, 3).get() == [0]

    os.kill(pid, signal.SIGKILL)

    eventually(lambda: cameras.publish_buffers(3 * MB, 4).get()[0] > 0)
    assert next(reader).value == bytes([4]) * 3 * MB
    reader.close()


def test_a_publisher_that_is_killed_with_a_loan_in_hand_leaves_nothing(start: Start) -> None:
    system, camera = start_cameras(start, 32 * MB)
    cameras = system.ref("cameras").proxy()
    reader = read(system, camera, keep="all")
    cameras.publish_loans(MB, 1).get()
    frame = next(reader)
    cameras.keep_loan(MB, 2).get()
    left = cameras.segments().get()
    assert os.getpid() in users_of(left)

    reading = Reading(reader)
    os.kill(camera.response.pid, signal.SIGKILL)
    eventually(lambda: when_back(lambda: cameras.publish_buffers(MB, 3).get()) == [1])

    eventually(lambda: reading.values)
    assert [value == bytes([3]) * MB for value in reading.values] == [True]  # and nothing of the loan
    assert bool((frame.value == 1).all())
    assert os.getpid() in users_of(left)
    del frame
    eventually(lambda: gc.collect() >= 0 and not users_of(left))
    camera.unload()
    assert reading.ended()
    assert reading.error is None


def test_a_publisher_goes_on_when_a_reader_with_a_frame_in_hand_is_killed(start: Start) -> None:
    system, camera = start_cameras(start, 32 * MB)
    cameras, watchers = system.ref("cameras").proxy(), system.ref("watchers").proxy()
    pid = system.open_registrar("other").load(Watchers.watch, "a").response
    holding = watchers.hold(1)
    eventually(lambda: is_wanted(system))
    assert cameras.publish_buffers(MB, 1).get() == [1]
    holding.get()
    segments = cameras.segments().get()
    assert pid in users_of(segments)

    os.kill(pid, signal.SIGKILL)

    eventually(lambda: pid not in users_of(segments))
    with camera.stream("images", keep="all", depth=1000, timeout_s=20) as reader:
        until_all_read(system, reader)
        for number in range(20):  # each needs the memory that the one before it had
            assert cameras.publish_loans(MB, number).get() is None
            assert bool((next(reader).value == number).all())
    assert cameras.shared_bytes().get() < 4 * MB


@pytest.mark.parametrize(
    ("name", "options", "error", "text"),
    [
        ("imagse", {}, rr.NotFound, "there are: 'images', 'notes'"),
        ("a/b", {}, rr.InvalidName, "stream"),
        ("images", {"depth": 0}, rr.UsageError, "depth: expected 1 to 1000, got 0"),
        ("images", {"keep": "newest"}, rr.UsageError, "keep: expected 'latest' or 'all'"),
    ],
)
def test_a_stream_that_cannot_be_read_is_refused_at_once(
    camera: rr.Query[Feed], name: str, options: dict[str, Any], error: type[Exception], text: str
) -> None:
    with pytest.raises(error, match=text):
        camera.stream(name, **options)


def test_a_released_query_has_no_streams(camera: rr.Query[Feed]) -> None:
    camera.unload()

    with pytest.raises(rr.UnknownQuery):
        camera.stream("images")


def test_a_stream_is_opened_once_and_in_callbacks_that_make_the_resource(system: rr.System) -> None:
    app = system.open_registrar("app")

    with pytest.raises(rr.LoadFailed, match="has a stream 'images' already"):
        app.load(Cameras.open_twice)
    late = app.load(Cameras.open_late)
    with pytest.raises(rr.UnloadFailed, match="only load and recover callbacks open streams"):
        late.unload()


def test_a_stream_is_opened_while_its_callback_runs_and_not_later(start: Start) -> None:
    system = start(rr.ChildSpec(Boards, id="boards"))
    system.open_registrar("app").load("boards/keeper")

    with pytest.raises(rr.UsageError, match="outside its load callback"):
        system.ref("boards").proxy().open_late().get()


def test_without_a_name_it_is_the_only_stream(start: Start) -> None:
    system = start(rr.ChildSpec(Boards, id="boards"), rr.ChildSpec(Cameras, id="cameras"))
    app = system.open_registrar("app")
    boards = system.ref("boards").proxy()

    with app.load(Boards.open_board, ["one"]).stream(timeout_s=20) as reader:
        eventually(lambda: boards.publish("one", "a").get() == 1)
        assert next(reader).stream.name == "one"
    with pytest.raises(rr.UsageError, match="has several streams: give the name of one, of 'one', 'two'"):
        app.load(Boards.open_board, ["one", "two"]).stream()
    with app.load(Cameras.open_camera, "a").stream(timeout_s=20) as reader:  # the one that its response names
        eventually(lambda: published(system, "b") == [1])
        assert next(reader).stream.name == "images"


def test_a_slow_reader_of_all_frames_does_not_hold_up_others_nor_the_close(start: Start) -> None:
    system = start(rr.ChildSpec(Boards, id="boards"))
    boards = system.ref("boards").proxy()
    board = system.open_registrar("app").load(Boards.open_board, ["one"])
    with board.stream("one", timeout_s=20) as quick:
        eventually(lambda: boards.is_wanted("one").get())
        slow = board.stream("one", keep="all", depth=1)
        eventually(lambda: boards.publish("one", "first").get() == 2)
        for value in ("second", "third"):
            boards.publish_in_threads("one", [value]).get()
            while next(quick).value != value:
                pass
    assert boards.publishing().get() == 2

    board.unload()

    assert boards.results().get() == [[1], [1]]
    slow.close()


def test_a_reader_gets_the_last_of_many_frames(system: rr.System, camera: rr.Query[Feed]) -> None:
    with read(system, camera, keep="all", depth=1000) as reader:
        for _ in range(4):
            assert published(system, *range(200)) == [1] * 200
            assert [next(reader).value for _ in range(200)] == [*range(200)]


def test_frames_of_several_threads_stay_in_order(start: Start) -> None:
    system = start(rr.ChildSpec(Boards, id="boards"))
    boards = system.ref("boards").proxy()
    board = system.open_registrar("app").load(Boards.open_board, ["one"])

    with board.stream("one", keep="all", depth=2, timeout_s=20) as reader:
        eventually(lambda: boards.is_wanted("one").get())
        boards.publish_in_threads("one", *([(thread, place) for place in range(100)] for thread in range(4))).get()
        frames = [next(reader) for _ in range(400)]

    assert [frame.number for frame in frames] == [*range(1, 401)]
    for thread in range(4):
        assert [value[1] for value in (frame.value for frame in frames) if value[0] == thread] == [*range(100)]


def test_a_new_reader_waits_until_a_respawned_manager_has_opened_all_streams(start: Start) -> None:
    system = start(rr.ChildSpec(Boards, id="boards"))
    app = system.open_registrar("app")
    board = app.load(Boards.open_board, ["one", "last"])
    directory = system.registrar("boards").directory

    os.kill(system.ref("boards").proxy().pid().get(), signal.SIGKILL)
    eventually(Path(directory, "at_gate").exists)
    with board.stream("last", timeout_s=20) as reader:
        reading = Reading(reader)
        Path(directory, "gate").touch()
        eventually(lambda: when_back(lambda: system.ref("boards").proxy().publish("last", "after").get()) == 1)
        eventually(lambda: reading.values == ["after"])
    assert reading.ended()
    with pytest.raises(rr.NotFound, match="there are: 'last', 'one'; did you mean 'last'"):
        board.stream("lasst")


@pytest.mark.parametrize("how", ["update_response", "replace_part"])
def test_a_reader_goes_on_with_the_stream_that_a_new_response_names(start: Start, how: str) -> None:
    system = start(rr.ChildSpec(Boards, id="boards"), rr.ChildSpec(Robots, id="robots"))
    boards = system.ref("boards").proxy()
    robot = system.open_registrar("app").load(Robots.load_robot)
    first = robot.response
    with robot.stream("eyes", timeout_s=20) as reader:
        eventually(lambda: boards.publish("eyes", "of a").get() == 1)
        assert next(reader).stream == first

        if how == "update_response":
            system.ref("robots").proxy().update(robot.resource_id).get()
        else:
            system.registrar("boards").send_status(first.resource_id, rr.Status(rr.State.FATAL, "unplugged"))

        reading = Reading(reader)
        eventually(lambda: robot.response != first)
        eventually(lambda: boards.publish("eyes", "of b").get() == 1)
        eventually(lambda: "of b" in reading.values)
        robot.unload()
        assert reading.ended()
        assert reading.error is None


@contextlib.contextmanager
def viewing(system: rr.System) -> Iterator[Callable[[], str]]:
    """Run a connection of the system in a process of its own; yield a function that returns its next line."""
    arguments = [str(system.state_dir), "cameras/camera", "a", "images"]
    program = [sys.executable, str(TESTS / "support_stream_connection.py"), *arguments]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as connection:
        assert connection.stdout is not None
        try:
            assert connection.stdout.readline() == "reads\n"
            eventually(lambda: is_wanted(system))
            yield connection.stdout.readline
        finally:
            connection.kill()


def test_a_connection_in_a_process_of_its_own_reads_on_after_a_crash_of_the_manager(start: Start) -> None:
    system, camera = start_cameras(start, 32 * MB)
    cameras = system.ref("cameras").proxy()
    with viewing(system) as line:
        published(system, b"small")
        assert line() == f"{zlib.crc32(b'small')} 0\n"
        cameras.publish_buffers(MB, 1).get()
        assert line() == f"{zlib.crc32(bytes([1]) * MB)} 0\n"

        os.kill(camera.response.pid, signal.SIGKILL)
        eventually(lambda: when_back(lambda: cameras.wanted().get()))
        cameras.publish_buffers(MB, 2).get()

        assert line() == f"{zlib.crc32(bytes([2]) * MB)} 0\n"
        system.registrar("cameras").unload(camera.resource_id, force=True)
        assert line() == "ResourceLost\n"


def test_the_memory_of_a_killed_connection_comes_back(start: Start) -> None:
    system, _ = start_cameras(start, 6 * MB)
    cameras = system.ref("cameras").proxy()
    with viewing(system) as line:
        for fill in (1, 2):  # the second is in its hands: it has dropped the first
            cameras.publish_buffers(2 * MB, fill).get()
            assert line() == f"{zlib.crc32(bytes([fill]) * 2 * MB)} 0\n"
        segments = cameras.segments().get()
        assert len(users_of(segments)) == 2

    eventually(lambda: len(users_of(segments)) == 1)
    eventually(lambda: not is_wanted(system))
    with system.registrar("app").load(Cameras.open_camera, "a").stream("images", keep="all", timeout_s=20) as reader:
        eventually(lambda: is_wanted(system))
        eventually(lambda: cameras.publish_buffers(5 * MB, 3).get() == [1])
        assert next(reader).value == bytes([3]) * 5 * MB


def test_a_connection_goes_on_with_the_stream_that_a_new_response_names_until_it_releases_it(start: Start) -> None:
    system = start(rr.ChildSpec(Boards, id="boards"), rr.ChildSpec(Robots, id="robots"))
    boards = system.ref("boards").proxy()
    with rr.connect(system.state_dir) as connection:
        robot = connection.open_registrar("viewer").load("robots/robot")
        reading = Reading(robot.stream("eyes", timeout_s=20))
        eventually(lambda: boards.publish("eyes", "of a").get() == 1)
        eventually(lambda: reading.values == ["of a"])

        system.ref("robots").proxy().update(robot.resource_id).get()

        eventually(lambda: boards.publish("eyes", "of b").get() == 1)
        eventually(lambda: reading.values[-1] == "of b")
        robot.unload()
        assert reading.ended()
        assert reading.error is None


def test_a_connection_that_is_closed_ends_its_streams(system: rr.System) -> None:
    with rr.connect(system.state_dir) as connection:
        reading = Reading(connection.open_registrar("viewer").load("cameras/camera", "a").stream("images"))
        eventually(lambda: is_wanted(system))

    assert reading.ended()
    assert reading.error is None


def test_close_ends_a_reader_that_waits_in_another_thread(camera: rr.Query[Feed]) -> None:
    reader = camera.stream("images")
    reading = Reading(reader)

    reader.close()

    assert reading.ended()
    assert reading.error is None


def descriptors_after_a_stream(start: Start, state_dir: Path) -> int:
    system = start(rr.ChildSpec(Cameras, id="cameras", placement="thread"), state_dir=state_dir)
    camera = system.open_registrar("app").load(Cameras.open_camera, "a")
    reader = read(system, camera)
    published(system, bytes(100_000))
    next(reader)

    system.stop()

    eventually(lambda: not [thread for thread in threading.enumerate() if "stream" in thread.name])
    assert camera.resource_id not in Path("/proc/net/unix").read_text()
    del reader
    gc.collect()
    return len(os.listdir("/proc/self/fd"))


def test_nothing_is_left_of_streams(start: Start, tmp_path: Path) -> None:
    once = descriptors_after_a_stream(start, tmp_path / "once")

    eventually(lambda: descriptors_after_a_stream(start, tmp_path / "again") <= once)
