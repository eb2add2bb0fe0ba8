"""rr_actors: an ask of an Actor in another process."""

from __future__ import annotations

import os
import signal
import tempfile
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import rr_actors as rr
from benchmarks.measure import time_each
from benchmarks.peers.contest import IN_FLIGHT, PAYLOAD, Contest
from benchmarks.peers.flight import seconds_away, seconds_of


class Echo(rr.Actor):
    """Answers with what it is asked."""

    def on_receive(self, message: Any) -> Any:
        return message


@contextmanager
def contest() -> Iterator[Contest]:
    """One Actor in a process of its own, supervised."""
    root = rr.Supervisor([rr.ChildSpec(Echo, id="echo")], max_restarts=1_000)
    with (
        tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir,
        rr.System(root, name="peers", state_dir=state_dir) as system,
    ):
        actor = system.ref("echo")

        def many(times: int) -> None:
            waiting: deque[Any] = deque()
            for _ in range(times):
                if len(waiting) == IN_FLIGHT:
                    waiting.popleft().get()
                waiting.append(actor.ask(PAYLOAD, block=False))
            for future in waiting:
                future.get()

        def kill() -> None:
            (child,) = system.supervisor().which_children()
            assert child.pid is not None
            os.kill(child.pid, signal.SIGKILL)

        yield Contest(
            rr.__version__,
            lambda times: time_each(lambda: actor.ask(PAYLOAD), times),
            lambda times: seconds_of(many, times),
            lambda: seconds_away(kill, lambda: actor.ask(PAYLOAD)),
        )
