"""Children: a supervisor's children in their order, as a value whose newest version costs the same with any number.

All versions share one table, which has the children of one of them, mostly the newest. Every other version keeps what
it has instead, and the version from which that differs. To read such a version moves the table there, step by step.
(Henry Baker, "Shallow binding makes functional arrays fast", 1991.)
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Collection, Iterator, Mapping
from heapq import merge
from itertools import islice

from rr_actors.supervision.core.state import ChildPhase, SupervisedChild, Why

_Kind = tuple[ChildPhase, Why, bool]
_Place = tuple[int, SupervisedChild]  # its number in the order, and the child

_ALL = tuple(Why)


class _Table:
    def __init__(self) -> None:
        self.places: dict[str, _Place] = {}
        self.ids: dict[int, str] = {}
        self.numbers: dict[_Kind, list[int]] = {}  # of the children of each kind, in order; none is empty
        self.last = 0

    def set(self, id: str, place: _Place | None) -> _Place | None:
        """Put a child there, or, with None, remove the child of that id. Return what was there."""
        before = self.places.get(id)
        old, new = before and _kind(before[1]), place and _kind(place[1])
        if before is not None and old is not None and old != new:
            numbers = self.numbers[old]
            del numbers[bisect_left(numbers, before[0])]
            if not numbers:
                del self.numbers[old]
        if place is None:
            if before is not None:
                del self.places[id], self.ids[before[0]]
            return before
        self.places[id] = place
        if before is None:
            self.ids[place[0]] = id
        if new is not None and old != new:
            insort(self.numbers.setdefault(new, []), place[0])
        return before


def _kind(child: SupervisedChild) -> _Kind:
    return child.phase, child.why, child.spec.significant


class Children(Mapping[str, SupervisedChild]):
    """Children by id, in start order. A child with a new id is put after the others.

    Iterating goes through all of them as they are at its begin.
    """

    __slots__ = ("_id", "_newer", "_place", "_table")

    def __init__(self, children: Mapping[str, SupervisedChild]) -> None:
        self._table: _Table | None = None  # None: it has the children of another version
        self._newer: Children  # it differs from this one in what is at `_id`; here that is `_place`
        self._id = ""
        self._place: _Place | None = None
        table = _Table()
        for number, (id, child) in enumerate(children.items(), 1):
            table.set(id, (number, child))
        table.last = len(children)
        self._table = table

    @classmethod
    def of(cls, children: Mapping[str, SupervisedChild]) -> Children:
        """Return the same children as a value of this class."""
        return children if isinstance(children, Children) else cls(children)

    def put(self, id: str, child: SupervisedChild) -> Children:
        """Return the children with this one in the place of the one of that id, or after the others."""
        table = self._own()
        before = table.places.get(id)
        if before is None:
            table.last += 1
        return self._next(table, id, (table.last if before is None else before[0], child))

    def without(self, id: str) -> Children:
        """Return the children but that one."""
        return self._next(self._own(), id, None)

    def first(self, count: int, *phases: ChildPhase, whys: Collection[Why] = _ALL) -> list[SupervisedChild]:
        """Return the first children, `count` at most, that are in one of these phases for one of these purposes."""
        table = self._own()
        return [self[table.ids[number]] for number in islice(merge(*_having(table, phases, whys)), count)]

    def last(self, *phases: ChildPhase) -> SupervisedChild | None:
        """Return the last child that is in one of these phases."""
        table = self._own()
        found = max((numbers[-1] for numbers in _having(table, phases, _ALL)), default=None)
        return None if found is None else self[table.ids[found]]

    def after(self, id: str) -> list[SupervisedChild]:
        """Return the children that follow the one of that id."""
        table = self._own()
        number = table.places[id][0]
        following = merge(*(numbers[bisect_right(numbers, number) :] for numbers in table.numbers.values()))
        return [self[table.ids[each]] for each in following]

    def any(self, *phases: ChildPhase, whys: Collection[Why] = _ALL) -> bool:
        """Return whether a child is in one of these phases, for one of these purposes."""
        return bool(_having(self._own(), phases, whys))

    def any_significant(self) -> bool:
        """Return whether a significant child is not stopped."""
        return any(significant and phase is not ChildPhase.STOPPED for phase, _, significant in self._own().numbers)

    def __getitem__(self, id: str) -> SupervisedChild:
        return self._own().places[id][1]

    def __iter__(self) -> Iterator[str]:
        ids = self._own().ids
        return iter([ids[number] for number in sorted(ids)])

    def __len__(self) -> int:
        return len(self._own().places)

    def _own(self) -> _Table:
        """Return the table, with the children of this version."""
        versions: list[Children] = [self]
        while (table := versions[-1]._table) is None:
            versions.append(versions[-1]._newer)
        for version in versions[-2::-1]:
            newer, id = version._newer, version._id
            newer._place, newer._id, newer._newer, newer._table = table.set(id, version._place), id, version, None
            version._table, version._place = table, None
            del version._newer
        return table

    def _next(self, table: _Table, id: str, place: _Place | None) -> Children:
        new = Children.__new__(Children)
        self._place, self._id, self._newer, self._table = table.set(id, place), id, new, None
        new._table, new._id, new._place = table, "", None
        return new


def _having(table: _Table, phases: Collection[ChildPhase], whys: Collection[Why]) -> list[list[int]]:
    return [numbers for (phase, why, _), numbers in table.numbers.items() if phase in phases and why in whys]
