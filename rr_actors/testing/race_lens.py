"""The race lens: which callbacks of a manager read and write which attributes at the same time.

Two callbacks race if both run, one of them writes what the other reads or writes, and no lock is held at both accesses.
It need not have gone wrong: that both ran at once is enough. So a race is found with few tries, as by Eraser (Savage
et al., 1997), from which the sets of locks are.

Callbacks that are `async def` take turns on one loop. Two of them race if one wrote between a read of the other and
its next write.
"""

from __future__ import annotations

import contextlib
import itertools
import linecache
import os
import threading
from collections.abc import Callable, Generator, Hashable, Iterable
from contextvars import ContextVar
from types import FrameType
from typing import Any, NamedTuple, cast

_PACKAGE = os.path.dirname(os.path.dirname(os.path.abspath(__file__))) + os.sep
_READY_MADE = os.path.join(_PACKAGE, "managers") + os.sep
_PYKKA = os.path.join(os.sep, "pykka", "")
_FRAMES = 4
_MEND = "serial=True of the class, at_once=1 of a server, or a lock mends it"
_SITES = 8


class Place(NamedTuple):
    """A line of code: its file, its number, and the function."""

    file: str
    line: int
    function: str

    def __str__(self) -> str:
        source = linecache.getline(self.file, self.line).strip()
        return f"{os.path.basename(self.file)}:{self.line}, in {self.function}: {source}"


class Access(NamedTuple):
    """An access of a callback to an attribute.

    Attributes:
        callback: the callback, in words.
        writes: whether it wrote.
        stack: where, the innermost line first.
        locks: the ids of the locks that were held.
        number: counts all accesses of the process.
    """

    callback: str
    writes: bool
    stack: tuple[Place, ...]
    locks: frozenset[int]
    number: int

    def __str__(self) -> str:
        called = "".join(f"\n        called from {place}" for place in self.stack[1:])
        return f"{self.callback} {'wrote' if self.writes else 'read'} it\n      at {self.stack[0]}{called}"


class Race(NamedTuple):
    """Two accesses that nothing keeps apart.

    Attributes:
        attribute: of the manager; with the key, if both were to one item of a dict or set.
        first, second: the accesses, in the order in which they were made.
    """

    attribute: str
    first: Access
    second: Access

    def __str__(self) -> str:
        return f"self.{self.attribute}\n    {self.first}\n    {self.second}\n{_MEND}"


class _Run:
    """A callback that runs."""

    def __init__(self, callback: str, *, takes_turns: bool) -> None:
        self.callback, self.takes_turns = callback, takes_turns
        self.accesses: dict[Hashable, list[Access]] = {}


_here: ContextVar[_Run | None] = ContextVar("rr_actors_race_lens_run", default=None)


class RaceLens:
    """Compares the accesses of the callbacks that run at the same time. From any thread.

    Args:
        found: is called once for each pair of lines that race.
    """

    def __init__(self, found: Callable[[Race], None]) -> None:
        self._found = found
        self._lock = threading.Lock()
        self._running: set[_Run] = set()
        self._seen: set[tuple[str, frozenset[Place]]] = set()
        self._numbers = itertools.count()

    @contextlib.contextmanager
    def run(self, callback: str, *, takes_turns: bool = False) -> Generator[None]:
        """Attribute all accesses in this context to a callback.

        Args:
            callback: in words.
            takes_turns: it is `async def`.
        """
        run = _Run(callback, takes_turns=takes_turns)
        token = _here.set(run)
        with self._lock:
            self._running.add(run)
        try:
            yield
        finally:
            with self._lock:
                self._running.discard(run)
            _here.reset(token)

    def note(self, owner: object, attribute: str, key: Hashable, *, writes: bool, frame: FrameType | None) -> None:
        """Note an access to an attribute of a manager, or to an item of it; without a callback that runs, nothing.

        Args:
            owner: the manager.
            key: of the item; None: the attribute itself.
            frame: the innermost one that is not of the lens.
        """
        run = _here.get()
        if run is None or frame is None or _is_ours(frame):
            return
        stack, locks = tuple(_stack(frame)), frozenset(_held(owner, frame))
        name = attribute if key is None else f"{attribute}[{key!r:.60}]"
        with self._lock:
            if run not in self._running:
                return  # a thread of it goes on
            mine = run.accesses.setdefault((id(owner), attribute, key), [])
            access = Access(run.callback, writes, stack, locks, next(self._numbers))
            races = [
                Race(name, *pair)
                for other in self._running
                if other is not run
                for pair in _races(access, mine, other, other.accesses.get((id(owner), attribute, key), ()), run)
            ]
            if len(mine) < _SITES:
                mine.append(access)
            elif writes or any(one.writes for one in mine[1:]):
                mine[-1] = access
            new = [race for race in races if self._is_new(attribute, race)]
        for race in new:
            self._found(race)

    @staticmethod
    def is_users(frame: FrameType) -> bool:
        """Return whether code of the user's runs in a frame, or of a ready-made manager."""
        return not _is_ours(frame)

    def _is_new(self, attribute: str, race: Race) -> bool:
        key = attribute, frozenset((race.first.stack[0], race.second.stack[0]))
        if key in self._seen:
            return False
        self._seen.add(key)
        return True


def _races(
    access: Access, mine: Iterable[Access], other: _Run, theirs: Iterable[Access], run: _Run
) -> Generator[tuple[Access, Access]]:
    """Yield the accesses of another run that race with a new one, each before the new one."""
    for one in theirs:
        if one.locks & access.locks or not (one.writes or access.writes):
            continue
        both_take_turns = run.takes_turns and other.takes_turns
        lost = one.writes and access.writes and any(not it.writes and it.number < one.number for it in mine)
        if lost or not both_take_turns:
            yield one, access


def _is_ours(frame: FrameType) -> bool:
    file = frame.f_code.co_filename
    return _PYKKA in file or (file.startswith(_PACKAGE) and not file.startswith(_READY_MADE))


def _stack(frame: FrameType | None) -> Generator[Place]:
    count = 0
    while frame is not None and count < _FRAMES and not _is_ours(frame):
        yield Place(frame.f_code.co_filename, frame.f_lineno, frame.f_code.co_qualname)
        frame, count = frame.f_back, count + 1


def _held(owner: object, frame: FrameType) -> Generator[int]:
    """Yield the locks that are held here, of the manager's attributes and of the code's globals, or may be.

    A plain Lock does not say who holds it: one that somebody holds counts.
    """
    found = _global_locks.get(id(frame.f_globals))
    if found is None:
        found = _global_locks[id(frame.f_globals)] = list(_locks(frame.f_globals))
    for lock, is_held in itertools.chain(found, _locks(vars(owner))):
        if is_held(lock):
            yield id(lock)


_Lock = tuple[Any, Callable[[Any], bool]]
_global_locks: dict[int, list[_Lock]] = {}  # of modules, by the id of their names


def _locks(names: dict[str, Any]) -> Generator[_Lock]:
    """Yield the locks among some values, each with the function that says whether it is held."""
    for value in list(names.values()):
        kind = cast("type[object]", type(value))
        if hasattr(kind, "acquire"):
            is_held = getattr(kind, "_is_owned", None) or getattr(kind, "locked", None)
            if is_held is not None:
                yield value, is_held
