"""Parameters of which `make test` runs a few, and `make test-slow` the others."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def few_now(few: Iterable[object], others: Iterable[object]) -> list[Any]:
    """Return all of them for pytest.mark.parametrize; the others are marked as slow."""
    return [*few, *(pytest.param(other, marks=pytest.mark.slow) for other in others)]
