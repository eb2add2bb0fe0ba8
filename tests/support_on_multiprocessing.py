"""The manager of tests/system/test_on_multiprocessing.py, in a module that its process imports without the tests."""

from __future__ import annotations

import multiprocessing
from typing import Any

import rr_actors as rr


class Known(rr.Manager):
    """Says what multiprocessing knows of its process."""

    def __init__(self, given: Any = None) -> None:
        self._given = given

    def on_receive(self, message: Any) -> Any:
        own, parent = multiprocessing.current_process(), multiprocessing.parent_process()
        assert parent is not None
        return own.name, own.pid, own.is_alive(), parent.name, parent.pid, parent.is_alive()
