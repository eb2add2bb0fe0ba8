"""What programs written for Pykka, and for multiprocessing, find when their actors are children in other processes."""

from __future__ import annotations

import multiprocessing
from typing import Any

import pytest

import rr_actors as rr
from conftest import Start


class Worker(rr.Actor):
    """Does what it is asked."""

    def __init__(self, *given: Any) -> None:
        self.given = given

    def on_receive(self, message: Any) -> Any:
        return message(self) if callable(message) else message


# -- what cannot leave its process -------------------------------------------------------------------------------------


def test_a_pipes_end_among_a_childs_arguments_is_refused_by_name(start: Start) -> None:
    here, there = multiprocessing.Pipe()
    with here, there:
        with pytest.raises(
            rr.StartFailed, match=r"args.*item 0: cannot pickle 'multiprocessing.connection.Connection'"
        ):
            start(rr.ChildSpec(Worker, "worker", args=(there,)))
        here.send("open")
        assert there.recv() == "open"
