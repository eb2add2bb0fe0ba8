"""Supervision performed: real processes, real signals, and actors placed as threads alike."""

from __future__ import annotations

import gc
import logging
import os
import random
import signal
import statistics
import subprocess
import sys
import textwrap
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pykka
import pytest

import rr_actors as rr
from rr_actors.base.config import SystemConfig
from rr_actors.base.errors import (
    ActorUnavailable,
    AlreadyPresent,
    AlreadyStarted,
    ChildRestarting,
    ChildRunning,
    InvalidSpec,
    MailboxFull,
    NotFound,
    NotSerializable,
    RestartIntensityExceeded,
    StartFailed,
    Unavailable,
    UsageError,
)
from rr_actors.runtime.workers import Workers
from rr_actors.supervision.core.specs import Backoff, ChildSpec, Supervisor
from rr_actors.supervision.event_history import History, Record
from rr_actors.wire.name_service import NameEntry, Presence, actor_key, open_state_dir, registrar_key
from support import WARM, Gate, eventually, lives, quickly, wait_gone
from support_supervision import Idle, Log, SlowToRegister, StuckManager, Threaded, Tree, Worker, let_go

Plant = Callable[..., Tree]
both = pytest.mark.parametrize("placement", ["process", "thread"])


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    """Start a tree, stopped after the test."""
    trees: list[Tree] = []

    def start(*children: Any, **options: Any) -> Tree:
        tree = Tree(tmp_path / "state", *children, **options)
        trees.append(tree)
        tree.start()
        return tree

    let_go.clear()
    yield start
    let_go.set()
    for tree in trees:
        if tree.hosted is not None:
            tree.stop()
        tree.close()
    assert {child.pid for child in psutil.Process().children(recursive=True)} == WARM


@pytest.fixture
def log(tmp_path: Path) -> Log:
    return Log(tmp_path / "log")


def worker(
    log: Log, id: str, placement: Any = "process", /, on_start: str = "", on_stop: str = "", **spec: Any
) -> ChildSpec:
    return ChildSpec(Worker, id=id, args=(str(log.path), id, on_start, on_stop), placement=placement, **spec)


def run_after(tree: Tree, path: str, run: int) -> int:
    """The number of the child's present run, once there is one after `run`."""
    return eventually(
        lambda: tree.run(path) > run and tree.child(path).state == "running" and tree.run(path), what=f"{path} up again"
    )


def reasons(tree: Tree, path: str) -> list[str]:
    above = path.rpartition("/")[0]
    return [r.reason for r in tree.supervisor(above).history() if r.path == path and r.event == "exited"]


# -- start and stop --------------------------------------------------------------------------------------------------


@both
def test_children_start_in_order_and_stop_in_reverse(plant: Plant, log: Log, placement: str) -> None:
    tree = plant(*(worker(log, id, placement) for id in "abc"))
    assert log.lines() == ["start a", "start b", "start c"]
    assert [child.id for child in tree.supervisor().which_children()] == ["c", "b", "a"]
    tree.stop()
    assert log.lines()[3:] == ["stop c", "stop b", "stop a"]


def test_a_process_child_lives_in_a_process_of_its_own_and_a_thread_child_here(plant: Plant, log: Log) -> None:
    tree = plant(worker(log, "a"), worker(log, "b", "thread"))
    assert tree.ask("root/a", "pid") == tree.child("root/a").pid != os.getpid()
    assert tree.ask("root/b", "pid") == tree.child("root/b").pid == os.getpid()


def test_a_class_made_in_a_test_function_can_be_a_child(plant: Plant) -> None:
    class Local(Worker):
        def answer(self) -> str:
            return f"from {os.getpid()}"

    tree = plant(ChildSpec(Local, id="local"))
    assert tree.ask("root/local", "answer") == f"from {tree.child('root/local').pid}"


@both
def test_a_child_that_fails_to_start_stops_those_before_it_and_is_named(plant: Plant, log: Log, placement: str) -> None:
    with pytest.raises(StartFailed, match=r"root/b.*ValueError: as it was told") as raised:
        plant(worker(log, "a", placement), worker(log, "b", placement, on_start="fail"), worker(log, "c", placement))
    assert log.lines() == ["start a", "start b", "stop a"]
    assert isinstance(raised.value.__cause__, ValueError)


def test_the_error_of_a_failed_start_has_the_traceback_of_the_other_process(plant: Plant, log: Log) -> None:
    with pytest.raises(StartFailed) as raised:
        plant(worker(log, "a", on_start="fail"))
    notes = "".join(getattr(raised.value.__cause__, "__notes__", []))
    assert "In the process of root/a" in notes
    assert "raise ValueError(text)" in notes


@both
def test_a_child_that_is_not_ready_in_time_fails_to_start(plant: Plant, log: Log, placement: str) -> None:
    began = time.monotonic()
    with pytest.raises(StartFailed, match=r"root/a.*0\.3 s \(start_timeout_s\)"):
        plant(worker(log, "a", placement, on_start="hang", start_timeout_s=0.3))
    assert time.monotonic() - began < 10


def test_the_system_limits_the_time_to_become_ready(plant: Plant, log: Log) -> None:
    with pytest.raises(StartFailed, match=r"start_timeout_s"):
        plant(worker(log, "a", on_start="hang"), config=SystemConfig(start_timeout_s=0.3))


