"""Idle resources: what nobody needs now is paused, and resumed when somebody does."""

from __future__ import annotations

import math
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.registrar.core.decide import decide
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import effects as e
from rr_actors.registrar.model.catalog import Catalog, Server
from rr_actors.registrar.model.messages import (
    Fetch,
    Fetched,
    Load,
    Loaded,
    LoadRefused,
    Reprioritise,
    Reprioritised,
    Unload,
)
from rr_actors.registrar.model.rows import STANDBY, Hold, Phase, State
from support import eventually


class Log:
    """What the callbacks of a server have done, and what they are to do."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.pause_raises = False
        self.resume_raises = False
        self.go = threading.Event()
        self.go.set()

    def load(self, request: str) -> str:
        self.calls.append(f"load {request}")
        return f"feed {request}"

    def unload(self, request: str, response: str) -> None:
        self.calls.append(f"unload {request}")

    def pause(self, request: str, response: str) -> None:
        self.go.wait(30)
        self.calls.append(f"pause {request}")
        if self.pause_raises:
            raise RuntimeError("jammed")

    def resume(self, request: str, response: str) -> str:
        self.go.wait(30)
        self.calls.append(f"resume {request}")
        if self.resume_raises:
            raise RuntimeError("burnt out")
        return response

    def serve(self, registrar: rr.Registrar, **options: Any) -> None:
        settings = {"idle": "pause", "pause": self.pause, "resume": self.resume} | options
        registrar.register_server("camera", self.load, self.unload, request_type=str, response_type=str, **settings)


@pytest.fixture
def system(tmp_path: Path) -> Iterator[rr.System]:
    with rr.System(state_dir=tmp_path / "state") as system:
        yield system


@pytest.fixture
def provider(system: rr.System) -> rr.Registrar:
    return system.open_registrar("cameras")


@pytest.fixture
def app(system: rr.System) -> rr.Registrar:
    return system.open_registrar("app")


def phases(registrar: rr.Registrar) -> list[str]:
    return [found.phase for found in registrar.resources()]


def is_(registrar: rr.Registrar, *wanted: str) -> Callable[[], bool]:
    return lambda: phases(registrar) == list(wanted)


def test_a_resource_that_nobody_holds_is_paused_and_a_load_resumes_it(
    provider: rr.Registrar, app: rr.Registrar
) -> None:
    log = Log()
    log.serve(provider)
    app.load("cameras/camera", "a").unload()
    eventually(is_(provider, "paused"))
    assert app.load("cameras/camera", "a").response == "feed a"
    assert (phases(provider), log.calls) == (["loaded"], ["load a", "pause a", "resume a"])


def test_a_load_of_a_paused_resource_is_answered_when_it_runs(provider: rr.Registrar, app: rr.Registrar) -> None:
    log = Log()
    log.serve(provider)
    app.load("cameras/camera", "a").unload()
    eventually(is_(provider, "paused"))
    log.go.clear()
    asked = app.load("cameras/camera", "a", block=False)
    eventually(is_(provider, "resuming"))
    assert "resume a" not in log.calls
    log.go.set()
    assert asked.get(timeout=10).response == "feed a"


def test_standby_of_all_holders_pauses_and_a_priority_resumes(provider: rr.Registrar, app: rr.Registrar) -> None:
    log = Log()
    log.serve(provider)
    first = app.load("cameras/camera", "a")
    second = app.load("cameras/camera", "a", priority=None)
    first.standby()
    eventually(is_(provider, "paused"))
    second.priority = 1
    eventually(is_(provider, "loaded"))
    assert log.calls == ["load a", "pause a", "resume a"]


def test_a_load_on_standby_leaves_a_paused_resource_paused(provider: rr.Registrar, app: rr.Registrar) -> None:
    log = Log()
    log.serve(provider)
    app.load("cameras/camera", "a", priority=None)
    eventually(is_(provider, "paused"))
    assert app.load("cameras/camera", "a", priority=None).response == "feed a"
    assert (phases(provider), log.calls) == (["paused"], ["load a", "pause a"])


def test_a_paused_resource_is_unloaded_after_paused_s_if_nobody_holds_it(
    provider: rr.Registrar, app: rr.Registrar
) -> None:
    log = Log()
    log.serve(provider, paused_s=0.05)
    held = app.load("cameras/camera", "held", priority=None)
    app.load("cameras/camera", "a").unload()
    eventually(lambda: "unload a" in log.calls)
    eventually(is_(provider, "paused"))
    held.unload()
    eventually(is_(provider))
    assert "resume held" not in log.calls


def test_a_resource_that_cannot_be_resumed_is_lost_and_the_next_request_makes_a_new_one(
    provider: rr.Registrar, app: rr.Registrar
) -> None:
    log = Log()
    log.serve(provider)
    heard: list[rr.Status] = []
    app.load("cameras/camera", "a", priority=None, on_status=heard.append)
    eventually(is_(provider, "paused"))
    log.resume_raises = True
    with pytest.raises(rr.LoadFailed, match="burnt out"):
        app.load("cameras/camera", "a")
    eventually(lambda: [status.state for status in heard] == [rr.State.FATAL])
    assert app.load("cameras/camera", "a").response == "feed a"
    assert log.calls.count("load a") == 2


def test_a_resource_that_cannot_be_paused_runs_on_for_its_holders(provider: rr.Registrar, app: rr.Registrar) -> None:
    log = Log()
    log.serve(provider)
    log.pause_raises = True
    held = app.load("cameras/camera", "a", priority=None)
    eventually(lambda: log.calls == ["load a", "pause a"])
    eventually(is_(provider, "loaded"))
    held.unload()
    eventually(is_(provider))
    assert "resume a" not in log.calls


def test_forced_unloads_take_a_paused_resource(provider: rr.Registrar, app: rr.Registrar) -> None:
    log = Log()
    log.serve(provider)
    app.load("cameras/camera", "a", priority=None)
    eventually(is_(provider, "paused"))
    provider.unload(provider.resources()[0].id, force=True)
    assert (phases(provider), log.calls[-1]) == ([], "unload a")


def test_a_part_is_paused_after_its_whole_and_resumed_before_it(
    system: rr.System, provider: rr.Registrar, app: rr.Registrar
) -> None:
    log, calls = Log(), []
    log.calls = calls
    log.serve(provider)
    robots = system.open_registrar("robots")

    def build(request: str) -> str:
        robots.load("cameras/camera", request)
        calls.append("load robot")
        return request

    robots.register_server(
        "robot",
        build,
        request_type=str,
        idle="pause",
        pause=lambda request, response: calls.append("pause robot"),
        resume=lambda request, response: calls.append("resume robot"),
    )
    query = app.load("robots/robot", "a")
    query.unload()
    eventually(is_(provider, "paused"))
    app.load("robots/robot", "a")
    assert calls == ["load a", "load robot", "pause robot", "pause a", "resume a", "resume robot"]
    assert (phases(provider), phases(robots)) == (["loaded"], ["loaded"])


def test_a_forced_unload_in_a_resumption_refuses_the_loads_that_wait(provider: rr.Registrar, app: rr.Registrar) -> None:
    log = Log()
    log.serve(provider)
    app.load("cameras/camera", "a").unload()
    eventually(is_(provider, "paused"))
    log.go.clear()
    asked = app.load("cameras/camera", "a", block=False)
    eventually(is_(provider, "resuming"))
    taken = provider.unload(provider.resources()[0].id, force=True, block=False)
    with pytest.raises(rr.LoadFailed):
        asked.get(timeout=10)
    log.go.set()
    taken.get(timeout=10)
    assert (phases(provider), log.calls[-1]) == ([], "unload a")


def nothing(request: str, response: str) -> None:
    pass


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"idle": "sleep"}, "idle"),
        ({"idle": "pause", "pause": nothing}, "resume"),
        ({"idle": "pause", "resume": nothing}, "pause"),
        ({"pause": nothing, "resume": nothing}, "pause"),
        ({"paused_s": 1.0}, "paused_s"),
        ({"idle": "pause", "paused_s": -1, "pause": nothing, "resume": nothing}, "paused_s"),
        ({"idle": "pause", "paused_s": math.nan, "pause": nothing, "resume": nothing}, "paused_s"),
        ({"idle": "pause", "linger_s": math.nan, "pause": nothing, "resume": nothing}, "linger_s"),
    ],
)
def test_a_wrong_idle_policy_is_refused_at_once(provider: rr.Registrar, options: dict[str, Any], field: str) -> None:
    with pytest.raises(rr.InvalidSpec) as caught:
        provider.register_server("camera", str, **options)
    assert caught.value.details["field"] == field


class Lamps(rr.Manager):
    """Pauses; a file of a callback's name says how many of its next runs kill the process."""

    def __init__(self, folder: str) -> None:
        super().__init__()
        self.folder = Path(folder)

    def _note(self, what: str) -> None:
        with (self.folder / "calls").open("a") as calls:
            calls.write(what + "\n")
        with (self.folder / "attempts").open("a") as attempts:
            attempts.write(f"{what} {rr.current().attempt}\n")
        deadly = self.folder / what
        if deadly.exists() and (left := int(deadly.read_text())):
            deadly.write_text(str(left - 1))
            os.kill(os.getpid(), signal.SIGKILL)

    @rr.server("lamp", idle="pause", recovery="keep")
    def light(self, request: str) -> str:
        self._note("load")
        return request

    @light.unload
    def put_out(self, request: str, response: str) -> None:
        self._note("unload")

    @light.pause
    def dim(self, request: str, response: str) -> None:
        self._note("pause")

    @light.resume
    def brighten(self, request: str, response: str) -> None:
        self._note("resume")


