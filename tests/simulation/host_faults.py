"""HostChance: what happens to the hosts of a simulated world, drawn from a stream of its own."""

from __future__ import annotations

import random
from typing import Any, TypeVar

from simulation.hosts import host_of
from simulation.sim_links import TO_CONSUMER, TO_PROVIDER
from simulation.world import Step, World

_T = TypeVar("_T")
_SLOWEST, _FASTEST = 0.957, 1.043
"""How fast clocks go: two of them differ by less than the margin of a lease."""


def on_hosts(rng: random.Random, plain: dict[str, _T]) -> tuple[dict[str, _T], dict[str, float]]:
    """Put the registrars of a world on two or three hosts; return them, and how fast the clock of each host goes."""
    names = [f"h{number}" for number in range(rng.choice((2, 2, 3)))]
    drifts = rng.random() < 0.7
    rates = {
        name: rng.choice((_SLOWEST, _FASTEST, rng.uniform(_SLOWEST, _FASTEST))) if drifts else 1.0 for name in names
    }
    return {f"{rng.choice(names)}/{name}": it for name, it in plain.items()}, rates


class HostChance:
    """Draws the steps of hosts. Each world has a mix of its own, and some have none of the trouble."""

    def __init__(self, seed: int, hosts: list[str]) -> None:
        self.rng = random.Random(f"hosts happen {seed}")
        draw = self.rng.random
        self.hosts = hosts
        self.pairs = [(a, b) for a in hosts for b in hosts if a != b]
        self.rate = 0.1 + draw() * 0.3
        self.renews = draw()  # how often all gateways renew their leases at once
        self.part = draw() * 0.1
        self.heal = 0.02 + draw() * 0.2
        self.freeze = draw() ** 2 * 0.1 if draw() < 0.5 else 0.0
        self.thaw = 0.05 + draw() * 0.3
        self.stumble = draw() ** 2 * 0.05 if draw() < 0.4 else 0.0
        self.gap = draw() ** 2 * 0.2 if draw() < 0.5 else 0.0
        self.slow = draw() < 0.3  # what is heard is answered late

    def next(self, world: World) -> Step | None:
        """What happens to a host now; None: nothing."""
        draw = self.rng.random
        if draw() >= self.rate:
            return None
        if world.apart and draw() < self.heal:
            return ("heal",)
        if world.hosts.frozen and draw() < self.thaw:
            return ("thaw", self.rng.choice(sorted(world.hosts.frozen)))
        if draw() < self.part and not world.apart:
            some = set(self.rng.sample(self.hosts, self.rng.randint(1, len(self.hosts) - 1)))
            names = tuple(name for name in world.registrars if host_of(name) in some)
            return ("part", names, self.rng.choice(("cut", "hold")), int(draw() * 3))
        if draw() < self.freeze:
            return ("freeze", self.rng.choice(self.hosts))
        if draw() < self.stumble:
            return ("stumble", self.rng.choice(self.hosts))
        if draw() < self.gap:
            return self._gap(world)
        return self._time(world)

    def _gap(self, world: World) -> Step | None:
        links: list[Any] = [
            ("gap", registrar.name, provider, way, int(self.rng.random() * len(peering.link.ways[way])))
            for registrar in world.registrars.values()
            for provider, peering in registrar.clients.items()
            for way in (TO_PROVIDER, TO_CONSUMER)
            if peering.link.ways[way] and host_of(provider) != host_of(registrar.name)
        ]
        return self.rng.choice(links) if links else None

    def _time(self, world: World) -> Step:
        draw = self.rng.random
        a, b = self.rng.choice(self.pairs)
        over = [
            (host, other)
            for host, given in world.hosts.given.items()
            for other, lease in given.items()
            if lease.is_over(world.hosts.clock(host))
        ]
        if over and draw() < 0.5:
            return ("lapse", *self.rng.choice(over), int(draw() * 3))
        if draw() < 0.05:
            return ("known", b)
        trouble = bool(world.apart or world.hosts.frozen)
        if draw() < (0.4 if trouble else 0.2):
            return ("tick", self.rng.choice((10, 30, 60) if trouble else (1, 5, 10, 10, 30)))
        if draw() < self.renews:
            return ("round",)
        if draw() < 0.3:
            return ("meet", a, b)
        if draw() < 0.35:
            return ("beat", a, b)
        return ("beaten", a, b, 0 if draw() < (0.8 if self.slow else 0.5) else 1)