@both
def test_a_child_may_ignore_its_start(plant: Plant, log: Log, placement: str) -> None:
    tree = plant(worker(log, "a", placement, on_start="ignore"), worker(log, "b", placement))
    assert tree.child("root/a").state == "stopped"
    assert tree.child("root/b").state == "running"
    assert tree.supervisor().start_child(worker(log, "c", placement, on_start="ignore")) is None


def test_arguments_that_cannot_be_pickled_are_named(plant: Plant) -> None:
    with pytest.raises(StartFailed) as raised:
        plant(ChildSpec(Worker, id="a", args=(threading.Lock(),)))
    assert isinstance(raised.value.__cause__, NotSerializable)
    assert "ChildSpec of root/a" in str(raised.value)


@both
def test_a_class_that_is_no_actor_is_an_invalid_spec(plant: Plant, placement: Any) -> None:
    with pytest.raises(StartFailed, match=r"actor_class_or_manager: expected .*pykka\.ThreadingActor") as raised:
        plant(ChildSpec(dict, id="a", placement=placement))
    assert isinstance(raised.value.__cause__, InvalidSpec)


@both
def test_an_actor_that_declares_servers_and_is_no_manager_is_an_invalid_spec(plant: Plant, placement: Any) -> None:
    class Cameras(rr.Actor):
        @rr.server("camera")
        def open_camera(self, device: str) -> str:
            return device

    with pytest.raises(StartFailed, match=r"expected a subclass of rr_actors\.Manager, as open_camera is ") as raised:
        plant(ChildSpec(Cameras, id="a", placement=placement))
    assert isinstance(raised.value.__cause__, InvalidSpec)


def test_a_stop_in_the_middle_of_a_start_does_not_wait_for_it(plant: Plant, log: Log) -> None:
    tree = plant(Supervisor([], id="inner"))
    slow = worker(log, "slow", on_start="hang", shutdown_s=0.2)
    starter = threading.Thread(target=_fail_to_start, args=(tree, "root/inner", slow))
    starter.start()
    eventually(lambda: "start slow" in log.lines(), timeout=30)
    assert tree.stop() < 8
    starter.join(5)
    assert not starter.is_alive()


def _fail_to_start(tree: Tree, supervisor: str, spec: ChildSpec | Supervisor) -> None:
    with pytest.raises(StartFailed):
        tree.supervisor(supervisor).start_child(spec)


def test_a_supervisor_stopped_during_its_own_start_takes_down_what_it_had_started(plant: Plant, log: Log) -> None:
    tree = plant()
    inner = Supervisor([worker(log, "a"), worker(log, "b", on_start="hang", shutdown_s=0.2)], id="inner")
    starter = threading.Thread(target=_fail_to_start, args=(tree, "root", inner))
    starter.start()
    eventually(lambda: "start b" in log.lines(), timeout=30)
    assert tree.stop() < 8
    starter.join(5)
    assert log.lines()[-1] == "stop a"


# -- shutdown --------------------------------------------------------------------------------------------------------


def test_a_process_that_does_not_stop_in_time_is_killed(plant: Plant, log: Log) -> None:
    tree = plant(worker(log, "a", on_stop="hang", shutdown_s=0.2))
    pid = tree.pid("root/a")
    tree.supervisor().terminate_child("a")
    (record,) = tree.records("stopped")
    assert (record.reason, record.code) == ("killed", -9)
    assert "shutdown_s=0.2" in record.detail
    assert not lives(pid)


def test_a_brutal_kill_does_not_ask(plant: Plant, log: Log) -> None:
    tree = plant(worker(log, "a", shutdown_s="brutal_kill"))
    tree.supervisor().terminate_child("a")
    assert log.lines() == ["start a"]
    assert tree.records("stopped")[0].detail == "brutal_kill"


def test_a_stopped_process_is_killed_all_the_same(plant: Plant, log: Log) -> None:
    tree = plant(worker(log, "a", shutdown_s=0.2))
    pid = tree.kill("root/a", signal.SIGSTOP)
    tree.supervisor().terminate_child("a")
    assert not lives(pid)


def test_a_thread_that_does_not_stop_in_time_is_reported_and_abandoned(
    plant: Plant, log: Log, caplog: pytest.LogCaptureFixture
) -> None:
    release = threading.Event()

    class Stuck(Worker):
        def on_stop(self) -> None:
            release.wait(20)

    tree = plant(ChildSpec(Stuck, id="a", placement="thread", shutdown_s=0.2))
    began = time.monotonic()
    tree.supervisor().terminate_child("a")
    assert time.monotonic() - began < 10
    assert tree.records("stopped")[0].reason == "killed"
    assert "abandoned" in tree.records("stopped")[0].detail
    assert any("root/a" in r.message and "abandoned" in r.message for r in caplog.records)
    with pytest.raises(pykka.ActorDeadError):
        tree.ask("root/a", "pid")
    assert tree.supervisor().restart_child("a") is not None  # its successor does not meet it
    assert tree.ask("root/a", "pid") == os.getpid()
    release.set()


def test_a_sigterm_stops_a_child_gracefully(plant: Plant, log: Log) -> None:
    tree = plant(worker(log, "a", restart="transient"))
    tree.kill("root/a", signal.SIGTERM)
    eventually(lambda: tree.child("root/a").state == "stopped")
    assert log.lines() == ["start a", "stop a"]
    assert reasons(tree, "root/a") == ["shutdown"]


