"""The time limit of a connection's call holds while the application is stopped, whatever it has sent before."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from support import LIMIT_S, eventually, hang

pytestmark = pytest.mark.usefixtures("runtime_dir")

LIMIT = 0.2


class Things(rr.Manager):
    @rr.server("thing", recovery="keep")
    def make(self, name: str) -> str:
        return name


@pytest.fixture
def stopped(state_dir: Path) -> Iterator[tuple[rr.Connection, rr.ConnectedRegistrar, rr.Query]]:
    """A connection, its registrar and a query, of an application that is stopped."""
    command = [sys.executable, __file__, str(state_dir)]
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes) as application:
        assert application.stdout is not None
        assert application.stdout.readline() == "up\n"
        with rr.connect(state_dir) as connection, connection.open_registrar("mine") as mine:
            query = mine.load("things/thing", "held")
            hang(application.pid)
            yield connection, mine, query
            os.kill(application.pid, signal.SIGCONT)
            eventually(lambda: [row.id for row in mine.queries()] in ([], [query.id]))  # what came too late is not held
        application.communicate("")


def test_the_time_limit_of_each_call_holds(stopped: tuple[rr.Connection, rr.ConnectedRegistrar, rr.Query]) -> None:
    connection, mine, query = stopped
    late = rr.LoadTimeout
    calls: dict[str, tuple[type[Exception], Callable[[], Any]]] = {
        "load": (late, lambda: mine.load("things/thing", "x", timeout_s=LIMIT)),
        "long": (late, lambda: mine.load("things/thing", "x" * 800_000, timeout_s=LIMIT)),
        "again": (late, lambda: mine.load("things/thing", "y", timeout_s=LIMIT)),
        "future": (late, lambda: mine.load("things/thing", "z", timeout_s=LIMIT, block=False).get()),
        "all": (late, lambda: mine.load_all([("things/thing", "a"), ("things/thing", "b")], timeout_s=LIMIT)),
        "await": (late, lambda: asyncio.run(mine.load_async("things/thing", "c", timeout_s=LIMIT))),
        "by class": (rr.Unavailable, lambda: mine.load(Things.make, "d", timeout_s=LIMIT)),
        "unload": (rr.Unavailable, lambda: query.unload(timeout_s=LIMIT)),
        "unload all": (rr.Unavailable, lambda: mine.unload_all(timeout_s=LIMIT)),
        "unload connection": (rr.Unavailable, lambda: mine.unload_client("things/thing", timeout_s=LIMIT)),
        "ask": (rr.Unavailable, lambda: connection.ask("things", "hello", timeout_s=LIMIT)),
    }

    def ended(name: str) -> str:
        expected, call = calls[name]
        began = time.monotonic()
        with pytest.raises(expected, match=r"has not answered|does not read what it is sent"):
            call()
        assert time.monotonic() - began < 4, name
        return name

    with ThreadPoolExecutor(len(calls)) as threads:
        assert list(threads.map(ended, calls, timeout=LIMIT_S)) == list(calls)


if __name__ == "__main__":
    with rr.System([rr.ChildSpec(Things, id="things", placement="thread")], state_dir=sys.argv[1]):
        print("up", flush=True)
        sys.stdin.read()
