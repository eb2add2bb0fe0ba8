"""Health: what is loaded is probed, and its holders hear when its state changes."""

from __future__ import annotations

import asyncio
import os
import resource
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import rr_actors as rr
from rr_actors.registrar.model.health import ProbeResult, first_counts, judged
from rr_actors.registrar.model.rows import State
from support import Calls, Gate, eventually, pid_of, serve, wait_gone

Start = Callable[..., rr.System]

OK, WARNING, ERROR, FATAL = State.OK, State.WARNING, State.ERROR, State.FATAL
OFTEN = rr.Health(every_s=0.01, timeout_s=60)
SOON_LATE = rr.Health(every_s=0.02, timeout_s=0.05, fail_after=4)

# -- the decision ------------------------------------------------------------------------------------------------------


def announced(health: rr.Health, results: list[State], begin: State = OK, step_s: float = 1.0) -> list[State | None]:
    """What is announced after each result, if one comes every `step_s`."""
    counts, said = first_counts(begin), list[State | None]()
    for number, result in enumerate(results):
        counts, state = judged(health, counts, ProbeResult(result), number * step_s)
        said.append(state)
    return said


LATE_WARNING = rr.Health(warn_after=2, fail_after=3, pass_after=2)


@pytest.mark.parametrize(
    ("health", "results", "said"),
    [
        (rr.Health(), [OK, OK], [None, None]),
        (rr.Health(), [ERROR, ERROR, ERROR, ERROR, OK], [WARNING, None, ERROR, None, OK]),
        (rr.Health(), [WARNING, WARNING, WARNING, OK], [WARNING, None, None, OK]),
        (rr.Health(), [FATAL], [FATAL]),
        (rr.Health(fail_after=1), [ERROR, WARNING, OK], [ERROR, WARNING, OK]),
        (rr.Health(fail_after=2), [ERROR, WARNING, ERROR, ERROR], [WARNING, None, None, ERROR]),
        (LATE_WARNING, [ERROR, OK, ERROR, ERROR, ERROR], [None, None, None, WARNING, ERROR]),
        (LATE_WARNING, [ERROR, ERROR, OK, ERROR, OK, OK], [None, WARNING, None, None, None, OK]),
        (LATE_WARNING, [ERROR, ERROR, ERROR, OK, WARNING, OK, OK], [None, WARNING, ERROR, None, WARNING, None, OK]),
        (rr.Health(fatal_after_s=3), [ERROR, ERROR, ERROR, ERROR], [WARNING, None, ERROR, FATAL]),
        (rr.Health(fatal_after_s=3), [ERROR, ERROR, OK, ERROR, ERROR], [WARNING, None, OK, WARNING, None]),
        (rr.Health(fatal_after=3), [ERROR, ERROR, ERROR], [WARNING, None, FATAL]),
        (rr.Health(fatal_after=2), [ERROR, WARNING, ERROR, ERROR], [WARNING, None, None, FATAL]),
        (rr.Health(fatal_after=1), [OK, ERROR], [None, FATAL]),
    ],
)
def test_the_state_follows_from_the_results(health: rr.Health, results: list[State], said: list[State | None]) -> None:
    assert announced(health, results) == said


def test_a_resource_that_has_failed_before_the_restart_of_its_process_is_announced_to_be_well() -> None:
    assert announced(rr.Health(), [OK, OK], begin=ERROR) == [OK, None]
    assert announced(rr.Health(), [OK], begin=State.UPDATE) == [None]


def tail(results: list[State], *kinds: State) -> int:
    """How many of the latest results in a row are of these kinds."""
    found = 0
    while found < len(results) and results[-1 - found] in kinds:
        found += 1
    return found


@st.composite
def healths(draw: st.DrawFn) -> rr.Health:
    fail_after = draw(st.integers(1, 4))
    lost = draw(st.none() | st.integers(1, 8))
    return rr.Health(1, 1, draw(st.integers(1, fail_after)), fail_after, draw(st.integers(1, 4)), lost)


