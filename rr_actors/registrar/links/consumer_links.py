"""Consumers: the links of consumers to a registrar, and the connections of their threads (direct lines)."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Collection, Container, Sequence
from typing import Any

import msgspec
from msgspec.structs import replace

from rr_actors.actors.turns import may_be_interrupted
from rr_actors.base.errors import NotSerializable, RrError, Unavailable, shown
from rr_actors.base.reporting.log import Log
from rr_actors.registrar.core.reconciliation import is_fenced
from rr_actors.registrar.engine.registrar_base import RegistrarBase
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.messages import (
    Describe,
    Fetch,
    Fetched,
    Gone,
    Leased,
    Load,
    Loaded,
    LoadRefused,
    Message,
    Noticed,
    NoticesHandled,
    Probe,
    Reprioritise,
    Unload,
    Unloaded,
    UnloadRefused,
    retired,
)
from rr_actors.runtime.thread_rules import any_thread, on_loop
from rr_actors.wire.transport import Hello, Link

logger = Log("rr_actors.registrar")

GATEWAY = retired("hosts")
"""The origin of the link by which the gateway of this host says which other hosts have a lease."""

_OF_ITSELF = frozenset({Load, Unload, Fetch, Gone, Reprioritise})  # messages in which a consumer names itself
_A_CONSUMERS = frozenset({Describe, NoticesHandled, Probe})  # the other messages that a consumer may send


@on_loop
class Consumers:
    """One link for each consumer of a registrar's actor, and any number of direct lines."""

    def __init__(self, provider: RegistrarBase) -> None:
        self._provider = provider
        self._links: dict[str, Link] = {}
        self._host_lines: dict[str, set[Link]] = {}  # the direct lines of consumers of other hosts
        self.routes = Routes()  # for each answer, the line or link by which it goes
        self.unflushed: dict[int, Any] = {}  # the links that have unsent messages
        self._side: dict[type[Any], Callable[[str, Any], None]] = {}  # messages of consumers that are not decided

    def attach(self, link: Link) -> _Inlet:
        """Take the link of a consumer; it replaces an older one."""
        origin = link.hello.origin
        old = self._links.get(origin)
        self._links[origin] = link
        if old is not None:
            old.close()
            self._lost(origin)
        return _Inlet(self.received, self.lost)

    def attach_direct(self, line: Link) -> _Inlet:
        """Take a direct line of a consumer's thread."""
        if "/" in line.hello.origin:
            self._host_lines.setdefault(line.hello.origin, set()).add(line)
        return _Inlet(self.received_directly, self.lost_directly)

    def send(self, origin: str, message: Message) -> None:
        """Send to a consumer by its link, when flushed, or at once by the line that asked. Lost if there is neither."""
        line, by_link = self.routes.way_of(message)
        if line is not None:
            self._try(line.send_now, line, message)
        link = self._links.get(origin) if by_link else None
        if link is not None:
            self._send(link, message)

    @any_thread
    def by_line(self, answer: Message) -> Callable[[], None] | None:
        """Return a function that sends an answer by the line that alone waits, or None."""
        line = self.routes.line_of(answer)
        send = None if line is None else line.answering(answer)
        if line is not None and send is not None:
            self.routes.answered(answer)
            if self._provider.node.watched.level[0] > 1:
                self._record("sent", line.hello.origin, answer)
        return send

    def tell_all(self, message: Message) -> None:
        """Send to every consumer that has a link, at once."""
        for link in list(self._links.values()):
            self._send(link, message)
        self.flush()

    def hint(self, origin: str, message: Message) -> None:
        """Send, when flushed, a message that may be lost: it is dropped if the consumer is behind with its reading."""
        link = self._links.get(origin)
        if link is not None and not link.behind:
            with contextlib.suppress(RrError):  # very many queries wait, so it is too long: no reason to close the link
                link.send(message)
                self.unflushed[id(link)] = link

    def _send(self, link: Any, message: Message) -> None:
        if self._try(link.send, link, message):
            self.unflushed[id(link)] = link

    @any_thread
    def _record(self, event: str, origin: str, message: Message, at: float | None = None) -> None:
        self._provider.recorder.message(event, self._provider.name, origin, message, at)

    def _try(self, send: Callable[[Message], None], link: Any, message: Message) -> bool:
        # The time before send(): the receiver may read and record the message before send() returns.
        at = time.time() if self._provider.node.watched.level[0] > 1 else None
        try:
            send(message)
        except RrError as error:
            others = self._instead(link, message, error)
            if others:
                return all(self._try(send, link, other) for other in others)
            logger.error("%s: %s; closing the link", self._provider.name, error)  # its consumer will ask again
            link.close()
            return False
        if at is not None:
            self._record("sent", link.hello.origin, message, at)
        return True

    def _instead(self, link: Any, message: Message, error: RrError) -> Sequence[Message]:
        """Return the messages that replace one that is over the limit of a frame, so that its link can stay open.

        They say the same, as far as they can. A consumer that is refused holds nothing, and one that holds a query has
        its request and response. Except for lists, this is needed only if the limit was lowered after a load. All other
        messages were cut, or refused, where they were made.
        """
        if not isinstance(error, NotSerializable) or "limit" not in error.details:
            return ()
        others: Sequence[Message] = ()
        match message:
            case Loaded():
                self._provider.receive(Unload(message.query_id, link.hello.origin), link.hello.origin)
                others = (self._provider.refusal(message, error),)
            case Fetched(queries=[_, _, *_] as rows):
                half = len(rows) // 2
                others = replace(message, queries=rows[:half], more=True), replace(message, queries=rows[half:])
            case Fetched(queries=[row]) if row.response is not None:
                others = (replace(message, queries=[replace(row, response=None)]),)
            case Fetched(queries=[row]) if row.request:
                others = (replace(message, queries=[replace(row, request=b"")]),)
            case Noticed(notice=notice) if notice.response is not None:
                others = (replace(message, notice=replace(notice, response=None)),)
            case _:
                pass
        if others:
            logger.warning("%s: to %s: %s; what fits is sent instead", self._provider.name, link.hello.origin, error)
        return others

    def flush(self) -> None:
        """Flush every link that has unsent messages."""
        if self.unflushed:
            dirty, self.unflushed = self.unflushed, {}
            for link in dirty.values():
                link.flush()

    def link_of(self, origin: str) -> Link | None:
        """Return the link of a consumer, or None."""
        return self._links.get(origin)

    def received(self, link: Link, message: Any) -> None:
        """Pass on a message of a link. If a newer link is open, ignore it: the consumer sends it again over that."""
        origin = link.hello.origin
        side = self._side.get(message.__class__)
        if side is None:
            _check(message, origin)
        if self._links.get(origin) is link:
            if self._provider.node.watched.level[0] > 1:
                self._record("received", origin, message)
            if side is not None:
                side(origin, message)
                return
            if isinstance(message, (Load, Unload)):
                self.routes.asked_by_link(origin, message)
            self._provider.receive(message, origin, more=link.more)
            if type(message) is Load:
                self._provider.progress.greet(origin, message.query_id)

    def expel(self, origin: str) -> None:
        """Close the link and the lines of a consumer that does not come back, and ignore their messages."""
        for line in self.routes.lines():
            if line.hello.origin == origin:
                line.close()
        link = self._links.pop(origin, None)
        if link is not None:
            link.close()
            self._lost(origin)

    def fence(self, hosts: Collection[str]) -> None:
        """Close the links and lines of all hosts that have no lease: what is still on its way there does nothing."""
        for origin in {*self._links, *self._host_lines}:
            if is_fenced(origin, hosts):
                for line in self._host_lines.pop(origin, ()):
                    line.close()
                self.expel(origin)

    def lost(self, link: Link, _reason: Exception | None) -> None:
        """Note that the link of a consumer is down."""
        origin = link.hello.origin
        if self._links.get(origin) is link:
            del self._links[origin]
            self._lost(origin)

    def _lost(self, origin: str) -> None:
        self.routes.link_lost(origin)
        self._provider.post(c.ConsumerLost(origin))

    @any_thread
    def listens_to(self, hello: Hello) -> bool:
        """Return whether direct lines of this incarnation of a consumer may ask: as long as that has a link."""
        link = self._links.get(hello.origin)
        return not self._provider.closed and link is not None and link.hello.epoch == hello.epoch  # else it may be dead

    def received_directly(self, line: Any, message: Any, *, more: bool = False) -> None:
        """Decide a message of a direct line; the answer goes by that line. With `more`, behind waiting commands."""
        if not self.listens_to(line.hello):
            line.close()
            return
        origin = line.hello.origin
        _check(message, origin)
        if self._provider.node.watched.level[0] > 1:
            self._record("received", origin, message)
        if type(message) is Load and (joined := self._provider.join(message)) is not None:
            self._try(line.send_now, line, joined)
            return
        if isinstance(message, (Load, Unload)):
            self.routes.asked_by_line(line, message, self._provider.catalog.refused)
            line.open_outlet()
        self._provider.receive(message, origin, more=more)

    def received_here(self, line: Any, message: Any) -> None:
        """Decide a message of a thread of this process, behind a command that the thread may have posted before."""
        self.received_directly(line, message, more=True)

    @any_thread
    def answer_here(self, message: Message, hello: Hello) -> Message | None:
        """Answer a thread of this process, with the Hello of its line, by a fast path. Return None if it has to send.

        An Unload is decided behind what the thread has asked of the loop before.
        """
        provider = self._provider
        if provider.closed or may_be_interrupted() or not self.listens_to(hello):
            return None
        at = time.time() if provider.node.watched.level[0] > 1 else None
        answer: Message | None = None
        if type(message) is Load:
            answer = provider.join(message)
        elif type(message) is Unload and not provider.gathers and not provider.node.dispatcher.is_behind():
            answer = provider.leave(message)
        if answer is not None and at is not None:
            self._record("received", hello.origin, message, at)
            self._record("sent", hello.origin, answer)
        return answer

    def lost_directly(self, line: Any, _reason: Exception | None) -> None:
        """Note that a direct line is down: the consumer's link carries the answers that it waits for."""
        self.routes.line_lost(line)
        if (lines := self._host_lines.get(line.hello.origin)) is not None:
            lines.discard(line)
            if not lines:
                del self._host_lines[line.hello.origin]

    def close(self) -> None:
        """Close every link and line."""
        for line in self.routes.clear():
            line.close()
        for link in list(self._links.values()):
            link.close()
        self._links.clear()


