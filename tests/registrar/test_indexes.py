"""The indexes over a catalog's rows: the same whether it is opened with the rows or they come and go one by one."""

from __future__ import annotations

import gc
import subprocess
import sys
import weakref
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rr_actors.registrar.model import catalog
from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.rows import (
    TABLE_OF,
    Held,
    Hold,
    Notice,
    Phase,
    Resource,
    Row,
    ServedQuery,
    State,
    content_of,
)
from rr_actors.runtime import garbage
from rr_actors.runtime.garbage import left_alone

INDEXES = (
    "by_request",
    "unloading",
    "queued",
    "moving",
    "by_server",
    "holders",
    "by_origin",
    "notices_to",
    "notices_on",
    "parts",
    "outbound",
    "unsettled",
)

SMALL = st.sampled_from(("a", "b", "c"))
IDS = st.sampled_from([f"i{number}" for number in range(8)])
RESOURCES = st.builds(
    Resource,
    IDS,
    SMALL,
    IDS.map(str.encode),
    st.just(b""),
    st.sampled_from(Phase),
    st.sampled_from((State.OK, State.OK, State.FATAL)),
    st.just(""),
    st.just(1),
)
QUERIES = st.builds(ServedQuery, IDS, IDS, SMALL, st.just(""), st.just(0), st.integers(0, 9))
HELD = st.builds(
    Held,
    IDS,
    SMALL,
    SMALL,
    st.just(b""),
    st.none(),
    IDS,
    st.sampled_from(("", "a", "b")),
    st.just(0),
    st.integers(0, 9),
    st.sampled_from(Hold),
    st.just(State.OK),
)
NOTICES = st.builds(Notice, IDS, IDS, SMALL, IDS, st.just("e"), st.just(State.OK), st.just(""), st.just("s"))
ROWS = st.lists(st.one_of(RESOURCES, QUERIES, HELD, NOTICES), max_size=30, unique_by=lambda row: (type(row), row.id))


def one_of_a_request(rows: list[Row]) -> list[Row]:
    """Rows as they can be: at most one resource that an identical request would be given."""
    seen: set[Any] = set()
    kept: list[Row] = []
    for row in rows:
        if isinstance(row, Resource):
            if (row.server, row.request) in seen:
                continue
            seen.add((row.server, row.request))
        kept.append(row)
    return kept


@given(ROWS)
@settings(max_examples=300)
def test_a_catalog_opened_with_rows_is_one_that_was_given_them_one_by_one(rows: list[Row]) -> None:
    rows = one_of_a_request(rows)
    opened = Catalog("p", content_of(rows))
    one_by_one = Catalog("p")
    for row in rows:
        one_by_one.set(TABLE_OF[type(row)], row.id, row)

    assert opened.tables == one_by_one.tables
    assert {name: getattr(opened, name) for name in INDEXES} == {name: getattr(one_by_one, name) for name in INDEXES}

    for row in rows:
        opened.set(TABLE_OF[type(row)], row.id, None)
    assert [name for name in INDEXES if getattr(opened, name)] == []


@given(st.lists(st.tuples(st.booleans(), SMALL, IDS)))
def test_an_index_has_the_ids_that_were_added_in_their_order_and_is_the_same_whatever_came_between(
    steps: list[tuple[bool, str, str]],
) -> None:
    index: dict[str, catalog.Ids] = {}
    expected: dict[str, list[str]] = {}
    for adds, key, id in steps:
        ids = expected.setdefault(key, [])
        if adds:
            catalog.add(index, key, id)
            ids += [id] if id not in ids else []
        else:
            catalog.discard(index, key, id)
            ids[:] = [other for other in ids if other != id]
    expected = {key: ids for key, ids in expected.items() if ids}
    assert {key: list(ids) for key, ids in index.items()} == expected
    pairs = [(key, id) for key, ids in expected.items() for id in ids]
    built = catalog.built([key for key, _ in pairs], [id for _, id in pairs])
    assert {key: list(ids) for key, ids in built.items()} == expected


@pytest.fixture
def nothing_is_frozen(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """As in a program of its own, where nobody has frozen what there is."""
    monkeypatch.setattr(garbage, "_frozen", False)
    gc.unfreeze()
    yield
    gc.freeze()


def test_the_garbage_collector_is_left_alone_until_the_last_block_ends_and_stays_off_where_it_was() -> None:
    assert gc.isenabled()
    outer, inner = left_alone(), left_alone()
    with outer:
        inner.__enter__()
        assert not gc.isenabled()
    assert not gc.isenabled()
    inner.__exit__(None, None, None)
    assert gc.isenabled()

    gc.disable()
    try:
        with left_alone():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


@pytest.mark.usefixtures("nothing_is_frozen")
def test_what_was_made_old_and_then_became_garbage_is_collected_after_a_while() -> None:
    class Ring:
        def __init__(self) -> None:
            self.itself = self

    rings: list[weakref.ref[Ring]] = []
    made: list[list[int]] = []
    for _ in range(80):
        ring = Ring()
        rings.append(weakref.ref(ring))
        with left_alone():
            made += ([number] for number in range(3_000))
        del ring
    assert sum(ring() is not None for ring in rings) < 40


@pytest.mark.usefixtures("nothing_is_frozen")
def test_blocks_that_leave_little_cause_no_collection_of_what_is_old() -> None:
    before = gc.get_stats()[-1]["collections"]
    for _ in range(200):
        with left_alone():
            pass
    assert gc.get_stats()[-1]["collections"] == before


@pytest.mark.usefixtures("nothing_is_frozen")
def test_what_was_made_while_the_garbage_collector_was_left_alone_is_old_afterwards() -> None:
    with left_alone():
        made = [[number] for number in range(5_000)]
    old = {id(item) for item in gc.get_objects(generation=2)}

    assert all(id(item) in old for item in made)
    assert gc.get_freeze_count() == 0


@pytest.mark.usefixtures("nothing_is_frozen")
def test_what_somebody_has_frozen_stays_so() -> None:
    gc.freeze()
    frozen = gc.get_freeze_count()
    with left_alone():
        pass
    assert gc.get_freeze_count() >= frozen > 0


def test_what_a_forked_child_makes_first_while_it_is_left_alone_is_frozen_with_what_it_shares() -> None:
    child = """
import gc
from rr_actors.runtime import garbage
garbage.share()
counts = [gc.get_freeze_count()]
for _ in range(2):
    with garbage.left_alone():
        made = [[number] for number in range(5_000)]
    counts.append(gc.get_freeze_count())
print(counts[1] - counts[0] >= 5_000, counts[2] <= counts[1], gc.isenabled())
"""
    ran = subprocess.run([sys.executable, "-c", child], capture_output=True, text=True, check=True)

    assert ran.stdout.split() == ["True", "True", "True"]


def test_a_finalizer_that_the_collection_of_a_block_runs_may_have_a_block_of_its_own() -> None:
    script = """
from rr_actors.runtime.garbage import left_alone

class Ring:
    ended = False
    def __init__(self):
        self.ring = self
    def __del__(self):
        with left_alone():
            Ring.ended = True

kept = []
for _ in range(40):  # in a row without a full collection: some of them begin with one
    with left_alone():
        Ring()  # it counts as old when the block ends
        kept.append([[number] for number in range(3000)])
print(Ring.ended)
"""
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=20)
    assert ran.stdout == "True\n"
