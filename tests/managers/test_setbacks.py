"""Setbacks: each failure in a row waits longer, the same one counts once, and what was well for long begins anew."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

import rr_actors as rr
from rr_actors.managers.planning.retries import TRIES, Retries
from rr_actors.managers.planning.setbacks import Setback, Setbacks, next_setback

backoffs = st.builds(
    lambda delay_s, factor, more_s: rr.Backoff(delay_s, factor, delay_s + more_s, 0.0),
    st.floats(0.0, 10.0),
    st.floats(1.0, 10.0),
    st.floats(0.0, 100.0),
)


@given(backoffs, st.integers(1, 100))
def test_failures_in_a_row_wait_longer_each_time_up_to_the_limit(backoff: rr.Backoff, times: int) -> None:
    before: Setback | None = None
    waited_s = 0.0
    for _ in range(times):
        before = next_setback(before, 0.0, backoff)
        assert waited_s <= before.retry_at <= backoff.maximum_s
        waited_s = before.retry_at
    assert before is not None
    assert before.count == times


@given(backoffs.filter(lambda backoff: backoff.maximum_s > 0), st.integers(1, 10))
def test_what_has_run_well_for_as_long_as_the_limit_begins_anew(backoff: rr.Backoff, times: int) -> None:
    before: Setback | None = None
    for _ in range(times):
        before = next_setback(before, 0.0, backoff)
    assert next_setback(before, 0.0, backoff, ran_s=backoff.maximum_s) == next_setback(None, 0.0, backoff)


@given(st.lists(st.sampled_from(["one", "two"]), max_size=10))
def test_a_failure_counts_once_in_a_row_however_many_report_it(reported: list[str]) -> None:
    some = Setbacks[str]()
    for at, failure_id in enumerate(reported):
        some.note("camera", float(at), failure_id=failure_id)
    in_a_row = [id for i, id in enumerate(reported) if i == 0 or reported[i - 1] != id]
    found = some.get("camera")
    assert (found.count if found is not None else 0) == len(in_a_row)


def test_what_is_well_is_tried_first_and_what_waits_last() -> None:
    some = Setbacks[str](rr.Backoff(1.0, 2.0, 8.0, 0.0))
    some.note("a", 0.0)
    assert some.ready_first("abc", 0.5) == ["b", "c", "a"]
    assert some.ready_first("abc", 0.5, lambda key: key == "c") == ["c", "b", "a"]
    assert some.next_at(0.5) == 1.0
    assert some.ready_first("abc", 1.0) == ["a", "b", "c"]
    assert some.next_at(1.0) is None


def test_what_is_forgotten_may_be_tried_at_once() -> None:
    some = Setbacks[str]()
    for key in "abc":
        some.note(key, 0.0)
    some.forget("a")
    assert some.may_try("a", 0.0)
    some.keep_only("b")
    assert (some.may_try("b", 0.0), some.may_try("c", 0.0)) == (False, True)
    some.clear()
    assert some.may_try("b", 0.0)


def test_what_has_failed_ten_times_in_a_row_is_given_up_and_the_others_are_not() -> None:
    retries = Retries[str]()
    retries.failed("other")
    for i in range(TRIES):
        assert retries.wait_s("one") is not None
        retries.failed("one", f"failure {i}")
    said: list[str] = []
    retries.stop()
    assert retries.rest("one", "it", said.append) is None
    assert retries.rest("other", "it", said.append) is not None
    assert retries.is_ready("third")
    assert said == []


def test_before_a_wait_that_is_not_short_the_holders_hear_of_it() -> None:
    retries, said = Retries[str](), list[str]()
    for failure in ("one", "two", "two", "three"):
        retries.failed("camera", failure)
    retries.stop()
    assert not retries.is_ready("camera")
    assert retries.rest("camera", "camera", said.append)
    assert said == ["camera is tried again in 0.4 s, as it has failed repeatedly"]
