"""Supervision in sentences: intensity, backoff, starts, stops, and what may happen in between. Tables are elsewhere."""

from __future__ import annotations

from typing import Any

import pytest

from rr_actors.base.errors import (
    AlreadyPresent,
    ChildRestarting,
    InvalidSpec,
    NotFound,
    RestartIntensityExceeded,
    StartFailed,
    UsageError,
)
from rr_actors.supervision.core import child_calls, restarts
from rr_actors.supervision.core.child_calls import count_children, get_childspec, update_child, which_children
from rr_actors.supervision.core.specs import Backoff, ChildSpec, Supervisor
from rr_actors.supervision.core.state import Exit, Mode, StartChild, SupervisorState
from support_simulated import Thing, World, child, world


def kill(made: World, id: str) -> None:
    made.exit(id, "killed")
    made.settle()


# -- start ---------------------------------------------------------------------------------------------------------


def test_children_start_in_order_each_when_the_one_before_is_ready() -> None:
    made = World(Supervisor([child("a"), child("b"), child("c")])).start()
    for id in "abc":
        assert list(made.starts) == [id]
        assert not made.started
        made.finish_start(id)
    assert made.started
    assert made.tree.mode is Mode.RUNNING


def test_a_supervisor_without_children_is_ready_at_once() -> None:
    assert World(Supervisor([])).start().started
    assert World(Supervisor([child("x")], strategy="simple_one_for_one")).start().started


def test_starting_a_supervisor_twice_is_an_error() -> None:
    made = world(child("a"))
    with pytest.raises(UsageError, match="root: started twice"):
        made.start()


@pytest.mark.parametrize("strategy", ["one_for_one", "one_for_all", "rest_for_one"])
def test_a_failing_start_stops_those_already_started_in_reverse_and_names_the_child(strategy: Any) -> None:
    made = World(Supervisor([child(id) for id in "abcd"], id="top", strategy=strategy))
    made.outcomes["c"].append("fail")
    made.start().settle()

    assert made.drain()[-5:] == ["fail c", "stop b", "down b", "stop a", "down a"]
    assert not made.started
    assert made.ended is not None
    error: Any = made.ended.error
    assert isinstance(error, StartFailed)
    assert error.details == {"id": "c"}
    assert str(error) == "child top/c did not start: OSError: no"
    assert isinstance(error.__cause__, OSError)
    assert made.ended.reason == "shutdown"


def test_a_child_that_says_ignore_is_kept_but_not_running_unless_temporary() -> None:
    made = World(Supervisor([child("a"), child("b", "temporary"), child("c")]))
    for id in "ab":
        made.outcomes[id].append("ignore")
    made.start().settle()
    assert made.started
    assert made.states() == {"a": "stopped", "c": "running"}
    assert made.answer("start_child", child("d")) == "d"
    made.outcomes["e"].append("ignore")
    assert made.answer("start_child", child("e")) is None
    assert made.states()["e"] == "stopped"


@pytest.mark.parametrize("strategy", ["one_for_one", "one_for_all", "rest_for_one"])
def test_a_child_that_ends_while_later_ones_start_is_restarted_and_waited_for(strategy: Any) -> None:
    made = World(Supervisor([child("a"), child("b"), child("c")], strategy=strategy)).start()
    made.finish_start("a")
    made.exit("a", "killed")
    assert made.states()["a"] == "restarting"
    if strategy == "one_for_one":  # b's start may need a: both go on
        assert set(made.starts) == {"a", "b"}
        made.finish_start("b")
        made.finish_start("c")
        assert not made.started
    made.settle()
    assert made.started
    assert made.states() == dict.fromkeys("abc", "running")
    assert len(made.tree.restarts) == 1


def test_a_start_that_fails_while_the_supervisor_starts_is_a_restart_only_for_a_child_that_was_up() -> None:
    made = World(Supervisor([child("a"), child("b")])).start()
    made.finish_start("a")
    made.exit("a", "killed")
    made.outcomes["a"].append("fail")
    made.finish_start("a")
    assert made.alive
    made.outcomes["b"].append("fail")
    made.finish_start("b")
    assert not made.alive


