"""Tests of managers start many systems whose managers are processes: their fork servers begin warm."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from warm_servers import WarmServers


@pytest.fixture(scope="module", autouse=True)
def _warm_fork_servers(warm: WarmServers) -> Iterator[None]:
    warm.is_on = True
    yield
    warm.is_on = False
