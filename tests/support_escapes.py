"""Ways in which a callback starts a process that hides, and the manager whose callback does so."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import time
from collections.abc import Callable

import rr_actors as rr
from support import Workshop

_PR_SET_NAME = 15


def _stay(shop: Workshop) -> None:
    shop.note("escaped", os.getpid())
    while True:
        time.sleep(60)


def fork_with_setsid(shop: Workshop) -> None:
    if os.fork() == 0:
        os.setsid()
        _stay(shop)


def daemonize_twice(shop: Workshop) -> None:
    if (first := os.fork()) == 0:
        os.setsid()
        if os.fork() == 0:
            os.setsid()
            os.chdir("/")
            if os.fork() == 0:
                _stay(shop)
        os._exit(0)
    os.waitpid(first, 0)


def change_its_name(shop: Workshop) -> None:
    if os.fork() == 0:
        os.setsid()
        ctypes.CDLL(None).prctl(_PR_SET_NAME, b"kworker/0:0", 0, 0, 0)
        _stay(shop)


def clear_its_environment_in_exec(shop: Workshop) -> None:
    if os.fork() == 0:
        os.setsid()
        shop.note("escaped", os.getpid())
        os.execve("/bin/sleep", ["sleep", "600"], {})


def close_all_descriptors(shop: Workshop) -> None:
    if os.fork() == 0:
        os.setsid()
        shop.note("escaped", os.getpid())
        os.closerange(0, 65536)
        while True:
            time.sleep(60)


def do_it_all(shop: Workshop) -> None:
    if (first := os.fork()) == 0:
        os.setsid()
        if os.fork() == 0:
            ctypes.CDLL(None).prctl(_PR_SET_NAME, b"kworker/0:0", 0, 0, 0)
            os.chdir("/")
            if os.fork() == 0:
                os.setsid()
                shop.note("escaped", os.getpid())
                os.closerange(0, 65536)
                os.execve("/bin/sleep", ["kworker/0:0", "600"], {})
        os._exit(0)
    os.waitpid(first, 0)


WAYS = [
    fork_with_setsid,
    daemonize_twice,
    change_its_name,
    clear_its_environment_in_exec,
    close_all_descriptors,
    do_it_all,
]


class Escaping(rr.Manager):
    """Serves things whose load callback starts a process that hides."""

    def __init__(self, root: str, way: Callable[[Workshop], None]) -> None:
        self._shop = Workshop(root)
        self._way = way

    @rr.server("thing")
    def load(self, request: int) -> int:
        self._way(self._shop)
        return request


class StartProgram:
    """A way to escape: run a program in a session of its own."""

    def __init__(self, program: str) -> None:
        self._program = program

    def __call__(self, shop: Workshop) -> None:
        application = subprocess.Popen(
            [sys.executable, "-c", self._program], stdout=subprocess.PIPE, start_new_session=True, text=True
        )
        assert application.stdout is not None
        application.stdout.readline()
        shop.note("escaped", application.pid)
