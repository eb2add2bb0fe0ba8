"""ProviderLink: a registrar's client, the actor that has its link to one provider.

It finds the provider, connects, reconciles, and reconnects. Its mailbox takes what its registrar has for the provider:
requests, and the wishes to connect, to know a server's types or all queries held there. It sends to its registrar what
comes from the provider.

While anything is asked, held or owed at the provider, it keeps trying: a provider that is being respawned is back
within milliseconds. It has no queue: open messages can be made from the rows, and reconciling sends them again.

A thread that loads or unloads and waits uses a connection of its own, beside the link. Then only the provider commits,
and the thread decides the changes that follow from the answer. If the connection breaks, the link sends the message
again.
"""

from __future__ import annotations

import asyncio
import os
import time
import zlib
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from rr_actors.actors.turns import CLOSED, Delivery, TurnActor
from rr_actors.base.errors import CatalogError, RegistrarDown, RrError, Unavailable, UnknownRegistrar
from rr_actors.base.names import PROVIDERS, ServerId, new_id
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.failure import failure_of
from rr_actors.registrar.engine.registrar_base import RegistrarBase
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import digests
from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.effects import Connect, SendRequest
from rr_actors.registrar.model.messages import (
    Describe,
    Described,
    Fetch,
    Fetched,
    FetchedQuery,
    Gone,
    Load,
    Loaded,
    LoadRefused,
    Message,
    Noticed,
    Progressed,
    Reprioritised,
    Unloaded,
    UnloadRefused,
    WaitedFor,
)
from rr_actors.registrar.model.rows import Hold, Put, ServerType
from rr_actors.runtime.processes.lifeline import is_ending
from rr_actors.runtime.thread_rules import any_thread, on_loop
from rr_actors.wire.name_service import NameEntry, Presence
from rr_actors.wire.thread_connections import ThreadConnections
from rr_actors.wire.transport import Exchange, Hello, Link

logger = Log("rr_actors.client")

THREADS = "direct"
"""Hello.kind of the connections of threads."""

_FIRST_RETRY_S = 0.002
_LAST_RETRY_S = 0.1
_STARTING_RETRY_S = 0.01  # the longest wait after a provider is up; to look into the directory takes 2 µs
_STOPPED_RETRY_S = 0.25
_STAYS_DOWN_S = {Presence.STOPPED: 0.2, Presence.DORMANT: 1.0}  # else it may be between two starts: an import, at most
_WRITE_AGAIN_S = 0.25
_LOOK_AT_LEASE_S = 1.0  # at least so often: the loop's timers stand still while the machine sleeps
LEASE_BITS = 32
"""The epoch of a provider of another host has its own epoch below these bits, and the number of the lease above."""

_ANSWERS = frozenset({Loaded, LoadRefused, Unloaded, UnloadRefused, Reprioritised, WaitedFor})
_A_PROVIDERS = _ANSWERS | {Fetched, Noticed}  # and the side messages (ProviderLink)

Fetching = Callable[[list[FetchedQuery] | None, Exception | None], None]


class FetchQueries(msgspec.Struct, frozen=True, eq=False):
    """Ask for the queries that the registrar holds at the provider; `done` gets them, or the error."""

    done: Fetching


class LearnTypes(msgspec.Struct, frozen=True):
    """Ask for a server's types, unless this link has brought them; `at_once`: do not wait for other messages."""

    server: str
    at_once: bool


