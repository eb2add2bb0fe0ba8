"""Random calls and exits: against a simple model of OTP's manual, and with everything happening at the same time."""

from __future__ import annotations

from collections import defaultdict, deque
from dataclasses import dataclass
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from rr_actors.base.errors import (
    AlreadyPresent,
    AlreadyStarted,
    ChildRunning,
    InvalidSpec,
    NotForDynamic,
    NotFound,
    StartFailed,
)
from rr_actors.supervision.core.child_calls import which_children
from rr_actors.supervision.core.specs import ChildSpec, Supervisor
from rr_actors.supervision.core.state import ChildPhase, Mode, Why
from support_simulated import Outcome, World, child

IDS = ["a", "b", "c", "d", "e"]
TYPES = ["permanent", "transient", "temporary"]
REASONS: list[Any] = ["normal", "shutdown", "abnormal", "killed"]
OUTCOMES: list[Outcome] = ["ok", "fail", "ignore"]


@dataclass
class Kid:
    """A child in the model: its specification and whether it is up."""

    spec: ChildSpec
    up: bool = False


class Manual:
    """OTP's supervisor as its manual tells it: one thing at a time, and every start and stop done when it is asked for.

    Says what it does in the words of World.log, and answers with the error that a call is to raise.
    """

    def __init__(self, spec: Supervisor) -> None:
        self.spec = spec
        self.simple = spec.strategy == "simple_one_for_one"
        self.kids = {} if self.simple else {s.id: Kid(s) for s in spec.child_specs}
        self.outcomes: dict[str, deque[Outcome]] = defaultdict(deque)
        self.restarts: list[float] = []
        self.log: list[str] = []
        self.now = 0.0
        self.alive = True
        self.made = 0

    # -- doing --

    def begin(self) -> None:
        for id in list(self.kids):
            if self._start(id) == "fail":
                self.end()
                return

    def end(self) -> None:
        for id in reversed(list(self.kids)):
            self._stop(id)
        self.alive = False

    def _start(self, id: str) -> Outcome:
        outcome = self.outcomes[id].popleft() if self.outcomes[id] else "ok"
        self.log += [f"start {id}", f"{'up' if outcome == 'ok' else outcome} {id}"]
        self.kids[id].up = outcome == "ok"
        if outcome == "ignore":
            self._down(id)
        return outcome

    def _stop(self, id: str) -> None:
        if self.kids[id].up:
            self.log += [f"stop {id}", f"down {id}"]
        self._down(id)

    def _down(self, id: str) -> None:
        self.kids[id].up = False
        if self.simple or self.kids[id].spec.restart == "temporary":
            del self.kids[id]

    # -- exits --

    def exit(self, id: str, reason: str) -> None:
        spec = self.kids[id].spec
        self.kids[id].up = False
        if spec.restart == "permanent" or (spec.restart == "transient" and reason in ("abnormal", "killed")):
            self._restart(id)
            return
        self._down(id)
        left = [kid for kid in self.kids.values() if kid.spec.significant and kid.up]
        when = self.spec.auto_shutdown
        if spec.significant and (when == "any" or (when == "all" and not left)):
            self.end()

    def _restart(self, id: str) -> None:
        """Until the whole group is up: each attempt counts, a failed one is tried again from where it failed."""
        failed: str | None = id
        while failed is not None:
            self.restarts = [at for at in self.restarts if self.now - at <= self.spec.max_seconds] + [self.now]
            if len(self.restarts) > self.spec.max_restarts:
                self._down(failed)
                self.end()
                return
            order = list(self.kids)
            groups = {"one_for_all": order, "rest_for_one": order[order.index(failed) :]}
            group = groups.get(str(self.spec.strategy), [failed])
            for other in reversed(group):
                if other != failed:
                    self._stop(other)
            failed = next((other for other in group if other in self.kids and self._start(other) == "fail"), None)

    # -- calls --

    def start_child(self, spec: Any) -> type[Exception] | None:
        if self.simple:
            self.made += 1
            id = f"{self.spec.child_specs[0].id}-{self.made}"
            spec = self.spec.child_specs[0]
        else:
            id = spec.id
            if spec.significant and self.spec.auto_shutdown == "never":
                return InvalidSpec
            if id in self.kids:
                return AlreadyStarted if self.kids[id].up else AlreadyPresent
        self.kids[id] = Kid(spec)
        if self._start(id) == "fail":
            del self.kids[id]
            return StartFailed
        return None

    def terminate_child(self, id: str) -> type[Exception] | None:
        if id not in self.kids:
            return None if self.simple and 1 <= int(id[2:]) <= self.made else NotFound
        self._stop(id)
        return None

    def _refusal(self, id: str) -> type[Exception] | None:
        """Return the error of a call that needs a stopped child."""
        if self.simple:
            return NotForDynamic
        if id not in self.kids:
            return NotFound
        return ChildRunning if self.kids[id].up else None

    def restart_child(self, id: str) -> type[Exception] | None:
        if refusal := self._refusal(id):
            return refusal
        kid = self.kids[id]
        order = list(self.kids)
        failed = self._start(id) == "fail"
        self.kids = {other: self.kids.get(other, kid) for other in order}  # kept, if it is temporary and said IGNORE
        return StartFailed if failed else None

    def delete_child(self, id: str) -> type[Exception] | None:
        if refusal := self._refusal(id):
            return refusal
        del self.kids[id]
        return None

    def update(self, spec: Supervisor) -> type[Exception] | None:
        self.spec = spec
        if not self.simple:
            old, self.kids = self.kids, {s.id: Kid(s) for s in spec.child_specs}
            for id, kid in old.items():
                self.kids.setdefault(id, kid).up = kid.up
        return None


