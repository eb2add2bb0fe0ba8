"""The desired state: what a file says is to be kept, the checks of that, and the replicas that it asks for.

A file has a table for each kind of thing that is kept::

    [[keep]]
    name = "camera"
    server = "cameras/camera"
    request = "/dev/video{instance}"     # {instance}: 0 to replicas - 1
    replicas = 3
    priority = 5
    after = ["power"]                    # loaded when all replicas of these are ready

    [[keep]]
    name = "worker"
    server = "workers/worker"
    request = "{instance}"
    min = 1                              # as many as `scale_on` says; see scaling.py
    max = 8

    [keep.scale_on]
    usage = "cpu"
    target = 0.7

    [[group]]                            # "keeper/group" loads all of its members, in this order
    name = "navigation"

    [[group.member]]
    server = "maps/map"
    request = "hall"
"""

from __future__ import annotations

import graphlib
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, cast

import msgspec

from rr_actors.base.errors import ConfigError, InvalidName, did_you_mean, few, shown
from rr_actors.base.names import parse_server_id
from rr_actors.base.toml import parse_typed, raise_faults, wrong
from rr_actors.base.values.canonical import encode
from rr_actors.managers.keeper import scaling
from rr_actors.managers.keeper.comparing import WantedReplica
from rr_actors.managers.keeper.scaling import Range, ScaleOn
from rr_actors.managers.planning.probes import NoProbe, probe_of
from rr_actors.registrar.model.rows import HIGHEST, LOWEST

INSTANCE = "{instance}"
MOST_REPLICAS = 10_000
NO_COUNTS: Mapping[str, int] = MappingProxyType({})
Request = Any
"""A request of any server: plain data, as TOML has it. None: the server's request with all of its defaults."""


