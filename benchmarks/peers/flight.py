"""How contestants time what they do together, and how long they are away."""

from __future__ import annotations

import time
from collections.abc import Callable

_PATIENCE_S = 20.0


def seconds_of(operation: Callable[[int], object], times: int) -> float:
    """Seconds that operation(times) takes."""
    start = time.perf_counter()
    operation(times)
    return time.perf_counter() - start


def seconds_away(kill: Callable[[], object], call: Callable[[], object]) -> float:
    """Seconds from `kill` to the first `call` that does not raise; called again at once when it does.

    Raises:
        TimeoutError: none for 20 s.
    """
    start = time.perf_counter()
    kill()
    while True:
        try:
            call()
        except Exception as error:
            if time.perf_counter() - start > _PATIENCE_S:
                raise TimeoutError(f"no answer for {_PATIENCE_S:g} s after SIGKILL: {error!r}") from error
            time.sleep(0.001)
        else:
            return time.perf_counter() - start
