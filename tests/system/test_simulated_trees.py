"""Trees in virtual time: what they do is what real ones do, and wrong scenarios are refused by name."""

from __future__ import annotations

import math
import random
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import rr_actors as rr

STRATEGIES: list[Any] = ["one_for_one", "one_for_all", "rest_for_one"]


class Idle(rr.Actor):
    """A child that does nothing."""


def spec(id: str, **fields: Any) -> rr.ChildSpec:
    return rr.ChildSpec(Idle, id=id, **fields)


def tree(*ids: str, **fields: Any) -> rr.Supervisor:
    return rr.Supervisor([spec(id) for id in ids], **fields)


def told(run: rr.SimulatedRun, since: float = 1.0) -> list[tuple[float, str, str]]:
    """What happened after the start: (seconds, event, id)."""
    return [(round(e["at"], 3), e["event"], e["path"].rpartition("/")[2]) for e in run.events if e["at"] >= since]


def test_the_children_start_one_after_the_other() -> None:
    run = rr.simulate(tree("a", "b"), start_s=0.2, until_s=10)

    assert told(run, 0) == [(0.2, "started", "a"), (0.4, "started", "b")]
    assert run.children["root/b"].availability == pytest.approx(0.96)
    assert run.ended_at is None


@pytest.mark.parametrize(
    ("strategy", "expected"),
    [
        ("one_for_one", [(5.0, "exited", "b"), (5.1, "restarted", "b")]),
        (
            "rest_for_one",
            [(5.0, "exited", "b"), (5.0, "stopped", "c"), (5.1, "restarted", "b"), (5.2, "restarted", "c")],
        ),
        (
            "one_for_all",
            [
                (5.0, "exited", "b"),
                (5.0, "stopped", "c"),
                (5.0, "stopped", "a"),
                (5.1, "restarted", "a"),
                (5.2, "restarted", "b"),
                (5.3, "restarted", "c"),
            ],
        ),
    ],
)
def test_a_death_restarts_whom_the_strategy_names(strategy: Any, expected: list[Any]) -> None:
    run = rr.simulate(tree("a", "b", "c", strategy=strategy), [("b", 5.0)], until_s=10)

    assert told(run) == expected
    assert run.children["root/b"].deaths == 1
    assert run.children["root/c"].restarts == (0 if strategy == "one_for_one" else 1)


def test_a_tree_gives_up_when_the_window_is_full() -> None:
    deaths = [("a", at) for at in (2.0, 3.0, 4.0, 5.0)]
    run = rr.simulate(tree("a", "b", max_restarts=3, max_seconds=5), deaths, until_s=100)

    assert run.gave_up == {"root": 5.0}
    assert run.ended_at == 5.0
    assert isinstance(run.error, rr.RestartIntensityExceeded)
    assert run.children["root/b"].longest_outage_s == pytest.approx(95)
    assert "root gave up after 5.0 s" in str(run)

    calm = rr.simulate(tree("a", "b", max_restarts=3, max_seconds=2.9), deaths, until_s=100)
    assert calm.ended_at is None


def test_a_branch_that_gives_up_is_restarted_by_its_own_supervisor() -> None:
    drive = rr.Supervisor([spec("x"), spec("y")], id="drive", max_restarts=0)
    run = rr.simulate(rr.Supervisor([spec("a"), drive]), [("x", 5.0)], until_s=10)

    assert run.gave_up == {"root/drive": 5.0}
    assert run.ended_at is None
    assert (5.2, "restarted", "drive") in told(run)
    assert run.children["root/drive/y"].restarts == 1


def test_a_supervisors_process_takes_all_below_with_it() -> None:
    drive = rr.Supervisor([spec("x"), rr.Supervisor([spec("y")], id="inner")], id="drive", placement="process")
    run = rr.simulate(rr.Supervisor([drive]), [("drive", 5.0)], until_s=10)

    assert told(run) == [
        (5.0, "exited", "drive"),
        (5.1, "started", "x"),
        (5.2, "started", "y"),
        (5.2, "started", "inner"),
        (5.2, "restarted", "drive"),
    ]
    assert run.children["root/drive/inner/y"].longest_outage_s == pytest.approx(0.2)


def test_backoff_makes_each_restart_wait_longer() -> None:
    backoff = rr.Backoff(delay_s=1, factor=2, maximum_s=60, jitter=0)
    children = [spec("a", backoff=backoff)]
    run = rr.simulate(
        rr.Supervisor(children, max_restarts=9, max_seconds=1), {"a": rr.Child.fails(5)}, until_s=25, start_s=0
    )

    assert [at for at, event, _ in told(run) if event == "restarted"] == pytest.approx([6.2, 13.3, 22.4], abs=0.2)


