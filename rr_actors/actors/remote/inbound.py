"""Visitor: the link of another process that sends letters to the actors of this one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pykka
from pykka import ActorDeadError

from rr_actors.actors.messaging import dead_letters, death_watch
from rr_actors.actors.messaging.ask_cycles import Chain, Target, check_chain
from rr_actors.actors.messaging.exit_reports import ExitReport
from rr_actors.actors.messaging.futures import ExcInfo, error_of
from rr_actors.actors.messaging.mailbox import Envelope, Mailbox, Packed, StopActor, has_ended, put
from rr_actors.actors.messaging.mailbox_looks import ORDERS, carry_out
from rr_actors.actors.messaging.message_notes import Stamp
from rr_actors.actors.remote.protocol import (
    PATH_URN,
    Answered,
    Ask,
    Dead,
    Halt,
    HandlerRaised,
    Inquire,
    Letter,
    Over,
    Tell,
    Unwatch,
    Watch,
    Watching,
)
from rr_actors.actors.remote.proxy import attributes_of
from rr_actors.base import pickling
from rr_actors.base.errors import MailboxFull, NotSerializable, RrError, Unavailable, shortened, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.base.reporting.tracebacks import trace_of
from rr_actors.runtime.event_loop import Dispatcher
from rr_actors.wire.segments import Parcel, Parcels
from rr_actors.wire.transport import Link
from rr_actors.wire.unix_link import UnixLink

logger = Log("rr_actors")

Outgoing = Answered | HandlerRaised | Dead | Watching | Over
Find = Callable[[str], "pykka.ActorRef[Any] | None"]


class Visitor:
    """Takes the letters of another process to this one's actors, and sends the answers back on the same link.

    Args:
        find: returns the reference to the actor of this process with a URN, or None.
        forget: called with the link when it is lost.
        parcels: the large values on the link.
    """

    def __init__(
        self, find: Find, dispatcher: Dispatcher, link: Link, forget: Callable[[Link], None], parcels: Parcels
    ) -> None:
        self._find = find
        self._dispatcher = dispatcher
        self._link = link
        self._forget = forget
        self._parcels = parcels
        self._dirty = False
        self._watches: dict[int, Callable[[], None]] = {}

    def received(self, link: Link, message: Letter) -> None:
        """Take a letter for an actor, or about it."""
        match message:
            case Ask(call, to, body, chain, stamp):
                self._deliver(to, body, call, chain, stamp)
            case Tell(to, body, stamp):
                self._deliver(to, body, None, (), stamp)
            case Inquire(call, to, what) if what in ORDERS:
                self._order(call, to, what)
            case Inquire(call, to, what):
                self._in_turn(to, call, message, self._inquire, call, to, what)
            case Halt(call, to, reason, final, stamp):
                # Like a message, after the earlier ones. A supervisor's stop overtakes them, as in the mailbox.
                if reason == "shutdown" or _opens_packed(self._find(to)):
                    self._halt(call, to, reason, final, stamp)
                else:
                    self._in_turn(to, call, message, self._halt, call, to, reason, final, stamp)
            case Watch(call, to):
                self._watch(call, to)
            case Unwatch(call):
                self._watches.pop(call, _nothing)()
            case _:
                logger.error("%s sent %s on a link that it opened", link.peer, type(message).__name__)
                link.close()

    def lost(self, link: Link, reason: Exception | None) -> None:
        """End the watches: no answer can be sent any more. Actors still handle the messages that have arrived."""
        self._forget(link)
        self._parcels.close()
        for unwatch in self._watches.values():
            unwatch()
        self._watches.clear()

    def answer(self, call: int, value: Any, name: str) -> None:
        """Send the value that a handler returned. From any thread, which pickles it."""
        try:
            body = pickling.dumps_large(value, f"reply of {name}", self._parcels.large_bytes)
            if not isinstance(body, bytes):
                body = self._parcels.pack(body)
        except BaseException as error:
            self.raised(call, error)
        else:
            self.post(Answered(call, body))

    def raised(self, call: int, error: BaseException, name: str = "") -> None:
        """Send the exception of a handler, or that the actor `name` has ended. From any thread, which pickles it."""
        if has_ended(error, name):
            self.post(Dead(call, taken=True))
            return
        try:
            body = pickling.dumps(error, "exception")
        except BaseException as reason:  # of its class
            logger.debug("an exception travels as text: %s", reason)
            body = b""
        trace = trace_of(error)
        self.post(HandlerRaised(call, body, text_of(error), trace))

    def post(self, letter: Outgoing) -> None:
        """Send an answer. From any thread."""
        try:
            self._dispatcher.call(self._send, letter)
        except Unavailable:
            logger.debug("an answer came after the loop had ended")

    def _send(self, letter: Outgoing) -> None:
        if isinstance(letter, Over):
            self._watches.pop(letter.call, None)
        try:
            try:
                self._link.send(letter)
            except NotSerializable as error:  # too long for a frame
                self._link.send(HandlerRaised(letter.call, pickling.dumps(error), text_of(error), ""))
        except RrError as error:  # the asker would wait for ever: an answer may be lost only with its link
            logger.error("%s does not read its answers, and is cut off: %s", self._link.peer, error)
            self._link.close()
            return
        if not self._dirty:
            self._dirty = True
            self._dispatcher.loop.call_soon(self._flush)

    def _flush(self) -> None:
        self._dirty = False
        self._link.flush()

    def _deliver(self, to: str, body: bytes | Parcel, call: int | None, chain: Chain, stamp: Stamp | None) -> None:
        ref = self._find(to)
        opens = (lambda: pickling.loads(body)) if isinstance(body, bytes) else self._parcels.claim(body)
        packed = Packed(opens, len(body), self._link.peer, body if isinstance(body, bytes) else b"")
        if ref is None:
            self._undeliverable(to, call, packed)
        elif _opens_packed(ref):
            self._put(ref, to, packed, call, chain, stamp)
        else:  # this actor would unpickle it on the loop, or does not know Packed
            self._in_turn(to, call, packed, self._open_and_put, ref, to, packed, call, chain, stamp)

    def _open_and_put(
        self, ref: pykka.ActorRef[Any], to: str, packed: Packed, call: int | None, chain: Chain, stamp: Stamp | None
    ) -> None:
        try:
            message = packed.open()
        except Exception as error:
            self._not_taken(to, call, packed, error)
        else:
            self._put(ref, to, message, call, chain, stamp)

    def _put(
        self, ref: pykka.ActorRef[Any], to: str, message: Any, call: int | None, chain: Chain, stamp: Stamp | None
    ) -> None:
        try:
            if call is not None:
                check_chain(Target(to, str(ref)), chain)
            answer = None if call is None else RemoteAnswer(self, call, str(ref))
            put(ref, Envelope(message, answer, chain, stamp), str(ref))
        except ActorDeadError:
            self._undeliverable(to, call, message)
        except Exception as error:
            self._not_taken(to, call, message, error)

    def _in_turn(self, to: str, call: int | None, message: Any, fn: Callable[..., None], *args: Any) -> None:
        """Run fn in a worker, after all earlier calls of the other process for the same actor."""
        try:
            self._dispatcher.workers.serial((self._link.peer, to), fn, *args)  # on all its connections
        except Unavailable as error:
            self._not_taken(to, call, message, error)

    def _not_taken(self, to: str, call: int | None, message: Any, error: Exception) -> None:
        if call is not None:
            self.raised(call, error)
            return
        full = isinstance(error, MailboxFull)
        if not full:  # the traceback helps to find the fault
            logger.error("a message told to %s by %s was not taken", to, self._link.peer, exc_info=error)
        self._record(to, message, f"not taken: {shortened(text_of(error))}", unheard=int(full))

    def _undeliverable(self, to: str, call: int | None, message: Any) -> None:
        self._record(to, message, "found nobody", unheard=int(call is None))
        if call is not None:
            self.post(Dead(call))

    def _record(self, to: str, message: Any, why: str, *, unheard: int) -> None:
        name = to.removeprefix(PATH_URN)
        if type(message) is Packed:
            message = dead_letters.Lost(f"{message.size} bytes")
        dead_letters.office.record(name, [message], f"sent by {self._link.peer}, {why}", unheard=unheard)

    def _watch(self, call: int, to: str) -> None:
        def over(report: ExitReport) -> None:
            self.post(Over(call, report.reason, report.detail))

        ref = self._find(to)
        unwatch = None if ref is None else death_watch.watch(ref, over)
        if unwatch is None:
            self.post(Dead(call))
        else:
            self._watches[call] = unwatch
            self.post(Watching(call))

    def _halt(self, call: int, to: str, reason: str, final: bool, stamp: Stamp | None) -> None:
        ref = self._find(to)
        if ref is None or not ref.is_alive():
            self.post(Dead(call))
            return
        try:
            answer = RemoteAnswer(self, call, str(ref))
            ref.actor_inbox.put(Envelope(StopActor(reason, final=final), answer, stamp=stamp))
        except Exception as error:
            self.raised(call, error, str(ref))

    def _order(self, call: int, to: str, what: str) -> None:
        """Look at a mailbox, or hold it up. The loop answers at once, whatever the actor does."""
        ref = self._find(to)
        if ref is None:
            self.post(Dead(call))
            return
        try:
            carry_out(ref, what, lambda done: self.answer(call, done, to))
        except Exception as error:
            self.raised(call, error)

    def _inquire(self, call: int, to: str, what: str) -> None:
        ref = self._find(to)
        actor = None if ref is None or not ref.is_alive() else ref._actor_weakref()  # pyright: ignore[reportPrivateUsage]
        if ref is None or actor is None:
            self.post(Dead(call))
            return
        try:
            match what:
                case "alive":
                    self.answer(call, True, to)
                case "class":
                    self.answer(call, ref.actor_class, f"the class of {ref}")
                case "attributes":
                    self.answer(call, attributes_of(actor), str(ref))
                case _:
                    self.raised(call, RrError(f"cannot answer {what!r} about an actor"))
        except Exception as error:
            self.raised(call, error)


class Asker(Visitor):
    """Takes one ask at a time from a waiting thread of another process; the thread that has the answer writes it."""

    def __init__(
        self, find: Find, dispatcher: Dispatcher, link: UnixLink, forget: Callable[[Link], None], parcels: Parcels
    ) -> None:
        super().__init__(find, dispatcher, link, forget, parcels)
        link.open_outlet()
        self._answering = link.answering

    def received(self, link: Link, message: Letter) -> None:
        """Take an ask of an actor."""
        if type(message) is Ask:
            super().received(link, message)
        else:
            logger.error("%s sent %s on a link for asking", link.peer, type(message).__name__)
            link.close()

    def post(self, letter: Outgoing) -> None:
        """Send an answer, in the calling thread if possible. From any thread."""
        answer = self._answering(letter)
        if answer is None:  # such as an answer that is too long for a frame
            super().post(letter)
        else:
            answer()


class RemoteAnswer(pykka.Future[Any]):
    """The future for the result of a handler whose asker is in another process. No thread waits on it here."""

    def __init__(self, visitor: Visitor, call: int, name: str) -> None:
        super().__init__()
        self._visitor = visitor
        self._call = call
        self._name = name

    def set(self, value: Any = None) -> None:
        """Send the value to the asker."""
        self._visitor.answer(self._call, value, self._name)

    def set_exception(self, exc_info: ExcInfo | None = None) -> None:
        """Send the exception to the asker."""
        self._visitor.raised(self._call, error_of(exc_info), self._name)


def _nothing() -> None:
    pass


def _opens_packed(ref: pykka.ActorRef[Any] | None) -> bool:
    return ref is not None and isinstance(ref.actor_inbox, Mailbox) and ref.actor_inbox.opens_packed