def test_a_sigterm_before_the_specification_is_unpickled_stops_a_child_within_its_time(plant: Plant, log: Log) -> None:
    here = os.getpid()

    def unpickled() -> str:
        assert os.getpid() != here
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.2)  # meanwhile the loop learns of it
        return "a"

    class Name:
        def __reduce__(self) -> Any:
            return unpickled, ()

    args = (str(log.path), Name(), "", "hang")
    tree = plant(ChildSpec(Worker, id="a", args=args, restart="temporary", shutdown_s=0.2))
    eventually(lambda: reasons(tree, "root/a") == ["killed"])
    assert log.lines() == ["start a"]


# -- exits and restarts ----------------------------------------------------------------------------------------------


def test_a_killed_process_is_started_again_and_its_end_is_kept(plant: Plant, log: Log) -> None:
    tree = plant(worker(log, "a"))
    pid = tree.kill("root/a")
    assert tree.pid("root/a", not_=pid) == tree.ask("root/a", "pid")
    (record,) = tree.records("exited")
    assert (record.reason, record.code, record.signal, record.pid) == ("killed", -9, "SIGKILL", pid)
    assert (record.path, record.state, record.restarts) == ("root/a", "restarting", 1)
    assert record.ready_s is not None
    assert record.up_s is not None
    assert abs(record.at - time.time()) < 10
    assert [r.pid for r in tree.records("restarted")] == [tree.pid("root/a")]


@both
def test_an_exception_is_an_abnormal_exit_with_its_traceback(plant: Plant, log: Log, placement: str) -> None:
    tree = plant(worker(log, "a", placement))
    run = tree.run("root/a")
    tree.ref("root/a").tell(("fail", "a poisoned message"))
    run_after(tree, "root/a", run)
    (record,) = tree.records("exited")
    assert (record.reason, record.detail) == ("abnormal", "ValueError: a poisoned message")
    assert "raise ValueError(text)" in record.traceback
    assert record.code == (1 if placement == "process" else None)


@both
@pytest.mark.parametrize(
    ("message", "reason"),
    [
        ("end", "normal"),
        (("end", "shutdown"), "shutdown"),
        ("leave", "normal"),
        (("leave", 3), "abnormal"),
        ("fail", "abnormal"),
    ],
)
def test_the_reason_of_an_exit(plant: Plant, log: Log, placement: str, message: Any, reason: str) -> None:
    tree = plant(worker(log, "a", placement, restart="permanent"))
    run = tree.run("root/a")
    tree.ref("root/a").tell(message)
    run_after(tree, "root/a", run)
    assert reasons(tree, "root/a") == [reason]


@pytest.mark.parametrize(("code", "reason"), [(0, "normal"), (7, "abnormal")])
def test_a_process_that_just_leaves_is_judged_by_its_exit_code(plant: Plant, log: Log, code: int, reason: str) -> None:
    tree = plant(worker(log, "a"))
    pid = tree.pid("root/a")
    tree.ref("root/a").tell(("os_exit", code))
    tree.pid("root/a", not_=pid)
    (record,) = tree.records("exited")
    assert (record.reason, record.code, record.detail) == (reason, code, f"exit code {code}")


@both
@pytest.mark.parametrize(
    ("restart", "message", "after"),
    [
        ("permanent", "end", "running"),
        ("transient", "end", "stopped"),
        ("transient", ("end", "shutdown"), "stopped"),
        ("transient", "fail", "running"),
        ("temporary", "fail", None),
        ("temporary", "end", None),
    ],
)
def test_the_restart_type_decides(
    plant: Plant, log: Log, placement: str, restart: Any, message: Any, after: str | None
) -> None:
    tree = plant(worker(log, "a", placement, restart=restart))
    tree.ref("root/a").tell(message)
    eventually(lambda: tree.records("exited"))
    state = {child.id: child.state for child in tree.supervisor().which_children()}.get("a")
    if after == "running":
        eventually(lambda: tree.child("root/a").state == "running")
    else:
        assert state == after


def test_a_death_is_noticed_within_milliseconds(plant: Plant, log: Log) -> None:
    tree = plant(worker(log, "a", restart="transient"), max_restarts=21)

    def noticed_after() -> float:
        killed = time.time()
        pid = tree.kill("root/a")
        tree.pid("root/a", not_=pid)
        return tree.records("exited")[-1].at - killed

    quickly(lambda: statistics.median(noticed_after() for _ in range(7)), 0.05)


@both
def test_a_restart_that_fails_is_counted_and_tried_again(plant: Plant, log: Log, placement: str) -> None:
    tree = plant(worker(log, "a", placement, on_start="fail_again"), max_restarts=3)
    tree.ref("root/a").tell("fail")
    assert tree.exited.wait(10)
    (report,) = tree.exits
    assert report.reason == "shutdown"
    assert isinstance(report.exception, RestartIntensityExceeded)
    assert "root" in report.detail
    assert log.lines().count("start a") == 4  # the first, and three restarts


def test_exceeding_the_intensity_stops_all_children_in_reverse_order(plant: Plant, log: Log) -> None:
    tree = plant(*(worker(log, id) for id in "abc"), max_restarts=0)
    tree.kill("root/b")
    assert tree.exited.wait(10)
    assert log.lines()[3:] == ["stop c", "stop a"]
    assert tree.exits[0].reason == "shutdown"


def test_a_backoff_shows_as_restarting_and_does_not_hold_up_a_stop(plant: Plant, log: Log) -> None:
    tree = plant(worker(log, "a", backoff=Backoff(delay_s=30.0, maximum_s=30.0)), worker(log, "b"))
    tree.kill("root/a")
    eventually(lambda: tree.child("root/a").state == "restarting")
    assert tree.records("exited")[0].delay_s > 20
    with pytest.raises(ActorUnavailable, match="root/a"):
        tree.ask("root/a", "pid")
    with pytest.raises(ChildRestarting):
        tree.supervisor().restart_child("a")
    assert tree.stop() < 8


