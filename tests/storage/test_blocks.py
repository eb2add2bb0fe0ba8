"""Rows of one table, packed by their columns, are unpacked as they were, and what was one object is one again."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rr_actors.registrar.model.rows import TABLES, Hold, Peer, Phase, Query, Resource, State, StoredServer, Table
from rr_actors.storage import image
from support_stores import part, query, rows_of, values

FEW = st.sampled_from(["", "a", "b", "OK", "ERROR"])


@pytest.mark.parametrize("table", TABLES)
@settings(max_examples=20)
@given(data=st.data())
def test_any_rows_are_unpacked_as_they_were_packed(table: Table, data: st.DataObject) -> None:
    assert_unpacked_as_packed(table, data)


@pytest.mark.slow
@pytest.mark.parametrize("table", TABLES)
@settings(max_examples=80)
@given(data=st.data())
def test_many_more_rows_are_unpacked_as_they_were_packed(table: Table, data: st.DataObject) -> None:
    assert_unpacked_as_packed(table, data)


def assert_unpacked_as_packed(table: Table, data: st.DataObject) -> None:
    ids = data.draw(st.sampled_from([FEW, values(str)]))
    some = st.lists(rows_of(TABLES[table], ids), min_size=1, max_size=10, unique_by=lambda row: row.id)
    rows: list[Any] = data.draw(some)

    packed = image.packed(rows)
    unpacked_ids, unpacked = image.rows_of_block(packed, TABLES[table])

    assert unpacked == rows
    assert unpacked_ids == [row.id for row in rows]
    assert [list(map(type, values_of(row))) for row in unpacked] == [list(map(type, values_of(row))) for row in rows]


values_of = msgspec.structs.astuple


def test_columns_in_which_all_is_the_same_or_as_the_ids_take_no_room() -> None:
    rows = [Query(f"query-{n}", f"query-{n}", "the consumer", "", 0, n) for n in range(1000)]
    different = [Query(f"query-{n}", f"r-{n}", f"c-{n}", f"p-{n}", n, n) for n in range(1000)]

    assert len(image.packed(rows)) < 16 * 1000 < len(image.packed(different))


def test_a_text_that_repeats_is_one_object() -> None:
    rows = [Query(f"q{n}", f"q{n}", "the consumer"[:], ("x" * 30, "y" * 30)[n % 2][:], 0, n) for n in range(20)]

    _, found = image.rows_of_block(image.packed(rows), Query)

    assert found == rows
    assert all(row.resource_id is row.id for row in found)
    assert len({id(row.origin) for row in found}) == 1
    assert len({id(row.parent) for row in found}) == 2


def test_a_state_is_no_id_though_they_read_the_same() -> None:
    rows = [part("OK"), msgspec.structs.replace(part("ERROR"), state=State.ERROR)]

    _, found = image.rows_of_block(image.packed(rows), Resource)

    assert [type(row.state) for row in found] == [State, State]
    assert found == rows


UNFIT: dict[str, tuple[Any, type[Any]]] = {
    "not rows at all": (b"\xc1", Peer),
    "nothing": (b"", Peer),
    "no list": (7, Peer),
    "a column too few": ([["a"]], StoredServer),
    "no ids": ([[], []], StoredServer),
    "an id that is bytes": ([[b"a"], [b"b"]], StoredServer),
    "items too few": ([["a", "b", "c"], [b"a", b"b"]], StoredServer),
    "items too many": ([["a"], [b"a", b"b"]], StoredServer),
    "the ids where bytes should be": ([["a"], []], StoredServer),
    "a phase there is not": ([["a"], ["s"], [b""], [None], ["flying"], ["OK"], [""], [1], [0]], Resource),
    "a text for a number": ([["a"], ["r"], ["o"], [""], ["1"], [1]], Query),
}


@pytest.mark.parametrize("name", UNFIT)
def test_what_are_no_rows_of_this_type_is_an_error(name: str) -> None:
    data, type_ = UNFIT[name]
    packed = data if isinstance(data, bytes) else msgspec.msgpack.encode(data)
    with pytest.raises((msgspec.MsgspecError, ValueError)):
        image.rows_of_block(packed, type_)


@given(st.binary(max_size=60), st.sampled_from(list(TABLES.values())))
def test_any_bytes_are_rows_or_an_error(data: bytes, type_: type[Any]) -> None:
    try:
        ids, rows = image.rows_of_block(data, type_)
    except (msgspec.MsgspecError, ValueError):
        return
    assert [row.id for row in rows] == ids


def test_phases_and_holds_are_themselves_again() -> None:
    rows = [part("a"), part("b")]
    assert all(row.phase is Phase.LOADED for row in image.rows_of_block(image.packed(rows), Resource)[1])
    assert Hold("held") is Hold.HELD
    assert image.rows_of_block(image.packed([query("a", 2**63 - 1)]), Query)[1] == [query("a", 2**63 - 1)]
