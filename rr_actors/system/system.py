"""System: a supervisor tree and a state directory. Where an application begins."""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import functools
import importlib
import os
import signal
import threading
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, Self, cast

from rr_actors.actors.actor import ExitReport
from rr_actors.actors.mailbox_refs import MailboxRef
from rr_actors.actors.messaging.dead_letters import Collection, DeadLetters
from rr_actors.actors.refs import ActorRef, ref_to
from rr_actors.actors.remote.hub import hub
from rr_actors.base.checks import examined, invalid
from rr_actors.base.config import RegistrarConfig, SystemConfig
from rr_actors.base.errors import (
    AlreadyStarted,
    CatalogLocked,
    InvalidName,
    InvalidSpec,
    NotFound,
    NotSerializable,
    RrError,
    StartFailed,
    SupervisionError,
    Unavailable,
    UsageError,
    is_a,
    shown,
)
from rr_actors.base.names import CONNECTED, check_name
from rr_actors.base.notebook import note_started, warn_of_redefined
from rr_actors.base.reporting.log import Log
from rr_actors.base.scarcity import wanted_by
from rr_actors.base.steps import Steps
from rr_actors.hosting import forwarded_logs
from rr_actors.hosting.forwarded_logs import KeptLogs
from rr_actors.hosting.process_node import SystemInfo
from rr_actors.registrar.arguments import check_text, state_path, stop_limit, system_config
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.pages import LoadRow, Wanted
from rr_actors.registrar.registrar import Registrar
from rr_actors.registrar.registrar import page as page_in
from rr_actors.registrar.servers.callback_context import check_not_own, serving
from rr_actors.runtime.backlogs import Backlog
from rr_actors.runtime.event_loop import (
    FORKED,
    Course,
    Dispatcher,
    acquire,
    check_asyncio,
    check_may_block,
    forget_in_children,
    leave_in_children,
    release,
)
from rr_actors.runtime.processes.process import keep_standard_fds
from rr_actors.runtime.shielding import Flag, shielded
from rr_actors.runtime.time_limits import finite_time, time_limit
from rr_actors.runtime.workers import Workers
from rr_actors.storage.child_records import ChildRecords
from rr_actors.storage.opening import open_catalog, remove_catalogs
from rr_actors.streams.stream import StreamInfo
from rr_actors.supervision.core.foreseen import What
from rr_actors.supervision.core.rendering import Tree
from rr_actors.supervision.core.specs import ChildSpec, Supervisor, as_child_spec, classes_of
from rr_actors.supervision.given_up import give_up
from rr_actors.supervision.hosted import Hosted, check_hostable, prepare
from rr_actors.supervision.import_guard import check_children_can_import, check_no_child_imports
from rr_actors.supervision.name_entries import Entries, check_managers, registrars_of, renamed_managers
from rr_actors.supervision.supervisor import SupervisorActor, SupervisorRef, supervisor_at
from rr_actors.system.backups import Backup, back_up, restore
from rr_actors.system.console.asking.waiting import waited_for
from rr_actors.system.console.console_connection import ConsoleConnection, find_console
from rr_actors.system.console.console_server import Console
from rr_actors.system.endings import Termination, Told, stop_dropped, wait_stopped, weakly
from rr_actors.system.event_subscribers import Event, Facts, Subscribers
from rr_actors.system.recording.event_memory import EventMemory
from rr_actors.system.recording.figures import Counters, Figure, figures_of
from rr_actors.system.recording.recordings import LIMIT as RECORDING_LIMIT
from rr_actors.system.recording.recordings import Recording, Recordings, note_present, present_entries
from rr_actors.system.registrar_lookup import (
    give_up_connected,
    gone_and_serving,
    left_behind,
    open_registrar,
    registrar_in,
    take_over,
)
from rr_actors.system.service_notices import ServiceNotices
from rr_actors.system.snapshots import (
    Preview,
    ask_registrars,
    describe_at,
    describe_registrars,
    describe_supervisor,
    paths_to,
    present_in,
    preview_in,
    streams_of,
)
from rr_actors.system.web_process import WebPage, check_proxy
from rr_actors.wire.name_service import (
    HostInfo,
    HostSettings,
    OtherHosts,
    Presence,
    StateDir,
    absolute_path,
    actor_key,
    open_state_dir,
    registrar_key,
)

logger = Log("rr_actors")

_LOOK_S = 1.0
_EVENTS_S = 1.0  # for subscribers to hear the last events, at a stop
_NOT_RUNNING = "not running; start it, or use it as a context manager"

_systems: weakref.WeakValueDictionary[str, System] = weakref.WeakValueDictionary()
"""The running systems of this process, by the real paths of their state directories."""


class _Starting:
    """A start that can be given up, also before there is anything to cancel."""

    def __init__(self) -> None:
        self._course: Course[None] | None = None
        self._given_up = False
        self.succeeded = False

    def wait(self, course: Course[None]) -> None:
        """Wait for the course that starts the tree, and end it if the start is given up already."""
        self._course = course
        if self._given_up:
            course.give_up()
        course.wait()

    def give_up(self) -> None:
        """Have the start end soon."""
        self._given_up = True
        if (course := self._course) is not None:
            course.give_up()