@st.composite
def child_specs(draw: st.DrawFn, auto_shutdown: str) -> ChildSpec:
    restart = draw(st.sampled_from(TYPES))
    significant = auto_shutdown != "never" and restart != "permanent" and draw(st.booleans())
    return child(draw(st.sampled_from(IDS)), restart, significant=significant)


@st.composite
def supervisors(draw: st.DrawFn, strategies: tuple[str, ...]) -> Supervisor:
    strategy: Any = draw(st.sampled_from(strategies))
    auto_shutdown: Any = draw(st.sampled_from(["never", "never", "any", "all"]))
    count = (1, 1) if strategy == "simple_one_for_one" else (0, 4)
    made = st.lists(child_specs(auto_shutdown), min_size=count[0], max_size=count[1], unique_by=lambda spec: spec.id)
    return Supervisor(
        draw(made),
        strategy=strategy,
        max_restarts=draw(st.sampled_from([0, 1, 2, 3, 10])),
        max_seconds=draw(st.sampled_from([1, 5])),
        auto_shutdown=auto_shutdown,
    )


PLANS = st.tuples(st.sampled_from(IDS), st.sampled_from(OUTCOMES))
STATIC = ("one_for_one", "one_for_all", "rest_for_one")
DYNAMIC = ("simple_one_for_one",)


