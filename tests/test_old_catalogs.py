"""Catalogs that an older rr_actors wrote are read, and become ones of this version when they are opened."""

from __future__ import annotations

import contextlib
import sqlite3
import tarfile
from pathlib import Path
from typing import Literal

import pytest

from rr_actors.errors import CatalogDamaged
from rr_actors.records import Peer, Put, Query, Row, rows_of
from rr_actors.stores import tables
from rr_actors.stores.opening import open_store, read_rows
from rr_actors.stores.witness import Witness
from support_stores import in_order

OLD = Path(__file__).with_name("catalogs_of_version_1.tar.gz")
"""Of the first schema, and with a journal of the first kind: one that was closed, one whose process was killed."""

ROWS: dict[str, list[Row]] = {
    "closed": [Peer("maker"), Query("a", "r", "app", "", 1, 1)],
    "killed": [Peer("arm"), Peer("maker"), Query("b", "r", "app", "", 1, 2), Query("c", "r", "app", "", 1, 3)],
}


@pytest.fixture(params=list(ROWS))
def old(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    with tarfile.open(OLD) as archive:
        archive.extractall(tmp_path, filter="data")
    return tmp_path / request.param / "catalog.sqlite3"


def version_of(path: Path) -> int:
    with contextlib.closing(sqlite3.connect(path)) as connection:
        (version,) = connection.execute("PRAGMA user_version").fetchone()
    return version


def test_it_is_read_without_being_changed(old: Path) -> None:
    before = {path: path.read_bytes() for path in old.parent.iterdir() if not path.name.endswith("-shm")}
    assert in_order(read_rows(old)) == ROWS[old.parent.name]
    assert {path: path.read_bytes() for path in before} == before


@pytest.mark.parametrize("durability", ["process", "power"])
def test_it_is_opened_and_is_one_of_this_version_from_then_on(
    old: Path, tmp_path: Path, durability: Literal["process", "power"], caplog: pytest.LogCaptureFixture
) -> None:
    rows = ROWS[old.parent.name]
    for number in range(3):
        store = open_store(old, durability=durability, witness=Witness(tmp_path, "app"))
        assert in_order(rows_of(store.load())) == in_order([*rows, *(Peer(f"p{n}") for n in range(number))])
        store.commit([Put(Peer(f"p{number}"))])
        store.close()
        assert version_of(old) == tables.SCHEMA_VERSION == 2
    assert [record for record in caplog.records if record.levelname == "WARNING"] == []
    with pytest.raises(CatalogDamaged, match="that of the registrar 'app' in the place of that of 'other'"):
        open_store(old, witness=Witness(tmp_path, "other"))


def test_an_upgrade_that_is_cut_short_leaves_the_old_one(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tables, "UPGRADE", (*tables.UPGRADE, "SELECT nothing"))
    with pytest.raises(CatalogDamaged, match="nothing"):
        open_store(old)
    monkeypatch.undo()
    assert version_of(old) == 1
    assert in_order(read_rows(old)) == ROWS[old.parent.name]
