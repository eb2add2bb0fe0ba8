"""Cycles: what a call leaves to the garbage collector, with all that its caller had."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable


class _Kept:
    pass


def leaves_cycle(call: Callable[[], object]) -> bool:
    """Return whether something that the caller of a call had lives on after both have returned."""

    def caller() -> weakref.ref[_Kept]:
        kept = _Kept()
        call()
        return weakref.ref(kept)

    before = gc.isenabled()
    gc.disable()
    try:
        return caller()() is not None
    finally:
        if before:
            gc.enable()
