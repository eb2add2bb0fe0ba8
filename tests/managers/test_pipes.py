"""The pipe manager: what it builds and replaces, with programs that are fakes, and with real ones that are killed."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors.managers import BuiltPipe, LoadComponent, Pipe, Pipes, Program, Programs, RunProgram
from rr_actors.managers.pipes.pipe_files import read_pipe_file
from support import Calls, Workshop, child, eventually, kill, wait_respawned
from support_programs import running_programs

Start = Callable[..., rr.System]


def entry(name: str, inputs: str = "", outputs: str = "", reliability: float = 1.0, type: str = "") -> str:
    """A component whose program waits; each letter is a type of data, of which the program gets the address."""
    addresses = [f'"${{input_{one}}}"' for one in inputs] + [f'"${{output_{one}}}"' for one in outputs]
    return f"""
[[component]]
name = "{name}"
type = "{type or name}"
inputs = {list(inputs)}
outputs = {list(outputs)}
reliability = {reliability}
[component.program]
command = "${{python}}"
arguments = ["-c", "import time; time.sleep(600)", {", ".join(addresses)}]
grace_s = 1
"""


CAMERA = entry("camera", "", "i")
TRACKER = entry("tracker", "i", "t", 0.9)
SPARE = entry("spare", "i", "t", 0.8)


class FakePrograms(rr.Manager):
    """Runs no program. Those of the components that are named in `broken` fail; the journal has what was begun."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)
        self.broken: list[str] = []

    def breaks(self, *names: str) -> None:
        self.broken = [*names]

    @rr.server("program", recovery="keep")
    def run(self, request: RunProgram) -> Program:
        name = request.instance.partition(":")[0]
        self.work.note("run", name)
        if name in self.broken:
            raise rr.LoadFailed(f"{name} is broken")
        return Program(os.getpid(), 0.0)

    @run.unload
    def end(self, request: RunProgram, response: Program | None) -> None:
        self.work.note("end", request.instance.partition(":")[0])


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "pipes.toml"


@pytest.fixture
def work(tmp_path: Path) -> Workshop:
    return Workshop(tmp_path / "work")


@pytest.fixture
def begin(start: Start, file: Path, work: Workshop) -> Callable[..., tuple[rr.System, rr.Registrar]]:
    """Start a system with these entries, whose programs are fakes."""

    def begin(*entries: str, **more: object) -> tuple[rr.System, rr.Registrar]:
        file.write_text("".join(entries))
        pipes = {"registry": str(file), **more}
        system = start(
            rr.ChildSpec(FakePrograms, id="programs", args=(str(work.root),), placement="thread"),
            rr.ChildSpec(Pipes, id="components", kwargs=pipes, placement="thread"),
        )
        return system, system.open_registrar("app")

    return begin


Begin = Callable[..., tuple[rr.System, rr.Registrar]]


def names(pipe: rr.Query[BuiltPipe]) -> list[str]:
    return [one.name for one in pipe.response.segments]


def load(app: rr.Registrar, of_type: str = "t", **more: object) -> rr.Query[BuiltPipe]:
    return app.load("components/pipe", Pipe(of_type, **more), response_type=BuiltPipe)  # type: ignore[arg-type]


def lose(system: rr.System, name: str, status: rr.State = rr.State.FATAL) -> None:
    """Say of the program of a component that it is lost."""
    programs = system.registrar("programs")
    held = [one for one in programs.resources() if one.holders and one.state != "FATAL"]
    (program,) = [one for one in held if one.request.instance.startswith(f"{name}:")]
    programs.send_status(program, rr.Status(status, "unplugged"))


def test_the_segments_meet_at_one_address_and_the_holder_gets_that_of_the_last(begin: Begin) -> None:
    _, app = begin(CAMERA, TRACKER, SPARE)
    with load(app) as pipe:
        camera, tracker = pipe.response.segments
        assert names(pipe) == ["camera", "tracker"]
        assert camera.parameters["output_i"] == tracker.parameters["input_i"]
        assert pipe.response.outputs == {"t": tracker.parameters["output_t"]}
        assert tracker.parameters["output_t"] != tracker.parameters["input_i"]


def test_equal_requests_share_a_pipe_and_an_instance_has_its_own(begin: Begin, work: Workshop) -> None:
    _, app = begin(CAMERA)
    with load(app, "i") as one, load(app, "i") as same, load(app, "i", instance="2") as other:
        assert one.response == same.response
        assert one.response.outputs != other.response.outputs
    assert sorted(work.lines()) == ["end camera", "end camera", "run camera", "run camera"]


