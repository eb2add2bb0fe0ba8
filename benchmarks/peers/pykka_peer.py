"""Pykka: an ask within one process."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from typing import Any

import pykka

from benchmarks.measure import time_each
from benchmarks.peers.contest import IN_FLIGHT, PAYLOAD, Contest
from benchmarks.peers.flight import seconds_of


class Echo(pykka.ThreadingActor):
    """Answers with what it is asked."""

    def on_receive(self, message: Any) -> Any:
        return message


@contextmanager
def contest() -> Iterator[Contest]:
    """A ThreadingActor of this process."""
    actor = Echo.start()

    def many(times: int) -> None:
        waiting: deque[Any] = deque()
        for _ in range(times):
            if len(waiting) == IN_FLIGHT:
                waiting.popleft().get()
            waiting.append(actor.ask(PAYLOAD, block=False))
        for future in waiting:
            future.get()

    try:
        yield Contest(
            metadata.version("pykka"),
            lambda times: time_each(lambda: actor.ask(PAYLOAD), times),
            lambda times: seconds_of(many, times),
        )
    finally:
        actor.stop()
