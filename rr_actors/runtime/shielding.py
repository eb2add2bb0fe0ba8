"""Shielding: work of several steps that must not be interrupted half way, called from the main thread.

A signal handler that raises, as that of Ctrl-C does, interrupts the main thread at its next call or jump. So such work
runs in a thread of its own, and the main thread waits. threading.Event is not good enough for that wait: interrupted,
it may raise RuntimeError in place of the handler's error.
"""

from __future__ import annotations

import _thread
import contextvars
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Flag:
    """A flag that is set once, and for which threads wait. An interrupted wait raises the handler's error."""

    __slots__ = ("_lock", "is_set")

    def __init__(self) -> None:
        self.is_set = False
        self._lock = threading.Lock()
        self._lock.acquire()

    def set(self) -> None:
        """Set the flag, and wake all waiting threads. A second call does nothing."""
        self.is_set = True
        self._open()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the flag is set, at most `timeout_s` seconds; return whether it is set."""
        if not self.is_set:
            try:
                self._lock.acquire(timeout=-1 if timeout_s is None else max(0.0, timeout_s))
            finally:
                if self.is_set:
                    self._open()  # for the next waiting thread
        return self.is_set

    def _open(self) -> None:
        try:
            self._lock.release()
        except RuntimeError:
            return  # it is open already


class _Work(Generic[T]):
    """A function that runs in a thread of its own, unless it is given up before it begins."""

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
        """Start the thread. Call this where no signal handler runs: Thread.start() takes several steps, too."""
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
        except BaseException as error:  # raised again in the waiting thread
            self.error = error
        self.ended.set()

    def give_up(self) -> bool:
        """Prevent the begin; return whether the function has begun already, and so runs to its end."""
        with self._lock:
            self._given_up = True
            return self._begun


def is_interruptible() -> bool:
    """Return whether signal handlers run in the calling thread."""
    return threading.get_ident() == threading.main_thread().ident


def shielded(fn: Callable[[], T], give_up: Callable[[], object] | None = None) -> T:
    """Run fn() in a thread that no signal handler can interrupt, and return its result.

    If the waiting main thread is interrupted, it calls `give_up`, waits for the end of fn if fn has begun, and raises
    the handler's error. A second interrupt ends that wait. Other threads than the main one, and all threads if the
    system gives no new thread, call fn() directly.

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
