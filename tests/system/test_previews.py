"""Previews: what system.preview() says is what then happens, on real systems with several trees and catalogs."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import pytest

import rr_actors as rr
from rr_actors.base.errors import NotFound, UsageError
from rr_actors.system.console.console_commands import Kill
from rr_actors.system.console.console_connection import ConsoleConnection, find_console
from support import Calls, Workshop, eventually, kill

Start = Callable[..., rr.System]
Strategy = Literal["one_for_one", "one_for_all", "rest_for_one"]
POLICIES = ("kept", "lost", "again", "found")


class Devices(rr.Manager):
    """Serves devices that survive a crash of their manager in each of the ways there are."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    @rr.server("kept", recovery="keep")
    def open_kept(self, name: str) -> str:
        return self.made("load", name)

    @rr.server("lost", recovery="lost")
    def open_lost(self, name: str) -> str:
        return self.made("load", name)

    @rr.server("again", recovery="reload")
    def open_again(self, name: str) -> str:
        return self.made("load", name)

    @rr.server("found")
    def open_found(self, name: str) -> str:
        return self.made("load", name)

    @open_found.recover
    def find(self, name: str, response: str) -> str:
        return self.made("recover", name)

    def made(self, how: str, name: str) -> str:
        self.work.note(how, name)
        return name


class Robots(rr.Manager):
    """Serves robots, each with the devices that its request names as parts."""

    @rr.server("robot")
    def start_robot(self, parts: tuple[str, ...]) -> str:
        for part in parts:
            policy, _, name = part.partition(":")
            self.registrar.load(f"devices/{policy}", name)
        return " ".join(parts)


@pytest.fixture
def watched(start: Start, workshop: Workshop) -> Callable[[Strategy], rr.System]:
    def started(strategy: Strategy) -> rr.System:
        children = [rr.ChildSpec(Devices, id="devices", args=(str(workshop.root),)), rr.ChildSpec(Robots, id="robots")]
        return start(rr.Supervisor(children, strategy=strategy, max_restarts=5))

    return started


def load_some(app: rr.Registrar, heard: Calls, seed: int) -> dict[str, str]:
    """Load devices and robots, some shared; return what each is, by the id of its resource."""
    numbers = random.Random(seed)
    names: dict[str, str] = {}
    for number in range(6):
        if numbers.random() < 0.5:
            policy = numbers.choice(POLICIES)
            query = app.load(f"devices/{policy}", f"{policy}{number % 3}", on_status=lambda status: heard(status))
        else:
            parts = [f"{policy}:{policy}{numbers.randrange(3)}" for policy in numbers.sample(POLICIES, 2)]
            query = app.load("robots/robot", tuple(parts), on_status=lambda status: heard(status))
        names[query.resource_id] = query.server_id
    return names


