"""What a Keeper does about what is wanted and what is there, and the reasons that it gives."""

from __future__ import annotations

from collections import Counter

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from rr_actors import Backoff, State
from rr_actors.managers.keeper.comparing import (
    KeptReport,
    ReplicaSteps,
    SeenReplica,
    Slot,
    WantedReplica,
    compare,
    report,
)
from rr_actors.managers.planning.setbacks import Setback, next_setback
from support_steps import steps_of

BACKOFF = Backoff(1.0, 2.0, 10.0, 0.0)
FAILED = {("a", 0): Setback(1, 5.0, "failing", "no fuel")}
A = WantedReplica("a", 0, b"a0")
HELD = SeenReplica("a", 0, b"a0", "held", "q")
OLD = SeenReplica("a", 0, b"old", "held", "q")


def seen(one: SeenReplica, **changes: object) -> SeenReplica:
    return msgspec.structs.replace(one, **changes)


LOADING, RELEASING, ENDING = (seen(HELD, phase=phase) for phase in ("loading", "releasing", "ending"))
TABLE: list[tuple[list[WantedReplica], list[SeenReplica], dict[Slot, Setback], ReplicaSteps]] = [
    ([A], [], {}, ReplicaSteps(load=[A])),
    ([A], [HELD], {}, ReplicaSteps()),
    ([A], [LOADING], {}, ReplicaSteps()),
    # it is loaded again when its time has come
    ([A], [], FAILED, ReplicaSteps(next_at=5.0)),
    ([A], [], {("a", 0): Setback(1, 4.0, "failing")}, ReplicaSteps(load=[A])),
    # what is lost, or is another thing than is wanted, goes before the new one comes
    ([A], [seen(HELD, state=State.FATAL)], FAILED, ReplicaSteps(release=[seen(HELD, state=State.FATAL)])),
    ([A], [seen(HELD, state=State.ERROR)], {}, ReplicaSteps()),
    ([A], [RELEASING], {}, ReplicaSteps()),
    ([A], [OLD], {}, ReplicaSteps(release=[OLD])),
    ([A], [seen(OLD, phase="loading")], {}, ReplicaSteps(withdraw=[seen(OLD, phase="loading")])),
    ([A], [seen(OLD, phase="ending")], {}, ReplicaSteps()),
    ([A], [ENDING], {}, ReplicaSteps(load=[A])),  # the registrar answers such a load after the end
    ([A], [seen(OLD, not_before=9.0)], {}, ReplicaSteps(next_at=9.0)),
    # nothing is wanted
    ([], [HELD], {}, ReplicaSteps(release=[HELD])),
    ([], [LOADING], {}, ReplicaSteps(withdraw=[LOADING])),
    ([], [RELEASING, ENDING], {}, ReplicaSteps()),
    # another priority
    ([WantedReplica("a", 0, b"a0", 5)], [HELD], {}, ReplicaSteps(prioritise=[(HELD, 5)])),
    ([WantedReplica("a", 0, b"a0", None)], [HELD], {}, ReplicaSteps(prioritise=[(HELD, None)])),
    # one of two that are equal is too many
    ([A], [HELD, seen(HELD, id="r")], {}, ReplicaSteps(release=[seen(HELD, id="r")])),
]


@pytest.mark.parametrize(("wanted", "there", "failures", "steps"), TABLE)
def test_the_steps(
    wanted: list[WantedReplica], there: list[SeenReplica], failures: dict[Slot, Setback], steps: ReplicaSteps
) -> None:
    assert compare(wanted, there, failures, 4.0) == steps


def test_what_is_after_another_is_loaded_when_all_of_that_is_ready() -> None:
    b = WantedReplica("b", 0, b"b0", 0, ("a",))
    second = WantedReplica("a", 1, b"a1")
    held = seen(HELD, instance=1, what=b"a1", id="r")

    assert compare([A, second, b], [HELD], {}, 0.0).load == [second]
    assert compare([A, second, b], [HELD, seen(held, state=State.ERROR)], {}, 0.0).load == []
    assert compare([A, second, b], [HELD, held], {}, 0.0).load == [b]
    assert compare([b], [], {}, 0.0).load == [b]  # none of "a" is wanted
    there = seen(HELD, keep="b", what=b"b0", id="s")
    assert compare([A, b], [there], {}, 0.0) == ReplicaSteps(load=[A])  # what is there stays


