"""The console's socket: the server accepts consoles of this user, reads their requests, and has workers answer them.

Each connection has one request in flight, and the server does not read the next requests meanwhile. So a program can
hold at most one worker, one answer and one list of events, and the system waits for no program.
"""

from __future__ import annotations

import asyncio
import functools
import os
import select
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from rr_actors.base.errors import ConfigError, MailboxFull, RrError, Unavailable, UsageError
from rr_actors.base.reporting.log import Log
from rr_actors.base.steps import Steps
from rr_actors.base.values.failure import failure_of
from rr_actors.hosting.forwarded_logs import KeptLogs
from rr_actors.registrar.engine.node import Node
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.connected_registrars import Caller
from rr_actors.system.console.console_commands import AwaitStatuses, Hold, OpenRegistrar
from rr_actors.system.console.console_feed import Feed, Reader
from rr_actors.system.console.console_protocol import REQUESTS, decoder_of
from rr_actors.system.console.console_view import Command, Look, Verb, View, Viewed
from rr_actors.system.console.running_systems import ListedSystem
from rr_actors.system.event_subscribers import Subscribers
from rr_actors.system.recording.event_memory import EventMemory
from rr_actors.system.recording.recordings import Recordings
from rr_actors.wire.frames import FrameReader, framed
from rr_actors.wire.unix_sockets import Refusals, SocketDir, peer_of

logger = Log("rr_actors")

SOCKETS_LIMIT = 256
"""The most sockets of one connected program, and the most that have not said Hello yet; further ones are refused."""
FRAME_S = 5.0
"""Seconds that a program may take for its first message, and for the rest of a message that it has begun."""
STALLED_S = 30.0
"""Seconds that a program may leave an answer unread."""
LOOK_S = 5.0
"""Seconds after which the server looks again whether a program has left whose requests it does not read yet."""
_AGAIN_S = 0.1