# -- restart intensity ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("limit", [0, 1, 3, 10])
def test_one_restart_more_than_allowed_ends_the_supervisor(limit: int) -> None:
    made = world(child("a"), child("b"), max_restarts=limit)
    for _ in range(limit):
        kill(made, "a")
    assert made.alive
    kill(made, "a")
    assert made.ended is not None
    assert made.ended.reason == "shutdown"


def test_the_window_is_inclusive_and_slides() -> None:
    made = world(child("a"), max_restarts=2, max_seconds=5)
    for now in (0.0, 4.0, 5.0001, 9.0001):  # never three within 5 s, ends included
        made.now = now
        kill(made, "a")
        assert made.alive
    made.now = 10.0001  # exactly 5 s after the one before the last
    kill(made, "a")
    assert not made.alive


def test_exceeding_it_stops_all_children_in_reverse_and_names_children_times_and_reasons() -> None:
    made = world(child("a"), child("b"), child("c"), max_restarts=1, max_seconds=5)
    made.now = 10.0
    made.exit("a", "abnormal")
    made.settle()
    made.drain()
    made.now = 12.5
    kill(made, "b")

    assert made.drain() == ["stop c", "down c", "stop a", "down a"]
    assert made.ended is not None
    error: Any = made.ended.error
    assert isinstance(error, RestartIntensityExceeded)
    assert error.details["supervisor"] == "root"
    assert error.details["restarts"] == [("a", 2.5, "abnormal"), ("b", 0.0, "killed")]
    assert str(error) == (
        "supervisor root: 2 restarts needed within 5 s, 1 allowed: a 2.5 s ago: abnormal; b 0 s ago: killed"
    )


def test_every_failed_attempt_counts() -> None:
    made = world(child("a"), max_restarts=3)
    made.outcomes["a"].extend(["fail", "fail", "ok"])
    kill(made, "a")
    assert made.alive
    assert [restart.reason for restart in made.tree.restarts] == [
        "killed",
        "start failed: OSError: no",
        "start failed: OSError: no",
    ]
    made.outcomes["a"].append("fail")
    kill(made, "a")
    assert not made.alive


def test_manual_stops_and_starts_never_count() -> None:
    made = world(child("a"), max_restarts=0)
    for _ in range(5):
        made.answer("terminate_child", "a")
        made.answer("restart_child", "a")
        made.outcomes["b"].append("fail")
        with pytest.raises(StartFailed):
            made.answer("start_child", child("b"))
    made.answer("terminate_child", "a")
    made.outcomes["a"].append("fail")
    with pytest.raises(StartFailed):
        made.answer("restart_child", "a")
    assert made.alive
    assert made.states() == {"a": "stopped"}
    assert made.tree.restarts == ()


def test_exits_that_need_no_restart_never_count() -> None:
    made = world(child("a", "transient"), child("b", "temporary"), max_restarts=0)
    made.exit("a", "normal")
    kill(made, "b")
    assert made.alive
    assert made.tree.restarts == ()


def test_a_group_restart_counts_once_however_many_it_concerns() -> None:
    made = world(*(child(id) for id in "abcd"), strategy="one_for_all", max_restarts=1)
    kill(made, "b")
    assert made.alive
    assert [restart.id for restart in made.tree.restarts] == ["b"]


def test_a_supervisor_that_gave_up_is_restarted_by_its_parent_if_permanent_and_not_if_transient() -> None:
    cases: list[tuple[Any, str]] = [("permanent", "running"), ("transient", "stopped")]
    for restart, after in cases:
        parent = world(Supervisor([child("x")], id="inner", restart=restart))
        parent.exit("inner", "shutdown")  # the reason of ExitSupervisor
        parent.settle()
        assert parent.states() == {"inner": after}


# -- group restarts ------------------------------------------------------------------------------------------------


def test_one_for_all_tries_the_whole_group_again_when_one_of_it_fails_to_start() -> None:
    made = world(child("a"), child("b"), child("c"), strategy="one_for_all")
    made.outcomes["b"].append("fail")
    kill(made, "c")
    assert made.drain() == [
        *("stop b", "down b", "stop a", "down a", "start a", "up a", "start b", "fail b"),
        *("stop a", "down a", "start a", "up a", "start b", "up b", "start c", "up c"),
    ]


