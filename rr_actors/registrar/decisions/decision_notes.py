"""DecisionNotes: notes what a registrar decides while a recording asks for that. It is never called otherwise."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from rr_actors.base.errors import text_of
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.failure import Failure
from rr_actors.registrar.core.decide import Item
from rr_actors.registrar.decisions.decided import OUTSIDE, Decided, Outside, all_of, copied, outside_of
from rr_actors.registrar.model.catalog import Catalog, Decision

logger = Log("rr_actors.registrar")

PART = 65_536
"""The most characters of a note that one entry has."""

Send = Callable[[str, int, Sequence[str]], bool]
"""Sends the note of this number of a registrar, in parts, and returns whether there was room for it."""


class DecisionNotes:
    """The notes of one registrar. Call it with the registrar's lock.

    The first note has all that the registrar knows. The next are numbered without a gap, so a reader sees whether one
    is missing. After anything that a note does not have, such as an interrupt within a decision, the next note has all
    again.
    """

    def __init__(self, name: str, send: Send) -> None:
        self._name = name
        self._send = send
        self._number = itertools.count(1)
        self._catalog: Catalog | None = None  # that the notes are of; None: the next note has all
        self._recording = 0
        self._seen: dict[str, dict[Any, Any]] = {}
        self._begun: tuple[list[Item], Outside] | None = None  # of the decision that is being made

    def doubt(self) -> None:
        """Have the next note have all that the registrar knows: something has changed that no note has."""
        self._catalog = self._begun = None

    def begin(self, catalog: Catalog, items: Iterable[Item], recording: int) -> list[Item]:
        """Note that these items are about to be decided, and return them.

        Args:
            recording: a number that changes when a recording begins.
        """
        items = list(items)
        if self._begun is not None:  # an interrupt came before its end was noted
            self.doubt()
        self._begun = items, {}
        if self._catalog is not catalog or self._recording != recording:
            known = self._catalog is catalog
            self._catalog, self._recording = catalog, recording
            self._seen = {name: copied(getattr(catalog, name)) for name in OUTSIDE}
            self._note(all_of(catalog, again=known))
            outside: Outside = {}
        else:
            outside = self._changed_outside(catalog)
        self._begun = items, outside
        return items

    def _changed_outside(self, catalog: Catalog) -> Outside:
        outside: Outside = {}
        for name in OUTSIDE:
            now, before = copied(getattr(catalog, name)), self._seen[name]
            if now != before:
                outside[name] = outside_of(before, now)
                self._seen[name] = now
        return outside

    def committed(self, decision: Decision) -> None:
        """Note a decision that is on disk, or waits to be written."""
        self._note_end(decision)

    def undone(self, decision: Decision, error: Exception) -> None:
        """Note a decision that is about to be undone, because it could not be written."""
        self._note_end(decision, end="undone", why=text_of(error))

    def raised(self, error: Exception) -> None:
        """Note that decide() has raised."""
        self._note_end(None, end="raised", why=text_of(error))
        self.doubt()

    def refused(self, decision: Decision, again: list[Item], failure: Failure) -> None:
        """Note which of the items of an undone decision are refused, and which are to be decided again."""
        self._note_end(decision, end="refused", why=failure.message, again=list(again), failure=failure)

    def _note_end(self, decision: Decision | None, **more: Any) -> None:
        if (begun := self._begun) is None:
            return
        if decision is None:
            self._note(Decided(*begun, **more))
        else:
            changes, later = list(decision.changes), list(decision.later.values())
            self._note(Decided(*begun, changes, later, list(decision.effects), **more))
        self._begun = None  # at last: after an interrupt before this, the next note has all

    def _note(self, what: Any) -> None:
        from rr_actors.registrar.decisions.typed_values import text_from  # its tables, which few programs need

        try:
            text = text_from(what)
            parts = [text[at : at + PART] for at in range(0, len(text), PART)]
            if not self._send(self._name, next(self._number), parts):
                self.doubt()
        except Exception:  # a value that cannot be written, or a defect: it must not end the registrar
            logger.exception("%s: a decision could not be recorded", self._name)
            self.doubt()