@pytest.mark.cold
def test_a_child_is_restarted_after_its_fork_server_was_killed(plant: Plant, log: Log) -> None:
    tree = plant(worker(log, "a"))
    pid = tree.pid("root/a")
    server = psutil.Process(pid).ppid()
    os.kill(server, signal.SIGKILL)
    eventually(lambda: not lives(server))
    assert lives(pid)
    tree.kill("root/a")
    assert tree.pid("root/a", not_=pid)


# -- strategies ------------------------------------------------------------------------------------------------------


@both
@pytest.mark.parametrize(
    ("strategy", "happened"),
    [
        ("one_for_one", ["start b"]),
        ("one_for_all", ["stop c", "stop a", "start a", "start b", "start c"]),
        ("rest_for_one", ["stop c", "start b", "start c"]),
    ],
)
def test_the_strategy_decides_who_is_started_again(
    plant: Plant, log: Log, placement: str, strategy: Any, happened: list[str]
) -> None:
    tree = plant(*(worker(log, id, placement) for id in "abc"), strategy=strategy)
    tree.ref("root/b").tell("fail")
    eventually(lambda: len(log.lines()) == 3 + len(happened), what=f"{happened} in {log.lines()}")
    assert log.lines()[3:] == happened
    eventually(lambda: all(child.state == "running" for child in tree.supervisor().which_children()))


@both
def test_dynamic_children_are_made_from_the_template_with_more_arguments(
    plant: Plant, log: Log, placement: str
) -> None:
    template = ChildSpec(Worker, id="session", args=(str(log.path),), placement=placement)  # type: ignore[arg-type]
    tree = plant(Supervisor([template], strategy="simple_one_for_one"))
    supervisor = tree.supervisor()
    assert supervisor.which_children() == []
    first, second = supervisor.start_child(["one"]), supervisor.start_child(["two"])
    assert first is not None
    assert second is not None
    assert sorted(log.lines()) == ["start one", "start two"]
    assert supervisor.count_children() == (1, 2, 0, 2)
    assert first.ask("pid") == supervisor.which_children()[1].pid
    supervisor.terminate_child(first)
    assert [child.ref for child in supervisor.which_children()] == [second]
    with pytest.raises(pykka.ActorDeadError):
        first.ask("pid")


# -- administration --------------------------------------------------------------------------------------------------


@both
def test_children_are_added_stopped_restarted_and_deleted(plant: Plant, log: Log, placement: str) -> None:
    tree = plant(worker(log, "a", placement))
    supervisor = tree.supervisor()
    ref = supervisor.start_child(worker(log, "b", placement))
    assert ref is not None
    assert ref.ask("pid") == tree.child("root/b").pid
    with pytest.raises(AlreadyStarted):
        supervisor.start_child(worker(log, "b", placement))
    with pytest.raises(ChildRunning):
        supervisor.delete_child("b")
    supervisor.terminate_child("b")
    assert (tree.child("root/b").state, tree.child("root/b").pid) == ("stopped", None)
    with pytest.raises(pykka.ActorDeadError):
        ref.ask("pid")
    with pytest.raises(AlreadyPresent):
        supervisor.start_child(worker(log, "b", placement))
    assert supervisor.restart_child("b") == ref
    assert ref.ask("pid") == tree.child("root/b").pid
    supervisor.terminate_child(ref)
    supervisor.delete_child("b")
    assert [child.id for child in supervisor.which_children()] == ["a"]
    with pytest.raises(NotFound):
        supervisor.terminate_child("b")
    assert tree.node.directory.lookup(actor_key("root/b")) == NameEntry(Presence.GONE, "")
    assert supervisor.get_childspec("a").id == "a"


@both
def test_a_child_that_cannot_be_started_is_not_one(plant: Plant, log: Log, placement: str) -> None:
    tree = plant()
    with pytest.raises(StartFailed, match="as it was told"):
        tree.supervisor().start_child(worker(log, "a", placement, on_start="fail"))
    assert tree.supervisor().which_children() == []


def test_a_supervisor_answers_while_a_child_starts(plant: Plant, log: Log) -> None:
    tree = plant(worker(log, "a"))
    slow = worker(log, "slow", on_start="hang", shutdown_s=0.1)
    starter = threading.Thread(target=_fail_to_start, args=(tree, "root", slow))
    starter.start()
    eventually(lambda: "start slow" in log.lines())
    assert [(child.id, child.state) for child in tree.supervisor().which_children()] == [
        ("slow", "starting"),
        ("a", "running"),
    ]
    pid = tree.kill("root/a")
    assert tree.pid("root/a", not_=pid)
    tree.supervisor().terminate_child("slow")
    starter.join(5)
    assert not starter.is_alive()


def test_a_child_may_have_its_supervisor_start_another(plant: Plant, log: Log) -> None:
    tree = plant(worker(log, "a"))
    ref = tree.ask("root/a", ("start_child_of", "root", "b"))
    assert ref.ask("pid") == tree.child("root/b").pid