@pytest.mark.parametrize("strategy", ["one_for_one", "one_for_all", "rest_for_one"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_kill_does_what_was_foreseen(
    watched: Callable[[Strategy], rr.System], workshop: Workshop, strategy: Strategy, seed: int
) -> None:
    system, heard, events = watched(strategy), Calls(), Calls()
    app = system.open_registrar("app")
    load_some(app, heard, seed)
    unsubscribe = system.subscribe(events)
    began = len(workshop.lines("load"))

    preview = system.preview(kill="devices")
    assert system.preview(kill="root/devices") == preview
    assert len(heard) == 0
    kill(system, "devices")

    def children() -> list[tuple[str, str]]:
        names = {"exited": "dies", "stopped": "stops", "restarted": "starts"}
        told = [event for event in list(events) if event["event"] in names]
        return [(names[event["event"]], event["path"]) for event in told]

    (course,) = preview.supervisors
    expected = [(step.happens, f"root/{step.id}") for step in course.steps]
    eventually(lambda: len(children()) >= len(expected))
    assert children() == expected

    fates: dict[str, set[str]] = {}
    for resource in preview.resources:
        fates.setdefault(resource.becomes, set()).add(resource.id)

    def lost() -> set[str]:
        states = [event for event in list(events) if event["event"] == "status"]
        return {event["resource_id"] for event in states if event["detail"].startswith("FATAL")}

    def ran(how: str, since: int = 0) -> Counter[str]:
        return Counter(line.split()[1] for line in workshop.lines(how)[since:])

    foreseen = {how: Counter(_request(one.name) for one in preview.resources if one.becomes == becomes)
                for how, becomes in (("recover", "recovered"), ("load", "loaded again"))}  # fmt: skip
    eventually(lambda: lost() == fates.get("lost", set()), what=f"{lost} {fates}")
    eventually(lambda: ran("recover") == foreseen["recover"])
    eventually(lambda: ran("load", began) == foreseen["load"])
    told = Counter((one.query_id, one.state) for one in preview.heard if one.holder == "app")
    eventually(lambda: Counter((one.query_id, str(one.state)) for one in list(heard)) == told)
    assert all(one.listens for one in preview.heard if one.holder == "app")
    unsubscribe()
    assert fates.keys() <= {"lost", "recovered", "loaded again"}


def _request(name: str) -> str:
    """The request in a name: devices/lost "lost1"."""
    return name.partition(" ")[2].strip('"')


def what_there_is(system: rr.System) -> dict[str, Any]:
    """The rows of all registrars; without their counts, some of which each look raises."""
    registrars = system.snapshot()["registrars"]
    return {name: {key: facts.get(key) for key in ("resources", "queries")} for name, facts in registrars.items()}


def test_a_preview_changes_nothing(watched: Callable[[Strategy], rr.System], workshop: Workshop) -> None:
    system, heard = watched("one_for_all"), Calls()
    load_some(system.open_registrar("app"), heard, 1)
    before, lines = what_there_is(system), workshop.lines()

    for what in ("kill", "stop", "restart"):
        system.preview(**{what: "devices"})

    assert what_there_is(system) == before
    assert workshop.lines() == lines
    assert len(heard) == 0


def test_a_restart_by_hand_does_what_was_foreseen(watched: Callable[[Strategy], rr.System], workshop: Workshop) -> None:
    system, heard = watched("one_for_one"), Calls()
    load_some(system.open_registrar("app"), heard, 2)
    preview = system.preview(restart="devices")

    system.supervisor().terminate_child("devices")
    system.supervisor().restart_child("devices")

    assert [(step.happens, step.id) for step in preview.supervisors[0].steps] == [
        ("stops", "devices"),
        ("starts", "devices"),
    ]
    told = Counter((one.query_id, one.state) for one in preview.heard if one.holder == "app")
    eventually(lambda: Counter((one.query_id, str(one.state)) for one in list(heard)) == told)
    found = Counter(_request(one.name) for one in preview.resources if one.becomes == "recovered")
    eventually(lambda: Counter(line.split()[1] for line in workshop.lines("recover")) == found)


def test_what_is_stopped_serves_nobody_and_nobody_hears_of_that(watched: Callable[[Strategy], rr.System]) -> None:
    system, heard = watched("one_for_one"), Calls()
    app = system.open_registrar("app")
    app.load("devices/lost", "front", on_status=heard)
    app.load("devices/kept", "back")

    preview = system.preview(stop="devices")

    assert (preview.unserved, preview.resources, preview.heard, preview.ends) == ({"devices": 2}, (), (), False)
    assert "2 resources of devices would have no server" in str(preview)
    system.supervisor().terminate_child("devices")
    assert len(heard) == 0


def test_a_supervisor_that_gives_up_takes_its_managers_with_it(start: Start, workshop: Workshop) -> None:
    inner = rr.Supervisor(
        [rr.ChildSpec(Devices, id="devices", args=(str(workshop.root),)), rr.ChildSpec(Robots, id="robots")],
        id="inner",
        max_restarts=0,
    )
    system, heard = start(rr.Supervisor([inner], max_restarts=3)), Calls()
    query = system.open_registrar("app").load("robots/robot", ("lost:a", "found:b"), on_status=heard)

    preview = system.preview(kill="devices")

    assert [(one.path, one.ends) for one in preview.supervisors] == [("root/inner", True), ("root", False)]
    assert {one.name: one.becomes for one in preview.resources} == {
        'devices/lost "a"': "lost",
        'devices/found "b"': "recovered",
        'robots/robot ["lost:a","found:b"]': "lost",
    }
    system.ref("devices").kill()
    eventually(lambda: [(one.query_id, str(one.state)) for one in list(heard)] == [(query.id, "FATAL")])


def test_an_end_of_the_whole_system_is_foreseen(start: Start, workshop: Workshop) -> None:
    children = [rr.ChildSpec(Devices, id="devices", args=(str(workshop.root),))]
    system = start(rr.Supervisor(children, max_restarts=0))
    system.open_registrar("app").load("devices/kept", "front")

    preview = system.preview(kill="devices")

    assert preview.ends
    assert preview.unserved == {"devices": 1}
    assert "the system would end" in str(preview)


def test_a_dry_run_of_the_console_says_the_same(watched: Callable[[Strategy], rr.System], state_dir: Path) -> None:
    system = watched("rest_for_one")
    app = system.open_registrar("app")
    app.load("devices/lost", "front", on_status=lambda _: None)
    app.load("devices/found", "back")
    app.load("devices/kept", "side")
    preview = system.preview(kill="devices")

    with ConsoleConnection(find_console(state_dir)) as connection:
        told = connection.ask(Kill("devices", dry_run=True))

    assert all(sentence in told.text for sentence in preview.sentences())
    assert preview.sentences() == [
        "root (rest_for_one): robots would stop, devices, robots would start, 1 of 5 restarts in 5 s",
        "1 resource of devices would stay",
        'would be lost: devices/lost "front"',
        'would be recovered: devices/found "back"',
        'app would hear FATAL of devices/lost "front"',
    ]
    assert told.facts["would"]["resources"][0]["becomes"] == "lost"


@pytest.mark.parametrize(
    ("asked", "error", "says"),
    [
        ({}, UsageError, "preview: expected one of kill, stop and restart, got 0"),
        ({"kill": "devices", "stop": "robots"}, UsageError, "expected one of kill, stop and restart, got 2"),
        ({"kill": "nobody"}, NotFound, "nobody"),
        ({"kill": "root"}, UsageError, "preview: kill: expected a child of a supervisor, got 'root'"),
        ({"restart": 3}, UsageError, r"preview: restart: expected a child's id or path, got 3 \(int\)"),
    ],
)
def test_a_wrong_question_is_refused(
    watched: Callable[[Strategy], rr.System], asked: dict[str, Any], error: type[Exception], says: str
) -> None:
    system = watched("one_for_one")

    with pytest.raises(error, match=says):
        system.preview(**asked)
