"""Names: registrars, servers, server ids, child ids and hosts.

A name has 1 to 64 ASCII letters, digits, "_", "-" and ".", and does not start with a dot: it is a directory's name too.
A server id is "registrar/server", or "host/registrar/server" for one of another host. A child's path in the tree is
"root/inner/child".
"""

from __future__ import annotations

import functools
import itertools
import os
import re
import time
from collections.abc import Collection, Iterable
from typing import NamedTuple

from rr_actors.base.errors import InvalidName, NotFound, did_you_mean, exact_text, few, is_a, shown

CONNECTED = "connection."
"""The prefix of the registrars of connected programs (rr.connect()); no other registrar has it."""

REGISTRAR = "registrar"
"""The last id in the path of a manager's registrar, "root/cameras/registrar"."""

PROVIDERS = "clients"
"""The id in the paths of a registrar's clients, one for each provider, "root/cameras/registrar/clients/maps"."""

SERVERS = "servers"
"""The id in the paths of a registrar's servers, "root/cameras/registrar/servers/camera"."""


def is_part(path: str) -> bool:
    """Return whether the path of an actor is one of a part: a manager's registrar, or the application's, or below."""
    ids = path.split("/")
    return REGISTRAR in ids[1:] or len(ids) == 1 or ids[1] in (PROVIDERS, SERVERS)


NAME_RULE = "1 to 64 ASCII letters, digits, '_', '-' or '.', not starting with '.'"
_NAME = re.compile(r"[A-Za-z0-9_\-][A-Za-z0-9_\-.]{0,63}\Z")


def is_of_another_host(registrar: str) -> bool:
    """Return whether this is the name of a registrar of another host, "hostb/cameras"."""
    return "/" in registrar


class ServerId(NamedTuple):
    """A server's address: the registrar it belongs to ("cameras", or "hostb/cameras") and its name there."""

    registrar: str
    server: str

    def __str__(self) -> str:
        return f"{self.registrar}/{self.server}"


def check_name(name: object, what: str = "name") -> str:
    """Return `name` if it may name a registrar, server or child; raise InvalidName, with the rule, if not."""
    if not is_a(name, str):
        raise InvalidName(f"{what}: expected a string, got {type(name).__name__} ({shown(name)})", name=name)
    name = exact_text(name)
    if not _NAME.match(name):
        raise InvalidName(f"{what} {shown(name)}: expected {NAME_RULE}", name=name)
    return name


def parse_server_id(text: object) -> ServerId:
    """Split "registrar/server", or "host/registrar/server", before the server's name.

    Raises:
        InvalidName: the text is anything else.
    """
    if not is_a(text, str):
        raise InvalidName(
            f"server id: expected a string 'registrar/server', got {type(text).__name__} ({shown(text)})", name=text
        )
    text = exact_text(text)
    registrar, slash, server = text.rpartition("/")
    if not slash:
        raise InvalidName(f"server id {shown(text)}: expected 'registrar/server', got no '/'", name=text)
    check_registrar_name(registrar)
    return ServerId(registrar, check_name(server, "server name"))


def check_registrar_name(name: str) -> None:
    """Raise InvalidName if this is neither "registrar" nor "host/registrar"."""
    host, slash, registrar = name.rpartition("/")
    if slash:
        check_name(host, "host name")
    check_name(registrar, "registrar name")


parsed_server = functools.lru_cache(1024)(parse_server_id)
"""Split a server id, a str, as parse_server_id() does, with a cache for the latest 1024 texts."""


def parse_server(server: object) -> ServerId:
    """Split a server id as parse_server_id() does, with the cache if it is a str."""
    return parsed_server(server) if type(server) is str else parse_server_id(server)


def child_meant(name: str, paths: Collection[str]) -> str | None:
    """Return the one of these paths that a path or an id names; None if there is no such child among them.

    Raises:
        NotFound: several children have this id.
    """
    if name in paths:
        return name
    found = [path for path in paths if path.rpartition("/")[2] == name]
    if len(found) > 1:
        raise NotFound(f"{shown(name)}: several children have this id: {few(sorted(found))}", id=name)
    return found[0] if found else None