class Console:
    """The console of one running system. On the loop; open() and close() are awaited there.

    Args:
        subscribers, recordings: the system's; the console's feed uses them.
        memory: what has happened in the system.
        child_logs: the last log lines of its children.
        shut_down: stops the system, in a thread of its own.
    """

    def __init__(
        self,
        system: Viewed,
        node: Node,
        subscribers: Subscribers,
        recordings: Recordings,
        memory: EventMemory,
        child_logs: KeptLogs,
        shut_down: Callable[[], None],
    ) -> None:
        self.node = node
        self.decoder = decoder_of(REQUESTS)
        self.view = View(system, node, memory, child_logs, shut_down)
        self.feed = Feed(subscribers, recordings)
        self.welcome = c.Welcome(c.VERSION, system.name, os.getpid(), node.info.state_dir, self.view.since)
        self.sockets: set[ConsoleSocket] = set()
        self.programs: Counter[object] = Counter()  # the sockets of each; of "", those that have not said Hello yet
        self.connections_limit = node.info.config.connections_limit
        self.refusals = Refusals(logger)
        self.stopping = False  # then commands are refused; the feed goes on
        self._sockets = SocketDir(Path(node.info.run_dir))
        self._server: asyncio.AbstractServer | None = None
        self._making: asyncio.Task[None] | None = None
        self._entry = ListedSystem(Path(node.info.run_dir))
        self._entering: asyncio.Future[None] | None = None

    async def open(self) -> None:
        """Listen, and put the system into the list of this user's running systems.

        Raises:
            ConfigError: the socket cannot be made.
        """
        await self._serve()
        self.node.keeper.also.append(self._keep)
        self._entering = asyncio.ensure_future(self.node.dispatcher.workers.run(self._entry.make))
        try:
            await asyncio.shield(self._entering)  # after an interrupted start, close() takes the entry out again
        except ConfigError as error:
            logger.warning("system %s: it is found by its state directory alone: %s", self.node.info.name, error)

    async def _serve(self) -> None:
        listener = self._sockets.bind(c.SOCKET)
        loop = asyncio.get_running_loop()
        made = await loop.create_unix_server(lambda: ConsoleSocket(self), sock=listener, start_serving=False)
        lost, self._server = self._server, made
        if lost is not None:
            lost.close()
        await made.start_serving()

    def _keep(self) -> None:
        """Make the socket again if its file was removed."""
        if self._server is not None and not self._sockets.has(c.SOCKET):
            self._making = asyncio.get_running_loop().create_task(self._serve())

    def counted(self, program: object, change: int) -> None:
        """Count a socket of a program that has come or gone."""
        self.programs[program] += change
        if not self.programs[program]:
            del self.programs[program]

    def leave_to_parent(self) -> None:
        """Give up, in a forked child, the lock that says that the parent lives."""
        self._entry.forget()

    async def close(self) -> None:
        """Stop listening, and close every connection. Try each step. A second close does nothing."""
        server, self._server = self._server, None
        entering, self._entering = self._entering, None
        steps = Steps()
        if self._making is not None:
            self._making.cancel()
        if entering is not None:
            await asyncio.wait((entering,))
            if entering.exception() is None:
                removing = self.node.dispatcher.workers.run(self._entry.remove)
                await steps.take_async("taking it out of the list of running systems", removing)
        steps.take("ending the feed", self.feed.close)
        self.refusals.close()
        if server is not None:
            steps.take("closing the console's socket", server.close)
            steps.take("removing the console's socket", self._sockets.unlink, c.SOCKET)
        for socket in list(self.sockets):
            steps.take("closing a console's connection", socket.end)
        steps.take("closing the directory of sockets", self._sockets.close)
        await asyncio.sleep(0)  # in its next turn the loop closes the transports that were ended
        await asyncio.sleep(0)
        steps.end("the console is not closed altogether")

    def answered(self, request: c.Message, caller: Caller) -> tuple[bytes, str]:
        """Return the frame that answers a request, and the id of the query that it loaded for one. In a worker."""
        name = type(request).__name__
        try:
            if not isinstance(request, Verb):
                raise UsageError(f"{name}: this connection has said Hello already")
            verb = cast("Verb[c.Message]", request)
            self._check_stopping(verb, Command, Look)
            answer = verb.carry_out(self.view, caller)
            self._check_stopping(verb, Look)  # a part of it may have been taken apart meanwhile
            frame = framed(answer, c.ANSWER_LIMIT_BYTES, "the longest answer of a console")
            return frame, answer.query_id if isinstance(answer, c.Holding) else ""
        except Exception as error:
            if not isinstance(error, RrError):
                logger.exception("console: %s failed", name)
            return refusal(error), ""

    def _check_stopping(self, request: Verb[Any], *refused: type[Verb[Any]]) -> None:
        if self.stopping and isinstance(request, refused):
            raise Unavailable(f"system {self.node.info.name!r} is stopping")

    def missed(self, count: int, seq: int) -> bytes:
        """Return the frame for a reader that was too slow. In a worker."""
        return framed(c.Missed(count, seq, self.view.children()), c.ANSWER_LIMIT_BYTES)


def refusal(error: BaseException) -> bytes:
    """Return the frame that says that a request has failed, and why."""
    return framed(c.Refused(failure_of(error)), c.ANSWER_LIMIT_BYTES)


