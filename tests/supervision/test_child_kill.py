"""A child of which_children() can be killed, and has the id of the process that answers."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors.actors.remote.hub import hub
from support import LIMIT_S, eventually, wait_gone


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


def test_a_child_that_has_a_pid_is_killed_though_its_supervisor_has_not_noted_the_start(state_dir: Path) -> None:
    children = rr.Supervisor([rr.ChildSpec(Lamps, id="lamps")], id="root", max_restarts=100)
    with rr.System(children, state_dir=state_dir) as system:
        here, before = system.supervisor(), 0
        for _ in range(10):
            (listed,) = eventually(lambda pid=before: [one for one in here.which_children() if (one.pid or pid) != pid])
            assert listed.kill()
            before = listed.pid or 0
            wait_gone(before)


def test_the_process_of_a_child_that_shares_it_is_no_process_of_its_own(state_dir: Path) -> None:
    with rr.System([rr.ChildSpec(Lamps, id="lamps", placement="thread")], state_dir=state_dir):
        process = hub("root/lamps")
        assert process is not None
        assert not process.kill_before_up("root/lamps", os.getpid())


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