@pytest.mark.parametrize("killed", ["pause", "resume"])
def test_a_pause_or_resumption_that_a_crash_interrupts_runs_again(tmp_path: Path, killed: str) -> None:
    (tmp_path / killed).write_text("1")
    spec = rr.ChildSpec(Lamps, id="lamps", kwargs={"folder": str(tmp_path)})
    with rr.System([spec], state_dir=tmp_path / "state") as system:
        app = system.open_registrar("app")
        query = app.load("lamps/lamp", "a", priority=None)
        lamps = system.registrar("lamps")
        eventually(is_(lamps, "paused"), timeout=30)
        query.priority = 0
        eventually(is_(lamps, "loaded"), timeout=30)
        calls = (tmp_path / "calls").read_text().split()
    expected = {"pause": ["load", "pause", "pause", "resume"], "resume": ["load", "pause", "resume", "resume"]}
    attempts = (tmp_path / "attempts").read_text().splitlines()
    assert calls[:4] == expected[killed]
    assert [line for line in attempts if line.startswith(killed)][:2] == [f"{killed} 1", f"{killed} 2"]


def test_a_resumption_that_kills_its_process_three_times_is_given_up(tmp_path: Path) -> None:
    (tmp_path / "resume").write_text("3")
    spec = rr.ChildSpec(Lamps, id="lamps", kwargs={"folder": str(tmp_path)})
    root = rr.Supervisor([spec], max_restarts=10)
    with rr.System(root, state_dir=tmp_path / "state") as system:
        app = system.open_registrar("app")
        query = app.load("lamps/lamp", "a", priority=None)
        eventually(is_(system.registrar("lamps"), "paused"), timeout=30)
        query.priority = 0
        assert query.wait_status(rr.State.FATAL, timeout_s=60).message
        assert (tmp_path / "calls").read_text().split().count("resume") == 3
        assert app.load("lamps/lamp", "a").response == "a"


