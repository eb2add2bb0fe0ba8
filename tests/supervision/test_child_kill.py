"""A child of which_children() can be killed, and has the id of the process that answers."""

from __future__ import annotations

from pathlib import Path

import pytest

import rr_actors as rr
from support import LIMIT_S, eventually


class Lamps(rr.Manager):
    @rr.server("lamp", recovery="keep")
    def switch_on(self, name: str) -> str:
        return name


def test_a_killed_child_is_started_again_and_has_the_pid_of_the_process_that_answers(state_dir: Path) -> None:
    children = rr.Supervisor([rr.ChildSpec(Lamps, id="lamps")], id="root", max_restarts=100)
    with rr.System(children, state_dir=state_dir) as system:
        app, here = system.open_registrar("app"), system.supervisor()
        for number in range(10):
            before = here.which_child("lamps")
            assert before.kill()
            app.load("lamps/lamp", str(number), timeout_s=LIMIT_S)  # the new process answers
            after = here.which_child("lamps").pid
            assert after is not None
            assert after != before.pid
            eventually(lambda: here.which_child("lamps").state == "running")


def test_a_child_that_does_not_run_is_not_killed(state_dir: Path) -> None:
    with rr.System([rr.ChildSpec(Lamps, id="lamps")], state_dir=state_dir) as system:
        system.supervisor().terminate_child("lamps")

        child = system.supervisor().which_child("lamps")

        assert child.pid is None
        assert not child.kill()


def test_a_child_in_this_process_cannot_be_killed(state_dir: Path) -> None:
    with rr.System([rr.ChildSpec(Lamps, id="lamps", placement="thread")], state_dir=state_dir) as system:
        child = system.supervisor().which_child("lamps")

        with pytest.raises(rr.UsageError, match="no process of its own"):
            child.kill()