def test_a_hanging_child_is_replaced_only_with_a_heartbeat() -> None:
    model = {"a": rr.Child.fails(10, hangs=1)}
    with_one = rr.simulate(rr.Supervisor([spec("a", heartbeat_s=2)]), model, until_s=100)
    without = rr.simulate(rr.Supervisor([spec("a")]), model, until_s=100)

    assert 7 <= with_one.children["root/a"].restarts <= 8
    assert all("heartbeat_s" in e.get("detail", "") for e in with_one.events if e["event"] == "exited")
    assert 2 <= with_one.children["root/a"].longest_outage_s <= 3.2
    assert without.children["root/a"].availability == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("stop_s", "shutdown_s", "took_s"),
    [(0.5, 5.0, 0.5), (9.0, 2.0, 2.0), (3.0, "infinity", 3.0), (3.0, "brutal_kill", 0)],
)
def test_a_stop_takes_its_time_or_the_limit(stop_s: float, shutdown_s: Any, took_s: float) -> None:
    children = [spec("a"), spec("b", shutdown_s=shutdown_s)]
    slow = rr.Child.fails(stop_s=stop_s)
    run = rr.simulate(
        rr.Supervisor(children, strategy="one_for_all"), {"a": rr.Child.fails(5), "b": slow}, until_s=5.1 + took_s
    )

    assert told(run, 5) == [(5.1, "exited", "a"), (round(5.1 + took_s, 3), "stopped", "b")]


def test_a_start_that_takes_too_long_is_ended_at_its_limit() -> None:
    children = [spec("a", start_timeout_s=2)]
    run = rr.simulate(rr.Supervisor(children), {"a": rr.Child.fails(start_s=3)}, until_s=60)

    assert run.ended_at == 2.0
    assert isinstance(run.error, rr.StartFailed)
    assert "start_timeout_s" in str(run.error)


def test_a_failed_start_is_tried_again_and_counts() -> None:
    life = rr.Child.fails(50, start_fails=0.4)
    started = [seed for seed in range(40) if rr.simulate(tree("a"), {"a": life}, until_s=1, seed=seed).ended_at is None]
    runs = [rr.simulate(tree("a", max_restarts=50), {"a": life}, until_s=1000, seed=seed) for seed in started]

    failures = sum(e["event"] == "start_failed" for run in runs for e in run.events)
    ends = sum(e["event"] == "exited" for run in runs for e in run.events)
    assert 0.3 < failures / (failures + ends) < 0.5
    assert all(run.ended_at is None for run in runs)


def test_a_death_that_meets_no_process_is_counted_and_changes_nothing() -> None:
    run = rr.simulate(tree("a"), [("a", 5.0), ("a", 5.0)], until_s=10)

    assert run.missed == [("root/a", 5.0)]
    assert run.children["root/a"].deaths == 1
    gone = rr.simulate(tree("a", max_restarts=0), [("a", 5.0), ("a", 6.0)], until_s=10)
    assert gone.ended_at == 5.0
    waiting = rr.Supervisor([spec("a", backoff=rr.Backoff(delay_s=2, jitter=0))])
    assert rr.simulate(waiting, [("a", 5.0), ("a", 6.0)], until_s=10).missed == [("root/a", 6.0)]


def test_no_code_of_the_classes_runs() -> None:
    class Loud(rr.Actor):
        def __init__(self) -> None:
            raise AssertionError

    threads = threading.active_count()
    rr.simulate(rr.Supervisor([rr.ChildSpec(Loud, id="loud")]), {"loud": rr.Child.fails(3)}, until_s=60)

    assert threading.active_count() == threads


def test_a_dynamic_supervisor_is_simulated_without_children() -> None:
    pool = rr.Supervisor([spec("worker")], id="pool", strategy="simple_one_for_one")
    run = rr.simulate(rr.Supervisor([pool]), until_s=10)

    assert list(run.children) == ["root/pool"]
    assert run.children["root/pool"].availability == 1


@given(
    st.sampled_from(STRATEGIES),
    st.integers(0, 4),
    st.floats(0.5, 30),
    st.lists(st.tuples(st.sampled_from("abcd"), st.floats(1, 59)), max_size=12),
    st.integers(0, 1000),
)
def test_each_run_keeps_the_promises_of_a_supervisor(
    strategy: Any, most: int, window_s: float, deaths: list[tuple[str, float]], seed: int
) -> None:
    what = tree("a", "b", "c", "d", strategy=strategy, max_restarts=most, max_seconds=window_s)
    run = rr.simulate(what, deaths, until_s=60, seed=seed)

    assert rr.simulate(what, deaths, until_s=60, seed=seed).events == run.events
    counted = [e["at"] for e in run.events if e["event"] in ("exited", "start_failed") and e.get("restarts")]
    for index, at in enumerate(counted):
        within = sum(at - window_s <= other <= at for other in counted[: index + 1])
        assert within <= most + 1
        assert (within == most + 1) <= (run.ended_at is not None)
    assert (run.ended_at is None) == (run.error is None)
    for path, child in run.children.items():
        lives = [e["event"] for e in run.events if e["path"] == path and e["event"] in ("started", "restarted")]
        assert child.restarts == max(0, len(lives) - 1)
        assert 0 <= child.up_s <= 60
        assert child.up_s + child.longest_outage_s <= 60 + 1e-6


