"""Line: this process's way to the actors of one other process: the messages to send, and the open calls.

No message is sent twice. When the link is lost, every open call fails; the caller decides whether to ask again.

A thread that asks and waits uses a connection of its own (wire/thread_connections.py), but not while messages on the
link may still be in flight: no message overtakes an earlier one, to whichever actor of that process.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

import msgspec

from rr_actors.actors.messaging import dead_letters
from rr_actors.actors.messaging.ask_cycles import Target
from rr_actors.actors.messaging.futures import Reply, fail
from rr_actors.actors.remote.protocol import (
    ASKS,
    PATH_URN,
    Answered,
    Ask,
    Dead,
    Halt,
    HandlerRaised,
    Letter,
    Over,
    Tell,
    Unwatch,
    Watch,
    Watching,
)
from rr_actors.base import pickling
from rr_actors.base.errors import MailboxFull, NotSerializable, RrError, Unavailable
from rr_actors.base.reporting.log import Log
from rr_actors.base.reporting.tracebacks import note_raised
from rr_actors.runtime.event_loop import Dispatcher
from rr_actors.runtime.time_limits import deadline_of
from rr_actors.wire.segments import Lie
from rr_actors.wire.thread_connections import BlockingLink, ThreadConnections
from rr_actors.wire.transport import Hello, Link, NotAnswering
from rr_actors.wire.unix_sockets import pid_of
from rr_actors.wire.unix_transport import UnixTransport

logger = Log("rr_actors")

WAITING_LIMIT = 100_000
RETRY_S = 0.01

_numbers = itertools.count(1)


class Whereabouts(msgspec.Struct):
    """Where to find an actor.

    Attributes:
        target: the actor's URN and its name for people.
        path: its path in the tree, if it is supervised; the directory has the address of its process.
        address: otherwise, the address of its process.
        ended_at: the address where it has ended, as this process knows; it is not there again.
    """

    target: Target
    path: str | None
    address: str
    ended_at: str = ""


class PendingCall(msgspec.Struct, frozen=True):
    """A call that waits for its answer.

    Attributes:
        begun: of a watch: called when the other process confirms it. The watch fails with Cut if its link is lost.
    """

    number: int
    reply: Reply[Any]
    where: Whereabouts
    begun: Callable[[], None] | None = None


class Arrived(msgspec.Struct, frozen=True):
    """An Answered whose body is a Parcel. `open` makes the value."""

    open: Callable[[], Any]


class Cut(Exception):
    """The link to the actor's process was lost, or could not be opened."""


