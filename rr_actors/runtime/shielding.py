"""Shielding: how the main thread, where signal handlers run, has something done that must not end half way.

A handler that raises, as that of Ctrl-C does, ends whatever the main thread does at the next call or jump. What takes
several steps runs in a thread of its own instead, and the main thread waits. threading.Event does not do for that wait:
interrupted, it may raise RuntimeError in place of what the handler raised.
"""

from __future__ import annotations

import _thread
import contextvars
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Flag:
    """A flag that is set once, and threads that wait for it. An interrupted wait raises what the handler raised."""

    __slots__ = ("_lock", "is_set")

    def __init__(self) -> None:
        self.is_set = False
        self._lock = threading.Lock()
        self._lock.acquire()

    def set(self) -> None:
        """Wake all that wait. Setting it twice is nothing."""
        self.is_set = True
        self._open()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until it is set, at most `timeout_s` seconds; whether it is."""
        if not self.is_set:
            try:
                self._lock.acquire(timeout=-1 if timeout_s is None else max(0.0, timeout_s))
            finally:
                if self.is_set:
                    self._open()  # for the next that waits
        return self.is_set

    def _open(self) -> None:
        try:
            self._lock.release()
        except RuntimeError:
            return  # it is open


class _Work(Generic[T]):
    """A function that a thread of its own runs, unless it is given up before it begins."""

    def __init__(self, fn: Callable[[], T]) -> None:
        self._fn = fn
        self._context = contextvars.copy_context()
        self._lock = threading.Lock()
        self._begun = False
        self._given_up = False
        self.ended = Flag()
        self.values: list[T] = []
        self.error: BaseException | None = None
        self.has_no_thread = False

    def begin(self) -> None:
        """Start the thread: by one that nobody can interrupt, as Thread.start() takes several steps, too."""
        try:
            threading.Thread(target=self._run, name="rr-shielded", daemon=True).start()
        except RuntimeError:  # the system has no more threads
            self.has_no_thread = True
            self.ended.set()

    def _run(self) -> None:
        with self._lock:
            if self._given_up:
                return
            self._begun = True
        try:
            self.values.append(self._context.run(self._fn))
        except BaseException as error:  # raised again by the thread that waits
            self.error = error
        self.ended.set()

    def give_up(self) -> bool:
        """Do not begin any more; whether it has begun, and runs to its end."""
        with self._lock:
            self._given_up = True
            return self._begun


def is_interruptible() -> bool:
    """Whether signal handlers run in the calling thread."""
    return threading.get_ident() == threading.main_thread().ident


def shielded(fn: Callable[[], T], give_up: Callable[[], object] | None = None) -> T:
    """Run fn() where no signal handler can interrupt it, and return what it returns.

    Interrupted, it calls `give_up`, waits until fn has ended, or will never begin, and raises what the handler raised.
    Interrupted again meanwhile, it does not wait any more. In other threads than the main one it only calls fn; so it
    does if the system has no thread for it.

    Args:
        give_up: makes fn end soon; called while fn runs.
    """
    if not is_interruptible():
        return fn()
    work = _Work(fn)
    try:
        try:
            _thread.start_new_thread(work.begin, ())
        except RuntimeError:
            return fn()
        work.ended.wait()
    except BaseException:
        if work.give_up():
            if give_up is not None:
                give_up()
            work.ended.wait()
        raise
    if work.has_no_thread:
        return fn()
    if work.error is not None:
        raise work.error
    return work.values[0]
