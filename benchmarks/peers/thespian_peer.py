"""Thespian: an ask of an actor in another process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata
from typing import Any

from thespian import actors  # pyright: ignore[reportMissingImports]  # a requirement of this benchmark alone

from benchmarks.measure import time_each
from benchmarks.peers.contest import PAYLOAD, Contest

_BASE = "multiprocQueueBase"  # the fastest of its bases with processes, beside those on TCP and UDP
_PATIENCE_S = 10.0


class Echo(actors.Actor):
    """Answers with what it is asked."""

    def receiveMessage(self, message: Any, sender: Any) -> None:  # noqa: N802  # Thespian's name
        if isinstance(message, bytes):
            self.send(sender, message)


@contextmanager
def contest() -> Iterator[Contest]:
    """An actor system of its own; one outside caller can have one ask under way, so there is no pipelining."""
    system = actors.ActorSystem(_BASE, logDefs=_QUIET)
    try:
        actor = system.createActor(Echo)

        def ask() -> None:
            if system.ask(actor, PAYLOAD, _PATIENCE_S) != PAYLOAD:
                raise RuntimeError(f"Thespian did not answer within {_PATIENCE_S:g} s")

        yield Contest(metadata.version("thespian"), lambda times: time_each(ask, times))
    finally:
        system.shutdown()


_QUIET: dict[str, Any] = {"version": 1, "handlers": {}, "root": {"level": "ERROR", "handlers": []}}