def _check(message: Any, origin: str) -> None:
    """Raise Unavailable, which closes this link, if a consumer may not send this message, or names another in it."""
    if type(message) in _OF_ITSELF:
        if message.origin != origin and not (type(message) is Gone and origin == retired(message.origin)):
            raise Unavailable(f"{type(message).__name__} of {shown(message.origin)} on a link of {origin!r}")
    elif type(message) not in _A_CONSUMERS and not (type(message) is Leased and origin == GATEWAY):
        raise Unavailable(f"{type(message).__name__} is a provider's to say, not a consumer's")


class _Inlet(msgspec.Struct, frozen=True):
    """The provider's end of a consumer's link, or of a direct line: a Receiver."""

    received: Callable[..., None]  # (link, message)
    lost: Callable[..., None]  # (link, reason)


# Routes: the way of each answer. It goes by the direct line that asked, by the consumer's link, or by both.
#
# If a question came by both, the answer goes by both. A thread that gives a line up closes it, and has the link ask,
# too. The provider may read the question before it reads the end of the line. So an answer may go to a line that nobody
# reads any more.


class _Ways(msgspec.Struct):
    """Questions of one kind that are not answered: by query, the direct line, and the consumer whose link asked."""

    lines: dict[str, Any] = {}
    links: dict[str, str] = {}


