"""A camera whose frames have checksums, and processes that read it with two threads each and tell what they had."""

from __future__ import annotations

import itertools
import os
import pickle
import random
import struct
import threading
import zlib
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Literal

import numpy

import rr_actors as rr
from support import eventually

MB = 2**20
HEAD = struct.Struct("<IIQ")  # checksum of what follows, process, number
TOLD = struct.Struct("<QQ")  # frames, wrong frames
BLOCK = random.Random(7).randbytes(MB)
PICTURE_BYTES = 640 * 480 * 3
READERS = ("a-latest", "a-all", "b-latest", "b-all")
SIZES = (0, 1, 1000, 60_000, 70_000, 200_000, 500_000)  # from 64 KiB on they are in shared memory


class Cameras(rr.Manager):
    """A camera has two threads that publish: one copies what it publishes, the other fills loans.

    Args:
        pictures_hz: how many pictures of 640 by 480 points each publishes a second; 0: frames of all sizes, at once.
    """

    def __init__(self, pictures_hz: float = 0.0) -> None:
        self.pictures_hz = pictures_hz
        self.off = threading.Event()

    @rr.server("camera", recovery="reload")
    def open_camera(self, device: str) -> None:
        images = rr.current().open_stream("images")
        for number, publish in enumerate((publish_copy, publish_loan)):
            arguments = images, publish, random.Random(number), self.pictures_hz, self.off
            threading.Thread(target=publish_on, args=arguments, daemon=True).start()

    @open_camera.unload
    def close_camera(self, device: str, response: object) -> None:
        self.off.set()


def publish_on(
    images: rr.Publisher,
    publish: Callable[[rr.Publisher, bytes], object],
    chance: random.Random,
    pictures_hz: float,
    off: threading.Event,
) -> None:
    for number in itertools.count():
        if pictures_hz:
            off.wait(1 / pictures_hz)
        if off.is_set():
            return
        if not images.wanted:
            off.wait(0.01)
            continue
        size = PICTURE_BYTES if pictures_hz else chance.choice(SIZES)
        start = chance.randrange(len(BLOCK) - size)
        body = struct.pack("<IQ", os.getpid(), number) + BLOCK[start : start + size]
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


CHILDREN = ("cameras", "watchers-a", "watchers-b")


def tree(told: Path, pictures_hz: float = 0.0) -> rr.Supervisor:
    """A camera, and two processes that read it with two threads each."""
    children = [
        rr.ChildSpec(Cameras, id="cameras", args=(pictures_hz,)),
        *(rr.ChildSpec(Watchers, id=f"watchers-{name}", args=(str(told),)) for name in "ab"),
    ]
    return rr.Supervisor(children, id="root", max_restarts=1_000_000)


def limits(pictures_hz: float = 0.0) -> rr.SystemConfig:
    """Little memory, so that slots are used again soon; enough for four readers that keep three frames each."""
    return rr.SystemConfig(segments_limit_bytes=(48 if pictures_hz else 16) * MB)


def watching(system: rr.System) -> list[rr.Query[Any]]:
    """Have both processes read."""
    app = system.open_registrar("app")
    return [app.load(f"watchers-{name}/watch", name) for name in "ab"]


def wait_for_more(traffic: Traffic, number: Callable[[], int]) -> None:
    """Wait until each reader has so many frames more, and none of them is wrong."""
    wanted = {name: traffic.frames(name) + number() for name in READERS}

    def have_more() -> bool:
        traffic.check()
        return all(traffic.frames(name) >= count for name, count in wanted.items())

    eventually(have_more, 60)
