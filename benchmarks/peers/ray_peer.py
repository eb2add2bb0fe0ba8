"""Ray: a call of an actor in a worker process."""

from __future__ import annotations

import os
import signal
import tempfile
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import ray  # pyright: ignore[reportMissingImports]  # a requirement of this benchmark alone

from benchmarks.measure import time_each
from benchmarks.peers.contest import IN_FLIGHT, PAYLOAD, Contest
from benchmarks.peers.flight import seconds_away, seconds_of


class Echo:
    """Answers with what it is called with."""

    def echo(self, message: bytes) -> bytes:
        return message

    def pid(self) -> int:
        return os.getpid()


@contextmanager
def contest() -> Iterator[Contest]:
    """A Ray of this machine alone, without its dashboard; the actor is restarted when it is killed."""
    with tempfile.TemporaryDirectory(prefix="ray-", ignore_cleanup_errors=True) as directory:
        ray.init(num_cpus=1, include_dashboard=False, log_to_driver=False, logging_level="ERROR", _temp_dir=directory)
        try:
            actor: Any = ray.remote(max_restarts=-1)(Echo).remote()

            def call() -> None:
                ray.get(actor.echo.remote(PAYLOAD), timeout=20.0)

            def many(times: int) -> None:
                waiting: deque[Any] = deque()
                for _ in range(times):
                    if len(waiting) == IN_FLIGHT:
                        ray.get(waiting.popleft())
                    waiting.append(actor.echo.remote(PAYLOAD))
                ray.get(list(waiting))

            def kill() -> float:
                pid: int = ray.get(actor.pid.remote())
                return seconds_away(lambda: os.kill(pid, signal.SIGKILL), call)

            yield Contest(
                ray.__version__, lambda times: time_each(call, times), lambda times: seconds_of(many, times), kill
            )
        finally:
            ray.shutdown()
