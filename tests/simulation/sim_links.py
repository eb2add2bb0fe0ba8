"""Links of a simulated world: in order, until they are cut; then what was sent last may be lost, either way."""

from __future__ import annotations

from collections import deque
from typing import Any

TO_PROVIDER = 0
TO_CONSUMER = 1


class SimLink:
    """A consumer's link to a provider, with what is on its way. A cut link still brings what is left of that."""

    __slots__ = ("cut", "epoch", "ways")

    def __init__(self, epoch: int) -> None:
        self.epoch = epoch
        self.ways: tuple[deque[Any], deque[Any]] = (deque(), deque())
        self.cut = False

    def lose(self, kept: tuple[int, int]) -> None:
        """Cut it: of what is on its way, this many messages in each direction still arrive."""
        self.cut = True
        for way, keep in zip(self.ways, kept, strict=True):
            while len(way) > keep:
                way.pop()


class SimLine:
    """A direct line: one thread's own connection for one load, or for the unload of what that got."""

    __slots__ = ("broken", "consumer", "epoch", "left", "provider", "query_id", "run", "unloads", "ways")

    def __init__(self, query_id: str, consumer: str, provider: str, epoch: int, *, unloads: bool = False) -> None:
        self.query_id = query_id
        self.unloads = unloads
        self.consumer = consumer
        self.provider = provider
        self.epoch = epoch
        self.run = 0  # the provider's epoch
        self.ways: tuple[deque[Any], deque[Any]] = (deque(), deque())
        self.broken = False
        self.left = False  # by the thread
