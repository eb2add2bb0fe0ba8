"""A target: something that takes bytes, what they look like when they are good, and how to make them a little worse."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec

Feed = Callable[[bytes], None]
"""Gives the target one input; raises (AssertionError, whatever comes out) if a promise is broken."""


class Target(msgspec.Struct, frozen=True):
    """One of them.

    Attributes:
        about: what is fed, in a few words.
        prepare: makes the Feed; the directory is its own.
        seeds: good inputs, made by the program itself.
        mutate: a change that keeps the input well-formed, where bytes changed at random would hardly ever be.
        words: what inputs are made of.
        longest: bytes that an input may have.
        end: gives back what `prepare` has begun, given its Feed; a process that ends has no need of it.
    """

    about: str
    prepare: Callable[[Path], Feed]
    seeds: Callable[[], list[bytes]]
    mutate: Callable[[bytes, random.Random], bytes] | None = None
    words: tuple[bytes, ...] = ()
    longest: int = 2048
    end: Callable[[Feed], None] = lambda _feed: None


def pieces(data: bytes, seed: int) -> Iterator[bytes]:
    """Cut a stream as a network might: 0 leaves it whole, 1 gives single bytes."""
    if seed < 2:
        step = 1 if seed else max(len(data), 1)
        yield from (data[at : at + step] for at in range(0, len(data), step))
        return
    chance = random.Random(seed)
    at = 0
    while at < len(data):
        size = chance.choice((1, 3, 4, 5, 11, 64, 500))
        yield data[at : at + size]
        at += size