def test_a_pause_that_kills_its_process_three_times_is_given_up(tmp_path: Path) -> None:
    (tmp_path / "pause").write_text("3")
    root = rr.Supervisor([rr.ChildSpec(Lamps, id="lamps", kwargs={"folder": str(tmp_path)})], max_restarts=10)
    with rr.System(root, state_dir=tmp_path / "state") as system:
        query = system.open_registrar("app").load("lamps/lamp", "a", priority=None)
        calls = tmp_path / "calls"
        eventually(lambda: calls.exists() and calls.read_text().split().count("pause") == 3, timeout=60)
        eventually(is_(system.registrar("lamps"), "loaded"), timeout=60)
        query.unload()
        assert calls.read_text().split() == ["load", "pause", "pause", "pause", "unload"]


# -- revocations and pauses --------------------------------------------------------------------------------------------


@pytest.fixture
def robots(system: rr.System) -> rr.Registrar:
    return system.open_registrar("robots")


def serve_robots(robots: rr.Registrar, calls: list[str], **options: Any) -> None:
    def build(request: str) -> str:
        robots.load("cameras/camera", request)
        return request

    robots.register_server(
        "robot",
        build,
        lambda request, response: calls.append(f"unload robot {request}"),
        request_type=str,
        idle="pause",
        pause=lambda request, response: calls.append(f"pause robot {request}"),
        resume=lambda request, response: calls.append(f"resume robot {request}"),
        **options,
    )


def test_what_is_revoked_while_it_is_paused_is_unloaded_without_being_resumed(
    provider: rr.Registrar, app: rr.Registrar
) -> None:
    log, heard = Log(), list[rr.Status]()
    log.serve(provider)
    app.load("cameras/camera", "held", priority=None, on_status=heard.append)
    app.load("cameras/camera", "free").unload()
    eventually(is_(provider, "paused", "paused"))
    for camera in provider.resources():
        provider.revoke(camera, "battery", grace_s=60, timeout_s=30)
    eventually(lambda: not app.queries())
    assert [(status.state, status.reason) for status in heard] == [(rr.State.FATAL, "revoked")]
    assert not [call for call in log.calls if call.startswith("resume")]
    assert phases(provider) == []


