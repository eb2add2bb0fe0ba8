"""The context of a running callback: for which resource, which attempt. What it loads is attributed by it.

It is a contextvar, so it follows into tasks and into asyncio.to_thread, not into threads that a callback starts by
hand: those pass ``parent=rr.current()`` on.
"""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from typing import Any

import msgspec

from rr_actors.base.errors import UsageError
from rr_actors.registrar.core.callback_runs import running
from rr_actors.registrar.model.rows import Phase


class Current(msgspec.Struct, frozen=True):
    """What a callback may know about its own call.

    Attributes:
        resource_id: the resource it loads, unloads, or hears about.
        attempt: 1 at first, more when a crash interrupted it before.
        origin: the registrar that holds the resource, by name: the one that asked first, of those that are left.
        server: the server's name, as it was registered.
        interrupted: in an unload callback, whether the load callback never returned: the response is None then. The
            load was withdrawn, or given up, after a crash; perhaps nothing was loaded, perhaps a part, perhaps all.
    """

    # The serving registrar's actor: what the callback loads belongs to its resource. And what the resource is in until
    # the callback returns: LOADING, UNLOADING, or LOADED, while it is asked after. None in a status callback: nothing
    # waits for that one.

    resource_id: str
    attempt: int
    origin: str
    server: str
    _registrar: Any
    _phase: Phase | None
    interrupted: bool = False


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


def serving(current: Current) -> Any:
    """The actor of the registrar whose callback it is."""
    return current._registrar  # pyright: ignore[reportPrivateUsage]  # same file


def _phase_of(current: Current) -> Phase | None:
    return current._phase  # pyright: ignore[reportPrivateUsage]  # same file


def begin(current: Current) -> None:
    """From now on current() returns `current` in this context, which is the callback's own."""
    _current.set(current)


def status_callback_of(registrar: Any) -> str:
    """Return the id of the resource whose status callback this code runs in, if the registrar serves it; else ""."""
    me = _current.get()
    return me.resource_id if me is not None and _phase_of(me) is None and serving(me) is registrar else ""


_DOES = {Phase.LOADING: "loads", Phase.UNLOADING: "unloads", Phase.LOADED: "recovers"}


def check_not_own(what: str, waits_for: Callable[[Current], bool], instead: str) -> None:
    """Raise if `what` would wait for the callback that this code runs in. A task that a callback left behind may wait.

    Args:
        waits_for: whether it waits for such a callback as long as that runs. Called with the lock of its registrar.
        instead: what to do.

    Raises:
        UsageError: it would. `.registrar`, `.server`, `.resource_id`
    """
    me = _current.get()
    if me is None or (phase := _phase_of(me)) is None or serving(me).closed:
        return
    with serving(me).lock:
        if not (_is_under_way(me, phase) and waits_for(me)):
            return
    name = serving(me).name
    whose = f"the callback that {_DOES[phase]} resource {me.resource_id} of {name}/{me.server}"
    text = f"{what} waits for {whose}, and is called in it: it would wait for itself; {instead}"
    raise UsageError(text, registrar=name, server=f"{name}/{me.server}", resource_id=me.resource_id)


def _is_under_way(me: Current, phase: Phase) -> bool:
    catalog = serving(me).whole()
    if running(catalog, me.resource_id, phase, me.attempt) is None:
        return False
    return phase is not Phase.LOADED or me.resource_id in catalog.recovering