def test_rest_for_one_tries_again_from_the_one_that_failed_to_start() -> None:
    made = world(child("a"), child("b"), child("c"), child("d"), strategy="rest_for_one")
    made.outcomes["c"].append("fail")
    kill(made, "b")
    assert made.drain() == [
        *("stop d", "down d", "stop c", "down c", "start b", "up b", "start c", "fail c"),
        *("start c", "up c", "start d", "up d"),
    ]
    assert [restart.id for restart in made.tree.restarts] == ["b", "c"]


def test_an_exit_during_a_group_restart_widens_it() -> None:
    made = world(child("a"), child("b"), child("c"), strategy="rest_for_one")
    made.exit("c", "killed")
    assert list(made.starts) == ["c"]
    made.exit("a", "killed")  # concerns b and the c being started, too
    made.settle()
    assert made.drain() == [
        *("start c", "stop c", "down c", "stop b", "down b"),
        *("start a", "up a", "start b", "up b", "start c", "up c"),
    ]
    assert [restart.id for restart in made.tree.restarts] == ["c", "a"]


def test_a_member_that_ends_while_the_group_is_being_stopped_does_not_count() -> None:
    made = world(child("a"), child("b"), child("c"), strategy="one_for_all", max_restarts=1)
    made.exit("a", "killed")
    assert list(made.stops) == ["c"]
    made.exit("b", "killed")  # its turn had not come
    made.exit("c", "killed")  # nor had the stop been done
    made.settle()
    assert made.alive
    assert made.drain()[2:] == ["start a", "up a", "start b", "up b", "start c", "up c"]
    assert len(made.tree.restarts) == 1


def test_a_child_terminated_by_hand_during_a_group_restart_is_left_out_of_it() -> None:
    made = world(child("a"), child("b"), child("c"), strategy="one_for_all")
    made.exit("a", "killed")
    caller = made.call("terminate_child", "b")
    made.settle()
    assert made.replies[caller].error is None
    assert made.states() == {"a": "running", "b": "stopped", "c": "running"}


def test_terminating_the_one_that_keeps_failing_lets_the_rest_of_the_group_go_on() -> None:
    made = world(child("a"), child("b"), child("c"), strategy="rest_for_one", max_restarts=9)
    made.outcomes["b"].extend(["fail", "fail", "fail"])
    made.exit("b", "killed")
    while made.outcomes["b"]:
        made.finish_stop("c") if made.stops else made.finish_start("b")
    made.call("terminate_child", "b")
    made.settle()
    assert made.states() == {"a": "running", "b": "stopped", "c": "running"}


def test_a_start_by_hand_waits_for_its_turn_while_the_group_restarts() -> None:
    made = world(child("a"), child("b"), strategy="one_for_all")
    made.exit("b", "killed")
    caller = made.call("start_child", child("c"))
    assert not made.starts
    made.settle()
    assert made.drain()[-2:] == ["start c", "up c"]
    assert made.replies[caller].id == "c"


def test_a_restart_by_hand_that_its_group_overtakes_is_a_member_from_then_on() -> None:
    made = world(child("a"), child("b"), strategy="one_for_all")
    made.answer("terminate_child", "b")
    caller = made.call("restart_child", "b")
    made.exit("a", "killed")
    made.outcomes["b"].append("fail")
    made.settle()
    assert isinstance(made.replies[caller].error, StartFailed)
    assert made.states() == {"a": "running", "b": "running"}  # tried again, as for any member
    assert [restart.id for restart in made.tree.restarts] == ["a", "b"]


@pytest.mark.parametrize("outcome", ["ok", "fail"])
def test_a_restart_by_hand_of_a_temporary_child_is_answered_though_its_group_restarts(outcome: str) -> None:
    made = world(child("a"), strategy="one_for_all")
    made.answer("update", Supervisor([child("a"), child("t", "temporary")], strategy="one_for_all"))
    caller = made.call("restart_child", "t")
    made.exit("a", "killed")
    made.outcomes["t"].append(outcome)  # type: ignore[arg-type]
    made.settle()
    assert isinstance(made.replies[caller].error, StartFailed) is (outcome == "fail")
    assert made.states() == {"a": "running", "t": "stopped" if outcome == "fail" else "running"}