@pytest.fixture
def threads() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor(1) as threads:
        yield threads


def test_a_revocation_in_a_pause_waits_for_the_end_of_the_callback(
    provider: rr.Registrar, app: rr.Registrar, threads: ThreadPoolExecutor
) -> None:
    log = Log()
    log.serve(provider)
    log.go.clear()
    held = app.load("cameras/camera", "a", priority=None)
    eventually(is_(provider, "pausing"))
    gone = threads.submit(provider.revoke, held.resource_id, "battery", grace_s=60)
    eventually(lambda: not app.queries())
    assert (phases(provider), gone.done()) == (["pausing"], False)
    log.go.set()
    gone.result(timeout=30)
    assert log.calls == ["load a", "pause a", "unload a"]


def test_a_revocation_in_a_resumption_refuses_the_loads_that_wait(
    provider: rr.Registrar, app: rr.Registrar, threads: ThreadPoolExecutor
) -> None:
    log = Log()
    log.serve(provider)
    held = app.load("cameras/camera", "a", priority=None)
    eventually(is_(provider, "paused"))
    log.go.clear()
    asked = app.load("cameras/camera", "a", block=False)
    eventually(is_(provider, "resuming"))
    gone = threads.submit(provider.revoke, held.resource_id, "battery", grace_s=60)
    with pytest.raises(rr.LoadFailed, match="battery"):
        asked.get(timeout=30)
    eventually(lambda: not app.queries())
    assert not gone.done()
    log.go.set()
    gone.result(timeout=30)
    assert log.calls == ["load a", "pause a", "resume a", "unload a"]


def test_a_revoked_part_is_unloaded_after_its_whole_and_neither_is_resumed(
    robots: rr.Registrar, provider: rr.Registrar, app: rr.Registrar
) -> None:
    log = Log()
    log.serve(provider)
    serve_robots(robots, log.calls)
    app.load("robots/robot", "a", priority=None)
    eventually(is_(provider, "paused"))
    provider.revoke(provider.resources()[0], "battery", grace_s=60, timeout_s=30)
    assert log.calls == ["load a", "pause robot a", "pause a", "unload robot a", "unload a"]
    assert (phases(robots), phases(provider)) == ([], [])


def test_a_paused_part_of_a_revoked_whole_stays_paused(
    robots: rr.Registrar, provider: rr.Registrar, app: rr.Registrar
) -> None:
    log = Log()
    log.serve(provider)
    serve_robots(robots, log.calls)
    app.load("robots/robot", "a", priority=None)
    eventually(is_(provider, "paused"))
    robots.revoke(robots.resources()[0], "battery", grace_s=60, timeout_s=30)
    assert (phases(robots), phases(provider)) == ([], ["paused"])
    assert app.load("cameras/camera", "a").response == "feed a"
    assert log.calls == ["load a", "pause robot a", "pause a", "unload robot a", "resume a"]


def test_a_paused_whole_puts_another_in_the_place_of_a_revoked_part(
    robots: rr.Registrar, provider: rr.Registrar, app: rr.Registrar
) -> None:
    def on_status(request: str, status: rr.Status) -> None:
        robots.replace_part(status, "b")

    log = Log()
    log.serve(provider)
    serve_robots(robots, log.calls, status=on_status)
    query = app.load("robots/robot", "a", priority=None)
    eventually(is_(provider, "paused"))
    provider.revoke(provider.resources()[0], "battery", grace_s=60, timeout_s=30)
    eventually(lambda: [(found.request, found.phase) for found in provider.resources()] == [("b", "paused")])
    assert phases(robots) == ["paused"]
    query.priority = 1
    eventually(is_(robots, "loaded"))
    assert log.calls[-2:] == ["resume b", "resume robot a"]


def test_a_paused_resource_that_is_not_let_go_is_unloaded_at_the_deadline(
    provider: rr.Registrar, app: rr.Registrar
) -> None:
    log, goes_on = Log(), threading.Event()
    log.serve(provider)
    held = app.load("cameras/camera", "a", priority=None, on_status=lambda status: goes_on.wait(60))
    eventually(is_(provider, "paused"))
    provider.revoke(held.resource_id, "battery", grace_s=0.1, timeout_s=30)
    assert (phases(provider), log.calls) == ([], ["load a", "pause a", "unload a"])
    goes_on.set()
    eventually(lambda: not app.queries())


