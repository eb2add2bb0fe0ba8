"""Isolated calls: a callable that runs in a process of its own, and is killed with it if it does not stop.

The process is a child like all others: the fork server makes it, and it dies with the process that started it. Over
the control socket go single bytes to the child, and the outcome back. The calling thread waits, and looks twenty times
a second whether there is something to say to the child.
"""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

from rr_actors.base import pickling
from rr_actors.runtime import interpreter
from rr_actors.runtime.callback_errors import raised_by
from rr_actors.runtime.processes import lifeline
from rr_actors.runtime.processes.fork_server import Inherited
from rr_actors.runtime.processes.process import Process, Spawner, signal_name
from rr_actors.runtime.time_limits import RunningLimit, RunningTime

_ENTRY = f"{__name__}:main"
_LOOK_S = 0.05
_LENGTH = struct.Struct("Q")
_GO_S = 5.0  # the longest wait for a process that lets its call begin, or has been killed
_STOP, _PAUSE, _RESUME, _GO = b"s", b"p", b"r", b"g"


class Events(NamedTuple):
    """Two requests to the call: to stop soon, and to pause for now."""

    stopping: threading.Event
    pausing: threading.Event


class Outcome(NamedTuple):
    """How a call has ended: with `value`, or with `why` there is none; `trace` is the traceback of what it raised."""

    value: Any = None
    why: str = ""
    trace: str = ""


def run_isolated(
    spawner: Spawner,
    call: bytes,
    events: Events,
    begin: Callable[[Callable[[], None]], bool],
    *,
    name: str,
    timeout_s: float | None,
    grace_s: float,
) -> Outcome:
    """Run a call in a process of its own, and wait for its end. Not for the loop's thread.

    Args:
        call: a pickled callable; it is called with its process's own Events.
        events: what happens to these, happens to the call's.
        begin: called when the process can begin. It calls its argument, which lets the call begin and returns when it
            has, and returns True. Or it returns False: the call does not begin.
        timeout_s: seconds after which the call's `stopping` is set; None: no limit.
        grace_s: seconds that it has to stop; then its process is killed. Both limits leave out standstills.

    Raises:
        StartFailed: there can be no process.
    """
    child = spawner.start(_ENTRY, call, name=name)
    try:
        return _Watch(child, events, timeout_s, grace_s).outcome(begin)
    finally:
        child.kill()
        lifeline.kill_group(child.pid)
        child.wait(_GO_S)  # what it has started in other sessions is found when it is dead
        child.close()
        spawner.sweep()


class _Watch:
    """A running call, as its parent sees it."""

    def __init__(self, child: Process, events: Events, timeout_s: float | None, grace_s: float) -> None:
        self._child, self._events = child, events
        self._timeout_s, self._grace_s = timeout_s, grace_s
        self._ran = RunningTime(_LOOK_S)
        self._began = 0.0
        self._stopped_at: float | None = None
        self._is_pausing = self._is_overdue = self._is_killed = False
        self._got = bytearray()
        child.control.settimeout(_LOOK_S)

    def outcome(self, begin: Callable[[Callable[[], None]], bool]) -> Outcome:
        """Let the call begin; return the outcome when it has come whole, or when there will be none."""
        while not self._got and not self._events.stopping.is_set() and self._child.wait(0.0) is None:
            self._receive()
        del self._got[:1]
        if not begin(self._let_begin):
            return Outcome(why="it was told to stop before it began")
        while not self._is_whole():
            has_ended = self._child.wait(0.0) is not None  # before the last look: what it has sent is there
            if not self._receive():
                if has_ended:
                    return Outcome(why=self._why_none())
                self._child.wait(_LOOK_S)  # its socket may be closed already; a result that came meanwhile is read next
            self._tell()
        return Outcome(*pickling.loads(bytes(self._got[_LENGTH.size :])))

    def _let_begin(self) -> None:
        """Let the call begin, and return when it does, or never will."""
        self._send(_GO)
        limit = RunningLimit(_GO_S)
        while not self._got and not limit.is_over() and self._child.wait(0.0) is None:
            self._receive()
        del self._got[:1]
        self._began = self._ran.read()

    def _is_whole(self) -> bool:
        size = len(self._got) - _LENGTH.size
        return size >= 0 and size >= _LENGTH.unpack_from(self._got)[0]

    def _receive(self) -> bool:
        """Take what has come, and return whether anything has."""
        try:
            data = self._child.control.recv(65_536)
        except OSError:  # nothing has come in time, or the process has ended
            return False
        self._got += data
        return bool(data)

    def _tell(self) -> None:
        now = self._ran.read()
        is_overdue = self._timeout_s is not None and now >= self._began + self._timeout_s
        if self._stopped_at is None and (is_overdue or self._events.stopping.is_set()):
            self._stopped_at, self._is_overdue = now, not self._events.stopping.is_set()
            self._send(_STOP)
        if self._events.pausing.is_set() != self._is_pausing:
            self._is_pausing = not self._is_pausing
            self._send(_PAUSE if self._is_pausing else _RESUME)
        if self._stopped_at is not None and now >= self._stopped_at + self._grace_s and not self._is_killed:
            self._is_killed = self._child.kill()

    def _send(self, what: bytes) -> None:
        try:
            self._child.control.send(what)
        except OSError:  # it has ended, or does not read
            return

    def _why_none(self) -> str:
        if self._is_killed:
            first = f"it was overdue after {self._timeout_s:g} s, and" if self._is_overdue else "it"
            return f"{first} did not end within {self._grace_s:g} s of stopping: its process was killed"
        ended = self._child.wait(0.0)
        code = None if ended is None else ended.code
        if code is None:
            return "its process has ended without a result, nobody knows how"
        how = f"was killed ({signal_name(-code)})" if code < 0 else f"has ended with exit code {code}"
        return f"its process {how} before there was a result"


# -- in the process ------------------------------------------------------------------------------------------------


def main(inherited: Inherited) -> int:
    """Run the call that the payload is, and send its outcome."""
    interpreter.begin()
    interpreter.name_process(f"rr: {inherited.name.rpartition('/')[2]}")
    events = Events(threading.Event(), threading.Event())
    message = _message(inherited, events)
    inherited.control.sendall(_LENGTH.pack(len(message)) + message)
    return 0


def _message(inherited: Inherited, events: Events) -> bytes:
    try:
        try:
            call = pickling.loads(inherited.payload)
        finally:
            _wait_to_begin(inherited.control, events)
        return pickling.dumps((call(events), "", ""), f"the result of {inherited.name}")
    except Exception as error:
        raised = raised_by(error)
        return pickling.dumps((None, raised.text, raised.trace))


def _wait_to_begin(control: socket.socket, events: Events) -> None:
    """Say that the call can begin, wait until the parent lets it, and say that it begins."""
    control.sendall(_GO)
    while control.recv(1) not in (_GO, b""):
        pass  # the parent tells nothing else before it, but it may have ended
    threading.Thread(target=_listen, args=(control, events), name="rr-isolated", daemon=True).start()
    control.sendall(_GO)


def _listen(control: socket.socket, events: Events) -> None:
    """Do what the parent says, until it has ended; the lifeline ends this process then."""
    while said := control.recv(1):
        match said:
            case b"s":
                events.stopping.set()
            case b"p":
                events.pausing.set()
            case _:
                events.pausing.clear()