def test_a_new_specification_counts_from_the_next_start(plant: Plant, log: Log) -> None:
    tree = plant(worker(log, "a"))
    pid = tree.pid("root/a")
    new = Supervisor([worker(log, "a", "thread"), worker(log, "b")], max_restarts=7)
    tree.supervisor().update(new)
    assert tree.pid("root/a") == pid
    assert tree.child("root/b").state == "stopped"
    tree.kill("root/a")
    assert tree.pid("root/a", not_=pid) == os.getpid()
    with pytest.raises(InvalidSpec):
        tree.supervisor().update(Supervisor([], id="other"))


def test_a_significant_child_may_end_its_supervisor(plant: Plant, log: Log) -> None:
    tree = plant(worker(log, "a"), worker(log, "b", restart="transient", significant=True), auto_shutdown="any")
    tree.ref("root/b").tell("end")
    assert tree.exited.wait(10)
    assert (tree.exits[0].reason, tree.exits[0].exception) == ("shutdown", None)
    assert log.lines()[-1] == "stop a"


def test_a_supervisor_that_is_not_there_is_not_found(plant: Plant) -> None:
    tree = plant()
    with pytest.raises(NotFound, match="root/nobody"):
        tree.supervisor("root/nobody").which_children()


# -- supervisors as children -----------------------------------------------------------------------------------------


@both
def test_a_supervisor_is_a_child_like_others(plant: Plant, log: Log, placement: Any) -> None:
    inner = Supervisor([worker(log, "a"), worker(log, "b", "thread")], id="inner", placement=placement)
    tree = plant(inner, worker(log, "c"))
    assert log.lines() == ["start a", "start b", "start c"]
    assert tree.supervisor().count_children() == (2, 2, 1, 1)
    assert (tree.child("root/inner").type, tree.child("root/inner").state) == ("supervisor", "running")
    assert (tree.child("root/inner").pid == os.getpid()) is (placement == "thread")
    assert tree.child("root/inner/b").pid == tree.child("root/inner").pid
    assert tree.ask("root/inner/a", "pid") == tree.child("root/inner/a").pid
    pid = tree.kill("root/inner/a")
    assert tree.pid("root/inner/a", not_=pid)
    eventually(lambda: [e["path"] for e in tree.events if e["event"] == "restarted"] == ["root/inner/a"])
    tree.stop()
    assert log.lines()[-3:] == ["stop c", "stop b", "stop a"]


def test_a_killed_supervisor_takes_all_below_it_down_and_comes_back_with_it(plant: Plant, log: Log) -> None:
    deep = Supervisor([worker(log, "a")], id="deep", placement="process")
    tree = plant(Supervisor([deep, worker(log, "b")], id="inner", placement="process"), worker(log, "c"))

    def gone_after() -> float:
        tree.supervisor("root/inner").start_child(worker(log, "dynamic"))
        before = {
            path: tree.pid(path)
            for path in ("root/inner", "root/inner/deep", "root/inner/deep/a", "root/inner/b", "root/c")
        }
        dynamic = tree.pid("root/inner/dynamic")
        tree.kill("root/inner")
        below = [dynamic, *(pid for path, pid in before.items() if path.startswith("root/inner"))]
        gone_s = wait_gone(*below)
        for path in before:
            eventually(lambda path=path: _is_back(tree, path))
        after = {path: tree.pid(path) for path in before}
        assert after["root/c"] == before["root/c"]
        assert not set(after.values()) & set(below)
        assert [child.id for child in tree.supervisor("root/inner").which_children()] == ["b", "deep"]
        return gone_s

    quickly(gone_after, 0.2)


def _is_back(tree: Tree, path: str) -> bool:
    try:
        return tree.child(path).state == "running"
    except (ActorUnavailable, NotFound, KeyError):
        return False


@both
def test_a_supervisor_that_gives_up_is_restarted_by_its_own(plant: Plant, log: Log, placement: Any) -> None:
    inner = Supervisor([worker(log, "a"), worker(log, "b")], id="inner", max_restarts=0, placement=placement)
    tree = plant(inner)
    tree.kill("root/inner/a")
    eventually(lambda: log.lines()[2:] == ["stop b", "start a", "start b"], what=f"{log.lines()}")
    eventually(lambda: tree.records("restarted"))
    (record,) = tree.records("exited")
    assert (record.path, record.reason) == ("root/inner", "shutdown")
    assert "root/inner" in record.detail
    assert "RestartIntensityExceeded" in record.traceback


def test_escalation_goes_through_all_levels(plant: Plant, log: Log) -> None:
    deep = Supervisor([worker(log, "a")], id="deep", max_restarts=0)
    tree = plant(Supervisor([deep], id="inner", max_restarts=0), max_restarts=0)
    tree.kill("root/inner/deep/a")
    assert tree.exited.wait(10)
    assert isinstance(tree.exits[0].exception, RestartIntensityExceeded)


def test_an_update_of_a_supervisor_outlives_its_respawn(plant: Plant, log: Log) -> None:
    tree = plant(Supervisor([worker(log, "a")], id="inner", placement="process"))
    tree.supervisor("root/inner").update(Supervisor([worker(log, "a"), worker(log, "b")], id="inner"))
    pid = tree.kill("root/inner")
    tree.pid("root/inner", not_=pid)
    eventually(lambda: _is_back(tree, "root/inner/b"))
    assert [child.id for child in tree.supervisor("root/inner").which_children()] == ["b", "a"]