def test_calls_that_waited_for_it_are_answered_when_the_supervisor_gives_up_over_it() -> None:
    made = world(child("a"), child("b"), strategy="one_for_all", max_restarts=1)
    made.answer("terminate_child", "b")
    callers = [made.call("restart_child", "b"), made.call("delete_child", "b"), made.call("start_child", child("b"))]
    made.exit("a", "killed")
    made.outcomes["b"].append("fail")
    made.settle()
    assert made.ended is not None
    assert set(callers) <= set(made.replies)


def test_a_group_waits_for_a_stop_by_hand() -> None:
    made = world(child("a"), child("b"), child("c"), strategy="one_for_all")
    made.exit("a", "killed")
    made.call("terminate_child", "b")
    made.finish_stop("c")
    assert not made.starts
    made.settle()
    assert made.states() == {"a": "running", "b": "stopped", "c": "running"}


def test_under_one_for_one_a_slow_restart_holds_up_nobody() -> None:
    made = world(child("a"), child("b"))
    made.exit("a", "killed")
    made.exit("b", "killed")
    caller = made.call("start_child", child("c"))
    assert list(made.starts) == ["a", "b", "c"]
    made.finish_start("c")
    assert made.replies[caller].id == "c"
    made.finish_start("b")
    assert made.states() == {"a": "restarting", "b": "running", "c": "running"}


# -- stop ----------------------------------------------------------------------------------------------------------


def test_children_stop_in_reverse_order_one_after_another() -> None:
    made = world(child("a"), child("b"), child("c")).stop()
    assert list(made.stops) == ["c"]
    made.settle()
    assert made.drain() == ["stop c", "down c", "stop b", "down b", "stop a", "down a"]


def test_dynamic_children_stop_all_at_once() -> None:
    made = world(child("x"), strategy="simple_one_for_one")
    for _ in range(3):
        made.answer("start_child", [])
    made.stop()
    assert list(made.stops) == ["x-1", "x-2", "x-3"]


def test_stopping_in_the_middle_of_a_restart_loop_cuts_it_short() -> None:
    made = world(child("a"), child("b", backoff=Backoff(delay_s=30, jitter=0)))
    made.exit("b", "killed")
    assert made.starts["b"].delay_s == 30
    made.stop()
    assert set(made.stops) == {"b", "a"} or set(made.stops) == {"b"}
    made.settle()
    assert made.ended is not None
    assert "up b" not in made.drain()


def test_stopping_a_supervisor_while_it_starts_stops_what_has_started() -> None:
    made = World(Supervisor([child("a"), child("b"), child("c")])).start()
    made.finish_start("a")
    made.stop()
    made.settle()
    assert made.drain() == ["start a", "up a", "start b", "stop b", "down b", "stop a", "down a"]
    assert made.ended is not None
    assert made.ended.error is None
    assert not made.started


def test_stopping_a_supervisor_that_was_never_started_ends_it() -> None:
    made = World(Supervisor([child("a")])).stop()
    assert made.ended is not None
    assert made.drain() == []


def test_callers_whose_start_is_cut_short_by_the_stop_are_told() -> None:
    made = world(child("a"))
    added = made.call("start_child", child("b"))
    waiting = made.call("restart_child", "b")
    made.stop().settle()
    assert isinstance(made.replies[added].error, StartFailed)
    assert isinstance(made.replies[waiting].error, NotFound)


def test_an_exit_while_the_supervisor_stops_is_no_restart() -> None:
    made = world(child("a"), child("b"), max_restarts=0).stop()
    made.exit("a", "killed")
    made.settle()
    assert made.ended is not None
    assert made.ended.error is None
    assert made.drain() == ["stop b", "down b"]


