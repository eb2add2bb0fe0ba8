"""A Transport over Eclipse Zenoh: links between hosts. The only file that imports zenoh.

An address is a name in the group, one for each session. If two sessions have the same one, each other side keeps to
the one that it has seen first, and refuses links of the second. A session says where it runs in the last part of its
keys. The keys, all below `rr/GROUP/ADDRESS` of the side that sends:

    rr/GROUP/ADDRESS/open/WHERE         a queryable: it opens links to this address
    rr/GROUP/ADDRESS/to/OTHER/LINK      the packets of a link, from ADDRESS to OTHER
    rr/GROUP/ADDRESS/alive/WHERE        a liveliness token; when it is gone, all links to ADDRESS are lost

Zenoh's calls may block: one to a host that reads nothing does, for seconds. So each host that is there has a thread
that makes the calls to it, in order, and one more thread makes all other calls. The event loop only puts them into
queues.
"""

# Zenoh's stubs leave out what some calls return.
# pyright: reportUnknownMemberType=false, reportUnknownLambdaType=false

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import queue
import re
import socket
import threading
import uuid
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
import zenoh

from rr_actors.base.errors import ConfigError, NameTaken, ProtocolMismatch, RrError, Unavailable, UsageError
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.failure import Failure, error_of, failure_of
from rr_actors.wire.frames import FRAME_LIMIT_BYTES, GOODBYE, decoder_of
from rr_actors.wire.hosts.byte_window import BROKEN, DATA, is_stray, packet
from rr_actors.wire.hosts.host_link import HostLink
from rr_actors.wire.hosts.host_names import ENDPOINT, is_endpoint
from rr_actors.wire.transport import Accept, Attach, Hello, Link, Welcome
from rr_actors.wire.unix_link import CLOSE_LIMIT_S, Wire

_log = Log(__name__)

PROTOCOL = 2
"""The version of what hosts say to each other."""
OPENING_LIMIT_S = 5.0
"""How long the other side may take to answer an opening."""
FIND_LIMIT_S = 1.0
"""How long after its start a transport looks for an address again that nobody answers for."""
_FIND_AGAIN_S = 0.05
_OPENING_BYTES = 64 * 1024
_TO_ACCEPTOR = ".a"
_TO_DIALLER = ".d"
_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,63}")


class _Opening(msgspec.Struct, frozen=True, array_like=True):
    """What the side that opens a link asks."""

    protocol: int
    origin: str
    where: str
    link: str
    hello: Hello


class _Opened(msgspec.Struct, frozen=True, array_like=True):
    """The answer: one of the two."""

    welcome: Welcome | None
    refusal: Failure | None


_Calls = queue.SimpleQueue[Callable[[zenoh.Session], object] | None]

_encode = msgspec.msgpack.encode
_read_opening = msgspec.msgpack.Decoder(_Opening).decode
_read_opened = msgspec.msgpack.Decoder(_Opened).decode


class _Sender(NamedTuple):
    """The thread that makes the calls to one address."""

    calls: _Calls
    thread: threading.Thread
    ended: asyncio.Event


def _here() -> str:
    """Return where this session runs, as a part of a key, different for each session."""
    machine = re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname())[:30]
    return f"{os.getpid()}.{machine}.{uuid.uuid4().hex[:12]}"


def place_of(where: str) -> str:
    """Return where a session runs, for people."""
    pid, _, rest = where.partition(".")
    return f"process {pid[:10]} of {rest.partition('.')[0][:30] or 'an unknown machine'}"


