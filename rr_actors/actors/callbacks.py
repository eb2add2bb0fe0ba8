"""The context of a running callback: for which resource, which attempt. What it loads is attributed by it.

It is a contextvar, so it follows into tasks and into asyncio.to_thread, not into threads that a callback starts by
hand: those pass ``parent=rr.current()`` on.
"""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from typing import Any

import msgspec

from rr_actors.errors import UsageError


class Current(msgspec.Struct, frozen=True):
    """What a callback may know about its own call.

    Attributes:
        resource_id: the resource it loads, unloads, or hears about.
        attempt: 1 at first, more when a crash interrupted it before.
        origin: the registrar that holds the resource, by name: the one that asked first, of those that are left.
        server: the server's name, as it was registered.
        registrar: the serving registrar's actor; what the callback loads belongs to its resource.
    """

    resource_id: str
    attempt: int
    origin: str
    server: str
    registrar: Any


_current: ContextVar[Current | None] = ContextVar("rr_current", default=None)


def current() -> Current:
    """Return the context of the callback that this code runs in.

    Raises:
        UsageError: this code does not run in a callback.
    """
    context = _current.get()
    if context is None:
        raise UsageError("rr.current(): expected to be called in a load, unload, status or recover callback")
    return context


current_or_none: Callable[[], Current | None] = _current.get
"""As current(), or None outside of callbacks."""


def begin(current: Current) -> None:
    """From now on current() returns `current` in this context, which is the callback's own."""
    _current.set(current)
