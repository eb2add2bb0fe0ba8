"""A picture of 6.2 MB on its way to another process: `python -m benchmarks.peers.frames`, a part of `make bench-peers`.

Streams, iceoryx2 and Zenoh one after the other, beside memcpy of the same bytes. "copied": from before the array is
copied or published until the reader has it; "in place": from when shared memory is filled. A reader of iceoryx2 is
woken by an event, as those of streams are, or asks without a pause. A reader of Zenoh gets bytes of its own. Files of
both stay in /dev/shm and /tmp/iceoryx2.
"""

# pyright: reportMissingImports=false, reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
# iceoryx2 and Zenoh are requirements of this benchmark alone.

from __future__ import annotations

import argparse
import contextlib
import ctypes
import multiprocessing
import os
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from importlib import metadata
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import numpy

import rr_actors as rr
from benchmarks.measure import Samples, time_each
from benchmarks.peers.environment import interpreter
from benchmarks.streaming import Cameras
from benchmarks.table import Row, text

_BYTES = 1080 * 1920 * 3
_CLOCK = struct.Struct("d")
_PORT = "tcp/127.0.0.1:17447"


class Flight(NamedTuple):
    """A way to another process. `publish` has the other process send a picture; `read` waits for its first bytes."""

    publish: Callable[[], object]
    read: Callable[[], bytes]


@contextlib.contextmanager
def streams(in_place: bool) -> Iterator[Flight]:
    """A stream of a manager."""
    with (
        tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir,
        rr.System([rr.ChildSpec(Cameras, id="cameras")], name="bench", state_dir=state_dir) as system,
    ):
        camera = system.open_registrar("app").load(Cameras.open_camera)
        manager = system.ref("cameras").proxy()
        with camera.stream(keep="all", depth=1000, timeout_s=60) as reader:
            while not manager.is_wanted().get():
                time.sleep(0.001)
            publish = manager.publish_loan if in_place else manager.publish_large
            yield Flight(publish, lambda: bytes(next(reader).value.data.cast("B")[: _CLOCK.size]))


@contextlib.contextmanager
def _publisher(run: Callable[[Connection, bool], None], in_place: bool) -> Iterator[Callable[[], object]]:
    """Run a publisher in a process of its own, which sends a picture for each call."""
    here, there = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=run, args=(there, in_place), daemon=True)
    process.start()
    there.close()
    here.recv()  # it is ready
    yield lambda: here.send(True)
    here.close()
    process.join()


def _iceoryx2_service() -> Any:
    import iceoryx2

    node = iceoryx2.NodeBuilder.new().create(iceoryx2.ServiceType.Ipc)
    name = iceoryx2.ServiceName.new("rr_actors/benchmark")
    data = node.service_builder(name).publish_subscribe(iceoryx2.Slice[ctypes.c_uint8]).open_or_create()
    return node, data, node.service_builder(name).event().open_or_create()


def _publish_by_iceoryx2(asked: Connection, in_place: bool) -> None:
    _node, data, events = _iceoryx2_service()
    publisher, notifier = (
        data.publisher_builder().initial_max_slice_len(_BYTES).create(),
        events.notifier_builder().create(),
    )
    picture = numpy.ones(_BYTES, "u1")
    asked.send(True)
    with contextlib.suppress(EOFError):
        while asked.recv():
            began = time.perf_counter()
            sample = publisher.loan_slice_uninit(_BYTES)
            memory = _memory(sample.payload_ptr, _BYTES)
            memory[:] = picture
            _CLOCK.pack_into(memory.data.cast("B"), 0, time.perf_counter() if in_place else began)
            sample.assume_init().send()
            notifier.notify()


def _memory(pointer: Any, size: int) -> Any:
    address = pointer if isinstance(pointer, int) else ctypes.cast(pointer, ctypes.c_void_p).value or 0
    return numpy.ctypeslib.as_array((ctypes.c_ubyte * size).from_address(address))


