"""Run: one run of one child, from its start to its end, in a process of its own or in this one.

A supervisor makes a new Run for every start. Whatever happens, start() returns or raises once, stop() returns once, and
a Run that became ready and ended by itself calls on_end once. When any of these reports the end of a process, that
process and its process group are dead.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

from msgspec.structs import replace

from rr_actors.actors.actor import ExitReport
from rr_actors.base import pickling
from rr_actors.base.errors import StartFailed, Unavailable
from rr_actors.base.reporting.log import Log
from rr_actors.base.reporting.tracebacks import ProcessStacks, add_note
from rr_actors.base.scarcity import wanted_by
from rr_actors.base.steps import Steps
from rr_actors.registrar.engine.node import Node
from rr_actors.runtime.processes import lifeline
from rr_actors.runtime.processes.process import Exited, Process, signal_name
from rr_actors.runtime.time_limits import wait_while_running
from rr_actors.supervision import control_channel as control
from rr_actors.supervision.core.specs import ChildSpec, Shutdown
from rr_actors.supervision.core.state import Exit, Reason, StartChild, Why
from rr_actors.supervision.event_history import RunFacts
from rr_actors.supervision.heartbeat import Heartbeat
from rr_actors.supervision.hosted import prepare

logger = Log("rr_actors.supervision")

ENTRY = "rr_actors.supervision.child_main:main"
_LAST_WORDS_S = 0.05  # the longest wait for a dead process's last messages
_PASSED_ON = 0.8  # of a time limit, what a process below has of it: it says why one further down is silent
_LEAVE_S = 2.0  # the longest time from a process's last answer to its end

OnEnd = Callable[[Exit], None]
Target = tuple[type[Any], Sequence[Any], Mapping[str, Any]]
"""The class to start for a child in this process, its args and its kwargs."""


class LocalRun:
    """The Run of a child in this process, with the methods of ProcessRun. It is abandoned if it cannot be stopped.

    Args:
        on_end: called if the child has become ready and then ends without stop().
    """

    def __init__(self, node: Node, spec: ChildSpec, path: str, target: Target, on_end: OnEnd) -> None:
        self.pid: int | None = os.getpid()
        self._timeout_s = _start_timeout_s(spec, node)
        self._target = target
        temporary = spec.restart == "temporary"
        self._hosted = prepare(node, target[0], path, lambda report: on_end(_exit_of(report)), once=temporary)

    async def start(self, *, by_hand: bool) -> bool:
        _, args, kwargs = self._target
        return await self._hosted.start(args, kwargs, self._timeout_s, by_hand=by_hand)

    async def stop(self, shutdown_s: Shutdown, *, final: bool) -> Exit:
        return _exit_of(await self._hosted.stop(shutdown_s, final=final))

    def kill(self) -> None:
        self._hosted.kill()


def _exit_of(report: ExitReport) -> Exit:
    return Exit(report.reason, report.detail, traceback=report.traceback)


class ProcessRun:
    """The Run of a child in a process of its own.

    Args:
        on_died: called at the death of the process, so that the processes that it started are swept.
    """

    on_end: OnEnd
    """Called if the child has become ready and then ends without stop(). Set it before start()."""
    on_death_in_callback: Callable[[str, bool], None]
    """Called once, before the child is ready, if its last process died in callbacks of resources. Set it, too."""
    on_acquitted: Callable[[], None]
    """Called when none of these has ended the present process. Set it, too."""

    def __init__(self, node: Node, spec: ChildSpec, path: str, on_died: Callable[[], None]) -> None:
        self._loop = loop = asyncio.get_running_loop()
        self.pid: int | None = None  # once it has one
        self.managers: set[str] = set()  # the paths of those that run below a supervisor
        self._node = node
        self.spec = spec
        self._path = path
        self._on_died = on_died
        self._process: Process | None = None
        self._channel: control.Channel | None = None
        self._launching: asyncio.Task[None] | None = None
        self._answer: asyncio.Future[control.Message | None] = loop.create_future()  # None: the process died first
        self._end: asyncio.Future[Exit] = loop.create_future()
        self._exited: Exited | None = None
        self._exiting: control.Exiting | None = None
        self._killed: Exit | None = None  # why the supervisor killed it
        self._silent = False  # the child's end of the channel is closed
        self._up = False
        self._died_before = False  # its last process died in callbacks of resources
        self._resumed = ""  # a callback of a resource that went on with such work during its start
        self._stopping = False
        self._heartbeat: Heartbeat | None = None
        self._asked: dict[int, asyncio.Future[control.FoundStacks]] = {}
        self._numbers = itertools.count(1)

    # -- Run -------------------------------------------------------------------------------------------------------

    async def start(self, *, by_hand: bool) -> bool:
        """Start the child. Return True once it is ready, False if its on_start returned IGNORE. Not after stop().

        Args:
            by_hand: start_child or restart_child asks for this start, and not the supervisor.

        Raises:
            StartFailed: the child did not become ready, or was stopped first.
            BaseException: the error of its on_start.
        """
        timeout_s = _start_timeout_s(self.spec, self._node)
        self.lay_out()
        assert self._launching is not None
        await asyncio.shield(self._launching)
        assert self._channel is not None
        if self._stopping:
            raise StartFailed(f"{self._path}: stopped before it had started", id=self._path)
        self._channel.send(control.Start(by_hand))
        if self.spec.heartbeat_s is not None and not self._end.done():
            self._heartbeat = Heartbeat(self.spec.heartbeat_s, self._ping, self._kill_hung, self._starved_s)
        await wait_while_running(self._answer, timeout_s)
        if not self._answer.done():
            self._kill(Exit("killed", f"on_start had not returned after {timeout_s:g} s (start_timeout_s)"))
            return await self._judge(None)
        return await self._judge(self._answer.result())

    def lay_out(self) -> None:
        """Make the process before start() is called. Until then nothing of the child runs in it."""
        if self._launching is None:
            self._launching = self._loop.create_task(self._launch())

    async def stop(self, shutdown_s: Shutdown, *, final: bool) -> Exit:
        """Stop the child, also during its start: ask, wait for shutdown_s, kill. Call it once.

        `final`: the child will not be started again.
        """
        self._stopping = True
        if self._heartbeat is not None:
            self._heartbeat.stop()
        if self._launching is not None:
            await asyncio.wait((self._launching,))
            self._launching.exception()  # start() raises it
        if self._process is None:
            return Exit("shutdown", "not started")
        if shutdown_s == "brutal_kill":
            self._kill(Exit("killed", "brutal_kill"))
        elif self._channel is not None:
            limit_s = None if shutdown_s == "infinity" else float(shutdown_s)
            self._channel.send(control.Stop(final))
            await wait_while_running(self._end, limit_s)
            if not self._end.done():
                self._kill(Exit("killed", f"had not stopped after shutdown_s={limit_s:g} s"))
        return await asyncio.shield(self._end)

    def kill(self) -> None:
        """Kill the child at once."""
        self._kill(Exit("killed", "killed by its supervisor"))

    # -- its start -------------------------------------------------------------------------------------------------

    async def _launch(self) -> None:
        process: Process = await self._node.dispatcher.workers.run(self._spawn)
        self._process = process
        self.pid = process.pid
        try:
            process.watch(self._loop, self._died)
            self._channel = await control.Channel.open(process.control, self._path, self._received, self._lost)
        except Exception:  # for instance, no descriptors are left
            self._process = self.pid = None
            process.close()
            raise
        self._node.stacks.add(self._path, self.ask_stacks)
        if self._exited is not None:
            self._await_last_words()

    def _spawn(self) -> Process:
        """Pickle the ChildSpec and launch the process. In a worker, since both block."""
        spec = pickling.dumps(self.spec, f"the ChildSpec of {self._path}")
        payload = pickling.dumps((self._node.info, self._path, spec, pickling.classes_with_codecs()))
        return self._node.spawner.start(ENTRY, payload, name=self._path)

    async def _judge(self, answer: control.Message | None) -> bool:
        match answer:
            case control.ChildReady():
                self._up = True
                if self._end.done():
                    self._loop.call_soon(self._tell)
                return True
            case control.Ignored():
                await self._leave()
                return False
            case control.Failed():
                await self._leave()
                raise await self._node.dispatcher.workers.run(_unpack, answer, self._path)
            case _:
                exit = await asyncio.shield(self._end)
                text = f"{self._path}: {exit} before it was ready"
                facts = {"callback": self._resumed} if self._resumed and self._killed is None else {}
                if self._resumed:
                    text += f", while callbacks of resources went on with what a crash had interrupted: {self._resumed}"
                error = StartFailed(text, id=self._path, code=exit.code, **facts)
                if exit.traceback:
                    error.add_note(exit.traceback)
                raise error

    async def _leave(self) -> None:
        """Wait until a process that has announced its end is dead; kill it after _LEAVE_S."""
        await wait_while_running(self._end, _LEAVE_S)
        if not self._end.done():
            self._kill(Exit("killed", f"had not left after {_LEAVE_S:g} s"))
        await asyncio.shield(self._end)

    # -- its messages ----------------------------------------------------------------------------------------------

    def _received(self, message: control.Message) -> None:
        match message:
            case control.ChildReady() | control.Ignored() | control.Failed():
                if not self._answer.done():
                    self._answer.set_result(message)
            case control.Exiting():
                self._exiting = message
            case control.Pong():
                if self._heartbeat is not None:
                    self._heartbeat.heard(message.trouble)
            case control.Resumed():
                self._resumed = message.run
            case control.FoundStacks():
                if (asked := self._asked.get(message.number)) is not None and not asked.done():
                    asked.set_result(message)
            case control.DiedInCallback():
                if not (self._up or self._died_before):
                    self._died_before = True
                    self.on_death_in_callback(message.runs, message.is_proven)
            case control.CallbacksAcquitted():
                self.on_acquitted()
            case control.News():
                self._note(message.event)
                if "path" not in message.event and self._channel is not None:  # resource events may be many
                    self._channel.rest()
                self._node.on_event(message.event)
            case _:
                pass

    def _note(self, event: dict[str, Any]) -> None:
        if event.get("kind") == "manager" and (path := event.get("path")) is not None:
            if event["event"] in ("started", "restarted"):
                self.managers.add(path)
            elif event.get("state") is None:
                self.managers.discard(path)

    def _ping(self) -> None:
        if self._channel is not None:
            self._channel.send(control.Ping())

    def _starved_s(self) -> float:
        return 0.0 if self._process is None else lifeline.starved_s(self._process.pid)

    async def ask_stacks(self, path: str, limit_s: float) -> ProcessStacks:
        """Return the stacks of the process of the child at `path`: of this child, or of one below it.

        Raises:
            Unavailable: the process has ended, or did not answer in time.
        """
        number = next(self._numbers)
        asked = self._asked[number] = self._loop.create_future()
        try:
            if self._channel is not None:
                self._channel.send(control.AskStacks(number, path, limit_s * _PASSED_ON))
            await asyncio.wait((asked,), timeout=limit_s)
        finally:
            del self._asked[number]
        if not asked.done():
            silent = f"{self._path}: process {self.pid} did not answer within {limit_s:g} s"
            raise Unavailable(f"{silent}: {self._why_silent()}")
        found = asked.result()
        if found.stacks is None:
            raise Unavailable(found.error)
        return found.stacks

    def _why_silent(self) -> str:
        paused = "" if self.pid is None else lifeline.stopped(self.pid)
        if paused:
            return f"it is {paused}"
        return "its loop does not turn: code that is not Python may hold the interpreter"

    # -- its end ---------------------------------------------------------------------------------------------------

    def _kill_hung(self, why: str) -> None:
        self._kill(Exit("abnormal", why))

    def _kill(self, why: Exit) -> None:
        if self._process is None:
            return
        if paused := lifeline.stopped(self._process.pid):
            why = replace(why, detail=f"{why.detail}; it was {paused}")
        if self._process.kill():
            self._killed = self._killed or why

    def _died(self, exited: Exited) -> None:
        assert self._process is not None
        self._exited = exited
        lifeline.kill_group(self._process.pid)
        if self._heartbeat is not None:
            self._heartbeat.stop()
        if self._channel is not None:
            self._channel.go_on()
            self._await_last_words()

    def _await_last_words(self) -> None:
        """Conclude when the last messages of the dead process have had time to arrive."""
        if self._silent:
            self._conclude()
        else:
            self._loop.call_later(_LAST_WORDS_S, self._conclude)

    def _lost(self) -> None:
        self._silent = True
        if self._exited is not None:
            self._conclude()

    def _conclude(self) -> None:
        if self._end.done():
            return
        assert self._process is not None
        assert self._exited is not None
        steps = Steps()  # the supervisor waits for the end, also if the clean-up fails
        if self._channel is not None:
            steps.take("closing the channel", self._channel.close)
        steps.take("ending what it started", self._on_died)
        self._node.stacks.remove(self._path, self.ask_stacks)
        for number, asked in self._asked.items():
            if not asked.done():
                asked.set_result(control.FoundStacks(number, None, f"{self._path}: its process has ended meanwhile"))
        steps.take("giving its descriptors back", self._process.close)
        steps.report(logger, self._path)
        code = self._exited.code
        traceback = self._exiting.traceback if self._exiting is not None else ""
        self._end.set_result(replace(self._classify(code), code=code, traceback=traceback))
        if not self._answer.done():
            self._answer.set_result(None)
        self._tell()

    def _tell(self) -> None:
        if self._up and not self._stopping:
            self.on_end(self._end.result())

    def _classify(self, code: int | None) -> Exit:
        if self._killed is not None and (code is None or code == -signal.SIGKILL):
            return self._killed
        if code is not None and code < 0:
            return Exit("killed", signal_name(-code))
        if self._exiting is not None:
            return Exit(cast("Reason", self._exiting.reason), self._exiting.detail)
        if code is None:
            return Exit("killed", "its exit code is unknown, as the fork server was killed, too")
        return Exit("normal" if code == 0 else "abnormal", f"exit code {code}")


Run = LocalRun | ProcessRun
"""One run of one child. All methods are called on the loop."""


def _start_timeout_s(spec: ChildSpec, node: Node) -> float | None:
    if spec.start_timeout_s is not None or spec.type == "supervisor":  # its children have limits of their own
        return spec.start_timeout_s
    return node.config.start_timeout_s


def _unpack(failed: control.Failed, path: str) -> BaseException:
    """Return the exception of the child, with its traceback as a note. In a worker, since it runs users' code."""
    error: BaseException | None = None
    if failed.error:
        with contextlib.suppress(BaseException):  # its class cannot be imported here: its text and traceback must do
            error = pickling.loads(failed.error)
    if not isinstance(error, BaseException):
        error = StartFailed(f"{path}: {failed.text}", id=path, wanted=failed.wanted)
    elif failed.wanted and not wanted_by(error):  # it has left its causes behind
        cause, error = error, StartFailed(f"{path}: {failed.text}: {failed.wanted}", id=path, wanted=failed.wanted)
        error.__cause__ = cause
    if failed.traceback:
        add_note(error, f"In the process of {path}:\n{failed.traceback}")
    return error


class Life:
    """One run of one child, as its supervisor sees it."""

    def __init__(self, action: StartChild, path: str) -> None:
        self.id = action.id
        self.number = action.run
        self.spec = action.spec
        self.why = action.why
        self.path = path
        self.run: Run | None = None
        self.told_to_stop = asyncio.Event()
        self.began = time.monotonic()
        self.ready_at: float | None = None
        self.since: float | None = None  # the same by the wall clock

    @property
    def pid(self) -> int | None:
        """The id of its process, once it has one."""
        return None if self.run is None else self.run.pid

    @property
    def up_s(self) -> float | None:
        """The seconds since it became ready, by the monotonic clock; None before."""
        return None if self.ready_at is None else time.monotonic() - self.ready_at

    @property
    def facts(self) -> RunFacts:
        """What a record says of it now."""
        ready_s = None if self.ready_at is None else self.ready_at - self.began
        return RunFacts(self.why is Why.RESTART, self.pid, ready_s, self.up_s)
