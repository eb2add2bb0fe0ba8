"""Hosts in a simulated world: leases, partitions between hosts, hosts that stand still, and clocks that drift.

A registrar "h1/r0" is on the host "h1". The gateways' links and heartbeats are made up. The leases are the real ones
(wire/hosts/leases.py), and so is what the registrars' core decides at their ends. In a world without hosts nothing of
this happens.

The promise: what a consumer holds is not released at the end of a lease while the consumer runs, counts on it, and has
been told nothing. And what is held under a new lease begins with nothing of the old one.
"""

from __future__ import annotations

from collections import deque
from typing import Any, NamedTuple

from rr_actors.registrar.core.reconciliation import is_fenced
from rr_actors.registrar.links.consumer_links import GATEWAY
from rr_actors.registrar.links.provider_link import LEASE_BITS
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.messages import Leased, Noticed
from rr_actors.registrar.model.rows import HELD, Held
from rr_actors.wire.hosts.leases import GivenLease, TakenLease, kept_s
from simulation.lives import Lives
from simulation.oracle import Violation
from simulation.sim_links import TO_CONSUMER, TO_PROVIDER
from simulation.sim_process import SimShell
from simulation.sim_registrar import SimRegistrar

LEASE_S = 10.0
_TENTH_S = 0.1


def host_of(name: str) -> str:
    """Return the host of a registrar; "" in a world without hosts."""
    return name.partition("/")[0] if "/" in name else ""


class GatewayLink:
    """A link from one gateway to another: heartbeats, and the time at which each was sent; and answers back."""

    def __init__(self) -> None:
        self.ways: tuple[deque[tuple[int, float]], deque[int]] = (deque(), deque())


class Taken:
    """What the gateway of a consumer's host knows of its lease at another host; the disk has the number and the end."""

    def __init__(self) -> None:
        self.lease = TakenLease()
        self.number = 1
        self.link: GatewayLink | None = None


class Sent(NamedTuple):
    """What a registrar was told: the hosts that have a lease, those that it owes, and the queries that they held."""

    named: frozenset[str]
    owed: frozenset[str]
    held: tuple[tuple[str, str], ...]


class SimHosts:
    """All gateways of a world, and the time.

    Args:
        names: the hosts.
        rates: how fast the clock of each goes.
    """

    def __init__(self, names: list[str], rates: dict[str, float]) -> None:
        self.names, self.rates = names, rates
        self.now = 0.0
        self.frozen: set[str] = set()
        self.taken = {(a, b): Taken() for a in names for b in names if a != b}
        self.given: dict[str, dict[str, GivenLease]] = {host: {} for host in names}
        self.known_from = dict.fromkeys(names, float("-inf"))
        self.owed: dict[str, set[str]] = {}  # by registrar: the hosts of which it has not released everything
        self.sent: dict[str, dict[int, Sent]] = {}
        self.numbers = 0
        self.lapsed: set[str] = set()  # queries that the end of a lease took
        self.clean: set[tuple[str, str]] = set()  # provider and consumer: it has released all that this one held

    def clock(self, host: str) -> float:
        """Return what the clock of a host says; they have not begun at the same time."""
        return 1000.0 * self.names.index(host) + self.rates[host] * self.now

    def barred(self, provider: str, host: str) -> bool:
        """Return whether a host gets no link to a registrar, as that may still have to release what it held."""
        sent = self.sent.get(provider, {})
        return host in self.owed.get(provider, ()) or any(host not in one.named for one in sent.values())

    def hear(self, given: GivenLease, host: str, _sent: float) -> None:
        """Have the gateway of a provider hear a heartbeat."""
        given.hear(self.clock(host))

    def knows(self, host: str) -> bool:
        """Return whether a gateway that was started again may say now which hosts have no lease."""
        return float("-inf") < self.known_from[host] <= self.clock(host)

    def acknowledge(self, lease: TakenLease, _host: str, number: int) -> None:
        """Have the gateway of a consumer hear that a heartbeat was heard."""
        lease.acknowledged(number, LEASE_S)

    def unknown_s(self) -> float:
        """Return for how long a gateway that was started again does not know who has a lease."""
        return kept_s(LEASE_S)


