"""Consumers: the links that others have opened to a registrar, and the direct lines of their threads."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from rr_actors.actors.routes import Routes
from rr_actors.actors.too_long import fitting
from rr_actors.errors import NotSerializable, RrError, Unavailable
from rr_actors.messages import Described, Fetched, Load, Loaded, LoadRefused, Message, Unload
from rr_actors.transport import Attach, Link

logger = logging.getLogger("rr_actors.registrar")

_NOT_A_CONSUMERS = frozenset({Described, Fetched})  # the client's to read; who sends one here loses its link alone


class Provider(Protocol):
    """Who takes what consumers send: the registrar's actor."""

    name: str
    closed: bool

    def receive(self, message: Message, sender: str, *, more: bool = False) -> None:
        """A message has arrived; `more`: others follow, to be decided together."""
        ...

    def refusal(self, loaded: Loaded, error: NotSerializable) -> LoadRefused:
        """What a consumer hears instead of an answer that is too long for a frame."""
        ...

    def consumer_lost(self, origin: str) -> None:
        """A consumer's link is down, or another has taken its place."""
        ...


class Consumers:
    """One link for each consumer, and any number of direct lines. On the loop.

    Attributes:
        routes: by which way each answer goes.

    Args:
        join_at_once: answers a Load that has come on a direct line, or returns None if it is to be decided as any.
    """

    def __init__(self, provider: Provider, join_at_once: Callable[[Load], Loaded | None]) -> None:
        self._provider = provider
        self._join_at_once = join_at_once
        self._links: dict[str, Link] = {}
        self.routes = Routes()
        self._dirty: dict[int, Any] = {}

    def attach(self, origin: str) -> Attach:
        """How a consumer's link is received."""
        return functools.partial(_Inlet, self, origin)

    def attach_direct(self, origin: str) -> Attach:
        """How the direct line of one of its threads is received."""
        return functools.partial(_DirectInlet, self, origin)

    def send(self, origin: str, message: Message) -> None:
        """Send to a consumer when flushed: an answer by the line the question came on. Lost if there is no link."""
        line, by_link = self.routes.way_of(message)
        if line is not None:
            self._send(line, message)
        link = self._links.get(origin) if by_link else None
        if link is not None:
            self._send(link, message)

    def by_line(self, answer: Message) -> Callable[[], None] | None:
        """What sends an answer by the direct line that alone waits for it; None: there is none. From any thread."""
        line = self.routes.line_of(answer)
        send = None if line is None else line.answering(answer)
        if send is not None:
            self.routes.answered(answer)
        return send

    def tell_all(self, message: Message) -> None:
        """Send to every consumer that has a link, at once."""
        for link in list(self._links.values()):
            self._send(link, message)
        self.flush()

    def _send(self, link: Any, message: Message) -> None:
        if self._try(link.send, link, message):
            self._dirty[id(link)] = link

    def _try(self, send: Callable[[Message], None], link: Any, message: Message) -> bool:
        try:
            send(message)
        except RrError as error:
            others = self._instead(link, message, error)
            if others:
                return all(self._try(send, link, other) for other in others)
            logger.error("%s: %s; closing the link", self._provider.name, error)  # it does not read: it will ask again
            link.close()
            return False
        return True

    def _instead(self, link: Any, message: Message, error: RrError) -> Sequence[Message]:
        """What goes in place of a message that is over the limit of a frame; who is refused holds nothing."""
        if not isinstance(error, NotSerializable) or "limit" not in error.details:
            return ()
        if type(message) is Loaded:
            self._provider.receive(Unload(message.query_id, link.hello.origin), link.hello.origin)
            others: Sequence[Message] = (self._provider.refusal(message, error),)
        else:
            others = fitting(message, error.details["limit"])
        if others:
            logger.warning("%s: to %s: %s; it is told what fits", self._provider.name, link.hello.origin, error)
        return others

    def flush(self) -> None:
        """Let everything go that was sent."""
        if self._dirty:
            dirty, self._dirty = self._dirty, {}
            for link in dirty.values():
                link.flush()

    def opened(self, origin: str, link: Link) -> None:
        """A consumer's link; a newer one replaces it."""
        old = self._links.get(origin)
        self._links[origin] = link
        if old is not None:
            old.close()
            self._lost(origin)

    def received(self, origin: str, link: Link, message: Any) -> None:
        """Pass a message on, unless a newer link is open: what an old one still brings is sent again over that."""
        if type(message) in _NOT_A_CONSUMERS:
            raise Unavailable(f"{type(message).__name__} is a provider's to say, not a consumer's")
        if self._links.get(origin) is link:
            if isinstance(message, (Load, Unload)):
                self.routes.asked_by_link(origin, message)
            self._provider.receive(message, origin, more=link.more)

    def expel(self, origin: str) -> None:
        """A consumer is gone for good: what its link still brings must not be taken up, and no thread of it waits."""
        for line in self.routes.lines_of(origin):
            line.close()
        link = self._links.pop(origin, None)
        if link is not None:
            link.close()
            self._lost(origin)

    def lost(self, origin: str, link: Link) -> None:
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
        if type(message) in _NOT_A_CONSUMERS:
            raise Unavailable(f"{type(message).__name__} is a provider's to say, not a consumer's")
        if type(message) is Load and (joined := self._join_at_once(message)) is not None:
            self._try(line.send_now, line, joined)
            return
        if isinstance(message, (Load, Unload)):
            self.routes.asked_by_line(line, message)
            line.open_outlet()
        # What a thread of this process has asked for before, by its registrar's loop, is on its way, and comes first.
        self._provider.receive(message, origin, more=line.local)

    def lost_directly(self, line: Any) -> None:
        """A direct line is gone: what it waits for is answered by the consumer's link."""
        self.routes.line_lost(line)

    def close(self) -> None:
        """Close every link and line."""
        for line in self.routes.clear():
            line.close()
        for link in list(self._links.values()):
            link.close()
        self._links.clear()


class _Inlet:
    """The provider's end of a consumer's link."""

    __slots__ = ("_consumers", "_origin")

    def __init__(self, consumers: Consumers, origin: str, link: Link) -> None:
        self._consumers = consumers
        self._origin = origin
        consumers.opened(origin, link)

    def received(self, link: Link, message: Any) -> None:
        self._consumers.received(self._origin, link, message)

    def lost(self, link: Link, reason: Exception | None) -> None:
        self._consumers.lost(self._origin, link)


class _DirectInlet:
    """The provider's end of a direct line."""

    __slots__ = ("_consumers", "_epoch", "_origin")

    def __init__(self, consumers: Consumers, origin: str, link: Link) -> None:
        self._consumers = consumers
        self._origin = origin
        self._epoch = link.hello.epoch

    def received(self, link: Link, message: Any) -> None:
        self._consumers.received_directly(self._origin, self._epoch, link, message)

    def lost(self, link: Link, reason: Exception | None) -> None:
        self._consumers.lost_directly(link)