def test_a_component_that_cannot_be_run_is_left_out_and_what_stays_is_not_run_again(
    begin: Begin, work: Workshop
) -> None:
    system, app = begin(CAMERA, TRACKER, SPARE)
    system.ref("programs").proxy().breaks("tracker").get()
    with load(app) as pipe:
        assert names(pipe) == ["camera", "spare"]
    with load(app, instance="2") as later:  # it is trusted less now
        assert names(later) == ["camera", "spare"]
    assert work.lines()[:3] == ["run camera", "run tracker", "run spare"]
    assert "run tracker" not in work.lines()[3:]


def test_what_another_chain_does_not_have_is_released(begin: Begin, work: Workshop) -> None:
    system, app = begin(CAMERA, TRACKER, entry("lidar", "", "l", 0.5), entry("matcher", "l", "t"))
    system.ref("programs").proxy().breaks("tracker").get()
    with load(app) as pipe:
        assert names(pipe) == ["lidar", "matcher"]
        assert work.lines() == ["run camera", "run tracker", "end camera", "run lidar", "run matcher"]


def test_when_no_chain_can_be_run_the_error_says_why_for_each_and_nothing_is_left(begin: Begin, work: Workshop) -> None:
    system, app = begin(CAMERA, TRACKER, SPARE)
    system.ref("programs").proxy().breaks("tracker", "spare").get()
    with pytest.raises(rr.LoadFailed, match=r"(?s)no pipe for 't' could be run.*tracker: .*broken.*spare: .*broken"):
        load(app)
    eventually(lambda: work.lines()[-1] == "end camera")
    assert system.registrar("programs").resources() == []


def test_a_segment_that_fails_is_replaced_alone_and_the_addresses_stay(begin: Begin, work: Workshop) -> None:
    system, app = begin(CAMERA, entry("old", "i", "f", 0.9), entry("new", "i", "f", 0.8), entry("tracker", "f", "t"))
    heard = Calls()
    pipe = app.load("components/pipe", Pipe("t"), on_status=heard, response_type=BuiltPipe)
    before = pipe.response
    lose(system, "old")
    (status,) = heard.wait()
    assert status.state is rr.State.UPDATE
    assert names(pipe) == ["camera", "new", "tracker"]
    assert pipe.response.outputs == before.outputs
    assert [pipe.response.segments[place] for place in (0, 2)] == [before.segments[place] for place in (0, 2)]
    addresses = [
        {k: v for k, v in one.segments[1].parameters.items() if "put_" in k} for one in (before, pipe.response)
    ]
    assert addresses[0] == addresses[1]
    eventually(lambda: work.lines() == ["run camera", "run old", "run tracker", "run new", "end old"])
    pipe.unload()
    assert system.registrar("programs").resources() == []


def test_the_only_component_that_fits_takes_its_own_place(begin: Begin) -> None:
    system, app = begin(CAMERA, TRACKER)
    pipe = load(app)
    lose(system, "camera")
    assert pipe.wait_status(timeout_s=20).state is rr.State.UPDATE
    assert names(pipe) == ["camera", "tracker"]


def test_when_nothing_can_take_its_place_the_holders_hear_fatal(begin: Begin) -> None:
    system, app = begin(CAMERA, TRACKER)
    pipe = load(app)
    system.ref("programs").proxy().breaks("tracker").get()
    lose(system, "tracker")
    status = pipe.wait_status(timeout_s=20)
    assert (status.state, status.message) == (rr.State.FATAL, "unplugged")


def test_another_takes_the_place_of_one_that_is_revoked_and_that_one_is_trusted_as_before(begin: Begin) -> None:
    system, app = begin(CAMERA, TRACKER, SPARE)
    pipe = load(app)
    programs = system.registrar("programs")
    (tracker,) = [one for one in programs.resources() if one.request.instance.startswith("tracker:")]
    programs.revoke(tracker.id, "needed elsewhere", grace_s=30)
    assert names(pipe) == ["camera", "spare"]
    assert names(load(app, instance="2")) == ["camera", "tracker"]


def test_a_pipe_ends_with_a_revoked_segment_that_nothing_else_can_be(begin: Begin) -> None:
    system, app = begin(CAMERA, TRACKER)
    pipe = load(app)
    programs = system.registrar("programs")
    (camera,) = [one for one in programs.resources() if one.request.instance.startswith("camera:")]
    programs.revoke(camera.id, "needed elsewhere", grace_s=30)
    status = pipe.wait_status(timeout_s=20)
    assert (status.state, status.reason) == (rr.State.FATAL, "revoked")