class Hosted(Lives):
    """Steps: tick, round, meet, beat, beaten, lapse, known, fence, freeze, thaw, stumble, gap."""

    hosts: SimHosts

    def begin_hosts(self, rates: dict[str, float]) -> None:
        """Give each host its gateway, with leases at all others."""
        self.hosts = SimHosts(list(rates), rates)
        self.round()

    def _renew(self, a: str, b: str) -> None:
        self.meet(a, b)
        self.beat(a, b)
        for way in (0, 1):
            while self.beaten(a, b, way):
                pass

    def round(self) -> bool:
        """All gateways that reach each other renew their leases."""
        for a, b in self.hosts.taken:
            self._renew(a, b)
        return bool(self.hosts.names)

    def mend_hosts(self) -> None:
        """Have all hosts run and reach each other, with leases that go on."""
        for host in list(self.hosts.frozen):
            self.thaw(host)
        self.end_leases()
        for a, b in self.hosts.taken:
            given = self.hosts.given[b].get(a)
            if given is not None and given.is_over(self.hosts.clock(b)):
                self.lapse(b, a)
        for b in self.hosts.names:
            self.hosts.known_from[b] = float("-inf")
        self.round()

    def on(self, host: str) -> list[SimRegistrar]:
        """Return the registrars of a host."""
        return [registrar for registrar in self.registrars.values() if host_of(registrar.name) == host]

    def crosses(self, one: str, other: str) -> bool:
        """Return whether two registrars are on different hosts."""
        return host_of(one) != host_of(other)

    def hosts_parted(self, a: str, b: str) -> bool:
        """Return whether a partition lies between two hosts."""
        here, there = self.on(a), self.on(b)
        return bool(here and there) and self.parted(here[0].name, there[0].name)

    def stands_still(self, step: tuple[Any, ...]) -> bool:
        """Return whether whoever would do this step is on a host that stands still."""
        frozen = self.hosts.frozen
        if not frozen or step[0] in ("crash", "cut", "part", "heal", "generation", "retire", "delete"):
            return False
        match step:
            case ("net", consumer, provider, way):
                return host_of(consumer if way == TO_CONSUMER else provider) in frozen
            case ("line", query_id, way, *_):
                line = self.lines.get(query_id)
                return line is not None and host_of(line.consumer if way == TO_CONSUMER else line.provider) in frozen
            case ("dial", consumer, provider):
                return host_of(consumer) in frozen or host_of(provider) in frozen
            case ("load", _, name, *_) | ("join", _, name, *_):
                return host_of(name) in frozen
            case (_, str() as name, *_):
                return host_of(name) in frozen
            case _:
                return False

    # -- time, and heartbeats --------------------------------------------------------------------------------------

    def tick(self, tenths: int) -> bool:
        """Time goes on. Each process that runs looks whether a lease is over, before anything else happens."""
        if not self.hosts.names:
            return False
        self.hosts.now += tenths * _TENTH_S
        self.end_leases()
        return True

    def meet(self, a: str, b: str) -> bool:
        """The gateway of a host opens a link to that of another."""
        taken = self.hosts.taken[a, b]
        if taken.link is not None or self.hosts_parted(a, b) or {a, b} & self.hosts.frozen:
            return False
        given = self.hosts.given[b].get(a)
        if given is not None and given.is_over(self.hosts.clock(b)):
            return False  # its gateway ends that first
        taken.link = GatewayLink()
        now = self.hosts.clock(b)
        self.hosts.given[b].setdefault(a, GivenLease(now, LEASE_S)).hear(now)
        return True

    def beat(self, a: str, b: str) -> bool:
        """A gateway sends a heartbeat."""
        taken, now = self.hosts.taken[a, b], self.hosts.clock(a)
        if taken.link is None or a in self.hosts.frozen:
            return False
        taken.link.ways[0].append((taken.lease.beat(now), now))
        return True

    def beaten(self, a: str, b: str, way: int) -> bool:
        """A heartbeat arrives, or the answer to one."""
        taken = self.hosts.taken[a, b]
        if taken.link is None or (self.held_up and self.hosts_parted(a, b)):
            return False
        if (b if way == 0 else a) in self.hosts.frozen or not taken.link.ways[way]:
            return False
        if way == 0:
            number, sent = taken.link.ways[0].popleft()
            self.hosts.hear(self.hosts.given[b][a], b, sent)
            taken.link.ways[1].append(number)
        else:
            self.hosts.acknowledge(taken.lease, a, taken.link.ways[1].popleft())
        return True

    def _unlink(self, a: str, b: str) -> None:
        taken = self.hosts.taken[a, b]
        taken.link = None
        taken.lease.lose()

    def part(self, names: tuple[str, ...], how: str, kept: int = 0) -> bool:
        if not super().part(names, how, kept):
            return False
        for a, b in self.hosts.taken:
            if how == "cut" and self.hosts_parted(a, b):
                self._unlink(a, b)
        return True

    def stumble(self, host: str) -> bool:
        """A gateway is killed and started again. It knows the leases that it has, and not those that it has given."""
        if host in self.hosts.frozen:
            return False
        for a, b in self.hosts.taken:
            if host in (a, b):
                self._unlink(a, b)
                for consumer in self.on(a):
                    for provider in self.on(b):
                        self.cut(consumer.name, provider.name, 0, 0)
                        self._break_lines_between(consumer.name, provider.name)
        self.hosts.given[host].clear()
        for registrar in self.on(host):
            self.hosts.sent.pop(registrar.name, None)
            self.hosts.owed.pop(registrar.name, None)
            self.todo.discard(("fence", registrar.name))
        self.hosts.known_from[host] = self.hosts.clock(host) + self.hosts.unknown_s()
        return True

    def freeze(self, host: str) -> bool:
        """A host stands still; what it has sent arrives, and time goes on."""
        if host in self.hosts.frozen:
            return False
        self.hosts.frozen.add(host)
        return True

    def thaw(self, host: str) -> bool:
        """It goes on; its processes look first whether a lease is over."""
        if host not in self.hosts.frozen:
            return False
        self.hosts.frozen.discard(host)
        self.end_leases()
        return True

    def gap(self, consumer: str, provider: str, way: int, place: int) -> bool:
        """The network drops what is on its way between hosts from there on. The numbers show that: the link breaks."""
        peering = self.registrars[consumer].clients.get(provider)
        if peering is None or peering.link.cut or not self.crosses(consumer, provider):
            return False
        ways = peering.link.ways
        if place >= len(ways[way]):
            return False
        self.drop(consumer, provider, way, place)
        return True

    def drop(self, consumer: str, provider: str, way: int, place: int) -> None:
        """Lose what is on its way behind that place, and the link with it."""
        ways = self.registrars[consumer].clients[provider].link.ways
        kept = (place, len(ways[1])) if way == TO_PROVIDER else (len(ways[0]), place)
        self.cut(consumer, provider, *kept)

    # -- the end of a lease, at the consumer's host ------------------------------------------------------------------

    def run_of(self, consumer: str, provider: str) -> int:
        """Return the epoch of a provider, with the number of the lease."""
        epoch = self.registrars[provider].epoch
        if not self.crosses(consumer, provider):
            return epoch
        return epoch | self.hosts.taken[host_of(consumer), host_of(provider)].number << LEASE_BITS

    def end_leases(self) -> None:
        """Have each host that runs look whether a lease of it is over."""
        for (a, b), taken in self.hosts.taken.items():
            if a not in self.hosts.frozen and taken.lease.is_over(self.hosts.clock(a)):
                self._end_taken(a, b)

    def _end_taken(self, a: str, b: str) -> None:
        taken = self.hosts.taken[a, b]
        runs = {p.name: self.run_of(consumer.name, p.name) for consumer in self.on(a) for p in self.on(b)}
        taken.lease, taken.link = TakenLease(), None
        taken.number += 1
        for consumer in self.on(a):
            for provider in self.on(b):
                self._unlink_consumer(consumer, provider.name)
                if consumer.state in ("up", "starting"):
                    self.tell_over(consumer, provider.name, runs[provider.name])

    def _unlink_consumer(self, consumer: SimRegistrar, provider: str) -> None:
        peering = consumer.clients.get(provider)
        if peering is not None:
            self._cut(consumer.name, provider, peering.link, (1_000_000, 0))
            self.todo.discard(("net", consumer.name, provider, TO_CONSUMER))
            consumer.unlinked(provider)
        self._break_lines_between(consumer.name, provider)

    def _break_lines_between(self, consumer: str, provider: str) -> None:
        for line in list(self.lines.values()):
            if (line.consumer, line.provider) == (consumer, provider) and not line.broken:
                self.break_line(line)

    def tell_over(self, consumer: SimRegistrar, provider: str, run: int) -> None:
        """Have a registrar decide that its lease is over, and hear so."""
        self._take_up(consumer)
        rows = (*consumer.catalog.held.values(), *consumer.catalog.in_flight.values())
        held = [row.id for row in rows if row.registrar == provider]
        if held or provider in consumer.catalog.peers:
            self.hosts.lapsed.update(held)
            consumer.post(c.LeaseOver(provider, run, "the lease is over", self.new_event()))
            self._take_up(consumer)

    def _take_up(self, registrar: SimRegistrar) -> None:
        while registrar.inbox and not registrar.disk_is_full and registrar.state in ("up", "starting"):
            self.wake(registrar.name)

    def up(self, name: str) -> bool:
        if not super().up(name):
            return False
        host, registrar = host_of(name), self.registrars[name]
        for provider in list(registrar.catalog.peers):
            if self.crosses(name, provider) and self.hosts.taken[host, host_of(provider)].lease.until is None:
                self.tell_over(registrar, provider, 0)
        return True

    def dial(self, consumer: str, provider: str) -> bool:
        if not self.crosses(consumer, provider):
            return super().dial(consumer, provider)
        a, b = host_of(consumer), host_of(provider)
        lease = self.hosts.taken[a, b].lease
        reached = lease.until is not None and a in self.hosts.given[b] and self.hosts.taken[a, b].link is not None
        bars = self.registrars[provider].state == "up" and self.hosts.barred(provider, a)
        if not reached or self.hosts_parted(a, b) or bars:
            return False
        before = self.registrars[consumer].clients.get(provider)
        if not super().dial(consumer, provider):
            return False
        if (
            before is None
            and provider in self.registrars[consumer].clients
            and (provider, consumer) in self.hosts.clean
        ):
            self.hosts.clean.discard((provider, consumer))
            if left := self.registrars[provider].catalog.by_origin.get(consumer):
                raise Violation("fence", f"{provider} has {sorted(left)} of a lease of {consumer} that is over")
        return True

    # -- the end of a lease, at the provider's host ------------------------------------------------------------------

    def lapse(self, b: str, a: str, kept: int = 0) -> bool:
        """A gateway ends the lease of another host.

        Args:
            kept: so many messages of each link are in the socket of a registrar.
        """
        given = self.hosts.given[b].get(a)
        if given is None or b in self.hosts.frozen or not given.is_over(self.hosts.clock(b)):
            return False
        del self.hosts.given[b][a]
        self._unlink(a, b)
        for provider in self.on(b):
            for consumer in self.on(a):
                link = provider.links.get(consumer.name)
                if link is not None and not link.cut:
                    self._cut(consumer.name, provider.name, link, (kept, 0))
                self._break_lines_between(consumer.name, provider.name)
            self._owe(provider.name, {a})
        return True

    def known(self, b: str) -> bool:
        """A gateway that was started again says which hosts have not come for the time of a lease."""
        hosts = self.hosts
        if not hosts.knows(b) or b in hosts.frozen:
            return False
        hosts.known_from[b] = float("-inf")
        for provider in self.on(b):
            self._owe(provider.name, set(hosts.names) - {b} - hosts.given[b].keys())
        return True

    def _owe(self, provider: str, hosts: set[str]) -> None:
        self.hosts.owed.setdefault(provider, set()).update(hosts)
        if hosts:
            self.todo.add(("fence", provider))

    def fence(self, name: str) -> bool:
        """A gateway tells a registrar which hosts have a lease."""
        hosts, registrar, host = self.hosts, self.registrars[name], host_of(name)
        if ("fence", name) not in self.todo or registrar.state != "up":
            return False
        if hosts.clock(host) < hosts.known_from[host]:
            return False
        owed = frozenset(hosts.owed[name])
        named = frozenset(hosts.given[host]) - owed | {host}
        queries = registrar.catalog.queries.values()
        held = tuple((query.id, query.origin) for query in queries if is_fenced(query.origin, named))
        hosts.numbers += 1
        hosts.sent.setdefault(name, {})[hosts.numbers] = Sent(named, owed, held)
        self.todo.discard(("fence", name))
        registrar.receive(Leased(sorted(named), hosts.numbers), GATEWAY)
        return True

    def close_fenced(self, provider: str, leased: list[str]) -> None:
        """A registrar closes the links and lines of hosts without a lease."""
        for origin in [name for name in self.registrars if is_fenced(name, leased)]:
            self.expel(provider, origin)
            self._break_lines_between(origin, provider)

    def released(self, provider: str, number: int) -> None:
        """A gateway hears that a registrar has released what it was to release; nobody is to have counted on that."""
        sent = self.hosts.sent.get(provider, {}).pop(number, None)
        if sent is None:
            return  # of a gateway that was killed since
        self.hosts.owed[provider] -= sent.owed
        for name in self.registrars:
            if host_of(name) in sent.owed:
                self.hosts.clean.add((provider, name))
        on_disk = self.registrars[provider].disk["queries"]
        for query_id, origin in sent.held:
            if query_id not in on_disk:
                self.hosts.lapsed.add(query_id)
                self.check_promise(query_id, origin, provider)

    def check_promise(self, query_id: str, origin: str, provider: str) -> None:
        """Check that nobody who runs counts on a query that is released, and has been told nothing."""
        consumer = self.registrars[origin]
        held = consumer.catalog.held.get(query_id)
        runs = consumer.state == "up" and host_of(origin) not in self.hosts.frozen and not consumer.disk_is_full
        if not runs or held is None or held.hold is not HELD or held.registrar != provider:
            return
        waiting = [item for item, _ in (*consumer.inbox, *consumer.held_back) if isinstance(item, Noticed)]
        told = {item.notice.query_id for item in waiting if item.notice.released}
        if query_id not in self.ledger.losses | told and query_id not in consumer.catalog.ending:
            raise Violation("leases", f"{provider} has released {query_id}, and {origin} runs, and counts on it")

    def may_be_lost(self, consumer: SimShell, held: Held) -> bool:
        return super().may_be_lost(consumer, held) or held.id in self.hosts.lapsed

    def fences_go_on(self, name: str) -> None:
        """A registrar's process has ended: it is told again when it is back."""
        self.hosts.sent.pop(name, None)
        if self.hosts.owed.get(name):
            self.todo.add(("fence", name))

    def crash(self, name: str, becomes: str = "down") -> bool:
        done = super().crash(name, becomes)
        if done:
            self.fences_go_on(name)
        return done