@given(healths(), st.lists(st.sampled_from([OK, WARNING, ERROR])))
def test_the_state_after_any_results_is_what_the_latest_in_a_row_say(health: rr.Health, results: list[State]) -> None:
    state = OK
    for number, said in enumerate(announced(health, results), start=1):
        assert said is not state  # only a change is announced
        before, state = state, said or state
        so_far = results[:number]
        failed, passed = tail(so_far, ERROR), tail(so_far, OK)
        lost = health.fatal_after_s is not None and failed > health.fatal_after_s
        if lost:
            assert state is FATAL
            return
        assert (state is ERROR) == (failed >= health.fail_after) or before is ERROR
        assert state is ERROR or failed < health.fail_after
        assert state is OK or passed < health.pass_after
        if before is OK:
            assert (state is OK) == (max(tail(so_far, WARNING, ERROR) - health.warn_after + 1, 0) == 0)
        if state is OK and before is not OK:
            assert passed >= health.pass_after
        if state is WARNING and before is ERROR:
            assert tail(so_far, OK, WARNING) >= health.pass_after


# -- bad input ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("field", "value", "text"),
    [
        ("every_s", 0, "health: every_s: expected a number from 0.01 to 86400, got 0"),
        ("every_s", float("nan"), "health: every_s: expected a number from 0.01 to 86400, got nan"),
        ("timeout_s", -1, "health: timeout_s: expected a number from 0.01 to 86400, got -1"),
        ("timeout_s", "1", "health: timeout_s: expected a number from 0.01 to 86400, got '1'"),
        ("timeout_s", None, "health: timeout_s: expected a number from 0.01 to 86400, got None"),
        ("fatal_after_s", 10**400, "health: fatal_after_s: expected a number from 0.01 to 86400, or None, got "),
        ("warn_after", 0, "health: warn_after: expected a whole number, 1 or more, got 0"),
        ("warn_after", 4, "health: warn_after: expected at most fail_after, 3, got 4"),
        ("fail_after", 1.5, "health: fail_after: expected a whole number, 1 or more, got 1.5"),
        ("pass_after", True, "health: pass_after: expected a whole number, 1 or more, got True"),
        ("fatal_after", 0, "health: fatal_after: expected a whole number, 1 or more, or None, got 0"),
    ],
)
def test_a_wrong_number_is_refused_by_name(field: str, value: Any, text: str) -> None:
    with pytest.raises(rr.InvalidSpec) as caught:
        rr.Health(**{field: value})
    assert str(caught.value).startswith(text)
    assert caught.value.details["field"] == field


def well(request: Any, response: Any) -> None:
    """Find the resource well."""


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"health": {"every_s": 1}, "probe": well}, "server 'cam': health: expected an rr.Health or None, got "),
        ({"health": OFTEN}, "server 'cam': probe: expected a callable, the health callback, as there is a health, got"),
        ({"probe": well}, "server 'cam': probe: expected health=rr.Health(...), without which it is never called, got"),
        ({"health": OFTEN, "probe": 3}, "server 'cam': probe: expected a callable, got 3 (int)"),
        ({"health": OFTEN, "probe": lambda: None}, "server 'cam': probe: "),
    ],
)
def test_a_wrong_option_is_refused_at_once(provider: rr.Registrar, options: dict[str, Any], text: str) -> None:
    with pytest.raises(rr.InvalidSpec) as caught:
        provider.register_server("cam", str, **options)
    assert str(caught.value).startswith(text)
    assert provider.servers() == []


# -- probes ------------------------------------------------------------------------------------------------------------


class Patient:
    """A health callback that returns or raises what the test says, and notes that it was called."""

    def __init__(self, answer: Any = None) -> None:
        self.answer = answer
        self.calls = Calls()

    def __call__(self, request: Any, response: Any) -> Any:
        self.calls(rr.current().resource_id)
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer

    def runs_on(self) -> None:
        """Return when it was called several more times."""
        self.calls.wait(len(self.calls.items) + 3)


def heard(statuses: Calls, count: int) -> list[str]:
    return [str(status) for status in statuses.wait(count)]