# -- hung children ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["stopped", "hold_the_interpreter", "block_the_loop"])
def test_a_hung_child_is_found_by_its_heartbeat_and_replaced(plant: Plant, log: Log, how: str) -> None:
    tree = plant(worker(log, "a", heartbeat_s=1.0))
    pid = tree.pid("root/a")
    if how == "stopped":
        os.kill(pid, signal.SIGSTOP)
    else:
        tree.ref("root/a").tell(how)
    tree.pid("root/a", not_=pid)
    (record,) = tree.records("exited")
    assert record.reason == "abnormal"
    assert record.detail.startswith("hung")
    assert not lives(pid)


def test_a_slow_callback_is_not_taken_for_a_hung_child(plant: Plant, log: Log) -> None:
    tree = plant(worker(log, "a", heartbeat_s=1.0))
    assert tree.ask("root/a", ("pause", 2.0)) == "rested"
    assert tree.records("exited") == []


# -- ordinary Pykka actors -------------------------------------------------------------------------------------------


@both
def test_a_pykka_threading_actor_can_be_a_child(plant: Plant, placement: Any) -> None:
    tree = plant(ChildSpec(Threaded, id="a", placement=placement), ChildSpec(Threaded, id="b", placement=placement))
    assert tree.ask("root/a", "pid") == tree.child("root/a").pid
    run, other = tree.run("root/a"), tree.run("root/b")
    tree.ref("root/a").tell("fail")
    run = run_after(tree, "root/a", run)
    tree.ref("root/a").tell("end")
    run = run_after(tree, "root/a", run)
    tree.ref("root/a").tell(("leave", 3))
    run_after(tree, "root/a", run)
    assert reasons(tree, "root/a") == ["abnormal", "normal", "abnormal"]
    assert tree.run("root/b") == other  # SystemExit in one did not stop the other
    assert "as it was told" in tree.records("exited")[0].traceback
    assert tree.ask("root/a", "pid") == tree.child("root/a").pid


@both
@pytest.mark.parametrize("code", [None, 1])
def test_the_asker_of_a_pykka_threading_actor_that_leaves_meanwhile_is_told(
    plant: Plant, placement: Any, code: int | None
) -> None:
    tree = plant(ChildSpec(Threaded, id="a", restart="temporary", placement=placement))
    with pytest.raises(pykka.ActorDeadError, match="root/a"):
        tree.ask("root/a", ("leave", code))
    eventually(lambda: reasons(tree, "root/a") == ["abnormal" if code else "normal"])


@both
def test_a_pykka_threading_actor_fails_to_start_when_its_on_start_raises(plant: Plant, placement: Any) -> None:
    with pytest.raises(StartFailed, match="as it was told"):
        plant(ChildSpec(Threaded, id="a", args=("fail",), placement=placement))


@both
def test_a_pykka_threading_actor_may_ignore_or_leave(plant: Plant, placement: Any) -> None:
    tree = plant(ChildSpec(Threaded, id="a", args=("ignore",), placement=placement))
    assert tree.child("root/a").state == "stopped"
    with pytest.raises(StartFailed, match="SystemExit"):
        tree.supervisor().start_child(ChildSpec(Threaded, id="b", args=("leave",), placement=placement))


# -- what is left ----------------------------------------------------------------------------------------------------


def test_what_a_child_started_dies_with_it(plant: Plant, log: Log) -> None:
    tree = plant(worker(log, "a"))
    inside = tree.ask("root/a", "start_program")
    outside = tree.ask("root/a", ("start_program", True))
    tree.kill("root/a")
    wait_gone(inside, outside)


def test_what_a_child_started_dies_when_it_is_stopped(plant: Plant, log: Log) -> None:
    tree = plant(worker(log, "a"))
    inside = tree.ask("root/a", "start_program")
    outside = tree.ask("root/a", ("start_program", True))
    tree.stop()
    wait_gone(inside, outside)


TOP = """
    import sys, time
    sys.path[:0] = {paths!r}
    from pathlib import Path
    from support_supervision import *
    log = {log!r}
    deep = Supervisor([ChildSpec(Worker, id="a", args=(log,))], id="deep", placement="process")
    inner = Supervisor([deep, ChildSpec(Worker, id="b", args=(log,))], id="inner", placement="process")
    others = [ChildSpec(Worker, id="c", args=(log,)), ChildSpec(Worker, id="d", placement="thread")]
    tree = Tree(Path({state!r}), inner, *others)
    tree.start()
    pids = [tree.pid("root/" + path) for path in ("inner", "inner/deep", "inner/deep/a", "inner/b", "c")]
    pids += [tree.ask("root/c", "start_program"), tree.ask("root/inner/deep/a", ("start_program", True))]
    print(*pids, flush=True)
    time.sleep(60)
"""


def test_nothing_outlives_a_killed_top_for_200_ms(tmp_path: Path) -> None:
    paths = [str(Path(__file__).parents[1]), str(Path(__file__).parents[2])]
    program = textwrap.dedent(TOP).format(paths=paths, log=str(tmp_path / "log"), state=str(tmp_path / "state"))

    def gone_after() -> float:
        with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as top:
            assert top.stdout is not None
            pids = [int(word) for word in top.stdout.readline().split()]
            assert len(pids) == 7
            assert all(lives(pid) for pid in pids)
            servers = [process.pid for process in psutil.Process(top.pid).children()]
            top.kill()
            return wait_gone(*pids, *servers)

    quickly(gone_after, 0.2)
    open_state_dir(tmp_path / "state").close()  # nobody holds it any more


