"""Streams with checksums, while their publisher and their readers are killed at random: no reader sees a wrong byte."""

from __future__ import annotations

import itertools
import os
import pickle
import random
import struct
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal

import numpy
import pytest

import rr_actors as rr
from support import eventually, kill
from support_slow import few_now

Start = Callable[..., rr.System]

MB = 2**20
HEAD = struct.Struct("<IIQ")  # checksum of what follows, process, number
TOLD = struct.Struct("<QQ")  # frames, wrong frames
BLOCK = random.Random(7).randbytes(MB)
SIZES = (0, 1, 1000, 60_000, 70_000, 200_000, 500_000)  # from 64 KiB on they are in shared memory


class Cameras(rr.Manager):
    """A camera has two threads that publish: one copies what it publishes, the other fills loans."""

    def __init__(self) -> None:
        self.off = threading.Event()

    @rr.server("camera", recovery="reload")
    def open_camera(self, device: str) -> None:
        images = rr.current().open_stream("images")
        for number, publish in enumerate((publish_copy, publish_loan)):
            arguments = images, publish, random.Random(number), self.off
            threading.Thread(target=publish_on, args=arguments, daemon=True).start()

    @open_camera.unload
    def close_camera(self, device: str, response: object) -> None:
        self.off.set()


def publish_on(
    images: rr.Publisher, publish: Callable[[rr.Publisher, bytes], object], chance: random.Random, off: threading.Event
) -> None:
    for number in itertools.count():
        if off.is_set():
            return
        if not images.wanted:
            off.wait(0.01)
            continue
        start = chance.randrange(MB // 2)
        body = struct.pack("<IQ", os.getpid(), number) + BLOCK[start : start + chance.choice(SIZES)]
        publish(images, struct.pack("<I", zlib.crc32(body)) + body)


def publish_copy(images: rr.Publisher, frame: bytes) -> None:
    changing = bytearray(frame)
    images.publish(pickle.PickleBuffer(changing), timeout_s=0.1)
    changing[:] = bytes(len(changing))  # a value may change when it is published


def publish_loan(images: rr.Publisher, frame: bytes) -> None:
    with images.loan(len(frame), "u1") as array:
        array[:] = numpy.frombuffer(frame, "u1")


def is_right(value: Any) -> bool:
    raw = memoryview(value)
    return len(raw) >= HEAD.size and zlib.crc32(raw[4:]) == HEAD.unpack_from(raw)[0]


class Watchers(rr.Manager):
    """Each resource reads the camera with threads that keep some frames, and look at them once more before they go.

    A file for each thread, which outlives the process, says how many frames it had and how many were wrong.
    """

    def __init__(self, told: str) -> None:
        self.told = Path(told)

    @rr.server("watch", recovery="reload")
    def watch(self, name: str) -> None:
        camera = self.registrar.load("cameras/camera", "a")
        keeps: tuple[Literal["latest", "all"], ...] = "latest", "all"
        for keep in keeps:
            reader = camera.stream("images", keep=keep, depth=4)
            file = os.open(self.told / f"{name}-{keep}-{os.getpid()}", os.O_RDWR | os.O_CREAT)
            threading.Thread(target=self.read, args=(reader, file), daemon=True).start()

    def read(self, reader: rr.StreamReader, file: int) -> None:
        count = wrong = 0
        kept: deque[Any] = deque()
        last: tuple[int, int] = 0, 0
        try:
            for frame in reader:
                right = is_right(frame.value)
                kept.append(frame.value)
                if len(kept) > 3:
                    right &= is_right(kept.popleft())
                pid = HEAD.unpack_from(memoryview(frame.value))[1]
                right &= pid != last[0] or frame.number == last[1] + frame.missed + 1
                last = pid, frame.number
                count, wrong = count + 1, wrong + (not right)
                os.pwrite(file, TOLD.pack(count, wrong), 0)
        except Exception as error:
            (self.told / f"error-{os.getpid()}-{file}").write_text(repr(error))


class Traffic:
    """What the readers of a directory have told."""

    def __init__(self, told: Path) -> None:
        self._told = told

    def frames(self, of: str = "") -> int:
        return sum(count for count, _ in self._read(of))

    def check(self) -> None:
        assert sum(wrong for _, wrong in self._read("")) == 0
        assert [path.read_text() for path in self._told.glob("error-*")] == []

    def _read(self, of: str) -> Iterable[tuple[int, int]]:
        for path in self._told.glob(f"{of}*-*"):
            raw = path.read_bytes()
            if len(raw) == TOLD.size and not path.name.startswith("error"):
                yield TOLD.unpack(raw)


def wait_for_more(traffic: Traffic, number: Callable[[], int]) -> None:
    """Wait until each reader has so many frames more, and none of them is wrong."""
    wanted = {name: traffic.frames(name) + number() for name in READERS}

    def have_more() -> bool:
        traffic.check()
        return all(traffic.frames(name) >= count for name, count in wanted.items())

    eventually(have_more, 60)


READERS = ("a-latest", "a-all", "b-latest", "b-all")


def kills(seconds: float) -> Iterable[int]:
    """Yield the numbers of kills: three, or as many as there is time for."""
    until = time.monotonic() + seconds
    return itertools.takewhile(lambda number: number < 3 or time.monotonic() < until, itertools.count())


@pytest.mark.parametrize("seconds", few_now([0], [20]))
def test_no_reader_sees_a_wrong_byte_whoever_is_killed(start: Start, tmp_path: Path, seconds: float) -> None:
    told = tmp_path / "told"
    told.mkdir()
    children = [
        rr.ChildSpec(Cameras, id="cameras"),
        *(rr.ChildSpec(Watchers, id=f"watchers-{name}", args=(str(told),)) for name in "ab"),
    ]
    tree = rr.Supervisor(children, id="root", max_restarts=10_000)
    system = start(tree, config=rr.SystemConfig(segments_limit_bytes=16 * MB))
    app = system.open_registrar("app")
    queries = [app.load(f"watchers-{name}/watch", name) for name in "ab"]
    traffic, chance = Traffic(told), random.Random(11)

    for _ in kills(seconds):
        wait_for_more(traffic, lambda: chance.randrange(1, 100))
        kill(system, chance.choice(["cameras", "watchers-a", "watchers-b"]))
    wait_for_more(traffic, lambda: 1)
    for query in queries:
        query.unload()
    traffic.check()
    print(f"{traffic.frames()} frames, none wrong")
