"""The witnesses of the mission in chaos: each sees what is wrong, and nothing where nothing is."""

from __future__ import annotations

from pathlib import Path

import pytest

from chaos.callback_log import Line
from chaos.mission.mission_checks import (
    allowed,
    check_acts,
    check_choices,
    check_graphs,
    check_kept,
    check_replicas,
    wrong_fatal,
)
from chaos.mission.mission_managers import CHOICES, DESIRED, GRAPH, STEPS, graphs_folder, write_files
from rr_actors.base.values.canonical import encode
from rr_actors.managers import Choose, Kept, RunAction
from rr_actors.managers.actions.graph_documents import feedback, read_graph
from rr_actors.managers.actions.graph_library import GraphLibrary
from rr_actors.managers.actions.graph_runs import Begin, decide, first_run
from rr_actors.managers.choices.chosen import Chosen
from rr_actors.managers.keeper.desired import Replica, parse_desired
from rr_actors.registrar.model.rows import Held, Hold, Phase, Resource, Row, State
from rr_actors.registrar.queries import ResourceInfo
from rr_actors.tools.inspection import Contents


def history(*steps: str) -> list[Line]:
    """Lines of mission m from "act 1/Look 1@7": what, round and action, attempt, process."""
    lines: list[Line] = []
    for at, step in enumerate(steps):
        what, _, rest = step.partition(" ")
        action, _, run = rest.partition(" ")
        attempt, _, pid = run.partition("@")
        lines.append(Line(at, "actions", what, f"m/{action}" if action else "m", int(attempt or 1), int(pid or 1)))
    return lines


@pytest.mark.parametrize(
    "steps",
    [
        ["act 1/Start", "acted 1/Start", "act 1/Fetch", "act 1/Look", "acted 1/Fetch", "act 1/Turn", "act 2/Look"],
        [
            "act 1/Look 1@1",
            "acted 1/Look 1@1",
            "act 1/Look 2@2",
            "act 1/Aim",
            "act 1/Shoot 1@3",
            "act 1/Turn",
            "act 2/Finish",
            "seen-the-end",
        ],
        ["act 1/Look 1@1", "act 1/Look 2@2", "act 1/Look 3@3", "released"],
        ["act 1/Fetch", "act 1/Look", "act 1/Fetch 2@2", "act 1/Look 2@2"],
    ],
)
def test_actions_may_run_side_by_side_and_again_before_their_end_is_on_disk(steps: list[str]) -> None:
    assert check_acts(history(*steps)) == []


@pytest.mark.parametrize(
    ("steps", "says"),
    [
        (["act 1/Start", "act 1/Look", "act 1/Start 2@2"], "1/Start runs after its end was on disk: 1/Look has begun"),
        (["act 1/Shoot", "act 1/Aim 2@2"], "1/Aim runs after its end was on disk: 1/Shoot has begun"),
        (["act 2/Look", "act 1/Turn"], "1/Turn runs after its end was on disk: 2/Look has begun"),
        (["act 3/Finish", "act 2/Turn"], "2/Turn runs after its end was on disk: 3/Finish has begun"),
        (["act 3/Finish", "seen-the-end", "act 3/Finish 2@2"], "runs after its end was on disk: seen-the-end"),
        (["act 1/Look", "released", "act 1/Fetch"], "1/Fetch runs after its end was on disk: released"),
        (["act 1/Look 1@1", "act 1/Look 1@2"], "1/Look runs as attempt 1 after 1"),
        (["act 1/Look 4@1"], "1/Look runs as attempt 4 after 0"),
        (["act 1/Look 1@1", "act 1/Look 2@1"], "1/Look runs twice at once"),
    ],
)
def test_an_action_that_runs_again_is_found(steps: list[str], says: str) -> None:
    (wrong,) = check_acts(history(*steps))
    assert wrong.startswith("mission m: action ")
    assert says in wrong


def held(
    server: str, request: object, resource: str = "r", parent: str = "", id: str = "q", state: State = State.OK
) -> Held:
    registrar, _, name = server.partition("/")
    return Held(id, registrar, name, encode(request), b"", resource, parent, 1, 1, Hold.HELD, state)


def contents(name: str, *rows: Row) -> Contents:
    return Contents(name, Path(name), rows)


def resource(server: str, request: object, response: object, state: State = State.OK, id: str = "r") -> Resource:
    return Resource(id, server, encode(request), encode(response), Phase.LOADED, state, "", 1)


def test_what_an_action_holds_is_needed_while_it_runs() -> None:
    graph = read_graph(GRAPH)
    run, _ = decide(graph, first_run(graph), Begin())
    row = resource("graph", "patrol", feedback(graph, run))

    def wrong(key: str, parent: str = "r") -> list[str]:
        return check_graphs(contents("actions", row, held("actions/action", RunAction("Start", {}, key), "s", parent)))

    assert wrong("r/Start_0/1") == []
    assert ["held by nobody" in one for one in wrong("r/Start_0/2")] == [True]
    assert ["held by nobody" in one for one in wrong("r/Look_0/1")] == [True]
    assert wrong("r/Start_0/1", "") == ["actions: query q is held by nobody"]


