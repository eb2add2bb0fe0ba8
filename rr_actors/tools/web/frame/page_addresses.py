"""Addresses of the web pages: what is chosen, searched and sorted, and the time that is shown, are in their query."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args
from urllib.parse import urlencode

Kind = Literal["", "child", "resource", "server", "registrar"]
KINDS: tuple[Kind, ...] = get_args(Kind)[1:]
"""The kinds of things that a drawer can show."""
_LONGEST = 500  # characters of a value: an address is typed by anybody
_TEXTS = ("match", "sort", "events")


@dataclass(frozen=True)
class Address:
    """What a page shows, besides the page itself.

    Attributes:
        kind, name: the chosen thing: the path of a child, the id of a resource, "registrar/server", or a registrar.
        match, sort: the search of the page's list, and what sorts it; "": as the page does without a choice.
        events: the filter of the events.
        at: the time that is shown, in seconds since the epoch; None for now.
    """

    kind: Kind = ""
    name: str = ""
    match: str = ""
    sort: str = ""
    events: str = ""
    at: float | None = None

    @classmethod
    def read(cls, query: Mapping[str, str]) -> Address:
        """Return the address of a query. What is unknown, or is no time, is left out."""
        kind = _kind(query)
        match, sort, events = (query.get(name, "")[:_LONGEST] for name in _TEXTS)
        return cls(kind, query.get(kind, "")[:_LONGEST], match, sort, events, _time(query.get("at", "")))

    def query(self) -> dict[str, str]:
        """Return the query: what read() reads as this address."""
        texts = {name: value for name in _TEXTS if (value := getattr(self, name))}
        chosen = {self.kind: self.name} if self.kind and self.name else {}
        return chosen | texts | ({} if self.at is None else {"at": f"{self.at:.1f}"})

    def chosen(self, kind: Kind, name: str) -> Address:
        """Return the address with another choice."""
        return replace(self, kind=kind if name else "", name=name if kind else "")


def link_to(kind: Kind, name: str) -> str:
    """Return the address that chooses a thing on whichever page it stands."""
    return f"?{urlencode({kind: name})}"


def _kind(query: Mapping[str, str]) -> Kind:
    for kind in KINDS:
        if query.get(kind):
            return kind
    return ""


def _time(text: str) -> float | None:
    try:
        at = round(float(text), 1)
    except (ValueError, OverflowError):
        return None
    return at if math.isfinite(at) and 0 < at < 1e11 else None
