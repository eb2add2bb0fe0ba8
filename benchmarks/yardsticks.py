"""What the machine itself can do: raw multiprocessing.Pipe echoes in other processes; in this one, an echo between two
threads, and a Pykka ask."""

from __future__ import annotations

import itertools
import multiprocessing
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import pykka

_ECHO = """
import sys
from multiprocessing.connection import Connection
connection = Connection(int(sys.argv[1]))
try:
    while True:
        connection.send_bytes(connection.recv_bytes())
except EOFError:
    pass
"""


@contextmanager
def pipe_echo(payload: bytes) -> Iterator[Callable[[], bytes]]:
    """A call that sends `payload` to another process through a Pipe and waits for it to come back, without pickling."""
    here, there = multiprocessing.Pipe()
    fd = there.fileno()
    process = subprocess.Popen([sys.executable, "-c", _ECHO, str(fd)], pass_fds=[fd])
    there.close()

    def echo() -> bytes:
        here.send_bytes(payload)
        return here.recv_bytes()

    try:
        yield echo
    finally:
        here.close()
        process.wait()


@contextmanager
def pipe_echoes(payload: bytes, children: int) -> Iterator[list[Callable[[], bytes]]]:
    """The echoes of so many children: what each costs when they are asked in turn shows what many processes cost."""
    with ExitStack() as stack:
        yield [stack.enter_context(pipe_echo(payload)) for _ in range(children)]


def in_turn(operations: list[Callable[[], Any]]) -> Callable[[], Any]:
    """One call that makes the next of these calls, and after the last the first again."""
    following = itertools.cycle(operations)
    return lambda: next(following)()


@contextmanager
def thread_echo(payload: bytes) -> Iterator[Callable[[], Any]]:
    """A call that gives `payload` to another thread through a SimpleQueue, and waits for it to come back."""
    there: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    back: queue.SimpleQueue[bytes] = queue.SimpleQueue()

    def answer() -> None:
        while (got := there.get()) is not None:
            back.put(got)

    def echo() -> bytes:
        there.put(payload)
        return back.get()

    thread = threading.Thread(target=answer)
    thread.start()
    try:
        yield echo
    finally:
        there.put(None)
        thread.join()


class _Echo(pykka.ThreadingActor):
    def on_receive(self, message: Any) -> Any:
        return message


@contextmanager
def pykka_ask(payload: bytes) -> Iterator[Callable[[], Any]]:
    """A call that asks a pykka.ThreadingActor of this process and waits for the answer."""
    actor = _Echo.start()
    try:
        yield lambda: actor.ask(payload)
    finally:
        actor.stop()