def test_each_exit_is_one_structured_log_line(plant: Plant, log: Log, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "rr_actors.supervision")
    tree = plant(worker(log, "a"))
    pid = tree.kill("root/a")
    tree.pid("root/a", not_=pid)
    (line,) = [record for record in caplog.records if record.name == "rr_actors.supervision"]
    assert line.message.startswith("exited path=root/a run=1 ")
    assert "reason=killed signal=SIGKILL restarts=1" in line.message  # once, not with its code and in words, too
    facts: dict[str, Any] = line.__dict__["supervision"]
    assert (facts["event"], facts["code"], facts["signal"]) == ("exited", -9, "SIGKILL")
    assert line.levelno == logging.WARNING


def test_the_run_of_an_event_counts_the_starts_of_its_child_alone(plant: Plant, log: Log) -> None:
    tree = plant(worker(log, "a"), worker(log, "b"))
    for _ in range(2):
        pid = tree.kill("root/b")
        tree.pid("root/b", not_=pid)
    eventually(lambda: [(e["event"], e.get("run")) for e in tree.events if e["path"] == "root/a"] == [("started", 1)])
    eventually(
        lambda: (
            [(e["event"], e.get("run")) for e in tree.events if e["path"] == "root/b"]
            == [("started", 1), ("exited", 1), ("restarted", 2), ("exited", 2), ("restarted", 3)]
        )
    )


def test_a_child_stopped_while_it_waits_to_be_started_again_has_not_died_once_more() -> None:
    history = History()
    killed = Record("exited", "root/a", "actor", 1, 0.0, "restarting", reason="killed", code=-9, signal="SIGKILL")
    history.add(killed)
    assert history.deaths("root/a", 3) == ["SIGKILL"]
    history.add(Record("stopped", "root/a", "actor", 1, 0.0, "stopped"))
    assert history.deaths("root/a", 3) == []
    history.add(killed)
    assert history.deaths("root/a", 3) == ["SIGKILL"]


def test_events_are_told_as_they_happen_from_every_process(plant: Plant, log: Log) -> None:
    tree = plant(Supervisor([worker(log, "a")], id="inner", placement="process"))
    eventually(
        lambda: (
            [(e["event"], e["path"]) for e in tree.events] == [("started", "root/inner/a"), ("started", "root/inner")]
        )
    )
    pid = tree.kill("root/inner/a")
    tree.pid("root/inner/a", not_=pid)
    eventually(
        lambda: (
            [(e["event"], e["path"]) for e in tree.events[2:]]
            == [("exited", "root/inner/a"), ("restarted", "root/inner/a")]
        )
    )
    assert tree.events[2]["signal"] == "SIGKILL"


@pytest.mark.cold  # it counts the processes below the fork server
def test_random_kills_and_calls_leave_a_tree_that_is_whole(plant: Plant, log: Log) -> None:
    chance = random.Random(4)
    inner = Supervisor(
        [worker(log, "d"), worker(log, "e", "thread")], id="inner", placement="process", max_restarts=1000
    )
    group = Supervisor([worker(log, "f"), worker(log, "g")], id="group", strategy="one_for_all", max_restarts=1000)
    tree = plant(worker(log, "a"), worker(log, "b", "thread"), worker(log, "c"), inner, group, max_restarts=1000)
    paths = ["a", "b", "c", "inner", "inner/d", "inner/e", "group/f", "group/g"]
    for _ in range(60):
        path = "root/" + chance.choice(paths)
        above, _, id = path.rpartition("/")
        supervisor = tree.supervisor(above)
        try:
            match chance.randrange(6):
                case 0 | 1:
                    pid = tree.child(path).pid
                    if pid and pid != os.getpid():
                        os.kill(pid, signal.SIGKILL)
                case 2:
                    tree.ref(path).tell("fail" if id != "inner" else "which_children")
                case 3:
                    supervisor.terminate_child(id)
                case 4:
                    supervisor.restart_child(id)
                case _:
                    supervisor.which_children()
        except (UsageError, Unavailable, pykka.ActorDeadError, ProcessLookupError, StartFailed, KeyError):
            continue  # the tree was in the middle of something: that is what this is about
    eventually(lambda: all(_runs_again(tree, "root/" + path) for path in paths), what="everything running")
    assert not tree.exits
    pids = {tree.pid("root/" + path) for path in paths} - {os.getpid()}
    servers = {process.pid for process in psutil.Process().children()}
    assert {process.pid for process in psutil.Process().children(recursive=True)} - servers == pids
    assert tree.stop() < 5


def _runs_again(tree: Tree, path: str) -> bool:
    above, _, id = path.rpartition("/")
    try:
        child = tree.child(path)
        if child.state == "stopped":
            tree.supervisor(above).restart_child(id)
        elif child.type == "worker":  # asked behind what it was told before
            return child.state == "running" and child.ref.ask("pid") == child.pid
        return child.state == "running"
    except (UsageError, Unavailable, pykka.ActorDeadError, StartFailed, KeyError):
        return False


@both
def test_a_supervisor_survives_messages_it_does_not_understand(plant: Plant, log: Log, placement: Any) -> None:
    tree = plant(Supervisor([worker(log, "a")], id="inner", placement=placement))
    pid = tree.pid("root/inner/a")
    tree.ref("root/inner").tell("nonsense")
    with pytest.raises(UsageError, match=r"root/inner: expected a supervisor's call, got 'nonsense'"):
        tree.ask("root/inner", "nonsense")
    assert tree.pid("root/inner/a") == pid
    assert tree.records("exited") == []


