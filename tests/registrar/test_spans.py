"""A consumer and a provider that compare digests agree on the same as those that compare everything."""

from __future__ import annotations

import random
from typing import Any, NoReturn

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rr_actors.registrar.core.decide import decide
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import digests
from rr_actors.registrar.model import effects as e
from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.messages import Fetch, Fetched, Noticed
from rr_actors.registrar.model.rows import Held, Hold, Peer, Phase, Resource, Row, ServedQuery, State, content_of

HOLDS = (None, Hold.PENDING, Hold.HELD, Hold.HELD, Hold.HELD, Hold.OWED)
PHASES = (None, Phase.LOADED, Phase.LOADED, Phase.LOADED, Phase.LOADING, Phase.UNLOADING, Phase.UNLOAD_FAILED)
ONE = st.tuples(
    st.sampled_from(HOLDS),
    st.sampled_from(PHASES),
    st.sampled_from((State.OK, State.OK, State.OK, State.FATAL)),
    st.sampled_from((b"1", b"1", b"1", b"2")),
    st.booleans(),
)


def held(number: int, hold: Hold = Hold.HELD, response: bytes | None = b"1") -> Held:
    place = (
        "p",
        "cam",
        b"%d" % number,
        response if hold is Hold.HELD else None,
        f"r{number}" if hold is Hold.HELD else "",
    )
    return Held(f"q{number}", *place, "", 0, number, hold, State.OK)


def served(number: int, phase: Phase = Phase.LOADED, state: State = State.OK, response: bytes = b"1") -> list[Row]:
    resource = Resource(f"r{number}", "cam", b"%d" % number, response, phase, state, "", 1)
    return [resource, ServedQuery(f"q{number}", f"r{number}", "app", "", 0, number)]


def known(consumer: Catalog, before: digests.HeldRows | None = None) -> digests.HeldRows:
    """What the consumer tells of what it holds."""
    return digests.known(digests.held_at(consumer, "p"), before)


def told(provider: Catalog, known: digests.Spans) -> Fetched:
    """The provider's answer, as one message."""
    decision = decide(provider, [(Fetch("app", True, 7, known), "app")])
    messages = [effect.message for effect in decision.effects if isinstance(effect, e.SendReply)]
    parts = [message for message in messages if isinstance(message, Fetched)]
    assert [part.more for part in parts] == [True] * (len(parts) - 1) + [False]
    return Fetched([query for part in parts for query in part.queries], False, 7, parts[-1].same)


def agreed(consumer: Catalog, answer: Fetched) -> tuple[Any, ...]:
    """What the consumer makes of it."""
    decision = decide(consumer, [(c.Reconcile("p", answer.queries, "e", answer.same), None)])
    return decision.changes, decision.later, decision.effects, consumer.held, consumer.kept


@given(st.lists(ONE, max_size=12), st.integers(1, 4))
@settings(max_examples=300)
def test_what_is_agreed_on_by_digests_is_what_whole_lists_come_to(ones: list[Any], length: int) -> None:
    mine: list[Row] = []
    theirs: list[Row] = []
    kept: list[str] = []
    for number, (hold, phase, state, response, is_kept) in enumerate(ones, 1):
        if hold is not None:
            mine.append(held(number, hold))
        if hold is Hold.HELD:
            kept += [f"q{number}"] * is_kept
        if phase is not None:
            theirs += served(number, phase, state, response)

    def consumer() -> Catalog:
        catalog = Catalog("app", content_of(mine), 2)
        catalog.kept.update(dict.fromkeys(kept, True))
        return catalog

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(digests, "LENGTH", length)
        by_digests = consumer()
        answer = told(Catalog("p", content_of(theirs), 1), known(by_digests).spans)

    assert agreed(by_digests, answer) == agreed(consumer(), told(Catalog("p", content_of(theirs), 1), []))


def test_where_nothing_differs_nothing_is_listed() -> None:
    rows = [row for number in range(1, 5001) for row in served(number)]
    random.Random(1).shuffle(rows)
    consumer = Catalog("app", content_of([Peer("p"), *(held(number) for number in range(1, 5001))]))

    answer = told(Catalog("p", content_of(rows), 2), known(consumer).spans)

    assert (answer.queries, answer.same) == ([], [(-1, 2**63 - 1)])
    assert agreed(consumer, answer)[:3] == ([], {}, [])


def test_with_one_that_differs_its_span_is_listed_and_what_came_behind_the_last() -> None:
    rows = [row for number in range(1, 5001) if number != 2000 for row in served(number)]
    consumer = Catalog("app", content_of([held(number) for number in range(1, 4991)]))

    answer = told(Catalog("p", content_of(rows), 2), known(consumer).spans)

    listed = [query.seq for query in answer.queries]
    assert listed == [*(number for number in range(1025, 2049) if number != 2000), *range(4991, 5001)]
    assert answer.same == [(-1, 1024), (2048, 4990)]
    decision = decide(consumer, [(c.Reconcile("p", answer.queries, "e", answer.same), None)])
    (lost,) = [effect.message for effect in decision.effects if isinstance(effect, e.Receive)]
    assert isinstance(lost, Noticed)
    assert (lost.notice.query_id, lost.notice.state) == ("q2000", State.FATAL)


def test_digests_are_made_once_as_long_as_the_same_is_held() -> None:
    consumer = Catalog("app", content_of([held(number) for number in range(1, 3000)]))
    first = known(consumer)
    assert known(consumer, first) is first

    consumer.set("held", "q7", held(7, Hold.OWED))
    second = known(consumer, first)
    assert second.spans[1:] != first.spans[1:], "one less, so that each span begins with another"
    assert second == known(consumer)


class Looked(dict[str, Resource]):
    """Resources that are looked up, and never all gone through."""

    def __iter__(self) -> NoReturn:
        raise AssertionError("all resources are gone through")

    def values(self) -> NoReturn:
        raise AssertionError("all resources are gone through")


def test_whoever_holds_little_is_answered_by_looking_at_little() -> None:
    others = [row for number in range(2, 500) for row in served(number)]
    rows = [msgspec.structs.replace(row, origin="other") if isinstance(row, ServedQuery) else row for row in others]
    provider = Catalog("p", content_of([*served(1), *rows]), 2)
    provider.resources = Looked(provider.resources)

    answer = told(provider, [])

    assert [query.query_id for query in answer.queries] == ["q1"]
