"""The stage: a real system with the manager under test, on which scenarios are played one after another.

Its fork server and its other children stay. Each scenario has a new process of the manager, and nothing is loaded when
it begins. After a fault all is ended, and made anew.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import shutil
import signal
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from rr_actors.base import pickling
from rr_actors.base.config import SystemConfig
from rr_actors.base.errors import (
    LoadError,
    NotHolder,
    NotSerializable,
    ResourceBusy,
    ResourceLost,
    RrError,
    StartFailed,
    Unavailable,
    UnknownQuery,
    UnloadFailed,
    UsageError,
    shown,
)
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query, Status
from rr_actors.supervision.core.specs import ChildSpec, Supervisor
from rr_actors.system.system import System
from rr_actors.testing import scenario_steps as s
from rr_actors.testing import watched_manager
from rr_actors.testing.callback_notes import Note, NoteReader
from rr_actors.testing.scenario_notes import (
    AGAIN,
    LEFT,
    LIMIT,
    LIVES,
    REFUSED,
    Fault,
    faults_of_callbacks,
    faults_of_devices,
    faults_of_runs,
    has_ended,
    process_of,
    runs_in,
)
from rr_actors.testing.seen_manager import TOGETHER
from rr_actors.testing.started_systems import LIMIT_S, VARIABLE, marked
from rr_actors.testing.watched_manager import ARM, CENSUS, Watch, watched_class

_RESTART_S = 20.0  # for a new process of the manager, on a machine that does much else
_BEGIN_S = 2.0
_CLEAR_S = _STOP_S = 0.5
_PAUSE_S = 0.004
_MANY = 1_000_000
_APP = "check"

T = TypeVar("T")


@dataclass(frozen=True)
class Setup:
    """What is checked.

    Attributes:
        child: the manager.
        beside: children that start before it.
        callback_s: how long a callback may take.
        same: whether two responses are the same.
        config: of the system.
    """

    child: ChildSpec
    beside: Sequence[ChildSpec | Supervisor]
    callback_s: float
    same: Callable[[Any, Any], bool]
    config: SystemConfig | None = None


class ServerFacts(msgspec.Struct, frozen=True):
    """A server of the manager, as its process has registered it.

    Attributes:
        roles: the callbacks that it has.
    """

    roles: frozenset[str]
    idle: str
    exclusive: bool


class _Broken(Exception):
    """The scenario ends here."""

    def __init__(self, fault: Fault, refused: s.Load | None = None) -> None:
        super().__init__(fault.promise)
        self.fault, self.refused = fault, refused


class _Held:
    """A query that the scenario holds."""

    def __init__(self, query: Query[Any], step: s.Load) -> None:
        self.query, self.step = query, step


class Stage:
    """Plays scenarios. A context manager: at its end nothing is left.

    Attributes:
        kills: the number of SIGKILLs that have met the manager.
        loads, loaded: how many loads were made, and how many of them succeeded.
        refusal: the last error of a load.
        story: the notes of the last scenario.

    Raises:
        UsageError: the manager cannot be started.
    """

    def __init__(self, setup: Setup) -> None:
        self._setup = setup
        self.kills = self.loads = self.loaded = 0
        self.refusal: RrError | None = None
        self.story: list[Note] = []
        self._refused: set[bytes] = set()
        self._allowed: dict[str, int] = {}
        self._learns = False
        self._run: _Run | None = None

    def __enter__(self) -> Stage:
        return self

    def __exit__(self, *exc: object) -> None:
        self._close()

    def _close(self) -> None:
        run, self._run = self._run, None
        if run is not None:
            run.close()

    def _open(self) -> _Run:
        if self._run is None:
            self._run = _Run(self._setup)
        return self._run

    @property
    def servers(self) -> Mapping[str, ServerFacts]:
        """The servers of the manager, by name."""
        return self._open().servers

    def play(self, steps: Sequence[s.Step]) -> Fault | None:
        """Play a scenario, and return the fault that it shows; None if there is none.

        A load that is refused is a fault if a fresh manager loads the same. Threads and open files that are left are a
        fault if they are more than one load and unload of the same in a fresh manager leaves.
        """
        fault, refused, census = self._play(steps)
        story = list(self.story)
        if refused is not None:
            again = s.Load(refused.server, refused.request)
            if self._play([again])[1] is not None:
                self._refused.add(_key(again))
                fault = None
        elif census:
            self._learns = True
            loads = {_key(load): load for step in steps for load in _loads(step)}
            for step in loads.values():
                self._play([s.Load(step.server, step.request), s.Unload()])
            self._learns = False
            left = {what: count for what, count in census.items() if count > self._allowed.get(what, 0)}
            fault = _left(left) if left else None
        self.story = story
        return fault

    def _play(self, steps: Sequence[s.Step]) -> tuple[Fault | None, s.Load | None, dict[str, int]]:
        """Return the fault, the load that was refused, and what is left."""
        run = self._open()
        fault, refused, left = None, None, dict[str, int]()
        try:
            run.begin(self._refused)
            try:
                for step in steps:
                    run.take(step)
            except _Broken as broken:
                if broken.refused is None:
                    raise
                fault, refused = broken.fault, broken.refused
            left = run.end()
        except _Broken as broken:
            fault, refused = broken.fault, None
        self.story = run.notes
        self.kills += run.kills
        self.loads, self.loaded = self.loads + run.loads, self.loaded + run.loaded
        self.refusal = run.refusal or self.refusal
        if self._learns:
            self._allowed |= {what: max(count, self._allowed.get(what, 0)) for what, count in left.items()}
        if fault is not None and refused is None and not (fault.promise != LIMIT and run.clear()):
            self._close()
        left = {what: count for what, count in left.items() if count > self._allowed.get(what, 0)}
        return (_left(left) if left and fault is None else fault), refused, left if fault is None else {}


def _left(left: Mapping[str, int]) -> Fault:
    listed = ", ".join(f"{what}" + (f" ({count} times)" if count > 1 else "") for what, count in sorted(left.items()))
    return Fault(LEFT, f"the manager's process still has: {listed}")


def _key(step: s.Load) -> bytes:
    return pickling.dumps((step.server, step.request))


def _loads(step: s.Step) -> list[s.Load]:
    """Return the loads that a step makes."""
    if isinstance(step, s.LoadTogether):
        return [s.Load(step.server, request) for request in step.requests]
    return [step] if isinstance(step, s.Load) else []


def _modules(child: ChildSpec) -> list[str]:
    """Return the modules that the fork server imports once, so that no start of the manager does."""
    own = child.actor_class_or_manager.__module__
    return [watched_manager.__name__, *([own] if own in sys.modules and own != "__main__" else [])]


class _Run:
    """A running system with the manager, and the scenario that is played on it."""

    def __init__(self, setup: Setup) -> None:
        self._setup, self._id = setup, setup.child.id
        self._directory = Path(tempfile.mkdtemp(prefix="rr-check-"))
        self._reader = NoteReader(self._directory)
        self._before = os.environ.get(VARIABLE)
        self._mark = os.environ[VARIABLE] = uuid.uuid4().hex
        self._threads: list[threading.Thread] = []
        self._killed: set[int] = set()
        self._held: list[_Held] = []
        self._judges = True
        self.kills = self.loads = self.loaded = 0
        self.refusal: RrError | None = None
        cls = watched_class(
            setup.child.actor_class_or_manager,  # pyright: ignore[reportArgumentType] - check_manager looks at it
            Watch(str(self._directory), setup.callback_s, setup.same),
        )
        child = replace(setup.child, actor_class_or_manager=cls, placement="process", restart="permanent")
        tree = Supervisor([*setup.beside, child], max_restarts=_MANY)
        config = setup.config or SystemConfig()
        config = replace(config, preload=(*config.preload, *_modules(setup.child)))
        self._system = System(tree, name="check", state_dir=self._directory / "state", config=config)
        try:
            self._start(child)
        except BaseException:
            self.close()
            raise

    def _start(self, child: ChildSpec) -> None:
        name = getattr(self._setup.child.actor_class_or_manager, "__qualname__", "")
        try:
            self._system.start()
        except NotSerializable as error:
            expected = "expected a manager and arguments that can travel to another process"
            raise UsageError(f"check_manager: {name}: {expected}: {error}") from error
        except RrError as error:
            raise UsageError(f"check_manager: {name}: expected a manager that starts, got: {error}") from error
        self._app = self._system.open_registrar(_APP)
        facts = {note.server: json.loads(note.text) for note in self._reader.read() if note.what == "server"}
        self.servers = {server: msgspec.convert(found, ServerFacts) for server, found in facts.items()}
        self._handle = self._system.registrar(self._id)
        self._first = 0
        self._seen: set[Note] = set()
        self._stop_child()
        self._others = set(marked(self._mark))

    def close(self) -> None:
        """End the system, and all that its processes have started."""
        pid = process_of(self._reader.read())
        with contextlib.suppress(RrError, ProcessLookupError):
            if pid:
                self._system.ref(self._id).kill()
        with contextlib.suppress(RrError, OSError):
            self._system.stop(timeout_s=_STOP_S)
        for text in marked(self._mark):
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(text.split()[1]), signal.SIGKILL)
        for thread in self._threads:
            thread.join(LIMIT_S)
        self._reader.close()
        shutil.rmtree(self._directory, ignore_errors=True)
        if self._before is None:
            os.environ.pop(VARIABLE, None)
        else:
            os.environ[VARIABLE] = self._before

    # -- a scenario --------------------------------------------------------------------------------------------------

    @property
    def notes(self) -> list[Note]:
        """The notes of this scenario."""
        return self._reader.read()[self._first :]

    def begin(self, refused: set[bytes]) -> None:
        """Start a new process of the manager."""
        self._refused = refused
        self._held.clear()
        self._faulty: set[str] = set()  # resources that were FATAL
        self.kills = self.loads = self.loaded = 0
        self._first = self._step_from = len(self._reader.read())
        try:
            self._system.supervisor().restart_child(self._id)
        except StartFailed as error:
            raise _Broken(Fault(LIVES, f"the next process of the manager did not start: {error}")) from error
        self._handle = self._system.registrar(self._id)
        self._settle()

    def take(self, step: s.Step) -> None:
        """Take a step.

        Raises:
            _Broken: a promise is broken.
        """
        self._step_from = len(self._reader.read())
        match step:
            case s.Load():
                self._load(step)
            case s.Wrong(server, request):
                self._wrong(server, request)
            case s.LoadTogether():
                self._load_together(step)
            case s.UnloadTogether():
                self._unload_together()
            case s.Kill():
                self._kill(step.kill_at)
            case s.AskUsage():
                self._arm("-", step)
                self._try(self._handle.usage)
            case s.Unload() if self._held:
                self._unload(self._held.pop(step.which % len(self._held)), step)
            case s.SendStatus() | s.Fatal() | s.Update() | s.Reload() | s.Pause() | s.Resume() if self._held:
                self._act(self._held[step.which % len(self._held)], step)
            case _:
                return
        self._settle()

    def end(self) -> dict[str, int]:
        """Release all, and end the manager's process; return the threads and files that it had then.

        Raises:
            _Broken: a promise is broken.
        """
        while self._held:
            self._step_from = len(self._reader.read())
            self._unload(self._held.pop(0), s.Unload())
        self._settle()
        if left := self._unload_rest(self._setup.callback_s + LIMIT_S):
            raise _Broken(Fault(LEFT, f"loaded, and held by nobody: {', '.join(left)}"))
        self._settle()
        pid = process_of(self.notes)
        census = self._census(pid)
        self._judge(faults_of_devices(self.notes, pid))
        unloads = {server for server, facts in self.servers.items() if "unload" in facts.roles}
        self._judge(faults_of_runs(self.notes, unloads))
        self._stop_child()
        deadline = time.monotonic() + LIMIT_S
        while (processes := set(marked(self._mark)) - self._others) and time.monotonic() < deadline:
            time.sleep(_PAUSE_S)
        if processes:
            raise _Broken(Fault(LEFT, f"the manager has ended, and left: {'; '.join(sorted(processes))}"))
        return census

    def clear(self) -> bool:
        """After a fault, end the manager's process; return whether the next scenario may be played here."""
        if any((note.what, note.role) == ("raised", "unload") for note in self.notes):
            return False  # it stays
        self._judges = False
        try:
            for held in self._held:
                self._try(functools.partial(held.query.unload, timeout_s=LIMIT_S))
            is_clear = not self._unload_rest(_CLEAR_S) and not self._app.queries()
            self._stop_child()
            return is_clear and set(marked(self._mark)) <= self._others
        except (RrError, _Broken):
            return False
        finally:
            self._judges = True

    def _unload_rest(self, patience_s: float) -> list[str]:
        """Wait until nothing is loaded, and unload by force what is paused; return what stays."""
        deadline = time.monotonic() + patience_s
        while left := self._do(self._handle.resources):
            late = time.monotonic() > deadline
            for resource in left:
                if late or resource.phase in ("paused", "unload_failed"):
                    self._try(functools.partial(self._handle.unload, resource.id, force=True, timeout_s=LIMIT_S))
            if late:
                break
            time.sleep(_PAUSE_S)
        return [f"{resource.server} {shown(resource.request)}" for resource in self._do(self._handle.resources)]

    def _census(self, pid: int) -> dict[str, int]:
        """Ask the process what is left, until nothing is, for a second at most."""
        deadline = time.monotonic() + 1.0
        while True:
            self._step_from = len(self._reader.read())
            (self._directory / f"{CENSUS}{pid}").touch()
            answer = self._until(self._answer, LIMIT_S)
            if answer is None:
                return {}
            found = json.loads(answer.text)
            census = {f"thread {name}": count for name, count in found["threads"].items()}
            census |= {f"open file {name}": count for name, count in found["files"].items()}
            if not found["threads"] or time.monotonic() > deadline:
                return census
            time.sleep(0.05)

    def _answer(self) -> Note | None:
        return next((note for note in self._reader.read()[self._step_from :] if note.what == "census"), None)

    def _stop_child(self) -> None:
        self._system.supervisor().terminate_child(self._id)

    # -- steps -------------------------------------------------------------------------------------------------------

    def _arm(self, server: str, step: Any) -> None:
        if step.kill_at is not None:
            arm = self._directory / f"{ARM}.new"
            arm.write_text(f"{server} {step.role} {step.kill_at}")
            arm.rename(self._directory / ARM)

    def _load(self, step: s.Load) -> None:
        self._arm(step.server, step)
        self.loads += 1
        options: dict[str, Any] = {"wait_s": 0.0} if self.servers[step.server].exclusive else {}
        options["timeout_s"] = 2 * self._setup.callback_s + 2 * _RESTART_S
        load: Any = self._app.load
        try:
            query: Query[Any] = self._do(lambda: load(f"{self._id}/{step.server}", step.request, **options))
        except ResourceBusy:
            return
        except (LoadError, UsageError, ResourceLost) as error:
            self._take_refusal(step, error)
            return
        self.loaded += 1
        self._held.append(_Held(query, step))

    def _load_together(self, step: s.LoadTogether) -> None:
        loads = list({_key(load): load for load in _loads(step)}.values())
        if self.servers[step.server].exclusive:
            loads = loads[:1]
        with self._meeting(step.role, len(loads)):
            errors = self._at_once([functools.partial(self._load, load) for load in loads])
        for error in errors:
            raise error

    def _unload_together(self) -> None:
        held, self._held = self._held, []
        resources = {one.query.resource_id for one in held}
        with self._meeting("unload", len(resources)):
            errors = self._at_once([functools.partial(self._unload, one, s.Unload()) for one in held])
        for error in errors:
            raise error

    @contextlib.contextmanager
    def _meeting(self, role: str, count: int) -> Generator[None]:
        """Have the callbacks of a role wait for each other, so that they run at the same time."""
        path = self._directory / TOGETHER
        new = path.with_suffix(".new")
        new.write_text(f"{role} {count} {uuid.uuid4().hex}")
        new.rename(path)
        try:
            yield
        finally:
            path.unlink()

    def _at_once(self, calls: Sequence[Callable[[], None]]) -> list[Exception]:
        """Make calls in threads, and return what they raise."""
        errors = list[Exception]()

        def work(call: Callable[[], None]) -> None:
            try:
                call()
            except Exception as error:
                errors.append(error)

        threads = [threading.Thread(target=work, args=(call,), name="check-manager", daemon=True) for call in calls]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return errors

    def _take_refusal(self, step: s.Load, error: RrError) -> None:
        self.refusal = error
        if _key(step) in self._refused or self._has_faulty(step):
            return  # of a device that has one user, the resource that is FATAL may be it
        text = f"{self._id}/{step.server} {shown(step.request)}: {error}"
        raise _Broken(Fault(AGAIN, text), s.Load(step.server, step.request))

    def _has_faulty(self, step: s.Load) -> bool:
        return any(it.query.resource_id in self._faulty and _key(it.step) == _key(step) for it in self._held)

    def _wrong(self, server: str, request: Any) -> None:
        try:
            query = self._do(
                lambda: self._app.load(
                    f"{self._id}/{server}", request, timeout_s=2 * self._setup.callback_s + _RESTART_S
                )
            )
        except (LoadError, UsageError):
            return
        text = f"expected {self._id}/{server} to refuse {shown(request)}, and it answered {shown(query.response)}"
        raise _Broken(Fault(REFUSED, text))

    def _unload(self, held: _Held, step: s.Unload) -> None:
        server, resource = held.step.server, held.query.resource_id
        facts = self.servers[server]
        self._arm(server, step)
        with contextlib.suppress(UnloadFailed, UnknownQuery, NotHolder, ResourceLost, Unavailable):
            self._do(lambda: held.query.unload(timeout_s=2 * self._setup.callback_s + 2 * _RESTART_S))
        if all(other.query.resource_id != resource for other in self._held):
            if "unload" in facts.roles and facts.idle == "unload":
                self._await("unload", resource)
            self._faulty.discard(resource)

    def _act(self, held: _Held, step: s.Step) -> None:
        query, server = held.query, held.step.server
        resource, facts = query.resource_id, self.servers[server]
        if query.state == State.FATAL or query.released:
            return
        match step:
            case s.SendStatus() | s.Update():
                self._arm(server, step)
                if isinstance(step, s.Update):
                    self._try(lambda: self._handle.update_response(resource, query.response, "check_manager"))
                else:
                    status = Status(State(step.state), "check_manager")
                    self._try(lambda: self._handle.send_status(resource, status))
                if "status" in facts.roles:
                    self._await("status", resource)
            case s.Fatal():
                self._faulty.add(resource)
                self._try(lambda: self._handle.send_status(resource, Status(State.FATAL, "check_manager")))
                self._settle()
                self._load(s.Load(server, held.step.request))
            case s.Reload():
                try:
                    self._try(lambda: self._handle.reload(resource, timeout_s=2 * self._setup.callback_s + _RESTART_S))
                except LoadError as error:
                    self._take_refusal(held.step, error)
            case s.Pause() | s.Resume() if facts.idle == "pause":
                self._arm(server, step)
                for other in self._held:
                    if other.query.resource_id == resource:
                        other.query.priority = 0 if isinstance(step, s.Resume) else None
                self._await(step.role, resource)
            case _:
                pass

    def _kill(self, recover_at: int | None) -> None:
        self._arm("-", s.Kill(recover_at))
        pid = process_of(self.notes)
        self._killed.add(pid)
        here = self._system.supervisor()
        if self._until(lambda: here.which_child(self._id).kill() or None, _RESTART_S) is None:
            raise _Broken(Fault(LIMIT, "the manager has no process that could be killed"))
        self.kills += 1
        self._until(lambda: process_of(self.notes) not in (pid, 0) or None, _RESTART_S)

    # -- waiting -----------------------------------------------------------------------------------------------------

    def _try(self, call: Callable[[], object]) -> None:
        """Make a call that a SIGKILL may interrupt, or that has come too late."""
        with contextlib.suppress(Unavailable, UnknownQuery, UsageError, UnloadFailed):
            self._do(call)

    def _do(self, call: Callable[[], T]) -> T:
        """Make a call in a thread, and look for faults until it returns.

        Raises:
            _Broken: a callback blocks, or the call does not return.
        """
        results: list[T] = []
        errors: list[BaseException] = []
        done = threading.Event()

        def work() -> None:
            try:
                results.append(call())
            except BaseException as error:
                errors.append(error)
            done.set()

        thread = threading.Thread(target=work, name="check-manager", daemon=True)
        thread.start()
        deadline = time.monotonic() + 3 * self._setup.callback_s + 3 * _RESTART_S
        while not done.wait(_PAUSE_S):
            try:
                self._look()
                if time.monotonic() > deadline:
                    raise _Broken(Fault(LIMIT, "a call of the check to the manager does not return"))
            except _Broken:
                self._threads.append(thread)
                raise
        thread.join()
        if errors:
            raise errors[0]
        return results[0]

    def _settle(self) -> None:
        """Wait until the manager is there, and no callback runs."""
        deadline = time.monotonic() + self._setup.callback_s + _RESTART_S
        while True:
            pid = process_of(self.notes)
            if pid and not runs_in(pid, self.notes):
                with contextlib.suppress(Unavailable):
                    self._do(self._handle.servers)
                    if process_of(self.notes) == pid and not runs_in(pid, self.notes):
                        break
            if time.monotonic() > deadline:
                raise _Broken(Fault(LIMIT, "the manager does not come back"))
            self._look()
            time.sleep(_PAUSE_S)
        (self._directory / ARM).unlink(missing_ok=True)
        self._look()
        killed = {note.pid for note in self.notes if note.what == "killed"} - self._killed
        self.kills += len(killed)
        self._killed |= killed

    def _look(self) -> None:
        """Look for faults of callbacks, and for a process that has died by itself.

        Raises:
            _Broken: there is one.
        """
        notes = self.notes
        self._judge(faults_of_callbacks(notes))
        started = [note.pid for note in notes if note.what == "started"]
        for pid in set(started[:-1]) - self._killed - {note.pid for note in notes if note.what == "killed"}:
            ran = ", ".join(f"the {run.role} callback of {run.name}" for run in runs_in(pid, notes)) or "no callback"
            self._judge(iter([Fault(LIVES, f"process {pid} died while {ran} ran, and the check had not killed it")]))

    def _await(self, role: str, resource: str) -> None:
        """Wait until a callback of a resource has run since the step began, if it begins soon."""

        def since() -> list[Note]:
            return self._reader.read()[self._step_from :]

        if self._until(lambda: any(_is(note, "begin", role, resource) for note in since()) or None, _BEGIN_S):
            patience_s = self._setup.callback_s + _RESTART_S
            self._until(lambda: has_ended(role, resource, since()) or None, patience_s)

    def _until(self, look: Callable[[], T | None], limit_s: float) -> T | None:
        deadline = time.monotonic() + limit_s
        while (found := look()) is None and time.monotonic() < deadline:
            self._look()
            time.sleep(_PAUSE_S)
        return found

    def _judge(self, faults: Iterator[Fault]) -> None:
        fault = next(faults, None) if self._judges else None
        if fault is not None:
            raise _Broken(fault)


def _is(note: Note, what: str, role: str, resource: str) -> bool:
    return (note.what, note.role, note.resource) == (what, role, resource)
