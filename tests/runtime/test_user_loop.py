"""The second event loop of a process, on which users' coroutines run."""

from __future__ import annotations

import asyncio
import contextvars
from typing import Any

import pytest

from rr_actors.base.errors import Unavailable
from rr_actors.runtime.user_loop import UserLoop
from support import Calls


def test_a_coroutine_is_ended_by_the_stop_of_its_loop_or_refused_and_never_forgotten() -> None:
    loop = UserLoop(Calls(), Calls())
    ended = Calls()

    async def forever() -> None:
        await asyncio.Event().wait()

    def done(_result: Any, error: BaseException | None) -> None:
        ended(type(error))

    for _ in range(50):
        loop.start(forever(), done, contextvars.copy_context())
    loop.stop()
    late = forever()
    with pytest.raises(Unavailable, match="is stopping"):
        loop.start(late, done, contextvars.copy_context())
    late.close()
    loop.stop()
    loop.thread.join()
    assert list(ended) == [asyncio.CancelledError] * 50
