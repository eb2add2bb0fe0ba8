"""What a decision costs does not grow with the number of children. Bytecodes are counted, not seconds."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rr_actors.actors.actor import Actor
from rr_actors.supervision.core import child_calls, restarts
from rr_actors.supervision.core.children import Children
from rr_actors.supervision.core.specs import ChildSpec, Strategy, Supervisor
from rr_actors.supervision.core.state import (
    Action,
    ChildPhase,
    Decision,
    Exit,
    StartChild,
    StopChild,
    SupervisedChild,
    SupervisorState,
    Why,
)
from rr_actors.supervision.event_history import KEPT, History, Record
from support_steps import steps_of

FEW, MANY = 10, 3_000
STRATEGIES: tuple[Strategy, ...] = ("one_for_one", "one_for_all", "rest_for_one", "simple_one_for_one")
SPEC = ChildSpec(Actor, id="c")
KILLED, DONE = Exit("killed"), Exit("shutdown")


def running(count: int, strategy: Strategy) -> tuple[SupervisorState, str]:
    """Return a supervisor of so many running children, and the id of the last one."""
    dynamic = strategy == "simple_one_for_one"
    specs = [SPEC] if dynamic else [ChildSpec(Actor, id=f"c-{n}") for n in range(1, count + 1)]
    spec = Supervisor(specs, strategy=strategy, max_restarts=1_000_000)
    tree, actions = restarts.decide_start(SupervisorState.of(spec), now=0.0)
    for n in range(count if dynamic else 0):
        tree, more = child_calls.start_child(tree, [], n, 0.0)
        actions += more
    return settled(tree, actions), f"c-{count}"


def settled(tree: SupervisorState, actions: Sequence[Action]) -> SupervisorState:
    """Do the starts and stops that the actions ask for, and those that follow from them."""
    for action in (left := list(actions)):
        more: Sequence[Action] = ()
        if isinstance(action, StartChild):
            tree, more = restarts.decide_started(tree, action.id, action.run, 1.0)
        elif isinstance(action, StopChild):
            tree, more = restarts.decide_stopped(tree, action.id, action.run, DONE, 1.0)
        left += more
    return tree


def killed(tree: SupervisorState, id: str) -> Decision:
    return restarts.decide_exit(tree, id, tree.children[id].run, KILLED, 1.0)


def terminated(tree: SupervisorState, id: str) -> Decision:
    return child_calls.terminate_child(tree, id, "caller", 1.0)


def terminated_and_restarted(tree: SupervisorState, id: str) -> Decision:
    return child_calls.restart_child(settled(*terminated(tree, id)), id, "caller", 1.0)


def added(tree: SupervisorState, _: str) -> Decision:
    return child_calls.start_child(tree, [] if tree.dynamic else ChildSpec(Actor, id="new"), "caller", 1.0)


def unknown(tree: SupervisorState, _: str) -> Decision:
    return child_calls.terminate_child(tree, "nobody", "caller", 1.0)


def late(tree: SupervisorState, id: str) -> Decision:
    return restarts.decide_stopped(tree, id, 0, DONE, 1.0)


def uncounted(tree: SupervisorState, id: str) -> Decision:
    return restarts.decide_uncounted(tree, id, tree.children[id].run)


DECISIONS: tuple[Callable[[SupervisorState, str], Decision], ...] = (
    killed,
    terminated,
    terminated_and_restarted,
    added,
    unknown,
    late,
    uncounted,
)


def cost(decide: Callable[[SupervisorState, str], Decision], count: int, strategy: Strategy) -> tuple[int, int]:
    """Return the steps of a decision with what follows from it, and the most bytes that it needs at a time."""
    tree, id = running(count, strategy)
    steps, _ = steps_of(lambda: settled(*decide(tree, id)))
    tree, id = running(count, strategy)
    tracemalloc.start()
    try:
        settled(*decide(tree, id))
        return steps, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("decide", "strategy"),
    [
        pytest.param(decide, strategy, id=f"{decide.__name__}-{strategy}")
        for decide in DECISIONS
        for strategy in STRATEGIES
        if (decide, strategy) != (killed, "one_for_all")  # it restarts all children
    ],
)
def test_a_decision_costs_with_many_children_what_it_costs_with_few(
    decide: Callable[[SupervisorState, str], Decision], strategy: Strategy
) -> None:
    few, few_bytes = cost(decide, FEW, strategy)
    many, many_bytes = cost(decide, MANY, strategy)
    assert many <= few * 1.1
    assert many_bytes <= few_bytes + 8 * MANY, "it copies the children"


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_a_stop_takes_as_many_steps_for_each_of_many_children_as_for_each_of_few(strategy: Strategy) -> None:
    def each(count: int) -> float:
        tree, _ = running(count, strategy)
        steps, tree = steps_of(lambda: settled(*restarts.decide_stop(tree, 1.0)))
        assert all(child.phase is ChildPhase.STOPPED for child in tree.children.values())
        return steps / count

    assert each(1_000) <= each(100) * 1.1


def test_the_history_finds_the_deaths_of_a_child_without_a_look_at_all_records() -> None:
    def steps(others: int) -> int:
        history = History()
        history.add(Record("exited", "root/a", "actor", 1, 0.0, reason="killed", signal="SIGKILL"))
        for run in range(others):
            history.add(Record("exited", f"root/b{run}", "actor", run, 0.0, reason="killed"))
        taken, deaths = steps_of(lambda: history.deaths("root/a", 3))
        assert deaths == ["SIGKILL"]
        return taken

    assert steps(KEPT - 1) == steps(1)


def test_the_history_knows_no_death_whose_record_it_no_longer_keeps() -> None:
    history = History()
    for run in range(2 * KEPT):
        history.add(Record("exited", f"root/{'a' if run in (0, KEPT) else 'b'}", "actor", run, 0.0, reason="killed"))
    history.add(Record("started", "root/b", "actor", 0, 0.0))
    assert len(history.records()) == KEPT
    assert history.deaths("root/a", 3) == []
    assert len(history.deaths("root/b", 3)) == 3


# -- Children -------------------------------------------------------------------------------------------------------

IDS = ("a", "b", "c", "d")


@st.composite
def changes(draw: st.DrawFn) -> tuple[int, str, SupervisedChild | None]:
    """Draw which version is changed, the id of a child, and what is put there; None removes it."""
    significant = draw(st.booleans())
    spec = ChildSpec(Actor, id="x", restart="temporary", significant=significant)
    child = SupervisedChild("x", spec, phase=draw(st.sampled_from(ChildPhase)), why=draw(st.sampled_from(Why)))
    return draw(st.integers(0, 30)), draw(st.sampled_from(IDS)), draw(st.sampled_from((child, child, None)))


@given(st.lists(changes(), max_size=30), st.lists(st.integers(0, 30), max_size=10))
def test_each_version_of_children_stays_what_it_was_whichever_is_changed_or_read(
    steps: list[tuple[int, str, SupervisedChild | None]], reads: list[int]
) -> None:
    versions: list[tuple[Children, dict[str, SupervisedChild]]] = [(Children({}), {})]
    for which, id, child in steps:
        children, model = versions[which % len(versions)]
        if child is None:
            versions.append((children.without(id), {key: model[key] for key in model if key != id}))
        else:
            versions.append((children.put(id, child), {**model, id: child}))
    for which in (*reads, *range(len(versions))):
        children, model = versions[which % len(versions)]
        assert list(children.items()) == list(model.items())
        assert len(children) == len(model)
        for position, id in enumerate(model):
            assert children.after(id) == list(model.values())[position + 1 :]
        for phase in ChildPhase:
            those = [child for child in model.values() if child.phase is phase]
            assert children.first(2, phase) == those[:2]
            assert children.last(phase) == (those[-1] if those else None)
            assert children.any(phase) == bool(those)
            assert children.first(9, phase, whys=(Why.NEW,)) == [c for c in those if c.why is Why.NEW]
        assert children.any_significant() == any(
            child.spec.significant and child.phase is not ChildPhase.STOPPED for child in model.values()
        )