class ZenohTransport:
    """A Transport over a Zenoh session of its own, which opens with the first listen() or connect().

    Args:
        group: the hosts that see each other have the same one.
        address: this transport's name in the group.
        codecs: the message type of each kind of link (`Hello.kind`).
        listen: Zenoh endpoints to listen at, on loopback alone: "tcp/127.0.0.1:7447". Links are not encrypted yet.
        connect: Zenoh endpoints of other hosts.
        frame_limit_bytes: the length of the longest message, on either side.
        on_peer: called on the loop with an address of the group when a session of that address has come or gone, and
            with the places of all that are there: the first is the one that is meant. For its own address: all others.

    Raises:
        ConfigError: the group or the address is no name, or an endpoint to listen at is not on loopback.
    """

    def __init__(
        self,
        group: str,
        address: str,
        codecs: Mapping[str, Any],
        *,
        listen: Sequence[str] = (),
        connect: Sequence[str] = (),
        frame_limit_bytes: int = FRAME_LIMIT_BYTES,
        on_peer: Callable[[str, list[str]], None] | None = None,
    ) -> None:
        for what, name in (("group", group), ("address", address)):
            if not _NAME.fullmatch(name):
                raise ConfigError(f"{what} {name!r}: expected 1 to 64 of A-Z, a-z, 0-9, '_', '.' and '-'")
        for endpoint in listen:
            if not is_endpoint(endpoint):
                raise ConfigError(f"listen {endpoint!r}: expected {ENDPOINT}")
        self.address = address
        self._group = group
        self._where = _here()
        self._places: dict[str, list[str]] = {}  # of each address, in the order in which they were seen
        self._wires = {kind: Wire(decoder_of(message_type), frame_limit_bytes) for kind, message_type in codecs.items()}
        self._listen = [*listen]
        self._connect = [*connect]
        self._calls = _Calls()
        self._senders: dict[str, _Sender] = {}  # of each other address that is there
        self._session: zenoh.Session | None = None
        self._links: dict[tuple[str, str], HostLink] = {}
        self._early: dict[tuple[str, str], list[bytes]] = {}  # packets of links that connect() waits for
        self._on_peer = on_peer
        self._accept: Accept | None = None
        self._closed = False
        self._thread: threading.Thread | None = None
        self._ready: asyncio.Future[None] | None = None
        self._ended = asyncio.Event()
        self._since = 0.0

    async def listen(self, accept: Accept) -> None:
        if self._accept is not None or self._closed:
            raise UsageError(f"transport {self.address}: listens already, or is closed")
        self._accept = accept
        await self._start()

    async def connect(self, address: str, hello: Hello, attach: Attach) -> Link:
        if hello.kind not in self._wires:
            raise UsageError(f"no codec for links of kind {hello.kind!r}: this transport has {sorted(self._wires)}")
        if not _NAME.fullmatch(address):
            raise Unavailable(f"nobody listens for {hello.to} at {address}: it is no name of a host")
        await self._start()
        name = uuid.uuid4().hex
        key = (address, name + _TO_DIALLER)
        put = self._putter(address, name + _TO_ACCEPTOR)
        self._early[key] = []
        try:
            welcome = await self._open(address, name, hello)
            link = HostLink(self._links, key, put, self._wires[hello.kind], hello, welcome, hello.to)
            link.attach(attach)
        except BaseException:  # cancelled, refused, or attach() raised: if the other side has a link, it ends
            put(packet(DATA, 0, GOODBYE))
            raise
        finally:
            early = self._early.pop(key)
        link.start()
        for data in early:
            link.take(data)
        return link

    async def _open(self, address: str, name: str, hello: Hello) -> Welcome:
        opening = _encode(_Opening(PROTOCOL, self.address, self._where, name, hello))
        while True:
            if self._closed:
                raise Unavailable(f"cannot connect to {hello.to}: this transport is closed")
            answer = await self._ask(address, opening)
            if answer is not None:
                break
            if self._loop.time() > self._since + FIND_LIMIT_S:
                raise Unavailable(f"nobody listens for {hello.to} at {address}: no host of {self._group} has that name")
            await asyncio.sleep(_FIND_AGAIN_S)
        try:
            opened = _read_opened(answer)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise Unavailable(f"cannot open a link to {hello.to} at {address}: its answer is none: {error}") from error
        if opened.welcome is None:
            raise error_of(opened.refusal or Failure("Unavailable", f"{hello.to} refused the link"))
        return opened.welcome

    def _place_meant(self, address: str) -> str:
        """Return where the session runs that is meant by an address; "" if none is there."""
        return self._where if address == self.address else next(iter(self._places.get(address, [])), "")

    async def _ask(self, address: str, opening: bytes) -> bytes | None:
        """Return the answer to an opening; None if nobody has that address."""
        if not (where := self._place_meant(address)):
            return None
        loop = self._loop
        done: asyncio.Future[bytes | None] = loop.create_future()

        def set_result(answer: bytes | None) -> None:
            if not done.done():
                done.set_result(answer)

        def take(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                self._call_soon(set_result, reply.ok.payload.to_bytes())

        def end() -> None:
            self._call_soon(set_result, None)

        handler: Any = zenoh.handlers.Callback(take, end, indirect=False)
        key = f"rr/{self._group}/{address}/open/{where}"

        def get(session: zenoh.Session) -> None:
            try:
                session.get(key, handler, payload=opening, timeout=OPENING_LIMIT_S)
            except zenoh.ZError:  # the session is being closed
                end()

        self._calls_to(address).put(get)
        return await done

    async def reached(self) -> list[str]:
        """Return the endpoints to connect to at which a host answers now."""
        done: asyncio.Future[list[str]] = self._loop.create_future()

        def set_result(found: set[str]) -> None:
            if not done.done():
                done.set_result([one for one in self._connect if one.replace("localhost", "127.0.0.1") in found])

        def look(session: zenoh.Session) -> None:
            found: set[str] = set()
            with contextlib.suppress(zenoh.ZError):  # the session is being closed
                found = {str(link.dst) for link in session.info.links()}
            self._call_soon(set_result, found)

        self._calls.put(look)
        return await done

    # -- the session, on its thread ---------------------------------------------------------------------------------

    async def _start(self) -> None:
        if self._closed:
            raise Unavailable(f"transport {self.address} is closed")
        if self._ready is None:
            self._loop = asyncio.get_running_loop()
            self._ready = self._loop.create_future()
            self._since = self._loop.time()
            self._thread = threading.Thread(target=self._run, name=f"zenoh of {self.address}", daemon=True)
            self._thread.start()
        await asyncio.shield(self._ready)

    def _config(self) -> zenoh.Config:
        config = zenoh.Config()
        for key, value in {
            "mode": "peer",
            "scouting/multicast/enabled": False,
            "listen/endpoints": self._listen,
            "connect/endpoints": self._connect,
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 2},
        }.items():
            config.insert_json5(key, json.dumps(value))
        return config

    def _run(self) -> None:
        try:
            session = zenoh.open(self._config())
        except Exception as error:
            failed = ConfigError(f"transport {self.address}: cannot listen at {', '.join(self._listen)}: {error}")
            self._call_soon(self._set_ready, failed)
            self._call_soon(self._ended.set)
            return
        self._session = session
        own = f"rr/{self._group}/{self.address}"
        packets: Any = zenoh.handlers.Callback(self._on_packet, indirect=False)
        openings: Any = zenoh.handlers.Callback(self._on_opening, indirect=False)
        alive: Any = zenoh.handlers.Callback(self._on_alive, indirect=False)
        session.declare_subscriber(f"rr/{self._group}/*/to/{self.address}/*", packets)
        session.declare_queryable(f"{own}/open/{self._where}", openings)
        session.liveliness().declare_subscriber(f"rr/{self._group}/*/alive/*", alive, history=True)
        token = session.liveliness().declare_token(f"{own}/alive/{self._where}")
        self._call_soon(self._set_ready, None)
        self._make(self._calls)
        token.undeclare()
        session.close()
        self._call_soon(self._ended.set)

    def _make(self, calls: _Calls) -> None:
        """Make the calls of a queue, one after another, until there is a None."""
        assert self._session is not None
        while (call := calls.get()) is not None:
            try:
                call(self._session)
            except Exception as error:
                _log.warning("%s: a call of zenoh failed: %s", self.address, error)

    def _begin_sender(self, address: str) -> _Sender:
        calls, ended = _Calls(), asyncio.Event()

        def run() -> None:
            self._make(calls)
            self._call_soon(ended.set)

        thread = threading.Thread(target=run, name=f"zenoh of {self.address} to {address}", daemon=True)
        thread.start()
        return _Sender(calls, thread, ended)

    def _calls_to(self, address: str) -> _Calls:
        """Return the queue of calls to an address."""
        sender = self._senders.get(address)
        return self._calls if sender is None else sender.calls

    def _set_ready(self, error: Exception | None) -> None:
        if self._ready is not None and not self._ready.done():
            if error is None:
                self._ready.set_result(None)
            else:
                self._ready.set_exception(error)

    def _call_soon(self, call: Callable[..., object], *arguments: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(call, *arguments)

    def _putter(self, address: str, link: str) -> Callable[[bytes], None]:
        to = f"rr/{self._group}/{self.address}/to/{address}/{link}"

        def put(data: bytes) -> None:
            self._calls_to(address).put(
                lambda session: session.put(to, data, congestion_control=zenoh.CongestionControl.BLOCK, express=False)
            )

        return put

    # -- what comes in, on Zenoh's threads --------------------------------------------------------------------------

    def _on_packet(self, sample: zenoh.Sample) -> None:
        parts = str(sample.key_expr).split("/")  # rr, the group, the sender, "to", this address, the link
        self._call_soon(self._take, (parts[2], parts[5]), sample.payload.to_bytes())

    def _on_alive(self, sample: zenoh.Sample) -> None:
        parts = str(sample.key_expr).split("/")
        if not _NAME.fullmatch(parts[2]):
            return  # a stranger's: no host has such a name
        change = self._lose if sample.kind == zenoh.SampleKind.DELETE else self._find
        if (parts[2], parts[4]) != (self.address, self._where):
            self._call_soon(change, parts[2], parts[4])

    def _on_opening(self, query: zenoh.Query) -> None:
        self._call_soon(self._answer, query, b"" if query.payload is None else query.payload.to_bytes())

    # -- and on the loop --------------------------------------------------------------------------------------------

    def _take(self, key: tuple[str, str], data: bytes) -> None:
        if (link := self._links.get(key)) is not None:
            link.take(data)
        elif (early := self._early.get(key)) is not None:
            early.append(data)
        elif is_stray(data):
            self._answer_stray(*key)

    def _answer_stray(self, address: str, link: str) -> None:
        """Tell the other side that its link has ended here: it may have lost no packet, and so would never know."""
        name, end = link[:-2], link[-2:]
        if end in (_TO_ACCEPTOR, _TO_DIALLER) and _NAME.fullmatch(address) and _NAME.fullmatch(name):
            back = _TO_DIALLER if end == _TO_ACCEPTOR else _TO_ACCEPTOR
            self._putter(address, name + back)(packet(BROKEN, 0, b"it has ended at this side"))

    def _find(self, address: str, where: str) -> None:
        if address != self.address and address not in self._senders:
            self._senders[address] = self._begin_sender(address)
        places = self._places.setdefault(address, [])
        if where not in places:
            places.append(where)
            self._say(address)

    def _lose(self, address: str, where: str) -> None:
        places = self._places.get(address, [])
        if where not in places:
            return
        is_meant = places[0] == where and address != self.address
        places.remove(where)
        if not places and address in self._senders:
            self._senders.pop(address).calls.put(None)
        for key, link in [*self._links.items()] if is_meant else []:
            if key[0] == address:
                link.end(Unavailable(f"{link.peer} is not reachable any more"))
        self._say(address)

    def _say(self, address: str) -> None:
        if self._on_peer is not None and not self._closed:
            self._on_peer(address, [place_of(where) for where in self._places[address]])

    def _answer(self, query: zenoh.Query, data: bytes) -> None:
        link, origin = None, ""
        peer = "a host that cannot be read"
        try:
            opening = self._opening_of(data)
            origin = opening.origin
            peer = f"{opening.hello.origin} (at {opening.origin})"
            link = self._open_link(opening)
            opened = _Opened(link.welcome, None)
        except Exception as error:
            if not isinstance(error, RrError):
                _log.exception("refusing a link of %s: accepting it failed", peer)
            opened = _Opened(None, failure_of(error))
        answer = _encode(opened)

        def reply(session: zenoh.Session) -> None:
            with query:
                query.reply(query.key_expr, answer)

        self._calls_to(origin).put(reply)
        if link is not None:
            link.start()

    def _opening_of(self, data: bytes) -> _Opening:
        if len(data) > _OPENING_BYTES:
            raise Unavailable(f"an opening of {len(data)} bytes, over the limit of {_OPENING_BYTES}")
        try:
            opening = _read_opening(data)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise Unavailable(f"{self.address} cannot read the opening of a link: {error}") from error
        if opening.protocol != PROTOCOL:
            raise ProtocolMismatch(
                f"{opening.origin} speaks protocol {opening.protocol}, {self.address} speaks {PROTOCOL}: "
                "install the same version of rr_actors on both hosts",
                host=self.address,
            )
        return opening

    def _open_link(self, opening: _Opening) -> HostLink:
        hello = opening.hello
        origin, name = opening.origin, opening.link
        key = (origin, name + _TO_ACCEPTOR)
        first = self._place_meant(origin) or opening.where
        if first != opening.where:
            raise NameTaken(
                f"a system in {place_of(first)} is host {origin!r} of group {self._group!r} already, so "
                f"{self.address!r} refuses the one in {place_of(opening.where)}: give each host a name of its own",
                name=origin,
            )
        if not _NAME.fullmatch(origin) or not _NAME.fullmatch(name) or key in self._links:
            raise Unavailable(f"the link {name!r} of {origin!r} is open already, or has no valid name")
        if self._closed or self._accept is None or hello.kind not in self._wires:
            raise Unavailable(f"{hello.to} takes no links of kind {hello.kind!r} at {self.address}")
        welcome, attach = self._accept(hello)
        put = self._putter(origin, name + _TO_DIALLER)
        link = HostLink(self._links, key, put, self._wires[hello.kind], hello, welcome, hello.origin)
        link.attach(attach)
        return link

    async def close(self) -> None:
        """Stop listening, send the queued messages (for a second at most), close all links, call `lost` for each."""
        self._closed = True
        links = [*self._links.values()]
        for link in links:
            link.close()
        with contextlib.suppress(TimeoutError):  # do not wait for a peer that does not read
            async with asyncio.timeout(2 * CLOSE_LIMIT_S):
                for link in links:
                    await link.closed.wait()
        for link in [*self._links.values()]:
            link.end(None)
        if self._thread is not None:
            senders = [*self._senders.values()]
            for sender in senders:
                sender.calls.put(None)
            with contextlib.suppress(TimeoutError):  # the end of the session ends a call to a host that reads nothing
                async with asyncio.timeout(CLOSE_LIMIT_S):
                    for sender in senders:
                        await sender.ended.wait()
            self._calls.put(None)
            await self._ended.wait()
            self._thread.join()
            for sender in senders:
                await sender.ended.wait()
                sender.thread.join()