def test_the_last_of_the_file_is_released_first() -> None:
    parts = [seen(HELD, instance=i, id=f"q{i}") for i in range(3)]
    assert [one.id for one in compare([A], parts, {}, 0.0).release] == ["q2", "q1"]


ERROR = seen(HELD, state=State.ERROR, message="health: no answer")
REASONS: list[tuple[list[SeenReplica], dict[Slot, Setback], KeptReport]] = [
    ([HELD], FAILED, KeptReport("a", 1, 1)),
    ([seen(HELD, state=State.WARNING)], {}, KeptReport("a", 1, 1)),
    ([], {}, KeptReport("a", 1, 0, "loading")),
    ([LOADING], {}, KeptReport("a", 1, 0, "loading")),
    ([LOADING], FAILED, KeptReport("a", 1, 0, "all failing", "no fuel", True)),
    ([seen(LOADING, is_slow=True)], FAILED, KeptReport("a", 1, 0, "loading")),
    ([], {("a", 0): Setback(1, 5.0, "none registered", "x")}, KeptReport("a", 1, 0, "none registered", "x", True)),
    ([], {("a", 0): Setback(1, 5.0, "over capacity", "x")}, KeptReport("a", 1, 0, "over capacity", "x", True)),
    ([ERROR], {}, KeptReport("a", 1, 0, "all failing", "health: no answer", True)),
]


@pytest.mark.parametrize(("there", "failures", "expected"), REASONS)
def test_the_reasons(there: list[SeenReplica], failures: dict[Slot, Setback], expected: KeptReport) -> None:
    assert report(["a"], [A], there, failures) == {"a": expected}


def test_several_reasons_are_named_once_each() -> None:
    replicas = [WantedReplica("a", i, b"") for i in range(5)]
    failures = {("a", i): Setback(1, 5.0, why) for i, why in enumerate(["failing", "failing", "over capacity"])}

    assert report(["a"], replicas, [seen(HELD, instance=4, what=b"")], failures)["a"] == KeptReport(
        "a", 5, 1, "failing, over capacity, loading", "", True
    )
    assert report(["a"], replicas[:2], [], failures)["a"].why == "all failing"
    assert report(["a"], [], [], failures)["a"] == KeptReport("a", 0, 0)


def test_what_waits_says_for_which() -> None:
    b = WantedReplica("b", 0, b"b0", 0, ("c", "a"))
    assert report(["a", "b", "c"], [A, b], [], {})["b"] == KeptReport("b", 1, 0, "waits for a")


@given(st.integers(0, 30), st.floats(0, 20), st.floats(0, 1e6))
def test_the_waiting_times_grow_and_begin_anew_after_a_long_run(count: int, ran_s: float, now: float) -> None:
    before = Setback(count, 0.0, "failing") if count else None

    made = next_setback(before, now, BACKOFF, ran_s=ran_s, reason="failing", text="why")

    again = 0 if ran_s >= 10 else count
    assert (made.count, made.reason, made.text) == (again + 1, "failing", "why")
    assert made.retry_at == now + min(10.0, 2.0**again)


def test_a_thousand_take_few_steps() -> None:
    wanted = [WantedReplica(f"n{i % 100}", i, b"%d" % i, 0, (f"n{(i + 1) % 100}",)) for i in range(1000)]
    there = [SeenReplica(one.keep, one.instance, one.what, "held", f"q{one.instance}") for one in wanted[::2]]

    steps, made = steps_of(lambda: compare(wanted, there, {}, 0.0))

    assert len(made.load) == 500
    assert steps < 300 * len(wanted)


names = st.sampled_from("abc")
keeps = st.dictionaries(
    names, st.tuples(st.integers(0, 3), st.sampled_from([b"x", b"y"]), st.none() | st.integers(0, 1))
)


