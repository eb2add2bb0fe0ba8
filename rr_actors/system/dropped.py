"""Dropped systems: they run, but nothing refers to them any more. They warn, as an open socket does, and are stopped.

A system is dropped where its last reference goes, or where the garbage collector runs. Nothing may wait at such a
point, so the system's loop stops the system in the background.
"""

from __future__ import annotations

import asyncio
import concurrent.futures
import logging
import warnings
import weakref
from collections.abc import Callable, Coroutine
from concurrent.futures import Future
from pathlib import Path
from typing import Any

from rr_actors.runtime import interpreter
from rr_actors.runtime.event_loop import current

logger = logging.getLogger("rr_actors")

_stopping: dict[str, tuple[Future[None], float]] = {}
"""The future that is done when a system has stopped, and its limit in seconds, by the real state directory."""


def weakly(method: Callable[..., object]) -> Callable[..., None]:
    """Return a callback that does not keep the method's object alive; without the object it does nothing."""
    reference = weakref.WeakMethod(method)

    def call(*args: Any) -> None:
        if (found := reference()) is not None:
            found(*args)

    return call


def stop(what: str, state_dir: Path, dropped: object, stopping: Coroutine[Any, Any, None], limit_s: float) -> None:
    """Warn that `what` was dropped, and run the coroutine `stopping` on the loop. Do not wait for it.

    Args:
        dropped: the dropped object, for the warning.
        limit_s: seconds that `stopping` may take. A program that exits meanwhile waits for so long.
    """
    text = f"{what} was dropped without stop(): call stop(), or use it as a context manager"
    warnings.warn(text, ResourceWarning, source=dropped, stacklevel=3)

    async def stopped() -> None:
        try:
            await stopping
        except Exception:
            logger.exception("%s: stopping it", what)

    dispatcher = current()
    if dispatcher is None or dispatcher.closed:  # the interpreter exits: what the system has started ends with it
        stopping.close()
        return
    logger.warning("%s; it is being stopped", text)
    running = stopped()
    try:
        _stopping[str(state_dir)] = asyncio.run_coroutine_threadsafe(running, dispatcher.loop), limit_s
    except RuntimeError:  # the loop has ended just now
        running.close()
        stopping.close()


def wait_stopped(state_dir: Path, timeout_s: float) -> None:
    """Wait until the dropped system of this state directory has stopped, at most `timeout_s` seconds."""
    if (stopping := _stopping.pop(str(state_dir), None)) is not None:
        concurrent.futures.wait(stopping[:1], timeout_s)


def _wait_at_exit() -> None:
    # This runs before the loop is closed, which would cancel the stops half way.
    for state_dir, (_, limit_s) in list(_stopping.items()):
        wait_stopped(Path(state_dir), limit_s)


interpreter.at_exit(_wait_at_exit)
