"""What may cross between hosts, and how it changes on its way.

A consumer "app" of the host "hosta" is "hosta/app" at its provider. What the provider calls "cameras/camera" is
"hostb/cameras/camera" for the consumer. Types are pickles, so they never cross: a consumer reads plain data.
"""

from __future__ import annotations

import re
import zlib
from typing import Any, cast

import msgspec
from msgspec.structs import replace

from rr_actors.base import pickling
from rr_actors.base.errors import InvalidName, Unavailable
from rr_actors.base.names import check_name
from rr_actors.base.values.failure import Failure
from rr_actors.registrar.links.provider_link import LEASE_BITS
from rr_actors.registrar.model.messages import (
    Describe,
    Described,
    Fetch,
    Fetched,
    Gone,
    Load,
    Loaded,
    LoadRefused,
    Message,
    Noticed,
    NoticesHandled,
    Probe,
    Progressed,
    Reprioritise,
    Reprioritised,
    Unload,
    Unloaded,
    UnloadRefused,
    WaitedFor,
)
from rr_actors.system.hosts.host_settings import LEASE_LEAST_S, LEASE_MOST_S
from rr_actors.wire.name_service import Presence


class Exported(msgspec.Struct, frozen=True, array_like=True):
    """A registrar that another host may load from: its status, its incarnation while it is up, and why it is not.

    `releases`: it releases what a host holds whose lease is over.
    """

    name: str
    status: str
    epoch: int
    why: str
    releases: bool = False


class Exports(msgspec.Struct, frozen=True, array_like=True, tag=1):
    """All registrars that the receiver may load from, and its lease. Sent at first, and after each change."""

    exported: list[Exported]
    lease_s: float


class Beat(msgspec.Struct, frozen=True, array_like=True, tag=2):
    """A heartbeat: the sender lives, and has what it holds."""

    number: int


class Beaten(msgspec.Struct, frozen=True, array_like=True, tag=3):
    """The heartbeat with this number was heard."""

    number: int


GatewayMessage = Exports | Beat | Beaten
"""What two gateways say to each other."""


_EXPORTS_LIMIT = 1000


def check_exports(message: Exports) -> None:
    """Raise Unavailable, which breaks the link, if this is nothing that a host may say of its registrars."""
    if not LEASE_LEAST_S <= message.lease_s <= LEASE_MOST_S:
        text = f"its lease is {message.lease_s:g} s: expected {LEASE_LEAST_S:g} to {LEASE_MOST_S:g}"
        raise Unavailable(text)
    if len(message.exported) > _EXPORTS_LIMIT:
        raise Unavailable(f"it exports {len(message.exported)} registrars: expected {_EXPORTS_LIMIT} at most")
    for one in message.exported:
        try:
            check_name(one.name)
            Presence(one.status)
            if not 0 <= one.epoch < 1 << LEASE_BITS:
                raise ValueError(f"its incarnation is {one.epoch}")
        except (InvalidName, ValueError) as error:
            raise Unavailable(f"it exports a registrar that none can be: {error}") from error


TO_PROVIDER = frozenset({Load, Unload, Fetch, NoticesHandled, Probe, Gone, Reprioritise})
"""What may cross from a consumer to its provider."""
TO_CONSUMER = frozenset(
    {Loaded, LoadRefused, Unloaded, UnloadRefused, Fetched, Noticed, Progressed, Reprioritised, WaitedFor}
)
"""What may cross from a provider to its consumer."""

_NO_TYPES = pickling.dumps((None, None), "types")
_NO_TYPES_CRC = zlib.crc32(_NO_TYPES)


def check_crosses(message: Any, kinds: frozenset[type[Any]], peer: str) -> None:
    """Raise Unavailable, which breaks the link, if a message may not cross between hosts in this direction."""
    kind: type[object] = message.__class__
    if kind in (Describe, Described):
        raise Unavailable(f"{kind.__name__} of {peer}: types are pickles, and no pickle crosses between hosts")
    if kind not in kinds:
        raise Unavailable(f"{kind.__name__} of {peer}: it does not cross between hosts in this direction")


def no_types(asked: Describe) -> Described:
    """Return the answer for a consumer here that asks for the types of another host's server: there are none."""
    return Described(asked.server, _NO_TYPES)


class Crossing:
    """The changes of the messages between a consumer of this host and a provider of another."""

    def __init__(self, here: str, there: str) -> None:
        self._here, self._there = here, there

    def to_provider(self, message: Message) -> Message:
        """Return a message of the consumer as the provider gets it."""
        match message:
            case Load() | Unload() | Fetch() | Gone() | Reprioritise():
                return replace(message, origin=f"{self._here}/{message.origin}")
            case Probe():
                return replace(message, ring=[_absolute(name, self._here) for name in message.ring])
            case _:
                return message

    def to_consumer(self, message: Message) -> Message:
        """Return a message of the provider as the consumer gets it."""
        match message:
            case Loaded():
                return replace(message, types=_NO_TYPES_CRC)
            case LoadRefused() | UnloadRefused():
                return replace(message, failure=self._failure(message.failure))
            case Noticed(notice=notice):
                origin = notice.origin.removeprefix(f"{self._here}/")
                return replace(message, notice=replace(notice, origin=origin, source=self._relative(notice.source)))
            case WaitedFor():
                return replace(message, ring=[self._relative(name) for name in message.ring])
            case _:
                return message

    def _failure(self, failure: Failure) -> Failure:
        """Change the names of servers in the attributes of an error, in its frames, and in what both say of them."""
        details, ring = dict(failure.details), failure.details.get("ring")
        names = [details.get("server"), *(cast("list[object]", ring) if isinstance(ring, (list, tuple)) else [])]
        changed = {name: self._relative(name) for name in names if isinstance(name, str)}
        if isinstance(details.get("server"), str):
            details["server"] = changed[details["server"]]
        if isinstance(ring, (list, tuple)):
            details["ring"] = [changed.get(name, name) for name in cast("list[Any]", ring)]
        trace = [(self._relative(origin), _renamed(text, changed)) for origin, text in failure.trace]
        return replace(failure, message=_renamed(failure.message, changed), trace=trace, details=details)

    def _relative(self, name: str) -> str:
        return _absolute(name, self._there).removeprefix(f"{self._here}/")


def _renamed(text: str, changed: dict[str, str]) -> str:
    """Return a text with other names for servers; parts of longer names stay."""
    if not changed:
        return text
    names = "|".join(map(re.escape, sorted(changed, key=len, reverse=True)))
    return re.sub(rf"(?<![\w./-])(?:{names})(?![\w/-])", lambda found: changed[found[0]], text)


def _absolute(name: str, host: str) -> str:
    """Return "host/registrar/server" for "registrar/server"; other texts stay."""
    return f"{host}/{name}" if name.count("/") == 1 else name
