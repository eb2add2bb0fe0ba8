"""The context of a running callback: for which resource and which attempt it runs.

A load inside the callback belongs to that resource. The context is a contextvar: tasks and asyncio.to_thread inherit
it. Threads that a callback starts by hand do not; they pass ``parent=rr.current()``.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextvars import ContextVar

import msgspec

from rr_actors.actors.messaging.ask_cycles import asker
from rr_actors.base.errors import UsageError
from rr_actors.base.names import NAME_LIMIT, named
from rr_actors.base.values.canonical import text_of_value
from rr_actors.registrar.core.callback_runs import running
from rr_actors.registrar.engine.progress import checked
from rr_actors.registrar.engine.registrar_base import RegistrarBase
from rr_actors.registrar.model.roles import ROLES, STATUS, USAGE, Role
from rr_actors.registrar.model.rows import LOADED
from rr_actors.streams.publisher import Publisher


class Current(msgspec.Struct, frozen=True):
    """The call of a callback, as the callback may know it; or the message that a handler of an actor handles.

    Of a message it has `origin` alone, "" or False is in the other attributes, and `attempt` is 1.

    Attributes:
        resource_id: the resource that the callback loads, unloads, or hears about.
        attempt: 1 at first; more if a crash interrupted an earlier attempt.
        origin: the name of the registrar that holds the resource: of its present holders, the one that asked first. Of
            a message: who asks, an actor whose handler waits for the answer, "connection.NAME" as
            ConnectedRegistrar.ask() says, or "connection.pid-4711" of Connection.ask(). "" for a tell(), an
            ask without waiting, and for code of no handler.
        server: the server's name, as it was registered.
        interrupted: in an unload callback, whether the load callback never returned; the response is None then. The
            load was withdrawn or given up after a crash. Nothing, a part or all of the resource may have been loaded.
    """

    # `_registrar` is the actor of the serving registrar. `_run` is the number of the run in decisions: of a load,
    # a recovery, a pause or a resumption its load's, of an unload its own.

    resource_id: str
    attempt: int
    origin: str
    server: str
    _registrar: RegistrarBase | None  # None: of a message
    _role: Role
    _run: int
    interrupted: bool = False
    _request: bytes = b""
    _runs_again: bool = True  # a callback runs after a crash of the manager

    @property
    def name(self) -> str:
        """The resource's name for people, its server and its request, or that's title: `cameras/camera "/dev/video7"`.

        It is shortened to 500 characters. "" for a message.
        """
        if self._registrar is None:
            return ""
        title = self._registrar.titles.get(self.server)
        return named(self._place, (title and title(self._request)) or text_of_value(self._request), NAME_LIMIT)

    @property
    def _place(self) -> str:
        return f"{serving(self).name}/{self.server}"

    def progress(self, fraction: float, text: str = "") -> None:
        """Report how far the load has come, in its load or recover callback, from any thread.

        All consumers that wait for the load hear it (`progress=` of Registrar.load). At most ten reports a second are
        sent: the newest ones, and always the last. A report does not wait, may be lost, and is not kept.

        Args:
            fraction: from 0.0 to 1.0.
            text: what the callback does now, for people; at most 500 characters.

        Raises:
            UsageError: `fraction` or `text` is something else, or this is an unload or status callback.
        """
        number, words = checked(fraction, text)
        if not self._role.reports:
            what = f"{self._place}: progress() in its {self._role.name} callback"
            allowed = " and ".join(role.name for role in ROLES.values() if role.reports)
            raise UsageError(f"{what}: only {allowed} callbacks report it")
        serving(self).progress.report(self.resource_id, number, words)

    @property
    def stopping(self) -> threading.Event:
        """The event that tells a load or recover callback that it may give up: nobody needs its result any more.

        It is set when all who waited for the load have withdrawn it, and when the callback is overdue. It is set when
        the registrar is closed, as when its process stops. The callback is not interrupted: it waits or asks, as in
        ``while not rr.current().stopping.wait(0.1)``, cleans up, and raises. If the load succeeds, it is not set. An
        ``async def`` callback need not ask: it is cancelled then.

        If somebody asks for the resource again before a stopped callback has raised, the callback runs once more.

        Raises:
            UsageError: this is another callback.
        """
        phase = self._role.phase
        if phase is None or not self._role.reports:
            what = f"{self._place}: stopping in its {self._role.name} callback"
            raise UsageError(f"{what}: only load and recover callbacks have it")
        return serving(self).stop_event(self.resource_id, phase, self._run)

    @property
    def loaded(self) -> threading.Event:
        """The event that is set when the load is over, for a thread that its load or recover callback has started.

        The response is on disk then, and can be replaced (`update_response`). It is set as well when the load has
        failed, or the registrar is closed: what the thread calls then raises.

        Raises:
            UsageError: this is another callback.
        """
        if not self._role.reports:
            what = f"{self._place}: loaded in its {self._role.name} callback"
            raise UsageError(f"{what}: only load and recover callbacks have it")
        return serving(self).load_over(self.resource_id)

    def open_stream(self, name: str = "stream") -> Publisher:
        """Open a stream of the resource, in its load or recover callback: its holders read it with Query.stream().

        It is closed when the unload callback has returned. After a crash of the manager, open it again in the callback
        that runs then: those who read it go on. With recovery="keep" and no recover callback, none runs: the log says
        so, and the iterations of those who read it end with Unavailable, thirty seconds after a crash.

        Raises:
            InvalidName: `name` is none.
            NameTaken: the resource has a stream of this name. `.name`
            UsageError: no load or recover callback of the resource runs here.
            Unavailable: there can be no socket or no thread for it.
        """
        if not self._role.reports or _current.get() is not self:
            place = "outside" if self._role.reports else "in"
            what = f"{self._place}: open_stream() {place} its {self._role.name} callback"
            raise UsageError(f"{what}: only load and recover callbacks open streams, while they run")
        once = "" if self._runs_again else self._place
        return serving(self).publishers.open(self.resource_id, name, once)


_current: ContextVar[Current | None] = ContextVar("rr_current", default=None)


_MESSAGE = Role("message", ())


def current() -> Current:
    """Return the context of the callback that this code runs in, or of the message that it handles.

    Raises:
        UsageError: this code runs in neither.
    """
    context = _current.get()
    if context is not None:
        return context
    if (origin := asker()) is not None:
        return Current("", 1, origin, "", None, _MESSAGE, 0)
    callbacks = ", ".join(role.name for role in ROLES.values())
    raise UsageError(f"rr.current(): expected to be called in a callback ({callbacks}), or by a handler of messages")


current_or_none: Callable[[], Current | None] = _current.get
"""Return the context of the callback that this code runs in; None outside of callbacks."""


def serving(current: Current) -> RegistrarBase:
    """Return the actor of the registrar that runs the callback.

    Raises:
        UsageError: it is the context of a message, which is of no resource.
    """
    registrar = current._registrar  # pyright: ignore[reportPrivateUsage]  # same file
    if registrar is None:
        raise UsageError("rr.current(): expected that of a callback, got that of a message, which has no resource")
    return registrar


def _run_of(current: Current) -> int:
    return current._run  # pyright: ignore[reportPrivateUsage]  # same file


def _role_of(current: Current) -> Role:
    return current._role  # pyright: ignore[reportPrivateUsage]  # same file


enter: Callable[[Current], object] = _current.set
"""Make current() return this context from now on, in the context of the callback."""


def status_callback_of(registrar: RegistrarBase) -> str:
    """Return the id of the resource whose status callback this code runs in, if the registrar serves it; else ""."""
    me = _current.get()
    return me.resource_id if me is not None and _role_of(me) is STATUS and serving(me) is registrar else ""


def check_not_measuring(registrar: RegistrarBase) -> None:
    """Raise UsageError in a usage callback of the registrar: it would ask for its own end."""
    me = _current.get()
    if me is not None and _role_of(me) is USAGE and serving(me) is registrar:
        text = f"{registrar.name}/{me.server}: usage() in its usage callback: it would wait for itself"
        raise UsageError(text, registrar=registrar.name, resource_id=me.resource_id)


def check_not_own(what: str, waits_for: Callable[[Current], bool], instead: str) -> None:
    """Raise if `what` would wait for the callback that this code runs in.

    A task that runs on after its callback has returned may wait.

    Args:
        waits_for: whether the call waits for such a callback while that runs. Called with the lock of its registrar.
        instead: what to do instead, for the error's text.

    Raises:
        UsageError: the call would wait for itself. `.registrar`, `.server`, `.resource_id`
    """
    me = _current.get()
    if me is None or (phase := _role_of(me).phase) is None or serving(me).closed:
        return
    with serving(me).lock:
        catalog = serving(me).whole()
        is_running = running(catalog, me.resource_id, phase, _run_of(me)) is not None
        if not is_running or (phase is LOADED and me.resource_id not in catalog.recovering) or not waits_for(me):
            return
    name = serving(me).name
    whose = f"the callback that {_role_of(me).name}s resource {me.resource_id} of {name}/{me.server}"
    text = f"{what} waits for {whose}, and is called in it: it would wait for itself; {instead}"
    raise UsageError(text, registrar=name, server=f"{name}/{me.server}", resource_id=me.resource_id)
