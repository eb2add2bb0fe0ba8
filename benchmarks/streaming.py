"""Frames of a stream, from a manager in another process: large ones beside memcpy, small ones beside a raw pipe."""

from __future__ import annotations

import contextlib
import multiprocessing
import statistics
import struct
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any

import numpy

import rr_actors as rr
from benchmarks.measure import time_each
from benchmarks.table import Row

_CLOCK = struct.Struct("d")
_SHAPE = (1080, 1920, 3)
_BYTES = 1080 * 1920 * 3


class Cameras(rr.Manager):
    """Publishes what it is asked to. A large frame has the time at which it was published in its first bytes."""

    @rr.server("camera")
    def open_camera(self) -> rr.Stream:
        self.images = rr.current().open_stream("images")
        self.picture = numpy.ones(_SHAPE, "u1")
        return self.images.stream

    def is_wanted(self) -> bool:
        return self.images.wanted

    def publish_large(self) -> int:
        _CLOCK.pack_into(self.picture.data.cast("B"), 0, time.perf_counter())
        return self.images.publish(self.picture)

    def publish_value(self, value: object) -> int:
        return self.images.publish(value)

    def publish_loan(self) -> None:
        with self.images.loan(_SHAPE, "u1") as picture:
            picture[:] = self.picture
            _CLOCK.pack_into(picture.data.cast("B"), 0, time.perf_counter())

    def publish_small(self, times: int) -> None:
        for number in range(times):
            self.images.publish(number)


def streaming(large: int, small: int) -> list[Row]:
    """How long a frame of 6.2 MB takes from publish() to the readers' loops, and a small one among many."""
    with (
        tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir,
        rr.System([rr.ChildSpec(Cameras, id="cameras")], name="bench", state_dir=state_dir) as system,
    ):
        camera = system.open_registrar("app").load(Cameras.open_camera)
        manager = system.ref("cameras").proxy()
        here, there = numpy.ones(_SHAPE, "u1"), numpy.ones(_SHAPE, "u1")
        copies: list[float] = []
        took: dict[str, list[float]] = {"frame": [], "frame, the last of 4 readers": [], "loan": []}
        with camera.stream(keep="all", depth=1000, timeout_s=60) as reader:
            while not manager.is_wanted().get():
                time.sleep(0.001)
            for _ in range(large):
                copies += time_each(lambda: numpy.copyto(there, here), 1)
                for name, publish in (("frame", manager.publish_large), ("loan", manager.publish_loan)):
                    sent = publish()
                    took[name].append(_arrival_s(reader))
                    sent.get()
            sent = manager.publish_small(small)
            next(reader)
            began = time.perf_counter()
            for _ in range(small - 1):
                next(reader)
            small_s = (time.perf_counter() - began) / (small - 1)
            sent.get()
        took["frame, the last of 4 readers"] = _last_of_four_s(camera, manager, large)
    copied, pipe_s = statistics.median(copies), _pipe_s(small)
    median = {name: statistics.median(times) * 1e3 for name, times in took.items()}
    p99 = {name: sorted(times)[int(len(times) * 0.99)] * 1e3 for name, times in took.items()}
    last = "frame, the last of 4 readers"
    return [
        Row("memcpy, 6.2 MB", copied * 1e3, "ms"),
        *(
            Row(f"{name}, 6.2 MB", median[name], "ms", p99[name], median[name] / (copied * 1e3), "memcpy")
            for name in ("frame", last)
        ),
        Row("frame, beyond 1.3 × memcpy", median["frame"] - 1.3 * copied * 1e3, "ms", at_most=0.15),
        Row("each reader more", (median[last] - median["frame"]) / 3, "ms", at_most=0.1),
        Row("loan, 6.2 MB", median["loan"], "ms", p99["loan"], at_most=0.15),
        Row("raw pipe, one small message", pipe_s * 1e6, "µs"),
        Row("frame of a stream, small", small_s * 1e6, "µs", at_most=50),
    ]


def _arrival_s(reader: rr.StreamReader) -> float:
    """Return how long ago the next frame was published, when the reader has it."""
    return -_CLOCK.unpack_from(next(reader).value.data.cast("B"))[0] + time.perf_counter()


def _last_of_four_s(camera: rr.Query[rr.Stream], manager: Any, times: int) -> list[float]:
    """Return when the last of four readers, each in a thread, has each frame."""
    took: list[float] = []
    with contextlib.ExitStack() as stack:
        readers = [stack.enter_context(camera.stream(keep="all", depth=1000, timeout_s=60)) for _ in range(4)]
        pool = stack.enter_context(ThreadPoolExecutor(4))
        number = 0
        while manager.publish_value(number).get() < 4:  # not all are bound yet
            number += 1
        for reader in readers:
            while next(reader).value != number:
                pass
        for _ in range(times):
            waiting = [pool.submit(_arrival_s, reader) for reader in readers]
            manager.publish_large().get()
            took.append(max(future.result() for future in waiting))
    return took


def _send(there: Connection, times: int) -> None:
    for number in range(times):
        there.send_bytes(number.to_bytes(8, "little"))


def _pipe_s(times: int) -> float:
    here, there = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("spawn").Process(target=_send, args=(there, times))
    process.start()
    there.close()
    here.recv_bytes()
    began = time.perf_counter()
    for _ in range(times - 1):
        here.recv_bytes()
    took = (time.perf_counter() - began) / (times - 1)
    process.join()
    here.close()
    return took
