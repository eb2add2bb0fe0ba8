"""Consumers: the links that others have opened to a registrar, and the direct lines of their threads."""

from __future__ import annotations

import functools
import logging
from typing import Any, Protocol

from rr_actors.errors import RrError, Unavailable
from rr_actors.messages import (
    Described,
    Fetched,
    Load,
    Loaded,
    LoadRefused,
    Message,
    Unload,
    Unloaded,
    UnloadRefused,
)
from rr_actors.transport import Attach, Link

logger = logging.getLogger("rr_actors.registrar")

_QUESTIONS = (Load, Unload)
_ANSWERS = (Loaded, LoadRefused, Unloaded, UnloadRefused)
_NOT_A_CONSUMERS = frozenset({Described, Fetched})  # the client's to read; who sends one here loses its link alone


class Provider(Protocol):
    """Who takes what consumers send: the registrar's actor."""

    name: str
    closed: bool

    def receive(self, message: Message, sender: str) -> None:
        """A message has arrived."""
        ...

    def consumer_lost(self, origin: str) -> None:
        """A consumer's link is down, or another has taken its place."""
        ...


class Consumers:
    """One link for each consumer, and any number of direct lines. On the loop."""

    def __init__(self, provider: Provider) -> None:
        self._provider = provider
        self._links: dict[str, Link] = {}
        self._routes: dict[str, Any] = {}  # query -> the direct line that its answer goes by
        self._asked_twice: set[str] = set()  # those of them that the consumer's link has asked about too
        self._unloads: dict[str, str] = {}  # those asked for by a link, and its consumer
        self._dirty: dict[int, Any] = {}

    def attach(self, origin: str) -> Attach:
        """How a consumer's link is received."""
        return functools.partial(_Inlet, self, origin)

    def attach_direct(self, origin: str) -> Attach:
        """How the direct line of one of its threads is received."""
        return functools.partial(_DirectInlet, self, origin)

    def send(self, origin: str, message: Message) -> None:
        """Send to a consumer when flushed: an answer by the line the question came on. Lost if there is no link."""
        if self._unloads and isinstance(message, (Unloaded, UnloadRefused)):
            self._unloads.pop(message.query_id, None)
        if self._routes and isinstance(message, _ANSWERS):
            line = self._routes.pop(message.query_id, None)
            if line is not None:
                self._send(line, message)
                if message.query_id in self._asked_twice:
                    self._asked_twice.discard(message.query_id)
                elif type(message) is not UnloadRefused:  # which has to come before the statuses that follow it
                    return
        link = self._links.get(origin)
        if link is not None:
            self._send(link, message)

    def tell_all(self, message: Message) -> None:
        """Send to every consumer that has a link, at once."""
        for link in list(self._links.values()):
            self._send(link, message)
        self.flush()

    def _send(self, link: Any, message: Message) -> None:
        try:
            link.send(message)
        except RrError as error:  # it does not read, or the frame is too long: it will ask again
            logger.error("%s: %s; closing the link", self._provider.name, error)
            link.close()
            return
        self._dirty[id(link)] = link

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
            if isinstance(message, _QUESTIONS):
                if message.query_id in self._routes:
                    self._asked_twice.add(message.query_id)  # the line may be dead: answered by both ways
                if type(message) is Unload:
                    self._unloads[message.query_id] = origin
            self._provider.receive(message, origin)

    def expel(self, origin: str) -> None:
        """A consumer is gone for good: what its link still brings must not be taken up."""
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
        for query_id in [id for id, asker in self._unloads.items() if asker == origin]:
            del self._unloads[query_id]  # asked for again over the next
        self._provider.consumer_lost(origin)

    def received_directly(self, origin: str, epoch: int, line: Any, message: Any) -> None:
        """A message on a direct line of the consumer's incarnation `epoch`: it is answered there."""
        link = self._links.get(origin)
        if self._provider.closed or link is None or link.hello.epoch != epoch:  # perhaps a dead one's
            line.close()
            return
        if type(message) in _NOT_A_CONSUMERS:
            raise Unavailable(f"{type(message).__name__} is a provider's to say, not a consumer's")
        if isinstance(message, _QUESTIONS):
            self._routes[message.query_id] = line
            if message.query_id in self._unloads:  # the line has been left: what it brings is old
                self._asked_twice.add(message.query_id)
        self._provider.receive(message, origin)

    def lost_directly(self, line: Any) -> None:
        """A direct line is gone: what it waits for is answered by the consumer's link."""
        for query_id in [id for id, route in self._routes.items() if route is line]:
            del self._routes[query_id]
            self._asked_twice.discard(query_id)

    def close(self) -> None:
        """Close every link and line."""
        for route in list(self._routes.values()):
            route.close()
        self._routes.clear()
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
