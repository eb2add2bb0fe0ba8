"""A fixture of tests that need the loop of a process and its workers."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from rr_actors.runtime.event_loop import Dispatcher


@pytest.fixture
def dispatcher() -> Iterator[Dispatcher]:
    """A dispatcher of the test's own."""
    dispatcher = Dispatcher()
    yield dispatcher
    dispatcher.close()