def test_a_manager_abandoned_in_its_thread_leaves_its_catalog_to_its_successor(plant: Plant, log: Log) -> None:
    tree = plant(ChildSpec(StuckManager, id="shop", placement="thread", shutdown_s=0.1))
    tree.supervisor().terminate_child("shop")
    assert "abandoned" in tree.records("stopped")[0].detail
    assert tree.supervisor().restart_child("shop") is not None
    served = tree.node.registrars["shop"]
    let_go.set()  # the abandoned one ends at last
    eventually(lambda: not any(thread.name.startswith("stuck") for thread in threading.enumerate()))
    assert tree.ask("root/shop", "anything") == "served"
    assert tree.node.registrars["shop"] is served
    assert not served.closed


def test_a_manager_that_hangs_in_its_start_as_a_thread_is_abandoned_with_its_catalog_free(
    plant: Plant, log: Log
) -> None:
    hanging = ChildSpec(StuckManager, id="shop", placement="thread", kwargs={"on_start": True}, start_timeout_s=0.2)
    tree = plant()
    with pytest.raises(StartFailed, match="start_timeout_s"):
        tree.supervisor().start_child(hanging)
    assert tree.supervisor().start_child(ChildSpec(StuckManager, id="shop", placement="thread", shutdown_s=0.1))
    served = tree.node.registrars["shop"]
    let_go.set()
    assert tree.ask("root/shop", "anything") == "served"
    assert tree.node.registrars["shop"] is served


def test_a_manager_that_fails_after_it_was_abandoned_leaves_its_successors_registrar_open(
    plant: Plant, log: Log
) -> None:
    tree = plant()
    hanging = ChildSpec(SlowToRegister, id="shop", placement="thread", start_timeout_s=0.2)
    with pytest.raises(StartFailed, match="start_timeout_s"):
        tree.supervisor().start_child(hanging)
    tree.supervisor().start_child(ChildSpec(StuckManager, id="shop", placement="thread", shutdown_s=0.1))
    served = tree.node.registrars["shop"]
    let_go.set()
    abandoned = weakref.ref(SlowToRegister.made.pop())
    eventually(lambda: gc.collect() >= 0 and abandoned() is None, what="the end of the abandoned one")
    assert tree.ask("root/shop", "anything") == "served"
    assert tree.node.registrars["shop"] is served
    assert not served.closed


def _registrar(tree: Tree, name: str) -> Presence | None:
    entry = tree.node.directory.lookup(registrar_key(name))
    return None if entry is None else entry.status


@both
def test_the_directory_says_where_a_managers_registrar_is(plant: Plant, placement: Any) -> None:
    tree = plant(ChildSpec(Idle, id="shop", placement=placement), ChildSpec(Idle, id="store", restart="temporary"))
    supervisor = tree.supervisor()
    assert _registrar(tree, "shop") is Presence.UP
    supervisor.terminate_child("shop")
    assert _registrar(tree, "shop") is Presence.STOPPED
    supervisor.restart_child("shop")
    assert _registrar(tree, "shop") is Presence.UP
    supervisor.terminate_child("shop")
    supervisor.delete_child("shop")
    assert _registrar(tree, "shop") is Presence.GONE
    tree.kill("root/store")
    eventually(lambda: _registrar(tree, "store") is Presence.GONE)


def test_managers_added_below_a_supervisor_that_is_killed_are_gone_and_the_others_come_back(plant: Plant) -> None:
    tree = plant(Supervisor([ChildSpec(Idle, id="shop")], id="inner", placement="process"))
    tree.supervisor("root/inner").start_child(ChildSpec(Idle, id="added"))
    eventually(
        lambda: [e["path"] for e in tree.events if e["kind"] == "manager"] == ["root/inner/shop", "root/inner/added"]
    )
    assert (_registrar(tree, "shop"), _registrar(tree, "added")) == (Presence.UP, Presence.UP)
    pid = tree.kill("root/inner")
    tree.pid("root/inner", not_=pid)
    assert _registrar(tree, "shop") is Presence.UP
    eventually(lambda: _registrar(tree, "added") is Presence.GONE)
    with pytest.raises(pykka.ActorDeadError):
        tree.ask("root/inner/added", "anything")


@both
def test_a_supervisor_that_gives_up_takes_leave_of_the_managers_added_to_it(
    plant: Plant, log: Log, placement: Any
) -> None:
    children = [ChildSpec(Idle, id="shop", placement="thread"), worker(log, "a")]
    tree = plant(Supervisor(children, id="inner", max_restarts=0, placement=placement))
    tree.supervisor("root/inner").start_child(ChildSpec(Idle, id="added", placement="thread"))
    tree.kill("root/inner/a")
    eventually(lambda: tree.records("restarted"))
    assert _registrar(tree, "shop") is Presence.UP
    assert _registrar(tree, "added") is Presence.GONE


def take_all_threads(workers: Workers, gate: Gate) -> None:
    while True:
        workers.submit(gate)


def test_children_are_restarted_while_callbacks_take_all_threads(plant: Plant, log: Log) -> None:
    inner = Supervisor([worker(log, "a")], id="inner", placement="process")
    tree = plant(inner, worker(log, "b"))
    old = {path: tree.pid(path) for path in ("root/inner", "root/b")}
    gate, workers = Gate(), tree.dispatcher.workers
    workers.threads.limit = 1
    with pytest.raises(MailboxFull):
        take_all_threads(workers, gate)
    try:
        for pid in old.values():
            os.kill(pid, signal.SIGKILL)
        for path, pid in old.items():
            tree.pid(path, not_=pid)
    finally:
        gate.open()
    assert {record.event for record in tree.supervisor().history()} == {"started", "exited", "restarted"}
