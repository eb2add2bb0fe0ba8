"""What one damaged file loses, at each step of the folding: nothing that another sound file still has."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from fuzz import flips
from rr_actors.base.errors import CatalogDamaged, CatalogError
from rr_actors.registrar.model.rows import Put, Row, rows_of
from rr_actors.storage.opening import Durability, open_store, read_rows
from rr_actors.storage.sqlite_store import SqliteTables
from support_slow import few_now
from support_stores import in_order, part, query, segments_of


@pytest.mark.timeout(600)
@pytest.mark.parametrize("one_in", few_now([4], [1]))
@pytest.mark.parametrize("durability", ["process", "power"])
def test_one_damaged_file_loses_nothing_that_another_one_has_at_any_step_of_the_folding(
    tmp_path: Path, durability: Durability, one_in: int
) -> None:
    """The whole of it: python -m fuzz.flips."""
    counts, failures = flips.sweep(
        tmp_path, durability, step=2003 * one_in, chosen=lambda number, _: number % one_in == 0
    )
    assert failures == []
    assert {"right", "refused", "warned"} == set(counts)


def test_the_sweep_would_find_the_loss(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As without a second copy of a -wal that is copied in part."""
    monkeypatch.setattr("rr_actors.storage.write_ahead.Spare.recover", lambda *_: None)
    _, failures = flips.sweep(tmp_path, "process", step=9001, chosen=lambda _, stage: "pages copied" in stage.name)
    assert any("catalog.sqlite3-wal" in failure for failure in failures)


def test_who_reads_a_catalog_without_its_lock_gets_no_mixture_of_old_and_new_pages(tmp_path: Path) -> None:
    (tmp_path / "made").mkdir()
    found = [stage for stage in flips.stages(tmp_path / "made", "process") if "pages copied" in stage.name]
    assert found
    for stage in found:
        path = stage.directory / "app" / "catalog.sqlite3"
        assert frozenset(read_rows(path)) == stage.rows
        for spoil in (flip_at(600), cut_to_nothing, Path.unlink):
            copy = shutil.copytree(path.parent, tmp_path / "copy")
            spoil(copy / "catalog.sqlite3-wal")
            with contextlib.suppress(CatalogDamaged):
                assert frozenset(read_rows(copy / path.name)) == stage.rows
            shutil.rmtree(copy)


# -- while the catalog is open -------------------------------------------------------------------------------------


def wal_of(path: Path) -> Path:
    return path.with_name(f"{path.name}-wal")


def in_place(path: Path, change: Callable[[bytearray], None]) -> None:
    """Change a file that another descriptor has open."""
    data = bytearray(path.read_bytes())
    change(data)
    with path.open("r+b") as file:
        file.write(data)
        file.truncate(len(data))


def flip_at(at: int) -> Callable[[Path], None]:
    def flip(path: Path) -> None:
        def change(data: bytearray) -> None:
            data[at] ^= 1

        in_place(path, change)

    return flip