class Line:
    """The messages for one address. Call its methods on the loop, except where they say otherwise.

    Attributes:
        parcels: the large values on the link.
        connections: those by which threads ask and wait.

    Args:
        hello: the Hello with which the link is opened; its `to` is the address.
        missing: makes the error for an actor that is not there.
        forget: called with the line when its link is lost, before its calls fail.
    """

    def __init__(
        self,
        dispatcher: Dispatcher,
        transport: UnixTransport,
        hello: Hello,
        missing: Callable[[Whereabouts], Exception],
        forget: Callable[[Line], None],
    ) -> None:
        self.address = hello.to
        self.parcels = transport.segments.parcels(pid_of(hello.to))
        self._dispatcher = dispatcher
        self._transport = transport
        self._hello = hello
        self._missing = missing
        self._forget = forget
        self._waiting: deque[tuple[Letter, PendingCall | None]] = deque()
        self._calls: dict[int, PendingCall] = {}
        self._turn = 0  # how often _pump() has run
        self._woken_for = -1  # the turn that the loop was last asked for
        self._link: Link | None = None
        self._peer = hello.to
        self._connecting: asyncio.Task[None] | None = None
        self._retry: asyncio.TimerHandle | None = None
        self.connections = ThreadConnections(self._dial)
        self._lock = threading.RLock()  # for _unsettled; a finalizer that tells may run in the thread that holds it
        self._unsettled: int | None = None  # the call number of the last letter, 0 if it has no answer
        self._left: set[BlockingLink] = set()  # with letters that may be unread; until then the link sends nothing

    @staticmethod
    def next_number() -> int:
        """Return a number that no other call of this process has. From any thread."""
        return next(_numbers)

    def put(self, letter: Letter, call: PendingCall | None = None) -> None:
        """Send the letter after all earlier ones; `call` is answered or fails later. From any thread.

        Raises:
            MailboxFull: WAITING_LIMIT letters wait: the other process does not read.
            Unavailable: this process's loop has ended.
        """
        if len(self._waiting) >= WAITING_LIMIT and not isinstance(letter, Halt | Watch | Unwatch):
            raise MailboxFull(
                f"{WAITING_LIMIT} messages wait for the process at {self.address}, the limit: it does not read; "
                "send less, or ask instead of telling",
                name=self.address,
                limit=WAITING_LIMIT,
            )
        with self._lock:
            self._unsettled = 0 if call is None else call.number
            self._waiting.append((letter, call))
        woken_for = self._woken_for
        turn = self._turn
        if woken_for != turn:
            self._dispatcher.call(self._pump)
            self._woken_for = turn  # last: if the thread is interrupted before this, the next one calls _pump()

    @property
    def open_calls(self) -> int:
        """How many calls wait for their answers, which come by the link. From any thread."""
        return len(self._calls)

    @property
    def may_ask(self) -> bool:
        """Whether ask() may succeed: no earlier letter may be in flight. From any thread."""
        return self._unsettled is None and self._link is not None and not (self._left or self._dispatcher.closed)

    def ask(
        self, letter: Ask, timeout_s: float | None, large: pickling.Large | None = None
    ) -> Answered | Arrived | HandlerRaised | Dead | None:
        """Send the letter by a connection of the calling thread alone, and wait; None if this is impossible now.

        From any thread that may block.

        Args:
            large: the value to send, instead of the letter's body.

        Raises:
            MailboxFull: no segment has room for the value.
            TimeoutError: no answer came in time.
            OSError: the connection is lost; the letter may have arrived.
            NotSerializable: the letter is too long for a frame.
        """
        deadline = deadline_of(timeout_s)
        line = self.connections.take(timeout_s) if self.may_ask else None
        if line is None:
            return None
        try:
            if large is not None:
                letter = msgspec.structs.replace(letter, body=line.parcels.pack(large))
            answer = line.exchange(letter, deadline)
            if isinstance(answer, (Answered, HandlerRaised, Dead)) and answer.call == letter.call:
                if type(answer) is Answered and not isinstance(answer.body, bytes):
                    answer = Arrived(line.parcels.claim(answer.body))
                self.connections.give_back(line)
                return answer
        except Lie as error:
            self.connections.drop(line)
            raise ConnectionResetError(f"the process at {self.address} is cut off: {error}") from error
        except (NotSerializable, Unavailable):
            self.connections.give_back(line)
            raise
        except TimeoutError:
            self._leave(line)
            raise
        except OSError:
            self.connections.drop(line)
            raise
        except BaseException:  # such as KeyboardInterrupt
            self._leave(line)
            raise
        self.connections.drop(line)
        raise ConnectionResetError(f"the process at {self.address} sent {type(answer).__name__} instead of the answer")

    def give_up(self, number: int) -> None:
        """Forget a call whose answer nobody waits for any more. From any thread."""
        self._dispatcher.call(self._calls.pop, number, None)

    def call_off(self, number: int) -> None:
        """End the Watch with this number. From any thread."""
        with contextlib.suppress(Unavailable):  # the loop has ended
            self._dispatcher.call(self._call_off, number)

    def close(self) -> None:
        """Close the link, and fail the open calls."""
        if self._connecting is not None:
            self._connecting.cancel()
        if self._link is not None:
            self._link.close()
        else:
            self._fail(Unavailable("this process is stopping"))

    # -- Receiver ------------------------------------------------------------------------------------------------------

    def received(self, link: Link, message: Letter) -> None:
        """Take an answer from the other process."""
        if not isinstance(message, (Answered, HandlerRaised, Dead, Watching, Over)):
            logger.error("%s sent %s on a link that this process opened", link.peer, type(message).__name__)
            link.close()
            return
        if isinstance(message, Watching):
            call = self._calls.get(message.call)
            if call is not None and call.begun is not None:
                call.begun()
            return
        answer = message
        if type(answer) is Answered and not isinstance(answer.body, bytes):
            answer = Arrived(self.parcels.claim(answer.body))
        with self._lock:
            if self._unsettled == message.call:
                self._unsettled = None
        call = self._calls.pop(message.call, None)
        if call is not None:  # not given up
            self.answer(call, answer)

    def answer(self, call: PendingCall, message: Answered | Arrived | HandlerRaised | Dead | Over) -> None:
        """Set the call's reply. From any thread."""
        match message:
            case Answered():
                body = message.body
                if isinstance(body, bytes):  # a Parcel has become an Arrived
                    call.reply.set_unopened(lambda: pickling.loads(body))
            case Arrived():
                call.reply.set_unopened(message.open)
            case HandlerRaised():
                origin = f"{call.where.target.name} in {self._peer}"
                call.reply.set_unopened(lambda: _reraise(message, origin), raises=True)
            case Over():
                call.reply.set(message)
            case Dead():
                if call.where.path is None:
                    call.where.ended_at = call.where.address
                fail(call.reply, self._missing(call.where))

    def lost(self, link: Link, reason: Exception | None) -> None:
        """Fail the open calls: the other process has ended, or the link is closed."""
        self._link = None
        self._fail(reason)

    # -- on the loop ---------------------------------------------------------------------------------------------------

    def _call_off(self, number: int) -> None:
        if self._calls.pop(number, None) is not None and self._link is not None:
            self.put(Unwatch(number))
            return
        for entry in list(self._waiting):
            if entry[1] is not None and entry[1].number == number:
                self._waiting.remove(entry)

    def _pump(self) -> None:
        self._turn += 1
        if self._left:
            return
        link = self._link
        if link is None:
            if self._connecting is None and self._waiting:
                self._connecting = asyncio.get_running_loop().create_task(self._connect())
            return
        while self._waiting:
            letter, call = self._waiting[0]
            try:
                link.send(letter)
            except MailboxFull:  # the link's limit is in bytes; it does not report when there is room again
                if self._retry is None:
                    self._retry = asyncio.get_running_loop().call_later(RETRY_S, self._try_again)
                break
            except RrError as error:  # too long for a frame
                if call is not None:
                    fail(call.reply, error)
                elif isinstance(letter, Tell):
                    _record_lost(letter.to, [letter], str(error))
            else:
                if call is not None:
                    self._calls[call.number] = call
            self._waiting.popleft()
        link.flush()

    def _try_again(self) -> None:
        self._retry = None
        self._pump()

    def _attach(self, link: Link) -> Line:
        self._link = link  # here, not after connect(): the link may be lost before that returns
        self._peer = link.peer
        return self

    async def _connect(self) -> None:
        try:
            connected = False
            while not connected:  # a process that does not answer may go on: each call has a time limit of its own
                with contextlib.suppress(NotAnswering):
                    await self._transport.connect(self.address, self._hello, self._attach)
                    connected = True
        except RrError as error:
            self._fail(error)
        except asyncio.CancelledError:
            self._fail(Unavailable("this process is stopping"))
            raise
        finally:
            self._connecting = None
        self._pump()

    def _fail(self, reason: Exception | None) -> None:
        self._forget(self)
        self.parcels.close()
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None
        self.connections.close()
        for line in list(self._left):  # a copy: threads add to it
            self._close_line(line)
        calls = list(self._calls.values())
        self._calls.clear()
        untold: dict[str, list[Tell]] = {}
        while self._waiting:  # one by one: other threads still append
            letter, call = self._waiting.popleft()
            if isinstance(letter, Tell):
                untold.setdefault(letter.to, []).append(letter)
            elif call is not None:
                calls.append(call)
        for call in calls:
            self.cut_off(call, reason)
        for urn, letters in untold.items():
            _record_lost(urn, letters, f"{dead_letters.LOST_WITH}{self.address}")

    def cut_off(self, call: PendingCall, reason: Exception | None) -> None:
        """Fail a call whose link or connection is lost. From any thread."""
        if call.begun is not None:
            error = Cut()
        elif reason is None or isinstance(reason, Unavailable) or not isinstance(reason, RrError):
            error = self._missing(call.where)
            error.__cause__ = reason
        else:  # the other process runs, and refuses
            error = reason
        fail(call.reply, error)

    # -- connections of threads ----------------------------------------------------------------------------------------

    def _dial(self, timeout_s: float) -> BlockingLink:
        return self._transport.dial(self.address, msgspec.structs.replace(self._hello, kind=ASKS), timeout_s)

    def _leave(self, line: BlockingLink) -> None:
        """Leave a connection with an answer to come; until the question on it has been read, send no later letters."""
        self._left.add(line)  # first: from now on no letter is sent
        if not self.connections.take_out(line):
            self._left.discard(line)
            return
        try:
            self._dispatcher.call(self._await_end, line)
        except Unavailable:  # the loop has ended: no letter is sent any more
            self._left.discard(line)
            line.close()

    def _await_end(self, line: BlockingLink) -> None:
        if self.connections.closed:
            self._close_line(line)
            self._pump()  # another thread may have used this line before it was forgotten
        else:
            line.leave()
            asyncio.get_running_loop().add_reader(line.fileno(), self._look_at_end, line)

    def _look_at_end(self, line: BlockingLink) -> None:
        if line.has_ended():
            self._close_line(line)
            self._pump()

    def _close_line(self, line: BlockingLink) -> None:
        if line in self._left:
            self._left.discard(line)
            asyncio.get_running_loop().remove_reader(line.fileno())
            line.close()


def _record_lost(urn: str, letters: list[Tell], why: str) -> None:
    lost = [dead_letters.Lost(f"{len(letter.body)} bytes") for letter in letters]
    dead_letters.office.record(urn.removeprefix(PATH_URN), lost, why, unheard=len(lost))


def _reraise(raised: HandlerRaised, origin: str) -> Any:
    """Raise the exception of the handler, in the thread that asked: its class may have to be imported."""
    error: BaseException | None = None
    if raised.error:
        try:
            error = pickling.loads(raised.error)
        except BaseException as reason:  # of its class
            logger.debug("an exception of %s cannot be made here: %r", origin, reason)
    if not isinstance(error, Exception):
        error = RrError(raised.text)
    note_raised(error, origin, raised.trace)
    try:
        raise error
    finally:
        del error  # its traceback has this frame
