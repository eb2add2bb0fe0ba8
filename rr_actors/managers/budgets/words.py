"""What a budget says of its shares, for people: behind whom one waits for room, and for whom one gives way. Pure."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec

from rr_actors.base.errors import shown
from rr_actors.base.names import in_short

NAMED = 3
"""Shares that a text names; of the others it has the number."""
_LONGEST = 400  # characters: a report of progress has at most 500


class Around(msgspec.Struct, frozen=True):
    """What is around a share that waits, by ids: who is ahead, who gives way for room, who has the room.

    `more_ahead`: how many are ahead beside those that are named. `reserves`: how many reserves start.
    """

    ahead: Sequence[str] = ()
    more_ahead: int = 0
    leaving: Sequence[str] = ()
    holding: Sequence[str] = ()
    reserves: int = 0


def waits(room: str, around: Around, name_of: Callable[[str], str]) -> str:
    """Return the text for a share that waits for room: how much, and behind whom, or who gives way, or who has it."""
    give = "gives" if len(around.leaving) == 1 else "give"
    parts = (f"{_several(around.leaving, name_of)} {give} way" if around.leaving else "", _reserves(around.reserves))
    said = ", ".join(filter(None, parts)) or f"held by {_several(around.holding, name_of) or 'nobody'}"
    if around.ahead:
        said = f"behind {_several(around.ahead, name_of, around.more_ahead)}"
    return in_short(f"waits for room in {room}; {said}", _LONGEST)


def has_room(pool: str, amount: float, waited_s: float) -> str:
    """Return the text for a share that has waited, and is admitted."""
    return f"has {amount:g} of pool {shown(pool)} after {waited_s:.1f} s"


def gives_way(pool: str, capacity: float | None, needing: Sequence[str], name_of: Callable[[str], str]) -> str:
    """Return why a share is revoked: the capacity has become less (None: it has not), or others need the room."""
    parts = (
        "" if capacity is None else f"its capacity is {capacity:g} now",
        f"{_several(needing, name_of)} {'needs' if len(needing) == 1 else 'need'} room" if needing else "",
    )
    why = ", and ".join(filter(None, parts))
    return in_short(f"pool {shown(pool)} has no room for it: {why}".removesuffix(": "), _LONGEST)


def _several(ids: Sequence[str], name_of: Callable[[str], str], also: int = 0) -> str:
    left = max(0, len(ids) - NAMED) + also
    more = f" and {left} more" if left else ""
    return ", ".join(map(name_of, ids[:NAMED])) + more


def _reserves(count: int) -> str:
    return "" if not count else "a reserve starts" if count == 1 else f"{count} reserves start"
