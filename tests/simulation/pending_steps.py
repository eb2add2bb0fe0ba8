"""Todo: what can happen next in a simulated world, to be drawn from in constant time."""

from __future__ import annotations

from typing import Any

Key = tuple[Any, ...]


class Todo:
    """A set of keys, each with a place, drawn by number. Their order depends on the history alone."""

    __slots__ = ("_place", "keys")

    def __init__(self) -> None:
        self.keys: list[Key] = []
        self._place: dict[Key, int] = {}

    def __contains__(self, key: Key) -> bool:
        return key in self._place

    def __len__(self) -> int:
        return len(self.keys)

    def add(self, key: Key) -> None:
        """Put it in, unless it is."""
        if key not in self._place:
            self._place[key] = len(self.keys)
            self.keys.append(key)

    def discard(self, key: Key) -> None:
        """Take it out, if it is in."""
        place = self._place.pop(key, None)
        if place is not None:
            last = self.keys.pop()
            if last is not key and last != key:
                self.keys[place] = last
                self._place[last] = place