class Resting:
    """A paused resource "q" with a part; it is a part of another, and is to be resumed for the load "next"."""

    def __init__(self) -> None:
        self.catalog = Catalog("p")
        self.obey(c.Register(Server("cam", pauses=True), "event"))
        self.tell(Fetch("app", True))
        self.tell(Load("q", "cam", b"front", "app", "whole", 1, 1))
        self.obey(c.Reconcile("parts", [], "event"))
        self.obey(c.AskProvider("part", "parts", "lens", b"", "q", 2))
        self.tell(Loaded("part", "lens", b"glass"), "parts")
        self.obey(c.CallbackEnded("load", "q", 1, response=b"feed"))
        self.tell(Reprioritise("q", "app", STANDBY))
        self.obey(c.LingerOver("q"))
        self.obey(c.CallbackEnded("pause", "q", 1))
        self.effects = self.tell(Load("next", "cam", b"front", "app", "", 0, 3))

    def obey(self, command: c.Command) -> list[Any]:
        return self._decide(command, None)

    def tell(self, message: Any, sender: str = "app") -> list[Any]:
        return self._decide(message, sender)

    def _decide(self, item: Any, sender: str | None) -> list[Any]:
        decision = decide(self.catalog, [(item, sender)])
        decision.close()
        return decision.effects

    def phase(self) -> Phase | None:
        resource = self.catalog.resources.get("q")
        return resource and resource.phase


def asked_of_the_part(effects: list[Any]) -> list[int]:
    return [
        it.message.priority for it in effects if isinstance(it, e.SendRequest) and isinstance(it.message, Reprioritise)
    ]


@pytest.mark.parametrize(
    ("command", "phase"),
    [
        (c.ForceUnload("q", "event:force", "ticket"), Phase.UNLOADING),
        (c.Revoke("q", "event:revoke", "battery", 5000, "ticket"), Phase.PAUSED),
        (c.SetStatus("q", "event:status", State.FATAL, "burnt out", "ticket"), Phase.PAUSED),
    ],
)
def test_a_resumption_that_waits_for_a_part_does_not_begin_for_what_is_lost(command: c.Command, phase: Phase) -> None:
    """Its part's provider may be away for long."""
    world = Resting()
    assert (world.phase(), asked_of_the_part(world.effects)[-1]) == (Phase.RESUMING, 0)
    effects = world.obey(command)
    refused = [
        it.message.query_id for it in effects if isinstance(it, e.SendReply) and isinstance(it.message, LoadRefused)
    ]
    assert (world.phase(), refused) == (phase, ["next"])
    after = effects + world.tell(Reprioritised("part", 0), "parts")
    assert "resume" not in [it.role for it in after if isinstance(it, e.StartCallback)]


def test_a_load_that_waits_for_a_resumption_is_answered_after_it_also_over_a_new_link() -> None:
    again = Resting()
    again.catalog.waiting.clear()  # as in the next process, which does not know who waits
    listed = [it.message for it in again.tell(Fetch("app", True)) if isinstance(it, e.SendReply)]
    rows = [row for message in listed if isinstance(message, Fetched) for row in message.queries]
    assert [(row.query_id, row.waits) for row in rows] == [("q", False), ("next", True)]
    asking = Catalog("app")
    for command in (c.AskProvider("next", "p", "cam", b"front", "", 1), c.Reconcile("p", rows[1:], "event")):
        decision = decide(asking, [(command, None)])
        decision.close()
    assert asking.held["next"].hold is Hold.PENDING
    assert not any(isinstance(it, e.LoadResolved) for it in decision.effects)
    assert any(isinstance(it, e.SendRequest) and isinstance(it.message, Load) for it in decision.effects)


def test_a_resumption_that_waits_for_a_part_does_not_begin_for_what_nobody_holds() -> None:
    world = Resting()
    world.tell(Unload("q", "app"))
    assert world.phase() is Phase.RESUMING
    assert STANDBY in asked_of_the_part(world.tell(Unload("next", "app")))
    assert world.phase() is Phase.PAUSED


def test_a_whole_does_not_wait_for_a_part_that_is_lost() -> None:
    """A whole asks the part to run. The part says that it runs, or it is lost, and the whole hears that, too."""
    world = Resting()
    running = e.SendReply("app", Reprioritised("q", 3))
    assert running not in world.tell(Reprioritise("q", "app", 3))
    assert running in world.obey(c.SetStatus("q", "event:status", State.FATAL, "burnt out", "ticket"))
    assert running in world.tell(Reprioritise("q", "app", 3))
