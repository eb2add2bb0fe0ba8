"""Peers that are let in and are broken: what they say to a registrar on a link that is open.

The link is a real one, but for its connection. Whatever comes, only that link is closed, with an error that has a name;
the registrar serves others, and what those hold stays held.
"""

from __future__ import annotations

import asyncio
import itertools
import os
from pathlib import Path
from typing import Any, cast

import msgspec

from fuzz.packed import framed, in_frames, samples
from fuzz.target import Feed, Target, pieces
from rr_actors.base.errors import RrError
from rr_actors.registrar.links.provider_link import THREADS as DIRECT
from rr_actors.registrar.links.provider_link import ProviderLink
from rr_actors.registrar.model.messages import Fetched, FetchedQuery, Gone, Load, Loaded, Message, Noticed, Unload
from rr_actors.registrar.model.rows import Notice, State
from rr_actors.registrar.registrar import Registrar
from rr_actors.system.system import System
from rr_actors.wire.transport import Hello, Welcome
from rr_actors.wire.unix_link import UnixLink, Wire
from rr_actors.wire.unix_sockets import SocketPeer

_LIMIT_BYTES = 100_000
_PEER = SocketPeer(os.getpid(), os.getuid())
_WIRE = Wire(msgspec.msgpack.Decoder(Message), _LIMIT_BYTES)
_ROLES = 3
"""A consumer's link, a direct line of one of its threads, and a provider's link."""
_MISTAKEN = "mistaken"


class _Connection:
    """A transport that keeps nothing, and is asked whether it was closed."""

    def __init__(self) -> None:
        self.ended = False

    def write(self, data: bytes) -> None:
        """Lose it."""

    def get_write_buffer_size(self) -> int:
        """Nothing waits."""
        return 0

    def get_extra_info(self, name: str) -> Any:
        """There is no socket."""
        raise OSError(name)

    def abort(self) -> None:
        """Note it."""
        self.ended = True

    close = abort


class _Shop:
    """A system with a provider and a consumer that holds something there; and a broken peer of either."""

    def __init__(self, directory: Path) -> None:
        self.system = System([], state_dir=directory / "state").start()
        self.provider = self.system.open_registrar("provider")
        self.provider.register_server("thing", _same, _nothing)
        self.app = self.system.open_registrar("app")
        self.kept = self.app.load("provider/thing", "kept")
        self._numbers = itertools.count(1)
        self._resources = {row.id for row in self.provider.resources()}

    def __call__(self, data: bytes) -> None:
        """Byte 0: the peer's role; byte 1: how the rest arrives."""
        if len(data) < 2:
            return
        self.hear(data[0] % _ROLES, data[2:], data[1])
        try:
            self.check()
        except RrError as error:
            raise AssertionError(f"others are not served any more: {error}") from error

    def hear(self, role: int, stream: bytes, seed: int) -> None:
        """Have the peer say all that, and go."""
        node = cast("Any", self.system)._node
        node.dispatcher.run(self._hear(role, stream, seed), 10.0)

    async def _hear(self, role: int, stream: bytes, seed: int) -> None:
        number = next(self._numbers)
        connection = _Connection()
        hello = Hello(DIRECT if role == 1 else "registrar", "provider", _MISTAKEN, number)
        links: set[UnixLink] = set()
        link = UnixLink(links, cast("Any", connection), _WIRE, hello, Welcome(number), _PEER, _MISTAKEN)
        first = self._attach(role, link, hello)
        for piece in pieces(stream, seed):
            link.data_received(piece)
            if connection.ended:
                break
        await asyncio.sleep(0)
        link.connection_lost(None)
        if first is not None:
            first.connection_lost(None)
        for registrar in (self.provider, self.app):
            actor = _actor_of(registrar)
            assert not actor.closed, f"{registrar.name}: {actor.down()}"
            client = actor.clients.pop(_MISTAKEN, None)
            if client is not None:
                client.close()
            actor.receive(Gone(_MISTAKEN), _MISTAKEN)

    def _attach(self, role: int, link: UnixLink, hello: Hello) -> UnixLink | None:
        provider = _actor_of(self.provider)
        if role == 2:
            app = _actor_of(self.app)
            client = app.clients[_MISTAKEN] = ProviderLink(app, _MISTAKEN)
            link.attach(lambda _link: client)
            client.link = link
            client._number, client._reconciled = 7, bool(hello.epoch & 1)  # pyright: ignore[reportPrivateUsage]
            return None
        if role == 0:
            link.attach(provider.consumers.attach)
            return None
        hello = Hello("registrar", "provider", _MISTAKEN, hello.epoch)
        first = UnixLink(set(), cast("Any", _Connection()), _WIRE, hello, Welcome(1), _PEER, _MISTAKEN)
        first.attach(provider.consumers.attach)
        link.attach(provider.consumers.attach_direct)
        return first

    def check(self) -> None:
        """See that everybody else is served, and holds what they held."""
        with self.app.load("provider/thing", next(self._numbers), timeout_s=5.0):
            assert [query.id for query in self.app.fetch_queries("provider")][:1] == [self.kept.id]
        assert [query.id for query in self.app.queries()] == [self.kept.id]


def _actor_of(registrar: Registrar) -> Any:
    return cast("Any", registrar)._actor


def _same(request: Any) -> Any:
    return request


def _nothing(request: Any, response: Any) -> None:
    return None


def _seeds() -> list[bytes]:
    request = msgspec.msgpack.encode("x")
    load = Load("0" * 32, "thing", request, _MISTAKEN, "", 1, 1)
    row = FetchedQuery("1" * 32, "thing", "2" * 32, request, request, "", 1, 1, "ok")
    notice = Notice("3" * 32, "1" * 32, _MISTAKEN, "2" * 32, "e", State.UPDATE, "hm", "r", False, request)
    said = [
        [load, Unload(load.query_id, _MISTAKEN)],
        [load, load, msgspec.structs.replace(load, origin="app", query_id="4" * 32)],
        [Loaded("5" * 32, "6" * 32, request), Fetched([row], number=7), Noticed(notice), Noticed(notice)],
        [Gone("app"), load],
    ]
    streams = [b"".join(framed(msgspec.msgpack.encode(one)) for one in some) for some in said]
    streams += [framed(body) for body in samples(Message)]
    return [bytes([role, 0]) + stream for role in range(_ROLES) for stream in streams]


def _end(shop: Feed) -> None:
    cast("_Shop", shop).system.stop()


PEER = Target(
    "what a broken peer says to a registrar, on a link that is open",
    _Shop,
    _seeds,
    in_frames(2),
    words=(b"thing", b"app", b"mistaken", b"kept"),
    end=_end,
)
