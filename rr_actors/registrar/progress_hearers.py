"""Hearers: a callable of the caller, or a bar on the terminal, hears how far a load has come.

The thread that waits calls it: with load() the calling thread, with load_async() the task's event loop, with
block=False a worker. A slow one hears only the newest report. One that raises is logged, and not called again.
"""

from __future__ import annotations

import asyncio
import contextlib
import contextvars
import queue
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol, cast

import msgspec

from rr_actors.base.checks import check_takes, examined, needing
from rr_actors.base.errors import Unavailable, UsageError, shown
from rr_actors.base.reporting.log import Log
from rr_actors.registrar.engine.progress import Progress
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.runtime.callback_errors import Raised, described, log_raised
from rr_actors.runtime.workers import is_async

logger = Log("rr_actors.registrar")

ProgressCallback = Callable[[Progress], object]
ProgressWanted = bool | ProgressCallback
"""What load() takes as `progress`: a callable, True for a bar, or False."""


class Hearer(msgspec.Struct):
    """The hearer of one load, until it is closed.

    Attributes:
        actor: the registrar that loads.
        callback: the callable, called with each report until it has raised, or the load has ended.
        end: called once, when the load has ended.
    """

    actor: RegistrarActor
    callback: ProgressCallback | None
    end: Callable[[], None] | None = None

    def hear(self, progress: Progress) -> None:
        """Pass a report on to the callable, in this thread."""
        callback = self.callback
        if callback is None:
            return
        try:
            callback(progress)
        except Exception as error:
            if isinstance(error, Raised) and not isinstance(error.error, Exception):
                raise error.error from None  # such as KeyboardInterrupt: it is for the caller
            self.callback = None
            self.actor.callback_failures += 1
            text = "%s: the progress callable of a load of %s raised, and is not called again"
            log_raised(logger, error, text, self.actor.name, progress.server)

    def close(self) -> None:
        """Stop calling the callable, and call `end`: the load has ended."""
        self.callback = None
        end, self.end = self.end, None
        if end is not None:
            end()


def hearer_of(progress: object, actor: RegistrarActor) -> Hearer | None:
    """Return the hearer that load()'s argument `progress` asks for; None if it asks for none.

    Raises:
        UsageError: `progress` is neither a bool nor a plain callable.
        MissingDependency: it is True, and rich is not installed.
    """
    if progress is False or progress is None:
        return None
    if progress is True:
        with needing("load: progress=True", "progress", ", or give a callable: load(..., progress=print)"):
            from rr_actors.registrar.progress_bar import Bar  # `import rr_actors` works without it
        bar = Bar()
        return Hearer(actor, bar.show, bar.close)
    if not callable(progress):
        raise UsageError(f"load: progress: expected a callable or a bool, got {shown(progress)}")
    callback = cast("ProgressCallback", progress)
    hearer = Hearer(actor, described(callback, "load: progress"))
    if is_async(callback):
        raise UsageError(f"load: progress: expected a plain function, got an async one ({shown(progress)})")
    with examined("load: progress"):
        check_takes(callback, ("progress",), "load", "progress")
    return hearer


# -- three ways to wait, and to hear meanwhile -------------------------------------------------------------------------


class Hearing(Protocol):
    """What the loop calls for a load of which a caller hears the progress. It must be quick."""

    def progressed(self, progress: Progress) -> None:
        """Pass on a report. On the loop."""
        ...

    def ended(self) -> None:
        """Note that the load has ended. On the loop."""
        ...


class _Newest:
    """The newest report that a hearer has not heard: of many, only one waits. The loop puts, one other thread takes."""

    def __init__(self) -> None:
        self._report: deque[Progress] = deque(maxlen=1)
        self._planned = False

    def put(self, progress: Progress) -> bool:
        """Keep the report, and return whether a take() has to be planned for it."""
        self._report.append(progress)  # first: a take() that is planned already will find it
        if self._planned:
            return False
        self._planned = True
        return True

    def take(self) -> Progress | None:
        """Return the report; None if there is none."""
        self._planned = False
        return self._report.pop() if self._report else None


class HearsHere:
    """The thread that waits for the load calls the hearer meanwhile."""

    def __init__(self, hearer: Hearer) -> None:
        self._hearer = hearer
        self._newest = _Newest()
        self._woken: queue.SimpleQueue[bool] = queue.SimpleQueue()  # whether the load has ended

    def close(self) -> None:
        """Close the hearer, as the thread waits no more."""
        self._hearer.close()

    def ended(self) -> None:
        """Wake the thread that waits. On the loop."""
        self._woken.put(True)

    def progressed(self, progress: Progress) -> None:
        """Pass a report to the waiting thread. On the loop."""
        if self._newest.put(progress):
            self._woken.put(False)

    def hear_within(self, timeout_s: float | None) -> bool:
        """Wait, call the hearer meanwhile, and return whether the load has ended."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            try:
                ended = self._woken.get(timeout=None if deadline is None else max(0.0, deadline - time.monotonic()))
                while not (ended or self._woken.empty()):
                    ended = self._woken.get()
            except queue.Empty:
                return False
            if (newest := self._newest.take()) is not None:
                self._hearer.hear(newest)
            if ended:
                return True
            if deadline is not None and time.monotonic() >= deadline:  # reports come faster than they are heard
                return False


class HearsOnThisLoop:
    """The event loop that runs here calls the hearer, in the caller's context. The task closes the hearer."""

    def __init__(self, hearer: Hearer) -> None:
        self._hearer = hearer
        self._newest = _Newest()
        self._loop, self._context = asyncio.get_running_loop(), contextvars.copy_context()

    def progressed(self, progress: Progress) -> None:
        """Have the event loop call the hearer with the newest report."""
        if self._newest.put(progress):
            with contextlib.suppress(RuntimeError):  # the event loop is closed, with the task that waited
                self._loop.call_soon_threadsafe(self._hear, context=self._context)

    def _hear(self) -> None:
        if (newest := self._newest.take()) is not None:
            self._hearer.hear(newest)

    def ended(self) -> None:
        """Do nothing: the task closes the hearer before it goes on."""


class HearsInWorkers:
    """A worker calls the hearer, in the caller's context, one call at a time."""

    def __init__(self, hearer: Hearer, query_id: str) -> None:
        self._hearer = hearer
        self._workers = hearer.actor.workers
        self._key = ("progress", query_id)
        self._context = contextvars.copy_context()
        self._newest = _Newest()

    def progressed(self, progress: Progress) -> None:
        """Have a worker call the hearer with the newest report."""
        if not self._newest.put(progress):
            return
        try:
            self._workers.serial(self._key, self._hear, context=self._context.copy())
        except Unavailable as error:  # too many threads are running
            self._newest.take()
            logger.debug("%s: a report of progress was not heard: %s", self._hearer.actor.name, error)

    def _hear(self) -> None:
        newest, audience = self._newest.take(), self._hearer.actor.audience
        if newest is not None and audience is not None and audience.hears(self._key[1]):
            self._hearer.hear(newest)

    def ended(self) -> None:
        """Have a worker close the hearer, after the calls that wait."""
        with contextlib.suppress(Unavailable):  # the registrar's workers have ended, and the bar with them
            self._workers.serial(self._key, self._hearer.close)