def test_holders_hear_of_a_state_when_it_changes_and_never_again(app: rr.Registrar, provider: rr.Registrar) -> None:
    patient, statuses = Patient(), Calls()
    serve(provider, "cam", health=OFTEN, probe=patient)
    query = app.load("provider/cam", 1, on_status=statuses)
    patient.runs_on()
    assert statuses.items == []
    patient.answer = OSError("no answer")
    assert heard(statuses, 2) == ["WARNING: health: OSError: no answer", "ERROR: health: OSError: no answer"]
    patient.runs_on()
    assert (query.state, len(statuses.items)) == (ERROR, 2)
    patient.answer = None
    assert heard(statuses, 3)[2:] == ["OK: health: OK"]
    patient.runs_on()
    assert len(statuses.items) == 3
    assert set(patient.calls.items) == {query.resource_id}


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        (WARNING, "WARNING: health: WARNING"),
        (rr.Status("warning", "dusty lens"), "WARNING: health: dusty lens"),
        (FATAL, "FATAL: health: FATAL"),
        (rr.Status("FATAL", "burnt out"), "FATAL: health: burnt out"),
    ],
)
def test_a_callback_may_return_a_state_or_a_status(
    app: rr.Registrar, provider: rr.Registrar, answer: Any, text: str
) -> None:
    statuses = Calls()
    serve(provider, "cam", health=OFTEN, probe=Patient(answer))
    app.load("provider/cam", 1, on_status=statuses)
    assert heard(statuses, 1) == [text]


@pytest.mark.parametrize("answer", [5, "OK", True, State.UPDATE, rr.Status("UPDATE", "new"), [OK]])
def test_an_answer_that_is_no_health_is_a_failure_that_says_what_was_expected(
    app: rr.Registrar, provider: rr.Registrar, answer: Any
) -> None:
    statuses = Calls()
    serve(provider, "cam", health=OFTEN, probe=Patient(answer))
    app.load("provider/cam", 1, on_status=statuses)
    expected = "InvalidResponse: expected None, or the State OK, WARNING, ERROR or FATAL, or a Status with one, got "
    for text, state in zip(heard(statuses, 2), ("WARNING", "ERROR"), strict=True):
        assert text.startswith(f"{state}: health: {expected}")


