"""The main program of a child's process: host one actor, report to the supervisor, leave."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import importlib
import inspect
import os
import signal
import socket
import sys
from pathlib import Path
from typing import Any

from rr_actors.actors.actor import ExitReport
from rr_actors.actors.remote.protocol import CODECS
from rr_actors.base import pickling
from rr_actors.base.errors import NotSerializable, Unavailable, text_of
from rr_actors.base.reporting import log
from rr_actors.base.reporting.log import Log
from rr_actors.base.scarcity import wanted_by
from rr_actors.hosting import forwarded_logs
from rr_actors.hosting.process_node import SystemInfo
from rr_actors.registrar.engine.node import MESSAGES, Node
from rr_actors.runtime import event_loop, interpreter
from rr_actors.runtime.callback_errors import raised_by
from rr_actors.runtime.processes.fork_server import Inherited
from rr_actors.storage.opening import open_catalog, remove_catalogs
from rr_actors.supervision import control_channel as control
from rr_actors.supervision.core.specs import ChildSpec, Shutdown
from rr_actors.supervision.heartbeat import ProcessHealth
from rr_actors.supervision.hosted import Hosted, prepare
from rr_actors.supervision.supervisor import target_of
from rr_actors.wire.frames import decoder_of

logger = Log("rr_actors")

# The fork server imports this module, and these two with it, and makes these decoders: a child has them already.
for _module in ("concurrent.futures.thread", "uvloop"):
    with contextlib.suppress(ImportError):  # uvloop need not be installed
        importlib.import_module(_module)
for _messages in (control.Message, *MESSAGES.values(), *CODECS.values()):
    decoder_of(_messages)

_CLOSE_S = 2.0


def main(inherited: Inherited) -> int:
    """Run the child that the payload describes. Return the exit code: 0 after a normal end or a shutdown, else 1."""
    interpreter.begin()
    info, path, spec, classes = pickling.loads(inherited.payload)
    interpreter.name_process(f"rr: {path.rpartition('/')[2]}")
    sys.breakpointhook = functools.partial(_break, path)
    dispatcher = event_loop.acquire()  # to the end of the process: its last messages are sent after its node has ended
    child = ChildProcess(inherited, info, path, spec, classes)

    def terminate(_number: int, _frame: object) -> None:
        if not dispatcher.closed:
            dispatcher.call(child.terminate)

    interpreter.handle_signal(signal.SIGTERM, terminate)
    return dispatcher.course(child.live()).wait()  # no handler of this thread raises, so no other thread shields it


def _break(path: str, *args: Any, **kwargs: Any) -> Any:
    """Replace sys.breakpointhook: a child has no standard input for Python's own debugger."""
    if "PYTHONBREAKPOINT" in os.environ:
        return sys.__breakpointhook__(*args, **kwargs)
    debugger = importlib.import_module("rr_actors.runtime.processes.terminal_debugger")  # it takes 10 ms
    frame: Any = inspect.currentframe()
    return debugger.break_at(frame.f_back, path.rpartition("/")[2])


