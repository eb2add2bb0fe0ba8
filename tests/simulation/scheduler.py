"""Chance: what happens next in a simulated world, drawn from one seeded generator. Same seed, same history."""

from __future__ import annotations

import random

from msgspec.structs import replace

from rr_actors.registrar.model.catalog import Server
from simulation.host_faults import HostChance, on_hosts
from simulation.pending_steps import Key
from simulation.process_faults import EXCLUSIVE_FIRST, FIRST, HASTY_FIRST, HOSTS_FIRST, IDLE_FIRST, Rough
from simulation.world import Step, World

REQUESTS = (b"p", b"q")
STATES = ("OK", "UPDATE", "WARNING", "ERROR", "FATAL")


def layout(rng: random.Random) -> dict[str, tuple[Server, ...]]:
    """Registrars and their servers: those of higher levels load from lower ones; one serves nothing."""
    made: dict[str, tuple[Server, ...]] = {"app": ()}
    for level in range(rng.randint(1, 4)):
        servers = tuple(_server(rng, f"s{number}") for number in range(rng.choice((1, 1, 2))))
        made[f"r{level}"] = servers
    if rng.random() < 0.3:
        made["bpp"] = ()
    return made


def _server(rng: random.Random, name: str) -> Server:
    linger_s = 1.0 if rng.random() < 0.2 else 0.0
    limit_s = 1.0 if rng.random() < 0.2 else None
    recovery = rng.choice(("keep", "keep", "reload", "lost"))
    return Server(name, linger_s, limit_s, recovery, rng.random() < 0.4, rng.random() < 0.4)


def _with_pauses(rng: random.Random, plain: dict[str, tuple[Server, ...]]) -> dict[str, tuple[Server, ...]]:
    """Some servers pause what idles, and unload it later: else it would be there when everybody has let go."""
    some = rng.random()
    return {
        name: tuple(replace(s, pauses=True, paused_s=1.0) if rng.random() < some else s for s in servers)
        for name, servers in plain.items()
    }


def _with_exclusive(rng: random.Random, plain: dict[str, tuple[Server, ...]]) -> dict[str, tuple[Server, ...]]:
    some = rng.random()
    return {
        name: tuple(replace(s, exclusive=True, grace_ms=1000) if rng.random() < some else s for s in servers)
        for name, servers in plain.items()
    }