def cut_in_half(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def cut_to_nothing(path: Path) -> None:
    os.truncate(path, 0)


DAMAGE = {
    "its header": flip_at(17),
    "its first page": flip_at(600),
    "its last page": flip_at(-9),
    "cut in half": cut_in_half,
    "cut to nothing": cut_to_nothing,
    "removed": Path.unlink,
}
ROWS: list[Row] = [query(f"q{n:02}", n) for n in range(30)]


@pytest.mark.parametrize("how", DAMAGE)
def test_a_wal_that_is_damaged_while_the_catalog_is_open_is_made_again_from_the_journal(
    tmp_path: Path, how: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "app" / "catalog.sqlite3"
    killed = open_store(tmp_path / "killed" / path.name)
    for row in ROWS[:10]:
        killed.commit([Put(row)])
    killed.tidy()
    for row in ROWS[10:15]:
        killed.commit([Put(row)])
        killed.upkeep()
    shutil.copytree(tmp_path / "killed", path.parent)
    killed.close()
    store = open_store(path)
    for row in ROWS[15:20]:
        store.commit([Put(row)])
        store.upkeep()
    DAMAGE[how](wal_of(path))
    store.commit([Put(ROWS[20])])
    store.tidy()
    assert "catalog.sqlite3-wal" in caplog.text
    assert "made again from the journal" in caplog.text
    caplog.clear()
    for row in ROWS[21:]:
        store.commit([Put(row)])
        store.upkeep()
    assert in_order(rows_of(store.load())) == ROWS
    store.close()
    assert caplog.text == ""
    assert in_order(read_rows(path)) == ROWS
    assert sorted(file.name for file in path.parent.iterdir()) == ["catalog.lock", "catalog.sqlite3"]


def full(*_: object) -> None:
    raise CatalogError("full", path="")


def test_commits_go_on_while_a_full_disk_takes_no_new_wal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file then has less than what was folded: the next segment must not be taken for all of it."""
    path = tmp_path / "app" / "catalog.sqlite3"
    store = open_store(path)
    store.commit([Put(ROWS[0])])
    store.tidy()
    for row in ROWS[1:20]:
        store.commit([Put(row), Put(part(f"p{row.id}", os.urandom(3000)))])
        store.upkeep()
    before = {row.id for row in rows_of(store.load())}
    flip_at(600)(wal_of(path))
    monkeypatch.setattr(SqliteTables, "fold", full)
    for row in ROWS[20:]:
        store.commit([Put(row)])
        kept = segments_of(path)
        for attempt in (store.tidy, store.upkeep):
            with pytest.raises(CatalogError, match="full"):
                attempt()
        assert set(kept) <= set(segments_of(path))
    monkeypatch.undo()
    left = tmp_path / "left"
    shutil.copytree(path.parent, left)
    store.tidy()
    expected = before | {row.id for row in ROWS[20:]}
    assert {row.id for row in rows_of(store.load())} == expected
    store.close()
    for place in (path.parent, left):
        again = open_store(place / path.name)
        assert {row.id for row in rows_of(again.load())} == expected
        again.close()


def test_a_tool_that_holds_up_the_copying_and_a_damaged_wal_after_it_lose_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """SQLite has copied some of the pages: without the -wal the file is neither old nor new."""
    path = tmp_path / "app" / "catalog.sqlite3"
    store = open_store(path)
    store.commit([Put(ROWS[0])])
    store.tidy()
    store.commit([Put(row) for row in ROWS[1:10]])
    store.upkeep()
    with closing(sqlite3.connect(path, isolation_level=None)) as tool:
        tool.execute("BEGIN")
        assert len(tool.execute("SELECT * FROM queries").fetchall()) == 10
        for row in ROWS[10:20]:
            store.commit([Put(row)])
            store.upkeep()
        store.tidy()  # copies what the tool does not hold up
        assert segments_of(path), "the file has not taken all of the -wal"
        for damage in (flip_at(17), flip_at(600), flip_at(-9)):
            copy = tmp_path / "copy"
            shutil.copytree(path.parent, copy)
            damage(copy / "catalog.sqlite3-wal")
            again = open_store(copy / path.name)
            assert in_order(rows_of(again.load())) == ROWS[:20]
            again.close()
            shutil.rmtree(copy)
    assert "catalog.sqlite3-wal" in caplog.text
    flip_at(600)(wal_of(path))
    for row in ROWS[20:]:
        store.commit([Put(row)])
    store.tidy()
    assert in_order(rows_of(store.load())) == ROWS
    store.close()
    assert in_order(read_rows(path)) == ROWS


def test_a_wal_that_is_damaged_while_a_catalog_for_power_is_open_is_not_copied_into_the_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "app" / "catalog.sqlite3"
    store = open_store(path, durability="power")
    store.commit([Put(ROWS[0])])
    store.tidy()
    for row in ROWS[1:]:
        store.commit([Put(row)])
        store.upkeep()
    flip_at(-9)(wal_of(path))
    store.tidy()
    store.close()
    again = open_store(path, durability="power")
    found = in_order(rows_of(again.load()))
    again.close()
    assert found == ROWS
    (warning,) = [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]
    assert "expected catalog.sqlite3-wal as it was written, got" in warning
    assert "made again from the journal" in warning
