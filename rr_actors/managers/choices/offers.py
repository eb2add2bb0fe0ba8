"""Offers: the alternatives that there are now, given ones and those of servers' labels, and how far each is trusted."""

from __future__ import annotations

import threading
from collections.abc import Sequence

from rr_actors.base.checks import RELIABILITY
from rr_actors.base.errors import ConfigError, LoadFailed
from rr_actors.managers.choices.alternatives import Alternative
from rr_actors.managers.choices.chosen import Choose
from rr_actors.managers.choices.labelled import Labelled
from rr_actors.managers.choices.matching import ranked, why_none
from rr_actors.managers.planning.reliability import Reliabilities


class Offers:
    """The alternatives of one manager. From any thread."""

    def __init__(self, given: Sequence[Alternative], labelled: Labelled, reliabilities: Reliabilities) -> None:
        self._given = self._every = tuple(given)
        self._labelled, self._reliabilities = labelled, reliabilities
        self._labelled_before: tuple[Alternative, ...] = ()
        self._lock = threading.Lock()

    def has_changed(self) -> bool:
        """Return whether a server with labels may have come or gone since every() was called last."""
        return self._labelled.has_changed()

    def every(self) -> tuple[Alternative, ...]:
        """Return the alternatives that were given, and those of servers' labels that are no others' as well."""
        with self._lock:
            labelled = self._labelled.alternatives()
            if labelled is not self._labelled_before:
                known = {(one.kind, one.key) for one in self._given}
                more = tuple(one for one in labelled if (one.kind, one.key) not in known)
                self._labelled_before, self._every = labelled, (*self._given, *more)
            return self._every

    def find(self, key: str, kind: str | None = None) -> Alternative | None:
        """Return the alternative with this key, of any kind or of this one; None if there is none any more."""
        return next((one for one in self.every() if one.key == key and kind in (None, one.kind)), None)

    def allowed(self, request: Choose) -> list[Alternative]:
        """Return the alternatives that a choice allows, the best first.

        Raises:
            ConfigError: the choice is wrong. `.key`, `.expected`, `.got`
            LoadFailed: no alternative is allowed; it says why not.
        """
        of = (self.every(), request.kind, request.where)
        found = ranked(*of, request.prefer, self.reliability)
        if not found:
            raise LoadFailed(nothing_left(request, why_none(*of, self.reliability).splitlines()))
        return found

    def allowed_now(self, request: Choose) -> list[Alternative]:
        """Return what a choice that was made before allows: the file may have changed, and nothing may be left."""
        try:
            return self.allowed(request)
        except (ConfigError, LoadFailed):
            return []

    def reliability(self, one: Alternative) -> float:
        """Return how far an alternative is trusted now, from 0 to 1."""
        return self._reliabilities.of(one.key, _trust(one))

    def lower(self, one: Alternative, failure_id: str) -> None:
        """Halve the reliability of an alternative for a failure. The same failure counts once."""
        self._reliabilities.lower(one.key, _trust(one), failure_id)


def nothing_left(request: Choose, why: Sequence[str]) -> str:
    """Return the text for a choice that nothing can serve."""
    return "\n".join([f"nothing is left for {request.kind!r}:", *why])


def _trust(one: Alternative) -> float:
    return float(one.provides.get(RELIABILITY, 1.0))
