"""system.wait_for(), connection.wait_for() and ref.wait_running(): no test and no program has to poll."""

from __future__ import annotations

from collections.abc import Callable

import pytest

import rr_actors as rr

Start = Callable[..., rr.System]
LIMIT_S = 30.0


class Cameras(rr.Manager):
    def shoot(self) -> int:
        return 1

    @rr.server("camera", recovery="keep")
    def open_camera(self, name: str) -> str:
        return name


class Ends(rr.Actor):
    def on_receive(self, message: object) -> None:
        self.stop()


def test_after_a_kill_the_child_is_waited_for(rr_system: Start) -> None:
    system = rr_system(rr.ChildSpec(Cameras, id="cameras"))
    cameras = system.ref("cameras")
    for wait in (cameras.wait_running, lambda: system.wait_for("cameras")):
        before = cameras.pid
        assert cameras.kill()
        wait()
        assert cameras.proxy().shoot().get(timeout=LIMIT_S) == 1  # at once
        assert cameras.pid != before


def test_a_child_and_a_resource_are_waited_for_by_their_states(rr_system: Start) -> None:
    task = rr.ChildSpec(Ends, id="task", restart="transient", placement="thread")
    system = rr_system([rr.ChildSpec(Cameras, id="cameras", placement="thread"), task])
    assert system.wait_for("cameras") == "running"
    system.ref("task").tell("do it, and end")
    assert system.wait_for("task", "stopped") == "stopped"
    with rr.connect(system.state_dir) as connection:
        query = system.open_registrar("app").load(Cameras.open_camera, "front")
        assert system.wait_for('cameras/camera "front"') in ("OK", "loaded")
        assert connection.wait_for('cameras/camera "front"', "loaded") in ("OK", "loaded")
        query.unload()
        assert connection.wait_for('cameras/camera "front"', "gone") == "gone"


def test_what_does_not_come_in_time_says_what_there_is(rr_system: Start) -> None:
    task = rr.ChildSpec(Ends, id="task", restart="temporary", placement="thread")
    system = rr_system([rr.ChildSpec(Cameras, id="cameras", placement="thread"), task])
    with pytest.raises(rr.Unavailable, match=r"^cameras: expected stopped within 0.05 s, it is running$"):
        system.wait_for("cameras", "stopped", timeout_s=0.05)
    with pytest.raises(rr.UsageError, match=r"state: expected running, .*, got 'ready'"):
        system.wait_for("cameras", "ready")
    ref = system.ref("task")
    ref.stop()
    with pytest.raises(rr.ActorUnavailable, match=r"root/task: expected to run within 0.05 s, and does not"):
        ref.wait_running(timeout_s=0.05)
    with pytest.raises(rr.UsageError, match="timeout_s"):
        ref.wait_running(timeout_s=-1)


def test_a_connection_whose_system_has_ended_waits_for_none(rr_system: Start) -> None:
    system = rr_system(rr.ChildSpec(Cameras, id="cameras", placement="thread"))
    with rr.connect(system.state_dir) as connection:
        system.stop()
        assert connection.wait_for("cameras", "gone") == "gone"
        with pytest.raises(rr.NotRunning, match="has ended: connect to its next run"):
            connection.wait_for("cameras", timeout_s=None)


def test_a_connection_that_is_closed_does_not_say_that_all_is_gone(rr_system: Start) -> None:
    system = rr_system(rr.ChildSpec(Cameras, id="cameras", placement="thread"))
    connection = rr.connect(system.state_dir)
    connection.close()
    for state in ("", "gone"):
        with pytest.raises(rr.NotRunning, match="the connection is closed"):
            connection.wait_for("cameras", state, timeout_s=None)


def test_a_time_limit_by_another_name_says_which_is_meant(rr_system: Start) -> None:
    app = rr_system(rr.ChildSpec(Cameras, id="cameras", placement="thread")).open_registrar("app")
    with pytest.raises(TypeError, match="unexpected keyword argument 'timeout'; did you mean 'timeout_s'"):
        app.load(Cameras.open_camera, "front", timeout=3)  # pyright: ignore[reportCallIssue]


def test_a_system_without_a_console_says_so(rr_system: Start) -> None:
    system = rr_system([], config=rr.SystemConfig(console=False))
    with pytest.raises(rr.UsageError, match=r"SystemConfig\(console=False\)"):
        system.wait_for("cameras")
