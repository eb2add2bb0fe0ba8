"""Consumers: the links that others have opened to a registrar, and the connections of their threads (direct lines)."""

from __future__ import annotations

import contextlib
import functools
import logging
import time
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
from msgspec.structs import replace

from rr_actors.base.errors import NotSerializable, RrError, Unavailable, shown
from rr_actors.registrar.links.local_line import LocalLine
from rr_actors.registrar.model.messages import (
    Describe,
    Fetch,
    Fetched,
    Gone,
    Load,
    Loaded,
    LoadRefused,
    Message,
    Noticed,
    NoticesHandled,
    Probe,
    Unload,
    Unloaded,
    UnloadRefused,
    retired,
)
from rr_actors.wire.transport import Attach, Link

logger = logging.getLogger("rr_actors.registrar")

_OF_ITSELF = frozenset({Load, Unload, Fetch, Gone})  # what a consumer says of itself, and names itself in
_A_CONSUMERS = frozenset({Describe, NoticesHandled, Probe})  # what else it may say


class Consumers:
    """One link for each consumer, and any number of direct lines. On the loop.

    Attributes:
        routes: by which way each answer goes.

    Args:
        provider: the registrar's actor.
    """

    def __init__(self, provider: Any) -> None:
        self._provider = provider
        self._links: dict[str, Link] = {}
        self.routes = Routes()
        self._dirty: dict[int, Any] = {}

    def attach(self, origin: str) -> Attach:
        """How a consumer's link is received."""

        def attach(link: Link) -> _Inlet:
            self.opened(origin, link)
            return _Inlet(functools.partial(self.received, origin), functools.partial(self.lost, origin))

        return attach

    def attach_direct(self, origin: str) -> Attach:
        """How the direct line of one of its threads is received."""

        def attach(line: Link) -> _Inlet:
            return _Inlet(functools.partial(self.received_directly, origin, line.hello.epoch), self.lost_directly)

        return attach

    def send(self, origin: str, message: Message) -> None:
        """Send to a consumer: by its link when flushed, or at once by the line that asked. Lost without a link."""
        line, by_link = self.routes.way_of(message)
        if line is not None:
            self._try(line.send_now, line, message)
        link = self._links.get(origin) if by_link else None
        if link is not None:
            self._send(link, message)

    def by_line(self, answer: Message) -> Callable[[], None] | None:
        """What sends an answer by the direct line that alone waits for it; None: there is none. From any thread."""
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
        """Send what may be lost, when flushed: it is lost if the consumer has not read what was sent before."""
        link = self._links.get(origin)
        if link is not None and not link.behind:
            with contextlib.suppress(RrError):  # it is too long, as very many wait: no reason to close the link
                link.send(message)
                self._dirty[id(link)] = link

    def _send(self, link: Any, message: Message) -> None:
        if self._try(link.send, link, message):
            self._dirty[id(link)] = link

    def _record(self, event: str, origin: str, message: Message, at: float | None = None) -> None:
        self._provider.node.recorder.message(event, self._provider.name, origin, message, at)

    def _try(self, send: Callable[[Message], None], link: Any, message: Message) -> bool:
        # Taken before: its receiver may read a message, and record that, before send() has returned here.
        at = time.time() if self._provider.node.watched.level[0] > 1 else None
        try:
            send(message)
        except RrError as error:
            others = self._instead(link, message, error)
            if others:
                return all(self._try(send, link, other) for other in others)
            logger.error("%s: %s; closing the link", self._provider.name, error)  # it does not read: it will ask again
            link.close()
            return False
        if at is not None:
            self._record("sent", link.hello.origin, message, at)
        return True

    def _instead(self, link: Any, message: Message, error: RrError) -> Sequence[Message]:
        """What goes in place of a message that is over the limit of a frame, so that its link can stay.

        A message of the same meaning, as far as it goes. Who is refused holds nothing, and who holds something has its
        request and response. But for a list, that is needed where the limit has been lowered since something was
        loaded. What else there is to say was cut, or refused, where it was made.
        """
        if not isinstance(error, NotSerializable) or "limit" not in error.details:
            return ()
        others: Sequence[Message] = ()
        match message:
            case Loaded():
                self._provider.monitor.receive(Unload(message.query_id, link.hello.origin), link.hello.origin)
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
        """Let everything go that was sent."""
        if self._dirty:
            dirty, self._dirty = self._dirty, {}
            for link in dirty.values():
                link.flush()

    def link_of(self, origin: str) -> Link | None:
        """A consumer's link, if it has one."""
        return self._links.get(origin)

    def opened(self, origin: str, link: Link) -> None:
        """A consumer's link; a newer one replaces it."""
        old = self._links.get(origin)
        self._links[origin] = link
        if old is not None:
            old.close()
            self._lost(origin)

    def received(self, origin: str, link: Link, message: Any) -> None:
        """Pass a message on, unless a newer link is open: what an old one still brings is sent again over that."""
        _check(message, origin)
        if self._links.get(origin) is link:
            if self._provider.node.watched.level[0] > 1:
                self._record("received", origin, message)
            if isinstance(message, (Load, Unload)):
                self.routes.asked_by_link(origin, message)
            self._provider.monitor.receive(message, origin, more=link.more)
            if type(message) is Load:
                self._provider.progress.greet(origin, message.query_id)

    def expel(self, origin: str) -> None:
        """A consumer is gone for good: what its link still brings is ignored, and no thread of it waits."""
        for line in self.routes.lines_of(origin):
            line.close()
        link = self._links.pop(origin, None)
        if link is not None:
            link.close()
            self._lost(origin)

    def lost(self, origin: str, link: Link, _reason: Exception | None) -> None:
        """A consumer's link is down."""
        if self._links.get(origin) is link:
            del self._links[origin]
            self._lost(origin)

    def _lost(self, origin: str) -> None:
        self.routes.link_lost(origin)
        self._provider.consumer_lost(origin)

    def listens_to(self, origin: str, epoch: int) -> bool:
        """Whether direct lines of the consumer's incarnation `epoch` are listened to: as long as it has a link."""
        link = self._links.get(origin)
        return not self._provider.closed and link is not None and link.hello.epoch == epoch  # else perhaps a dead one's

    def received_directly(self, origin: str, epoch: int, line: Any, message: Any) -> None:
        """A message on a direct line of the consumer's incarnation `epoch`: it is answered there."""
        if not self.listens_to(origin, epoch):
            line.close()
            return
        _check(message, origin)
        if self._provider.node.watched.level[0] > 1:
            self._record("received", origin, message)
        if type(message) is Load and (joined := self._provider.join(message)) is not None:
            self._try(line.send_now, line, joined)
            return
        if isinstance(message, (Load, Unload)):
            self.routes.asked_by_line(line, message)
            line.open_outlet()
        # A thread of this process may have posted to this loop before: with `more` this comes a turn later, behind it.
        self._provider.monitor.receive(message, origin, more=isinstance(line, LocalLine))

    def lost_directly(self, line: Any, _reason: Exception | None) -> None:
        """A direct line is gone: what it waits for is answered by the consumer's link."""
        self.routes.line_lost(line)

    def close(self) -> None:
        """Close every link and line."""
        for line in self.routes.clear():
            line.close()
        for link in list(self._links.values()):
            link.close()
        self._links.clear()