class OneThingAtATime(RuleBasedStateMachine):
    """As OTP's supervisor works: every event is dealt with before the next. We do exactly what the model does."""

    strategies = STATIC

    @initialize(data=st.data(), planned=st.lists(PLANS, max_size=2))
    def start(self, data: st.DataObject, planned: list[tuple[str, Outcome]]) -> None:
        spec = data.draw(supervisors(self.strategies), "supervisor")
        self.world, self.model = World(spec), Manual(spec)
        for id, outcome in planned:
            self.plan_for(id, outcome)
        self.world.start().settle()
        self.model.begin()

    @precondition(lambda self: not self.model.alive)
    @rule(data=st.data(), planned=st.lists(PLANS, max_size=2))
    def another_is_started(self, data: st.DataObject, planned: list[tuple[str, Outcome]]) -> None:
        self.start(data, planned)

    def ids(self) -> list[str]:
        return IDS if self.strategies is STATIC else [f"{self.world.tree.template.id}-{n}" for n in range(1, 7)]

    def plan_for(self, id: str, outcome: Outcome) -> None:
        self.world.outcomes[id].append(outcome)
        self.model.outcomes[id].append(outcome)

    def both(self, name: str, argument: Any) -> None:
        expected = getattr(self.model, name)(argument)
        caller = self.world.call(name, argument)
        self.world.settle()
        error = self.world.replies[caller].error
        assert (type(error) if error else None) is expected, f"{name}({argument}): {error!r}, expected {expected}"

    @precondition(lambda self: self.model.alive)
    @rule(data=st.data(), outcome=st.sampled_from(OUTCOMES))
    def plan(self, data: st.DataObject, outcome: Outcome) -> None:
        self.plan_for(data.draw(st.sampled_from(self.ids())), outcome)

    @precondition(lambda self: self.model.alive)
    @rule(seconds=st.sampled_from([0.5, 1, 5]))
    def time_passes(self, seconds: float) -> None:
        self.world.now += seconds
        self.model.now += seconds

    @precondition(lambda self: self.model.alive and self.world.up)
    @rule(data=st.data(), reason=st.sampled_from(REASONS))
    def a_child_ends(self, data: st.DataObject, reason: Any) -> None:
        id = data.draw(st.sampled_from(sorted(self.world.up)))
        self.world.exit(id, reason)
        self.world.settle()
        self.model.exit(id, reason)

    @precondition(lambda self: self.model.alive)
    @rule(data=st.data())
    def a_child_is_started(self, data: st.DataObject) -> None:
        spec: Any = data.draw(child_specs(self.model.spec.auto_shutdown)) if self.strategies is STATIC else []
        self.both("start_child", spec)

    @precondition(lambda self: self.model.alive)
    @rule(data=st.data(), name=st.sampled_from(["terminate_child", "restart_child", "delete_child"]))
    def a_call_is_made(self, data: st.DataObject, name: str) -> None:
        self.both(name, data.draw(st.sampled_from(self.ids())))

    @precondition(lambda self: self.model.alive)
    @rule(data=st.data())
    def it_is_updated(self, data: st.DataObject) -> None:
        if self.strategies is STATIC:
            self.both("update", data.draw(supervisors(self.strategies)))

    @precondition(lambda self: self.model.alive)
    @rule()
    def it_is_stopped(self) -> None:
        self.world.stop().settle()
        self.model.end()

    @invariant()
    def both_have_done_the_same(self) -> None:
        mine, theirs = self.world.drain(), self.model.log
        self.model.log = []
        if self.strategies is DYNAMIC and not self.model.alive:
            mine, theirs = sorted(mine), sorted(theirs)  # dynamic children stop in no order
        assert mine == theirs

    @invariant()
    def both_are_in_the_same_state(self) -> None:
        assert self.world.alive == self.model.alive
        assert (self.world.ended is None) == self.model.alive
        assert set(self.world.up) == {id for id, kid in self.model.kids.items() if kid.up}
        if self.model.alive:
            assert [c.id for c in which_children(self.world.tree)] == list(reversed(self.model.kids))
            assert self.world.states() == {
                id: "running" if kid.up else "stopped" for id, kid in self.model.kids.items()
            }


class OneThingAtATimeDynamic(OneThingAtATime):
    """The same under simple_one_for_one."""

    strategies = DYNAMIC  # type: ignore[assignment]


