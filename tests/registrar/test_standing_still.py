"""A manager's process stands still for longer than its time limits, and goes on: nothing is overdue by that."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
import pytest

import rr_actors as rr
from rr_actors.managers import Programs, Ready, RunProgram
from support import Calls, Workshop, eventually, hang, kill, pid_of, states

Start = Callable[..., rr.System]

LIMIT_S = 1.0
STILL_S = 2.5  # longer than the limit
RECOVER_S = 4.0  # longer than on_start waits for it
STRICT = rr.Health(every_s=0.1, timeout_s=LIMIT_S, fail_after=1, fatal_after_s=LIMIT_S)


class Limited(rr.Manager):
    """Has a time limit for each callback, which waits at a step of its name."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    @rr.server("quick")
    def load_quick(self, request: str) -> str:
        return request

    @load_quick.unload
    def unload_quick(self, request: str, response: str) -> None:
        self.work.note("unload", request)

    @rr.server("slow", load_timeout_s=LIMIT_S)
    def load_slow(self, request: str) -> str:
        self.work.step("load", os.getpid())
        return request

    @rr.server("probed", health=STRICT)
    def load_probed(self, request: str) -> str:
        return request

    @load_probed.health
    def look(self, request: str, response: str) -> None:
        self.work.step("look", os.getpid())

    @rr.server("recovered", recover_timeout_s=RECOVER_S)
    def load_recovered(self, request: str) -> str:
        return request

    @load_recovered.recover
    def recover(self, request: str, response: str) -> str:
        self.work.step("recover", os.getpid())
        return response

    @rr.server("whole")
    def load_whole(self, request: str) -> str:
        self.registrar.load("limited/quick", "part")
        return request

    @load_whole.status
    def part_status(self, request: str, status: rr.Status) -> None:
        self.work.step("status", os.getpid())
        self.work.note("unload", "may begin")
        status.handled()

    @load_whole.usage
    def usage(self, request: str, response: str) -> dict[str, float]:
        self.work.step("usage", os.getpid())
        return {"watts": 1.0}


class Standing:
    """A system with one manager, which the test stops at a step of a callback and then resumes."""

    def __init__(self, system: rr.System, workshop: Workshop) -> None:
        self.system, self.workshop = system, workshop
        self.app = system.open_registrar("app")

    def still(self, step: str, still_s: float = STILL_S) -> None:
        """Stop the process when a callback is at the step. Then let it go on, and the callback when it has looked."""
        pid = int(self.workshop.wait(step)[-1].split()[1])
        hang(pid)
        time.sleep(still_s)
        os.kill(pid, signal.SIGCONT)
        with self.app.load("limited/quick", "is its loop there?"):  # which has looked at its timers before
            self.workshop.open(step)


@pytest.fixture
def standing(start: Start, workshop: Workshop) -> Standing:
    return Standing(start(rr.ChildSpec(Limited, id="limited", args=(str(workshop.root),))), workshop)


def test_a_probe_does_not_fail_by_a_standstill(standing: Standing) -> None:
    heard = Calls()
    standing.workshop.shut("look")
    standing.app.load("limited/probed", "front", on_status=heard)
    standing.still("look")
    standing.workshop.wait("look", 3)
    assert states(heard) == []


def test_a_load_is_not_overdue_by_a_standstill(standing: Standing) -> None:
    standing.workshop.shut("load")
    loading = standing.app.load("limited/slow", "it", block=False)
    standing.still("load")
    assert loading.get(timeout=30).response == "it"


def test_a_recovery_is_not_overdue_by_a_standstill(standing: Standing) -> None:
    heard = Calls()
    query = standing.app.load("limited/recovered", "it", on_status=heard)
    standing.workshop.shut("recover")
    kill(standing.system, "limited")
    standing.still("recover", RECOVER_S + 0.5)
    manager = standing.system.registrar("limited")
    assert eventually(lambda: [one.phase for one in manager.resources() if one.id == query.resource_id] == ["loaded"])
    assert states(heard) == []


def test_a_whole_has_its_grace_after_a_standstill(standing: Standing) -> None:
    whole = standing.app.load("limited/whole", "it")
    manager = standing.system.registrar("limited")
    (part,) = [one for one in manager.resources() if one.request == "part"]
    standing.workshop.shut("status")
    revoking = threading.Thread(target=manager.revoke, args=(part.id, "enough"), kwargs={"grace_s": LIMIT_S})
    revoking.start()
    standing.still("status")
    revoking.join(30)
    assert [one.id for one in manager.resources()] == [whole.resource_id]
    unloads = [line for line in standing.workshop.lines("unload") if "loop" not in line]
    assert unloads == ["unload may begin", "unload part"]


def test_a_usage_is_known_after_a_standstill(standing: Standing) -> None:
    whole = standing.app.load("limited/whole", "it")
    manager = standing.system.registrar("limited")
    standing.workshop.shut("usage")
    found: list[Any] = []
    asking = threading.Thread(target=lambda: found.append(manager.usage(timeout_s=LIMIT_S)))
    asking.start()
    standing.still("usage")
    asking.join(30)
    assert [(dict(usages), usages.failures) for usages in found] == [({whole.resource_id: {"watts": 1.0}}, {})]


def test_a_program_may_become_ready_after_a_standstill_of_its_manager(start: Start, tmp_path: Path) -> None:
    system, sign, begun = start(rr.ChildSpec(Programs, id="programs")), tmp_path / "ready", tmp_path / "begun"
    program = RunProgram("sh", ("-c", f"touch {begun}; exec sleep 600"), ready=Ready(file=str(sign), timeout_s=LIMIT_S))
    starting = system.open_registrar("app").load("programs/program", program, block=False)
    eventually(begun.exists)
    pid = pid_of(system, "programs")
    hang(pid)
    time.sleep(STILL_S)
    os.kill(pid, signal.SIGCONT)
    assert len(system.registrar("programs").resources()) == 1
    sign.touch()
    assert starting.get(timeout=30).response.pid


def test_a_program_has_its_grace_after_a_standstill_of_its_shim(start: Start, tmp_path: Path) -> None:
    system, told, go_on = start(rr.ChildSpec(Programs, id="programs")), tmp_path / "told", tmp_path / "go on"
    code = f"trap 'touch {told}' TERM; echo ready; until [ -e '{go_on}' ]; do sleep 0.01; done; touch {tmp_path}/saved"
    program = RunProgram("sh", ("-c", code), ready=Ready(line="ready"), grace_s=LIMIT_S)
    app = system.open_registrar("app")
    query = app.load("programs/program", program)
    stopping = app.unload(query, block=False)
    eventually(told.exists)
    stopped = [psutil.Process(query.response.pid).parent(), psutil.Process(query.response.pid)]
    for process in stopped:
        assert process is not None
        hang(process.pid)
    time.sleep(STILL_S)
    for process in stopped:
        assert process is not None
        process.send_signal(signal.SIGCONT)
    time.sleep(LIMIT_S / 4)  # the shim has looked at the grace
    go_on.touch()
    stopping.get(timeout=30)
    assert (tmp_path / "saved").exists()