def test_without_replacement_the_holders_hear_fatal_at_once(begin: Begin) -> None:
    system, app = begin(CAMERA, TRACKER, SPARE, replace=False)
    pipe = load(app)
    lose(system, "tracker")
    assert pipe.wait_status(timeout_s=20).state is rr.State.FATAL


def test_a_failure_in_a_pipe_counts_for_components_and_the_other_way_round(begin: Begin) -> None:
    alone = 'defaults = { input_i = "x", output_t = "y" }\n[component.program]'
    first, second = entry("first", "i", "t", 0.9, "tracker"), entry("second", "i", "t", 0.8, "tracker")
    system, app = begin(CAMERA, (first + second).replace("[component.program]", alone))
    with load(app) as pipe:
        lose(system, "first")
        pipe.wait_status(rr.State.UPDATE, timeout_s=20)
    with app.load("components/component", LoadComponent("tracker")) as component:
        assert component.response.name == "second"
        assert component.response.parameters["output_t"] == "y"
        lose(system, "second")
        component.wait_status(rr.State.UPDATE, timeout_s=20)
        assert component.response.name == "first"
    with load(app, instance="2") as pipe:
        assert names(pipe) == ["camera", "first"]


WAY = """
[[pipe]]
type = "tags"
[[pipe.segment]]
type = "camera"
outputs = ["i"]
[[pipe.segment]]
type = "tracker"
inputs = ["i"]
outputs = ["t"]
"""


def test_a_described_pipe_has_components_of_its_types_alone(begin: Begin) -> None:
    system, app = begin(
        entry("any", "", "t"), entry("one", "", "i", 0.5, "camera"), entry("two", "", "i", 0.4, "camera"), TRACKER, WAY
    )
    with load(app, "tags") as tags, load(app, "t") as direct:
        assert names(tags) == ["one", "tracker"]
        assert names(direct) == ["any"]
        lose(system, "one")
        tags.wait_status(rr.State.UPDATE, timeout_s=20)
        assert names(tags) == ["two", "tracker"]


# -- what is wrong -------------------------------------------------------------------------------------------------


def test_what_nothing_gives_is_an_error_that_names_what_there_is(begin: Begin) -> None:
    _, app = begin(CAMERA, TRACKER, WAY)
    with pytest.raises(rr.LoadFailed, match=r"of_type: expected one of i, t, tags, got 'tag'.*did you mean 'tags'\?"):
        load(app, "tag")


def test_what_no_chain_ends_in_is_an_error_that_says_what_is_missing(begin: Begin) -> None:
    _, app = begin(entry("tracker", "i", "t"), WAY)
    with pytest.raises(rr.LoadFailed, match=r"(?s)no pipe for 't' can be built:.*tracker takes i: no chain"):
        load(app)
    with pytest.raises(rr.LoadFailed, match=r"(?s)segment 0: there is no component of type 'camera'"):
        load(app, "tags")


@pytest.mark.parametrize(
    ("text", "key", "says"),
    [
        ("[[component]\n", None, "not valid TOML"),
        (CAMERA.replace("inputs", "input"), "component[0].input", "did you mean 'inputs'?"),
        (CAMERA.replace("['i']", "'i'"), "component[0].outputs", "expected a list, got 'i' (str)"),
        (CAMERA.replace("['i']", "['i', 'a/b']"), "component[0].outputs[1]", "letters, digits and _, got 'a/b'"),
        (CAMERA + CAMERA, "component[1].name", "'camera' again"),
        (CAMERA + "[[pipe]]\ntype = 'a'\nsegment = []\n", "pipe[0].segment", "at least one segment, got none"),
        (CAMERA + WAY.replace("outputs", "output", 1), "pipe[0].segment[0].output", "did you mean 'outputs'?"),
        (
            CAMERA + WAY.replace('inputs = ["i"]', ""),
            "pipe[0].segment[1].inputs",
            "expected outputs of the segment before it (i), got [] (list)",
        ),
        (
            CAMERA + WAY.replace('inputs = ["i"]', 'inputs = ["i", "j"]'),
            "pipe[0].segment[1].inputs",
            "expected outputs of the segment before it (i), got ['i', 'j'] (list)",
        ),
        (
            CAMERA + WAY.replace('outputs = ["i"]', 'outputs = ["i"]\ninputs = ["x"]'),
            "pipe[0].segment[0].inputs",
            "expected no inputs, as nothing comes before the first segment",
        ),
        (CAMERA + WAY.replace('outputs = ["t"]', ""), "pipe[0].segment[1].outputs", "at least one output"),
    ],
)
def test_a_wrong_file_is_an_error_with_file_and_key(file: Path, text: str, key: str | None, says: str) -> None:
    file.write_text(text)
    with pytest.raises(rr.ConfigError) as caught:
        read_pipe_file(file)
    assert says in str(caught.value)
    assert caught.value.details["file"] == str(file)
    assert caught.value.details.get("key") == key