class ConsoleSocket(asyncio.Protocol):
    """The socket of one console."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._frames = FrameReader(console.decoder, c.REQUEST_LIMIT_BYTES)
        self._transport: asyncio.Transport
        self._requests: list[c.Message] = []
        self._timer: asyncio.TimerHandle | None = None
        self._greeted = False
        self._busy = False
        self._blocked = False
        self._ended = False
        self._looks = False  # whether the loop will look for the program
        self._reader: Reader | None = None
        self._has_registrars = False
        self.program: object = ""  # what all sockets of one rr.Connection have in common
        self.pid = 0
        self._unheard: tuple[str, ...] = ()  # the registrar and query of the last answer, until Keep

    @property
    def is_gone(self) -> bool:
        """Whether the program has left, or is being left. From any thread: the loop may not have noticed it yet."""
        poll = select.poll()
        try:
            poll.register(self._transport.get_extra_info("socket"), select.POLLRDHUP)
            return self._ended or bool(poll.poll(0))
        except ValueError:  # the loop has just closed it
            return True

    @property
    def unread_bytes(self) -> int:
        """How many bytes of answers wait here, because the program does not read."""
        return self._transport.get_write_buffer_size()

    # -- called by asyncio -------------------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Accept the console, if it is this user's and there is room."""
        self._transport = cast("asyncio.Transport", transport)
        peer = peer_of(transport)
        self.pid = peer.pid
        if not peer.trusted:
            self._console.refusals.note(f"console: refused {peer}, of user {peer.uid}")
            self._transport.abort()
            self._ended = True
        elif self._console.programs[""] >= SOCKETS_LIMIT:
            self._leave(Unavailable(f"{SOCKETS_LIMIT} consoles are connected already that have not said Hello yet"))
        else:
            self._console.sockets.add(self)
            self._console.programs[""] += 1
            self._set_timer(FRAME_S)

    def data_received(self, data: bytes) -> None:
        """Take the requests that `data` completes; refuse and disconnect a program that breaks the rules."""
        if self._ended:
            return
        self._requests += self._frames.feed(data)
        if self._frames.error is not None or self._frames.ended:
            self._requests.clear()
            self._leave(self._frames.error or UsageError("expected a request, got a frame of 0 bytes"))
        elif self._reader is not None:
            self._leave(UsageError("a connection that follows the events takes no further requests: open another"))
        else:
            self._next()
            if self._requests:  # otherwise read on, to notice a program that leaves
                self._transport.pause_reading()
                if not self._looks:
                    self._look_later()

    def _look_later(self) -> None:
        self._looks = True
        asyncio.get_running_loop().call_later(LOOK_S, self._look_for_program)

    def _look_for_program(self) -> None:
        """Abort the connection if the program has left: while nothing is read, the transport does not notice that."""
        self._looks = False
        if self._ended or self._transport.is_reading():
            return
        if self.is_gone:
            self._transport.abort()
        else:
            self._look_later()

    def eof_received(self) -> bool:
        """Close the connection: the program sends no more, and its last request is not answered either."""
        self.end()
        return False

    def pause_writing(self) -> None:
        """Hold back further answers and events, because the program does not read."""
        self._blocked = True
        if self._reader is not None:
            self._reader.is_blocked = True
        else:
            self._set_timer(STALLED_S)

    def resume_writing(self) -> None:
        """Go on with answers and events, because the program reads again."""
        self._blocked = False
        self._stop_timer()
        if self._reader is not None:
            self._reader.is_blocked = False
            self._reader.flush()
        else:
            self._next()

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the console, which has gone, and close its registrars."""
        self._ended = True
        self._stop_timer()
        self._requests.clear()
        if self in self._console.sockets:
            self._console.sockets.remove(self)
            self._console.counted(self.program, -1)
        if self._reader is not None:
            self._console.feed.remove(self._reader)
        self._release_unheard()
        if self._has_registrars:
            self._clean_up(self._console.view.connected.close, self)

    def _release_unheard(self) -> None:
        unheard, self._unheard = self._unheard, ()
        if unheard:
            self._clean_up(self._console.view.connected.release_unheard, *unheard)

    def _clean_up(self, fn: Callable[..., None], *args: Any) -> None:
        """Have a worker release what the program has left, after an opening that may still be in progress."""
        try:
            self._console.node.dispatcher.workers.serial(self, fn, *args)
        except MailboxFull:
            asyncio.get_running_loop().call_later(_AGAIN_S, self._clean_up, fn, *args)
        except Unavailable:  # the process is closing, and with it all its registrars
            logger.debug("the registrars of a program are closed with the system")

    # -- requests ----------------------------------------------------------------------------------------------------

    def _next(self) -> None:
        """Begin with the next request, if the last one is answered and the program has read the answer."""
        if self._ended or self._busy or self._blocked:
            return
        while self._greeted and self._requests and isinstance(self._requests[0], c.Keep):
            self._unheard = ()
            del self._requests[0]
        if not self._requests:
            if self._frames.is_waiting or not self._greeted:
                if self._timer is None:
                    self._set_timer(FRAME_S)
            else:
                self._stop_timer()
            self._transport.resume_reading()
            return
        self._stop_timer()
        request = self._requests.pop(0)
        if not self._greeted:
            self._greet(request)
        elif isinstance(request, c.Follow | c.BeginRecording):
            self._follow(request)
        else:
            self._begin(request)

    def _greet(self, request: c.Message) -> None:
        if not isinstance(request, c.Hello) or request.version != c.VERSION:
            said = f"version {request.version}" if isinstance(request, c.Hello) else type(request).__name__
            self._leave(
                Unavailable(f"console: expected Hello of version {c.VERSION}, got {said}: use the same rr_actors")
            )
            return
        programs, limit = self._console.programs, self._console.connections_limit
        program = request.program or self
        if program not in programs and len(programs) - ("" in programs) >= limit:
            self._leave(
                Unavailable(f"{limit} programs are connected already: close a connection, or raise connections_limit")
            )
            return
        if programs[program] >= SOCKETS_LIMIT:
            self._leave(Unavailable(f"this connection has {SOCKETS_LIMIT} sockets already, one for each call"))
            return
        self._console.counted("", -1)
        self._console.counted(program, 1)
        self.program = program
        self._greeted = True
        self._transport.write(framed(self._console.welcome, c.ANSWER_LIMIT_BYTES))
        self._next()

    def _begin(self, request: c.Message) -> None:
        self._busy = True
        self._release_unheard()
        if isinstance(request, AwaitStatuses) and not self._console.view.connected.has_statuses(
            request.registrar, self, functools.partial(self._begin_again, request)
        ):
            return
        workers = self._console.node.dispatcher.workers
        answer = self._console.answered, request, self
        try:
            if isinstance(request, OpenRegistrar):
                self._has_registrars = True
                workers.serial(self, *answer, done=functools.partial(self._answered, request))
            else:
                workers.submit(*answer, done=functools.partial(self._answered, request))
        except Unavailable as error:
            self._answered(request, (refusal(error), ""), None)

    def _begin_again(self, request: AwaitStatuses) -> None:
        """Answer a request for statuses, as one has arrived. From any thread."""
        self._console.node.dispatcher.call(lambda: None if self._ended else self._begin(request))

    def _answered(self, request: c.Message, answer: tuple[bytes, str] | None, error: BaseException | None) -> None:
        self._busy = False
        frame, query_id = answer or (refusal(error or Unavailable("it was not answered")), "")
        self._unheard = (request.registrar, query_id) if query_id and isinstance(request, Hold) else ()
        if self._ended:
            self._release_unheard()
        else:
            self._transport.write(frame)
            self._next()

    # -- the feed ----------------------------------------------------------------------------------------------------

    def _follow(self, follow: c.Follow | c.BeginRecording) -> None:
        if self._requests or self._frames.is_waiting:
            self._leave(UsageError("a connection that follows the events takes no further requests: open another"))
            return
        feed = self._console.feed
        self._reader = Reader(follow, self._transport.write, self._tell_missed)
        self._transport.write(framed(c.Following(0 if self._reader.records else feed.seq), c.ANSWER_LIMIT_BYTES))
        feed.add(self._reader)
        self._transport.resume_reading()  # it was paused if the request had waited for an answer

    def _tell_missed(self) -> None:
        assert self._reader is not None
        count, seq = self._reader.take_missed()
        try:
            self._console.node.dispatcher.workers.submit(self._console.missed, count, seq, done=self._told_missed)
        except Unavailable as error:
            self._leave(error)

    def _told_missed(self, frame: bytes | None, error: BaseException | None) -> None:
        if self._ended or self._reader is None:
            return
        if frame is None:
            self._leave(error or Unavailable("the tree could not be looked at"))
            return
        self._transport.write(frame)
        self._reader.caught_up()

    # -- the end -----------------------------------------------------------------------------------------------------

    def end(self) -> None:
        """Send what is written, and close the connection; at once, if the program does not read."""
        self._ended = True
        if self._reader is not None:
            self._console.feed.remove(self._reader)
        if self._blocked:
            self._transport.abort()
        else:
            self._set_timer(STALLED_S)  # the program may never read the rest
            self._transport.close()

    def _leave(self, error: BaseException) -> None:
        """Send the error, and close the connection."""
        self._transport.write(refusal(error))
        self.end()

    def _set_timer(self, seconds: float) -> None:
        self._stop_timer()
        self._timer = asyncio.get_running_loop().call_later(seconds, self._too_slow)

    def _stop_timer(self) -> None:
        timer, self._timer = self._timer, None
        if timer is not None:
            timer.cancel()

    def _too_slow(self) -> None:
        self._timer = None
        self._ended = True
        self._transport.abort()
