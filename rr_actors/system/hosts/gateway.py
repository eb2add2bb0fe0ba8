"""Gateway: to the processes of its host it is the registrars of other hosts; to other hosts, the consumers here.

Each consumer's link has one link between the hosts. Another link between each two hosts carries what they export.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import functools
import importlib
import importlib.machinery
import time
from pathlib import Path
from typing import Any, NoReturn, cast

from msgspec.structs import replace

from rr_actors.actors.actor import Actor
from rr_actors.base.checks import invalid, missing_library
from rr_actors.base.errors import NameTaken, NotExported, ProtocolMismatch, RrError, Unavailable, few, is_a
from rr_actors.base.reporting.log import Log
from rr_actors.base.steps import Steps
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.links.provider_link import LEASE_BITS, THREADS
from rr_actors.registrar.model.messages import Describe, Described, Message
from rr_actors.supervision.core.specs import ChildSpec, Supervisor
from rr_actors.system.hosts.exported_registrars import ExportedRegistrars
from rr_actors.system.hosts.host_messages import (
    TO_CONSUMER,
    TO_PROVIDER,
    Beat,
    Beaten,
    Crossing,
    Exported,
    Exports,
    GatewayMessage,
    check_crosses,
    check_exports,
    no_types,
)
from rr_actors.system.hosts.host_settings import Hosts, named_in, names_of
from rr_actors.system.hosts.link_relay import Relay
from rr_actors.system.registrar_lookup import catalogs_on_disk, give_up_connected
from rr_actors.wire.hosts.host_link import HostLink
from rr_actors.wire.hosts.host_names import REFUSED, UNREACHABLE, UP, HostRow, away, not_exported, put_row, row_of
from rr_actors.wire.hosts.lease_rows import LeaseRow, boot_id, identity, now_s, read_lease, write_lease
from rr_actors.wire.hosts.leases import BEATS, GivenLease, TakenLease, kept_s
from rr_actors.wire.name_service import OtherHosts, Presence, registrar_key
from rr_actors.wire.transport import Attach, Hello, Link, Receiver, Welcome
from rr_actors.wire.unix_transport import UnixTransport

_log = Log(__name__)

_HOSTS = "hosts"
"""The kind of the link between two gateways."""
_AGAIN_S = 0.2
_TICK_S = 0.05
_LOOK_S = 1.0
_WHY_CHARACTERS = 250
_TWIN_S = 2.0
"""For so long a gateway that was killed may seem to be another system of its host's name."""
_KINDS = ("registrar", THREADS)
_MESSAGES: dict[str, Any] = dict.fromkeys(_KINDS, Message)


class _Peer:
    """Another host: its row, and what it exports to this one. It receives the messages of the link that it accepted."""

    def __init__(self, name: str, row: HostRow) -> None:
        self.name, self.row = name, row
        self.places: list[str] = []  # of the systems of that name that are there, the one that is meant first
        self.exports: dict[str, Exported] = {}
        self.meeting: asyncio.Task[None] | None = None
        self.said: Exports | None = None  # what it has said on the present link
        self.link: Link | None = None  # the link to its gateway
        self.lease = TakenLease()
        self.releasing: list[str] = []  # what releases there at the end of the lease
        self.number = 0  # of the lease, if it releases something at its end
        self.next_beat = 0.0
        self.because = row.why  # why it is away, without what has been tried since


GATEWAY = "hosts"
"""The id of the gateway among the children of the root."""


def with_gateway(root: Supervisor, hosts: object) -> tuple[Supervisor, OtherHosts]:
    """Return the tree with the gateway as the root's first child, and what all processes know of other hosts.

    Raises:
        InvalidSpec: hosts is no Hosts. Or the root's strategy is not one_for_one: a crash of the gateway would restart
            others.
        MissingDependency: the library zenoh is not installed.
    """
    if not is_a(hosts, Hosts):
        raise invalid("System", "hosts", "an rr.Hosts or None", hosts)
    if root.strategy != "one_for_one":
        expected = "'one_for_one' with hosts=; put your supervisor below such a root"
        raise invalid("System", "root.strategy", expected, root.strategy)
    if importlib.machinery.PathFinder.find_spec("zenoh") is None:
        raise missing_library("zenoh", "System(hosts=...)", "hosts")
    gateway = ChildSpec(Gateway, id=GATEWAY, args=(hosts,))
    return dataclasses.replace(root, children=(gateway, *root.children)), names_of(hosts)


