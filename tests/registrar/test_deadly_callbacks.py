"""What a manager promises about callbacks that end its process (docs/semantics.md, "Crash and recovery").

A driver that segfaults, os._exit: real processes. After three deaths in runs of one callback of a resource the callback
is not run again for that resource, and the manager lives.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import rr_actors as rr
from support import LIMIT_S, TEST_PATHS, Calls, Workshop, eventually, kill, pid_of

Start = Callable[..., rr.System]
STARTS_S = 60.0
"""A limit for what takes four starts of a process: each may take some seconds on a busy machine."""


def segfault() -> None:
    """End the process as a driver does that reads where nothing is."""
    ctypes.string_at(0)


ENDS: dict[str, Callable[[], None]] = {"os._exit": lambda: os._exit(3), "SIGSEGV": segfault}


class Deadly(rr.Manager):
    """Serves "thing": a callback ends the process if its request names the callback, and the workshop is "armed"."""

    def __init__(self, root: str, how: str) -> None:
        self.work = Workshop(root)
        self.how = how

    def meets(self, role: str, request: str) -> None:
        self.work.note(f"{role} {request}")
        if request.startswith(role) and len(self.work.lines("armed")) > len(self.work.lines("disarmed")):
            ENDS[self.how]()

    @rr.server("thing", recover_timeout_s=1.0)
    def load_thing(self, request: str) -> str:
        self.meets("load", request)
        return request

    @load_thing.unload
    def unload_thing(self, request: str, response: str | None) -> None:
        self.meets("unload", request)

    @load_thing.status
    def thing_status(self, request: str, status: rr.Status) -> None:
        self.meets("status", request)

    @load_thing.recover
    def recover_thing(self, request: str, response: str) -> str:
        if request == "slow":
            self.work.step("recover slow")
        self.meets("recover", request)
        return response

    @rr.server("probed", health=rr.Health(every_s=0.1))
    def load_probed(self, request: str) -> str:
        return request

    @load_probed.health
    def probe(self, request: str, response: str) -> None:
        self.meets("health", request)

    @rr.server("used", recovery="keep")
    def load_used(self, request: str) -> str:
        return request

    @load_used.usage
    def use_used(self, request: str, response: str) -> dict[str, float]:
        self.meets("usage", request)
        return {"watts": 1.0}

    @rr.server("other")
    def load_other(self, request: str) -> str:
        return request


def deadly(workshop: Workshop, how: str = "os._exit") -> rr.ChildSpec:
    return rr.ChildSpec(Deadly, id="shop", args=(str(workshop.root), how))


def states(system: rr.System) -> dict[str, tuple[str, str]]:
    return {info.request: (str(info.phase), str(info.state)) for info in system.registrar("shop").resources()}


class Patient(rr.Manager):
    """Serves "thing": the callback that the workshop has armed does not return until it is disarmed."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    def wait(self, role: str) -> None:
        if len(self.work.lines(f"armed {role}")) > len(self.work.lines("disarmed")):
            self.work.note(f"waits in {role}")
            while len(self.work.lines("armed")) > len(self.work.lines("disarmed")):
                time.sleep(0.01)

    @rr.server("thing", recovery="keep")
    def load_thing(self, request: str) -> str:
        self.wait("load")
        return request

    @load_thing.unload
    def unload_thing(self, request: str, response: str | None) -> None:
        self.wait("unload")

    @load_thing.status
    def thing_status(self, request: str, status: rr.Status) -> None:
        self.wait("status")

    @load_thing.recover
    def recover_thing(self, request: str, response: str) -> str:
        self.wait("recover")
        return response


def restart(system: rr.System, id: str) -> None:
    system.supervisor().terminate_child(id)
    system.supervisor().restart_child(id)