def no_child(name: str, paths: Collection[str]) -> NotFound:
    """Return the error for a path or an id that names no child of these paths, with the nearest name among them."""
    known = sorted({path if "/" in name else path.rpartition("/")[2] for path in paths})
    hint = did_you_mean(name, known) or f"; there are: {few(known) or 'none'}"
    return NotFound(f"{shown(name)}: there is no child of this path or id{hint}", id=name)


_MS_NS = 1_000_000
_ID = re.compile(r"[0-9a-f]{12}[78][0-9a-f]{19}\Z")
_EARLIEST_S = 1_600_000_000.0  # no id was made before; other ids may give any time
_latest_ns = 0
_numbers: itertools.count[int]  # next() is atomic: no lock, for which a finalizer or a signal handler would wait


def new_id() -> str:
    """Make an id: a UUIDv7 (RFC 9562) as 32 hex digits, unique over processes, increasing in one thread.

    After a crash a resource's server gets its statuses again in the order of their ids. Nothing else but output for
    people depends on the order.
    """
    global _latest_ns
    now_ns = time.time_ns()
    if now_ns < _latest_ns:  # the clock was set back
        now_ns = _latest_ns
    _latest_ns = now_ns
    return f"{(now_ns // _MS_NS << 80) + next(_numbers):032x}"


def planned_id() -> str:
    """Make an id for the query of a load that a planner makes for itself, in distinction to those made by hand.

    It is a UUIDv8 with the fields of new_id(), so that it is known in any process, also after a crash.
    """
    id = new_id()
    return f"{id[:12]}8{id[13:]}"


def is_planned(id: str) -> bool:
    """Return whether planned_id() has made the id of a query."""
    return id[12:13] == "8"


def made_at(id: str) -> float:
    """Return when an id was made here, in seconds since 1970. A resource's id begins with such a one."""
    return int(id[:12], 16) / 1000


def time_in(id: str) -> float | None:
    """Return when an id was made, in seconds since 1970; None for an id that is no UUIDv7 or planned_id()."""
    if _ID.match(id) is None:
        return None
    at = made_at(id)
    return at if at > _EARLIEST_S else None


def _renew() -> None:
    """Take new random bits: a forked child must not repeat its parent's ids."""
    global _numbers
    bits = int.from_bytes(os.urandom(10), "big")
    # The version, 12 random bits, the variant, and 61 of 62 random bits: no number grows out of its 62.
    _numbers = itertools.count(0x7 << 76 | (bits >> 68) << 64 | 0b10 << 62 | bits & (1 << 61) - 1)


_renew()
os.register_at_fork(after_in_child=_renew)


# -- as people read them ----------------------------------------------------------------------------------------------

NAME_WIDTH, NAME_LIMIT = 60, 500
"""The most characters of a resource's name in a sentence or a line, and of one that is stored, for people."""
_SPARED = 15
"""A name that is longer by so few characters is not shortened: it would lose more than it saves."""
_SHORT_ID = 8


def named(server: str, request: str, width: int = NAME_WIDTH) -> str:
    """Return a resource's name, its server and its request, shortened in the middle: cameras/camera "/dev/video7"."""
    whole = f"{server} {request}".rstrip()
    return whole if len(whole) <= width + _SPARED else in_short(whole, width)


def in_short(text: str, width: int) -> str:
    """Return a text of at most `width` characters: its beginning and its end."""
    if len(text) <= width:
        return text
    ahead = width // 2
    return f"{text[:ahead]}…{text[len(text) - (width - 1 - ahead) :]}"


def short_id(id: str) -> str:
    """Return the end of an id, which every command takes. Ids begin with their time, so their ends tell them apart."""
    return id[-_SHORT_ID:]


def short_ids(ids: Iterable[str]) -> dict[str, str]:
    """Return the short form of each of these ids, as long as it has to be to be unique among them."""
    known = dict.fromkeys(ids)
    length = _SHORT_ID
    while len({id[-length:] for id in known}) < len(known):
        length += 1
    return {id: id[-length:] for id in known}
