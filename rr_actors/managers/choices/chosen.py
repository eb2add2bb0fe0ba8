"""What a choice is asked for, what it answers, and what its manager knows of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import msgspec

from rr_actors.base.values.canonical import encode, shown_plain
from rr_actors.managers.choices.alternatives import Alternative, key_of
from rr_actors.managers.templates import Parameter
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query


class Choose(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The request for the best alternative of a kind.

    Attributes:
        kind: what is needed, such as "range".
        where: what it must provide: `{"rate_hz": ">=10", "place": "roof"}`. A value alone is to be equal.
        prefer: what is better, the most important first: "rate_hz" is more of it, "-cost" less. Of equal alternatives
            the first that was given is better.
        bind: "relay" opens an address that stays, `Chosen.address`, for programs that connect to what is chosen. The
            response of each alternative has to be its own address, or to have it as its field "address":
            "unix:/run/camera.sock" or "tcp:127.0.0.1:5000".
    """

    kind: str
    where: dict[str, Parameter] = {}
    prefer: list[str] = []
    bind: Literal["", "relay"] = ""

    def __rr_title__(self) -> str:
        where = ", ".join(f"{name} {wanted}" for name, wanted in self.where.items())
        best = f"best {', '.join(self.prefer)}" if self.prefer else ""
        said = "; ".join(filter(None, (where, best, self.bind)))
        return f"{self.kind} ({said})" if said else self.kind


class Chosen(msgspec.Struct, frozen=True):
    """The response: the alternative in use, what it provides, and its own response, as plain values.

    When another one takes its place, the response changes, and its holders hear an UPDATE status.

    Attributes:
        address: of the relay, of the same form as the address of the alternative that was chosen first. It stays the
            same. "" without `bind="relay"`.
    """

    server: str
    request: Any
    response: Any
    provides: dict[str, Parameter]
    address: str = ""


class HeldChoice(msgspec.Struct):
    """A choice that is loaded.

    Attributes:
        failing: its part has said ERROR, and nothing could take its place.
        moving: it has been told to return to a better alternative, and has not done so.
        failures: how each alternative failed last for this choice, since this process began.
    """

    request: Choose
    present: str
    address: str = ""
    failing: bool = False
    moving: bool = False
    failures: dict[str, str] = {}


def held_choice(request: Choose, chosen: Chosen, parts: Sequence[Query]) -> HeldChoice:
    """Return what is known of a choice that a process before has made."""
    failing = any(part.state is State.ERROR for part in parts)
    return HeldChoice(request, key_of(chosen.server, chosen.request), chosen.address, failing)


def chosen_of(one: Alternative, query: Query) -> Chosen:
    """Return the response of a choice whose part is this alternative."""
    request, response = (shown_plain(encode(value)) for value in (one.request, query.response))
    return Chosen(one.server, request, response, one.provides)
