"""The interpreter that everything shares: its lock, its signal handlers, its garbage collector."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator
from typing import TypeVar

# Turns: how long this process's loop waits for Python's lock while a callback computes.
#
# Whoever computes keeps the lock until another thread has waited for as long as the switch interval. The loop needs it
# once when something arrives, and again each time that a commit has let go of it (for each write): those waits are
# cut short, as the loop has only just given the lock away. Python's interval is the process's, so nothing is changed
# where the process is the user's.

A = TypeVar("A")

_SWITCH_S = 0.0003  # Python's own 5 ms would be felt in each load; less takes much of what the callback could compute
_AGAIN_S = 0.00001


class _Process:
    ours = False


def begin() -> None:
    """Make the interval short in this process, which is one of this package's own."""
    _Process.ours = True
    sys.setswitchinterval(_SWITCH_S)


def hurried(work: Callable[[A], object], argument: A) -> None:
    """Call work(argument), which lets go of the lock for a moment, and is to have it again soon. On the loop."""
    if not _Process.ours:
        work(argument)
        return
    before = sys.getswitchinterval()  # a callback may have set another
    sys.setswitchinterval(_AGAIN_S)
    try:
        work(argument)
    finally:
        sys.setswitchinterval(before)


# Interruptions: whether a Python signal handler may run in this thread between any two of its instructions.
#
# A handler may stop the system, or call anything else that waits for the loop: what the loop may have to wait for must
# not be held then. Only the main thread runs handlers, and by default there is none but that of Ctrl-C, which raises.

_SIGNALS = tuple(signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP})
_LOOK_AGAIN_S = 0.05  # looking takes some 40 us


class _Looked:
    until = 0.0
    found = False


class _Interruptions:
    main = threading.main_thread().ident


def possible() -> bool:
    """Whether a handler other than that of Ctrl-C may interrupt the calling thread; as it was lately."""
    if threading.get_ident() != _Interruptions.main:
        return False
    now = time.monotonic()
    if now >= _Looked.until:
        _Looked.found = any(_waits(signal.getsignal(number)) for number in _SIGNALS)
        _Looked.until = now + _LOOK_AGAIN_S
    return _Looked.found


def _waits(handler: object) -> bool:
    return callable(handler) and handler is not signal.default_int_handler


def _look_who_is_main() -> None:
    _Interruptions.main = threading.main_thread().ident  # in a forked child it is the thread that forked


os.register_at_fork(after_in_child=_look_who_is_main)


# The garbage collector, left alone while a great many objects are made that all stay.

_lock = threading.Lock()
_asleep = 0
_was_on = False
_shared = False

_SELDOM = 16  # blocks in a row
_blocks = 0
_collections = 0


@contextlib.contextmanager
def left_alone() -> Generator[None]:
    """Collect nothing in this process until the end of the block, or of the last of those that overlap.

    What there is then counts as old, which is collected seldom, or is shared: else the next collection would go through
    all of it. Python looks at the old when much has become old since it last did, and does not know of what was made
    so here: after some blocks without that it is collected before the next, with what it keeps open.
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
                _make_old()
                gc.enable()


def share() -> None:
    """Let processes that are forked from this one share the memory of what there is: no collection touches it."""
    global _shared
    gc.collect()
    gc.freeze()
    _shared = True


def _look_at_the_old() -> None:
    global _blocks, _collections
    _blocks += 1
    if (collections := gc.get_stats()[-1]["collections"]) != _collections:
        _blocks, _collections = 0, collections
    elif _blocks >= _SELDOM:
        gc.collect()


def _make_old() -> None:
    global _shared
    if _shared:  # the first time in a child, which has only begun: nothing of its own is to be collected yet
        _shared = False
        gc.freeze()
    elif not gc.get_freeze_count():  # what somebody has frozen is to stay so
        gc.freeze()
        gc.unfreeze()
