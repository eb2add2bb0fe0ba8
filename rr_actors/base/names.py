"""Names: registrars, servers, server ids and child ids.

A name is ASCII letters, digits, "_", "-" and ".", 1 to 64 characters, not starting with a dot (it is a directory's
name too).
A server id is "registrar/server"; a child's path in the tree is "root/inner/child".
"""

from __future__ import annotations

import functools
import itertools
import os
import re
import threading
import time
from typing import NamedTuple, cast

from rr_actors.base.errors import InvalidName, exact_text, is_a, shown

CLIENTS = "client."
"""What the names of the registrars of clients begin with, and no others (rr.connect())."""

_NAME = re.compile(r"[A-Za-z0-9_\-][A-Za-z0-9_\-.]{0,63}\Z")


class ServerId(NamedTuple):
    """A server's address: the registrar it belongs to and its name there."""

    registrar: str
    server: str

    def __str__(self) -> str:
        return f"{self.registrar}/{self.server}"


def check_name(name: object, what: str = "name") -> str:
    """Return `name` if it may name a registrar, server or child.

    Raises:
        InvalidName: saying what was wrong with it.
    """
    if not is_a(name, str):
        raise InvalidName(f"{what}: expected a string, got {type(name).__name__} ({shown(name)})", name=name)
    name = exact_text(cast("str", name))
    if not _NAME.match(name):
        raise InvalidName(
            f"{what} {shown(name)}: expected 1 to 64 ASCII letters, digits, '_', '-' or '.', not starting with '.'",
            name=name,
        )
    return name


def parse_server_id(text: object) -> ServerId:
    """Split "registrar/server" into its two names.

    Raises:
        InvalidName: when it is not two valid names with one "/" between them.
    """
    if not is_a(text, str):
        raise InvalidName(
            f"server id: expected a string 'registrar/server', got {type(text).__name__} ({shown(text)})", name=text
        )
    text = exact_text(cast("str", text))
    registrar, slash, server = text.partition("/")
    if not slash:
        raise InvalidName(f"server id {shown(text)}: expected 'registrar/server', got no '/'", name=text)
    return ServerId(check_name(registrar, "registrar name"), check_name(server, "server name"))


_parsed = functools.lru_cache(1024)(parse_server_id)


def parse_server(server: object) -> ServerId:
    """As parse_server_id(), which it asks once for each text.

    Raises:
        InvalidName: it is not of that form.
    """
    return _parsed(server) if type(server) is str else parse_server_id(server)


_DIGITS = "0123456789abcdef"
_MS_NS = 1_000_000


class IdMaker:
    """Makes query ids: UUIDv7 (RFC 9562) as 32 hex digits, unique over processes, increasing in one thread.

    The order is a convenience for people who read a catalog; nothing relies upon it.
    """

    def __init__(self) -> None:
        self._now = (0, "", iter(("",)))  # the end of a millisecond, the head of its ids, and their 4096 numbers
        self.renew()

    def renew(self) -> None:
        """Take new random bits: a forked child must not repeat its parent's ids."""
        self._lock = threading.Lock()
        self._tail = f"{0x8000_0000_0000_0000 | int.from_bytes(os.urandom(8), 'big') >> 2:016x}"

    def new(self) -> str:
        """Return the next one. From any thread."""
        while True:
            now = self._now
            end_ns, head, numbers = now
            if time.time_ns() < end_ns and (number := next(numbers, "")):
                return f"{head}{number}{self._tail}"
            # If all 4096 are taken, or the clock was set back, it goes on in the next.
            ms = max(time.time_ns() // _MS_NS, end_ns // _MS_NS)
            following = ((ms + 1) * _MS_NS, f"{ms:012x}7", map("".join, itertools.product(_DIGITS, repeat=3)))
            with self._lock:  # nothing is called with it: a finalizer that wants an id, too, would wait for itself
                if self._now is now:
                    self._now = following


_ids = IdMaker()
new_id = _ids.new
"""The process's own."""

os.register_at_fork(after_in_child=_ids.renew)
