"""Alternatives: what a file or a program says about each, and the checks of that.

A file has one table for each, the preferred first::

    [[alternative]]
    kind = "range"
    server = "cameras/depth"
    request = { device = "front" }                       # as the server takes it; without one: load("cameras/depth")
    provides = { rate_hz = 30, cost = 8, reliability = 0.9 }

    [[alternative]]
    kind = "range"
    server = "lidars/lidar"
    provides = { rate_hz = 10, cost = 3 }
    break_first = true                                   # it cannot exist beside another one
    timeout_s = 5                                        # how long its load may take
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import msgspec

from rr_actors.base.checks import is_number, wrong_label
from rr_actors.base.errors import ConfigError, InvalidName, NotSerializable
from rr_actors.base.names import parse_server
from rr_actors.base.toml import parse_typed, raise_faults, wrong
from rr_actors.base.values.canonical import encode, json_of, shown_plain
from rr_actors.managers.planning.last_good import last_good_file
from rr_actors.managers.templates import Parameter
from rr_actors.registrar.manager import Beginning

_WHERE = "Choices"

Allowed = Callable[[Any], Iterable[str]]
"""Returns the keys of the alternatives that a request for a choice, as plain values, allows; none if it is wrong."""


class Alternative(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One way to get what a choice asks for: a load of `request` at `server`.

    Attributes:
        kind: what it gives, such as "range"; a choice names it.
        server: "registrar/server".
        request: the request. None: each field has its default, as in `load(server)`.
        provides: numbers, texts and truth values by name, by which choices compare. "reliability", from 0 to 1, is 1 by
            default, and each failure halves it.
        break_first: it cannot exist beside another alternative. So that one is released before this one is loaded, and
            this one is released before another one is loaded. A choice does not return to it, or from it, by itself.
        timeout_s: how many seconds its load may take.
    """

    kind: str
    server: str
    request: Any = None
    provides: dict[str, Parameter] = {}
    break_first: bool = False
    timeout_s: float = 30.0

    @property
    def key(self) -> str:
        """What it loads, as text: alternatives of two kinds may have the same."""
        return key_of(self.server, self.request)


class AlternativeFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file."""

    alternative: list[Alternative]


def key_of(server: str, request: object) -> str:
    """Return a load as text, for people, too: 'cameras/depth {"device":"front"}'."""
    return server if request is None else f"{server} {json_of(shown_plain(encode(request)))}"


def read_alternatives(
    file_or_alternatives: str | os.PathLike[str] | Sequence[Alternative], beginning: Beginning | None = None
) -> tuple[Alternative, ...]:
    """Return the alternatives of a TOML file, after a crash of the last good one, or as they are given.

    The preferred come first.

    Raises:
        ConfigError: the file cannot be read, or an alternative is wrong. `.file`, `.key`, `.expected`, `.got`
    """
    if isinstance(file_or_alternatives, (str, os.PathLike)):
        return last_good_file(beginning, Path(file_or_alternatives).absolute(), _parse_alternatives).now
    if not isinstance(file_or_alternatives, (list, tuple)):
        expected = "a list of Alternative, or the path of a TOML file"
        raise wrong(None, "alternatives", expected, file_or_alternatives, where=_WHERE)
    return _checked(None, file_or_alternatives)


def _parse_alternatives(data: bytes, file: str) -> tuple[Alternative, ...]:
    return _checked(file, parse_typed(data, file, AlternativeFile).alternative)


def _checked(file: str | None, found: Sequence[Alternative]) -> tuple[Alternative, ...]:
    seen: set[tuple[str, str]] = set()
    faults: list[ConfigError] = []
    for i, one in enumerate(found):
        place = f"alternative[{i}]"
        try:
            _check(file, place, one)
        except ConfigError as error:
            faults.append(error)
            continue
        if (one.kind, one.key) in seen:
            expected = "a server and request that no other alternative of this kind has"
            faults.append(wrong(file, place, expected, one.key, where=_WHERE, said=f"{one.key} again"))
        seen.add((one.kind, one.key))
    raise_faults(faults)
    return tuple(found)


def _check(file: str | None, place: str, one: Alternative) -> None:
    if not isinstance(one, Alternative):  # pyright: ignore[reportUnnecessaryIsInstance]  # a program may give anything
        raise wrong(file, place, "an Alternative", one, where=_WHERE)
    if not one.kind or not isinstance(one.kind, str):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise wrong(file, f"{place}.kind", "a name", one.kind, where=_WHERE)
    try:
        parse_server(one.server)
    except InvalidName as error:
        raise wrong(file, f"{place}.server", "'registrar/server'", one.server, where=_WHERE) from error
    try:
        encode(one.request)
    except NotSerializable as error:
        raise wrong(file, f"{place}.request", "plain data", one.request, where=_WHERE, said=str(error)) from error
    if not is_number(one.timeout_s) or one.timeout_s <= 0:
        raise wrong(file, f"{place}.timeout_s", "a number of seconds over 0", one.timeout_s, where=_WHERE)
    if (found := wrong_label(one.provides)) is not None:
        key = ".".join(filter(None, (place, "provides", found.key)))
        raise wrong(file, key, found.expected, found.got, where=_WHERE)


def check_rings(alternatives: Sequence[Alternative], server: str, allowed: Allowed) -> None:
    """Check that no alternative is a choice that might choose this same alternative, directly or by others.

    Args:
        server: the id of the server of choices that has these alternatives.
        allowed: returns the alternatives that a request for a choice allows.

    Raises:
        ConfigError: one might; the text names the ring.
    """
    inner = {one.key: allowed(shown_plain(encode(one.request))) for one in alternatives if one.server == server}

    def follow(path: tuple[str, ...]) -> None:
        for key in inner.get(path[-1], ()):
            if key == path[0]:
                place = f"alternative[{next(i for i, one in enumerate(alternatives) if one.key == key)}]"
                expected, ring = "alternatives that do not hold each other in a ring", " -> ".join((*path, key))
                raise wrong(None, place, expected, path[0], where=_WHERE, said=f"the ring {ring}")
            if key in inner and key not in path:
                follow((*path, key))

    for key in inner:
        follow((key,))
