"""Books: what the rows of a Budgets manager's catalog say of its pools. Pure.

The rows are the one source of truth: of who has a share, who loses one, and what gives. A share that was admitted, and
whose row does not say so yet, is `admitted` besides.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Container, Iterable, Mapping, Sequence

import msgspec

from rr_actors.base.names import NAME_WIDTH, in_short, made_at, short_id
from rr_actors.base.values.canonical import shown_plain
from rr_actors.managers.budgets.planner import LEAST, HeldShare
from rr_actors.managers.budgets.requests import Share, Supply
from rr_actors.managers.budgets.rings import RingHold
from rr_actors.registrar.model.rows import STANDBY, Phase, Resource, ServedQuery, State, priority_of

_HELD = (Phase.LOADED, Phase.UNLOADING, Phase.UNLOAD_FAILED)


class BookEntry(msgspec.Struct, frozen=True):
    """A share or supply: its row, what it asks for, who holds it, and what it is a part of."""

    id: str
    request: Share | Supply
    phase: Phase
    is_lost: bool
    priority: int | None
    holders: tuple[str, ...]
    whole: str

    @property
    def name(self) -> str:
        """What a share is for, with its priority, for people."""
        whose = in_short(self.request.whose, NAME_WIDTH) if isinstance(self.request, Share) else ""
        name = whose or ", ".join(dict.fromkeys(self.holders)) or "nobody"
        return f"{name} ({'standby' if self.priority is None else f'priority {self.priority}'})"


class Book(msgspec.Struct):
    """One pool: the shares that are held, by id, and what is given by which resource."""

    shares: dict[str, BookEntry] = {}
    supplies: dict[str, float] = {}

    def used(self) -> float:
        """Return the sum of the shares."""
        return math.fsum(share.request.amount for share in self.shares.values())

    def by_priority(self) -> dict[str, float]:
        """Return the sums of the shares by priority, the highest first; "standby" is the last."""
        sums: dict[int | None, float] = {}
        for share in self.shares.values():
            sums[share.priority] = sums.get(share.priority, 0.0) + share.request.amount
        order = sorted(sums, key=lambda priority: math.inf if priority is None else -priority)
        return {"standby" if priority is None else str(priority): sums[priority] for priority in order}

    def given(self) -> float:
        """Return the sum of the supplies."""
        return math.fsum(self.supplies.values())

    def running(self, leaving: Container[str]) -> list[HeldShare]:
        """Return the shares for the planner. Those that lose theirs, or are being unloaded, are `leaving`."""
        return [
            HeldShare(id, one.request.amount, one.priority, made_at(id), id in leaving or one.is_lost)
            for id, one in self.shares.items()
        ]


class Books:
    """All pools at one moment.

    Attributes:
        of: the shares and supplies by id, also those that are being loaded.
        pools: the pools by name.
    """

    def __init__(
        self,
        pools: Iterable[str],
        rows: Sequence[tuple[Resource, list[ServedQuery]]],
        admitted: Container[str],
        ended: Container[str],
    ) -> None:
        """Read the rows.

        Args:
            admitted: shares that were admitted, and are being loaded.
            ended: resources that are being released: what they give counts no more.
        """
        self.pools = {name: Book() for name in pools}
        self.of: dict[str, BookEntry] = {}
        for row, queries in rows:
            if row.server not in ("share", "supply"):
                continue
            one = _holding(row, queries)
            if one is None:  # it is being refused
                continue
            self.of[row.id] = one
            book = self.pools.get(one.request.pool)
            if book is None:
                continue
            if isinstance(one.request, Share):
                if row.phase in _HELD or row.id in admitted:
                    book.shares[row.id] = one
            elif _gives(one) and one.whole not in ended:
                book.supplies[one.whole] = book.supplies.get(one.whole, 0.0) + one.request.amount

    def holds(self, leaving: Container[str]) -> list[RingHold]:
        """Return all shares that are held, for the search for rings."""
        return [
            RingHold(pool, one.whole, one.request.amount, id in leaving or one.is_lost)
            for pool, book in self.pools.items()
            for id, one in book.shares.items()
        ]

    def name_of(self, id: str) -> str:
        """Return what a share is for, for people."""
        one = self.of.get(id)
        return f"share {short_id(id)}" if one is None else one.name


def most_of(own: float, book: Book, reserves: Mapping[str, float]) -> float:
    """Return what a pool can have: its own capacity, what others give, and all of its reserves.

    Args:
        reserves: the amounts by the resources that are the reserves; what is not loaded has any other key.
    """
    others = (amount for whole, amount in book.supplies.items() if whole not in reserves)
    return own + math.fsum([*others, *reserves.values()])


def _holding(row: Resource, queries: Sequence[ServedQuery]) -> BookEntry | None:
    request = _request(row.server, row.request)
    if request is None:
        return None
    priority = priority_of(max((query.priority for query in queries), default=STANDBY))
    whole = next((query.parent for query in queries if query.parent), "")
    holders = tuple(query.origin for query in queries)
    return BookEntry(row.id, request, row.phase, row.state is State.FATAL, priority, holders, whole)


def _gives(one: BookEntry) -> bool:
    """Return whether a supply gives now: somebody needs what it is a part of, and that is not lost."""
    needed = one.priority is not None and one.priority > LEAST
    return one.phase is Phase.LOADED and not one.is_lost and needed


@functools.lru_cache(maxsize=8192)
def _request(server: str, raw: bytes) -> Share | Supply | None:
    """Return what a row asks for; None if that is wrong: its load is refused."""
    try:
        return msgspec.convert(shown_plain(raw), Share if server == "share" else Supply)
    except msgspec.ValidationError:
        return None