@on_loop
class ProviderLink(TurnActor):
    """The client of one registrar for one provider.

    Attributes:
        link: the present one; `opened` is the number of the Fetch that opened the last one.
        connections: those of threads, beside the link; they may be used as Calls.connections_to() says.
        is_uncalled: whether no thread has asked for one of them yet, and opening one takes a handshake.
        undescribed: the servers whose types have been asked for, or have to be, and have not come yet.
    """

    def __init__(self, registrar: RegistrarBase, provider: str) -> None:
        self._registrar = registrar
        self._node = registrar.node
        self.provider = provider
        self.link: Link | None = None
        self.opened = 0  # the number of the Fetch that opened the last link
        self._task: asyncio.Task[None] | None = None
        self._asked = False
        self._chunks: list[FetchedQuery] = []
        self._fetching: list[Fetching] = []  # called fetch(), oldest first
        self._listed_for = 0  # how many of them the last Fetch asks for: those that had called before it was sent
        self._reconciled = False
        self._known: digests.HeldRows | None = None  # the rows held there, and their digests, when last looked at
        self._number = registrar.epoch << 32  # the number of the last Fetch
        self._linked = False  # whether there was ever a link
        self._lost_seq = 0  # the running number at which the last link ended (RegistrarState.sequence)
        self._gone = False  # whether the registrar knows that the provider is gone for good
        self._down: tuple[Presence, float] | None = None  # why the last tries have failed, and since when (monotonic)
        self._described: set[str] = set()
        self.undescribed: set[str] = set()
        self.checksums: dict[str, int] = {}  # by server, those of the types that are known (Loaded.types)
        self.connections: ThreadConnections[Exchange] = ThreadConnections(self._dial_for_thread)
        self.is_uncalled = False
        self._side: dict[type[Any], Callable[[Any], None]] = {  # messages of the provider that are not decided
            Described: self._take_types,
            Progressed: self._hear_progress,
        }
        self._unflushed: Link | None = None  # a link with unsent requests
        self._run = 0  # the epoch of the provider in the last link
        self._lease = 0  # the number of the lease under which something may be held; 0: none
        self._lease_timer: asyncio.TimerHandle | None = None
        if self._node.info.hosts is not None and "/" in provider:  # something may be held from before a crash
            self._node.dispatcher.loop.call_soon_threadsafe(self._watch_lease)

    # -- the handler ---------------------------------------------------------------------------------------------

    def handle(self, deliveries: Sequence[Delivery]) -> None:
        """Do what the registrar wants of its provider."""
        for message, _ in deliveries:
            match message:
                case SendRequest() as wanted:
                    self._request(wanted)
                case Connect():
                    self._want()
                case LearnTypes(server, at_once):
                    self._describe(server, at_once=at_once)
                case FetchQueries(done):
                    self._fetch(done)
                case other:
                    raise TypeError(f"{self.actor_ref}: unknown message {type(other).__name__}")

    def follow(self) -> None:
        """Send the requests of the turn, together."""
        if self._unflushed is not None:
            link, self._unflushed = self._unflushed, None
            link.flush()

    def _request(self, wanted: SendRequest) -> None:
        link, registrar = self.link, self._registrar
        if link is None:
            self._want()
            return
        if registrar.catalog.up.get(self.provider) != self.opened:
            return  # decided for an earlier link: reconciling this one sends all open messages again
        try:
            if type(wanted.message) is Load:
                self._describe(wanted.message.server)
            link.send(wanted.message)
        except RrError as error:
            self._not_sent(link, wanted, error)
            return
        if self._node.watched.level[0] > 1:
            registrar.recorder.message("sent", registrar.name, self.provider, wanted.message)
        self._unflushed = link

    def _not_sent(self, link: Link, wanted: SendRequest, error: RrError) -> None:
        registrar = self._registrar
        if type(wanted.message) is Load:
            registrar.post(c.GiveUp(wanted.message.query_id, failure_of(error)))
            return
        logger.error("%s: %s; closing the link, what is open is sent again over the next", registrar.name, error)
        link.close()

    # -- for threads ---------------------------------------------------------------------------------------------

    @any_thread
    def has_run_since(self, seq: int) -> bool:
        """Return whether the provider is up, and no link to it has ended since the query of this number was asked for.

        Then the process that has answered the load runs. The event loop hears of the end of a link later than others
        see what the provider's end has closed, so this looks at the provider itself, too.
        """
        link, here = self.link, self._registrar.peers.get(self.provider)
        if link is None or self._registrar.catalog.up.get(self.provider) != self.opened or seq <= self._lost_seq:
            return False
        return not is_ending(link.pid) if link.pid != os.getpid() else here is not None and not here.closed

    @any_thread
    def _dial_for_thread(self, timeout_s: float) -> Exchange | None:
        entry, link = self._node.find(self.provider), self.link
        if entry is None or entry.status is not Presence.UP or link is None:
            return None
        hello = self._hello(THREADS)
        here = self._registrar.peers.get(self.provider)
        line: Exchange
        if here is not None:
            line = here.line(hello)
        else:
            line = self._node.transport.dial(entry.address, hello, timeout_s)
        if line.epoch != link.welcome.epoch:
            line.close()
            return None
        return line

    @any_thread
    def epoch_here(self) -> int | None:
        """Return the provider's epoch if it is in this process, and the link is to its present incarnation."""
        here, link = self._registrar.peers.get(self.provider), self.link
        return None if here is None or link is None or here.epoch != link.welcome.epoch else here.epoch

    @any_thread
    def answer_at_once(self, message: Message) -> Message | None:
        """Have a provider of this process answer without waiting. None: it has not taken the message."""
        here = self._registrar.peers.get(self.provider)
        return None if here is None else here.answer_at_once(message, self._hello(THREADS))

    # -- for the registrar ---------------------------------------------------------------------------------------

    def want(self) -> None:
        """Have a link opened if there is none; if that is impossible, the registrar gets PeerGone with the reason."""
        self.deliver(Connect(self.provider))

    def _want(self) -> None:
        self._asked = True
        if self.link is None and self._task is None and not self._registrar.closed:
            self._task = self._node.dispatcher.loop.create_task(self._connect())

    def link_again(self) -> None:
        """Close the link and open another, over which the provider lists again what is held there."""
        self._drop_link()
        self._want()

    def _drop_link(self) -> None:
        link, self.link, self._lost_seq = self.link, None, next(self._registrar.sequence)
        self.connections.close()
        if link is not None:
            link.close()

    def _describe(self, server: str, *, at_once: bool = False) -> None:
        if self.link is None:
            self.undescribed.add(server)
            self._want()
        elif server not in self._described:
            self.undescribed.add(server)  # until the answer is there: this link may break before
            self.link.send(Describe(server))
            if at_once:
                self.link.flush()

    def _fetch(self, done: Fetching) -> None:
        if self._registrar.closed:
            done(None, self._registrar.down())
            return
        self._fetching.append(done)
        if self.link is None:
            self._want()
        elif self._reconciled and len(self._fetching) == 1:  # else the next Fetch is sent when the last is answered
            self._send_fetch(self.link, resume=False)

    def take_leave(self) -> None:
        """Have the provider release all queries, also those of threads, as this registrar does not come back."""
        if self.link is not None and self.provider != self._registrar.name:
            try:
                self.link.send(Gone(self._registrar.name))
            except RrError as error:
                logger.warning("%s: could not take leave of %s: %s", self._registrar.name, self.provider, error)

    def close(self) -> None:
        """Close the link, as the registrar is closed."""
        if self._task is not None:
            self._task.cancel()
            self._task = None
        self._drop_link()
        self._end_fetches(self._registrar.down())
        if self._lease_timer is not None:
            self._lease_timer.cancel()
        self.closed = True
        self.end_life(CLOSED)

    # -- connecting ----------------------------------------------------------------------------------------------

    async def _connect(self) -> None:
        try:
            delay, registrar = _FIRST_RETRY_S, self._registrar
            while not registrar.closed and (self._asked or registrar.catalog.needs(self.provider) or self._fetching):
                wait = await self._try_once(delay)
                if wait is None:
                    return
                await asyncio.sleep(wait)
                delay = min(delay * 1.5, _LAST_RETRY_S)
        finally:
            self._task = None

    async def _try_once(self, delay: float) -> float | None:
        """Try once to connect; return the seconds to wait before the next try, or None if no other is needed."""
        entry = self._node.find(self.provider)
        if entry is None:  # if it had anything, its catalog would have been found, and it would be dormant
            self._unreachable(self._node.directory.no_registrar(self.provider), final=True, empty=True)
            return None
        if entry.status is Presence.GONE:
            if self._asked or self._fetching or not self._gone:
                self._gone = True
                text = f"registrar {self.provider!r}: gone for good{entry.because}"
                self._unreachable(RegistrarDown(text, registrar=self.provider, status=str(entry.status)), final=True)
            return _STOPPED_RETRY_S  # what is owed there is delivered if it is started again under its name
        self._gone = False
        stays_down = self._stays_down(entry)
        if entry.status in (Presence.STOPPED, Presence.DORMANT):
            if self._asked or self._fetching or (stays_down and self._waits()):
                self._say_releases_wait(entry)
                text = f"registrar {self.provider!r}: {entry.status}{entry.because}; start it again, or take another"
                down = RegistrarDown(text, registrar=self.provider, status=str(entry.status))
                self._unreachable(down, final=False)
            return _STOPPED_RETRY_S
        if entry.status is Presence.STARTING:
            if self._known is None and entry.address:  # its process is reading its catalog, so there is time for this
                self._known = await self._look_ahead()
            return min(delay, _STARTING_RETRY_S)
        try:
            await self._dial(entry.address)
        except (Unavailable, UnknownRegistrar):  # it has just died, or does not serve yet: the directory will say
            return delay
        except RrError as error:
            logger.error("%s: cannot connect to %s: %s", self._registrar.name, self.provider, error)
            self._unreachable(error, final=False)
            return _STOPPED_RETRY_S
        return None

    def _stays_down(self, entry: NameEntry) -> bool:
        """Return whether the provider has been down for so long that nothing seems to be about to start it again."""
        limit_s = None if entry.turn else _STAYS_DOWN_S.get(entry.status)
        if limit_s is None:
            self._down = None
            return False
        now = time.monotonic()
        if self._down is None or self._down[0] is not entry.status:
            self._down = entry.status, now
        return now - self._down[1] >= limit_s

    def _waits(self) -> bool:
        """Return whether a load that was sent waits for the provider."""
        with self._registrar.lock:
            return self._registrar.whole().waits_for(self.provider)

    async def _look_ahead(self) -> digests.HeldRows | None:
        """Return the rows held at the provider with their digests, before the link is there.

        They are probably still true then. The loop serves others in between.
        """
        rows = self._registrar.held_at(self.provider)
        if rows is None:
            return None
        told: digests.Spans = []
        for span in digests.cut(rows):
            told.append(span)
            await asyncio.sleep(0)
        return digests.HeldRows(rows, told)

    async def _dial(self, address: str) -> None:
        transport = self._node.local if address == self._node.local.address else self._node.transport
        link = await transport.connect(address, self._hello("registrar"), self._attach)
        if self._registrar.closed:
            link.close()
            return
        rows = None if self._fetching else self._registrar.held_at(self.provider)  # fetch() needs all queries listed
        known = None if rows is None else digests.known(rows, self._known)
        self._known = None
        lease = link.welcome.epoch >> LEASE_BITS
        if self._lease not in (0, lease) and lease:
            self._end_lease()
        self._lease = lease
        self._run = link.welcome.epoch
        self.link = link
        self._watch_lease()
        self.connections = ThreadConnections(self._dial_for_thread)
        self.is_uncalled = transport is self._node.transport
        self._asked = False
        self._reconciled = False
        self._described.clear()
        self._chunks.clear()
        self._send_fetch(link, resume=True, known=known)
        self.opened = self._number

    @any_thread
    def _hello(self, kind: str) -> Hello:
        return Hello(kind, self.provider, self._registrar.name, self._registrar.epoch)

    def _send_fetch(self, link: Link, *, resume: bool, known: digests.HeldRows | None = None) -> None:
        self._number += 1
        self._listed_for = len(self._fetching)
        link.send(Fetch(self._registrar.name, resume, self._number, known.spans if known else []))
        link.flush()

    def _say_releases_wait(self, entry: NameEntry) -> None:
        """Log that callers wait for releases at a provider that has to be started again."""
        held = self._registrar.catalog.held
        rows = (held.get(query_id) for query_id in list(self._registrar.unloads))
        if any(row is not None and row.registrar == self.provider for row in rows):
            text = "%s: a release waits for registrar %r, which is %s%s: start it again; until then the release is owed"
            logger.warning(text, self._registrar.name, self.provider, entry.status, entry.because)

    def _unreachable(self, error: RrError, *, final: bool, empty: bool = False) -> None:
        self._asked = False
        self._end_fetches(error)
        self._registrar.post(c.PeerGone(self.provider, failure_of(error), final, new_id(), empty))

    def _end_fetches(self, error: RrError) -> None:
        fetching, self._fetching = self._fetching, []
        for done in fetching:
            done(None, error)

    def _attach(self, _link: Link) -> ProviderLink:
        return self

    # -- the lease, if the provider is of another host -------------------------------------------------------------
    #
    # The gateway closes the link when the lease is over. But it may be frozen, or killed, just then. So each process
    # looks for itself whether the lease was renewed.

    def _watch_lease(self) -> None:
        hosts, info = self._node.info.hosts, self._node.info
        lease = None if hosts is None else hosts.lease(info.state_dir, self.provider)
        if self._lease_timer is not None:
            self._lease_timer.cancel()
            self._lease_timer = None
        if lease is None or self._registrar.closed:
            return
        self._lease = self._lease or lease[0]
        wait_s = max(0.0, min(lease[1], _LOOK_AT_LEASE_S)) if lease[0] == self._lease else 0.0
        self._lease_timer = self._node.dispatcher.loop.call_later(wait_s, self._look_at_lease)

    def _look_at_lease(self) -> None:
        """End the lease if it is over, or if another has begun."""
        hosts = self._node.info.hosts
        if hosts is None or not self._lease or self._registrar.closed:
            return
        lease = hosts.lease(self._node.info.state_dir, self.provider)
        if lease is None or (lease[0] == self._lease and lease[1] > 0):
            self._watch_lease()
            return
        if self.link is not None:
            self._drop_link()
            self._registrar.post(c.LinkLost(self.provider))
        self._end_lease()
        if self._registrar.catalog.needs(self.provider):
            self._want()

    def _end_lease(self) -> None:
        """Have the registrar lose all that it holds there."""
        host = self.provider.partition("/")[0]
        why = f"the lease at host {host!r} is over: it was not reachable for so long, and may have released this"
        self._lease = 0
        self._registrar.post(c.LeaseOver(self.provider, self._run, why, new_id()))

    # -- messages of the provider --------------------------------------------------------------------------------

    def received(self, link: Link, message: Any) -> None:
        """Take a message of the provider; raise Unavailable, which closes the link, if it is a consumer's."""
        kind = message.__class__
        if kind not in _A_PROVIDERS and kind not in self._side:
            raise Unavailable(f"{kind.__name__} is a consumer's to say, not a provider's")
        if self._node.watched.level[0] > 1:
            self._registrar.recorder.message("received", self._registrar.name, self.provider, message)
        if kind in _ANSWERS or (kind is Noticed and self._reconciled):
            self._registrar.receive(message, self.provider, more=link.more)
        elif kind is Fetched:
            self._fetched(link, message)
        elif kind in self._side:
            self._side[kind](message)
        # A notice that comes before the list of queries is sent again behind it.

    def _hear_progress(self, message: Progressed) -> None:
        registrar = self._registrar
        if message.in_line:
            with registrar.lock:  # a thread that has got its answer forgets the place behind this
                pending = [id for id in message.query_ids if _is_pending(registrar.whole(), id)]
                registrar.listeners.place(message, pending)
        registrar.listeners.hear(self.provider, message)

    def _take_types(self, message: Described) -> None:
        """Keep the types of a server, if they were asked for or an older version of them is known."""
        server = f"{self.provider}/{message.server}"
        if message.server in self.undescribed or server in self._registrar.catalog.server_types:
            self._described.add(message.server)
            self.undescribed.discard(message.server)
            self._registrar.described(server, message.blob)
            self.checksums[message.server] = zlib.crc32(message.blob)

    def _fetched(self, link: Link, message: Fetched) -> None:
        if message.number != self._number:
            return  # an earlier incarnation has asked for it
        self._chunks.extend(message.queries)
        if message.more:
            return
        queries, self._chunks = self._chunks, []
        if not self._reconciled:
            self._reconciled = True
            self.undescribed.update(query.server for query in queries)
            prefix = f"{self.provider}/"
            with self._registrar.lock:
                catalog = self._registrar.whole()
                if message.same and not self._linked:  # and those of queries that agree, and so are not listed
                    self.undescribed.update(catalog.held[id].server for id in catalog.outbound.get(self.provider, ()))
                known = [row for server, row in catalog.server_types.items() if server.startswith(prefix)]
            self._linked = True
            self.checksums = {row.id.removeprefix(prefix): zlib.crc32(row.blob) for row in known}
            self.undescribed.update(self.checksums)  # types that were sent to an earlier incarnation
            for server in self.undescribed:
                link.send(Describe(server))
            link.flush()
            run = link.welcome.epoch
            link_facts = (message.same, message.number, run, message.notices)
            reconcile = c.Reconcile(self.provider, queries, new_id(), *link_facts)
            # with `more`: notices follow, which say why a query is not in the list
            self._registrar.post(reconcile, more=link.more)
        answered, self._fetching = self._fetching[: self._listed_for], self._fetching[self._listed_for :]
        for done in answered:
            done(queries, None)
        if self._fetching and self.link is link:
            self._send_fetch(link, resume=False)

    def lost(self, link: Link, reason: Exception | None) -> None:
        """Note that the link is down, and connect again if anything is open at the provider."""
        closed = self._registrar.closed
        if reason is not None and not closed:
            logger.info("%s: link to %s lost: %s", self._registrar.name, self.provider, reason)
        if self.link is not link and self.link is not None:
            return
        self.link, self._lost_seq = None, next(self._registrar.sequence)
        self.connections.close()
        if closed:
            return
        self._registrar.post(c.LinkLost(self.provider))
        self._look_at_lease()
        if self._registrar.catalog.needs(self.provider) or self._fetching:
            asked = self._asked
            self._want()
            self._asked = asked  # unchanged: if no caller asks, it is no error that the provider is stopped