def _check(message: Any, origin: str) -> None:
    """See that a consumer says what a consumer may, and of itself.

    Raises:
        Unavailable: it does not; its link is closed, and nobody else's.
    """
    if type(message) in _OF_ITSELF:
        if message.origin != origin and not (type(message) is Gone and origin == retired(message.origin)):
            raise Unavailable(f"{type(message).__name__} of {shown(message.origin)} on a link of {origin!r}")
    elif type(message) not in _A_CONSUMERS:
        raise Unavailable(f"{type(message).__name__} is a provider's to say, not a consumer's")


class _Inlet(msgspec.Struct, frozen=True):
    """The provider's end of a consumer's link, or of a direct line: a Receiver."""

    received: Callable[..., None]  # (link, message)
    lost: Callable[..., None]  # (link, reason)


# Routes: by which way a provider answers: by the direct line that the question came by, the consumer's link, or both.
#
# Both is for what both have asked. A thread that leaves a line closes it and has the link ask, too; its end is read
# with what is in it or some time after, so a question may be answered to a line that nobody reads any more.


class _Ways(msgspec.Struct):
    """By which ways questions of one kind have come that are not answered: by query, the line; the link's consumer."""

    lines: dict[str, Any] = {}
    links: dict[str, str] = {}


class Routes:
    """Those of one provider. On the loop, but for line_of and answered.

    Loads and unloads apart: the answer to a Load that comes late, or twice, is not that to an Unload of the same query.
    """

    def __init__(self) -> None:
        self._loads, self._unloads = loads, unloads = _Ways(), _Ways()
        self._ways: dict[type[Any], _Ways] = {
            Load: loads,
            Loaded: loads,
            LoadRefused: loads,
            Unload: unloads,
            Unloaded: unloads,
            UnloadRefused: unloads,
        }

    @property
    def open_by_link(self) -> int:
        """How many questions of links are not answered yet."""
        return len(self._loads.links) + len(self._unloads.links)

    def asked_by_link(self, consumer: str, question: Load | Unload) -> None:
        """A consumer's link has asked."""
        self._ways[type(question)].links[question.query_id] = consumer

    def asked_by_line(self, line: Any, question: Load | Unload) -> None:
        """A direct line has asked."""
        self._ways[type(question)].lines[question.query_id] = line

    def way_of(self, message: Any) -> tuple[Any, bool]:
        """Return, and forget, the line that a message goes by (or None), and whether it goes by the link."""
        ways = self._ways.get(message.__class__)
        if ways is None:
            return None, True
        asked = ways.links.pop(message.query_id, None) is not None
        line = self._forget_line(ways, message.query_id)
        # A refusal has to come before the statuses that follow it.
        return line, asked or line is None or type(message) is UnloadRefused

    def line_of(self, message: Any) -> Any:
        """The line that a message goes by, and by nothing else; None if there is none. From any thread."""
        ways = self._ways.get(message.__class__)
        if ways is None or type(message) is UnloadRefused or message.query_id in ways.links:
            return None
        return ways.lines.get(message.query_id)

    def answered(self, answer: Any) -> None:
        """It goes by that line, without way_of. From any thread."""
        self._forget_line(self._ways[type(answer)], answer.query_id)

    def _forget_line(self, ways: _Ways, query_id: str) -> Any:
        if ways is self._unloads:
            self._loads.links.pop(query_id, None)  # a Load that was withdrawn is not answered
        return ways.lines.pop(query_id, None)

    def line_lost(self, line: Any) -> None:
        """A line is no more: what it waits for is answered by the link."""
        for ways in (self._loads, self._unloads):
            for query_id in [query_id for query_id, route in list(ways.lines.items()) if route is line]:
                del ways.lines[query_id]

    def lines_of(self, consumer: str) -> list[Any]:
        """The lines of a consumer's threads that wait for an answer."""
        return [line for line in self._lines() if line.hello.origin == consumer]

    def _lines(self) -> list[Any]:
        return [*self._loads.lines.values(), *self._unloads.lines.values()]

    def link_lost(self, consumer: str) -> None:
        """A consumer's link is no more: what is still open is asked again over the next."""
        for ways in (self._loads, self._unloads):
            for query_id in [query_id for query_id, origin in ways.links.items() if origin == consumer]:
                del ways.links[query_id]

    def clear(self) -> list[Any]:
        """Forget everything; returns the lines that wait for an answer."""
        lines = self._lines()
        self.__init__()
        return lines