def test_a_manager_whose_pipes_do_not_meet_does_not_start(start: Start, file: Path) -> None:
    file.write_text(CAMERA + WAY.replace('inputs = ["i"]', 'inputs = ["j"]'))
    with pytest.raises(rr.StartFailed, match=r"pipe\[0\].segment\[1\].inputs: expected outputs of the segment before"):
        start(rr.ChildSpec(Pipes, id="components", args=(str(file),)))


# -- killed --------------------------------------------------------------------------------------------------------


@pytest.fixture
def real(start: Start, file: Path) -> tuple[rr.System, rr.Registrar]:
    """Real programs: a camera, and two components that can stand behind it."""
    file.write_text(CAMERA + TRACKER + SPARE)
    system = start(rr.ChildSpec(Programs, id="programs"), rr.ChildSpec(Pipes, id="components", args=(str(file),)))
    return system, system.open_registrar("app")


def pids(pipe: rr.Query[BuiltPipe]) -> list[int]:
    return [one.pid for one in pipe.response.segments]


def test_a_segment_that_is_silent_is_replaced_alone(start: Start, file: Path, tmp_path: Path) -> None:
    silent = '[component.health]\nsocket = "${place}/${output_t}"\nevery_s = 0.05\nfail_after = 2\n'
    file.write_text(CAMERA + TRACKER + silent + SPARE)
    system = start(rr.ChildSpec(Programs, id="programs"), rr.ChildSpec(Pipes, id="components", args=(str(file),)))
    with load(system.open_registrar("app"), parameters={"place": str(tmp_path)}) as pipe:
        camera = pipe.response.segments[0]
        pipe.wait_status(rr.State.UPDATE, timeout_s=20)
        assert (names(pipe), pipe.response.segments[0]) == (["camera", "spare"], camera)
        eventually(lambda: sorted(running_programs()) == sorted(pids(pipe)))


def test_a_pipe_outlives_its_manager_and_that_of_the_programs(real: tuple[rr.System, rr.Registrar]) -> None:
    system, app = real
    with load(app) as pipe:
        before = pipe.response
        for id in ("components", "programs"):
            wait_respawned(system, id, kill(system, id))
        assert sorted(running_programs()) == sorted(pids(pipe))
        with load(app) as same:
            assert same.response == pipe.response == before
        os.kill(before.segments[1].pid, signal.SIGKILL)
        pipe.wait_status(rr.State.UPDATE, timeout_s=20)
        assert names(pipe) == ["camera", "spare"]
        assert pids(pipe)[0] == before.segments[0].pid
        eventually(lambda: sorted(running_programs()) == sorted(pids(pipe)))
    eventually(lambda: not running_programs())


def test_a_segment_is_replaced_whatever_moment_the_manager_is_killed_at(real: tuple[rr.System, rr.Registrar]) -> None:
    system, app = real
    with load(app) as pipe:
        camera = pids(pipe)[0]
        for _ in range(3):
            before, manager = pids(pipe)[1], child(system, "components").pid
            assert manager is not None
            os.kill(before, signal.SIGKILL)
            kill(system, "components")
            wait_respawned(system, "components", manager)
            eventually(lambda: sorted(running_programs()) == sorted(pids(pipe)) and pids(pipe)[1] != before)  # noqa: B023
            assert pids(pipe)[0] == camera
            assert pipe.state is rr.State.UPDATE
    eventually(lambda: not running_programs())


def test_a_manager_killed_while_it_builds_leaves_one_pipe(real: tuple[rr.System, rr.Registrar]) -> None:
    system, app = real
    with ThreadPoolExecutor(1) as thread:
        for round in range(3):
            loading = thread.submit(load, app, instance=str(round))
            eventually(running_programs)
            wait_respawned(system, "components", kill(system, "components"))
            pipe = loading.result()
            assert sorted(running_programs()) == sorted(pids(pipe))
            pipe.unload()
            eventually(lambda: not running_programs())
