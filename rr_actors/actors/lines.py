"""Line: this process's way to the actors of one other process: what waits to be sent, and which calls are open.

Nothing is sent twice. When the link is lost, every open call fails; whoever asked decides whether to ask again.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
from collections import deque
from collections.abc import Callable
from typing import Any

import msgspec

from rr_actors import pickling
from rr_actors.actors import dead_letters
from rr_actors.actors.asking import Target
from rr_actors.actors.dispatcher import Dispatcher
from rr_actors.actors.letters import Answered, Dead, Halt, Letter, Over, Raised, Tell, Unwatch, Watch, Watching
from rr_actors.actors.replies import Reply, fail
from rr_actors.errors import MailboxFull, RrError, Unavailable
from rr_actors.transport import Hello, Link, Transport

logger = logging.getLogger("rr_actors")

WAITING_LIMIT = 100_000
RETRY_S = 0.01

_numbers = itertools.count(1)


class Whereabouts(msgspec.Struct, frozen=True):
    """How to find an actor.

    Attributes:
        target: its URN and its name for people.
        path: its path in the tree, if it is supervised; who has it, the directory says.
        address: otherwise, the address of the process it lives in.
    """

    target: Target
    path: str | None
    address: str


class Call(msgspec.Struct, frozen=True):
    """A call that waits for its answer.

    Attributes:
        missing: makes the error for an actor that is not there.
        cut: makes the error for a link that is lost; by default `missing` does.
        begun: called when the other process says that it watches.
    """

    number: int
    reply: Reply[Any]
    name: str
    missing: Callable[[], Exception]
    cut: Callable[[], Exception] | None = None
    begun: Callable[[], None] | None = None


class Line:
    """The messages for one address. put() may be called from any thread, everything else runs on the loop.

    Args:
        hello: what the link is opened with.
        forget: called with the line when its link is lost, before its calls fail.
    """

    def __init__(
        self,
        dispatcher: Dispatcher,
        transport: Transport,
        address: str,
        hello: Hello,
        forget: Callable[[Line], None],
    ) -> None:
        self.address = address
        self._dispatcher = dispatcher
        self._transport = transport
        self._hello = hello
        self._forget = forget
        self._waiting: deque[tuple[Letter, Call | None]] = deque()
        self._calls: dict[int, Call] = {}
        self._woken = False
        self._link: Link | None = None
        self._connecting: asyncio.Task[None] | None = None
        self._retry: asyncio.TimerHandle | None = None

    @staticmethod
    def next_number() -> int:
        """A number for a call, of no other call of this process."""
        return next(_numbers)

    def put(self, letter: Letter, call: Call | None = None) -> None:
        """Send the letter, after those before it; `call` is answered or fails later.

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
        self._waiting.append((letter, call))
        if not self._woken:
            self._woken = True
            self._dispatcher.call(self._pump)

    def give_up(self, number: int) -> None:
        """Nobody waits for the answer any more. From any thread."""
        self._dispatcher.call(self._calls.pop, number, None)

    def call_off(self, number: int) -> None:
        """The Watch with this number is not wanted any more. From any thread."""
        try:
            self._dispatcher.call(self._call_off, number)
        except Unavailable:
            logger.debug("a watch was called off after the loop had ended")

    def close(self) -> None:
        """Close the link; open calls fail."""
        if self._connecting is not None:
            self._connecting.cancel()
        if self._link is not None:
            self._link.close()
        else:
            self._fail(Unavailable("this process is stopping"))

    # -- Receiver ------------------------------------------------------------------------------------------------------

    def received(self, link: Link, message: Letter) -> None:
        """An answer."""
        if not isinstance(message, (Answered, Raised, Dead, Watching, Over)):
            logger.error("%s sent %s on a link that this process opened", link.peer, type(message).__name__)
            link.close()
            return
        if isinstance(message, Watching):
            call = self._calls.get(message.call)
            if call is not None and call.begun is not None:
                call.begun()
            return
        call = self._calls.pop(message.call, None)
        if call is None:
            return  # given up
        match message:
            case Answered():
                call.reply.set_unopened(lambda: pickling.loads(message.body))
            case Raised():
                origin = f"{call.name} in {link.peer}"
                call.reply.set_unopened(lambda: _reraise(message, origin))
            case Over():
                call.reply.set(message)
            case Dead():
                fail(call.reply, call.missing())

    def lost(self, link: Link, reason: Exception | None) -> None:
        """The other process is gone, or closed the link."""
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
        self._woken = False
        link = self._link
        if link is None:
            if self._connecting is None and self._waiting:
                self._connecting = asyncio.get_running_loop().create_task(self._connect())
            return
        while self._waiting:
            letter, call = self._waiting[0]
            try:
                link.send(letter)
            except MailboxFull:  # by the link's measure, bytes; it tells nobody when there is room again
                if self._retry is None:
                    self._retry = asyncio.get_running_loop().call_later(RETRY_S, self._try_again)
                break
            except RrError as error:  # too long for a frame
                if call is None:
                    logger.error("a message to the process at %s was not sent: %s", self.address, error)
                else:
                    fail(call.reply, error)
            else:
                if call is not None:
                    self._calls[call.number] = call
            self._waiting.popleft()
        link.flush()

    def _try_again(self) -> None:
        self._retry = None
        self._pump()

    def _attach(self, link: Link) -> Line:
        self._link = link  # here, not after connect(): it may be lost before that returns
        return self

    async def _connect(self) -> None:
        try:
            await self._transport.connect(self.address, self._hello, self._attach)
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
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None
        calls = list(self._calls.values())
        self._calls.clear()
        untold: dict[str, list[dead_letters.Lost]] = {}
        while self._waiting:  # one by one: other threads still append
            letter, call = self._waiting.popleft()
            if isinstance(letter, Tell):
                untold.setdefault(letter.to, []).append(dead_letters.Lost(len(letter.body)))
            elif call is not None:
                calls.append(call)
        for call in calls:
            if call.cut is not None:
                error = call.cut()
            elif reason is None or isinstance(reason, Unavailable) or not isinstance(reason, RrError):
                error = call.missing()
                error.__cause__ = reason
            else:  # the peer is there and refuses
                error = reason
            fail(call.reply, error)
        for urn, lost in untold.items():
            name = urn.removeprefix("urn:rr-actor:")
            dead_letters.office.record(name, lost, f"lost with its process at {self.address}", unheard=len(lost))


def _reraise(raised: Raised, origin: str) -> Any:
    """Raise what the handler raised; in the thread that asked, since its class may have to be imported."""
    error: BaseException | None = None
    if raised.error:
        try:
            error = pickling.loads(raised.error)
        except Exception as reason:
            logger.debug("an exception of %s cannot be made here: %r", origin, reason)
    if not isinstance(error, Exception):
        error = RrError(raised.text)
    error.add_note(f"raised by {origin}:\n{raised.trace.rstrip()}")
    raise error
