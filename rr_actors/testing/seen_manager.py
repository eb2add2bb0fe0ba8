"""A manager that is seen through the race lens: a subclass of the user's class whose accesses to `self` are noted.

Everything here runs in the manager's process.
"""

from __future__ import annotations

import functools
import os
import sys
import threading
from collections.abc import Callable, Hashable
from pathlib import Path
from types import BuiltinFunctionType, FunctionType, MethodType
from typing import Any, ClassVar, cast

import msgspec

from rr_actors.registrar.engine.server import Callback, ServerSpec
from rr_actors.registrar.manager import Manager
from rr_actors.registrar.model.roles import ROLES, UPGRADE, Role
from rr_actors.registrar.servers.callback_context import current
from rr_actors.runtime.workers import is_async
from rr_actors.testing.callback_notes import Note, append_note
from rr_actors.testing.race_lens import Race, RaceLens

TOGETHER = "together"
"""A file of the directory: the role of the callbacks that are to run at the same time, and how many there are."""
_MEETING_S = 0.3
_METHODS = (MethodType, FunctionType, BuiltinFunctionType, functools.partial)


class SeenManager(Manager):
    """The base of the class that seen_class() makes of the user's class, which is its second base."""

    _rr_notes: ClassVar[str] = ""

    def __getattribute__(self, name: str) -> Any:
        value = super().__getattribute__(name)
        if not name.startswith("__") and not issubclass(type(value), _METHODS):
            lens = _lens_of(type(self)._rr_notes)
            lens.note(self, name, None, writes=False, frame=sys._getframe(1))  # pyright: ignore[reportPrivateUsage]
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        frame = sys._getframe(1)  # pyright: ignore[reportPrivateUsage]
        lens = _lens_of(type(self)._rr_notes)
        if type(value) in SEEN and sys.getrefcount(value) <= _fresh() and lens.is_users(frame):
            value = SEEN[cast("type[object]", type(value))](value)
            value.note = functools.partial(self._rr_note_item, lens, name)
        super().__setattr__(name, value)
        lens.note(self, name, None, writes=True, frame=frame)

    def _rr_note_item(self, lens: RaceLens, name: str, key: Hashable, writes: bool) -> None:
        frame = sys._getframe(2)  # pyright: ignore[reportPrivateUsage]
        lens.note(self, name, key, writes=writes, frame=frame)

    def _rr_adapted(self, spec: ServerSpec) -> ServerSpec:
        spec = super()._rr_adapted(spec)
        roles = {field: role for field, role in ROLES.items() if role is not UPGRADE and getattr(spec, field)}
        seen = {field: self._rr_seen(getattr(spec, field), role) for field, role in roles.items()}
        return msgspec.structs.replace(spec, **seen)

    def _rr_seen(self, callback: Callback, role: Role) -> Callback:
        notes, serial = type(self)._rr_notes, type(self).serial
        lens = _lens_of(notes)
        if is_async(callback):

            @functools.wraps(callback)
            async def seen_async(*given: Any, **fields: Any) -> Any:
                with lens.run(_named(role), takes_turns=True):
                    return await callback(*given, **fields)

            return seen_async

        @functools.wraps(callback)
        def seen(*given: Any, **fields: Any) -> Any:
            with lens.run(_named(role), takes_turns=serial):
                meeting = _meeting(notes, role.name)
                meeting()
                try:
                    return callback(*given, **fields)
                finally:
                    meeting()

        return seen

    def _handle_receive(self, message: Any) -> Any:
        lens = _lens_of(type(self)._rr_notes)
        with lens.run(f"the handler of a {type(message).__name__}", takes_turns=type(self).serial):
            return super()._handle_receive(message)


def seen_class(cls: type[Manager], notes: str) -> type[Manager]:
    """Return a subclass of a class of managers that is seen through the lens. It travels by value.

    Args:
        notes: the directory of the notes, to which races are appended.
    """
    names = {"_rr_notes": notes, "__module__": __name__, "__qualname__": f"seen.{cls.__qualname__}"}
    return type(cls)(cls.__name__, (SeenManager, cls), names)


def _named(role: Role) -> str:
    now = current()
    return f"the {role.name} callback of {now.name}" if now.resource_id else f"the {role.name} callback"


@functools.cache
def _lens_of(notes: str) -> RaceLens:
    """Return the lens of this process for the managers of one directory of notes."""

    def found(race: Race) -> None:
        append_note(notes, Note(os.getpid(), "race", text=str(race)))

    return RaceLens(found)


# -- callbacks that are to run at the same time ---------------------------------------------------------------------


class _Meeting:
    """A place where callbacks wait for each other twice: before they begin, and before they end."""

    def __init__(self, count: int) -> None:
        self._count, self._arrived = count, 0
        self._more = threading.Condition()

    def wait(self) -> None:
        """Wait until all have arrived, or for a moment: some may never come."""
        with self._more:
            self._arrived += 1
            target = -(-self._arrived // self._count) * self._count
            self._more.notify_all()
            self._more.wait_for(lambda: self._arrived >= target, _MEETING_S)


@functools.cache
def _meeting_of(notes: str, what: str) -> _Meeting:
    return _Meeting(int(what.split()[1]))


def _meeting(notes: str, role: str) -> Callable[[], None]:
    """Return what a callback does at its beginning and end: it waits for the others, if a scenario says so."""
    try:
        what = (Path(notes) / TOGETHER).read_text()
    except FileNotFoundError:
        return lambda: None
    return _meeting_of(notes, what).wait if what.split()[0] == role else lambda: None


# -- containers -----------------------------------------------------------------------------------------------------


class _SeenDict(dict[Any, Any]):
    """A dict that is an attribute of a manager. Reads and writes of its items are noted."""

    note: Callable[[Any, bool], None]

    def __getitem__(self, key: Any) -> Any:
        self.note(key, False)
        return super().__getitem__(key)

    def __contains__(self, key: object) -> bool:
        self.note(key, False)
        return super().__contains__(key)

    def get(self, key: Any, default: Any = None) -> Any:
        self.note(key, False)
        return super().get(key, default)

    def __setitem__(self, key: Any, value: Any) -> None:
        self.note(key, True)
        super().__setitem__(key, value)

    def __delitem__(self, key: Any) -> None:
        self.note(key, True)
        super().__delitem__(key)

    def __reduce__(self) -> Any:
        return dict, (dict(self),)


class _SeenSet(set[Any]):
    """A set that is an attribute of a manager. Questions for its items, and changes of them, are noted."""

    note: Callable[[Any, bool], None]

    def __contains__(self, item: object) -> bool:
        self.note(item, False)
        return super().__contains__(item)

    def add(self, item: Any) -> None:
        self.note(item, True)
        super().add(item)

    def remove(self, item: Any) -> None:
        self.note(item, True)
        super().remove(item)

    def __reduce__(self) -> Any:
        return set, (list(self),)


SEEN: dict[type[object], Callable[[Any], Any]] = {dict: _SeenDict, set: _SeenSet}


@functools.cache
def _fresh() -> int:
    """Return how many references a new dict has in __setattr__, if nothing else refers to it."""

    class Counted:
        count = 0

        def __setattr__(self, name: str, value: object) -> None:
            Counted.count = sys.getrefcount(value)

    Counted().value = {}
    return Counted.count
