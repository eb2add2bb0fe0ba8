"""Rough: the trouble between processes, drawn from a stream of its own: what else a seed draws is the same without."""

from __future__ import annotations

import random

from rr_actors.registrar.model.rows import STANDBY, Hold
from simulation.network import OLD
from simulation.pending_steps import Key
from simulation.world import Step, World

FIRST = 2**40
"""Worlds of smaller seeds have plain links, which break at times: seeds that failed before there was more go on
meaning what they meant."""
BRIEF_FIRST = 2**41
"""From here on, threads let go directly of what they have just loaded."""
OWE_FIRST = 2**42
"""From here on, also of what is on disk, and they join what is held in their own process."""
AT_ONCE_FIRST = 2**43
"""From here on, providers let direct lines join at once what is held."""
TELL_FIRST = 2**44
"""From here on, threads decide themselves what follows when their callbacks have returned, and providers decide at once
what direct lines ask for."""
HASTY_FIRST = 2**45
"""From here on, some registrars decide everything as it comes in."""
SAY_FIRST = 2**46
"""From here on, status callbacks say something of their own resources, and who listens to a part deals with what it
says."""
SWAP_FIRST = 2**47
"""From here on, status callbacks replace parts of what they are about."""
PARTS_FIRST = 2**48
"""From here on, callbacks load by connections of their threads."""
LIVES_FIRST = 2**49
"""From here on, registrars are closed, deleted and absent, and come back."""
RANK_FIRST = 2**50
"""From here on, loads have priorities, which change."""
REVOKE_FIRST = 2**51
"""From here on, owners revoke resources."""
IDLE_FIRST = 2**52
"""From here on, servers pause what idles."""
RELOAD_FIRST = 2**53
"""From here on, owners reload resources."""
EXCLUSIVE_FIRST = 2**54
"""From here on, some servers are exclusive, and some loads wait in line only for a while."""
HOSTS_FIRST = 2**55
"""From here on, the registrars are on two or three hosts; fresh seeds are from 2**54 to 2**56."""
PRIORITIES = (STANDBY, -3, 0, 0, 4, 9)
STATES = ("OK", "UPDATE", "WARNING", "ERROR", "FATAL")