def choice(
    present: str, where: Choose = CHOICES[0], part: str = "", state: State = State.OK, trial: str = "", **more: State
) -> list[str]:
    """What is wrong with a choice that says it has `present`, and has `part`, whose resource has this state."""
    server, name = present.split(" ")
    has = (part or present).split(" ")
    rows: list[Row] = [resource("choice", where, Chosen(server, name, "ok", {}))]
    rows.append(held(has[0], has[1], "s", "r", "p", more.get("said", State.OK)))
    if trial:
        on_trial, _, request = trial.partition(" ")
        rows.append(held(on_trial, request, "t", "", "t"))
    providers = {
        name: contents(name, resource("camera", has[1], "ok", state, "s")) for name in ("sensors-1", "sensors-2")
    }
    return check_choices(contents("choices", *rows), providers)


FRONT, LIDAR, SPARE = "sensors-1/camera front", "sensors-2/lidar front", "sensors-2/camera spare"


def test_a_choice_has_one_part_that_works_and_trials_of_what_is_better() -> None:
    assert choice(FRONT) == choice(LIDAR, trial=FRONT) == choice(SPARE, trial=LIDAR) == []
    assert choice(FRONT, trial=SPARE, said=State.ERROR) == []
    assert choice(FRONT, part=LIDAR)[0].endswith(
        """has ['sensors-2/lidar "front"'], and says sensors-1/camera "front\""""
    )
    assert choice(FRONT, state=State.FATAL)[0].endswith(
        """no working alternative: sensors-1/camera "front" is loaded, FATAL"""
    )
    for trial in (FRONT, LIDAR, SPARE):
        assert ["held by nobody" in wrong for wrong in choice(FRONT, trial=trial)] == [True]


def test_a_choice_that_is_lost_says_why_of_each_alternative() -> None:
    for request in CHOICES:
        why = [f"{key}: it broke" for key in allowed(request)]
        assert wrong_fatal(request, "\n".join(["nothing is left", *why])) == ""
        assert why[0].partition(":")[0] in wrong_fatal(request, "\n".join(["nothing is left", *why[1:]]))


def replica(instance: int, id: str, request: str = "radio") -> Resource:
    return resource("replica", Replica("radio", instance, "sensors-1/camera", request), None, id=id)


def test_replicas_are_as_many_as_are_wanted_and_never_two_of_one() -> None:
    one, two = replica(0, "a"), replica(1, "b")
    rows = [one, two, held("keeper/replica", "", "a", id="q1"), held("keeper/replica", "", "b", id="q2")]
    kept = [Kept("radio", 2, 2)]

    assert check_kept(kept, [], contents("keeper", *rows)) == []
    assert check_kept([Kept("radio", 3, 3)], [], contents("keeper", *rows)) == ["keeper: there are 2 replicas of 3"]
    assert check_kept(kept, ["radio: 1 of 2 ready"], contents("keeper", *rows)) == ["keeper: radio: 1 of 2 ready"]
    again = held("keeper/replica", "", "a", id="q3")
    assert check_kept(kept, [], contents("keeper", *rows, again)) == ["keeper: resource a is held 2 times"]
    lost = held("keeper/replica", "", "c", id="q4")
    assert check_kept(kept, [], contents("keeper", *rows, lost)) == ["keeper: a query of c is held by nobody"]


def test_a_second_replica_is_seen_at_any_moment() -> None:
    def info(instance: int, request: str) -> ResourceInfo:
        asked = Replica("radio", instance, "sensors-1/camera", request)
        return ResourceInfo(request, "replica", asked, None, "OK", Phase.LOADED, State.OK, "", 1, (), (), 0)

    assert check_replicas([info(0, "a"), info(1, "b")]) == []
    assert check_replicas([info(0, "a"), info(0, "b")]) == ["keeper: there are 2 replicas of ('radio', 0)"]


def test_the_graphs_and_the_files_of_the_mission_are_right(tmp_path: Path) -> None:
    wanted = {name: parse_desired(text.encode(), name).replicas("keeper/group") for name, text in DESIRED.items()}
    assert {name: len(replicas) for name, replicas in wanted.items()} == {
        "all": 6,
        "less": 4,
        "others": 6,
        "nothing": 0,
    }
    assert [*read_graph(GRAPH).nodes] == [
        f"{name}_0" for name in ("Start", "Look", "Fetch", "Survey", "Turn", "Finish")
    ]
    write_files(tmp_path)
    assert [*GraphLibrary(STEPS, graphs_folder(tmp_path)).look().find("Survey").nodes] == ["Aim_0", "Shoot_0"]