class KeptKind(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One kind of thing that is kept.

    Attributes:
        name: what `keeper/kept` and `after` call it.
        server: "registrar/server".
        request: its texts may contain {instance}, the number of the replica.
        replicas: how many are wanted, from 0.
        min, max, scale_on: how many are wanted at least and at most, and what decides between them. Without `min` it is
            1. Where these are given, `replicas` is not.
        priority: of each replica, from -1000 to 1000.
        standby: whether the replicas are held on standby, without a priority.
        after: names of what must be ready before a replica is loaded. What is loaded already stays.
    """

    name: str
    server: str
    request: Request = None
    replicas: int = 1
    priority: int = 0
    standby: bool = False
    after: tuple[str, ...] = ()
    min: int | None = None
    max: int | None = None
    scale_on: ScaleOn | None = None

    @property
    def range_(self) -> Range | None:
        """Within which the number of replicas changes; None: it is fixed."""
        if self.scale_on is None or self.max is None:
            return None
        return Range(1 if self.min is None else self.min, self.max, self.scale_on)

    @property
    def least(self) -> int:
        """How many replicas there are at least."""
        return self.replicas if self.range_ is None else self.range_.least


class Member(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A resource of a group."""

    server: str
    request: Request = None


class KeptGroup(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Resources that are loaded together, by their name at `keeper/group`."""

    name: str
    member: tuple[Member, ...] = ()


class KeepFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file."""

    keep: tuple[KeptKind, ...] = ()
    group: tuple[KeptGroup, ...] = ()


class Replica(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The request for one replica.

    `members`: what it loads in place of a group: its members, and those of the groups in it. They are part of the
    request, so a replica of a changed group is another one.
    """

    keep: str
    instance: int
    server: str
    request: Request = None
    members: tuple[Member, ...] = ()

    def __rr_title__(self) -> str:
        return f"{self.keep} {self.instance}"


class Desired(msgspec.Struct, frozen=True):
    """What is to be kept, and the groups, by their names."""

    keeps: dict[str, KeptKind] = {}
    groups: dict[str, KeptGroup] = {}

    def replicas(self, group_server: str, counts: Mapping[str, int] = NO_COUNTS) -> list[tuple[WantedReplica, Replica]]:
        """Return all replicas that are wanted.

        Args:
            group_server: the id of the server of groups.
            counts: how many are wanted of what scales, by its name. Without, the least.
        """
        found: list[tuple[WantedReplica, Replica]] = []
        for keep in self.keeps.values():
            priority = None if keep.standby else keep.priority
            for i in range(counts.get(keep.name, keep.least)):
                request = numbered(keep.request, i)
                members = self.members(request, group_server) if keep.server == group_server else ()
                replica = Replica(keep.name, i, keep.server, request, members)
                found.append((WantedReplica(keep.name, i, encode(replica), priority, keep.after), replica))
        return found

    def members(self, group: Request, group_server: str) -> tuple[Member, ...]:
        """Return the members of a group, with those of the groups in it in their place; each of them once."""
        found: dict[bytes, Member] = {}
        for member in self.groups[group].member if isinstance(group, str) and group in self.groups else ():
            inner = self.members(member.request, group_server) if member.server == group_server else (member,)
            found |= {encode(one): one for one in inner if encode(one) not in found}
        return tuple(found.values())


def numbered(request: Request, instance: int) -> Request:
    """Return the request with the number in place of each {instance} in its texts."""
    if isinstance(request, str):
        return request.replace(INSTANCE, str(instance))
    if isinstance(request, list):
        return [numbered(part, instance) for part in cast("list[object]", request)]
    if isinstance(request, dict):
        return {key: numbered(part, instance) for key, part in cast("dict[str, object]", request).items()}
    return request


def parse_desired(data: bytes, file: str, group_server: str = "keeper/group") -> Desired:
    """Return what the bytes of a TOML file called `file` want; `group_server` is the id of the server of groups.

    Raises:
        ConfigError: they are no TOML, or keys are wrong: the text has all of them. `.file`, `.key`, `.expected`, `.got`
            are of the first.
    """
    parsed = parse_typed(data, file, KeepFile)
    checks = _Checks(file, group_server, parsed)
    checks.names("keep", [keep.name for keep in parsed.keep])
    checks.names("group", [group.name for group in parsed.group])
    for i, keep in enumerate(parsed.keep):
        checks.keep(f"keep[{i}]", keep)
    for i, group in enumerate(parsed.group):
        for j, member in enumerate(group.member):
            checks.loads(f"group[{i}].member[{j}]", member.server, [member.request])
    checks.no_ring("keep", "after", {keep.name: keep.after for keep in parsed.keep}, "after")
    checks.no_ring("group", "member", {group.name: checks.inner(group) for group in parsed.group}, "in")
    raise_faults(checks.faults)
    return Desired({keep.name: keep for keep in parsed.keep}, {group.name: group for group in parsed.group})


class _Checks:
    """The checks of one file. `faults` has what is wrong."""

    def __init__(self, file: str, group_server: str, parsed: KeepFile) -> None:
        self.faults: list[ConfigError] = []
        self._file = file
        self._group_server = group_server
        self._keeps = [keep.name for keep in parsed.keep]
        self._groups = [group.name for group in parsed.group]

    def names(self, table: str, names: list[str]) -> None:
        seen = set[str]()
        for i, name in enumerate(names):
            if not name or name in seen:
                said = f"{shown(name)} again" if name else None
                self._wrong(f"{table}[{i}].name", f"a name that no other {table} has", name, said)
            seen.add(name)

    def keep(self, key: str, keep: KeptKind) -> None:
        most = keep.replicas if keep.max is None else keep.max
        replicas = min(max(most, 1), MOST_REPLICAS)
        self.loads(key, keep.server, [numbered(keep.request, i) for i in range(replicas)])
        self._within(f"{key}.replicas", keep.replicas, 0, MOST_REPLICAS)
        self._scale(key, keep)
        self._within(f"{key}.priority", keep.priority, LOWEST, HIGHEST)
        if keep.standby and keep.priority:
            self._wrong(f"{key}.priority", "none, as what is on standby has no priority", keep.priority)
        if most > 1 and numbered(keep.request, 0) == keep.request:
            expected = f"a request with {INSTANCE}, so that the {most} replicas differ"
            self._wrong(f"{key}.request", expected, keep.request)
        for i, name in enumerate(keep.after):
            if name not in self._keeps:
                said = f"{shown(name)}{did_you_mean(name, self._keeps)}"
                self._wrong(f"{key}.after[{i}]", f"one of {few(self._keeps)}", name, said)

    def _scale(self, key: str, keep: KeptKind) -> None:
        """Check what decides how many replicas there are."""
        on = keep.scale_on
        if on is None:
            for field, limit in (("min", keep.min), ("max", keep.max)):
                if limit is not None:
                    self._wrong(f"{key}.{field}", "none without scale_on", limit)
            return
        if keep.max is None:
            self._wrong(f"{key}.max", "how many replicas there are at most, as scale_on decides", None)
        else:
            self._within(f"{key}.max", keep.max, 1, MOST_REPLICAS)
            least = 1 if on.usage else 0  # where there is none, no usage says that one is needed
            self._within(f"{key}.min", 1 if keep.min is None else keep.min, least, max(keep.max, 1))
        if keep.replicas != 1:
            self._wrong(f"{key}.replicas", "none, as scale_on decides", keep.replicas)
        for field, expected in scaling.faults(on):
            self._wrong(f"{key}.scale_on.{field}", expected, getattr(on, field))
        if on.probe is not None:
            try:
                probe_of(on.probe)
            except NoProbe as error:
                self._wrong(f"{key}.scale_on.probe", error.expected, on.probe, error.found)

    def loads(self, key: str, server: str, requests: Sequence[Request]) -> None:
        """Check what a table loads; of a group, that there is one."""
        try:
            parse_server_id(server)
        except InvalidName:
            self._wrong(f"{key}.server", "the id of a server, 'registrar/server'", server)
        unknown = [one for one in requests if not isinstance(one, str) or one not in self._groups]
        if server == self._group_server and unknown:
            name = unknown[0]
            said = f"{shown(name)}{did_you_mean(name, self._groups) if isinstance(name, str) else ''}"
            self._wrong(f"{key}.request", f"the name of a group: {few(self._groups) or 'none'}", name, said)

    def inner(self, group: KeptGroup) -> tuple[str, ...]:
        """Return the names of the groups that are members of one."""
        names = (member.request for member in group.member if member.server == self._group_server)
        return tuple(name for name in names if isinstance(name, str))

    def no_ring(self, table: str, field: str, graph: Mapping[str, tuple[str, ...]], word: str) -> None:
        """Check that nothing is, in the end, after itself, or in itself."""
        try:
            graphlib.TopologicalSorter(graph).prepare()
        except graphlib.CycleError as error:
            ring = f" {word} ".join(map(shown, reversed(error.args[1])))
            key = f"{table}[{list(graph).index(error.args[1][-1])}].{field}"
            self._wrong(key, "names without a ring", error.args[1], f"the ring {ring}")

    def _within(self, key: str, number: int, least: int, most: int) -> None:
        if not least <= number <= most:
            self._wrong(key, f"a whole number from {least} to {most}", number)

    def _wrong(self, key: str, expected: str, got: object, said: str | None = None) -> None:
        self.faults.append(wrong(self._file, key, expected, got, said=said))


def changes(before: Desired, after: Desired) -> list[str]:
    """Return a line for each difference: "+ camera", "- lidar", "~ arm: replicas 3 -> 1"."""
    lines: list[str] = []
    for prefix, old, new in (("", before.keeps, after.keeps), ("group ", before.groups, after.groups)):
        lines += [f"+ {prefix}{name}" for name in new if name not in old]
        lines += [f"- {prefix}{name}" for name in old if name not in new]
        for name, now in new.items():
            if name in old and (said := _changed(old[name], now)):
                lines.append(f"~ {prefix}{name}: {said}")
    return lines


def _changed(old: msgspec.Struct, new: msgspec.Struct) -> str:
    pairs = ((field, getattr(old, field), getattr(new, field)) for field in new.__struct_fields__)
    return ", ".join(f"{field} {_plain(was)} -> {_plain(now)}" for field, was, now in pairs if was != now)


def _plain(value: object) -> str:
    return shown(msgspec.to_builtins(value))