@given(st.integers(0, 100))
def test_a_strategy_does_not_change_when_a_child_dies(seed: int) -> None:
    life = {"a": rr.Child.fails(rr.Exponential(20)), "b": rr.Child.fails(rr.Uniform(5, 10))}
    first: dict[str, list[tuple[float, str]]] = {}
    for strategy in STRATEGIES:
        run = rr.simulate(tree("a", "b", strategy=strategy), life, until_s=200, seed=seed)
        first[strategy] = [(e["at"], e["path"]) for e in run.events if e["event"] == "exited"][:1]

    assert len({tuple(each) for each in first.values()}) == 1


# -- experiments -------------------------------------------------------------------------------------------------------


def test_an_experiment_has_a_row_for_each_combination() -> None:
    life = {"lidar": rr.Child.fails(rr.Exponential(30), start_s=2)}
    found = rr.experiment(
        tree("lidar", "maps"),
        life,
        vary={"max_restarts": [1, 3], "max_seconds": [5.0, 60.0], "lidar.backoff": [None, rr.Backoff(delay_s=5)]},
        runs=5,
        until_s=600,
    )

    assert len(found.rows) == 8
    by_setting = {(row["max_restarts"], row["max_seconds"]): row for row in found.rows if row["lidar.backoff"] is None}
    assert by_setting[1, 60.0]["ended"] == 1
    assert by_setting[3, 5.0]["ended"] == 0
    assert by_setting[3, 5.0]["worst_availability"] == pytest.approx(30 / 32, abs=0.05)
    assert by_setting[3, 5.0]["ended_after_s"] is None
    assert str(found).count("\n") == 8
    assert found.svg().count("<rect") == 1 + 2 * 8


def test_a_setting_of_a_child_deep_below_can_be_varied() -> None:
    drive = rr.Supervisor([spec("x"), spec("y")], id="drive", max_restarts=9)
    found = rr.experiment(
        rr.Supervisor([drive], max_restarts=100, max_seconds=1),
        [("x", 5.0), ("x", 6.0)],
        vary={"drive.strategy": STRATEGIES, "root/drive/y.shutdown_s": ["brutal_kill", 1.0]},
        runs=1,
        until_s=10,
    )

    assert [row["restarts"] for row in found.rows] == [2, 2, 4, 4, 4, 4]


# -- bad input ---------------------------------------------------------------------------------------------------------

LIFE = rr.Child.fails(3)
BRANCH = rr.Supervisor([spec("a"), rr.Supervisor([spec("x")], id="drive"), spec("t", placement="thread")])