class Rough:
    """Draws partitions, messages that come twice, direct lines that break, links that break when they are new, and what
    is slow; and more rings. Each world has a mix of its own, and some have none of it."""

    def __init__(self, seed: int, names: list[str]) -> None:
        self.rng = random.Random(f"rough {seed}")
        self.names = names
        draw = self.rng.random
        self.part = draw() ** 2 * 0.02 if draw() < 0.4 else 0.0
        self.heal = 0.01 + draw() * 0.1
        self.dup = draw() ** 2 * 0.6 if draw() < 0.4 else 0.0
        self.snap = draw() ** 2 * 0.1 if draw() < 0.3 else 0.0
        self.redial = draw() if draw() < 0.25 else 0.0
        self.faulty_follow = draw() ** 2 * 0.5 if draw() < 0.2 else 0.0
        self.slow = {self._what_is_slow() for _ in range(self.rng.choice((0, 0, 1, 2)))}
        starts = random.Random(f"starts {seed}")
        if starts.random() < 0.2:
            self.slow.add((starts.choice(("serve", "register", "up")),))
        self.full = starts.random() ** 2 * 0.02 if starts.random() < 0.2 else 0.0
        self.space = 0.02 + starts.random() * 0.1
        self._full: str | None = None  # whose disk is
        self.slowness = 1.0 - draw() ** 2 * 0.3
        self.rings = draw() if draw() < 0.3 else 0.0
        self.brief = 0.0
        if seed >= BRIEF_FIRST:
            self._thread = random.Random(f"brief {seed}")
            self.brief = self._thread.random() if self._thread.random() < 0.7 else 0.0
            if self._thread.random() < 0.3:
                self.slow.add(("wake", self._thread.choice(names)))
            if self.brief and self._thread.random() < 0.3:
                self.slow.add(("line",))
        self.owe = self.join = 0.0
        if seed >= OWE_FIRST:
            self._owing = random.Random(f"owe {seed}")
            self.owe = self._owing.random() * 0.3 if self._owing.random() < 0.7 else 0.0
            self.join = self._owing.random() * 0.1 if self._owing.random() < 0.5 else 0.0
            self._joined = 0
            self.faulty_owe = self._owing.random() ** 2 * 0.5 if self._owing.random() < 0.3 else 0.0
        self._at_once: random.Random | None = None
        if seed >= AT_ONCE_FIRST:
            at_once = random.Random(f"at once {seed}")
            self._at_once = at_once if at_once.random() < 0.8 else None
            self.faulty_at_once = at_once.random() ** 2 * 0.5 if at_once.random() < 0.3 else 0.0
        self._telling: random.Random | None = None
        self.haste = 0.0
        if seed >= TELL_FIRST:
            self._telling = random.Random(f"tell {seed}")
            self.tell = self._telling.random() if self._telling.random() < 0.8 else 0.0
            self.overtake = self._telling.random() < 0.8
            self.haste = self._telling.random() * 0.5 if self._telling.random() < 0.7 else 0.0
            self.faulty_tell = self._telling.random() ** 2 * 0.5 if self._telling.random() < 0.3 else 0.0
        self.listen = 0.0
        self._saying: random.Random | None = None
        if seed >= SAY_FIRST:
            self._saying = random.Random(f"say {seed}")
            self.say = self._saying.random() * 0.4 if self._saying.random() < 0.5 else 0.0
            self.listen = self._saying.random() * 0.05 if self._saying.random() < 0.5 else 0.0
            self.dealing = self._saying.random()
            self.owners = self._saying.random() ** 2 * 0.1 if self._saying.random() < 0.5 else 0.0
        self.swap = self.subs = 0.0
        if seed >= SWAP_FIRST:
            self._swapping = random.Random(f"swap {seed}")
            self.swap = self._swapping.random() * 0.3 if self._swapping.random() < 0.5 else 0.0
            self.subs = 0.7 if self.swap else 0.0  # a part and a spare, often enough
        self._parts: random.Random | None = None
        if seed >= PARTS_FIRST:
            parts = random.Random(f"parts {seed}")
            self._parts = parts if parts.random() < 0.8 else None
            self.parts = parts.random() * 0.3
            self.part_rings = parts.random() < 0.5
        self._lives: random.Random | None = None
        if seed >= LIVES_FIRST:
            lives = random.Random(f"lives {seed}")
            self._lives = lives if lives.random() < 0.8 else None
            self.close = lives.random() ** 2 * 0.02
            self.delete = lives.random() * 0.3
            self.generations = lives.random() ** 2 * 0.01
            self.late = lives.random() ** 2 * 0.2 if lives.random() < 0.4 else 0.0
        self._ranking: random.Random | None = None
        if seed >= RANK_FIRST:
            ranking = random.Random(f"rank {seed}")
            self._ranking = ranking if ranking.random() < 0.9 else None
            self.rank = ranking.random() * 0.15
            self.ranked = ranking.random()
            if ranking.random() < 0.5:
                self.subs = max(self.subs, 0.6)
        self._revoking: random.Random | None = None
        if seed >= REVOKE_FIRST:
            revoking = random.Random(f"revoke {seed}")
            self._revoking = revoking if revoking.random() < 0.9 else None
            self.revoke = revoking.random() ** 2 * 0.1
            self.hastens = revoking.random() ** 3  # the end of the grace
            if revoking.random() < 0.5:
                self.subs = max(self.subs, 0.7)
        self._reloading: random.Random | None = None
        if seed >= RELOAD_FIRST:
            reloading = random.Random(f"reload {seed}")
            self._reloading = reloading if reloading.random() < 0.8 else None
            self.reload = reloading.random() ** 2 * 0.1
        self._any = self.part or self.dup or self.snap or self.full
        self._dialled: Key | None = None

    def _what_is_slow(self) -> tuple[object, ...]:
        kind = self.rng.choice(("net", "net", "old", "old", "line", "wake", "call", "save", "dial"))
        if kind == "net":
            return (kind, self.rng.choice(self.names), self.rng.choice((0, 1)))
        if kind == "wake":
            return (kind, self.rng.choice(self.names))
        if kind == "call":
            return (kind, self.rng.choice(("load", "unload", "hear", "status", "recover", "reload")))
        return (kind,)

    def next(self, world: World) -> Step | None:
        """Trouble, before anything else happens; None: none now."""
        if self._dialled is not None:
            dialled, self._dialled = self._dialled, None
            if self.rng.random() < self.redial:
                return ("cut", dialled[1], dialled[2], 1 + int(self.rng.random() * 4), 0)
        if self._telling is not None and (step := self._hurry(world, self._telling)) is not None:
            return step
        if self._parts is not None and (step := self._part(world, self._parts)) is not None:
            return step
        if self._lives is not None and (step := self._live(world, self._lives)) is not None:
            return step
        if self._ranking is not None and (step := self._rank(world, self._ranking)) is not None:
            return step
        if self._revoking is not None and (step := self._revoke(world, self._revoking)) is not None:
            return step
        if self._reloading is not None and (step := self._reload(world, self._reloading)) is not None:
            return step
        if self.brief and (step := self._let_go(world)) is not None:
            return step
        if (self.owe or self.join) and (step := self._owe(world)) is not None:
            return step
        if self._saying is not None and (step := self._say(world, self._saying)) is not None:
            return step
        if self.swap and (step := self._swap(world)) is not None:
            return step
        if world.apart:
            if self.rng.random() < self.heal:
                return ("heal",)
        elif not self._any:
            return None
        elif self.rng.random() < self.part:
            apart = self.rng.sample(self.names, self.rng.randint(1, len(self.names) - 1))
            return ("part", tuple(apart), self.rng.choice(("cut", "hold")), int(self.rng.random() * 3))
        if self.full and (step := self._disk()) is not None:
            return step
        draw = self.rng.random()
        if draw < self.dup:
            return self._dup(world)
        if draw < self.dup + self.snap:
            return self._snap(world)
        return None

    def _say(self, world: World, rng: random.Random) -> Step | None:
        """Somebody listens to a part, or an owner says how a resource is, also while it is loading."""
        draw = rng.random()
        if draw < self.listen:
            parts = [(r.name, id) for r in world.registrars.values() for ids in r.catalog.parts.values() for id in ids]
            return ("listen", *rng.choice(parts)) if parts else None
        if draw < self.listen + self.owners:
            servings = [(r.name, id) for r in world.live() for id in r.catalog.resources]
            if servings:
                name, id = rng.choice(servings)
                return ("own", name, "status", id, rng.choice(STATES))
        return None

    def _swap(self, world: World) -> Step | None:
        """A status callback replaces a part."""
        if self._swapping.random() >= self.swap:
            return None
        wholes = [(r.name, id) for r in world.live() for id, parts in r.catalog.parts.items() if len(parts) > 1]
        if not wholes:
            return None
        name, id = self._swapping.choice(wholes)
        return ("own", name, "swap", id)

    def dealt_with(self, kind: str) -> tuple[str, ...] | None:
        """How a callback that hears a status goes on, in worlds in which that differs; None: as in any other."""
        rng = self._saying
        if rng is None or kind not in ("status", "hear"):
            return None
        if kind == "status" and rng.random() < self.say:
            return ("say", rng.choice(STATES))
        return ("raise",) if rng.random() < self.dealing * 0.5 else ("ok",)

    def _hurry(self, world: World, rng: random.Random) -> Step | None:
        """Threads and their lines go on, and the loops have no time."""
        if rng.random() >= self.haste:
            return None
        keys = [
            key for key in world.todo.keys if key[0] == "line" or (key[0] == "call" and key[2] in ("load", "unload"))
        ]
        if not keys:
            return None
        key = rng.choice(keys)
        if key[0] == "line":
            return (*key, "", self.at_once(), self.overtaking())
        return (*key, "tell", self._fault_of(rng))

    def _let_go(self, world: World) -> Step | None:
        if self._thread.random() >= self.brief:
            return None
        registrars = [r for r in world.registrars.values() if r.state in ("up", "starting")]
        new = [(r.name, id) for r in registrars for id in r.holds() if id in r.unsaved.new]
        return ("owe", *self._thread.choice(new), "") if new else None

    def _owe(self, world: World) -> Step | None:
        draw = self._owing.random()
        if draw >= self.owe:
            return self._join(world) if draw < self.owe + self.join else None
        held = [(r.name, id) for r in world.registrars.values() if r.state in ("up", "starting") for id in r.holds()]
        if not held:
            return None
        return ("owe", *self._owing.choice(held), self._faulty())

    def _faulty(self) -> str:
        return self._owing.choice(("error", "before", "after")) if self._owing.random() < self.faulty_owe else ""

    def _join(self, world: World) -> Step | None:
        servings = [(r.name, row.server, row.request) for r in world.live() for row in r.catalog.resources.values()]
        if not servings:
            return None
        self._joined += 1
        return ("join", f"j{self._joined}", *self._owing.choice(servings), self._faulty())

    def _disk(self) -> Step | None:
        draw = self.rng.random()
        if self._full is None and draw < self.full:
            self._full = self.rng.choice(self.names)
            return ("full", self._full)
        if self._full is not None and draw < self.space:
            name, self._full = self._full, None
            return ("space", name)
        return None

    def _snap(self, world: World) -> Step | None:
        lines = [query_id for query_id, line in world.lines.items() if not (line.broken or line.left)]
        return ("snap", self.rng.choice(lines)) if lines else None

    def _dup(self, world: World) -> Step | None:
        keys = world.todo.keys
        key = keys[int(self.rng.random() * len(keys))] if keys else None
        if key is None or key[0] != "net" or key[3] == OLD:
            return None
        consumer, provider, way = key[1], key[2], int(key[3])
        peering = world.registrars[consumer].clients.get(provider)
        if peering is None or not peering.link.ways[way]:
            return None
        place = int(self.rng.random() * len(peering.link.ways[way]))
        return ("dup", consumer, provider, way, place, int(self.rng.random() * 4))

    def delays(self, key: Key) -> bool:
        """Whether what was drawn to happen next does not happen yet."""
        if key[0] == "dial":
            self._dialled = key
        if self._revoking is not None and key[0] == "timer" and str(key[2]).startswith("revoke:"):
            return self._revoking.random() >= self.hastens
        if not self.slow:
            return False
        kind = key[0]
        if kind == "net":
            slow = ("old",) in self.slow if key[3] == OLD else ("net", key[2], key[3]) in self.slow
        elif kind == "wake":
            slow = (kind, key[1]) in self.slow
        elif kind == "call":
            slow = (kind, key[2]) in self.slow
        else:
            slow = (kind,) in self.slow
        return slow and self.rng.random() < self.slowness

    def _live(self, world: World, rng: random.Random) -> Step | None:
        """A registrar is closed, stopped and deleted, or absent from the next run of the system; or it comes back."""
        draw = rng.random()
        if draw < self.generations:
            return ("generation", tuple(name for name in self.names if rng.random() < 0.4))
        name = rng.choice(self.names)
        state = world.registrars[name].state
        if state == "stopped" and draw < self.delete:
            return ("delete", name)
        if world.registrars[name].closing is not None and draw < self.late:
            return ("closing", name, True)
        if draw < self.close:
            return ("close", name)
        if state == "up" and draw < self.close * 1.5:
            return ("crash", name, "stopped")
        if state in ("away", "absent") and draw < 0.05:
            return ("up", name)
        return None

    def _revoke(self, world: World, rng: random.Random) -> Step | None:
        """An owner revokes a resource."""
        if rng.random() >= self.revoke:
            return None
        servings = [(r.name, id) for r in world.live() for id in r.catalog.resources]
        if not servings:
            return None
        name, id = rng.choice(servings)
        return ("own", name, "revoke", id)

    def _reload(self, world: World, rng: random.Random) -> Step | None:
        """An owner reloads a resource."""
        if rng.random() >= self.reload:
            return None
        servings = [(r.name, id) for r in world.live() for id in r.catalog.resources]
        if not servings:
            return None
        name, id = rng.choice(servings)
        return ("own", name, "reload", id)

    @property
    def reloads(self) -> bool:
        """Whether owners reload resources in this world."""
        return self._reloading is not None

    def _rank(self, world: World, rng: random.Random) -> Step | None:
        """Somebody gives a query another priority: one of people outside, or now and then a part."""
        if rng.random() >= self.rank:
            return None
        parts = rng.random() < 0.2
        rows = [(r.name, row) for r in world.live() for row in r.catalog.held.values()]
        held = [(name, row.id) for name, row in rows if row.hold is Hold.HELD and bool(row.parent) is parts]
        return ("rank", *rng.choice(held), rng.choice(PRIORITIES)) if held else None

    def with_priority(self, step: Step) -> Step:
        """Return a load with a priority: often that of somebody outside, now and then that of a callback."""
        rng = self._ranking
        if rng is None or rng.random() >= self.ranked * (0.2 if step[0] == "call" else 0.6):
            return step
        return (*step, rng.choice(PRIORITIES))

    def _part(self, world: World, rng: random.Random) -> Step | None:
        """A callback's thread loads something by a connection of its own."""
        if rng.random() >= self.parts:
            return None
        keys = [key for key in world.todo.keys if key[0] == "call" and key[2] in ("load", "reload")]
        if not keys:
            return None
        key = rng.choice(keys)
        servers = [server for servers in world.layout.values() for server in servers]
        rings = self.part_rings and not self.reloads and not any(server.recovery == "reload" for server in servers)
        names = self.names if rings else self.names[: self.names.index(str(key[1]))]
        places = [(name, server.name) for name in names for server in world.layout[name]]
        if not places:
            return None
        return self.with_priority((*key, "sub", *rng.choice(places), rng.choice((b"p", b"q")), "directly"))

    def fault(self) -> str:
        """Of the disk, when a thread leaves its direct line."""
        return "error" if self.rng.random() < self.faulty_follow else ""

    def at_once(self) -> str | None:
        """How the disk behaves if a provider lets a direct line join at once; None: it does not."""
        if self._at_once is None:
            return None
        faulty = self._at_once.random() < self.faulty_at_once
        return self._at_once.choice(("error", "before", "after")) if faulty else ""

    def overtaking(self) -> str | None:
        """How the disk behaves if a provider decides at once what a direct line asks for; None: it does not."""
        if self._telling is None or not self.overtake:
            return None
        return self._fault_of(self._telling)

    def telling(self) -> str | None:
        """How the disk behaves if a thread tells itself that its callback has returned; None: it does not."""
        if self._telling is None or self._telling.random() >= self.tell:
            return None
        return self._fault_of(self._telling)

    def _fault_of(self, rng: random.Random) -> str:
        return rng.choice(("error", "before", "after")) if rng.random() < self.faulty_tell else ""