class ChildProcess:
    """This process, which runs one child. Used on the loop.

    Args:
        spec: the pickled ChildSpec. A worker unpickles it, since that may import users' modules.
        classes: pickled classes that bring their codecs.
    """

    def __init__(self, inherited: Inherited, info: SystemInfo, path: str, spec: bytes, classes: list[bytes]) -> None:
        self.node = Node(info, path, on_event=self._tell, open_catalog=open_catalog, remove_unneeded=remove_catalogs)
        self.node.on_death_in_callback = lambda runs, proven: self._say(control.DiedInCallback(runs, proven))
        self.node.on_acquitted = lambda: self._say(control.CallbacksAcquitted())
        self.node.on_resumed = self._resumed
        self._has_resumed = False
        self._health = ProcessHealth(self._directories)
        self._inherited = inherited
        self._path = path
        self._spec = spec
        self._classes = classes
        self._shutdown_s: Shutdown  # from the specification
        self._channel: control.Channel | None = None
        self._hosted: Hosted | None = None
        loop = self.node.dispatcher.loop
        self._told_to_start: asyncio.Future[control.Start] = loop.create_future()
        self._told_to_stop: asyncio.Future[None] = loop.create_future()
        self._stop: control.Stop | None = None
        self._is_limited = False  # the parent limits the stops that it asks for
        self._looking: set[asyncio.Task[None]] = set()
        self._report: asyncio.Future[ExitReport] = loop.create_future()  # of an actor that has ended by itself

    async def live(self) -> int:
        """Run the child until its end, and return the exit code."""
        self._channel = await control.Channel.open(self._inherited.control, self._path, self._received, self.terminate)
        info = self.node.info
        if info.config.logging:  # from here on, since the import of users' modules logs, too
            forwarded_logs.begin(self._path, info.log_levels, self._send_log)
        try:
            await self.node.start()
            code = await self._live()
        except Exception as error:
            logger.exception("%s: could not be hosted", self._path)
            self._say(_failed(error))
            code = 1
        await self._close()
        return code

    def terminate(self) -> None:
        """Stop the child gracefully, after SIGTERM or the loss of the supervisor."""
        if self._stop is None:
            self._is_limited = True
            self._stop_as(control.Stop())

    def _stop_as(self, stop: control.Stop) -> None:
        self._stop = stop
        if not self._told_to_stop.done():
            self._told_to_stop.set_result(None)

    async def _live(self) -> int:
        await asyncio.wait((self._told_to_start, self._told_to_stop), return_when=asyncio.FIRST_COMPLETED)
        if self._stop is not None:
            return self._leave(ExitReport("shutdown", "stopped before it was started"))
        try:
            if not await self._start():
                self._say(control.Ignored())
                return 0
        except Exception as error:
            if self._stop is not None:
                return self._leave(ExitReport("shutdown", "stopped while it was starting"))
            in_worker = not interpreter.patched()  # no worker can start there
            self._say(await self.node.dispatcher.workers.run(_failed, error) if in_worker else _failed(error))
            return 1
        self._say(control.ChildReady())
        await asyncio.wait((self._told_to_stop, self._report), return_when=asyncio.FIRST_COMPLETED)
        return self._leave(self._report.result() if self._report.done() else await self._stop_actor())

    async def _start(self) -> bool:
        try:
            spec = await self.node.dispatcher.workers.run(self._unpickle)
        finally:
            interpreter.check_not_patched()  # by a module that this has imported
        self._shutdown_s = spec.shutdown_s
        cls, args, kwargs = target_of(spec)
        self._hosted = prepare(self.node, cls, self._path, self._report.set_result, once=spec.restart == "temporary")
        by_hand = self._told_to_start.result().by_hand
        start = self._hosted.start(args, kwargs, None, by_hand=by_hand)  # the parent has the time limit
        starting = asyncio.ensure_future(start)
        await asyncio.wait((starting, self._told_to_stop), return_when=asyncio.FIRST_COMPLETED)
        if not starting.done():
            self._hosted.cut_short()
        return await starting

    def _unpickle(self) -> ChildSpec:
        for blob in self._classes:
            with contextlib.suppress(Exception):  # the child may not need it
                pickling.loads(blob)
        return pickling.loads(self._spec)

    async def _stop_actor(self) -> ExitReport:
        assert self._hosted is not None
        assert self._stop is not None
        limit_s = self._shutdown_s if self._is_limited else "infinity"
        return await self._hosted.stop(limit_s, final=self._stop.final)

    def _leave(self, report: ExitReport) -> int:
        self._say(control.Exiting(report.reason, report.detail, report.traceback))
        return 0 if report.reason in ("normal", "shutdown") else 1

    async def _close(self) -> None:
        try:
            async with asyncio.timeout(_CLOSE_S):
                await self.node.close()
        except TimeoutError:
            logger.warning("%s: closing took longer than %g s; left as it is", self._path, _CLOSE_S)
        except Exception:
            logger.exception("%s: closing", self._path)
        if self._channel is not None:
            await self.node.dispatcher.workers.run(log.flush)
            channel, self._channel = self._channel, None  # log records go to standard error from now on
            await channel.finish(_CLOSE_S)

    # -- messages --------------------------------------------------------------------------------------------------

    def _received(self, message: control.Message) -> None:
        match message:
            case control.Start():
                self._told_to_start.set_result(message)
            case control.Stop():
                self.node.stopping = f"{self._path} is being stopped"
                self._stop_as(message)
            case control.Ping():
                self._say(control.Pong(self._health.trouble()))
            case control.AskStacks():
                task = self.node.dispatcher.loop.create_task(self._find_stacks(message))
                self._looking.add(task)  # the loop itself keeps only weak references
                task.add_done_callback(self._looking.discard)
            case _:
                logger.error("%s: unexpected on the control channel: %r", self._path, message)

    async def _find_stacks(self, asked: control.AskStacks) -> None:
        try:
            found = control.FoundStacks(asked.number, await self.node.stacks.of(asked.path, asked.limit_s))
        except Exception as error:
            found = control.FoundStacks(asked.number, None, text_of(error).partition(": ")[2])
        self._say(found)

    def _directories(self) -> list[Path]:
        """Return the directories this process works in: the system's, and those of its registrars that write."""
        node = self.node
        state_dir = node.info.state_dir
        configs = [registrar.config for registrar in node.registrars.values()]
        catalogs = [config.catalog_path(state_dir).parent for config in configs if config.durability != "none"]
        return [Path(state_dir), *catalogs]

    def _send_log(self, event: dict[str, Any]) -> bool:
        """Send a log record as news, from any thread. Return False if that is not possible any more."""
        if self._channel is None:
            return False
        try:
            self.node.dispatcher.call(self._say, control.News(event))
        except Unavailable:
            return False
        return True

    def _tell(self, event: dict[str, Any]) -> None:
        try:
            self._say(control.News(event))
        except NotSerializable:
            logger.exception("%s: an event that is not plain data: %r", self._path, event)

    def _resumed(self, run: str) -> None:
        """Tell the supervisor of the first such callback: one is enough, and there may be many."""
        if not self._has_resumed:
            self._has_resumed = True
            self._say(control.Resumed(run))

    def _say(self, message: control.Message) -> None:
        if self._channel is not None:
            self._channel.send(message)


def _failed(error: BaseException) -> control.Failed:
    """Return the message for a failed start. In a worker, since pickling runs users' code."""
    raised, wanted = raised_by(error), wanted_by(error)
    try:
        return control.Failed(raised.text, raised.trace, pickling.dumps(raised.error, "exception"), wanted)
    except BaseException:  # then only its text and its traceback are sent
        return control.Failed(raised.text, raised.trace, wanted=wanted)


def could_not_begin(end: socket.socket, error: BaseException) -> None:
    """Send the message of a failed start from a process that has no control channel yet."""
    control.send_first(end, _failed(error))