# -- significant children -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("restart", "reason", "ends"),
    [
        ("transient", "normal", True),
        ("transient", "shutdown", True),
        ("transient", "abnormal", False),
        ("transient", "killed", False),
        ("temporary", "normal", True),
        ("temporary", "shutdown", True),
        ("temporary", "abnormal", True),
        ("temporary", "killed", True),
    ],
)
def test_a_significant_child_that_ends_for_good_ends_the_supervisor(restart: str, reason: Any, ends: bool) -> None:
    made = world(child("a"), child("b", restart, significant=True), child("c"), auto_shutdown="any")
    made.exit("b", reason)
    made.settle()
    assert made.alive != ends
    if ends:
        assert made.ended is not None
        assert (made.ended.reason, made.ended.error) == ("shutdown", None)
        assert made.drain() == ["stop c", "down c", "stop a", "down a"]
        assert made.reports[1].event == "auto_shutdown"


def test_with_all_the_last_significant_child_ends_the_supervisor() -> None:
    made = world(
        child("a", "transient", significant=True),
        child("b", "temporary", significant=True),
        child("c", "transient"),
        auto_shutdown="all",
    )
    made.exit("c", "normal")
    made.exit("b", "killed")
    assert made.alive
    made.exit("a", "killed")  # it is restarted: not its end
    made.settle()
    assert made.alive
    made.exit("a", "normal")
    made.settle()
    assert not made.alive


def test_with_all_a_significant_child_that_is_being_restarted_is_still_active() -> None:
    made = world(
        child("a", "transient", significant=True), child("b", "transient", significant=True), auto_shutdown="all"
    )
    made.exit("a", "killed")
    made.exit("b", "normal")
    assert made.alive


def test_stopping_a_significant_child_by_hand_or_with_its_group_does_not_end_the_supervisor() -> None:
    significant = child("b", "temporary", significant=True)
    made = world(child("a"), significant, strategy="one_for_all", auto_shutdown="any")
    kill(made, "a")
    assert made.states() == {"a": "running"}
    made.answer("start_child", significant)
    made.answer("terminate_child", "b")
    assert made.alive


def test_significant_children_cannot_be_added_where_auto_shutdown_is_never() -> None:
    made = world(child("a"))
    with pytest.raises(InvalidSpec, match=r"b\.significant: expected False for 'b', as auto_shutdown is 'never'"):
        made.answer("start_child", child("b", "transient", significant=True))


def test_a_significant_child_that_ends_while_the_supervisor_starts_fails_the_start() -> None:
    spec = Supervisor([child("a", "temporary", significant=True), child("b")], auto_shutdown="any")
    made = World(spec).start()
    made.finish_start("a")
    made.exit("a", "normal")
    made.settle()
    assert made.ended is not None
    assert isinstance(made.ended.error, StartFailed)


# -- dynamic children ----------------------------------------------------------------------------------------------


def test_dynamic_children_get_the_templates_arguments_and_their_own() -> None:
    template = ChildSpec(Thing, id="worker", args=(1,), kwargs={"a": 2})
    made = world(template, strategy="simple_one_for_one")
    caller = made.call("start_child", [2, "three"])
    spec = made.starts["worker-1"].spec
    assert (spec.id, spec.args, spec.kwargs) == ("worker-1", (1, 2, "three"), {"a": 2})
    made.settle()
    assert made.replies[caller].id == "worker-1"
    kill(made, "worker-1")
    assert get_childspec(made.tree, "worker-1").args == (1, 2, "three")
    assert made.tree.children["worker-1"].run == 2


def test_ids_of_dynamic_children_are_never_used_again_nor_longer_than_an_id_may_be() -> None:
    made = world(child("x" * 64), strategy="simple_one_for_one")
    first = made.answer("start_child", [])
    assert first == "x" * 40 + "-1"
    made.answer("terminate_child", first)
    assert made.answer("start_child", []) == "x" * 40 + "-2"

    later = World(made.tree.spec)
    later.tree = SupervisorState.of(made.tree.spec, generation="g2")
    later.start()
    assert later.answer("start_child", []) == "x" * 40 + "-g2.1"
    later.answer("terminate_child", "x" * 40 + "-g2.1")
    with pytest.raises(NotFound):
        later.answer("terminate_child", first)


@pytest.mark.parametrize("argument", [child("y"), "abc", None, {"a": 1}])
def test_a_dynamic_child_is_started_with_a_list_of_arguments(argument: Any) -> None:
    made = world(child("x"), strategy="simple_one_for_one")
    with pytest.raises(InvalidSpec, match="a list of additional arguments, as it is simple_one_for_one"):
        made.answer("start_child", argument)


