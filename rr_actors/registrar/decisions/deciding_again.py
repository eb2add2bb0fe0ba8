"""Decisions that were noted, decided again by today's code, and what is different. No I/O, clock, thread or randomness.

registrar = DecidedAgain()
registrar.begin(began)
result = registrar.decide(decided)
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import Any, Literal

import msgspec

from rr_actors.base.errors import text_of
from rr_actors.registrar.core.decide import decide, refuse_uncommitted
from rr_actors.registrar.decisions.decided import OUTSIDE, Began, Decided, all_of, apply_outside, catalog_of
from rr_actors.registrar.decisions.typed_values import plain
from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.rows import Change, Drop, Row, Table, key_of_row


class RowChange(msgspec.Struct, frozen=True):
    """A change of one row.

    Attributes:
        before, after: the row; None: there is none. What was before is not known if `knows_before` is False.
        later: it may be on disk a moment later than the effects.
    """

    table: Table
    id: str
    before: Row | None
    after: Row | None
    later: bool = False
    knows_before: bool = True


class Difference(msgspec.Struct, frozen=True):
    """Something that today's code decides in another way.

    Attributes:
        of: what is different: a change, an effect, the error, or what the registrar knew.
        name: of what the registrar knew, which part.
        recorded, today: the values; None: there is none.
    """

    of: Literal["change", "later change", "effect", "error", "decided again later", "known"]
    recorded: Any
    today: Any
    name: str = ""


class Again(msgspec.Struct, frozen=True):
    """A decision that was decided again.

    Attributes:
        is_decided: whether it was. It was not if an earlier decision was different, or notes before it are missing.
    """

    rows: tuple[RowChange, ...]
    differences: tuple[Difference, ...]
    is_decided: bool = True


class DecidedAgain:
    """One registrar whose decisions are decided again."""

    def __init__(self) -> None:
        self._catalog: Catalog | None = None  # None: what it knows is not known

    @property
    def is_known(self) -> bool:
        """Whether it is known what the registrar knows, so that decisions can be decided again."""
        return self._catalog is not None

    def lose(self) -> None:
        """Forget what the registrar knows, until the next begin(): notes are missing."""
        self._catalog = None

    def begin(self, began: Began) -> tuple[Difference, ...]:
        """Take what the registrar knew. If decisions led there, return what is different from what they led to.

        Raises:
            AttributeError, TypeError: this version of the package knows no such things.
        """
        before, self._catalog = self._catalog, catalog_of(began)
        if before is None or not began.again:
            return ()
        return tuple(_differences_of(began, all_of(before)))

    def decide(self, decided: Decided) -> Again:
        """Decide once more, and compare. After a difference nothing more is decided until the next begin()."""
        catalog = self._catalog
        rows = tuple(_rows_of(catalog, decided))
        if catalog is None:
            return Again(rows, (), is_decided=False)
        try:
            differences = tuple(self._decide(catalog, decided))
        except Exception as error:  # whatever a defect of decide() raises
            text = text_of(error)
            is_same = decided.end == "raised" and decided.why == text
            differences = () if is_same else (Difference("error", decided.why or None, text),)
            self.lose()  # the catalog is in the middle of a decision
        if differences:
            self.lose()
        return Again(rows, differences)

    def _decide(self, catalog: Catalog, decided: Decided) -> Iterable[Difference]:
        apply_outside(catalog, decided.outside)
        if decided.end == "refused" and decided.failure is not None:
            decision, again = refuse_uncommitted(catalog, decided.items, decided.failure)
        else:
            decision, again = decide(catalog, decided.items), []
        differences = [
            *_differing("change", decided.changes, decision.changes),
            *_differing("later change", decided.later, list(decision.later.values())),
            *_differing("effect", decided.effects, decision.effects),
            *_differing("decided again later", decided.again, again),
        ]
        if decided.end == "raised":
            differences = [Difference("error", decided.why, None)]
        if decided.end == "undone":
            decision.undo()
        else:
            decision.close()
        if decided.end == "committed":
            catalog.deserted.clear()  # as the engine does
        return differences


def _rows_of(catalog: Catalog | None, decided: Decided) -> Iterable[RowChange]:
    """Yield the changes of rows that were noted, each with the row before."""
    seen: dict[tuple[Table, str], Row | None] = {}
    for changes, later in ((decided.changes, False), (decided.later, True)):
        for change in changes:
            key, row = _put_of(change)
            before = seen[key] if key in seen else None if catalog is None else catalog.tables[key[0]].get(key[1])
            seen[key] = row
            yield RowChange(*key, before, row, later, catalog is not None)


def _put_of(change: Change) -> tuple[tuple[Table, str], Row | None]:
    if isinstance(change, Drop):
        return (change.table, change.id), None
    return key_of_row(change.row), change.row


_Of = Literal["change", "later change", "effect", "decided again later"]


def _differing(of: _Of, recorded: Sequence[Any], today: Sequence[Any]) -> Iterable[Difference]:
    """Yield what is in one list and not in the other, or the first that has another place."""
    if (texts := list(map(_key, recorded))) == (texts_today := list(map(_key, today))):
        return
    left = list(texts_today)
    only_recorded: list[Any] = []
    for text, one in zip(texts, recorded, strict=True):
        if text in left:
            left.remove(text)
        else:
            only_recorded.append(one)
    only_today: list[Any] = []
    for text, one in zip(texts_today, today, strict=True):
        if text in left:
            left.remove(text)
            only_today.append(one)
    for one, other in itertools.zip_longest(only_recorded, only_today):
        yield Difference(of, one, other)
    if not only_recorded and not only_today:  # the same ones in another order
        place = next(place for place, text in enumerate(texts) if text != texts_today[place])
        yield Difference(of, recorded[place], today[place], f"at place {place + 1}")


def _key(value: Any) -> bytes:
    return msgspec.msgpack.encode(plain(value))


def _differences_of(recorded: Began, today: Began) -> Iterable[Difference]:
    """Yield what a registrar knew that its decisions did not lead to."""
    rows, rows_today = ({key_of_row(row): row for row in began.rows} for began in (recorded, today))
    for key in {**rows, **rows_today}:
        if (row := rows.get(key)) != (other := rows_today.get(key)):
            yield Difference("known", row, other, " ".join(key))
    for name, value in recorded.memory.items():
        other = today.memory.get(name)
        if name not in OUTSIDE and _key(value) != _key(other):
            yield Difference("known", value, other, name)
