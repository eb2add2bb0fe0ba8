"""A manager under test: a subclass of the user's class that notes its callbacks, and dies where a scenario says so.

Everything here runs in the manager's process.
"""

from __future__ import annotations

import contextlib
import functools
import json
import linecache
import os
import signal
import sys
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Generator
from pathlib import Path
from types import FrameType, FunctionType, TracebackType
from typing import Any, ClassVar

import msgspec

from rr_actors.base.errors import shown
from rr_actors.registrar.engine.server import Callback, ServerSpec
from rr_actors.registrar.manager import Manager
from rr_actors.registrar.model.roles import LOAD, RECOVER, ROLES, UPGRADE, Role
from rr_actors.registrar.servers.callback_context import current_or_none
from rr_actors.runtime.workers import is_async
from rr_actors.testing.callback_notes import Note, begin_notes
from rr_actors.testing.seen_manager import SeenManager

ARM, CENSUS = "arm", "census"
"""Files of the directory: which callback dies next, as "server role line"; and what is asked of a process, its id."""
_LINGER_S = 0.05
_LOOK_S = 0.02
_OURS = ("rr-", "ThreadPoolExecutor", "asyncio_", "pykka")


class Watch(msgspec.Struct, frozen=True):
    """What the manager under test is given.

    Attributes:
        directory: of the notes.
        callback_s: how long a callback may take.
        same: whether a recover callback has returned the response that there was.
    """

    directory: str
    callback_s: float
    same: Callable[[Any, Any], bool]


class WatchedManager(SeenManager):
    """The base of the class that check_manager() makes of the user's class, which is its second base."""

    _rr_watch: ClassVar[Watch]

    def _rr_adapted(self, spec: ServerSpec) -> ServerSpec:
        return _watcher(self._rr_watch).watched(super()._rr_adapted(spec))


def watched_class(cls: type[Manager], watch: Watch) -> type[Manager]:
    """Return a subclass of a class of managers whose callbacks are noted. It travels by value."""
    names = {
        "_rr_watch": watch,
        "_rr_notes": watch.directory,
        "__module__": __name__,
        "__qualname__": f"watched.{cls.__qualname__}",
    }
    return type(cls)(cls.__name__, (WatchedManager, cls), names)


class _Running(msgspec.Struct):
    """A callback that runs."""

    note: Note
    thread: int
    began: float
    limit_s: float
    is_named: bool = False