class World(RuleBasedStateMachine):
    """Anything happens in any order, as a Keeper would carry out the steps; in the end what is there is wanted."""

    def __init__(self) -> None:
        super().__init__()
        self.wanted: list[WantedReplica] = []
        self.there: dict[str, SeenReplica] = {}
        self.failures: dict[Slot, Setback] = {}
        self.now = 0.0
        self.count = 0

    @rule(desired=keeps)
    def apply(self, desired: dict[str, tuple[int, bytes, int | None]]) -> None:
        after = {"b": ("a",), "c": ("a", "b")}
        self.wanted = [
            WantedReplica(name, i, what, priority, tuple(one for one in after.get(name, ()) if one in desired))
            for name, (replicas, what, priority) in sorted(desired.items())
            for i in range(replicas)
        ]
        self.look()

    @rule(data=st.data(), works=st.booleans())
    def answer(self, data: st.DataObject, works: bool) -> None:
        """A load or a release that has begun is answered, or an end comes."""
        if begun := sorted(id for id, one in self.there.items() if one.phase != "held"):
            self.finish(data.draw(st.sampled_from(begun)), works)
        self.look()

    @rule(data=st.data(), state=st.sampled_from([State.FATAL, State.ERROR, State.OK]))
    def change(self, data: st.DataObject, state: State) -> None:
        held = sorted(id for id, one in self.there.items() if one.phase == "held" and one.state is not State.FATAL)
        if held:
            id = data.draw(st.sampled_from(held))
            self.there[id] = one = seen(self.there[id], state=state)
            if state is State.FATAL:
                self.fail(one.slot)
        self.look()

    @rule()
    def crash(self) -> None:
        """The keeper forgets what it has begun; the registrar ends what nobody holds, and keeps what is held."""
        self.failures = {}
        phases = {"loading": "ending", "releasing": "held", "held": "held", "ending": "ending"}
        self.there = {id: seen(one, phase=phases[one.phase]) for id, one in self.there.items()}
        self.look()

    @rule(seconds=st.integers(1, 20))
    def time_passes(self, seconds: int) -> None:
        self.now += seconds
        self.look()

    def fail(self, slot: Slot) -> None:
        self.failures[slot] = next_setback(self.failures.get(slot), self.now, BACKOFF, reason="failing")

    def finish(self, id: str, works: bool) -> None:
        one = self.there.pop(id)
        if one.phase == "loading" and works:
            self.there[id] = seen(one, phase="held")
        elif one.phase == "loading":
            self.fail(one.slot)
        elif one.phase == "releasing" and not works:
            self.there[id] = seen(one, phase="held", not_before=self.now + 3)

    def look(self) -> ReplicaSteps:
        steps = compare(self.wanted, self.there.values(), self.failures, self.now)
        for one in steps.load:
            self.count += 1
            id = f"{self.count:06}"
            self.there[id] = SeenReplica(one.keep, one.instance, one.what, "loading", id, State.OK, one.priority)
        for one in steps.withdraw:
            self.there[one.id] = seen(one, phase="ending")
        for one in steps.release:
            self.there[one.id] = seen(one, phase="releasing")
        for one, priority in steps.prioritise:
            self.there[one.id] = seen(one, priority=priority)
        return steps

    @invariant()
    def there_is_never_a_second_one(self) -> None:
        """But for a load of the same that is ending, which is begun after its end."""
        alive = [one for one in self.there.values() if one.phase != "ending"]
        assert max(Counter(one.slot for one in alive).values(), default=0) <= 1
        for one in self.there.values():
            if one.phase == "ending":
                assert all(
                    other.what == one.what for other in alive if other.slot == one.slot and other.phase == "loading"
                )

    @invariant()
    def a_look_begins_all_there_is_to_begin(self) -> None:
        assert not any(msgspec.structs.astuple(compare(self.wanted, self.there.values(), self.failures, self.now))[:4])

    def teardown(self) -> None:
        """When events stop, what is there is what is wanted, and each thing that is not has a reason till then."""
        for _ in range(50):
            for id in [id for id, one in self.there.items() if one.phase != "held"]:
                self.finish(id, works=True)
            for id, one in self.there.items():
                if one.state is State.ERROR:
                    self.there[id] = seen(one, state=State.OK)
            self.now += 20
            for one in report(
                {one.keep for one in self.wanted}, self.wanted, self.there.values(), self.failures
            ).values():
                assert (one.ready == one.wanted) == (one.why == "")
            if not any(msgspec.structs.astuple(self.look())):
                break
        actual = sorted((one.slot, one.what, str(one.priority)) for one in self.there.values())
        assert actual == sorted((one.slot, one.what, str(one.priority)) for one in self.wanted)
        assert all(one.is_ready for one in self.there.values())


TestWorld = World.TestCase