@pytest.mark.parametrize("argument", [Thing, [1], None])
def test_another_child_is_started_with_a_child_spec(argument: Any) -> None:
    with pytest.raises(InvalidSpec, match="a ChildSpec or Supervisor"):
        world().answer("start_child", argument)


def test_dynamic_children_leave_nothing_behind() -> None:
    made = world(child("x", "transient"), strategy="simple_one_for_one")
    for outcome in ("ok", "fail", "ignore"):
        id = f"x-{made.tree.last_dynamic + 1}"
        made.outcomes[id].append(outcome)  # type: ignore[arg-type]
        made.call("start_child", [])
        made.settle()
        if outcome == "ok":
            made.exit(id, "normal")
    assert made.states() == {}


def test_ten_thousand_dynamic_children_are_no_trouble() -> None:
    made = world(child("x"), strategy="simple_one_for_one")
    for n in range(300):
        made.answer("start_child", [n])
    children = {f"y-{n}": made.tree.children["x-1"] for n in range(10_000)}
    tree = SupervisorState(
        made.tree.spec, "root", Mode.RUNNING, {**made.tree.children, **children}, last_run=made.tree.last_run
    )
    tree, actions = restarts.decide_exit(tree, "x-7", tree.children["x-7"].run, Exit("killed"), 0.0)
    assert [action.id for action in actions if isinstance(action, StartChild)] == ["x-7"]


# -- backoff -------------------------------------------------------------------------------------------------------


def test_each_restart_in_a_row_waits_longer_and_shows_as_restarting() -> None:
    made = world(child("a", backoff=Backoff(delay_s=1, factor=2, maximum_s=60, jitter=0)), max_restarts=9)
    made.outcomes["a"].extend(["fail", "fail"])
    made.exit("a", "killed")
    waits: list[float] = []
    while made.starts:
        waits.append(made.starts["a"].delay_s)
        assert made.states() == {"a": "restarting"}
        made.finish_start("a")
    assert waits == [1, 2, 4]
    assert [report.delay_s for report in made.reports if report.event != "started"] == [1, 2, 4]


def test_the_backoff_starts_over_when_it_has_been_up_for_as_long_as_the_longest_wait() -> None:
    made = world(child("a", backoff=Backoff(delay_s=1, maximum_s=10, jitter=0)))
    for now, expected in ((0, 1), (9, 2), (19, 1), (19, 2)):
        made.now = now
        made.exit("a", "killed")
        assert made.starts["a"].delay_s == expected
        made.finish_start("a")
        assert made.alive
        made.tree = SupervisorState(
            **{**{f: getattr(made.tree, f) for f in SupervisorState.__struct_fields__}, "restarts": ()}
        )


def test_the_jitter_is_the_callers_chance() -> None:
    made = world(child("a", backoff=Backoff(delay_s=8, jitter=0.5)))
    made.chance = 0.5
    made.exit("a", "killed")
    assert made.starts["a"].delay_s == 6


def test_a_backoff_of_no_delay_never_waits_however_many_restarts_there_were() -> None:
    assert Backoff(delay_s=0.0).delay(10_000, 0.0) == 0.0
    assert Backoff(delay_s=0.1, maximum_s=30.0).delay(10_000, 0.0) == 30.0


def test_a_group_waits_for_the_backoff_of_the_one_that_fell() -> None:
    patient = child("b", backoff=Backoff(delay_s=3, jitter=0))
    made = world(child("a"), patient, strategy="one_for_all")
    made.exit("b", "killed")
    made.finish_stop("a")
    assert made.starts["a"].delay_s == 3
    assert made.states() == {"a": "restarting", "b": "restarting"}
    made.finish_start("a")
    assert made.starts["b"].delay_s == 0


def test_without_backoff_a_restart_does_not_wait() -> None:
    made = world(child("a"))
    made.exit("a", "killed")
    assert made.starts["a"].delay_s == 0