@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: rr.Child.fails(-1), "every_s: expected a number of at least 0"),
        (lambda: rr.Child.fails(0), "every_s: expected a number greater than 0"),
        (lambda: rr.Child.fails(math.nan), "every_s"),
        (lambda: rr.Child.fails(3, start_s=math.inf), "start_s"),
        (lambda: rr.Child.fails(3, stop_s=-1), "stop_s"),
        (lambda: rr.Child.fails(3, hangs=1.1), "hangs: expected a number from 0 to 1, got 1.1"),
        (lambda: rr.Child.fails(3, start_fails=-0.1), "start_fails: expected a number from 0 to 1"),
        (lambda: rr.Child.fails(3, reason="bored"), "reason: expected one of 'killed', 'abnormal', 'normal'"),  # pyright: ignore[reportArgumentType]
        (lambda: rr.Exponential(0), "mean_s: expected a number greater than 0"),
        (lambda: rr.Uniform(3, 1), "most_s: expected at least least_s"),
        (lambda: rr.simulate(BRANCH, {"aa": rr.Child.fails(3)}), "'aa': there is no child of this path or id"),
        (lambda: rr.simulate(BRANCH, {"a": LIFE, "root/a": LIFE}), "one model for each child, got 'a second one"),
        (lambda: rr.simulate(BRANCH, {"a": 30}), "expected what Child.fails"),  # pyright: ignore[reportArgumentType]
        (lambda: rr.simulate(BRANCH, {"drive": rr.Child.fails(3)}), "a child that is no supervisor"),
        (lambda: rr.simulate(BRANCH, {"t": rr.Child.fails(3)}), "a thread of its supervisor's"),
        (lambda: rr.simulate(BRANCH, [("drive", 3.0)]), "a thread of its supervisor's"),
        (lambda: rr.simulate(BRANCH, [("a", -1.0)]), r"scenario\[0\]\[1\]: expected seconds since the start"),
        (lambda: rr.simulate(BRANCH, [("a", 1.0), ("a", 11.0)], until_s=10), r"from 0 to until_s \(10\), got 11.0"),
        (lambda: rr.simulate(BRANCH, [("a", math.nan)]), "expected seconds since the start"),
        (lambda: rr.simulate(BRANCH, [("a",)]), r"expected \(child, seconds since the start\)"),  # pyright: ignore[reportArgumentType]
        (lambda: rr.simulate(BRANCH, "a"), "scenario: expected a dict of models by child, or a list"),  # pyright: ignore[reportArgumentType]
        (lambda: rr.simulate(BRANCH, until_s=0), "until_s: expected a number greater than 0"),
        (lambda: rr.simulate(BRANCH, until_s=math.inf), "until_s"),
        (lambda: rr.simulate(BRANCH, start_s=-1), "start_s"),
        (lambda: rr.simulate(BRANCH, seed=1.5), "seed: expected a whole number"),  # pyright: ignore[reportArgumentType]
        (lambda: rr.simulate(Idle), "tree: expected a Supervisor"),  # pyright: ignore[reportArgumentType]
        (lambda: rr.experiment(BRANCH, [], vary={}), "vary: expected a dict with a list of values"),
        (lambda: rr.experiment(BRANCH, [], vary={"max_restart": [1]}), "expected one of strategy, max_restarts"),
        (lambda: rr.experiment(BRANCH, [], vary={"max_restarts": [-1]}), "a number of at least 0, got -1"),
        (lambda: rr.experiment(BRANCH, [], vary={"max_restarts": []}), "a list of values, at least one"),
        (lambda: rr.experiment(BRANCH, [], vary={"driver.strategy": ["one_for_all"]}), "did you mean 'drive'"),
        (lambda: rr.experiment(BRANCH, [], vary={"strategy": ["x"]}, runs=0), "runs: expected a whole number above 0"),
    ],
)
def test_what_cannot_be_is_refused_by_name(call: Callable[[], object], text: str) -> None:
    with pytest.raises((rr.InvalidSpec, rr.NotFound), match=text):
        call()


# -- beside real processes ---------------------------------------------------------------------------------------------


def _random_tree(chance: random.Random) -> rr.Supervisor:
    inner = rr.Supervisor(
        [spec("x"), spec("y")],
        id="inner",
        strategy=chance.choice(STRATEGIES),
        max_restarts=chance.choice([0, 1, 9]),
        max_seconds=3600.0,
    )
    restart = chance.choice(["permanent", "temporary", "transient"])
    children: list[Any] = [spec("a"), spec("b", restart=restart), spec("c")]
    children.insert(chance.randrange(4), inner)
    return rr.Supervisor(
        children, strategy=chance.choice(STRATEGIES), max_restarts=chance.choice([2, 3, 20]), max_seconds=3600.0
    )


class Heard:
    """The events of children, oldest first."""

    def __init__(self) -> None:
        self.events: list[Any] = []
        self._more = threading.Condition()

    def __call__(self, event: Any) -> None:
        if "path" in event:
            with self._more:
                self.events.append(event)
                self._more.notify_all()

    def wait_for(self, rest: Callable[[Sequence[Any]], bool]) -> None:
        with self._more:
            assert self._more.wait_for(lambda: rest(self.events), 30), self.events[-3:]


@pytest.mark.timeout(180)  # a start takes 2 s on a machine that is busy five times over
@pytest.mark.parametrize("seed", [*range(3), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(3, 20))])
def test_real_processes_do_the_same(seed: int, tmp_path: Path) -> None:
    """Processes are killed one after the other, when a simulation has come to rest with the same deaths."""
    chance = random.Random(seed)
    what, heard, killed = _random_tree(chance), Heard(), list[str]()
    system = rr.System(what, state_dir=tmp_path)
    system.subscribe(heard)
    with system:
        for _ in range(3):
            child = chance.choice(["a", "b", "c", "inner/x", "inner/y"])
            try:
                if not system.ref(f"root/{child}").kill():
                    continue
            except (rr.NotFound, rr.NotRunning, rr.ActorDeadError):  # its supervisor has ended
                continue
            killed.append(f"root/{child}")
            run = rr.simulate(what, [(path, 10.0 * n) for n, path in enumerate(killed, 1)], until_s=100)
            heard.wait_for(lambda events, run=run: len(events) >= len(run.events))
            assert _essence(heard.events)[: len(run.events)] == _essence(run.events)
    assert killed


def _essence(events: Sequence[Any]) -> list[tuple[str, str]]:
    return [(event["event"], event["path"]) for event in events]