class Chance:
    """Draws the steps of one run. How often what happens differs from run to run: rare mixes are found sooner."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.layout = layout(self.rng)
        if seed >= IDLE_FIRST:
            self.layout = _with_pauses(random.Random(f"idle {seed}"), self.layout)
        self._waits: random.Random | None = None
        if seed >= EXCLUSIVE_FIRST:
            self._waits = random.Random(f"exclusive {seed}")
            self.layout = _with_exclusive(self._waits, self.layout)
        self.rates: dict[str, float] = {}
        self._hosts: HostChance | None = None
        if seed >= HOSTS_FIRST:
            self.layout, self.rates = on_hosts(random.Random(f"hosts {seed}"), self.layout)
            self._hosts = HostChance(seed, list(self.rates))
        self.names = list(self.layout)
        self.providers = [name for name, servers in self.layout.items() if servers]
        draw = self.rng.random
        self.crash = draw() ** 3 * 0.04
        self.cut = draw() ** 2 * 0.04
        self.people = 0.03 + draw() * 0.15
        self.owners = draw() ** 2 * 0.03
        self.faulty_disk = draw() ** 3 * 0.1
        self.fails = draw() ** 2 * 0.4
        self.subs = draw() * 0.7
        hasty = random.Random(f"hasty {seed}")
        some = hasty.random() if seed >= HASTY_FIRST else 0.0
        self.hasty = frozenset(name for name in self.names if hasty.random() < some)
        self.rough = Rough(seed, self.names) if seed >= FIRST else None
        self.rings = 0.3 if draw() < 0.2 else 0.0
        if self.rough is not None:
            self.rings = max(self.rings, self.rough.rings)
            self.subs = max(self.subs, self.rough.subs)
        reloads = self.rough is not None and self.rough.reloads
        if reloads or any(server.recovery == "reload" for servers in self.layout.values() for server in servers):
            self.rings = 0.0  # a reload that loads what holds it makes a ring that waits for nothing: not found
        self.tired = draw() ** 2 * 0.5
        self.direct = 0.5 if draw() < 0.5 else 0.0  # of those who ask
        if self.rough is not None and (self.rough.brief or self.rough.haste):
            self.direct = 0.9
            self.people += 0.1
        if self.rough is not None and self.rough.swap:
            self.people, self.crash, self.cut = self.people * 0.3, self.crash * 0.2, self.cut * 0.2  # wholes get whole
        self.retires = draw() < 0.15
        self.one_by_one = draw() * 0.5
        self._rates = (self.crash, self.crash + self.cut, self.crash + self.cut + self.owners)
        self._all = self._rates[2] + self.people
        self.asked = 0

    def next(self, world: World) -> Step | None:
        """What happens next; None: nothing comes to mind."""
        if self._hosts is not None and (step := self._hosts.next(world)) is not None:
            return step
        if self.rough is not None and (trouble := self.rough.next(world)) is not None:
            return trouble
        draw = self.rng.random()
        if draw < self._all:
            if draw < self._rates[0]:
                return self._crash()
            if draw < self._rates[1]:
                return self._cut(world)
            if draw < self._rates[2]:
                return self._owner(world)
            return self._person(world)
        keys = world.todo.keys
        if not keys:
            return self._person(world)
        key = keys[int(self.rng.random() * len(keys))]
        return self._go_on(world, key)

    def _go_on(self, world: World, key: Key) -> Step | None:
        if self.rough is not None and self.rough.delays(key):
            return None
        kind = key[0]
        draw = self.rng.random
        if kind == "wake":
            count = 1 if draw() < self.one_by_one else 1_000_000
            if draw() < self.faulty_disk:
                fault = self.rng.choice(("error", "error", "before", "after", "during"))
                return (*key, count, fault, int(draw() * 3))
            return (*key, count)
        if kind == "call":
            return self._callback(key)
        if kind in ("tire", "late") and draw() >= self.tired:
            return None
        if self.rough is not None and kind == "line":
            return (*key, self.rough.fault(), self.rough.at_once(), self.rough.overtaking())
        if self.rough is not None and (kind == "tire" or (kind == "late" and self.rough.brief)):
            return (*key, self.rough.fault())
        if kind == "timer":
            return key if draw() < 0.3 else None
        return key

    def _callback(self, key: Key) -> Step:
        draw = self.rng.random
        kind = key[2]
        if self.rough is not None and (how := self.rough.dealt_with(kind)) is not None:
            return (*key, *how)
        if kind in ("load", "reload") and draw() < self.subs:
            level = self.names.index(key[1]) - 1
            if draw() < self.rings:
                provider = self.rng.choice(self.providers)
            elif level < 1:
                return (*key, "ok")
            else:
                provider = self.names[1 + int(draw() * level)]
            server = self.rng.choice(self.layout[provider]).name if self.layout[provider] else "none"
            step = (*key, "sub", provider, server, self.rng.choice(REQUESTS))
            return step if self.rough is None else self.rough.with_priority(step)
        if kind != "hear" and draw() < self.fails:
            return (*key, "raise")
        if kind == "recover" and draw() < 0.3:
            return (*key, "change")
        if kind in ("load", "unload") and self.rough is not None and (fault := self.rough.telling()) is not None:
            return (*key, "tell", fault)
        return (*key, "ok")

    def _crash(self) -> Step:
        name = self.rng.choice(self.names)
        draw = self.rng.random()
        if self.retires and draw < 0.2:
            return ("retire", name)
        return ("crash", name, "stopped" if draw > 0.85 else "down")

    def _cut(self, world: World) -> Step | None:
        registrar = world.registrars[self.rng.choice(self.names)]
        if not registrar.clients:
            return None
        provider = self.rng.choice(list(registrar.clients))
        return ("cut", registrar.name, provider, int(self.rng.random() * 3), int(self.rng.random() * 3))

    def _owner(self, world: World) -> Step | None:
        name = self.rng.choice(self.providers)
        registrar = world.registrars[name]
        draw = self.rng.random()
        if draw < 0.05:
            return ("own", name, "unregister", self.rng.choice(self.layout[name]).name)
        if not registrar.catalog.resources:
            return None
        target = self.rng.choice(list(registrar.catalog.resources))
        if draw < 0.65:
            return ("own", name, "status", target, self.rng.choice(STATES))
        return ("own", name, "response" if draw < 0.8 else "force", target)

    def _person(self, world: World) -> Step | None:
        name = self.rng.choice(self.names)
        registrar = world.registrars[name]
        if self.rng.random() < 0.45:
            held = registrar.holds()
            return ("unload", name, self.rng.choice(held)) if held else None
        provider = self.rng.choice(self.providers)
        servers = self.layout[provider]
        server = self.rng.choice(servers).name if self.rng.random() < 0.98 else "none"
        self.asked += 1
        direct = self.direct > 0 and self.rng.random() < self.direct
        step: Step = ("load", f"q{self.asked}", name, provider, server, self.rng.choice(REQUESTS), direct)
        step = step if self.rough is None else self.rough.with_priority(step)
        if self._waits is not None and self._waits.random() < 0.2:
            step = (*(*step, 0)[:8], self._waits.choice((0, 1000)))
        return step