@pytest.mark.parametrize("role", ["load", "unload", "status", "recover"])
def test_a_callback_that_clean_restarts_interrupt_is_not_to_blame_and_runs_again(
    start: Start, workshop: Workshop, role: str, caplog: pytest.LogCaptureFixture
) -> None:
    system = start(rr.ChildSpec(Patient, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    query = app.load("shop/thing", "first")
    workshop.note(f"armed {role}")
    match role:
        case "load":
            waiting = app.load("shop/thing", "second", block=False, timeout_s=LIMIT_S)
        case "unload":
            waiting = app.unload(query, block=False, timeout_s=LIMIT_S)
        case "status":
            system.registrar("shop").send_status(query, rr.Status(rr.State.WARNING, "worn"))
            waiting = None
        case _:
            restart(system, "shop")
            waiting = None
    for number in range(4):  # one more than the deaths that a callback is allowed
        eventually(lambda: len(workshop.lines(f"waits in {role}")) == number + 1, LIMIT_S)  # noqa: B023
        restart(system, "shop")
    eventually(lambda: len(workshop.lines(f"waits in {role}")) == 5, LIMIT_S)
    workshop.note("disarmed")
    if waiting is not None:
        waiting.get(timeout=LIMIT_S)
    if role == "status":
        assert query.wait_status(timeout_s=LIMIT_S).message == "worn"
    assert not [record.message for record in caplog.records if "died" in record.message]


def test_the_log_says_that_a_death_in_a_callback_is_taken_off_the_count(
    start: Start, workshop: Workshop, caplog: pytest.LogCaptureFixture
) -> None:
    system = start(deadly(workshop, "os._exit"))
    workshop.note("armed")
    with pytest.raises(rr.LoadFailed):
        system.open_registrar("app").load("shop/thing", "load", timeout_s=STARTS_S)
    said = [one.getMessage() for one in caplog.records if "is taken off the count again" in one.getMessage()]
    assert said
    assert all("the last process of root/shop died" in line and "thing" in line for line in said)


@pytest.mark.parametrize("how", ENDS)
def test_a_recover_callback_that_ends_its_process_three_times_loses_the_resource_by_name(
    start: Start, workshop: Workshop, how: str
) -> None:
    system = start(deadly(workshop, how))
    app = system.open_registrar("app")
    hears = Calls()
    lost = app.load("shop/thing", "recover", on_status=hears)
    kept = [app.load("shop/thing", f"kept {number}") for number in range(5)]
    workshop.note("armed")
    kill(system, "shop")
    (status,) = hears.wait(timeout=STARTS_S)
    assert status.state is rr.State.FATAL
    assert "shop/thing: the process died in each of 3 runs of the recover callback" in status.message
    assert lost.resource_id in status.message
    assert len(workshop.lines("recover recover")) == 3
    assert app.load("shop/other", "again").response == "again"
    assert [query.state for query in kept] == [rr.State.OK] * 5
    assert system.ended is None


@pytest.mark.parametrize("how", ENDS)
def test_an_unload_callback_that_ends_its_process_three_times_is_unload_failed_and_is_cleared_by_force(
    start: Start, workshop: Workshop, how: str
) -> None:
    system = start(deadly(workshop, how))
    app = system.open_registrar("app")
    query = app.load("shop/thing", "unload")
    workshop.note("armed")
    for _ in range(2):
        with pytest.raises(rr.UnloadFailed, match=r"in each of 3 runs of the unload callback.*unload --force"):
            query.unload()
        assert len(workshop.lines("unload unload")) == 3
        assert states(system)["unload"][0] == "unload_failed"
    pid = pid_of(system, "shop")
    system.registrar("shop").unload(query.resource_id, force=True)
    assert states(system) == {}
    assert len(workshop.lines("unload unload")) == 3
    assert pid_of(system, "shop") == pid
    assert system.ended is None


@pytest.mark.parametrize("how", ENDS)
def test_a_status_callback_that_ends_its_process_three_times_is_passed_over(
    start: Start, workshop: Workshop, how: str
) -> None:
    system = start(deadly(workshop, how))
    app = system.open_registrar("app")
    hears = Calls()
    query = app.load("shop/thing", "status", on_status=hears)
    workshop.note("armed")
    with contextlib.suppress(rr.RegistrarDown):  # the process may end before it has answered
        system.registrar("shop").send_status(query.resource_id, rr.Status(rr.State.WARNING, "first"))
    assert [status.message for status in hears.wait(timeout=STARTS_S)] == ["first"]
    assert len(workshop.lines("status status")) == 3
    system.registrar("shop").send_status(query.resource_id, rr.Status(rr.State.OK, "second"))
    assert [status.message for status in hears.wait(2)] == ["first", "second"]
    assert len(workshop.lines("status status")) == 3
    assert system.ended is None


@pytest.mark.parametrize("how", ENDS)
def test_a_usage_callback_that_ends_its_process_three_times_is_named_and_not_run_again(
    start: Start, workshop: Workshop, how: str
) -> None:
    system = start(deadly(workshop, how))
    app = system.open_registrar("app")
    hears = Calls()
    kept = app.load("shop/used", "kept")
    lost = app.load("shop/used", "usage", on_status=hears)
    probed = app.load("shop/probed", "well", on_status=hears)
    workshop.note("armed")
    for asked in (1, 2, 3):
        with pytest.raises(rr.RegistrarDown):
            system.registrar("shop").usage(timeout_s=STARTS_S)
        assert len(workshop.lines("usage usage")) == asked
    usages = system.registrar("shop").usage(timeout_s=STARTS_S)
    assert usages == {kept.resource_id: {"watts": 1.0}}
    assert list(usages.failures) == [lost.resource_id]
    assert "the process died in each of 3 runs of the usage callback" in usages.failures[lost.resource_id]
    assert len(workshop.lines("usage usage")) == 3
    assert probed.state is rr.State.OK
    assert hears.items == []
    assert system.ended is None


class Crashing(rr.Manager):
    """Its process dies by itself, whatever its callbacks do."""

    def on_start(self) -> None:
        timer = threading.Timer(float(os.environ["CRASH_AFTER_S"]), os.kill, (os.getpid(), signal.SIGKILL))
        timer.daemon = True
        timer.start()

    @rr.server("probed", recovery="keep", health=rr.Health(every_s=0.2, timeout_s=2.0))
    def load_probed(self, request: str) -> str:
        return request

    @load_probed.health
    def probe(self, request: str, response: str) -> None:
        threading.Event().wait(0.15)


@pytest.mark.parametrize("after_s", [0.5, 0.8])
def test_a_crash_that_has_nothing_to_do_with_the_callbacks_that_run_counts(
    start: Start, monkeypatch: pytest.MonkeyPatch, after_s: float
) -> None:
    monkeypatch.setenv("CRASH_AFTER_S", str(after_s))
    system = start(rr.Supervisor([rr.ChildSpec(Crashing, id="shop")], max_seconds=STARTS_S))
    app = system.open_registrar("app")
    hears = Calls()
    for number in range(5):
        with contextlib.suppress(rr.RegistrarDown, rr.SupervisionError):
            app.load("shop/probed", str(number), on_status=hears)
    eventually(lambda: system.ended is not None, timeout=STARTS_S)
    assert f"4 restarts needed within {STARTS_S:g} s" in str(system.ended)
    assert not [status for status in hears if "health" in status.message]


@pytest.mark.parametrize("how", ENDS)
def test_a_health_callback_that_ends_its_process_each_time_loses_the_resource_by_name(
    start: Start, workshop: Workshop, how: str
) -> None:
    system = start(deadly(workshop, how))
    app = system.open_registrar("app")
    hears = Calls()
    lost = app.load("shop/probed", "health", on_status=hears)
    kept = [app.load("shop/probed", f"kept {number}") for number in range(3)]
    workshop.note("armed")
    (status,) = hears.wait(timeout=STARTS_S)  # it waits for 5 s in all, and four processes start
    assert status.state is rr.State.FATAL
    assert "shop/probed: the process died in each of 3 runs of the health callback" in status.message
    assert lost.resource_id in status.message
    died = len(workshop.lines("health health"))
    probed = len(workshop.lines("health kept 0"))
    eventually(lambda: len(workshop.lines("health kept 0")) > probed + 3)
    assert len(workshop.lines("health health")) == died  # it is not probed any more
    assert [query.state for query in kept] == [rr.State.OK] * 3
    lost.unload()
    assert system.ended is None


@pytest.mark.parametrize("how", ENDS)
def test_a_load_in_a_loop_that_ends_its_process_is_refused_for_a_while_and_ends_no_tree(
    start: Start, workshop: Workshop, how: str
) -> None:
    system = start(deadly(workshop, how))
    app = system.open_registrar("app")
    workshop.note("armed")
    with pytest.raises(rr.LoadFailed, match=r"in each of 3 attempts.*the same request is refused for 5 s"):
        app.load("shop/thing", "load")
    refused = 0
    until = time.monotonic() + 1.0
    while time.monotonic() < until:
        with pytest.raises(rr.LoadFailed, match=r"given up once.*refused for 5 s"):
            app.load("shop/thing", "load")
        refused += 1
    assert refused > 10
    assert len(workshop.lines("load load")) == 3
    assert app.load("shop/thing", "another").response == "another"
    assert system.ended is None


KILLED = """
import contextlib, os, signal
import rr_actors as rr
from test_deadly_callbacks import Workshop, deadly
workshop = Workshop({root!r})
system = rr.System([deadly(workshop)], state_dir={state_dir!r}).start()
query = system.open_registrar("app").load("shop/thing", {request!r})
workshop.shut("never")
system.supervisor().terminate_child("shop") if {request!r} == "unload" else None
with contextlib.suppress(rr.RrError):
    query.unload(timeout_s=0.1) if {request!r} == "unload" else None
pids = [child.pid for child in system.supervisor().which_children() if child.pid]
for pid in [*pids, os.getpid()]:
    os.kill(pid, signal.SIGKILL)
"""


@pytest.mark.parametrize("role", ["recover", "unload"])
def test_a_whole_system_starts_on_a_state_directory_whose_callbacks_end_the_process(
    start: Start, workshop: Workshop, state_dir: Path, role: str
) -> None:
    code = KILLED.format(root=str(workshop.root), state_dir=str(state_dir), request=role)
    subprocess.run([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": TEST_PATHS}, check=False)
    workshop.note("armed")
    system = start(deadly(workshop))
    app = system.open_registrar("app")
    assert app.load("shop/other", "works").response == "works"
    phase, state = {"recover": ("loaded", "FATAL"), "unload": ("unload_failed", "unload_failed")}[role]
    eventually(lambda: states(system).get(role) == (phase, state), what=str(states(system)))
    assert len(workshop.lines(f"{role} {role}")) == 3
    assert system.ended is None


def test_a_recover_callback_that_hangs_holds_up_no_other_server_and_is_lost_after_its_time_limit(
    start: Start, workshop: Workshop
) -> None:
    system = start(deadly(workshop))
    app = system.open_registrar("app")
    hears = Calls()
    app.load("shop/thing", "slow", on_status=hears)
    workshop.shut("recover slow")
    kill(system, "shop")
    assert app.load("shop/other", "works", timeout_s=LIMIT_S).response == "works"
    (status,) = hears.wait(timeout=STARTS_S)
    assert status.state is rr.State.FATAL
    assert "shop/thing: lost: the recover callback took longer than recover_timeout_s=1 s" in status.message
    workshop.open("recover slow")


def test_an_unload_whose_provider_is_given_up_fails_and_stays_owed_until_a_later_system_delivers_it(
    start: Start, workshop: Workshop
) -> None:
    system = start(rr.Supervisor([deadly(workshop)], max_restarts=0))
    app = system.open_registrar("app")
    query = app.load("shop/thing", "unload")
    workshop.note("armed")
    with pytest.raises(rr.RegistrarDown, match="1 restart needed within 5 s, 0 allowed"):
        query.unload()
    assert not query.released
    assert app.owed() == [query.id]
    system.stop()
    workshop.note("disarmed")
    system = start(deadly(workshop))
    app = system.open_registrar("app")
    workshop.wait("unload unload", 2)
    eventually(lambda: app.owed() == [])
    assert states(system) == {}


class Ring(rr.Manager):
    """Serves "thing", whose unload callback loads what its request names: "registrar/server request"."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    @rr.server("thing")
    def load_thing(self, request: str) -> str:
        return request

    @load_thing.unload
    def unload_thing(self, request: str, response: str | None) -> None:
        server, _, wanted = request.partition(" ")
        try:
            self.registrar.load(server, wanted or request, timeout_s=LIMIT_S)
        except rr.LoadError as error:
            self.work.note(f"refused {type(error).__name__}", *str(error).split())

    @rr.server("back")
    def load_back(self, request: str) -> str:
        self.registrar.load("one/thing", f"two/back {request}", timeout_s=LIMIT_S)
        return request


@pytest.mark.parametrize("request_", ["one/thing", "two/back x"])
def test_an_unload_callback_that_would_wait_for_itself_is_refused_at_once(
    start: Start, workshop: Workshop, request_: str
) -> None:
    system = start(*(rr.ChildSpec(Ring, id=id, args=(str(workshop.root),)) for id in ("one", "two")))
    app = system.open_registrar("app")
    query = app.load("one/thing", request_)
    began = time.monotonic()
    query.unload()
    assert time.monotonic() - began < LIMIT_S / 2
    assert workshop.lines("refused CircularDependency")