class System:
    """A tree of managers and actors, and a directory with their state.

    Use it as a context manager (`with` or `async with`), or call start() and stop(), or run(). If nothing refers to a
    running system, nor to a registrar that it opened, it warns (ResourceWarning) and is stopped in the background::

        with rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir="state") as system:
            app = system.open_registrar("app")

    Args:
        root: a Supervisor, or a list of ChildSpecs and Supervisors for a one_for_one supervisor called "root".
        name: the name in logs and errors.
        state_dir: the directory for catalogs, sockets and locks, made private (0700). One system at a time uses it.
            Give it one of its own: start() warns if it has other files at first.
        config: limits and defaults.
        debug: whether actors can be paused and stepped: system.mailbox(id).pause().
        hosts: an rr.Hosts, the system's part in a group of hosts (docs/hosts.md); None: it ends at this host.

    Raises:
        InvalidSpec: the tree is wrong, or hosts is no rr.Hosts. `.field`, `.expected`, `.got`.
        ConfigError: state_dir is no path, or config is no SystemConfig.
    """

    def __init__(
        self,
        root: Supervisor | Sequence[ChildSpec | Supervisor] = (),
        *,
        name: str = "system",
        state_dir: str | os.PathLike[str] = "rr_state",
        config: SystemConfig | None = None,
        debug: bool = False,
        hosts: HostSettings | None = None,
    ) -> None:
        self.name = check_name(name, "system name")
        self.root = _root_of(root)
        self._hosts: OtherHosts | None = None
        if hosts is not None:
            gateway = importlib.import_module("rr_actors.system.hosts.gateway")  # what few systems need
            self.root, self._hosts = gateway.with_gateway(self.root, hosts)
        self.state_dir = state_path(state_dir)
        self.config = system_config(config)
        self.debug = debug
        _check_tree(self.root, self.root.id)
        self._top = self.root.id  # the paths of this tree begin with it
        self._lock = threading.RLock()  # held by the thread that starts or stops the system
        self._backing_up = threading.Lock()
        self._starting: _Starting | None = None
        self._winding: asyncio.Task[None] | None = None  # of a stop
        self._hurries = False  # whether the stop was interrupted
        self._state: StateDir | None = None
        self._node: Node | None = None
        self._tree: Hosted | None = None
        self._console: Console | None = None
        self._pages: list[WebPage] = []
        self._dispatcher: Dispatcher | None = None
        self._subscribers = Subscribers(self.name)
        self._logs: Backlog[Facts] | None = None  # of this run; used on the loop, except at the end of the run
        self._counters = Counters()
        listen = functools.partial(self._subscribers.listen, records=True)
        self._recordings = Recordings(listen, self._subscribers.want_decisions, self._counters)
        self._dead_letters = Collection()
        self._ended = Flag()
        self._end: ExitReport | None = None
        self._why_stopped = _NOT_RUNNING
        self._service: ServiceNotices | None = None

    # -- life ----------------------------------------------------------------------------------------------------

    def start(self) -> Self:
        """Start every child in order. Return when all are ready.

        Raises:
            StartFailed: a child did not become ready. The children that had started are stopped again.
            CatalogLocked: another running system uses this state directory.
            CatalogError: what a child with a `renamed_from` left under that id cannot be taken over.
            ConfigError: the state directory cannot be used.
            AlreadyStarted: the system is running.
            UsageError: a module that a child process needs is still being imported, or the call would hang here.
        """
        check_may_block("System.start()")
        starting = self._check_start()
        try:
            shielded(functools.partial(self._start_now, starting), starting.give_up)
            return self
        except BaseException:
            if starting.succeeded:  # interrupted after the start: the caller cannot stop the system
                self.stop()
            raise

    __enter__ = start  # no method that calls it: an interrupt between the calls could lose a system that has started

    def _check_start(self) -> _Starting:
        """Check that no import would block the start. In the calling thread, which may hold import locks itself."""
        start = f"system {self.name!r}: start()"
        check_no_child_imports(start)
        check_children_can_import(as_child_spec(self.root), self.root.id, start)
        return _Starting()

    def _start_now(self, starting: _Starting) -> None:
        with self._lock:
            if self._node is not None:
                text = f"system {self.name!r}: it is running already (`with` starts a system by itself); stop it first"
                raise AlreadyStarted(text, id=self.name)
            keep_standard_fds()
            path = absolute_path(self.state_dir)
            wait_stopped(path, self.config.stop_timeout_s)
            self._starting = starting
            try:
                self._state = state = open_state_dir(path)
                self._memory = EventMemory(state.folder, self.config.events_limit_bytes, self.config.events_kept_s)
                self._child_logs = KeptLogs()
                self._dispatcher = dispatcher = acquire(workers_limit=self.config.workers_limit)
                place = str(state.path), str(state.run_dir), state.key
                levels = forwarded_logs.levels()
                info = SystemInfo(
                    self.name, *place, self.config, state.place, levels, debug=self.debug, hosts=self._hosts
                )
                self._ended = Flag()
                self._end = None
                self._why_stopped = _NOT_RUNNING
                self._hurries = False
                self._dead_letters = Collection()
                leave_in_children(self, System._leave_to_parent)
                starting.wait(dispatcher.course(self._start(info)))
            except BaseException as error:
                steps = Steps()  # the caller must hear of the first failure
                steps.take("giving back what it used", self._give_back)
                steps.report(logger, f"system {self.name!r}: its start failed, and not everything is given back")
                if isinstance(error, SupervisionError | CatalogLocked) or not (wanted := wanted_by(error)):
                    raise
                text = f"system {self.name!r} did not start: {wanted}"
                raise StartFailed(text, id=self.name, wanted=wanted) from error
            finally:
                self._starting = None
            _systems[str(state.path)] = self
            starting.succeeded = True

    @classmethod
    def running(cls, state_dir: str | os.PathLike[str] = "rr_state") -> System | None:
        """Return the running system of this process with that state directory, or None.

        A notebook cell that starts a system can use this when it runs a second time. If it has defined the class of a
        child anew, with other code, a RuntimeWarning says that the system runs the code from before.

        Raises:
            ConfigError: state_dir is no path, or no possible state directory.
        """
        system = _systems.get(str(absolute_path(state_path(state_dir))))
        for cls in classes_of(as_child_spec(system.root)) if system is not None else ():
            warn_of_redefined(cls, by_name=True)
        return system

    def __del__(self) -> None:
        """Warn that the system was dropped while it runs, and stop it in the background."""
        node: Node | None = getattr(self, "_node", None)  # __init__ may have raised
        if node is not None:
            what = f"system {self.name!r} in {self.state_dir}"
            place = Path(node.info.state_dir)
            stop_dropped(what, place, self, self._stop_dropped(node), self.config.stop_timeout_s)

    async def _stop_dropped(self, node: Node) -> None:
        try:
            await self._stop(node, self.config.stop_timeout_s)
        finally:
            with contextlib.suppress(Unavailable):  # no worker is free: _give_back() closes them on the loop
                await node.dispatcher.workers.run(self._recordings.close)  # it may wait for a disk
            self._give_back()

    async def _start(self, info: SystemInfo) -> None:
        self._top = _free_top(self.root.id)
        # The running parts hold the system weakly, so that a dropped system is noticed.
        node = Node(
            info, self._top, on_event=weakly(self._publish), open_catalog=open_catalog, remove_unneeded=remove_catalogs
        )
        self._node = node
        self._subscribers.attend(node)
        try:
            await node.start()
        except BaseException:  # no descriptors are left, or the start is given up
            await node.close()
            raise
        if self._state is not None:
            node.keeper.also.append(self._state.keep)
        try:
            spec = as_child_spec(self.root)
            note_started(classes_of(spec))
            entries = Entries(node.directory, ChildRecords(info.state_dir))
            entries.announce(spec, self._top)
            entries.tell_of_orphans(spec, self._top)
            in_tree = set(entries.registrars_of(spec, self._top))
            renamed = renamed_managers(spec, self._top)
            await node.dispatcher.workers.run(take_over, self.config, Path(info.state_dir), renamed)
            dormant = await node.dispatcher.workers.run(left_behind, self.config, Path(info.state_dir), in_tree)
            for name, contents in dormant.items():
                node.directory.mark(registrar_key(name), Presence.DORMANT, contents)
            await give_up_connected(node, dormant)
            if self.config.console:
                shut_down = weakly(self._shut_down)
                kept = self._memory, self._child_logs
                self._console = Console(self, node, self._subscribers, self._recordings, *kept, shut_down)
                await self._console.open()
            self._tree = prepare(node, SupervisorActor, self._top, weakly(self._tree_ended))
            await self._start_tree(self._tree)
            self._service = ServiceNotices(node.dispatcher.loop)
            self._service.started(f"system {self.name} runs in {info.state_dir}")
        except BaseException:
            console, self._console, self._tree = self._console, None, None
            try:
                if console is not None:
                    await console.close()
            finally:
                await node.close()
            raise

    async def _start_tree(self, tree: Hosted) -> None:
        starting = asyncio.ensure_future(tree.start((self.root,), {}, None))
        try:
            await asyncio.shield(starting)
        except asyncio.CancelledError:  # the starting thread was interrupted: stop what has started
            await tree.stop(self.config.stop_timeout_s, final=False)
            await asyncio.wait((starting,))
            starting.exception()
            raise

    def stop(self, timeout_s: float | None = None) -> None:
        """Stop everything, in the reverse order of the start, and release everything held. A second stop does nothing.

        An interrupted stop (Ctrl-C) kills the processes that have not stopped yet. In a forked child, stop() does
        nothing.

        Args:
            timeout_s: seconds after which processes that have not stopped are killed. None: the config's
                stop_timeout_s.

        Raises:
            UsageError: timeout_s is no number of seconds, or a callback of one of this process's registrars made the
                call and would wait for itself. Nothing is stopped.
            Exception, ExceptionGroup: a step, or several, went wrong. All other steps were done.
        """
        limit_s = self._check_stop(timeout_s)
        shielded(functools.partial(self._stop_now, limit_s), self._stop_at_once)

    def _check_stop(self, timeout_s: float | None) -> float:
        limit_s = self.config.stop_timeout_s if timeout_s is None else stop_limit(timeout_s)
        if (running := self._node) is not None:
            instead = "start a thread for it, or tell the main one, and let the callback return"
            check_not_own(f"system {self.name!r}: stop()", lambda me: serving(me).node is running, instead)
        if (starting := self._starting) is not None:  # it still starts: a signal handler calls stop(), for instance
            starting.give_up()
        return limit_s

    def _stop_now(self, limit_s: float, report: ExitReport | None = None) -> None:
        """Stop everything; then the threads in wait() and run() go on. `report`: for `ended`, if it was no stop()."""
        with self._lock:
            node, dispatcher = self._node, self._dispatcher
            if node is None or dispatcher is None:
                return
            steps = Steps()
            steps.take("stopping what runs", dispatcher.course(self._stop(node, limit_s)).wait)
            steps.take("giving back what it used", self._give_back)
            self._end = self._end or report
            self._ended.set()
            steps.end(f"system {self.name!r}: stopped, with errors")

    def _shut_down(self) -> None:
        """Stop the system in a thread of its own, because a console asked for it; wait() and run() return then."""
        threading.Thread(target=self._stop_for_console, name="rr-shut-down").start()

    def _stop_for_console(self) -> None:
        report = ExitReport("shutdown", "a console has shut the system down")
        try:
            self._stop_now(self._check_stop(None), report)
        except Exception:
            logger.exception("system %s: a console has shut it down", self.name)

    def _stop_at_once(self) -> None:
        self._hurries = True  # the stop may not have begun
        if (dispatcher := self._dispatcher) is not None:
            with contextlib.suppress(Unavailable):
                dispatcher.call(self._hurry)

    def _hurry(self) -> None:
        if self._winding is not None:
            self._winding.cancel()

    async def _stop(self, node: Node, limit_s: float) -> None:
        steps = Steps()
        console, self._console = self._console, None
        if console is not None:
            console.stopping = True
        service, self._service = self._service, None
        if service is not None:
            service.stopping()
        self._winding = asyncio.ensure_future(self._wind_up(node, limit_s, steps))
        if self._hurries:
            self._hurry()
        try:
            await self._winding
        except asyncio.CancelledError:  # the thread that stops the system was interrupted
            await self._wind_up(node, 0.0, steps)
            raise
        finally:
            self._winding = None
            if service is not None:
                service.close()
            if console is not None:
                await steps.take_async("closing the console", console.close())
            await steps.take_async("closing the process's part of it", node.close())
            node.stopping = f"system {self.name!r} has been stopped: start it, and open the registrar again"
        steps.end(f"system {self.name!r}: not everything stopped cleanly")

    async def _wind_up(self, node: Node, limit_s: float, steps: Steps) -> None:
        node.stopping = f"system {self.name!r} is being stopped"
        for name, status in node.statuses().items():
            if status is Presence.DORMANT and (entry := node.find(name)) is not None:
                logger.warning("system %s: stops, and registrar %s stays dormant%s", self.name, name, entry.because)
        opened = [name for name, actor in node.registrars.items() if actor.on_defect is None]  # by no manager
        await steps.take_async("closing the application's registrars", node.dismiss(opened[::-1], limit_s))
        if self._tree is not None and self._end is None:
            await steps.take_async("stopping the tree", self._tree.stop(limit_s, final=True))
        self._tree = None

    def _give_back(self) -> None:
        steps = Steps()
        forget_in_children(self)
        self._node = None
        pages, self._pages = self._pages, []
        for page in pages:
            steps.take("ending a web page", page.stop)
        steps.take("ending the recordings", self._recordings.close)
        may_wait = self._dispatcher is not None and self._dispatcher.may_block()
        steps.take("ending the subscriptions", self._subscribers.end, _EVENTS_S if may_wait else 0.0)
        self._logs = None
        if self._dispatcher is not None:
            self._dispatcher = None
            steps.take("ending the loop", release)
        if (state := self._state) is not None:
            if _systems.get(str(state.path)) is self:
                del _systems[str(state.path)]
            self._state = None
            steps.take("giving the state directory back", state.close)
        steps.end(f"system {self.name!r}: not everything is given back")

    def _leave_to_parent(self) -> object:
        """Forget all that runs, in a forked child, and return it for event_loop.py to keep: it is the parent's."""
        left = (self._node, self._tree, self._console, self._dispatcher, self._state, self._pages)
        if self._console is not None:
            self._console.leave_to_parent()
        for page in self._pages:
            page.forget()
        self._pages = []
        for registrar in self._node.registrars.values() if self._node is not None else ():
            registrar.leave_to_parent()
        self._starting = self._winding = None
        self._lock = threading.RLock()  # another thread may have held it at the fork
        if self._state is not None:
            _systems.pop(str(self._state.path), None)
            self._state.forget()
        self._subscribers.leave()
        self._logs = None
        self._recordings.leave_to_parent()
        self._node = self._tree = self._console = self._dispatcher = self._state = None
        self._why_stopped = f"the running one {FORKED}"
        return left

    def __reduce__(self) -> NoReturn:
        raise NotSerializable(
            f"system {self.name!r} belongs to its process: send references to its actors instead", path=""
        )

    def __exit__(self, kind: object, error: BaseException | None, traceback: object) -> None:
        """Stop the system as stop() does.

        Raises:
            The errors of stop().
            SupervisionError: the block ended cleanly, but the tree had ended by itself, and not cleanly; as run().
        """
        gave_up = self._gave_up()
        self.stop()
        if error is None and gave_up is not None:
            raise gave_up from gave_up.__cause__

    async def __aenter__(self) -> Self:
        """Start the system as start() does, without blocking the event loop; if cancelled, give the start up."""
        starting = self._check_start()
        try:
            await _in_thread(functools.partial(self._start_now, starting), starting.give_up)
        except asyncio.CancelledError:
            if starting.succeeded:  # cancelled as the start ended: nobody else would stop the system
                await self.__aexit__()
            raise
        return self

    async def __aexit__(
        self, kind: object = None, error: BaseException | None = None, traceback: object = None
    ) -> None:
        """Stop the system as __exit__() does, without blocking the event loop; if cancelled, kill what still runs."""
        gave_up = self._gave_up()
        await _in_thread(functools.partial(self._stop_now, self._check_stop(None)), self._stop_at_once)
        if error is None and gave_up is not None:
            raise gave_up from gave_up.__cause__

    def _gave_up(self) -> SupervisionError | None:
        """Return the error of a running system whose tree has ended by itself, and not cleanly."""
        report = self._end
        if self._node is None or report is None or report.exception is None:
            return None
        text = f"system {self.name!r}: its root supervisor has ended: {report.detail or report.reason}"
        error = SupervisionError(text)
        error.__cause__ = report.exception
        return error

    def run(self) -> signal.Signals | None:
        """Start the system unless it runs; wait for SIGTERM, Ctrl-C (SIGINT) or its end; then stop it.

        Use it for a service or a container, where the program is process 1 and SIGTERM does nothing by default.
        A second signal kills what has not stopped yet. Only the main thread can call run(), and run() replaces the
        handlers of both signals meanwhile.

        Returns:
            The signal that ended it; or None, if the tree ended by itself cleanly, or the system was stopped by
            another thread or a console.

        Raises:
            The errors of start() and stop().
            SupervisionError: the tree ended by itself, and not cleanly; `__cause__` is the error that ended it.
            UsageError: a thread other than the main one calls it.
        """
        with Termination(f"system {self.name!r}: run()", self._stop_at_once) as termination:
            try:
                termination.awaited = True
                if termination.told is not None:  # before it was awaited
                    raise Told
                if self._node is None:
                    self.start()
                while not self._ended.wait(_LOOK_S):
                    pass  # a signal that another thread gets does not interrupt this wait
            except Told:
                assert termination.told is not None
                logger.info("system %s: stops, as it got %s", self.name, termination.told.name)
            finally:
                termination.awaited = False
                gave_up = self._gave_up()
                try:
                    self.stop()
                except Unavailable:
                    if not termination.again:
                        raise
                    logger.warning("system %s: told twice to stop; what had not stopped yet was killed", self.name)
        if termination.told is None and gave_up is not None:
            raise gave_up from gave_up.__cause__
        return termination.told

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the tree ends by itself (restart intensity, auto_shutdown), or the system is stopped.

        Returns:
            Whether the tree ended or the system was stopped, by another thread or a console. `ended` says how it ended.

        Raises:
            UsageError: timeout_s is no number of seconds.
        """
        return self._ended.wait(time_limit(timeout_s))

    @property
    def ended(self) -> ExitReport | None:
        """The report of how the tree ended by itself, or was shut down by a console; None if neither has happened."""
        return self._end

    def _tree_ended(self, report: ExitReport) -> None:
        self._end = report
        why = report.detail or report.reason
        if self._node is not None:  # the threads that wait for a part of it hear of its end
            try:
                self._mark_gone(self._node, why)
            except (RrError, OSError) as error:  # a full disk: they wait for their time limits
                logger.warning("system %s: the end of its tree could not be marked: %s", self.name, error)
        logger.error("system %s: its root supervisor has ended: %s", self.name, why)
        if self._service is not None:
            self._service.ended(why)
        if self._node is not None:
            self._node.emit("ended", path=self._top, reason=report.reason, detail=report.detail)
        self._ended.set()

    def _mark_gone(self, node: Node, why: str) -> None:
        node.directory.mark(actor_key(self._top), Presence.GONE, why)
        entries = Entries(node.directory, ChildRecords(node.info.state_dir))
        for name in entries.registrars_of(as_child_spec(self.root), self._top):
            if name not in node.registrars:
                node.directory.mark(registrar_key(name), Presence.GONE, why)

    def _running(self) -> Node:
        node = self._node
        if node is None:
            raise UsageError(f"system {self.name!r}: {self._why_stopped}")
        return node

    # -- registrars ----------------------------------------------------------------------------------------------

    def open_registrar(self, name: str, config: RegistrarConfig | None = None) -> Registrar:
        """Open a registrar in this process, to consume or provide resources, or both. It continues its catalog.

        Raises:
            InvalidName: the name has characters that no name may have, or begins with "connection.".
            NameTaken: another registrar of the system has the name.
            ConfigError: `config` is no RegistrarConfig, or has another name.
            CatalogError: the catalog is locked, damaged or of another version.
        """
        node = self._running()
        if check_name(name, "registrar name").startswith(CONNECTED):
            expected = (
                f"a name that does not begin with {CONNECTED!r}, as those of connected programs do (rr.connect())"
            )
            raise InvalidName(f"registrar name {name!r}: expected {expected}", name=name)
        return open_registrar(node, name, self.config.registrar(name) if config is None else config, self)

    def registrar(self, name: str) -> Registrar:
        """Return a registrar of this process, or a handle on a registrar of another process.

        A handle waits for a registrar that is being started or respawned, within each call's time limit.

        Raises:
            UnknownRegistrar: the system has no registrar of this name.
        """
        return registrar_in(self._running(), name, patient=True, owner=self)

    def dormant(self) -> list[str]:
        """Return the registrars that hold or serve something, whose process died, and that nobody has opened again.

        They include those of managers that are gone for good, with a supervisor that died say, and that still serve
        something: no unload callback has run.
        """
        node = self._running()
        dormant = [name for name, status in node.statuses().items() if status is Presence.DORMANT]
        return sorted([*dormant, *gone_and_serving(node)])

    def release(self, name: str, *, force: bool = False) -> None:
        """Release everything that a dormant registrar holds; a provider that is down does so when it is back.

        Those that hold what it serves hear FATAL, and hold it no more. It goes on until the registrar is opened: under
        its name, or by the `renamed_from` of a ChildSpec. If the application ends before all is released, its next
        start finds the registrar dormant again.

        Args:
            force: forget what the registrar serves, too. No unload callback runs: whatever they would end stays.

        Raises:
            UsageError: the registrar is not dormant.
            CatalogError: its catalog cannot be opened.
        """
        node = self._running()
        if name not in self.dormant():
            there = ", ".join(self.dormant()) or "none"
            raise UsageError(f"registrar {shown(name)}: not dormant; the dormant ones are: {there}")
        node.dispatcher.run(give_up(node, name, clear=force))

    # -- the tree ------------------------------------------------------------------------------------------------

    def ref(self, id: str) -> ActorRef[Any]:
        """Return a reference to a child actor anywhere in the tree, by its id or its path ("inner/a").

        An id is searched for under the root supervisor first, then below. If several children have it, use a path. A
        manager's registrar is "cameras/registrar", and one of the application's has its name ("app"). A client of a
        registrar is "cameras/registrar/clients/maps" or "app/clients/cameras"; a server is "app/servers/camera".

        Raises:
            NotFound: no child has this id, or several have it. The error has their paths.
            ActorUnavailable: a supervisor that may have the child is being respawned.
            pykka.Timeout: the process of such a supervisor has not answered within 60 s.
        """
        id = check_text(id, "ref: expected a child's id or path")
        path, _, child_id = id.rpartition("/")
        part = self._running().part(id)
        if part is not None and path:
            return part
        supervisor = self._supervisor_ref(path)
        try:
            supervisor.get_childspec(child_id)
        except NotFound as error:
            meant = paths_to(child_id, self.supervisor())
            if not path and len(meant) == 1:
                return ref_to(meant[0])
            if not meant and part is not None:
                return part
            if not meant:
                raise
            raise NotFound(f"{error}; did you mean {' or '.join(map(repr, meant))}?", id=id) from error
        return ref_to(f"{supervisor.path}/{child_id}")

    def wait_for(self, id: str, state: str = "", *, timeout_s: float | None = 30.0) -> str:
        """Wait until a child or a resource is in a state, and return the state. `rr-actors wait` does the same.

        Args:
            id: a child's id or path; or a resource's name, such as 'cameras/camera "front"', or its id.
            state: of a child "running", "starting", "restarting" or "stopped"; of a resource its phase, such as
                "loaded" or "paused", or its state, such as "OK" or "FATAL"; or "gone". Default: the child runs, or the
                resource is loaded.

        Raises:
            Unavailable: it was not in time; the text has the state that was seen last.
            NotRunning: the system has ended.
            UsageError: there is no such state, several children or resources have this name, or the system has no
                console (SystemConfig.console).
        """
        self._running()
        check_may_block("System.wait_for()")
        if not self.config.console:
            raise UsageError("wait_for: expected a system with a console, got SystemConfig(console=False)")

        def is_so(seen: str) -> bool:
            """Return whether a child that its supervisor calls running answers: it may not know of a kill yet."""
            if seen == "running":
                with contextlib.suppress(NotFound):  # a supervisor
                    return self.ref(id).is_alive()
            return True

        return waited_for(lambda: ConsoleConnection(find_console(self.state_dir)), id, state, timeout_s, is_so)

    def supervisor(self, path: str | None = None) -> SupervisorRef:
        """Return a supervisor by its path of ids, "root/inner" or "inner"; without a path, the root supervisor.

        Raises:
            NotFound: there is no such supervisor, or it is gone. `.known` has the others. Later calls on it raise
                this too, and ActorUnavailable while it is being respawned.
        """
        directory = self._running().directory
        supervisor = self._supervisor_ref(path)
        return supervisor if supervisor.path == self._top else supervisor_at(supervisor.path, directory)

    def _supervisor_ref(self, path: str | None) -> SupervisorRef:
        self._running()
        below = "" if path is None else check_text(path, "supervisor: expected a path of ids")
        for top in (self._top, self.root.id):
            if below == top or below.startswith(top + "/"):
                below = below[len(top) + 1 :]
                break
        return SupervisorRef(f"{self._top}/{below}" if below else self._top)

    def start_child(self, spec: ChildSpec | Supervisor) -> ActorRef[Any] | None:
        """Add a child to the root supervisor and start it, as SupervisorRef.start_child() does."""
        return self.supervisor().start_child(spec)

    def mailbox(self, id: str) -> MailboxRef:
        """Return the mailbox of an actor, to look at it, or to pause it. No actor is asked for that.

        Args:
            id: an id or path as for ref(), or that of a supervisor.

        Raises:
            NotFound: no actor has it, or several have. `.known` has the paths of all.
        """
        node = self._running()
        id = check_text(id, "mailbox: expected an actor's id or path")
        return MailboxRef(ref_to(self._top) if id in (self._top, self.root.id) else node.ref(id))

    # -- looking -------------------------------------------------------------------------------------------------

    def snapshot(self) -> dict[str, Any]:
        """Return the tree, and every registrar's resources, queries and dependencies, as plain data.

        A supervisor or registrar that does not answer has an "error" in the place of what it would say.
        """
        node = self._running()
        registrars = describe_registrars(node)
        return {"system": self.name, "tree": describe_supervisor(self.supervisor()), "registrars": registrars}

    def streams(self) -> list[StreamInfo]:
        """Return the open streams of the whole system. A registrar that does not answer is left out."""
        return streams_of(self._running())

    def hosts(self) -> list[HostInfo]:
        """Return the other hosts that this system knows, by name: those it has seen, and those its settings name.

        Raises:
            UsageError: the system was made without hosts=.
        """
        if self._hosts is None:
            raise UsageError(f"system {self.name!r}: hosts(): expected a system made with System(hosts=...)")
        return self._hosts.known(self._running().directory)

    def tree(self, path: str | None = None) -> Tree:
        """Return a picture of the child at `path` and everything below it; without a path, of the whole tree.

        A supervisor that does not answer is "unavailable" in it, and nothing below it is known.

        Raises:
            NotFound: there is nothing at that path.
        """
        return Tree(describe_at(self._supervisor_ref(path)))

    def dead_letters(self) -> DeadLetters:
        """Return the dead letters since the start, messages that reached nobody: their number, and the newest 1000.

        They include all messages of this process, and at most 100 a second of each other process.
        """
        return self._dead_letters.all()

    def subscribe(self, callback: Callable[[Event], Any] | Callable[[dict[str, Any]], Any]) -> Callable[[], None]:
        """Call `callback(event)` in a worker, in order, for each event of the whole system.

        An event is a dict: an rr.ChildEvent, rr.ResourceEvent, rr.ProgressEvent, rr.StreamEvent, rr.DeadLetterEvent,
        rr.EndedEvent or rr.MissedEvent. "event" is its kind ("started", "loaded" ...); docs/supervision.md lists them.
        The other keys say where ("path", or "registrar", "server" and "resource_id") and how.

        Returns:
            A function that ends the subscription.
        """
        return self._subscribers.add(callback)

    def backup(self, directory: str | os.PathLike[str], *, timeout_s: float = 30.0) -> Backup:
        """Copy the catalogs of all registrars as they are at one moment, and the files beside them, to a new directory.

        All registrars hold still for that moment, which the result has as `held_s`; nothing fails because of it. If a
        registrar is being restarted, or its process does not answer, it is tried again. The directory is complete, or
        is not made. It is as private as a state directory: who can write it can run code as you when it is restored.

        Raises:
            ConfigError: the directory is not empty, or cannot be made.
            RegistrarDown, Unavailable: a registrar did not hold still within `timeout_s` seconds. The error names it.
            CatalogError: a catalog cannot be read, or a copy cannot be written.
            UsageError: the system does not run, or the call would hang here.
        """
        check_may_block("System.backup()")
        node, limit_s = self._running(), finite_time(timeout_s, "timeout_s")
        with self._backing_up:
            return back_up(node, state_path(directory), limit_s)

    @staticmethod
    def restore(
        directory: str | os.PathLike[str],
        state_dir: str | os.PathLike[str],
        *,
        locations: Mapping[str, str | os.PathLike[str]] | None = None,
    ) -> Backup:
        """Make a new state directory from a backup. A system that starts there goes on from the moment of the backup.

        A catalog that was configured with a location outside of the state directory is put there again. All is made, or
        nothing.

        Args:
            directory: the backup.
            state_dir: a directory that does not exist, or is empty.
            locations: other locations, by the names of registrars. Configure the new system with the same ones.

        Raises:
            ConfigError: `directory` is no backup, `state_dir` is not empty, or a location has a catalog.
            CatalogDamaged: a file of the backup is missing or damaged. `.path`
            CatalogVersion: a newer version of rr_actors has written it. `.path`, `.expected`, `.got`
        """
        return restore(state_path(directory), state_path(state_dir), locations or {})

    def serve_web(
        self, *, host: str = "127.0.0.1", port: int = 0, prefix: str = "", hosts: Sequence[str] = ()
    ) -> WebPage:
        """Serve a live web page of this system, from a process of its own that ends with the system.

        It needs the extra `web`. docs/console.md shows the page, docs/security.md says who can open it.

        Args:
            host: the address to listen at. Every program that reaches it and has the page's URL can drive the system.
            port: the port to listen at; 0 takes a free one.
            prefix: the path before all paths of the page, if browsers reach it through a proxy: "/rr", or
                "/user/me/proxy/{port}".
            hosts: the names of the hosts at which a proxy serves it: "hub.example.org", with the port if it is not the
                usual one. Pages of these hosts can drive the system.

        Returns:
            The page: its `.url`, and `.stop()`.

        Raises:
            UsageError: the system does not run or has no console, or an argument is not valid.
            MissingDependency: the library nicegui is not installed.
            Unavailable: the page did not start; standard error says why.
        """
        check_may_block("System.serve_web()")
        self._running()
        if not is_a(host, str) or not host:
            raise UsageError(f"serve_web: host: expected an address to listen at, got {shown(host)}")
        if not is_a(port, int) or is_a(port, bool) or not 0 <= port <= 65_535:
            raise UsageError(f"serve_web: port: expected a whole number from 0 to 65535, got {shown(port)}")
        check_proxy("serve_web", prefix, hosts)
        if not self.config.console:
            raise UsageError(
                f"system {self.name!r}: serve_web needs the console, which SystemConfig(console=False) ended"
            )
        page = WebPage(str(absolute_path(self.state_dir)), host, port, prefix, hosts)
        with self._lock:
            if self._node is not None:
                self._pages.append(page)
                return page
        page.stop()
        raise UsageError(f"system {self.name!r}: it was stopped while its web page started")

    def record(
        self, file: str | os.PathLike[str] | None = None, *, limit: int = RECORDING_LIMIT, decisions: bool = False
    ) -> Recording:
        """Begin to record what happens: events, exits, callbacks, and the messages between registrars.

        Use it as a context manager, or call its stop(). It ends with the system, too. Only a recording in progress has
        a cost, which docs/recording.md gives.

        Args:
            file: a new file to write it to, without a bound; None: it is in memory. A thread writes the file, and
                misses entries if the disk is too slow.
            limit: how many entries are kept in memory; the oldest are dropped first.
            decisions: have the registrars record all that they decide, for `rr-actors replay`. Such a recording has
                whole requests and responses, and loads take longer meanwhile (docs/replay.md).

        Raises:
            UsageError: the system does not run, limit is no whole number above 0, or decisions is no bool.
            ConfigError: the file exists already, or cannot be created.
        """
        self._running()
        path = None if file is None else Path(file)
        recording = Recording(self.name, limit=limit, path=path, recordings=self._recordings, decisions=decisions)
        if (node := self._node) is None:  # the system was stopped meanwhile
            recording.stop()
            self._running()
        else:
            present = present_in(node, None if self._end is not None else self._top)
            note_present(recording, present_entries(*present, time.time()))
        return recording

    def preview(self, *, kill: str | None = None, stop: str | None = None, restart: str | None = None) -> Preview:
        """Return what would happen if a child was killed, stopped or restarted now; nothing is changed.

        Give one of the three: the child's id, if only one has it, or its path.

        Args:
            kill: its process would be killed.
            stop: its supervisor would stop it, as terminate_child() does.
            restart: its supervisor would stop it, and start it again.

        Raises:
            UsageError: not one child is given, or it is the root.
            NotFound: there is no such child, or several have the id.
            ActorUnavailable: its supervisor does not answer now.
        """
        node = self._running()
        what: What = "kill" if kill is not None else "stop" if stop is not None else "restart"
        given = [child for child in (kill, stop, restart) if child is not None]
        if len(given) != 1:
            raise UsageError(f"preview: expected one of kill, stop and restart, got {len(given)}")
        (child,) = given
        path = self.ref(check_text(child, f"preview: {what}: expected a child's id or path")).path
        if path is None or "/" not in path:
            raise UsageError(f"preview: {what}: expected a child of a supervisor, got {shown(child)}")
        return preview_in(node, self._top, path, what)

    def figures(self) -> list[Figure]:
        """Return the figures of the system: children, restarts, registrars, servers' loads, commits, dead letters.

        During recordings, loads and their time as holders see them, and exits are also counted.
        rr_actors.system.recording.figures has prometheus_text() for them, rr_actors.system.recording.otel_export has
        register_metrics().
        """
        node = self._running()
        stats = {name: dict[str, int]() for name in node.statuses()}
        servers: list[LoadRow] = []
        for name, answer in ask_registrars(node, _loads_and_stats).items():
            if not isinstance(answer, RrError):  # else the registrar has ended just now
                servers += answer[0]
                stats[name] = answer[1]
        tree: dict[str, Any] = {"path": self._top, "state": "stopped"}
        if self._end is None:  # what has ended is not asked: that would make a dead letter
            tree = describe_supervisor(self.supervisor())
        return [*figures_of(tree, stats, servers, self.dead_letters().count), *self._counters.figures()]

    def _publish(self, event: Facts) -> None:
        node = self._node
        if node is None:
            return
        if event["event"] == forwarded_logs.EVENT:
            self._take_log(node.dispatcher.workers, event)
            return
        if event["event"] == "dead_letter":
            self._dead_letters.heard(event)
        if event["event"] == "restarted" and self._service is not None:
            self._service.restarted(event["path"])
        if event.pop("kept", False) or "path" in event:
            self._memory.take(event)
        if self._subscribers.listened:
            self._subscribers.tell(event)

    def _take_log(self, workers: Workers, event: Facts) -> None:
        self._child_logs.take(event)
        if (logs := self._logs) is None:
            logs = self._logs = Backlog(workers, forwarded_logs.take, self._say_missed_logs, _say_log_lost)
        try:
            logs.put(event)
        except Unavailable as error:
            _say_log_lost(error, event)

    def _say_missed_logs(self, count: int) -> None:
        text = "system %s: the logging here is too slow: %d records of its child processes are missing"
        logger.warning(text, self.name, count)

    def __repr__(self) -> str:
        state = "stopped" if self._node is None else "running" if self._end is None else "ended, not stopped,"
        return f"<System {self.name} {state} in {self.state_dir}>"


def _loads_and_stats(registrar: Registrar) -> tuple[list[LoadRow], dict[str, int]]:
    return page_in(registrar, Wanted("loads", limit=0)).loads, registrar.stats()


def _say_log_lost(error: BaseException, event: Facts | None) -> None:
    child, record = ("a child", "how many are missing") if event is None else (event["processName"], event["msg"])
    logger.error("%s: its record %r is lost, as it could not be logged here", child, record, exc_info=error)


async def _in_thread(fn: Callable[[], object], give_up: Callable[[], object]) -> None:
    """Run fn() in a thread of its own until it has ended; if cancelled, call give_up(), and wait for the end.

    The application's executor may be full of calls that wait for this one.

    Raises:
        UsageError: no event loop of asyncio runs in this thread.
    """
    check_asyncio("async with System")
    loop = asyncio.get_running_loop()
    ended = asyncio.Event()
    errors: list[BaseException] = []
    context = contextvars.copy_context()

    def run() -> None:
        try:
            context.run(fn)
        except BaseException as error:
            errors.append(error)
        with contextlib.suppress(RuntimeError):  # the application's loop was closed meanwhile
            loop.call_soon_threadsafe(ended.set)

    threading.Thread(target=run, name="rr-system", daemon=True).start()
    cancelled: asyncio.CancelledError | None = None
    while not ended.is_set():
        try:
            await ended.wait()
        except asyncio.CancelledError as error:  # at a second one, the work is ending already
            if cancelled is None:
                give_up()
            cancelled = error
    if cancelled is not None:
        raise cancelled
    if errors:
        raise errors[0]


def _free_top(id: str) -> str:
    """Return the root's id, or "root.2" while another system of this process has it: a path leads to one actor only."""
    number = 1
    top = id
    while (other := hub(top)) is not None and other.name == top:
        number += 1
        top = f"{id}.{number}"
    return top