def test_a_child_can_be_terminated_while_it_waits() -> None:
    made = world(child("a", backoff=Backoff(delay_s=20)))
    made.exit("a", "killed")
    with pytest.raises(ChildRestarting):
        raise made.replies[made.call("restart_child", "a")].error or AssertionError
    made.call("terminate_child", "a")
    made.finish_stop("a")
    assert made.states() == {"a": "stopped"}
    made.answer("restart_child", "a")
    assert made.states() == {"a": "running"}
    made.exit("a", "killed")
    assert made.starts["a"].delay_s == 20  # as for the first time: the start by hand was a new beginning


def test_a_group_in_which_two_fell_waits_for_the_longer_backoff() -> None:
    children = [child(id, backoff=Backoff(delay_s=delay_s, jitter=0)) for id, delay_s in (("a", 1), ("b", 5))]
    made = world(*children, child("c"), strategy="rest_for_one")
    made.exit("b", "killed")
    made.exit("a", "killed")
    made.finish_stop("c")
    assert made.starts["a"].delay_s == 5


# -- questions -----------------------------------------------------------------------------------------------------


def test_children_are_listed_newest_first() -> None:
    made = world(child("a"), child("b"))
    made.answer("start_child", child("c"))
    assert [c.id for c in which_children(made.tree)] == ["c", "b", "a"]


def test_counts_are_of_specifications_running_children_and_types() -> None:
    inner = Supervisor([], id="inner")
    made = world(child("a"), inner, child("c"))
    made.answer("terminate_child", "c")
    made.exit("a", "killed")
    assert count_children(made.tree) == (3, 1, 1, 2)
    dynamic = world(inner, strategy="simple_one_for_one")
    assert count_children(dynamic.tree) == (1, 0, 0, 0)
    dynamic.answer("start_child", [])
    dynamic.answer("start_child", [])
    dynamic.exit("inner-1", "killed")
    assert count_children(dynamic.tree) == (1, 1, 2, 0)


def test_get_childspec_answers_for_children_in_every_state() -> None:
    made = world(child("a"), child("b"))
    made.answer("terminate_child", "b")
    made.exit("a", "killed")
    assert get_childspec(made.tree, "a") == child("a")
    assert get_childspec(made.tree, "b") == child("b")
    with pytest.raises(NotFound, match=r"supervisor root has no child 'c' \(it has: a, b\)"):
        get_childspec(made.tree, "c")


def test_get_childspec_gives_the_template_by_its_id() -> None:
    template = ChildSpec(Thing, id="worker", args=(1,))
    made = world(template, strategy="simple_one_for_one")
    made.answer("start_child", [2])
    assert get_childspec(made.tree, "worker") == template
    assert get_childspec(made.tree, "worker-1").args == (1, 2)
    with pytest.raises(NotFound):
        get_childspec(made.tree, "worker-2")


# -- update --------------------------------------------------------------------------------------------------------


def test_an_update_keeps_children_adds_new_ones_stopped_and_takes_the_new_order() -> None:
    made = world(child("a"), child("b"), child("c"))
    made.answer("update", Supervisor([child("new"), child("c", "transient"), child("a")], strategy="one_for_all"))
    assert made.states() == {"new": "stopped", "c": "running", "a": "running", "b": "running"}
    assert made.drain() == []
    made.answer("restart_child", "new")
    made.exit("c", "normal")
    assert made.states()["c"] == "stopped"
    kill(made, "a")
    assert made.states() == dict.fromkeys(["new", "c", "a", "b"], "running")


def test_an_updated_child_has_its_new_specification_from_its_next_start_on() -> None:
    made = world(ChildSpec(Thing, id="a", args=[1]))
    made.answer("update", Supervisor([ChildSpec(Thing, id="a", args=[2])]))
    made.exit("a", "killed")
    assert made.starts["a"].spec.args == (2,)


def test_a_temporary_child_that_came_with_an_update_is_kept_until_it_has_run() -> None:
    made = world(child("a"))
    made.answer("update", Supervisor([child("a"), child("t", "temporary")]))
    for outcome in ("ignore", "fail"):
        made.outcomes["t"].append(outcome)  # type: ignore[arg-type]
        made.call("restart_child", "t")
        made.settle()
        assert made.states()["t"] == "stopped"
    made.answer("restart_child", "t")
    kill(made, "t")
    assert made.states() == {"a": "running"}