class AllAtOnce(RuleBasedStateMachine):
    """Starts and stops take their time, and anything may happen meanwhile. What must hold then, whatever happens.

    World checks that a child is never started twice, nor stopped when down, nor a caller answered twice.
    """

    @initialize(data=st.data())
    def start(self, data: st.DataObject) -> None:
        self.world = World(data.draw(supervisors((*STATIC, *DYNAMIC)), "supervisor")).start()
        self.callers: list[int] = []
        self.updated = False

    @precondition(lambda self: self.world.starts)
    @rule(data=st.data(), outcome=st.sampled_from(["ok", "ok", "ok", "fail", "ignore"]))
    def a_start_ends(self, data: st.DataObject, outcome: Outcome) -> None:
        id = data.draw(st.sampled_from(sorted(self.world.starts)))
        self.world.outcomes[id].append(outcome)
        self.world.finish_start(id)

    @precondition(lambda self: self.world.stops)
    @rule(data=st.data())
    def a_stop_ends(self, data: st.DataObject) -> None:
        self.world.finish_stop(data.draw(st.sampled_from(sorted(self.world.stops))))

    @precondition(lambda self: self.world.up)
    @rule(data=st.data(), reason=st.sampled_from(REASONS))
    def a_child_ends(self, data: st.DataObject, reason: Any) -> None:
        self.world.exit(data.draw(st.sampled_from(sorted(self.world.up))), reason)

    @rule(data=st.data(), name=st.sampled_from(["start_child", "terminate_child", "restart_child", "delete_child"]))
    def a_call_is_made(self, data: st.DataObject, name: str) -> None:
        tree = self.world.tree
        argument: Any = data.draw(st.sampled_from([*(IDS if not tree.dynamic else []), *tree.children, "nobody"]))
        if name == "start_child":
            argument = [] if tree.dynamic else data.draw(child_specs(tree.spec.auto_shutdown))
        self.callers.append(self.world.call(name, argument))

    @precondition(lambda self: not self.world.tree.dynamic)
    @rule(data=st.data())
    def it_is_updated(self, data: st.DataObject) -> None:
        """Any time: even a group restart under way comes to its end when the strategy changes."""
        self.callers.append(self.world.call("update", data.draw(supervisors(STATIC))))
        self.updated = True

    @rule(seconds=st.sampled_from([1, 6]))
    def time_passes(self, seconds: float) -> None:
        self.world.now += seconds

    @rule()
    @precondition(lambda self: self.world.tree.mode is Mode.RUNNING and len(self.callers) > 5)
    def it_is_stopped(self) -> None:
        self.world.stop()

    @invariant()
    def a_group_is_restarted_one_thing_at_a_time_and_in_order(self) -> None:
        if not self.world.tree.grouped or not self.world.alive or self.updated:
            return
        children = list(self.world.tree.children.values())
        assert len(self.world.starts.keys() - self.world.stops.keys() - self.condemned()) <= 1
        for index, starting in enumerate(children):
            if starting.phase is ChildPhase.STARTING and starting.why is Why.RESTART:
                assert all(later.id not in self.world.up for later in children[index:])
                assert not self.condemned()

    def condemned(self) -> set[str]:
        return {c.id for c in self.world.tree.children.values() if c.phase is ChildPhase.CONDEMNED}

    @invariant()
    def something_is_always_under_way_until_all_is_at_rest(self) -> None:
        tree, busy = self.world.tree, bool(self.world.starts or self.world.stops)
        waiting = [
            c for c in tree.children.values() if c.phase in (ChildPhase.DUE, ChildPhase.CONDEMNED, ChildPhase.RECYCLING)
        ]
        assert busy or not waiting
        assert busy or tree.mode in (Mode.RUNNING, Mode.STOPPED)
        assert busy or all(caller in self.world.replies for caller in self.callers)

    def teardown(self) -> None:
        """Left alone, it comes to rest: all that it wants up is up, and every caller has been answered."""
        if not hasattr(self, "world"):
            return
        self.world.outcomes.clear()
        self.world.settle()
        assert set(self.callers) == set(self.world.replies)
        assert set(self.world.up) == {id for id, state in self.world.states().items() if state == "running"}
        assert set(self.world.states().values()) <= {"running", "stopped"}
        if self.world.alive:
            self.world.stop().settle()
        assert self.world.ended is not None
        assert not self.world.up


TestOneThingAtATime = OneThingAtATime.TestCase
TestOneThingAtATimeDynamic = OneThingAtATimeDynamic.TestCase
TestAllAtOnce = AllAtOnce.TestCase
SETTINGS = settings(max_examples=60, stateful_step_count=30, database=None)
TestOneThingAtATime.settings = TestOneThingAtATimeDynamic.settings = TestAllAtOnce.settings = SETTINGS
