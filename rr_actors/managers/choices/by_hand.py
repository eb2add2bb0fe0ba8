"""What an operator has fixed: which alternative a choice is to have until that is taken back.

It is before all others, and otherwise a choice goes on as before: another one serves while it fails, and it takes its
place back when it is well again (decision 81).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec

from rr_actors.base.errors import NotFound, Unavailable, UsageError, few, shown
from rr_actors.base.names import short_id
from rr_actors.managers.choices.chosen import HeldChoice
from rr_actors.managers.planning.kept_record import KeptRecord

_PART = 4  # characters of an id


class ByHand(msgspec.Struct, frozen=True):
    """What was chosen by hand for a choice: the alternative's key, who did it, and when (seconds since 1970)."""

    key: str
    by: str
    at: float


class ChoiceInfo(msgspec.Struct, frozen=True):
    """A choice as it is now.

    Attributes:
        id: of the resource; `kind`: what it gives.
        present: the alternative in use, as text: 'cameras/depth {"device":"front"}'.
        allowed: the alternatives that its request allows now, in the order in which they are tried.
        by_hand: the alternative that was chosen by hand; "" for none.
        by, at: who chose it, and when (seconds since 1970).
        why: why that one is not in use; "" if it is.
    """

    id: str
    kind: str
    present: str
    allowed: tuple[str, ...]
    by_hand: str = ""
    by: str = ""
    at: float = 0.0
    why: str = ""


class ChoicesRecord(msgspec.Struct):
    """What is known of choices beside the catalog.

    Attributes:
        choices: those whose part has been released before another one was loaded in its place.
        by_hand: what was chosen by hand, by the choice's id.
    """

    choices: list[str] = []
    by_hand: dict[str, ByHand] = {}


class ChosenByHand:
    """What is chosen by hand for the choices of one manager. Its callers have the manager's lock."""

    def __init__(self, record: KeptRecord[ChoicesRecord]) -> None:
        self._record = record

    def key(self, id: str) -> str:
        """Return the key of what is chosen for a choice; "" for none."""
        by_hand = self._record.now.by_hand.get(id)
        return "" if by_hand is None else by_hand.key

    def set(self, id: str, by_hand: ByHand | None) -> None:
        """Write what is chosen for a choice; None takes it back.

        Raises:
            Unavailable: the disk refuses it. Nothing has changed.
        """
        before = self._record.now.by_hand
        others = {other: one for other, one in before.items() if other != id}
        self._record.now.by_hand = others if by_hand is None else {**others, id: by_hand}
        if not self._record.save():
            self._record.now.by_hand = before
            raise Unavailable(f"choice {short_id(id)}: what is chosen by hand cannot be written; nothing has changed")

    def keep_only(self, choices: Mapping[str, HeldChoice]) -> None:
        """Forget what was chosen for choices that are no more."""
        before = self._record.now.by_hand
        self._record.now.by_hand = {id: one for id, one in before.items() if id in choices}
        if len(self._record.now.by_hand) < len(before):
            self._record.save()

    def info(self, id: str, held: HeldChoice, allowed: Sequence[str]) -> ChoiceInfo:
        """Return how a choice is; `allowed` are the keys of what it allows now."""
        place = id, held.request.kind, held.present, tuple(allowed)
        by_hand = self._record.now.by_hand.get(id)
        if by_hand is None:
            return ChoiceInfo(*place)
        why = ""
        if held.present != by_hand.key:
            why = (
                "it is not in use yet, or has failed"
                if by_hand.key in allowed
                else "it is not there, or not allowed now"
            )
        return ChoiceInfo(*place, by_hand.key, by_hand.by, by_hand.at, why)


def find_choice(text: object, choices: Mapping[str, HeldChoice]) -> str:
    """Return the id of the choice that a text means: its id, the beginning or end of that, or a kind that one has.

    Raises:
        NotFound: it means none. `.id`, `.known`
        UsageError: it means several.
    """
    if not isinstance(text, str):
        raise UsageError(f"expected the id or the kind of a choice, got {shown(text)}")
    if text in choices:
        return text
    ids = [id for id in choices if len(text) >= _PART and (id.startswith(text) or id.endswith(text))]
    found = ids or [id for id, held in choices.items() if held.request.kind == text]
    names = [f"{short_id(id)} ({choices[id].request.kind})" for id in (found or choices)]
    if not found:
        raise NotFound(f"no choice {shown(text)}: there are {few(names) or 'none'}", id=text, known=tuple(choices))
    if len(found) > 1:
        raise UsageError(f"{shown(text)} means several choices: {few(names)}; give one of these ids")
    return found[0]


def find_key(text: object, allowed: Sequence[str]) -> str:
    """Return the alternative that a text means: its key, or the server of one alone.

    Raises:
        NotFound: it means none that is allowed. `.id`, `.known`
        UsageError: it means several.
    """
    if not isinstance(text, str):
        raise UsageError(f"expected an alternative, as 'registrar/server' or with its request, got {shown(text)}")
    if text in allowed:
        return text
    found = [key for key in allowed if key.partition(" ")[0] == text]
    if not found:
        known = few(allowed) or "none"
        raise NotFound(f"no alternative {shown(text)}: the choice allows {known}", id=text, known=tuple(allowed))
    if len(found) > 1:
        raise UsageError(f"{shown(text)} means several alternatives: {few(found)}; give one with its request")
    return found[0]