def _is_pending(catalog: Catalog, query_id: str) -> bool:
    held = catalog.held.get(query_id)
    return query_id in catalog.in_flight or (held is not None and held.hold is Hold.PENDING)


class ProviderLinks(dict[str, ProviderLink]):
    """The clients of one registrar, by provider; one that is asked for is made."""

    def __init__(self, registrar: RegistrarBase) -> None:
        super().__init__()
        self._registrar = registrar

    def __missing__(self, provider: str) -> ProviderLink:
        registrar = self._registrar
        path = f"{registrar.actor_ref.path}/{PROVIDERS}/{provider}"
        client = self[provider] = ProviderLink.made(path, registrar, provider)
        client.begin_life(registrar.node.dispatcher, registrar.node.hub)
        return client


@on_loop
class ServerTypes:
    """The types of the servers of one registrar's providers; its catalog keeps them."""

    def __init__(self, registrar: RegistrarBase, clients: ProviderLinks) -> None:
        self._registrar = registrar
        self._clients = clients
        self._wanting: dict[str, list[Callable[[], None]]] = {}
        self._newest: dict[str, bytes] = {}

    def tell(self, server: ServerId, told: Callable[[], None]) -> None:
        """Call `told` when the types of a provider's server are known."""
        if str(server) in self._registrar.catalog.server_types:
            told()
            return
        self._wanting.setdefault(str(server), []).append(told)
        self._clients[server.registrar].deliver(LearnTypes(server.server, at_once=True))

    def described(self, server: str, blob: bytes) -> None:
        """Keep the types that a provider has sent, and call the callers that wait for them."""
        self._newest[server] = blob
        self._keep(server, blob)

    def _keep(self, server: str, blob: bytes) -> None:
        registrar = self._registrar
        if registrar.closed or self._newest[server] is not blob:
            return
        known = registrar.catalog.server_types.get(server)
        if known is None or known.blob != blob:
            row = ServerType(server, blob)  # written now: after a respawn, on_start reads queries before a link is up
            try:
                registrar.commit_rows([Put(row)])
            except CatalogError as error:  # a full disk, for instance: the callers wait, within their time limits
                logger.warning("%s: the types of %s are written later: %s", registrar.name, server, error)
                registrar.node.dispatcher.loop.call_later(_WRITE_AGAIN_S, self._keep, server, blob)
                return
        for told in self._wanting.pop(server, ()):
            told()
