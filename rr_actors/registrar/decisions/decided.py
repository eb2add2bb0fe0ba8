"""What a recording has of a registrar's decisions: how all was when it began, and then each decision."""

from __future__ import annotations

from collections import defaultdict
from typing import Any, Literal, cast

import msgspec

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.core.decide import Item
from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.effects import Effect
from rr_actors.registrar.model.rows import Change, Row, content_of, rows_of

Memory = dict[str, Any]
"""What a catalog has in memory beside its rows, by attribute; the indexes, too, which know the order of what came."""

Outside = dict[str, tuple[dict[Any, Any], list[Any]]]
"""By attribute of a catalog, what was put into it and what was taken out of it, not by a decision."""

OUTSIDE = ("in_flight", "wait_limits", "listened", "servers")
"""What other code than decide() changes: threads that load, those that listen, and the registration of a server."""

_NOT_NOTED = frozenset(("tables", "unfinished", "_index", "joined", "waited"))
"""The rows, which are noted as such; functions; and counts, on which no decision depends."""


class Began(msgspec.Struct, frozen=True):
    """All that a registrar knew.

    Attributes:
        again: decisions were noted up to here, and this is what has come of them: another recording began.
    """

    name: str
    epoch: int
    rows: list[Row]
    memory: Memory
    again: bool = False


class Decided(msgspec.Struct, frozen=True):
    """One decision.

    Attributes:
        items: the messages, each with its sender, and the commands, with None.
        outside: what was changed before it by other code than decisions.
        changes: of rows, which are on disk before the effects; those of `later` may be written later.
        end: "committed"; "undone", as it could not be written, for the reason in `why`; "refused": these items were
            undone before, some are refused with `failure`, and `again` are to be decided again; "raised": `why` is the
            error.
    """

    items: list[Item]
    outside: Outside
    changes: list[Change] = []
    later: list[Change] = []
    effects: list[Effect] = []
    end: Literal["committed", "undone", "refused", "raised"] = "committed"
    why: str = ""
    again: list[Item] = []
    failure: Failure | None = None


def memory_of(catalog: Catalog) -> Memory:
    """Return what a catalog knows beside its rows. The values are the catalog's own, except those of OUTSIDE."""
    tables = catalog.tables.values()
    return {
        name: value.copy() if name in OUTSIDE else value
        for name, value in vars(catalog).items()
        if name not in _NOT_NOTED and not any(value is table for table in tables)
    }


def all_of(catalog: Catalog, *, again: bool = False) -> Began:
    """Return all that a registrar knows, as memory_of() does."""
    return Began(catalog.name, catalog.epoch, rows_of(catalog.tables), memory_of(catalog), again)


def catalog_of(began: Began) -> Catalog:
    """Return a new catalog that knows the same, and changes nothing of what was noted.

    Raises:
        AttributeError: a catalog of this version has no such memory.
    """
    catalog = Catalog(began.name, content_of(began.rows), began.epoch)
    for name, value in began.memory.items():
        known: Any = getattr(catalog, name)
        is_made = isinstance(known, defaultdict)  # by_request: dicts in a dict
        setattr(catalog, name, defaultdict(dict, _own(value)) if is_made else _own(value))
    return catalog


def _own(value: Any) -> Any:
    """Return a copy of what a catalog would change: dicts in dicts, and sets."""
    if isinstance(value, dict):
        return {key: _own(one) for key, one in cast("dict[Any, Any]", value).items()}
    return set(cast("set[Any]", value)) if isinstance(value, set) else value


def apply_outside(catalog: Catalog, outside: Outside) -> None:
    """Make the changes of other code than decisions."""
    for name, (put, taken) in outside.items():
        known: dict[Any, Any] | set[Any] = getattr(catalog, name)
        known.update(put)
        for key in taken:
            known.discard(key) if isinstance(known, set) else known.pop(key, None)


def outside_of(before: dict[Any, Any], now: dict[Any, Any]) -> tuple[dict[Any, Any], list[Any]]:
    """Return what was put in and taken out between two copies of one of OUTSIDE."""
    missing = object()
    put = {key: value for key, value in now.items() if before.get(key, missing) != value}
    return put, [key for key in before if key not in now]


def copied(values: dict[Any, Any] | set[Any]) -> dict[Any, Any]:
    """Return a copy of one of OUTSIDE; of a set, a dict with its members as keys."""
    return dict.fromkeys(values.copy(), True) if isinstance(values, set) else values.copy()
