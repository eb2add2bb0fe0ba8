"""What the machine itself can do: raw multiprocessing.Pipe echoes in other processes, and a Pykka ask in this one."""

from __future__ import annotations

import itertools
import multiprocessing
import subprocess
import sys
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
