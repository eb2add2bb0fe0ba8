"""The book of a bridge's holds: the same id is the same hold, and nothing is held for nobody."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

import rr_actors as rr
from rr_actors.managers.ros.hold_book import (
    GONE_S,
    OWNER_S,
    RESTORED_S,
    RETRY_S,
    Action,
    Answer,
    Begin,
    HoldBook,
    Lease,
    Release,
    Say,
    Withdraw,
)
from rr_actors.managers.ros.ros_config import Json
from rr_actors.managers.ros.ros_messages import Load, Renew, Unload

NAV, CAM = "/nav", "cameras/camera"
HERE = frozenset({NAV})


def book() -> HoldBook:
    return HoldBook(Json(allow=("cameras/*",), max_priority=5), "/rr/load")


def load(id: str = "1", server: str = CAM, **more: Any) -> Load:
    return Load(id, NAV, server, **more)


def held(lease_s: float | None = None) -> HoldBook:
    one = book()
    (begin,) = one.load(load(lease_s=lease_s), 0.0, HERE)
    assert isinstance(begin, Begin)
    assert one.loaded(begin.number, "q1", "feed", 0.0) == [Answer("load", (NAV, "1"), None, "q1", "feed")]
    return one


def refusal(actions: list[Action]) -> Any:
    (answer,) = actions
    assert isinstance(answer, Answer)
    assert answer.error is not None
    return answer.error


def test_the_same_id_again_is_the_same_query() -> None:
    one = book()
    (begin,) = one.load(load(), 0.0, HERE)
    assert one.load(load(), 1.0, HERE) == []  # it is loading, and its answer comes
    assert isinstance(begin, Begin)
    first = one.loaded(begin.number, "q1", "feed", 2.0)
    assert one.load(load(), 3.0, HERE) == first


@pytest.mark.parametrize(
    ("asked", "kind", "text"),
    [
        (load("2", "maps/map"), "NotAllowed", "/rr/load: server: expected one of cameras/*, got 'maps/map'"),
        (load("2", priority=6), "InvalidRequest", "/rr/load: priority: expected 5 at most"),
        (load("1", request="other"), "InvalidRequest", "/rr/load: id: expected another id for another request"),
    ],
)
def test_what_is_not_allowed_is_refused(asked: Load, kind: str, text: str) -> None:
    error = refusal(held().load(asked, 1.0, HERE))
    assert type(error).__name__ == kind
    assert text in str(error)


def test_an_owner_that_never_was_holds_nothing() -> None:
    one = book()
    assert one.load(load(), 0.0, frozenset({"/nab"})) == []
    assert one.tick(OWNER_S - 0.1, frozenset({"/nab"})) == []
    error = refusal(one.tick(OWNER_S, frozenset({"/nab"})))
    assert (error.path, error.got) == ("owner", "'/nav'")
    assert "the full name of a node in the graph; did you mean '/nab'?" in error.expected
    assert one.holds() == []


def test_an_owner_that_is_seen_a_little_later_loads() -> None:
    one = book()
    assert one.load(load(), 0.0, frozenset()) == []
    (begin,) = one.tick(1.0, HERE)
    assert isinstance(begin, Begin)


def test_a_hold_ends_when_its_owner_is_gone_for_some_time() -> None:
    one = held()
    assert one.tick(10.0, frozenset()) == []
    assert one.tick(11.0, HERE) == []  # it was missing for a moment
    assert one.tick(12.0, frozenset()) == []
    said, release = one.tick(12.0 + GONE_S, frozenset())
    assert isinstance(said, Say)
    assert (said.state, said.reason, release) == ("FATAL", "owner_gone", Release(1, "q1"))
    assert one.released(1, None, 15.0) == []
    assert one.holds() == []


def test_a_lease_ends_if_it_is_not_renewed() -> None:
    one = held(lease_s=5.0)
    (answer,) = one.renew(Renew("1", NAV), 4.0)
    assert isinstance(answer, Answer)
    assert answer.error is None
    assert one.tick(8.9, HERE) == []
    said, release = one.tick(9.0, HERE)
    assert isinstance(said, Say)
    assert (said.reason, said.message) == ("lease_ended", "the lease of 5 s was not renewed")
    assert release == Release(1, "q1")
    assert "the lease of 5 s" not in str(refusal(one.renew(Renew("1", NAV), 9.1)))


@pytest.mark.parametrize("is_switch", [False, True])
def test_a_release_that_nobody_waits_for_is_tried_again_until_it_is_done(is_switch: bool) -> None:
    one = book()
    if is_switch:
        (begin,) = one.switch_on("light", CAM, "1", 0, 0.0)
        one.loaded(1, "q1", "feed", 0.0)
        one.heard(1, Say(("", ""), "q1", "FATAL", "it burnt out"))
        release, begin = one.switch_on("light", CAM, "1", 0, 1.0)
        assert isinstance(begin, Begin)
    else:
        one.load(load(), 0.0, HERE)
        one.unload(Unload("1", NAV))  # withdrawn, but it had just been loaded
        (release,) = one.loaded(1, "q1", "feed", 1.0)
    assert release == Release(1, "q1")
    failed = rr.UnloadFailed("it is stuck", server=CAM)
    for at in (2.0, 2.0 + RETRY_S):
        assert one.released(1, failed, at) == []
        assert one.tick(at + RETRY_S - 0.1, HERE) == []
        assert one.tick(at + RETRY_S, HERE) == [release]
        assert one.tick(at + RETRY_S, HERE) == []  # its end is not heard yet
    assert one.released(1, None, 99.0) == []
    assert one.tick(999.0, HERE) == []


def test_a_lease_that_ends_withdraws_a_load() -> None:
    one = book()
    one.load(load(lease_s=5.0), 0.0, HERE)
    said, withdraw, answer = one.tick(5.0, HERE)
    assert isinstance(said, Say)
    assert withdraw == Withdraw(1)
    assert "was not renewed" in str(refusal([answer]))
    assert one.loaded(1, "q1", "feed", 5.1) == [Release(1, "q1")]  # it had just ended


def test_an_unload_is_answered_once_it_is_done_and_as_often_as_it_is_asked() -> None:
    one = held()
    assert one.unload(Unload("1", NAV)) == [Release(1, "q1")]
    assert one.unload(Unload("1", NAV)) == []
    assert one.released(1, None, 1.0) == [Answer("unload", (NAV, "1"))]
    assert one.unload(Unload("1", NAV)) == [Answer("unload", (NAV, "1"))]


def test_a_late_load_of_a_hold_that_has_ended_loads_nothing() -> None:
    one = held()
    one.unload(Unload("1", NAV))
    one.released(1, None, 1.0)
    error = refusal(one.load(load(), 2.0, HERE))
    assert isinstance(error, rr.UnknownQuery)
    assert "it has been released; expected a new id" in str(error)


def test_what_was_never_held_cannot_be_released_or_renewed() -> None:
    for error in (refusal(held().unload(Unload("7", NAV))), refusal(held().renew(Renew("7", NAV), 1.0))):
        assert isinstance(error, rr.UnknownQuery)
        assert str(error) == "/nav holds nothing by the id '7': its ids are 1"


def test_a_release_that_fails_keeps_the_hold_and_is_tried_again_if_its_owner_is_gone() -> None:
    one = held()
    one.unload(Unload("1", NAV))
    failed = rr.UnloadFailed("it is stuck", resource_id="r")
    assert refusal(one.released(1, failed, 1.0)) is failed
    assert one.tick(2.0, frozenset()) == []
    assert one.tick(2.0 + RETRY_S, frozenset())[1:] == [Release(1, "q1")]


def test_after_a_restart_the_holds_go_on_and_their_owners_have_time_to_be_seen() -> None:
    one = book()
    one.restored(Lease(NAV, "1", CAM, {}, None), "q1", "feed", "OK", 0.0)
    assert one.load(load(), 1.0, HERE) == [Answer("load", (NAV, "1"), None, "q1", "feed")]
    assert one.tick(1.0, frozenset()) == []
    assert one.tick(1.0 + GONE_S, frozenset()) == []
    assert one.tick(1.0 + RESTORED_S, frozenset())[1:] == [Release(1, "q1")]


def test_after_a_restart_a_load_goes_on_and_answers_who_sends_again() -> None:
    one = book()
    lease = Lease(NAV, "1", CAM, {}, None, 5)
    (begin,) = one.interrupted(lease, 0.0)
    assert isinstance(begin, Begin)
    assert begin.lease == lease
    assert one.load(load(), 1.0, HERE) == []
    assert one.loaded(begin.number, "q1", "feed", 2.0) == [Answer("load", (NAV, "1"), None, "q1", "feed")]


def test_what_is_exposed_no_more_is_known() -> None:
    assert book().is_exposed(Lease(NAV, "1", CAM, {}), {"lamp"})
    assert not book().is_exposed(Lease(NAV, "1", "maps/map", {}), {"lamp"})
    assert book().is_exposed(Lease("", "lamp", "lamps/lamp", {}), {"lamp"})
    assert not book().is_exposed(Lease("", "door", "doors/door", {}), {"lamp"})
    assert not held().is_exposed(Lease(NAV, "1", CAM, {}), {"lamp"})  # it is held already


def test_a_switch_whose_resource_is_lost_loads_anew() -> None:
    one = HoldBook(None)
    (begin,) = one.switch_on("lamp", "lamps/lamp", {}, 0, 0.0)
    assert isinstance(begin, Begin)
    assert one.switch_on("lamp", "lamps/lamp", {}, 0, 0.0) == []
    one.loaded(begin.number, "q1", "on", 0.0)
    one.heard(begin.number, Say(("", ""), "q1", "FATAL", "it burned"))
    release, again = one.switch_on("lamp", "lamps/lamp", {}, 0, 1.0)
    assert release == Release(begin.number, "q1")
    assert isinstance(again, Begin)
    assert again.number != begin.number
    assert one.released(begin.number, None, 1.1) == []
    assert one.loaded(again.number, "q2", "on", 1.2) == [Answer("load", ("", "lamp"), None, "q2", "on")]


class Bridge(RuleBasedStateMachine):
    """Nodes ask, loads end or fail, nodes come and go, time passes: and the book and what is there agree."""

    def __init__(self) -> None:
        super().__init__()
        self.book, self.now = book(), 0.0
        self.nodes = {"/a", "/b"}
        self.loading, self.held, self.releasing = set[int](), dict[int, str](), dict[int, str]()
        self.begun = list[tuple[str, str]]()

    def done(self, actions: list[Action]) -> None:
        for action in actions:
            if isinstance(action, Begin):
                assert action.number not in self.loading
                assert action.lease.owner in self.nodes
                self.loading.add(action.number)
                self.begun.append(action.lease.key)
            elif isinstance(action, Withdraw):
                self.loading.remove(action.number)
            elif isinstance(action, Release):
                self.releasing[action.number] = self.held.pop(action.number)

    @rule(
        id=st.sampled_from("xyz"), owner=st.sampled_from(["/a", "/b"]), lease_s=st.none() | st.sampled_from([1.0, 9.0])
    )
    def load(self, id: str, owner: str, lease_s: float | None) -> None:
        self.done(self.book.load(Load(id, owner, CAM, {}, lease_s), self.now, self.nodes))

    @rule(id=st.sampled_from("xyz"), owner=st.sampled_from(["/a", "/b"]))
    def unload(self, id: str, owner: str) -> None:
        self.done(self.book.unload(Unload(id, owner)))

    @rule(id=st.sampled_from("xyz"), owner=st.sampled_from(["/a", "/b"]))
    def renew(self, id: str, owner: str) -> None:
        self.done(self.book.renew(Renew(id, owner), self.now))

    @precondition(lambda self: self.loading)
    @rule(data=st.data(), ok=st.booleans())
    def ended(self, data: st.DataObject, ok: bool) -> None:
        number = data.draw(st.sampled_from(sorted(self.loading)))
        self.loading.remove(number)
        if ok:
            self.held[number] = f"q{number}"
            self.done(self.book.loaded(number, f"q{number}", None, self.now))
        else:
            self.done(self.book.failed(number, rr.LoadFailed("no", server=CAM)))

    @precondition(lambda self: self.releasing)
    @rule(data=st.data(), ok=st.booleans())
    def released(self, data: st.DataObject, ok: bool) -> None:
        number = data.draw(st.sampled_from(sorted(self.releasing)))
        query = self.releasing.pop(number)
        if not ok:
            self.held[number] = query
        self.done(self.book.released(number, None if ok else rr.UnloadFailed("stuck", resource_id="r"), self.now))

    @rule(owner=st.sampled_from(["/a", "/b"]), passed_s=st.sampled_from([0.1, 1.0, 5.0]))
    def goes_or_comes(self, owner: str, passed_s: float) -> None:
        self.nodes ^= {owner}
        self.passes(passed_s)

    @rule(passed_s=st.sampled_from([0.1, 1.0, 5.0]))
    def passes(self, passed_s: float) -> None:
        self.now += passed_s
        self.done(self.book.tick(self.now, self.nodes))

    @invariant()
    def the_book_and_what_is_there_agree(self) -> None:
        phases = {hold.number: hold.phase for hold in self.book.holds() if hold.phase != "awaited"}
        assert {number for number, phase in phases.items() if phase == "loading"} == self.loading
        assert {number for number, phase in phases.items() if phase == "held"} == set(self.held)
        assert {number for number, phase in phases.items() if phase == "releasing"} == set(self.releasing)

    def teardown(self) -> None:
        """All nodes go: whatever was held is released."""
        self.nodes.clear()
        for _ in range(6):
            self.passes(20.0)
            for number in list(self.releasing):
                del self.releasing[number]
                self.done(self.book.released(number, None, self.now))
        assert self.book.holds() == []
        assert not self.held
        assert not self.loading


TestBridge = Bridge.TestCase
TestBridge.settings = settings(max_examples=60, stateful_step_count=30)