@on_loop
class Routes:
    """The ways of all answers of one provider.

    Loads and unloads are apart: an answer to a Load, late or sent twice, does not answer an Unload of the same query.
    """

    def __init__(self) -> None:
        self._loads, self._unloads = _Ways(), _Ways()
        self._ways: dict[type[Any], _Ways] = {
            **dict.fromkeys((Load, Loaded, LoadRefused), self._loads),
            **dict.fromkeys((Unload, Unloaded, UnloadRefused), self._unloads),
        }

    def asked_by_link(self, consumer: str, question: Load | Unload) -> None:
        """Note a question that came by a consumer's link."""
        self._ways[type(question)].links[question.query_id] = consumer

    def asked_by_line(self, line: Any, question: Load | Unload, released: Container[str] = ()) -> None:
        """Note a question that came by a direct line; an Unload of a query in `released` is answered by the link, too.

        Such an Unload came by the link before, and was refused since. So its thread may have left the line.
        """
        self._ways[type(question)].lines[question.query_id] = line
        if type(question) is Unload and question.query_id in released:
            self.asked_by_link(question.origin, question)

    def way_of(self, message: Any) -> tuple[Any, bool]:
        """Return the line of an answer (or None), and whether it goes by the link; forget the question."""
        ways = self._ways.get(message.__class__)
        if ways is None:
            return None, True
        asked = ways.links.pop(message.query_id, None) is not None
        line = self._forget_line(ways, message.query_id)
        # An UnloadRefused must come before the notices that follow it by the link.
        return line, asked or line is None or type(message) is UnloadRefused

    @any_thread
    def line_of(self, message: Any) -> Any:
        """Return the line of an answer that goes by nothing else; None if there is none."""
        ways = self._ways.get(message.__class__)
        if ways is None or type(message) is UnloadRefused or message.query_id in ways.links:
            return None
        return ways.lines.get(message.query_id)

    @any_thread
    def answered(self, answer: Any) -> None:
        """Forget the question of an answer that goes by the line of line_of()."""
        self._forget_line(self._ways[type(answer)], answer.query_id)

    @any_thread
    def _forget_line(self, ways: _Ways, query_id: str) -> Any:
        if ways is self._unloads:
            self._loads.links.pop(query_id, None)  # a withdrawn Load gets no answer
        return ways.lines.pop(query_id, None)

    def line_lost(self, line: Any) -> None:
        """Forget the questions of a line that is down: their answers go by the link."""
        for ways in (self._loads, self._unloads):
            _forget_way(ways.lines, line)

    def lines(self) -> list[Any]:
        """Return the lines that wait for an answer."""
        return [*self._loads.lines.values(), *self._unloads.lines.values()]

    def links(self) -> list[str]:
        """Return the consumers whose links wait for an answer, each as often as it has asked."""
        return [*self._loads.links.values(), *self._unloads.links.values()]

    def link_lost(self, consumer: str) -> None:
        """Forget the questions of a consumer's link that is down: the next link asks again."""
        for ways in (self._loads, self._unloads):
            _forget_way(ways.links, consumer)

    def clear(self) -> list[Any]:
        """Forget all questions; return the lines that wait for an answer."""
        lines = self.lines()
        self.__init__()
        return lines


def _forget_way(ways: dict[str, Any], lost: object) -> None:
    for query_id, way in list(ways.items()):
        if way == lost:
            ways.pop(query_id, None)  # another thread may have answered this question just now