class Gateway(Actor):
    """The child of the root that System(hosts=...) adds, in a process of its own."""

    def __init__(self, hosts: Hosts) -> None:
        self._hosts = hosts
        self._run: _Run | None = None

    async def _rr_before_start(self, place: Any) -> None:
        self._run = _Run(self._hosts, place.node)
        try:
            await self._run.start()
        except BaseException:
            await self._run.close()
            raise

    async def _rr_after_stop(self, final: bool) -> None:
        if self._run is not None:
            await self._run.close()


class _Run:
    """The gateway from its start to its end. On the loop."""

    def __init__(self, hosts: Hosts, node: Node) -> None:
        self._hosts, self._name = hosts, hosts.name
        self._node, self._directory = node, node.directory
        self._local = UnixTransport(
            node.info.run_dir, node.info.key, _MESSAGES, frame_limit_bytes=node.config.frame_limit_bytes
        )
        # Only this process imports zenoh.
        zenoh_link = importlib.import_module("rr_actors.wire.hosts.zenoh_link")
        self._network = zenoh_link.ZenohTransport(
            hosts.group,
            hosts.name,
            {**_MESSAGES, _HOSTS: GatewayMessage},
            listen=hosts.listen,
            connect=hosts.connect,
            frame_limit_bytes=node.config.frame_limit_bytes,
            on_peer=self._seen,
        )
        self._peers: dict[str, _Peer] = {}
        self._told: dict[Link, str] = {}  # the links by which other hosts hear what is exported
        self._relays: dict[Relay, tuple[str, bool]] = {}  # the other host of each, and whether it serves that host
        self._identity = identity(node.info.state_dir)
        self._given: dict[str, GivenLease] = {}
        self._releases = any(export.on_lost == "release" for export in hosts.exports.values())
        self._known_from = now_s() + kept_s(hosts.lease_s)  # then all that were away for that long are without a lease
        self._told_known = False
        self._ticking: asyncio.Task[None] | None = None
        self._exported: ExportedRegistrars | None = None
        self._twins: asyncio.TimerHandle | None = None
        self._looking: asyncio.Task[None] | None = None
        self._giving_up: asyncio.Task[None] | None = None
        self._closing = False

    async def start(self) -> None:
        """Listen on both sides, and look for other hosts."""
        self._begin_rows()
        await self._local.listen(self._accept_here)
        self._node.keeper.transports.append(self._local)
        self._exported = ExportedRegistrars(
            self._name, self._hosts.exports, self._node, self._local, self._tell_exports, self._leased
        )
        await self._network.listen(self._accept_host)
        self._ticking = asyncio.get_running_loop().create_task(self._tick())
        self._looking = asyncio.get_running_loop().create_task(self._look())

    async def close(self) -> None:
        """Close all links, and write that no other host is reachable."""
        self._closing = True
        steps = Steps()
        if self._twins is not None:
            self._twins.cancel()
        for task in (self._looking, self._ticking, self._giving_up):
            if task is not None:
                task.cancel()
        if self._exported is not None:
            steps.take("ending to look after exports", self._exported.close)
        for peer in self._peers.values():
            if peer.meeting is not None:
                peer.meeting.cancel()
            steps.take("noting that a host is away", self._away, peer, "the gateway here is being stopped")
        for relay in [*self._relays]:
            steps.take("closing a link between hosts", relay.close)
        try:
            await steps.take_async("closing the links to other hosts", self._network.close())
        finally:
            await steps.take_async("closing the links of this host", self._local.close())
        steps.end("the gateway: not closed altogether")

    # -- other hosts -----------------------------------------------------------------------------------------------

    def _begin_rows(self) -> None:
        """Write the rows of all hosts that are known: from the settings, and from a gateway that was killed."""
        self._directory.remove_host(self._name)
        for name in {*named_in(self._hosts), *self._directory.hosts()}:
            before = row_of(self._directory, name)
            why = "not seen since this system started" if before is None else "the gateway here has started again"
            since = before.since if before is not None and before.state == UNREACHABLE else time.time()
            peer = self._peers[name] = _Peer(name, HostRow(UNREACHABLE, since, why))
            self._begin_lease(peer)
            for registrar in self._directory.other_hosts_registrars():
                if registrar.startswith(f"{name}/"):
                    self._directory.mark(registrar_key(registrar), Presence.STARTING, away(name, peer.row))
            put_row(self._directory, name, peer.row)
        for target in self._hosts.routes.values():
            name = target.partition("/")[0]
            if name in self._peers:
                self._directory.mark(registrar_key(target), Presence.STARTING, away(name, self._peers[name].row))

    def _seen(self, name: str, places: list[str]) -> None:
        """Note that a system of that name has come or gone, as the network says, and where all of them are."""
        if self._closing:
            return
        if name == self._name:
            self._note_twins(places)
            return
        peer = self._peers.get(name)
        if peer is None:
            peer = self._peers[name] = _Peer(name, HostRow(UNREACHABLE, time.time(), "not met yet"))
            self._begin_lease(peer)
            put_row(self._directory, name, peer.row)
        peer.places = places
        if not places:
            self._away(peer, "its system has ended, or the network between")
        elif peer.meeting is None or peer.meeting.done():
            peer.meeting = asyncio.get_running_loop().create_task(self._meet(peer))
        elif peer.row.state == UP:
            self._set_row(peer, UP, _second(peer))

    def _note_twins(self, places: list[str]) -> None:
        """Note other systems that have this host's name; the gateway that was killed is one, for a moment."""
        if self._twins is not None:
            self._twins.cancel()
            self._twins = None
        if places:
            self._twins = asyncio.get_running_loop().call_later(_TWIN_S, self._report_twins, places)
        else:
            self._directory.remove_host(self._name)

    def _report_twins(self, places: list[str]) -> None:
        said = f"{_systems(places)} of group {self._hosts.group!r} has this host's name, too: give each one of its own"
        put_row(self._directory, self._name, HostRow(REFUSED, time.time(), said[:_WHY_CHARACTERS]))
        _log.error("host %s: %s", self._name, said)

    async def _meet(self, peer: _Peer) -> None:
        """Keep a link to a host that is alive, by which it says what it exports."""
        since = asyncio.get_running_loop().time()
        while peer.places and not self._closing:
            hearing = _Hearing(functools.partial(self._said, peer))
            try:
                hello = Hello(_HOSTS, peer.name, self._name, self._identity)
                peer.link = await self._network.connect(peer.name, hello, hearing.attach)
                peer.next_beat = 0.0
            except ProtocolMismatch as error:
                self._refused(peer, str(error))
                return
            except NameTaken as error:
                if asyncio.get_running_loop().time() > since + _TWIN_S:
                    self._refused(peer, str(error), name_taken=True)
                await asyncio.sleep(_AGAIN_S)
                continue
            except RrError as error:
                self._away(peer, f"no link to it: {error}")
                await asyncio.sleep(_AGAIN_S)
                continue
            await hearing.lost_event.wait()
            peer.link = None
            self._away(peer, f"the link to it is lost{hearing.because}")
            await asyncio.sleep(_AGAIN_S)

    def _said(self, peer: _Peer, message: GatewayMessage) -> None:
        """Take what the gateway of another host says on the link to it. It is up when it has heard a heartbeat."""
        match message:
            case Exports():
                check_exports(message)
                peer.said = message
                if peer.row.state == UP:
                    self._take_exports(peer, message)
            case Beaten(number):
                if peer.said is None or not peer.lease.acknowledged(number, peer.said.lease_s):
                    raise Unavailable(f"it has heard heartbeat {number}: none of that number waits")
                if peer.lease.is_over(now_s()):
                    self._end_taken(peer)
                    return
                self._write_lease(peer)
                if peer.row.state != UP:
                    self._take_exports(peer, peer.said)
            case Beat():
                _refuse(message)

    def _take_exports(self, peer: _Peer, message: Exports) -> None:
        """Write what a host exports into the directory; then that it is up."""
        peer.exports = {one.name: one for one in message.exported}
        for name, one in peer.exports.items():
            self._write(peer, name, one)
        prefix = f"{peer.name}/"
        for registrar in self._directory.other_hosts_registrars():
            if registrar.startswith(prefix) and registrar.removeprefix(prefix) not in peer.exports:
                self._directory.mark(registrar_key(registrar), Presence.GONE, not_exported(peer.name))
        if peer.row.state != UP and self._giving_up is None:
            self._giving_up = asyncio.get_running_loop().create_task(self._give_up_connected())
        self._set_row(peer, UP, _second(peer))

    async def _give_up_connected(self) -> None:
        """Release what clients of a killed application have left at other hosts: no gateway ran when this one began."""
        try:
            catalogs = await self._node.dispatcher.workers.run(
                catalogs_on_disk, self._node.config, Path(self._node.info.state_dir)
            )
            ended = (Presence.DORMANT, Presence.GONE)
            await give_up_connected(self._node, [name for name in catalogs if self._node.status_of(name) in ended])
        finally:
            self._giving_up = None

    def _write(self, peer: _Peer, name: str, one: Exported) -> None:
        key = registrar_key(f"{peer.name}/{name}")
        if one.status == Presence.UP:
            self._directory.publish(key, self._local.address)
        else:
            self._directory.mark(key, Presence(one.status), f"{peer.name}: {one.why}" if one.why else "")

    def _away(self, peer: _Peer, why: str) -> None:
        """Write that a host is not reachable; loads there wait, within their time limits."""
        peer.because = why
        peer.said = None
        peer.lease.lose()
        if peer.row.state == UNREACHABLE:
            self._say_why(peer, why)
            return
        self._set_row(peer, UNREACHABLE, why)
        for name in peer.exports:
            self._directory.mark(registrar_key(f"{peer.name}/{name}"), Presence.STARTING, away(peer.name, peer.row))
        peer.exports = {}
        self._close_relays(peer.name, serving=False)
        self._close_relays(peer.name, serving=True)

    def _close_relays(self, host: str, *, serving: bool) -> None:
        for relay in [relay for relay, place in self._relays.items() if place == (host, serving)]:
            relay.close()

    def _refused(self, peer: _Peer, why: str, *, name_taken: bool = False) -> None:
        """Write that a host refuses this one, also for the loads that wait for it."""
        self._set_row(peer, REFUSED, why, name_taken=name_taken)
        for registrar in self._directory.other_hosts_registrars():
            if registrar.startswith(f"{peer.name}/"):
                self._directory.mark(registrar_key(registrar), Presence.STARTING, away(peer.name, peer.row))

    # -- leases ----------------------------------------------------------------------------------------------------

    async def _tick(self) -> None:
        """Send heartbeats, and end the leases that are over."""
        while True:
            now = now_s()
            for peer in [*self._peers.values()]:
                if peer.lease.is_over(now):
                    self._end_taken(peer)
                elif peer.link is not None and peer.said is not None and now >= peer.next_beat:
                    peer.next_beat = now + peer.said.lease_s / BEATS
                    with contextlib.suppress(RrError):  # it does not read: the lease ends
                        peer.link.send_now(Beat(peer.lease.beat(now)))
            for host, given in [*self._given.items()]:
                if given.is_over(now):
                    self._end_given(host)
            if not self._told_known and now >= self._known_from and self._exported is not None:
                self._told_known = True
                self._exported.tell_leased()
            await asyncio.sleep(_TICK_S)

    def _begin_lease(self, peer: _Peer) -> None:
        """Go on with the lease of a gateway that was killed, or of a system that has ended."""
        row = read_lease(self._node.info.state_dir, peer.name)
        if row is not None:
            peer.number = row.number
            peer.releasing = row.registrars
            peer.lease = TakenLease(now_s() + row.left_s)

    def _write_lease(self, peer: _Peer) -> None:
        """Write the lease for the processes of this system, if anything is released at its end."""
        assert peer.said is not None
        releasing = [one.name for one in peer.said.exported if one.releases]
        if releasing or peer.number:
            peer.number = peer.number or 1
            peer.releasing = releasing
            self._write_row(peer, peer.lease.until or 0.0)

    def _write_row(self, peer: _Peer, until: float) -> None:
        row = LeaseRow(peer.number, until, boot_id(), peer.releasing)
        try:
            write_lease(self._node.info.state_dir, peer.name, row)
        except OSError as error:
            _log.error("the lease at host %s is not written, so what is held there is lost: %s", peer.name, error)

    def _end_taken(self, peer: _Peer) -> None:
        """End the lease of this host at another: it may release what is held there. The next one has another number."""
        peer.lease = TakenLease()
        if peer.number:
            _log.error("%s: the lease at host %s is over: what is held there is lost", self._name, peer.name)
            peer.number += 1
            self._write_row(peer, 0.0)
        if peer.link is not None:
            peer.link.close()
        if peer.row.state == UP:
            self._away(peer, "it has not answered for the time of the lease")
        elif peer.number:
            self._away(peer, f"{peer.because}; the lease is over, and what was held there is lost")

    def _end_given(self, host: str) -> None:
        """End the lease of another host here: nothing that is still on its way from there does anything."""
        del self._given[host]
        _log.warning("%s: the lease of host %s is over: what it holds is released", self._name, host)
        self._close_relays(host, serving=True)
        for link in [link for link, name in self._told.items() if name == host]:
            link.close()
        if self._exported is not None:
            self._exported.lease_over(host)

    def _leased(self) -> set[str] | None:
        """Return the hosts that have a lease here; None: others may have one of the gateway that was before this."""
        return set(self._given) if now_s() >= self._known_from else None

    async def _look(self) -> None:
        """Write of each host that is away where it has been looked for, while that goes on."""
        while True:
            if any(_is_away(peer) for peer in self._peers.values()):
                tried = self._tried(await self._network.reached())
                for peer in self._peers.values():
                    if _is_away(peer):
                        self._say_why(peer, f"{peer.because}; {tried}")
            await asyncio.sleep(_LOOK_S)

    def _tried(self, reached: list[str]) -> str:
        nobody = [endpoint for endpoint in self._hosts.connect if endpoint not in reached]
        said = [
            ("nobody answers at", nobody),
            ("another host answers at", reached),
            ("it has not connected to", [*self._hosts.listen]),
        ]
        return ", ".join(f"{what} {few(places)}" for what, places in said if places)

    def _say_why(self, peer: _Peer, why: str) -> None:
        """Write another reason for a host's being away, also into the entries of its registrars."""
        before = away(peer.name, peer.row)
        self._set_row(peer, UNREACHABLE, why)
        if before == (now := away(peer.name, peer.row)):
            return
        for registrar in self._directory.other_hosts_registrars():
            key = registrar_key(registrar)
            entry = self._directory.lookup(key) if registrar.startswith(f"{peer.name}/") else None
            if entry is not None and entry.why == before:
                self._directory.mark(key, Presence.STARTING, now)

    def _set_row(self, peer: _Peer, state: str, why: str, *, name_taken: bool = False) -> None:
        why = why[:_WHY_CHARACTERS]
        if (state, why) != (peer.row.state, peer.row.why):
            since = peer.row.since if state == peer.row.state else time.time()
            peer.row = HostRow(state, since, why, name_taken)
            put_row(self._directory, peer.name, peer.row)
            _log.info("%s: host %s is %s%s", self._name, peer.name, state, f": {why}" if why else "")

    # -- links of consumers here -----------------------------------------------------------------------------------

    def _accept_here(self, hello: Hello) -> tuple[Welcome, Attach]:
        """Accept a link of a consumer of this host, in the place of the provider "hostb/cameras"."""
        host, _, registrar = hello.to.partition("/")
        peer = self._peers.get(host)
        provider = None if peer is None else peer.exports.get(registrar)
        if provider is None or provider.status != Presence.UP:
            raise Unavailable(f"registrar {hello.to}: not reachable now")
        if peer is None or peer.lease.is_over(now_s()):
            raise Unavailable(f"registrar {hello.to}: the lease is over")
        crossing = Crossing(self._name, host)
        there = replace(hello, to=registrar, origin=f"{self._name}/{hello.origin}")

        def forth(link: Link, message: Any) -> Any:
            if type(message) is Describe:
                link.send_now(no_types(message))
                return None
            return crossing.to_provider(message)

        def back(_link: Link, message: Any) -> Any:
            check_crosses(message, TO_CONSUMER, hello.to)
            return crossing.to_consumer(message)

        def attach(link: Link) -> Receiver:
            dial = functools.partial(self._network.connect, host, there)
            return self._relay(link, (host, False), provider.epoch, dial, forth, back)

        # Another lease is another incarnation of the provider: answers of the one before do not count.
        number = peer.number if provider.releases else 0
        return Welcome(provider.epoch | number << LEASE_BITS), attach

    # -- links of other hosts --------------------------------------------------------------------------------------

    def _accept_host(self, hello: Hello) -> tuple[Welcome, Attach]:
        """Accept a link of another host: of its gateway, or of one of its consumers."""
        if hello.kind == _HOSTS:
            return Welcome(0), self._attach_gateway
        host = hello.origin.partition("/")[0]
        if self._exported is None:
            raise Unavailable(f"{self._name} is starting")
        return Welcome(self._exported.check(hello.to, host).epoch), functools.partial(self._attach_host, host)

    def _attach_gateway(self, link: Link) -> Receiver:
        host, now, who = _sender(link), now_s(), link.hello.epoch
        given = self._given.setdefault(host, GivenLease(now, self._hosts.lease_s, who))
        if given.identity != who and self._releases:
            text = f"another system of the name {host!r} has a lease at {self._name!r}: its end has to come first"
            raise NameTaken(f"{text}, {self._hosts.lease_s:g} s after it was heard", name=host)
        self._told[link] = host
        given.hear(now)
        if self._exported is not None:
            link.send_now(self._exports_for(host))

        def heard(message: GatewayMessage) -> None:
            if type(message) is not Beat or self._given.get(host) is not given:
                _refuse(message)
            given.hear(now_s())
            link.send_now(Beaten(message.number))

        return _Hearing(heard, functools.partial(self._told.pop, link, None))

    def _exports_for(self, host: str) -> Exports:
        assert self._exported is not None
        return Exports(self._exported.for_host(host), float(self._hosts.lease_s))

    def _attach_host(self, host: str, link: Link) -> Receiver:
        """Serve a consumer of another host, as which no third one may speak."""
        hello = link.hello
        if host != _sender(link) or hello.origin.count("/") != 1:
            text = f"host {_sender(link)!r} speaks for {hello.origin!r}: expected a registrar of its own"
            raise NotExported(text, host=self._name, registrar=hello.to)
        if host not in self._given:
            raise Unavailable(f"host {host!r} has no lease at {self._name!r}: its gateway comes first")
        peer = link.peer

        def forth(_link: Link, message: Any) -> Any:
            check_crosses(message, TO_PROVIDER, peer)
            return message

        def back(_link: Link, message: Any) -> Any:
            if type(message) is Described:  # a provider tells its consumers of new types
                return None
            check_crosses(message, TO_CONSUMER, hello.to)
            return message

        async def dial(attach: Attach) -> Link:
            assert self._exported is not None
            return await self._local.connect(self._exported.address(hello.to), hello, attach)

        return self._relay(link, (host, True), link.welcome.epoch, dial, forth, back)

    def _relay(self, link: Link, place: tuple[str, bool], epoch: int, dial: Any, forth: Any, back: Any) -> Receiver:
        relay = Relay(link, epoch, dial, forth, back, self._ended)
        self._relays[relay] = place
        return relay.end

    def _ended(self, relay: Relay) -> None:
        self._relays.pop(relay, None)

    def _tell_exports(self) -> None:
        """Tell all other hosts what they may load from, as it has changed."""
        if self._exported is not None:
            for link, host in [*self._told.items()]:
                with contextlib.suppress(RrError):  # it does not read: it hears of it with the next link
                    link.send_now(self._exports_for(host))


class _Hearing:
    """The receiver of a link between two gateways."""

    def __init__(self, heard: Any, ended: Any = None) -> None:
        self._heard, self._ended = heard, ended
        self.lost_event = asyncio.Event()
        self.because = ""

    def attach(self, _link: Link) -> Receiver:
        return self

    def received(self, link: Link, message: Any) -> None:
        self._heard(message)

    def lost(self, link: Link, reason: Exception | None) -> None:
        self.because = f": {reason}" if reason is not None else ""
        self.lost_event.set()
        if self._ended is not None:
            self._ended()


def _systems(places: list[str]) -> str:
    return f"a system in {few(places)}"


def _is_away(peer: _Peer) -> bool:
    return peer.row.state == UNREACHABLE and not peer.places


def _second(peer: _Peer) -> str:
    """Return what to say of a host that is up: that a second system has its name, or nothing."""
    others = peer.places[1:]
    return f"{_systems(others)} has its name, too, and is refused" if others else ""


def _sender(link: Link) -> str:
    """Return the host at the other end of a link between hosts: as the network says, not as the host says."""
    return cast(HostLink, link).address


def _refuse(message: Any) -> NoReturn:
    raise Unavailable(f"{type(message).__name__} on a link that only the other side sends on")
