"""The actors of tests/test_pykka_programs.py, in a module that their processes import without the tests."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pykka

import rr_actors as rr


class Worker(rr.Actor):
    """Does what it is asked."""

    def __init__(self, *given: Any) -> None:
        self.given = given

    def on_receive(self, message: Any) -> Any:
        return message(self) if callable(message) else message

    def work_until(self, path: str) -> None:
        """Work until the file is there."""
        while not Path(path).exists():
            time.sleep(0.005)


class Plain(pykka.ThreadingActor):
    """An actor of Pykka's."""

    def on_receive(self, message: Any) -> Any:
        return message(self) if callable(message) else message


def registered(_: Any) -> list[str]:
    """The URNs in the registry of the actor's process."""
    return [ref.actor_urn for ref in pykka.ActorRegistry.get_all()]


def start_another(_: Any) -> str:
    """Start an actor in the actor's process."""
    return Worker.start().actor_urn


def boom(_: Any) -> None:
    """Raise in the actor."""
    raise KeyError("boom")
