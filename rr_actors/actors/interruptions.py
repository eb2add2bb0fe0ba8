"""Interruptions: whether a Python signal handler may run in this thread between any two of its instructions.

A handler may stop the system, or call anything else that waits for the loop: what the loop may have to wait for must
not be held then. Only the main thread runs handlers, and by default there is none but that of Ctrl-C, which raises.
"""

from __future__ import annotations

import os
import signal
import threading
import time

_SIGNALS = tuple(signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP})
_LOOK_AGAIN_S = 0.05  # looking takes some 40 us


class _Looked:
    until = 0.0
    found = False


class _Process:
    main = threading.main_thread().ident


def possible() -> bool:
    """Whether a handler other than that of Ctrl-C may interrupt the calling thread; as it was lately."""
    if threading.get_ident() != _Process.main:
        return False
    now = time.monotonic()
    if now >= _Looked.until:
        _Looked.found = any(_waits(signal.getsignal(number)) for number in _SIGNALS)
        _Looked.until = now + _LOOK_AGAIN_S
    return _Looked.found


def _waits(handler: object) -> bool:
    return callable(handler) and handler is not signal.default_int_handler


def _look_who_is_main() -> None:
    _Process.main = threading.main_thread().ident  # in a forked child it is the thread that forked


os.register_at_fork(after_in_child=_look_who_is_main)
