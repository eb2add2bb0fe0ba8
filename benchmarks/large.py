"""Values of 8 KB to 50 MB to an Actor in another process and back, beside memcpy and multiprocessing.Pipe."""

from __future__ import annotations

import contextlib
import multiprocessing
import pickle
import tempfile
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Any

import rr_actors as rr
from benchmarks.measure import interleaved
from benchmarks.table import Row

_MB = 10**6


class Picture:
    """Has a buffer that pickle hands out of band, as numpy's arrays do."""

    def __init__(self, data: Any) -> None:
        self.data = data

    def __reduce_ex__(self, protocol: Any) -> Any:
        return Picture, (pickle.PickleBuffer(self.data) if protocol >= 5 else bytes(self.data),)


class Watcher(rr.Actor):
    """Takes a value, and answers with it, or with nothing."""

    def on_receive(self, message: Any) -> Any:
        value, is_wanted = message
        return value if is_wanted else None


def large(times: int) -> list[Row]:
    """Bytes of 8 to 500 KB; buffers of 1, 10 and 50 MB, and 10 MB of bytes."""
    rows: list[Row] = []
    with _pipe() as pipe, _watcher() as ask:
        rows += [_middle(kilobytes, pipe, ask, 10 * times) for kilobytes in (8, 32, 60, 100, 200, 500)]
        for name, size, make in (
            ("1 MB", _MB, _picture),
            ("10 MB", 10 * _MB, _picture),
            ("50 MB", 50 * _MB, _picture),
            ("10 MB of bytes", 10 * _MB, bytes),
        ):
            value = make(size)
            rows += _rows(name, value, bytearray(size), bytearray(size), pipe, ask, times)
    return rows


def _middle(kilobytes: int, pipe: Callable[[Any], Any], ask: Callable[[Any], Any], times: int) -> Row:
    """What most messages are: documents, scans, small pictures. The byte 0x93 looks like a name in a pickle."""
    value = b"\x93" * (kilobytes * 1000)
    measured = interleaved({"pipe": lambda: pipe((value, True)), "echo": lambda: ask((value, True))}, times=times)
    took = measured["echo"].median
    name = f"echo by an Actor, {kilobytes} KB of bytes"
    return Row(name, took * 1e3, "ms", measured["echo"].p99 * 1e3, took / measured["pipe"].median, "Pipe")


def _picture(size: int) -> Picture:
    return Picture(bytearray(size))


def _rows(
    name: str,
    value: Any,
    here: bytearray,
    there: bytearray,
    pipe: Callable[[Any], Any],
    ask: Callable[[Any], Any],
    times: int,
) -> list[Row]:
    target = memoryview(there)

    def memcpy() -> None:
        target[:] = here

    measured = interleaved(
        {
            "memcpy": memcpy,
            "pipe": lambda: pipe((value, True)),
            "ask": lambda: ask((value, False)),
            "echo": lambda: ask((value, True)),
        },
        times=times,
    )
    took = {what: samples.median for what, samples in measured.items()}
    aim = 0.3 if isinstance(value, Picture) else None
    bound = round(2 * took["memcpy"] * 1e3 + 0.2, 2) if name == "10 MB" else None
    return [
        Row(f"memcpy, {name}", took["memcpy"] * 1e3, "ms"),
        Row(f"Pipe echo, {name}", took["pipe"] * 1e3, "ms", measured["pipe"].p99 * 1e3),
        Row(f"ask, one way, {name}", took["ask"] * 1e3, "ms", measured["ask"].p99 * 1e3, at_most=bound),
        Row(
            f"echo by an Actor, {name}",
            took["echo"] * 1e3,
            "ms",
            measured["echo"].p99 * 1e3,
            took["echo"] / took["pipe"],
            "Pipe",
            at_most=aim,
        ),
    ]


def _echo(there: Connection) -> None:
    with contextlib.suppress(EOFError):
        while True:
            there.send(there.recv()[0])


@contextlib.contextmanager
def _pipe() -> Iterator[Callable[[Any], Any]]:
    here, there = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=_echo, args=(there,))
    process.start()
    there.close()

    def echo(message: Any) -> Any:
        here.send(message)
        return here.recv()

    try:
        yield echo
    finally:
        here.close()
        process.join()


@contextlib.contextmanager
def _watcher() -> Iterator[Callable[[Any], Any]]:
    spec = rr.ChildSpec(Watcher, id="watcher", placement="process")
    with (
        tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir,
        rr.System([spec], name="bench", state_dir=state_dir) as system,
    ):
        yield system.ref("watcher").ask
