"""A large table read by its columns gives the rows that reading it row by row does, or says that it is not clear."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rr_actors.records import TABLES, Put, Query, Row, Table
from rr_actors.stores import columns, tables
from rr_actors.stores.damage import Damage
from support_stores import in_order, part, query, rows_of, values

IDS = values(str)


@pytest.fixture(autouse=True)
def few_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(columns, "_ROWS", 3)


def stored(rows: Sequence[Row], sql: str = "") -> sqlite3.Connection:
    """The rows in a catalog's tables, and what `sql` has done to them."""
    connection = sqlite3.connect(":memory:", isolation_level=None, check_same_thread=False)
    for create in tables.SCHEMA.values():
        connection.execute(create)
    for statement, parameters in tables.statements([Put(row) for row in rows]):
        connection.execute(statement, parameters)
    connection.executescript(sql)
    return connection


def read(connection: sqlite3.Connection, table: Table) -> list[Any]:
    return columns.read_table(connection, table, TABLES[table])


@pytest.mark.parametrize("table", TABLES)
@settings(max_examples=60)
@given(data=st.data())
def test_any_rows_are_read_as_they_were_written(table: Table, data: st.DataObject) -> None:
    rows = data.draw(st.lists(rows_of(TABLES[table], IDS), max_size=10, unique_by=lambda row: row.id))
    connection = stored(rows)

    assert read(connection, table) == in_order(rows)
    assert tables.read_all(connection, large=True) == in_order(rows)
    connection.close()


@pytest.mark.parametrize("count", range(8))
def test_however_many_there_are_each_is_read_once(count: int) -> None:
    rows = [query(f"q{number}", number) for number in range(count)]

    assert read(stored(rows), "queries") == rows


def test_a_text_that_repeats_is_one_object(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(columns, "_ROWS", 100)
    rows = [Query(f"q{number}", f"q{number}", "the consumer", "", 0, number) for number in range(20)]

    found = read(stored(rows), "queries")

    assert all(row.resource_id is row.id for row in found)
    assert len({id(row.origin) for row in found}) == 1


UNCLEAR = {
    "a wrong checksum": "UPDATE queries SET crc = crc + 1 WHERE id = 'q3'",
    "another text": "UPDATE queries SET origin = 'other' WHERE id = 'q3'",
    "a text that is bytes": "UPDATE queries SET origin = x'01' WHERE id = 'q3'",
    "a text that is not UTF-8": "UPDATE queries SET origin = CAST(x'ff' AS TEXT) WHERE id = 'q3'",
    "a number that is text": "UPDATE queries SET seq = 'seven' WHERE id = 'q3'",
    "an id that is bytes": "UPDATE queries SET id = x'01' WHERE id = 'q3'",
    "ids that are bytes": "UPDATE queries SET id = CAST(id AS BLOB)",
    "an id that is not UTF-8": "UPDATE queries SET id = CAST(x'ff' AS TEXT) WHERE id = 'q3'",
    "no such table": "DROP TABLE queries",
}


@pytest.mark.parametrize("sql", UNCLEAR.values(), ids=UNCLEAR)
def test_what_is_wrong_makes_a_table_unclear_and_reading_its_rows_tells_what(sql: str) -> None:
    connection = stored([query(f"q{number}", number) for number in range(7)], sql)

    with pytest.raises(columns.Unclear):
        read(connection, "queries")
    with pytest.raises((Damage, UnicodeDecodeError, sqlite3.Error)):
        tables.read_all(connection, large=True)


def as_text(connection: sqlite3.Connection) -> None:
    connection.execute("UPDATE resources SET request = CAST(request AS TEXT)")


def as_a_new_one(connection: sqlite3.Connection) -> None:
    connection.execute("UPDATE resources SET response = x'' WHERE id = 'r3'")


@pytest.mark.parametrize("change", [as_text, as_a_new_one])
def test_bytes_that_are_none_or_other_ones_make_a_table_unclear(change: Callable[[sqlite3.Connection], None]) -> None:
    connection = stored([part(f"r{number}", b"request") for number in range(7)])
    change(connection)

    with pytest.raises(columns.Unclear):
        read(connection, "resources")
    with pytest.raises(Damage):
        tables.read_all(connection, large=True)


def test_rows_too_long_to_be_gathered_are_read_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(columns, "_LONGEST", 10_000)
    rows = [part(f"r{number}", bytes(8_000)) for number in range(7)]
    connection = stored(rows)

    with pytest.raises(columns.Unclear):
        read(connection, "resources")
    assert tables.read_all(connection, large=True) == rows


def test_a_connection_is_afterwards_as_it_was() -> None:
    connection = stored([query(f"q{number}", number) for number in range(7)], UNCLEAR["another text"])
    longest = connection.getlimit(sqlite3.SQLITE_LIMIT_LENGTH)
    for _ in range(2):
        with pytest.raises(columns.Unclear):
            read(connection, "queries")

        assert connection.execute("SELECT 'text'").fetchone() == ("text",)
        assert connection.getlimit(sqlite3.SQLITE_LIMIT_LENGTH) == longest
        connection.execute("DELETE FROM queries WHERE id = 'q3'")
        connection.execute("UPDATE queries SET seq = 99 WHERE id = 'q4'")


def test_good_rows_in_another_order_make_a_table_unclear() -> None:
    """SQLite looks for the rows between two ids, and would miss some where they are in no order."""
    connection = stored([query(f"q{number}", number) for number in range(7)])
    ((page, size),) = connection.execute(
        "SELECT rootpage, page_size FROM sqlite_schema, pragma_page_size WHERE name = 'queries'"
    )
    data = bytearray(connection.serialize())
    first = (page - 1) * size + 8  # of two bytes for each row: where in the page it is
    last = first + 2 * 6
    data[first : first + 2], data[last : last + 2] = data[last : last + 2], data[first : first + 2]
    connection.deserialize(bytes(data))
    assert [id for (id,) in connection.execute("SELECT id FROM queries")] == ["q6", "q1", "q2", "q3", "q4", "q5", "q0"]

    with pytest.raises(columns.Unclear, match="order"):
        read(connection, "queries")