def test_a_resource_that_fails_for_too_long_is_lost_and_the_next_load_makes_a_new_one(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    patient = Patient(OSError("no answer"))
    health = rr.Health(every_s=0.01, timeout_s=60, fatal_after_s=0.05)
    serve(provider, "cam", health=health, probe=patient)
    query = app.load("provider/cam", 1)
    assert str(query.wait_status("FATAL", timeout_s=30)) == "FATAL: health: OSError: no answer"
    patient.answer = None
    assert app.load("provider/cam", 1).resource_id != query.resource_id


def test_the_servers_status_callback_hears_of_it_first(app: rr.Registrar, provider: rr.Registrar) -> None:
    statuses, seen = Calls(), Calls()

    def handled(request: Any, status: rr.Status) -> None:
        seen(str(status))
        status.handled()

    serve(provider, "cam", status=handled, health=OFTEN, probe=Patient(OSError("no answer")))
    app.load("provider/cam", 1, on_status=statuses)
    assert seen.wait(2) == ["WARNING: health: OSError: no answer", "ERROR: health: OSError: no answer"]
    assert statuses.items == []


def test_a_callback_that_hangs_fails_and_does_not_begin_again_until_it_has_returned(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    gate, begun, statuses, others = Gate(), Calls(), Calls(), Calls()

    def probe(request: int, response: Any) -> None:
        if request == 1:
            begun(request)
            gate()
        else:
            others(request)

    serve(provider, "cam", health=SOON_LATE, probe=probe)
    app.load("provider/cam", 1, on_status=statuses)
    app.load("provider/cam", 2)
    assert heard(statuses, 2) == [
        "WARNING: health: not returned within 0.05 s",
        "ERROR: health: not returned within 0.05 s",
    ]
    others.wait(len(others.items) + 3)  # one that hangs holds up no other
    assert begun.items == [1]
    gate.open()
    assert heard(statuses, 3)[2:] == ["OK: health: OK"]
    assert len(begun.items) >= 2


def test_an_async_callback_probes_as_well_and_may_hang(app: rr.Registrar, provider: rr.Registrar) -> None:
    statuses, begun, ends = Calls(), Calls(), threading.Event()

    async def probe(request: Any, response: Any) -> None:
        begun(request)
        await asyncio.to_thread(ends.wait, 10)

    serve(provider, "cam", health=SOON_LATE, probe=probe)
    app.load("provider/cam", 1, on_status=statuses)
    assert heard(statuses, 2)[1] == "ERROR: health: not returned within 0.05 s"
    assert begun.items == [1]
    ends.set()
    assert heard(statuses, 3)[2] == "OK: health: OK"


# -- when nothing is probed --------------------------------------------------------------------------------------------


def beside(app: rr.Registrar, patient: Patient) -> None:
    """Return when another resource of the same server was probed several times, in rounds that began after the call."""
    with app.load("provider/cam", "beside") as other:
        before = patient.calls.items.count(other.resource_id)
        eventually(lambda: patient.calls.items.count(other.resource_id) >= before + 3, timeout=30)


def test_nothing_is_probed_while_it_is_loading_paused_or_unloading(app: rr.Registrar, provider: rr.Registrar) -> None:
    patient, gate, closing = Patient(), Gate(), Gate()

    def load(request: str) -> str:
        if request == "front":
            gate()
        return request

    def unload(request: str, response: str) -> None:
        if request == "front":
            closing()

    idle = {"idle": "pause", "pause": well, "resume": well, "recovery": "keep"}
    provider.register_server("cam", load, unload, health=OFTEN, probe=patient, **idle)
    loading = app.load("provider/cam", "front", block=False)
    gate.wait_arrived()
    front = next(info.id for info in provider.resources() if info.request == "front")
    beside(app, patient)
    assert front not in patient.calls.items
    gate.open()
    query = loading.get(timeout=30)
    eventually(lambda: front in patient.calls.items, timeout=30)
    query.standby()
    eventually(lambda: phase(provider, front) == "paused", timeout=30)
    before = patient.calls.items.count(front)
    beside(app, patient)
    assert patient.calls.items.count(front) == before
    query.priority = 0
    eventually(lambda: patient.calls.items.count(front) > before, timeout=30)
    taken = provider.unload(front, force=True, block=False)
    closing.wait_arrived()
    before = patient.calls.items.count(front)
    beside(app, patient)
    assert patient.calls.items.count(front) == before
    closing.open()
    taken.get(timeout=30)


def phase(registrar: rr.Registrar, resource_id: str) -> str:
    return next((info.phase for info in registrar.resources() if info.id == resource_id), "gone")


def test_an_unload_begins_when_a_probe_of_the_resource_has_returned(app: rr.Registrar, provider: rr.Registrar) -> None:
    gate, order = Gate(), Calls()

    def probe(request: Any, response: Any) -> None:
        gate()
        order("probed")

    serve(provider, "cam", unload=lambda request, response: order("unloaded"), health=OFTEN, probe=probe)
    query = app.load("provider/cam", 1)
    gate.wait_arrived()
    unloading = app.unload(query, block=False)
    eventually(lambda: phase(provider, query.resource_id) == "unloading")
    gate.open()
    unloading.get(timeout=30)
    assert order.items[-2:] == ["probed", "unloaded"]


def test_an_unload_does_not_wait_for_a_probe_that_hangs(app: rr.Registrar, provider: rr.Registrar) -> None:
    gate = Gate()
    serve(provider, "cam", health=SOON_LATE, probe=lambda request, response: gate())
    query = app.load("provider/cam", 1)
    gate.wait_arrived()
    query.unload()
    assert provider.resources() == []
    gate.open()


def test_after_an_unregistered_server_nothing_is_probed(app: rr.Registrar, provider: rr.Registrar) -> None:
    first, second = Patient(), Patient()
    serve(provider, "cam", health=OFTEN, probe=first)
    app.load("provider/cam", 1)
    first.runs_on()
    provider.unregister_server("cam")
    count = len(first.calls.items)
    serve(provider, "cam", health=OFTEN, probe=second)
    app.load("provider/cam", 1)
    second.runs_on()
    assert len(first.calls.items) == count


# -- managers ----------------------------------------------------------------------------------------------------------


class Cameras(rr.Manager):
    """The file "broken" says that its cameras fail; "calls" has what its callbacks have done."""

    def __init__(self, folder: str) -> None:
        super().__init__()
        self.folder = Path(folder)
        self.probed = 0

    def probes(self) -> int:
        return self.probed

    def _note(self, what: str) -> None:
        with (self.folder / "calls").open("a") as calls:
            calls.write(f"{what} {os.getpid()}\n")

    @rr.server("cam", health=rr.Health(every_s=0.02, timeout_s=60))
    def open_camera(self, request: str) -> str:
        return request

    @open_camera.health
    def look(self, request: str, response: str) -> None:
        self.probed += 1
        self._note("probed")
        if (self.folder / "broken").exists():
            raise OSError("no picture")

    @open_camera.recover
    def find_again(self, request: str, response: str) -> str:
        while (self.folder / "wait").exists():
            threading.Event().wait(0.01)
        self._note("recovered")
        return response


@pytest.fixture
def cameras(start: Start, tmp_path: Path) -> tuple[rr.System, Callable[[], list[str]]]:
    """A system with cameras, and what returns the lines that their callbacks have written."""

    def calls() -> list[str]:
        file = tmp_path / "calls"
        return file.read_text().splitlines() if file.exists() else []

    return start(rr.ChildSpec(Cameras, id="cameras", kwargs={"folder": str(tmp_path)})), calls


def test_a_process_that_is_killed_and_restored_probes_again_and_says_what_has_changed(
    cameras: tuple[rr.System, Callable[[], list[str]]], tmp_path: Path
) -> None:
    system, calls = cameras
    statuses = Calls()
    (tmp_path / "broken").touch()
    query = system.open_registrar("app").load(Cameras.open_camera, "front", on_status=statuses)
    assert heard(statuses, 2) == ["WARNING: health: OSError: no picture", "ERROR: health: OSError: no picture"]
    pid = int(calls()[-1].split()[1])
    (tmp_path / "broken").unlink()
    (tmp_path / "wait").touch()
    os.kill(pid, signal.SIGKILL)
    wait_gone(pid)
    (tmp_path / "wait").unlink()
    query.wait_status("OK", timeout_s=60)
    later = [line.split()[0] for line in calls() if not line.endswith(f" {pid}")]
    assert later[:2] == ["recovered", "probed"]  # nothing is probed while it is recovering
    assert later.count("recovered") == 1


def test_a_server_that_another_process_registers_is_probed_there(
    start: Start, app: rr.Registrar, tmp_path: Path
) -> None:
    system = start(rr.ChildSpec(Cameras, id="cameras", kwargs={"folder": str(tmp_path)}), state_dir=tmp_path / "other")
    app = system.open_registrar("consumer")
    there = system.registrar("cameras")
    there.register_server("eye", lambda request: request, health=OFTEN, probe=lambda request, response: FATAL)
    assert app.load("cameras/eye", 1).wait_status("FATAL", timeout_s=60).message == "health: FATAL"


def test_a_state_that_a_full_disk_did_not_take_is_announced_when_it_has_room(
    cameras: tuple[rr.System, Callable[[], list[str]]], tmp_path: Path
) -> None:
    system, _ = cameras
    messages = system.ref("cameras").proxy()
    query, pid = system.open_registrar("app").load("cameras/cam", "front"), pid_of(system, "cameras")
    before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (0, before[1]))  # so the callback fails, too
    probed = messages.probes().get()
    eventually(lambda: messages.probes().get() > probed + 5)
    assert query.state is OK
    (tmp_path / "broken").touch()
    resource.prlimit(pid, resource.RLIMIT_FSIZE, before)
    query.wait_status(ERROR, timeout_s=30)
