"""The actors of tests/test_pykka_programs.py, in a module that their processes import without the tests."""

from __future__ import annotations

import atexit
import time
from collections.abc import Iterator
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


class Drawer:
    """A part with operators of its own."""

    def __init__(self) -> None:
        self.socks = 2

    def __len__(self) -> int:
        return self.socks


class Common:
    """What a Shelf does, on whatever it is based."""

    def __init__(self) -> None:
        super().__init__()
        self.items: dict[str, Any] = {}
        self.drawer = pykka.traversable(Drawer())
        self.label = "shelf"
        self.opened = 0
        ref: Any = self.actor_ref  # type: ignore[attr-defined]
        self.own = ref

    def on_receive(self, message: Any) -> Any:
        return message(self) if callable(message) else message

    def on_start(self) -> None:
        self.own_proxy = self.own.proxy()

    def put(self, name: str, value: Any) -> int:
        self.items[name] = value
        return len(self.items)

    def ask_through(self, proxy: Any) -> Any:
        return proxy.put("from afar", 1).get(), proxy.label.get(), len(proxy)

    def __len__(self) -> int:
        return len(self.items)

    def __getitem__(self, name: str) -> Any:
        return self.items[name]

    def __setitem__(self, name: str, value: Any) -> None:
        self.items[name] = value

    def __delitem__(self, name: str) -> None:
        del self.items[name]

    def __contains__(self, name: str) -> bool:
        return name in self.items

    def __iter__(self) -> Iterator[str]:
        yield from self.items

    def __enter__(self) -> Any:
        self.opened += 1
        return self

    def __exit__(self, kind: Any, error: Any, _traceback: Any) -> bool:
        self.opened -= 1
        return kind is KeyError and error.args == ("forgiven",)


class Shelf(Common, rr.Actor):
    """One of ours."""


class PlainShelf(Common, pykka.ThreadingActor):
    """One of Pykka's."""


class Carrier(rr.Actor):
    """Keeps the proxy that it is made with, where everybody sees it."""

    def __init__(self, shelf: Any) -> None:
        self.shelf = shelf

    def put(self) -> int:
        return self.shelf.put("carried", 1).get()


class Eager(rr.Actor):
    """Asks its supervisor, and the one at the top, before it has started itself."""

    def on_start(self) -> None:
        self.heard: dict[str, str] = {}
        for path in {self.above(), "root"}:
            try:
                rr.SupervisorRef(path).which_children()
            except rr.ActorUnavailable as error:
                self.heard[path] = str(error).partition(",")[0]

    def above(self) -> str:
        return str(self.actor_ref.path).rpartition("/")[0]  # type: ignore[attr-defined]

    def on_receive(self, message: Any) -> Any:
        return rr.SupervisorRef(self.above()).which_children()


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


def write_at_exit(path: str) -> Any:
    """What makes an actor's process write to a file when it ends in order."""

    def register(_: Any) -> None:
        atexit.register(Path(path).write_text, "written")

    return register


def put_late(name: str) -> Any:
    """A message that puts a thing on the shelf."""
    return lambda shelf: shelf.put(name, "late")
