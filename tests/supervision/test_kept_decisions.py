"""Dynamic children with ids of their own: what becomes of each when it ends, or its supervisor does."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from rr_actors.base.errors import (
    AlreadyPresent,
    AlreadyStarted,
    CatalogDamaged,
    ChildRunning,
    InvalidSpec,
    NotForDynamic,
    NotFound,
    StartFailed,
    TooManyChildren,
)
from rr_actors.supervision.core import restarts
from rr_actors.supervision.core.child_calls import get_childspec
from rr_actors.supervision.core.specs import Supervisor
from rr_actors.supervision.core.state import KeptChild, Mode
from support_simulated import Outcome, World, child

FAILS: list[Outcome] = ["fail"] * 3

DAMAGED = CatalogDamaged("/state/.children/:/a: expected the record of a child, got other bytes", path="/state")


def pool(restart: str = "permanent", **options: Any) -> World:
    return World(Supervisor([child("port", restart, args=("115200",))], strategy="simple_one_for_one", **options))


def forgotten(made: World) -> list[str]:
    return [report.id for report in made.reports if report.state is None]


# -- starts ----------------------------------------------------------------------------------------------------------


def test_a_child_with_an_id_has_that_id_and_the_templates_arguments_with_its_own() -> None:
    made = pool().start()
    assert made.answer("start_child", ["/dev/ttyS0"], "ttyS0") == "ttyS0"
    spec = get_childspec(made.tree, "ttyS0")
    assert (spec.id, spec.args) == ("ttyS0", ("115200", "/dev/ttyS0"))
    assert made.answer("start_child", []) == "port-1", "an id that is given uses up no number"


def test_an_id_that_a_child_has_is_refused_by_name() -> None:
    made = pool(max_children=1).start()
    made.answer("start_child", [], "ttyS0")
    with pytest.raises(AlreadyStarted, match="root/ttyS0 is running"):
        made.answer("start_child", [], "ttyS0")
    with pytest.raises(TooManyChildren):
        made.answer("start_child", [], "ttyS1")
    made.exit("ttyS0")
    with pytest.raises(AlreadyPresent, match="root/ttyS0 exists and is being restarted"):
        made.answer("start_child", [], "ttyS0")


def test_the_templates_id_is_refused() -> None:
    with pytest.raises(InvalidSpec, match=r"id: expected another id than the template's, got 'port'"):
        pool().start().answer("start_child", [], "port")


def test_an_id_beside_a_child_spec_is_refused() -> None:
    with pytest.raises(InvalidSpec, match=r"id: expected none, as the ChildSpec has one, got 'ttyS0'"):
        World(Supervisor([])).start().answer("start_child", child("a"), "ttyS0")


def test_a_start_that_fails_adds_nothing() -> None:
    made = pool().start()
    made.outcomes["ttyS0"].append("fail")
    with pytest.raises(StartFailed):
        made.answer("start_child", [], "ttyS0")
    assert (made.states(), forgotten(made)) == ({}, ["ttyS0"])


# -- ends ------------------------------------------------------------------------------------------------------------


def test_terminate_child_ends_it_for_good() -> None:
    made = pool().start()
    made.answer("start_child", [], "ttyS0")
    made.answer("terminate_child", "ttyS0")
    assert (made.states(), forgotten(made)) == ({}, ["ttyS0"])
    with pytest.raises(NotFound):
        made.answer("terminate_child", "ttyS0")
    assert made.answer("start_child", [], "ttyS0") == "ttyS0"


def test_its_own_end_is_for_good_if_it_is_not_restarted() -> None:
    made = pool("transient").start()
    made.answer("start_child", [], "ttyS0")
    made.exit("ttyS0", "normal")
    assert (made.states(), forgotten(made)) == ({}, ["ttyS0"])


def test_the_end_of_its_supervisor_is_not() -> None:
    made = pool().start()
    made.answer("start_child", [], "ttyS0")
    made.answer("start_child", [])
    made.stop().settle()
    assert made.ended is not None
    assert (made.states(), forgotten(made)) == ({"ttyS0": "stopped"}, ["port-1"])


def test_nor_is_the_end_of_a_supervisor_that_gives_up_because_of_it() -> None:
    made = pool(max_restarts=0).start()
    for id in ("ttyS0", "ttyS1"):
        made.answer("start_child", [], id)
    made.exit("ttyS0")
    made.settle()
    assert made.ended is not None
    assert (made.states(), forgotten(made)) == ({"ttyS0": "stopped", "ttyS1": "stopped"}, [])


def test_one_that_a_caller_has_ended_before_its_supervisor_ends_stays_ended() -> None:
    made = pool().start()
    made.answer("start_child", [], "ttyS0")
    made.call("terminate_child", "ttyS0")
    made.stop().settle()
    assert forgotten(made) == ["ttyS0"]


def test_one_whose_first_start_is_cut_short_by_its_supervisors_end_is_not_kept() -> None:
    made = pool().start()
    caller = made.call("start_child", [], "ttyS0")
    made.stop().settle()
    assert isinstance(made.replies[caller].error, StartFailed)
    assert forgotten(made) == ["ttyS0"]


def test_a_temporary_child_is_not_kept() -> None:
    made = pool("temporary").start()
    made.answer("start_child", [], "ttyS0")
    made.stop().settle()
    assert forgotten(made) == ["ttyS0"]


# -- coming back -----------------------------------------------------------------------------------------------------


def test_kept_children_come_back_with_their_supervisor_in_their_order() -> None:
    made = pool().start([KeptChild("b", (1,)), KeptChild("a", (2,))])
    made.settle()
    assert made.log == ["start b", "up b", "start a", "up a"]
    assert made.started
    assert get_childspec(made.tree, "b").args == ("115200", 1)
    made.exit("b")
    assert made.settle().states() == {"b": "running", "a": "running"}


def test_one_that_does_not_start_stays_stopped_and_the_others_come_back() -> None:
    made = pool()
    made.outcomes["a"].append("fail")
    made.start([KeptChild("a"), KeptChild("b")]).settle()
    assert (made.started, made.states()) == (True, {"a": "stopped", "b": "running"})
    assert [(report.event, str(report.error)) for report in made.reports if report.id == "a"] == [
        ("start_failed", "no")
    ]


def test_one_that_is_lost_is_named_and_the_others_come_back() -> None:
    made = pool().start([KeptChild("b"), KeptChild("a", lost=DAMAGED)]).settle()
    assert (made.started, made.states()) == (True, {"b": "running", "a": "stopped"})
    assert [report.error for report in made.reports if report.id == "a"] == [DAMAGED]
    with pytest.raises(StartFailed, match="expected the record of a child, got other bytes"):
        made.answer("restart_child", "a")


def test_a_want_of_something_outside_fails_the_start_of_its_supervisor_which_tries_again() -> None:
    made = pool().start([KeptChild("a")])
    error = OSError(24, "Too many open files")
    made.take(restarts.decide_start_failed(made.tree, "a", made.starts.pop("a").run, error, 0.0))
    assert made.ended is not None
    assert made.ended.error is not None
    assert made.ended.error.details["wanted"].startswith("EMFILE")
    assert made.states() == {"a": "stopped"}


@pytest.mark.parametrize("kept", [KeptChild("a"), KeptChild("a", lost=DAMAGED)])
def test_a_stopped_one_starts_with_new_arguments(kept: KeptChild) -> None:
    made = pool()
    made.outcomes["a"].extend(FAILS[: 1 if kept.lost else 2])
    made.start([kept]).settle()
    with pytest.raises(StartFailed):
        made.answer("start_child", ["new"], "a")
    assert made.states() == {"a": "stopped"}
    assert made.answer("start_child", ["new"], "a") == "a"
    assert get_childspec(made.tree, "a").args == ("115200", "new")


def test_a_stopped_one_is_started_or_ended_by_hand() -> None:
    made = pool()
    made.outcomes["a"].append("fail")
    made.start([KeptChild("a"), KeptChild("b")]).settle()
    with pytest.raises(NotForDynamic):
        made.answer("delete_child", "a")
    with pytest.raises(ChildRunning):
        made.answer("restart_child", "b")
    assert made.answer("restart_child", "a") == "a"
    made.answer("terminate_child", "a")
    assert (made.states(), forgotten(made)) == ({"b": "running"}, ["a"])


def test_one_that_the_present_template_cannot_make_is_lost() -> None:
    made = World(Supervisor([Supervisor([], id="port")], strategy="simple_one_for_one"))
    made.start([KeptChild("a", ("/dev/ttyS0",)), KeptChild("port")]).settle()
    assert made.states() == {"a": "stopped", "port": "stopped"}
    assert all(isinstance(report.error, InvalidSpec) for report in made.reports)


# -- in any order ----------------------------------------------------------------------------------------------------

IDS = ["a", "b", "c"]


class Incarnations(RuleBasedStateMachine):
    """A supervisor over its incarnations: on disk are the children that have been started and have not ended for good.

    The disk is written as the performer writes it: a child is there from the beginning of its start by a caller, until
    a report says that it is forgotten.
    """

    @initialize(restart=st.sampled_from(["permanent", "transient"]), max_restarts=st.integers(0, 2))
    def begin(self, restart: str, max_restarts: int) -> None:
        self.spec = pool(restart, max_restarts=max_restarts).tree.spec
        self.ended: set[str] = set()
        self.disk: dict[str, KeptChild] = {}
        self.made = World(self.spec).start()
        self.settle()

    def settle(self) -> None:
        self.made.settle()
        for report in self.made.reports:
            if report.state is None:
                self.disk.pop(report.id, None)
        self.made.reports.clear()

    @precondition(lambda self: self.made.alive)
    @rule(id=st.sampled_from(IDS), fails=st.booleans(), argument=st.integers())
    def start_child(self, id: str, fails: bool, argument: int) -> None:
        state = self.made.states().get(id)
        if fails:
            self.made.outcomes[id].append("fail")
        before = self.disk.get(id)
        self.disk[id] = KeptChild(id, (argument,))
        try:
            self.made.answer("start_child", [argument], id)
            assert state in (None, "stopped")
            assert not fails
        except AlreadyStarted:
            assert state == "running"
            assert before is not None
            self.disk[id] = before
        except StartFailed:
            assert fails
        self.made.outcomes[id].clear()
        self.settle()

    @precondition(lambda self: self.made.alive)
    @rule(id=st.sampled_from(IDS))
    def terminate_child(self, id: str) -> None:
        try:
            self.made.answer("terminate_child", id)
        except NotFound:
            pass
        self.settle()
        assert id not in self.disk

    @precondition(lambda self: self.made.alive and self.made.up)
    @rule(data=st.data(), reason=st.sampled_from(["normal", "killed"]), fails=st.integers(0, 3))
    def exit(self, data: st.DataObject, reason: Any, fails: int) -> None:
        id = data.draw(st.sampled_from(sorted(self.made.up)))
        kept = self.disk[id]
        self.made.outcomes[id].extend(FAILS[:fails])
        self.made.exit(id, reason)
        self.settle()
        self.made.outcomes[id].clear()
        for_good = reason == "normal" and self.spec.child_specs[0].restart == "transient"
        assert self.disk.get(id) == (None if for_good else kept), "a child that is restarted is kept, or its supervisor"

    @rule(failing=st.sets(st.sampled_from(IDS)), killed=st.booleans())
    def next_incarnation(self, failing: set[str], killed: bool) -> None:
        if not killed:
            self.made.stop()
            self.settle()
        self.made = World(self.spec)
        for id in failing:
            self.made.outcomes[id].append("fail")
        kept = dict(self.disk)
        self.made.start(self.disk.values())
        self.settle()
        assert self.made.started
        assert self.disk == kept
        assert self.made.states() == {id: "stopped" if id in failing else "running" for id in kept}
        self.made.outcomes.clear()

    @invariant()
    def on_disk_is_what_the_supervisor_has(self) -> None:
        assert {child.id: child.extra for child in self.made.tree.children.values()} == {
            child.id: child.args for child in self.disk.values()
        }
        assert self.made.alive or self.made.tree.mode is Mode.STOPPED


TestIncarnations = Incarnations.TestCase
TestIncarnations.settings = settings(max_examples=60, stateful_step_count=20, deadline=None)