class _Watcher:
    """Notes the callbacks of this process."""

    def __init__(self, watch: Watch) -> None:
        self._directory, self._same, self._callback_s = Path(watch.directory), watch.same, watch.callback_s
        self._notebook = begin_notes(watch.directory)
        self._running: dict[int, _Running] = {}
        self._threads: list[threading.Thread] = []
        self._notebook.write("started")
        self._note_threads()
        threading.Thread(target=self._look, name="rr-watch-callbacks", daemon=True).start()

    def watched(self, spec: ServerSpec) -> ServerSpec:
        """Return a server whose callbacks are noted, and which lingers hardly."""
        roles = {field: role for field, role in ROLES.items() if role is not UPGRADE and getattr(spec, field)}
        facts = {"roles": sorted(role.name for role in roles.values()), "idle": spec.idle, "exclusive": spec.exclusive}
        self._notebook.write("server", text=json.dumps(facts), server=spec.name)
        watched = {field: self._noted(getattr(spec, field), role, spec) for field, role in roles.items()}
        return msgspec.structs.replace(spec, linger_s=min(spec.linger_s, _LINGER_S), **watched)

    def _noted(self, callback: Callback, role: Role, spec: ServerSpec) -> Callback:
        limit_s = (role is LOAD and spec.load_timeout_s) or self._callback_s
        if is_async(callback):

            @functools.wraps(callback)
            async def noted_async(*given: Any, **fields: Any) -> Any:
                with self._run(callback, role, limit_s):
                    return self._answered(role, given, fields, await callback(*given, **fields))

            return noted_async

        @functools.wraps(callback)
        def noted(*given: Any, **fields: Any) -> Any:
            with self._run(callback, role, limit_s):
                return self._answered(role, given, fields, callback(*given, **fields))

        return noted

    def _answered(self, role: Role, given: tuple[Any, ...], fields: dict[str, Any], answer: Any) -> Any:
        """Note a recover callback that returns another response than it got: its last argument."""
        if role is RECOVER:
            before = fields["response"] if "response" in fields else given[-1] if given else answer
            if not self._same(before, answer):
                self._notebook.write("changed", role.name, f"it got {shown(before)}, and returned {shown(answer)}")
        return answer

    @contextlib.contextmanager
    def _run(self, callback: Callback, role: Role, limit_s: float) -> Generator[None]:
        now = current_or_none()
        place = ("", "", "", 0) if now is None else (now.server, now.resource_id, now.name, now.attempt)
        note = Note(os.getpid(), "begin", role.name, *place)
        self._notebook.append(note)
        running = _Running(note, threading.get_ident(), time.monotonic(), limit_s)
        self._running[id(running)] = running
        death = self._armed(callback, note)
        before = sys.gettrace()
        try:
            if death is not None:
                sys.settrace(death.trace)
            yield
        except BaseException as error:
            sys.settrace(before)
            text = "".join(traceback.format_exception(type(error), error, _of_user(error.__traceback__)))
            self._notebook.append(msgspec.structs.replace(note, what="raised", text=text))
            raise
        else:
            sys.settrace(before)
            self._notebook.append(msgspec.structs.replace(note, what="end"))
            if death is not None:
                death.die("its end")
        finally:
            self._running.pop(id(running), None)

    def _armed(self, callback: Callback, note: Note) -> _Death | None:
        """Return where this run dies, if the scenario says so."""
        arm = self._directory / ARM
        try:
            server, role, line = arm.read_text().split()
            if (role, server) != (note.role, note.server) and (role, server) != (note.role, "-"):
                return None
            arm.unlink()
        except (FileNotFoundError, ValueError):
            return None
        return _Death(self._notebook.append, note, callback, int(line))

    def _note_threads(self) -> None:
        """Note the threads that callbacks start: what is left of them when nothing is loaded is left behind."""
        start = threading.Thread.start

        @functools.wraps(start)
        def noted_start(thread: threading.Thread) -> None:
            start(thread)
            now = current_or_none()
            if now is not None and now.resource_id and not thread.name.startswith(_OURS):
                self._threads.append(thread)

        setattr(threading.Thread, "start", noted_start)  # noqa: B010 - `self` has another name

    def _look(self) -> None:
        census = self._directory / f"{CENSUS}{os.getpid()}"
        while True:
            time.sleep(_LOOK_S)
            now = time.monotonic()
            for running in list(self._running.values()):
                if not running.is_named and now - running.began > running.limit_s:
                    running.is_named = True
                    frame = sys._current_frames().get(running.thread)  # pyright: ignore[reportPrivateUsage]
                    stack = "".join(traceback.format_stack(frame)[-6:]) if frame is not None else ""
                    text = f"{stack}not returned within {running.limit_s:g} s"
                    self._notebook.append(msgspec.structs.replace(running.note, what="blocked", text=text))
            if census.exists():
                census.unlink(missing_ok=True)
                self._notebook.write(
                    "census", text=json.dumps({"threads": self._left_threads(), "files": self._files()})
                )

    def _left_threads(self) -> dict[str, int]:
        self._threads = [thread for thread in self._threads if thread.is_alive()]
        return dict(Counter(thread.name.partition("-")[0] + _target_of(thread) for thread in self._threads))

    def _files(self) -> dict[str, int]:
        """Count the open files and devices of this process by their paths, without those of the package."""
        others = ("/proc/", "/memfd:", "/dev/null", "/dev/shm/", os.path.realpath(self._directory))
        found: Counter[str] = Counter()
        for entry in os.scandir("/proc/self/fd"):
            with contextlib.suppress(OSError):
                path = os.readlink(entry.path)
                if path.startswith("/") and not path.startswith(others) and not path.endswith(" (deleted)"):
                    found[path] += 1
        return dict(found)


_watcher = functools.cache(_Watcher)


def _target_of(thread: threading.Thread) -> str:
    target = getattr(thread, "_target", None)
    return f" ({getattr(target, '__qualname__', type(target).__name__)})"


def _of_user(trace: TracebackType | None) -> TracebackType | None:
    """Return a traceback without the frames of this module at its beginning."""
    while trace is not None and trace.tb_frame.f_code.co_filename == __file__:
        trace = trace.tb_next
    return trace


class _Death:
    """SIGKILL at the n-th line that a callback runs, or at its end if it has fewer lines.

    Args:
        append: appends a note.
        left: how many lines run before.
    """

    def __init__(self, append: Callable[[Note], None], note: Note, callback: Callback, left: int) -> None:
        self._append, self._note, self._left = append, note, left
        self._files = set(_files_of(callback))

    def trace(self, frame: FrameType, event: str, _argument: object) -> Any:
        """Trace the calls of the callback's own file; a function for sys.settrace()."""
        if frame.f_code.co_filename not in self._files:
            return None
        return self._line

    def _line(self, frame: FrameType, event: str, _argument: object) -> Any:
        if event == "line":
            if self._left == 0:
                file, line = frame.f_code.co_filename, frame.f_lineno
                self.die(f"{os.path.basename(file)}:{line}, before: {linecache.getline(file, line).strip()}")
            self._left -= 1
        return self._line

    def die(self, where: str) -> None:
        """Note it, and end this process."""
        self._append(msgspec.structs.replace(self._note, what="killed", text=where))
        os.kill(os.getpid(), signal.SIGKILL)


def _files_of(callback: Callback) -> Generator[str]:
    """Yield the files of a callback's code."""
    left: list[Any] = [callback]
    while left:
        found = left.pop()
        if isinstance(found, functools.partial):
            left += [found.func, *found.args[:1]]
            continue
        function = getattr(found, "__func__", found)
        if (wrapped := getattr(function, "__wrapped__", None)) is not None:
            left.append(wrapped)
        elif isinstance(function, FunctionType):
            yield function.__code__.co_filename