@contextlib.contextmanager
def iceoryx2(in_place: bool, sleeps: bool = True) -> Iterator[Flight]:
    """A publish-subscribe service of bytes, in shared memory."""
    _node, data, events = _iceoryx2_service()
    subscriber, listener = data.subscriber_builder().create(), events.listener_builder().create()

    def read() -> bytes:
        while (sample := subscriber.receive()) is None:
            if sleeps:
                listener.blocking_wait()
        return _memory(sample.payload_ptr, _CLOCK.size).tobytes()

    with _publisher(_publish_by_iceoryx2, in_place) as publish:
        yield Flight(publish, read)


def _zenoh_session(ends: str) -> Any:
    import zenoh

    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5(f"{ends}/endpoints", f'["{_PORT}"]')
    return zenoh.open(config)


def _publish_by_zenoh(asked: Connection, in_place: bool) -> None:
    with _zenoh_session("connect") as session:
        publisher, picture = session.declare_publisher("rr_actors/benchmark"), numpy.ones(_BYTES, "u1")
        while not publisher.matching_status:
            time.sleep(0.01)
        asked.send(True)
        with contextlib.suppress(EOFError):
            while asked.recv():
                _CLOCK.pack_into(picture.data.cast("B"), 0, time.perf_counter())
                publisher.put(picture.tobytes())


@contextlib.contextmanager
def zenoh(in_place: bool) -> Iterator[Flight]:
    """A key of two sessions on this machine."""
    with _zenoh_session("listen") as session:
        subscriber = session.declare_subscriber("rr_actors/benchmark")
        with _publisher(_publish_by_zenoh, in_place) as publish:
            yield Flight(publish, lambda: subscriber.recv().payload.to_bytes()[: _CLOCK.size])


_PEERS: tuple[tuple[str, str, bool, Callable[[bool], AbstractContextManager[Flight]]], ...] = (
    ("stream, copied", "", False, streams),
    ("stream, in place", "", True, streams),
    ("iceoryx2, copied", "iceoryx2", False, iceoryx2),
    ("iceoryx2, in place", "iceoryx2", True, iceoryx2),
    ("iceoryx2, in place, asked all the time", "iceoryx2", True, partial(iceoryx2, sleeps=False)),
    ("Zenoh, copied", "eclipse-zenoh", False, zenoh),
)


def _flights(times: int, flight: Flight) -> Samples:
    took: list[float] = []
    for _ in range(times // 10 + times):
        flight.publish()
        took.append(-_CLOCK.unpack(flight.read())[0] + time.perf_counter())
    return Samples(tuple(took[times // 10 :]))  # after it has warmed up


def _rows(times: int) -> Iterator[Row]:
    here, there = numpy.ones(_BYTES, "u1"), numpy.ones(_BYTES, "u1")
    copied = statistics.median(time_each(lambda: numpy.copyto(there, here), times))
    yield Row("memcpy, 6.2 MB", copied * 1e3, "ms")
    for name, package, in_place, peer in _PEERS:
        try:
            version = f" {metadata.version(package)}" if package else ""
        except metadata.PackageNotFoundError:
            sys.stderr.write(f"{name}: {package} is not installed\n")
            continue
        with peer(in_place) as flight:
            took = _flights(times, flight)
        yield Row(f"{name}{version}", took.median * 1e3, "ms", took.p99 * 1e3, took.median / copied, "memcpy")


def main() -> None:
    """Measure in the environment of the peers, and print a table."""
    parser = argparse.ArgumentParser(prog="benchmarks.peers.frames", description=__doc__)
    parser.add_argument("--times", type=int, default=300, help="pictures of each (default: 300)")
    options = parser.parse_args()
    python = interpreter()
    if os.path.realpath(sys.prefix) != os.path.realpath(os.path.dirname(os.path.dirname(python))):
        sys.exit(subprocess.call([python, "-m", "benchmarks.peers.frames", *sys.argv[1:]]))
    sys.stdout.write(text(_rows(options.times)) + "\n")


if __name__ == "__main__":
    main()
