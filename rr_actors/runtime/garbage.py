"""The garbage collector, switched off while a great many lasting objects are made."""

from __future__ import annotations

import contextlib
import gc
import threading
from collections.abc import Generator

_lock = threading.RLock()  # the collection within may run a finalizer that imports a name of the package
_asleep = 0
_was_on = False
_shared = False
_frozen = False

_MANY = 2_000  # objects that a block leaves: the usual collections go through less at little cost
_SELDOM = 16  # blocks that left many, in a row without a full collection
_blocks = 0
_collections = 0


@contextlib.contextmanager
def left_alone() -> Generator[None]:
    """Switch the collector off in this process until the end of the block, or of the last overlapping block.

    If the block leaves many objects, all count as old then, or are shared: otherwise the next collection would go
    through all of them. Python collects old objects when many have become old, but does not count those of such
    blocks. So after some of them without a full collection, the next block begins with one, which also frees what dead
    objects keep open.
    """
    global _asleep, _was_on
    with _lock:
        if _asleep == 0:
            _was_on = gc.isenabled()
            if _was_on:
                _look_at_the_old()
            gc.disable()
        _asleep += 1
    try:
        yield
    finally:
        with _lock:
            _asleep -= 1
            if _asleep == 0 and _was_on:
                if _shared or gc.get_count()[0] > _MANY:
                    _make_old()
                gc.enable()


def share() -> None:
    """Let forked processes share the memory of this one's present objects: no collection touches them."""
    global _shared
    gc.collect()
    gc.freeze()
    _shared = True


def _look_at_the_old() -> None:
    global _blocks, _collections
    if (collections := gc.get_stats()[-1]["collections"]) != _collections:
        _blocks, _collections = 0, collections
    elif _blocks >= _SELDOM:
        gc.collect()


def _make_old() -> None:
    global _blocks, _shared, _frozen
    _blocks += 1
    if _shared:  # the first block in a new child, which has no garbage of its own yet
        _shared = False
        gc.freeze()
        _frozen = True
    elif not _frozen and gc.get_freeze_count():  # objects that other code has frozen stay frozen
        _frozen = True  # the count goes through all of them each time: 10 ms for half a million objects
    elif not _frozen:
        gc.freeze()
        gc.unfreeze()
