"""Supervision as tables: every strategy × restart type × exit × state; every call and every event in every state."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import pytest

from rr_actors.base.errors import (
    AlreadyPresent,
    AlreadyStarted,
    ChildRestarting,
    ChildRunning,
    NotForDynamic,
    NotFound,
    RestartIntensityExceeded,
    StartFailed,
)
from rr_actors.supervision.core import restarts
from rr_actors.supervision.core.restarts import needs_restart
from rr_actors.supervision.core.state import ChildPhase, Exit, StopChild
from support_simulated import SHUTDOWN, World, child, world

STRATEGIES = ("one_for_one", "one_for_all", "rest_for_one", "simple_one_for_one")
TYPES = ("permanent", "transient", "temporary")
REASONS = ("normal", "shutdown", "abnormal", "killed")

#                normal  shutdown abnormal killed
RESTARTED = {
    "permanent": (True, True, True, True),
    "transient": (False, False, True, True),
    "temporary": (False, False, False, False),
}


@pytest.mark.parametrize("restart", TYPES)
def test_the_restart_type_and_the_exit_decide_whether_it_is_restarted(restart: Any) -> None:
    assert tuple(needs_restart(restart, reason) for reason in REASONS) == RESTARTED[restart]  # type: ignore[arg-type]


# What is done when b, of a, b and c, ends and is to be restarted.
DONE = {
    "one_for_one": ["start b", "up b"],
    "one_for_all": ["stop c", "down c", "stop a", "down a", "start a", "up a", "start b", "up b", "start c", "up c"],
    "rest_for_one": ["stop c", "down c", "start b", "up b", "start c", "up c"],
    "simple_one_for_one": ["start b", "up b"],
}


def trio(strategy: str, restart: str) -> tuple[World, dict[str, str]]:
    """Children a, b and c, b of that restart type; and their ids (dynamic ones have made-up names)."""
    if strategy != "simple_one_for_one":
        return world(child("a"), child("b", restart), child("c"), strategy=strategy), {id: id for id in "abc"}
    made = world(child("x", restart), strategy=strategy)
    ids = {name: made.answer("start_child", [name]) or "" for name in "abc"}
    made.drain()
    return made, ids


@pytest.mark.parametrize(("strategy", "restart", "reason"), list(product(STRATEGIES, TYPES, REASONS)))
def test_an_exit_concerns_whom_the_strategy_says(strategy: str, restart: str, reason: Any) -> None:
    made, ids = trio(strategy, restart)
    again = RESTARTED[restart][REASONS.index(reason)]

    made.exit(ids["b"], reason)
    at_once = made.states().get(ids["b"])
    made.settle()

    forgotten = not again and (restart == "temporary" or strategy == "simple_one_for_one")
    assert at_once == ("restarting" if again else None if forgotten else "stopped")
    assert made.drain() == [f"{line.split()[0]} {ids[line.split()[1]]}" for line in (DONE[strategy] if again else [])]
    assert made.states() == {
        id: "running" if name != "b" or again else "stopped" for name, id in ids.items() if name != "b" or not forgotten
    }
    assert len(made.tree.restarts) == again


# -- a sibling's state, when another child of its group is killed ----------------------------------------------------


def running(made: World) -> None:
    pass


def stopped_by_hand(made: World) -> None:
    made.answer("terminate_child", "c")


def being_stopped_by_hand(made: World) -> None:
    made.call("terminate_child", "c")


def being_started_by_hand(made: World) -> None:
    made.answer("terminate_child", "c")
    made.call("restart_child", "c")


def ended_by_itself(made: World) -> None:
    made.exit("c", "normal")
    made.settle()


def ignored(made: World) -> None:
    made.answer("terminate_child", "c")
    made.outcomes["c"].append("ignore")
    made.answer("restart_child", "c")


def dying_at_the_same_time(made: World) -> None:
    made.exit("c", "killed")


# state of c, restart type of c, then what becomes of it: with one_for_one; with one_for_all and rest_for_one
SIBLINGS = [
    (running, "permanent", "left", "started"),
    (running, "transient", "left", "started"),
    (running, "temporary", "left", "forgotten"),
    (stopped_by_hand, "permanent", "stopped", "started"),
    (stopped_by_hand, "transient", "stopped", "started"),
    (being_stopped_by_hand, "permanent", "stopped", "started"),
    (being_stopped_by_hand, "transient", "stopped", "started"),
    (being_stopped_by_hand, "temporary", "forgotten", "forgotten"),
    (being_started_by_hand, "permanent", "started", "started"),
    (being_started_by_hand, "transient", "started", "started"),
    (ended_by_itself, "transient", "stopped", "started"),
    (ignored, "permanent", "stopped", "started"),
    (ignored, "transient", "stopped", "started"),
    (dying_at_the_same_time, "permanent", "started", "started"),
    (dying_at_the_same_time, "transient", "started", "started"),
    (dying_at_the_same_time, "temporary", "forgotten", "forgotten"),
]


@pytest.mark.parametrize("strategy", STRATEGIES[:3])
@pytest.mark.parametrize(("prepare", "restart", "alone", "in_group"), SIBLINGS)
def test_what_becomes_of_a_sibling(
    prepare: Callable[[World], None], restart: str, alone: str, in_group: str, strategy: str
) -> None:
    made = world(child("a"), child("b"), child("c", restart), strategy=strategy)
    prepare(made)
    run = made.tree.children["c"].run if "c" in made.tree.children else 0

    made.exit("b", "killed")
    made.settle()

    after = made.tree.children.get("c")
    expected = alone if strategy == "one_for_one" else in_group
    assert (after.state if after else "forgotten") == {"left": "running", "started": "running"}.get(expected, expected)
    if expected == "left":
        assert after is not None
        assert after.run == run
    assert made.states()["a"] == made.states()["b"] == "running"


@pytest.mark.parametrize("strategy", STRATEGIES[:3])
@pytest.mark.parametrize("restart", TYPES)
def test_a_child_that_is_being_added_while_another_is_killed_is_added(strategy: str, restart: str) -> None:
    made = world(child("a"), child("b"), strategy=strategy)
    caller = made.call("start_child", child("c", restart))

    made.exit("b", "killed")
    assert made.states()["c"] == "starting"
    made.settle()

    assert made.replies[caller].id == "c"
    assert made.states() == {"a": "running", "b": "running", "c": "running"}


# -- calls: what is answered in which state ------------------------------------------------------------------------


def in_running() -> World:
    return world(child("a"), child("x"))


def in_stopped() -> World:
    made = in_running()
    made.answer("terminate_child", "x")
    return made


def in_restarting() -> World:
    made = in_running()
    made.exit("x", "killed")
    return made


def in_restart_loop() -> World:
    made = in_restarting()
    made.outcomes["x"].append("fail")
    made.finish_start("x")
    return made


def in_group_restart() -> World:
    made = world(child("a"), child("x"), strategy="one_for_all")
    made.exit("a", "killed")
    return made


def in_unknown() -> World:
    return world(child("a"))


Answers = dict[str, type[Exception] | None]
BUSY: Answers = {"start": AlreadyPresent, "terminate": None, "restart": ChildRestarting, "delete": ChildRestarting}
ANSWERS: list[tuple[Callable[[], World], Answers]] = [
    (in_running, {"start": AlreadyStarted, "terminate": None, "restart": ChildRunning, "delete": ChildRunning}),
    (in_stopped, {"start": AlreadyPresent, "terminate": None, "restart": None, "delete": None}),
    (in_restarting, BUSY),
    (in_restart_loop, BUSY),
    (in_group_restart, BUSY),
    (in_unknown, {"start": None, "terminate": NotFound, "restart": NotFound, "delete": NotFound}),
]
AFTERWARDS = {"start": "running", "terminate": "stopped", "restart": "running", "delete": None}


@pytest.mark.parametrize("call", ["start", "terminate", "restart", "delete"])
@pytest.mark.parametrize(("prepare", "answers"), ANSWERS)
def test_calls_are_answered_as_in_otp(prepare: Callable[[], World], answers: Answers, call: str) -> None:
    made, expected = prepare(), answers[call]
    argument = child("x") if call == "start" else "x"
    if expected is None:
        made.answer(f"{call}_child", argument)
        assert made.states().get("x") == AFTERWARDS[call]
    else:
        before = made.states()
        caller = made.call(f"{call}_child", argument)
        error = made.replies[caller].error  # at once, whatever else goes on
        assert type(error) is expected
        assert error.id == "x"  # type: ignore[attr-defined]
        assert made.states() == before
        made.settle()
    assert made.states()["a"] == "running"
    assert len(made.tree.restarts) == (prepare in (in_restarting, in_group_restart)) + 2 * (prepare is in_restart_loop)


@pytest.mark.parametrize(
    ("call", "argument", "expected"),
    [
        ("restart_child", "x-1", NotForDynamic),
        ("delete_child", "x-1", NotForDynamic),
        ("restart_child", "nobody", NotForDynamic),
        ("terminate_child", "x", NotForDynamic),
        ("terminate_child", "nobody", NotFound),
        ("terminate_child", "x-9", NotFound),
        ("terminate_child", "x-1", None),
    ],
)
def test_calls_under_simple_one_for_one_are_answered_as_in_otp(call: str, argument: str, expected: Any) -> None:
    made = world(child("x"), strategy="simple_one_for_one")
    assert made.answer("start_child", []) == "x-1"
    if expected is None:
        made.answer(call, argument)
        assert made.states() == {}
        made.answer(call, argument)  # it has ended already: as good
    else:
        with pytest.raises(expected):
            made.answer(call, argument)
        assert made.states() == {"x-1": "running"}


# -- a call about a child that somebody is starting or stopping waits for that ----------------------------------------


def while_added(made: World) -> int:
    return made.call("start_child", child("x"))


def while_started_by_hand(made: World) -> int:
    made.answer("start_child", child("x"))
    made.answer("terminate_child", "x")
    return made.call("restart_child", "x")


def while_stopped_by_hand(made: World) -> int:
    made.answer("start_child", child("x"))
    return made.call("terminate_child", "x")


WAITING = [
    (while_added, "ok", {"start": AlreadyStarted, "restart": ChildRunning, "delete": ChildRunning}),
    (while_added, "fail", {"start": None, "restart": NotFound, "delete": NotFound}),
    (while_added, "ignore", {"start": AlreadyPresent, "restart": None, "delete": None}),
    (while_started_by_hand, "ok", {"start": AlreadyStarted, "restart": ChildRunning, "delete": ChildRunning}),
    (while_started_by_hand, "fail", {"start": AlreadyPresent, "restart": None, "delete": None}),
    (while_started_by_hand, "ignore", {"start": AlreadyPresent, "restart": None, "delete": None}),
    (while_stopped_by_hand, "ok", {"start": AlreadyPresent, "restart": None, "delete": None, "terminate": None}),
]


@pytest.mark.parametrize("strategy", STRATEGIES[:3])
@pytest.mark.parametrize(
    ("prepare", "outcome", "call", "expected"),
    [(prepare, outcome, call, want) for prepare, outcome, calls in WAITING for call, want in calls.items()],
)
def test_a_call_waits_for_the_start_or_stop_that_somebody_asked_for(
    prepare: Callable[[World], int], outcome: Any, call: str, expected: type[Exception] | None, strategy: str
) -> None:
    made = world(child("a"), strategy=strategy)
    first = prepare(made)
    made.outcomes["x"].append(outcome)
    second = made.call(f"{call}_child", child("x") if call == "start" else "x")
    assert first not in made.replies
    assert second not in made.replies

    made.settle()

    error = made.replies[second].error
    assert (type(error) if error else None) == expected
    assert (made.replies[first].error is None) == (outcome != "fail")
    assert all(state in ("running", "stopped") for state in made.states().values())


# -- events: what each does in each phase --------------------------------------------------------------------------


def phase_stopped() -> World:
    return in_stopped()


def phase_starting() -> World:
    return in_restarting()


def phase_running() -> World:
    return in_running()


def phase_condemned() -> World:
    made = world(child("a"), child("x"), child("z"), strategy="one_for_all")
    made.exit("a", "killed")  # z is being stopped, x is next
    return made


def phase_recycling() -> World:
    made = phase_condemned()
    made.finish_stop("z")
    return made


def phase_due() -> World:
    made = phase_recycling()
    made.finish_stop("x")  # now a is being started
    return made


def phase_stopping() -> World:
    made = in_running()
    made.call("terminate_child", "x")
    return made


EVENTS = ("started", "ignored", "failed", "exited", "stopped")
NOTHING = None
#                   started          ignored        failed          exited          stopped
PHASES = {
    phase_stopped: (NOTHING, NOTHING, NOTHING, NOTHING, NOTHING),
    phase_due: (NOTHING, NOTHING, NOTHING, NOTHING, NOTHING),
    phase_starting: (ChildPhase.RUNNING, ChildPhase.STOPPED, ChildPhase.STARTING, ChildPhase.STARTING, NOTHING),
    phase_running: (NOTHING, NOTHING, NOTHING, ChildPhase.STARTING, NOTHING),
    phase_condemned: (ChildPhase.CONDEMNED, ChildPhase.DUE, ChildPhase.DUE, ChildPhase.DUE, NOTHING),
    phase_recycling: (NOTHING, NOTHING, NOTHING, NOTHING, ChildPhase.DUE),
    phase_stopping: (NOTHING, NOTHING, NOTHING, NOTHING, ChildPhase.STOPPED),
}


@pytest.mark.parametrize("event", EVENTS)
@pytest.mark.parametrize("prepare", PHASES)
def test_what_each_event_does_in_each_phase(prepare: Callable[[], World], event: str) -> None:
    made, expected = prepare(), PHASES[prepare][EVENTS.index(event)]
    x = made.tree.children["x"]
    assert x.phase.name.lower() == prepare.__name__.removeprefix("phase_")

    def send(run: int) -> tuple[Any, list[Any]]:
        match event:
            case "started" | "ignored":
                return restarts.decide_started(made.tree, "x", run, 1.0, ignored=event == "ignored")
            case "failed":
                return restarts.decide_start_failed(made.tree, "x", run, OSError("no"), 1.0)
            case "exited":
                return restarts.decide_exit(made.tree, "x", run, Exit("killed"), 1.0)
            case _:
                return restarts.decide_stopped(made.tree, "x", run, SHUTDOWN, 1.0)

    tree, actions = send(x.run)
    if expected is NOTHING:
        assert (tree, actions) == (made.tree, [])
    else:
        assert tree.children["x"].phase is expected
        assert tree.children["x"] != x
    assert send(x.run - 1) == (made.tree, []), "a report about an earlier run changes nothing"
    assert restarts.decide_exit(made.tree, "nobody", 1, Exit("killed"), 1.0) == (made.tree, [])


@pytest.mark.parametrize("prepare", [*PHASES, in_restart_loop])
def test_stopping_the_supervisor_ends_it_from_any_state(prepare: Callable[[], World]) -> None:
    made = prepare()
    pending = made.call("start_child", child("new"))
    made.stop()
    assert not made.alive
    made.settle()

    assert made.ended is not None
    assert (made.ended.reason, made.ended.error) == ("shutdown", None)
    assert pending in made.replies
    assert not made.up
    assert set(made.states().values()) <= {"stopped"}
    made.stop()  # once more changes nothing


@pytest.mark.parametrize("prepare", PHASES)
@pytest.mark.parametrize("call", ["start", "terminate", "restart", "delete"])
def test_calls_on_a_supervisor_that_stops_are_answered_not_found(prepare: Callable[[], World], call: str) -> None:
    made = prepare().stop()
    for _ in range(2):  # while it stops, and afterwards
        caller = made.call(f"{call}_child", child("x") if call == "start" else "x")
        assert isinstance(made.replies[caller].error, NotFound)
        made.settle()


def test_the_stop_action_says_how_long_it_may_take() -> None:
    made = world(child("a", shutdown_s=2.5), child("b", shutdown_s="brutal_kill"), child("c", shutdown_s="infinity"))
    made.stop()
    seen: list[StopChild] = []
    while made.stops:
        id, action = next(iter(made.stops.items()))
        seen.append(action)
        made.finish_stop(id)
    assert [(action.id, action.shutdown_s) for action in seen] == [("c", "infinity"), ("b", "brutal_kill"), ("a", 2.5)]


# -- deaths in callbacks of resources ----------------------------------------------------------------------------------


def died(callback: str = "") -> StartFailed:
    """The failure of a start whose process died, perhaps while a callback of a resource ran."""
    return StartFailed("exit code 3 before it was ready", id="b", **({"callback": callback} if callback else {}))


def fails(made: World, id: str, error: StartFailed) -> None:
    run = made.starts.pop(id).run
    made.take(restarts.decide_start_failed(made.tree, id, run, error, made.now))


def test_a_death_in_a_callback_of_a_resource_does_not_count_once_the_next_run_says_so() -> None:
    made = world(child("a"), child("b"))
    for _ in range(20):
        made.exit("b", "killed")
        assert [restart.id for restart in made.tree.restarts] == ["b"]
        made.take(restarts.decide_uncounted(made.tree, "b", made.tree.children["b"].run))
        assert made.tree.restarts == ()
        made.settle()
    assert made.states()["b"] == "running"


def test_a_death_counts_after_all_if_the_callbacks_that_ran_have_ended_well() -> None:
    made = world(child("a"), child("b"))
    for _ in range(made.tree.spec.max_restarts):
        made.exit("b", "killed")
        made.take(restarts.decide_uncounted(made.tree, "b", made.tree.children["b"].run))
        made.settle()
        made.take(restarts.decide_acquitted(made.tree, "b", made.tree.children["b"].run, made.now))
        assert made.states()["b"] == "running"
    assert len(made.tree.restarts) == made.tree.spec.max_restarts
    made.exit("b", "killed")
    made.take(restarts.decide_uncounted(made.tree, "b", made.tree.children["b"].run))
    made.settle()
    made.take(restarts.decide_acquitted(made.tree, "b", made.tree.children["b"].run, made.now))
    assert isinstance(made.tree.error, RestartIntensityExceeded)


def test_deaths_in_a_callback_that_runs_no_more_never_count() -> None:
    made = world(child("a"), child("b"))
    for is_proven in (False, False, True, False):
        made.exit("b", "killed")
        made.take(restarts.decide_uncounted(made.tree, "b", made.tree.children["b"].run, is_proven=is_proven))
        made.settle()
    made.take(restarts.decide_acquitted(made.tree, "b", made.tree.children["b"].run, made.now))
    assert len(made.tree.restarts) == 1


def test_other_deaths_count_beside_those_in_callbacks_of_resources() -> None:
    made = world(child("a"), child("b"))
    made.exit("b", "killed")
    made.settle()
    made.exit("b", "killed")
    made.take(restarts.decide_uncounted(made.tree, "b", made.tree.children["b"].run))
    made.take(restarts.decide_uncounted(made.tree, "b", made.tree.children["b"].run))
    assert [restart.id for restart in made.tree.restarts] == ["b"]


def test_a_late_word_of_an_earlier_run_changes_nothing() -> None:
    made = world(child("a"), child("b"))
    earlier = made.tree.children["b"].run
    made.exit("b", "killed")
    before = made.tree
    assert restarts.decide_uncounted(before, "b", earlier) == (before, [])


def test_a_start_that_died_in_a_callback_of_a_resource_is_made_again_and_must_be_confirmed() -> None:
    made = world(child("a"), child("b"))
    made.exit("b", "killed")
    counted = len(made.tree.restarts)
    for _ in range(20):
        fails(made, "b", died("the recover callback of shop/thing"))
        assert len(made.tree.restarts) == counted
        made.take(restarts.decide_uncounted(made.tree, "b", made.tree.children["b"].run))
        counted = len(made.tree.restarts)
    fails(made, "b", died("the recover callback of shop/thing"))
    fails(made, "b", died("the recover callback of shop/thing"))  # nobody has said that it was so
    assert len(made.tree.restarts) == counted + 1
