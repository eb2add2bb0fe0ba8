"""ChoiceSearch: a search among alternatives, for a choice that has none or whose one has failed."""

from __future__ import annotations

from collections.abc import Sequence

from rr_actors.managers.choices.alternatives import Alternative
from rr_actors.managers.choices.chosen import HeldChoice
from rr_actors.managers.planning.retries import Retries
from rr_actors.managers.planning.searches import CandidateLoad, Search
from rr_actors.registrar.queries import Query
from rr_actors.registrar.registrar import NO_FIELDS, Registrar


class ChoiceSearch(Search[Alternative]):
    """A search for what a choice is to have in the place of `part`; None: it has no part."""

    def __init__(
        self, registrar: Registrar, retries: Retries[str], held: HeldChoice, part: Query | None, tried: Sequence[str]
    ) -> None:
        super().__init__(registrar, retries, _key, _key, lambda what: "; ".join((*self.tried, what)))
        self.held, self.part = held, part
        self.tried += tried


def loading_of(one: Alternative) -> CandidateLoad:
    """Return the load that gives an alternative."""
    return CandidateLoad(one.server, NO_FIELDS if one.request is None else one.request, one.timeout_s)


def _key(one: Alternative) -> str:
    return one.key


def breaks_first(one: Alternative) -> bool:
    """Return whether an alternative cannot exist beside another one."""
    return one.break_first
