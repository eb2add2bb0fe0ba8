"""Hearers: a callable of the caller, or a bar on the terminal, hears how far a load has come.

The thread that waits calls it: with load() the calling thread, with load_async() the task's event loop, with
block=False a worker. A slow one hears only the newest report. One that raises is logged, and not called again.
"""

from __future__ import annotations

import asyncio
import contextvars
import logging
import queue
import time
from collections import deque
from collections.abc import Callable
from typing import cast

import msgspec

from rr_actors.base.checks import check_takes, examined, needing
from rr_actors.base.errors import RrError, Unavailable, UsageError, shown
from rr_actors.registrar.engine.progress import Progress
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.model.rows import Held
from rr_actors.runtime.callback_errors import Raised, described, log_raised
from rr_actors.runtime.workers import is_async

logger = logging.getLogger("rr_actors.registrar")

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
        UsageError: `progress` is neither a bool nor a plain callable; or it is True, and rich is not installed.
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


class HearingWait:
    """The wait of one thread for a load. The thread calls its hearer meanwhile. Otherwise as loads.Wait."""

    def __init__(self, hearer: Hearer) -> None:
        self._hearer = hearer
        self._arrived: queue.SimpleQueue[Progress | None] = queue.SimpleQueue()
        self.done = False
        self.error: BaseException | None = None

    def ended(self, _held: Held | None, error: RrError | None) -> None:
        """Note how the load ended, and wake the thread that waits. On the loop."""
        self.error = error
        self.done = True
        self._arrived.put(None)

    def progressed(self, progress: Progress) -> None:
        """Pass a report to the waiting thread. On the loop."""
        self._arrived.put(progress)

    def done_within(self, timeout_s: float | None) -> bool:
        """Wait, call the hearer meanwhile, and return whether the load has ended."""
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            try:
                arrived = self._arrived.get(timeout=None if deadline is None else max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                return False
            newest, ended = arrived, arrived is None
            while not ended and not self._arrived.empty():
                arrived = self._arrived.get()
                newest, ended = arrived or newest, arrived is None
            if newest is not None:
                self._hearer.hear(newest)
            if ended:
                return True
            if deadline is not None and time.monotonic() >= deadline:  # reports come faster than they are heard
                return False


def on_this_loop(hearer: Hearer) -> Callable[[Progress], None]:
    """Return a listener that has the hearer called on the event loop that runs here, in the caller's context."""
    loop, context = asyncio.get_running_loop(), contextvars.copy_context()

    def listener(progress: Progress) -> None:
        try:
            loop.call_soon_threadsafe(hearer.hear, progress, context=context)
        except RuntimeError:  # the event loop is closed, with the task that waited
            return

    return listener


def in_workers(hearer: Hearer, actor: RegistrarActor, query_id: str) -> Callable[[Progress], None]:
    """Return a listener that has the hearer called in a worker, in the caller's context, one call at a time."""
    context = contextvars.copy_context()
    newest: deque[Progress] = deque(maxlen=1)

    def hear() -> None:
        if newest:
            hearer.hear(newest.pop())

    def listener(progress: Progress) -> None:
        newest.append(progress)
        try:
            actor.workers.serial(("progress", query_id), hear, context=context.copy())
        except Unavailable as error:  # too many threads are running
            logger.debug("%s: a report of progress was not heard: %s", actor.name, error)

    return listener