def test_an_updated_template_is_that_of_all_dynamic_children_from_their_next_start_on() -> None:
    made = world(child("x"), strategy="simple_one_for_one")
    made.answer("start_child", ["own"])
    made.answer("update", Supervisor([ChildSpec(Thing, id="y", args=["new"])], strategy="simple_one_for_one"))
    made.exit("x-1", "killed")
    assert made.starts["x-1"].spec.args == ("new", "own")
    made.settle()
    assert made.answer("start_child", []) == "y-2"


@pytest.mark.parametrize(
    "spec", [Supervisor([], id="other"), Supervisor([child("a")], strategy="simple_one_for_one"), child("a"), None]
)
def test_an_invalid_update_changes_nothing(spec: Any) -> None:
    made = world(child("a"))
    before = made.tree
    with pytest.raises(InvalidSpec, match="update of root"):
        made.answer("update", spec)
    assert made.tree == before


def test_an_update_takes_effect_on_the_intensity_at_once() -> None:
    made = world(child("a"), max_restarts=1)
    kill(made, "a")
    made.answer("update", Supervisor([child("a")], max_restarts=2))
    kill(made, "a")
    assert made.alive


def test_a_group_restart_under_way_is_finished_though_the_strategy_has_changed() -> None:
    made = world(child("a"), child("b"), child("c"), strategy="one_for_all")
    made.exit("c", "killed")
    made.call("update", Supervisor([child("a"), child("b"), child("c")]))
    made.settle()
    assert made.states() == dict.fromkeys("abc", "running")


def test_a_nested_supervisor_that_was_updated_starts_by_its_new_specification() -> None:
    inner = Supervisor([child("x")], id="inner", restart="transient")
    made = world(inner, child("b"))
    made.tree = update_child(made.tree, "inner", Supervisor([child("x"), child("y")], id="inner"))
    made.exit("inner", "killed")
    started = made.starts["inner"].spec
    assert [spec.id for spec in started.actor_class_or_manager.child_specs] == ["x", "y"]  # type: ignore[union-attr]
    assert started.restart == "transient"
    again = SupervisorState.of(made.tree.spec)  # what its own parent would start next time
    assert again.children["inner"].spec == started


def test_only_known_children_can_be_noted_as_updated() -> None:
    with pytest.raises(NotFound):
        update_child(world().tree, "inner", Supervisor([], id="inner"))


# -- reports -------------------------------------------------------------------------------------------------------


def test_each_exit_and_start_is_reported_with_what_follows() -> None:
    made = world(child("a"), child("b", "temporary"), max_restarts=1)
    kill(made, "a")
    made.exit("b", "abnormal")
    seen = [(report.event, report.id, report.state, str(report.exit), report.restarts) for report in made.reports]
    assert seen == [
        ("exited", "a", "restarting", "killed", 1),
        ("started", "a", "running", "None", 0),
        ("exited", "b", None, "abnormal", 0),
    ]
    made.reports.clear()
    kill(made, "a")
    assert [(report.event, report.id, report.restarts) for report in made.reports] == [
        ("exited", "a", 2),
        ("gave_up", "a", 2),
    ]


def test_a_start_is_refused_with_the_reason_when_the_id_is_taken_by_one_being_restarted() -> None:
    made = world(child("a"))
    made.exit("a", "killed")
    with pytest.raises(AlreadyPresent, match=r"start_child\('a'\): root/a exists and is being restarted"):
        raise made.replies[made.call("start_child", child("a"))].error or AssertionError


def test_decisions_never_change_the_tree_they_are_given() -> None:
    made = world(child("a"), child("b"), strategy="one_for_all")
    before = made.tree
    copy = SupervisorState(**{name: getattr(before, name) for name in SupervisorState.__struct_fields__})
    copy_of_children = dict(before.children)
    restarts.decide_exit(before, "a", before.children["a"].run, Exit("killed"), 1.0)
    restarts.decide_stop(before, 1.0)
    child_calls.terminate_child(before, "b", 1, 1.0)
    child_calls.start_child(before, child("c"), 2, 1.0)
    assert before == copy
    assert before.children == copy_of_children