def _root_of(root: object) -> Supervisor:
    """Return the root supervisor: `root`, or a one_for_one supervisor called "root" of the children that it lists."""
    if is_a(root, Supervisor):
        return root
    kind = type(root)
    if not issubclass(kind, (list, tuple, Sequence)) or issubclass(kind, (str, bytes, range, memoryview)):
        raise invalid("System", "root", "a Supervisor or a list of ChildSpecs", root)
    children: list[ChildSpec | Supervisor] = []
    with examined("System: root"):
        for child in cast("Sequence[ChildSpec | Supervisor]", root):
            if not is_a(child, (ChildSpec, Supervisor)):  # checked before the next: there may be a thousand million
                raise invalid("System", "root", "ChildSpecs and Supervisors", child)
            children.append(child)
    return Supervisor(children)


def _check_tree(supervisor: Supervisor, path: str) -> None:
    """Check that every child can be hosted, and that no two managers have one registrar, or a connection's name."""
    for spec in supervisor.child_specs:
        inner = spec.actor_class_or_manager
        if isinstance(inner, Supervisor):
            _check_tree(inner, f"{path}/{spec.id}")
        else:
            check_hostable(inner, f"{path}/{spec.id}", spec.args, spec.kwargs)
    names = registrars_of(as_child_spec(supervisor), path)
    check_managers(names, f"Supervisor {path}")
    for id, old in renamed_managers(as_child_spec(supervisor), path).items():
        if old in names:
            expected = f"an id that no other manager has, as what {old!r} left is to be that of {id!r}"
            raise invalid(f"Supervisor {path}", "renamed_from", expected, old)
    for name in names:
        if names.count(name) > 1:
            expected = "registrar names unique in the tree (a manager's child id is its registrar's name)"
            text = f"Supervisor {path}: id: expected {expected}, got {name!r} twice"
            raise InvalidSpec(text, field="id", expected=expected, got=name)
