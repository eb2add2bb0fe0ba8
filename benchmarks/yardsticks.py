"""What the machine itself can do: raw multiprocessing.Pipe echoes in other processes; in this one, an echo between
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
above, *below = [Connection(int(fd)) for fd in sys.argv[1:]]
try:
    while True:
        message = above.recv_bytes()
        for connection in below:
            connection.send_bytes(message)
            message = connection.recv_bytes()
        above.send_bytes(message)
except EOFError:
    pass
"""


@contextmanager
def pipe_echo(payload: bytes, links: int = 1) -> Iterator[Callable[[], bytes]]:
    """A call that sends `payload` through Pipes to the last of a chain of processes, and waits for it."""
    here, above = multiprocessing.Pipe()
    processes: list[subprocess.Popen[bytes]] = []
    for left in reversed(range(links)):
        ends = multiprocessing.Pipe() if left else ()
        fds = [end.fileno() for end in (above, *ends[:1])]
        processes.append(subprocess.Popen([sys.executable, "-c", _ECHO, *map(str, fds)], pass_fds=fds))
        for end in (above, *ends[:1]):
            end.close()
        above = ends[-1] if ends else above

    def echo() -> bytes:
        here.send_bytes(payload)
        return here.recv_bytes()

    try:
        yield echo
    finally:
        here.close()
        for process in processes:
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
def thread_echo(payload: bytes, links: int = 1) -> Iterator[Callable[[], Any]]:
    """A call that gives `payload` through SimpleQueues to the last of a chain of threads, and waits for it."""
    there: list[queue.SimpleQueue[bytes | None]] = [queue.SimpleQueue() for _ in range(links)]
    back: list[queue.SimpleQueue[bytes]] = [queue.SimpleQueue() for _ in range(links)]

    def answer(link: int) -> None:
        while (got := there[link].get()) is not None:
            if link + 1 < links:
                there[link + 1].put(got)
                got = back[link + 1].get()
            back[link].put(got)

    def echo() -> bytes:
        there[0].put(payload)
        return back[0].get()

    threads = [threading.Thread(target=answer, args=(link,)) for link in range(links)]
    for thread in threads:
        thread.start()
    try:
        yield echo
    finally:
        for link, thread in enumerate(threads):
            there[link].put(None)
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
