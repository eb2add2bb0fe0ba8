"""A store with a journal: what is on disk when, full disks, other users, values of every size, several threads."""

from __future__ import annotations

import contextlib
import functools
import gc
import json
import os
import resource
import shutil
import signal
import sqlite3
import stat
import subprocess
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from random import Random
from typing import Any

import pytest

from rr_actors.base.config import RegistrarConfig
from rr_actors.base.errors import CatalogDamaged, CatalogError, CatalogLocked
from rr_actors.base.folder import Folder
from rr_actors.registrar.engine.commit_log import CommitLog
from rr_actors.registrar.model.catalog import Catalog, Decision
from rr_actors.registrar.model.rows import Change, Drop, Peer, Put, Row, ServedQuery, rows_of
from rr_actors.registrar.model.store import Store
from rr_actors.storage import journaled_store, opening
from rr_actors.storage import journaled_store as journaled_module
from rr_actors.storage.catalog_lock import CatalogLock
from rr_actors.storage.journaled_store import JournaledStore, Segment
from rr_actors.storage.opening import open_store, read_rows
from rr_actors.storage.sqlite_store import SqliteTables
from rr_actors.storage.witness import Witness
from rr_actors.supervision.given_up import forget
from support import REPOSITORY
from support_interrupts import interrupted
from support_stores import belonging_to_another, in_order, part, query, segments_of


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "reg" / "catalog.sqlite3"


def journaled(path: Path) -> JournaledStore:
    store = open_store(path)
    assert isinstance(store, JournaledStore)
    return store


def made(path: Path) -> JournaledStore:
    """A store of an empty catalog whose SQLite file is made."""
    store = journaled(path)
    open_tables(store)
    return store


def content(store: Store) -> list[Row]:
    return in_order(rows_of(store.load()))


def names(path: Path) -> list[str]:
    return sorted(file.name for file in path.parent.iterdir())


def segments(path: Path) -> list[str]:
    return [segment.name for segment in segments_of(path)]


def folded(path: Path) -> list[str]:
    """The ids of the queries that other tools see."""
    with contextlib.closing(sqlite3.connect(path)) as connection:
        return [id_ for (id_,) in connection.execute("SELECT id FROM queries ORDER BY id")]


def left_by(path: Path, name: str = "copy") -> Path:
    """A copy as a crash would leave it."""
    copy = path.parent.with_name(name)
    shutil.rmtree(copy, ignore_errors=True)
    shutil.copytree(path.parent, copy)
    return copy / path.name


@contextlib.contextmanager
def no_folding() -> Iterator[None]:
    """Another tool writes to the SQLite file, and takes long; or there is no room for it."""
    fold = SqliteTables.fold

    def full(store: SqliteTables, _changes: Any, _segment: int) -> None:
        raise CatalogError(f"{store.path}: full", path=str(store.path))

    SqliteTables.fold = full  # type: ignore[method-assign]
    try:
        yield
    finally:
        SqliteTables.fold = fold  # type: ignore[method-assign]


@contextlib.contextmanager
def full_disk(size: int) -> Iterator[None]:
    """No file may have more bytes than that."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def in_parts(store: JournaledStore, *commits: Sequence[Change]) -> None:
    """Commit, each to a segment of its own."""
    for changes in commits:
        store.commit(changes)
        with no_folding(), pytest.raises(CatalogError):
            store.tidy()


# -- what is on disk when ------------------------------------------------------------------------------------------


def test_a_commit_is_in_the_journal_at_once_and_in_the_sqlite_file_when_it_is_tidied(path: Path) -> None:
    store = journaled(path)
    assert (names(path), store.wants_tidying()) == (["catalog.lock"], False)
    store.commit([Put(query("a"))])
    assert (names(path), store.wants_tidying()) == (["catalog.journal.1", "catalog.lock"], True)
    assert read_rows(path) == content(store) == [query("a")]
    store.tidy()
    assert (segments(path), store.wants_tidying(), folded(path)) == ([], False, ["a"])
    store.commit([Put(query("b"))])
    assert segments(path) == ["catalog.journal.2"]
    assert content(store) == [query("a"), query("b")]
    store.close()
    assert names(path) == ["catalog.lock", "catalog.sqlite3"]
    store = journaled(path)
    store.commit([Put(query("c"))])
    assert segments(path) == ["catalog.journal.3"]
    store.close(erase=True)
    assert not path.parent.exists()


def test_what_comes_and_goes_before_it_is_folded_is_in_no_table(path: Path) -> None:
    store = journaled(path)
    open_tables(store)
    for n in range(50):
        store.commit([Put(query(f"{n}"))])
        store.commit([Drop("queries", f"{n}")])
    store.tidy()
    assert (folded(path), content(store), segments(path)) == ([], [], [])
    store.close()


def test_segments_of_a_crash_are_folded_and_removed_at_the_next_opening(path: Path) -> None:
    store = journaled(path)
    in_parts(store, [Put(query("a"))], [Put(query("b"))], [Drop("queries", "a")])
    copy = left_by(path)
    store.close()
    assert segments(copy) == [f"catalog.journal.{n}" for n in (1, 2, 3)]
    assert in_order(read_rows(copy)) == [query("b")]
    assert segments(copy) == [f"catalog.journal.{n}" for n in (1, 2, 3)]
    for durability in ("process", "power"):
        again = left_by(copy, f"again-{durability}")
        store = open_store(again, durability=durability)
        assert (folded(again), content(store)) == (["b"], [query("b")])
        assert segments(again) == ([] if durability == "power" else segments(copy)), "the -wal alone is no second copy"
        store.tidy()
        store.commit([Put(query("c"))])
        assert segments(again) == ["catalog.journal.4"]
        store.close()


def test_a_segment_that_could_not_be_removed_is_not_read_again(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store, unlink = journaled(path), os.unlink

    def broken(name: str, **options: Any) -> None:
        if "journal" in name:
            raise OSError(5, "broken")
        unlink(name, **options)

    store.commit([Put(query("a"))])
    with monkeypatch.context() as patch:
        patch.setattr(os, "unlink", broken)
        store.tidy()
    assert segments(path) == ["catalog.journal.1"]
    store.commit([Drop("queries", "a")])
    store.tidy()
    assert read_rows(path) == []
    store.close()
    assert segments(path) == ["catalog.journal.1"]
    store = journaled(path)
    assert (content(store), segments(path)) == ([], [])
    shutil.copy(path, path.with_name("catalog.journal.1.old"))
    store.close()


def test_erasing_removes_segments_that_could_not_be_removed_before(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = journaled(path)
    store.commit([Put(query("a"))])
    with monkeypatch.context() as patch:
        patch.setattr(os, "unlink", lambda *_, **__: (_ for _ in ()).throw(OSError(5, "broken")))
        store.tidy()
    store.close(erase=True)
    assert not path.parent.exists()


def test_a_store_that_is_closed_takes_nothing_and_tidies_nothing(path: Path) -> None:
    """A worker may be late."""
    for durability in ("process", "power"):
        store = open_store(path, durability=durability)
        store.commit([Put(ServedQuery(f"{n}", "r" * 4000, "app", "", 1, n)) for n in range(1000)])
        store.close(erase=True)
        store.tidy()
        with pytest.raises(CatalogError, match="closed"):
            store.commit([Put(query("b"))])
        assert not path.parent.exists()


def test_numbers_go_on_after_a_gap(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store = journaled(path)
    in_parts(store, [Put(query("a"))], [Put(query("b"))], [Put(query("c"))])
    copy = left_by(path)
    store.close()
    copy.with_name("catalog.journal.2").unlink()
    store = journaled(copy)
    assert content(store) == [query("a")]
    assert f"{copy}: catalog.journal.2: missing" in caplog.text
    assert segments(copy) == []
    store.commit([Put(query("d"))])
    assert segments(copy) == ["catalog.journal.4"]
    again = left_by(copy, "again")
    store.close()
    assert in_order(read_rows(again)) == [query("a"), query("d")]


def descriptors(path: Path) -> int:
    """How many this process has open in the catalog's directory."""
    found = 0
    for file in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # that of this listing
            found += str(file.readlink()).startswith(str(path.parent))
    return found


def test_descriptors_are_not_used_up_by_what_waits_to_be_folded(path: Path) -> None:
    store = journaled(path)
    opened = descriptors(path)
    in_parts(store, *[[Put(query(f"{n}"))] for n in range(50)])
    assert len(segments(path)) == 50
    assert descriptors(path) <= opened + 1
    store.close()
    assert names(path) == ["catalog.lock", "catalog.sqlite3"]
    assert len(read_rows(path)) == 50
    assert (opened > 0, descriptors(path)) == (True, 0)


def test_another_tool_that_holds_the_sqlite_file_holds_up_no_commit(path: Path) -> None:
    store = journaled(path)
    open_tables(store)
    store.commit([Put(query("a"))])
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as tool:
        tool.execute("BEGIN IMMEDIATE")
        with pytest.raises(CatalogError, match=rf"{path}: expected to take 1 change.*locked.*they stay in the journal"):
            store.tidy()
        store.commit([Put(query("b"))])
        assert in_order(read_rows(path)) == content(store) == [query("a"), query("b")]
    store.tidy()
    assert (folded(path), segments(path)) == (["a", "b"], [])
    store.close()


# -- before the SQLite file is made ---------------------------------------------------------------------------------


def test_openings_that_write_nothing_are_counted_and_leave_their_lock(path: Path) -> None:
    for epoch in range(1, 4):
        store = journaled(path)
        assert (store.epoch, content(store), names(path)) == (epoch, [], ["catalog.lock"])
        if epoch == 2:
            path = left_by(path)  # killed
        store.close()
    store = journaled(path)
    store.commit([Put(query("a"))])
    store.close()
    assert names(path) == ["catalog.lock", "catalog.sqlite3"]
    store = journaled(path)
    assert (store.epoch, content(store)) == (5, [query("a")])
    store.close()


@pytest.mark.parametrize("size", [56, 80])
def test_a_full_disk_makes_no_opening_forgotten(path: Path, size: int) -> None:
    """The lock's file alone counts them, and takes a part of a longer text."""
    with full_disk(0), pytest.raises(CatalogError, match=f"{path}: .*File too large"):
        journaled(path)
    store = journaled(path)
    with full_disk(size), pytest.raises(CatalogError):
        store.commit([Put(part("r", b"x" * 100))])
    copy = left_by(path)
    store.close()
    store = journaled(copy)
    assert (store.epoch, content(store)) == (2, [])
    store.close()


def test_a_catalog_that_is_all_in_its_journal_is_read_locked_and_opened_by_the_next(path: Path) -> None:
    store = journaled(path)
    in_parts(store, [Put(query("a"))], [Put(query("b"))], [Drop("queries", "a")])
    assert names(path) == [*(f"catalog.journal.{n}" for n in (1, 2, 3)), "catalog.lock"]
    assert in_order(read_rows(path)) == content(store) == [query("b")]
    with pytest.raises(CatalogLocked, match="this process"):
        open_store(path)
    for durability in ("process", "power"):
        copy = left_by(path, f"copy-{durability}")
        again = open_store(copy, durability=durability)
        assert (content(again), again.epoch, path.name in names(copy)) == ([query("b")], 2, True)
        again.close()
    store.close()
    assert (names(path), read_rows(path)) == (["catalog.lock", "catalog.sqlite3"], [query("b")])


def test_a_tool_that_looks_before_there_is_a_file_does_no_harm(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for changes in ([], [Put(query("a"))]):
        store = journaled(path)
        store.commit(changes)
        with contextlib.closing(sqlite3.connect(path)) as tool:
            assert tool.execute("SELECT name FROM sqlite_schema").fetchall() == []
        assert path.stat().st_size == 0
        copy = left_by(path)
        store.close()
        again = journaled(copy)
        assert (content(again), again.epoch) == (
            [change.row for change in changes if type(change) is Put],
            store.epoch + 1,
        )
        again.close()
    assert read_rows(path) == [query("a")]
    assert caplog.messages == []


def test_a_copy_that_is_put_in_the_place_of_a_catalog_that_held_nothing_is_opened_without_a_word(
    path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    made(path).close()
    other = path.parent.with_name("other") / path.name
    journaled(other).close()
    shutil.copy(path, other)
    store = journaled(other)
    assert store.epoch == 2
    store.close()
    assert caplog.messages == []


def test_a_commit_that_vanishes_before_there_is_a_file_is_told_of(path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store = journaled(path)
    store.commit([Put(query("a"))])
    copy = left_by(path)
    store.close()
    copy.with_name("catalog.journal.1").unlink()
    store = journaled(copy)
    assert (content(store), store.epoch) == ([], 2)
    store.close()
    assert f"{copy}: catalog.journal.1: missing" in caplog.text


def test_a_journal_alone_that_another_registrar_has_begun_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "one" / "catalog.sqlite3"
    store = open_store(path, witness=Witness(tmp_path, "one"))
    store.commit([Put(query("a"))])
    copy = left_by(path, "two")
    store.close()
    with pytest.raises(CatalogDamaged, match=f"{copy}: .*a journal that another registrar has begun"):
        open_store(copy, witness=Witness(tmp_path, "two"))
    assert read_rows(copy) == [query("a")]


def test_a_catalog_whose_file_was_made_is_damaged_without_it_also_after_a_crash(path: Path) -> None:
    store = journaled(path)
    store.commit([Put(query("a"))])
    store.tidy()
    copy = left_by(path)
    store.close()
    for file in copy.parent.glob("catalog.sqlite3*"):
        file.unlink()
    with pytest.raises(CatalogDamaged, match="no such file, though it was opened 1 times and is not closed"):
        journaled(copy)


# -- full disks ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [0, 30, 56, 60, 100])
def test_a_commit_on_a_full_disk_is_refused_by_name_and_the_next_one_with_room_works(path: Path, size: int) -> None:
    store = journaled(path)
    for begun in (False, True):
        before = content(store)
        with full_disk(size), pytest.raises(CatalogError, match=f"{path}: expected to write 2 .*journal.*Make room"):
            store.commit([Put(part("r", b"x" * 100)), Put(query("never"))])
        assert in_order(read_rows(path)) == content(store) == before
        store.commit([Put(query(f"{begun}"))])
        assert in_order(read_rows(left_by(path))) == content(store) == in_order([*before, query(f"{begun}")])
    store.close()
    assert names(path) == ["catalog.lock", "catalog.sqlite3"]
    assert in_order(read_rows(path)) == [query("False"), query("True")]


def test_a_commit_that_failed_first_of_all_leaves_nothing_behind(path: Path) -> None:
    store = journaled(path)
    with full_disk(60), pytest.raises(CatalogError):
        store.commit([Put(query("a"))])
    with pytest.raises(OverflowError):
        store.commit([Put(query("a", 2**63))])
    store.close()
    assert names(path) == ["catalog.lock"]


def open_tables(store: JournaledStore) -> None:
    """Have the SQLite file made and opened, which the first folding does. Two segments are folded then."""
    for change in (Put(query("first")), Drop("queries", "first")):
        store.commit([change])
        store.tidy()


def test_what_cannot_be_folded_on_a_full_disk_stays_in_the_journal_until_there_is_room(path: Path) -> None:
    store = journaled(path)
    open_tables(store)
    wal = path.with_name(path.name + "-wal")
    rows: list[Row] = []
    for n in range(3):
        rows.append(part(f"{n}", os.urandom(20_000)))
        store.commit([Put(rows[-1])])
        with full_disk(wal.stat().st_size + 4096), pytest.raises(CatalogError, match=f"{path}: .*stay in the journal"):
            store.tidy()
        assert content(store) == in_order(read_rows(path)) == rows
    assert segments(path) == [f"catalog.journal.{n}" for n in (3, 4, 5)]
    copy = left_by(path)
    with full_disk(wal.stat().st_size + 4096):
        store.close()
    assert segments(path) == [f"catalog.journal.{n}" for n in (3, 4, 5)]
    for catalog in (path, copy):
        assert in_order(read_rows(catalog)) == rows
        store = journaled(catalog)
        assert content(store) == rows
        store.tidy()
        assert segments(catalog) == []
        store.close()


def test_the_first_changes_stay_in_the_journal_if_the_disk_has_no_room_for_the_files_of_sqlite(path: Path) -> None:
    store = journaled(path)
    store.commit([Put(query("a"))])
    for _ in range(2):
        with full_disk(4096), pytest.raises(CatalogError, match=f"{path}: .*stay in the journal"):
            store.tidy()
        assert content(store) == in_order(read_rows(left_by(path))) == [query("a")]
    store.tidy()
    assert segments(path) == []
    store.close()
    assert read_rows(path) == [query("a")]


def test_what_is_put_in_the_place_of_a_file_that_is_not_made_yet_is_not_written_over(path: Path) -> None:
    store = journaled(path)
    store.commit([Put(query("a"))])
    path.write_text("a copy of last week")
    with pytest.raises(CatalogError, match=f"{path}: .*File exists.*stay in the journal"):
        store.tidy()
    assert path.read_text() == "a copy of last week"
    path.unlink()
    store.tidy()
    store.close()
    assert read_rows(path) == [query("a")]


def test_no_commit_folds_or_waits_for_the_folding_however_many_changes_wait(path: Path) -> None:
    """A tool keeps the SQLite file locked: a thread that folds waits for a second, and fails."""
    store = made(path)
    with contextlib.closing(sqlite3.connect(path, isolation_level=None)) as tool:
        tool.execute("BEGIN IMMEDIATE")
        store.commit([Put(query("a", n)) for n in range(100_001)])
        store.commit([Put(query("b"))])
        with pytest.raises(CatalogError, match="stay in the journal"):
            store.tidy()
        store.commit([Put(query("c"))])
        tool.execute("ROLLBACK")
    assert in_order(read_rows(left_by(path))) == [query("a", 100_000), query("b"), query("c")]
    store.tidy()
    assert segments(path) == []
    store.close()
    assert in_order(read_rows(path)) == [query("a", 100_000), query("b"), query("c")]


def test_a_commit_that_finds_the_journal_full_is_refused_until_the_sqlite_file_takes_the_changes(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(journaled_module, "_AT_MOST", 2)
    store = journaled(path)
    store.commit([Put(query("a")), Put(query("b"))])
    for _ in range(2):
        with pytest.raises(CatalogError, match=f"{path}: expected fewer than 2 changes in its journal, got 2"):
            store.commit([Put(query("c"))])
    assert content(store) == in_order(read_rows(left_by(path))) == [query("a"), query("b")]
    store.tidy()
    store.commit([Put(query("c"))])
    store.close()
    assert in_order(read_rows(path)) == [query("a"), query("b"), query("c")]


def test_who_is_interrupted_while_he_folds_loses_nothing_that_was_committed(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = journaled(path)
    store.commit([Put(query("a"))])
    with monkeypatch.context() as patch:
        patch.setattr(Segment, "close", interrupt)
        with pytest.raises(KeyboardInterrupt):
            store.tidy()
    assert content(store) == [query("a")]
    store.commit([Put(query("c"))])
    assert in_order(read_rows(left_by(path))) == [query("a"), query("c")]
    store.close()
    assert in_order(read_rows(path)) == [query("a"), query("c")]


@pytest.mark.parametrize("interrupted", [True, False])
def test_what_is_committed_and_not_folded_while_a_store_closes_is_there_at_the_next_opening(
    path: Path, monkeypatch: pytest.MonkeyPatch, interrupted: bool
) -> None:
    """Ctrl-C ends the folding at its beginning; or another thread commits just behind the folding."""
    store = journaled(path)
    store.commit([Put(query("a"))])
    fold = SqliteTables.fold

    def disturbed(tables: SqliteTables, *folded: Any) -> None:
        fold(tables, *folded)
        store.commit([Put(query("b"))])

    if interrupted:
        monkeypatch.setattr(journaled_store, "net_of", interrupt)
    else:
        monkeypatch.setattr(SqliteTables, "fold", disturbed)
    with pytest.raises(KeyboardInterrupt) if interrupted else contextlib.nullcontext():
        store.close()
    with contextlib.closing(open_store(path)) as again:
        assert content(again) == [query(id_) for id_ in ("a" if interrupted else "ab")]


def test_an_interrupt_after_a_segment_is_begun_loses_nothing_that_is_committed_later(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = journaled(path)
    with monkeypatch.context() as patch:
        patch.setattr(SqliteTables, "note", interrupt)
        with pytest.raises(KeyboardInterrupt):
            store.commit([Put(query("a"))])
    store.commit([Put(query("b"))])
    assert in_order(read_rows(left_by(path))) == [query("b")]
    store.close()
    assert in_order(read_rows(path)) == [query("b")]


def test_an_interrupt_of_a_commit_leaves_no_descriptor(path: Path) -> None:
    """Where Python delivers a signal, and so between the opening of a journal's file and the next instruction, too."""
    point, where = 0, "not yet"
    while where:
        point += 1
        store = journaled(path)
        where = interrupted(functools.partial(store.commit, [Put(query("a"))]), point).where
        store.commit([Put(query("b"))])
        assert query("b") in content(store), where
        store.close()
        gc.collect()  # an error holds what its traceback leads to
        assert descriptors(path) == 0, where
    assert point > 20


@pytest.mark.slow
def test_an_interrupt_while_the_file_is_made_leaves_it_to_the_next_folding(path: Path) -> None:
    point, where = 0, "not yet"
    while where:
        point += 1
        store = journaled(path)
        store.commit([Put(query("a"))])
        where = interrupted(store.tidy, point).where
        store.commit([Put(query("b"))])
        store.tidy()
        assert folded(path) == ["a", "b"], where
        store.close(erase=True)
        assert not path.parent.exists(), where
    assert point > 100


def test_an_interrupt_while_a_catalog_is_locked_leaves_it_free(path: Path) -> None:
    path.parent.mkdir()
    with Folder.at(path.parent) as folder:
        point, where = 0, "not yet"
        while where:
            point += 1
            where = interrupted(lambda: CatalogLock(folder, path).release(), point).where
            gc.collect()
            assert descriptors(path) == 1, where  # the directory's
            CatalogLock(folder, path).release()
    assert point > 20


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt


class Timer:
    def __init__(self, at: float, call: Callable[[], None]) -> None:
        self.at = at
        self.call = call
        self.cancelled = False

    def cancel(self) -> None:
        self.cancelled = True


class Loop:
    """Time and timers that a test moves on."""

    def __init__(self) -> None:
        self.now = 0.0
        self.timers: list[Timer] = []

    def time(self) -> float:
        return self.now

    def call_later(self, delay_s: float, call: Callable[..., None], *args: Any) -> Timer:
        self.timers.append(Timer(self.now + delay_s, lambda: call(*args)))
        return self.timers[-1]

    def call_soon_threadsafe(self, fn: Callable[..., object], *args: Any) -> None:
        fn(*args)

    def advance(self, seconds: float) -> None:
        until = self.now + seconds
        while due := [timer for timer in self.timers if timer.at <= until]:
            timer = min(due, key=lambda timer: timer.at)
            self.timers.remove(timer)
            self.now = timer.at
            if not timer.cancelled:
                timer.call()
        self.now = until


class Worker:
    """Does at once what it is given."""

    def submit(self, fn: Callable[[], None], *, done: Callable[..., None], patient: bool) -> None:
        assert patient
        try:
            fn()
        except CatalogError as error:
            done(None, error)
        else:
            done(None, None)


@pytest.fixture
def ledger(path: Path) -> tuple[CommitLog, Loop, JournaledStore]:
    loop, worker, store = Loop(), Worker(), journaled(path)
    lock = threading.RLock()
    lock.acquire()  # as a registrar does before it commits: the test's own thread is the only one here
    return CommitLog("app", RegistrarConfig("app"), store, loop, worker, lock), loop, store  # type: ignore[arg-type]


def commit(ledger: CommitLog, *rows: Row) -> None:
    batch = Decision(Catalog("app"))
    for row in rows:
        batch.put(row)
    ledger.commit(batch)


def test_a_ledger_folds_when_nothing_is_committed_any_more_or_at_last_anyway(
    path: Path, ledger: tuple[CommitLog, Loop, JournaledStore]
) -> None:
    noted, loop, _ = ledger
    commit(noted, query("a"))
    loop.advance(0.25)
    assert (folded(path), segments(path), loop.timers) == (["a"], ["catalog.journal.1"], [])
    for n in range(30):
        commit(noted, query(f"b{n:02}"))
        loop.advance(0.09)
    assert 15 < len(folded(path)) < 30
    loop.advance(0.25)
    assert len(folded(path)) == 31
    noted.close(erase=False)
    assert loop.timers == []


def test_a_ledger_does_not_fold_while_another_registrar_of_the_process_commits(
    path: Path, ledger: tuple[CommitLog, Loop, JournaledStore]
) -> None:
    noted, loop, _ = ledger
    lock = threading.RLock()
    lock.acquire()
    store = journaled(path.parent.with_name("another") / path.name)
    other = CommitLog("other", RegistrarConfig("other"), store, loop, Worker(), lock)  # type: ignore[arg-type]
    commit(noted, query("a"))
    for n in range(20):
        commit(other, query(f"b{n:02}"))
        loop.advance(0.09)
    assert segments(path) == ["catalog.journal.1"]
    loop.advance(0.25)
    assert (folded(path), len(folded(store.path))) == (["a"], 20)
    commit(noted, query("c"))
    for n in range(30):
        commit(other, query(f"d{n:02}"))
        loop.advance(0.09)
    assert folded(path) == ["a", "c"], "2 s are the most"
    other.close(erase=False)
    noted.close(erase=False)


def test_a_ledger_whose_disk_is_full_says_so_and_folds_again_until_there_is_room(
    path: Path, ledger: tuple[CommitLog, Loop, JournaledStore], caplog: pytest.LogCaptureFixture
) -> None:
    noted, loop, store = ledger
    open_tables(store)
    wal = path.with_name(path.name + "-wal")
    row = part("large", os.urandom(20_000))
    commit(noted, row)
    with full_disk(wal.stat().st_size + 4096):
        loop.advance(5.0)
        with pytest.raises(CatalogError, match="stay in the journal"):
            noted.save()
    assert 3 <= caplog.text.count("app: ") <= 6
    assert f"{path}: expected to take 1 change(s) from its journal" in caplog.text
    assert (content(store), segments(path)) == ([row], ["catalog.journal.3"])
    assert read_rows(left_by(path)) == [row]
    loop.advance(1.0)
    assert loop.timers == []
    with contextlib.closing(sqlite3.connect(path)) as connection:
        assert connection.execute("SELECT id FROM resources").fetchall() == [("large",)]
    noted.close(erase=False)


def test_a_full_disk_is_said_more_and_more_rarely_and_its_end_once(
    path: Path, ledger: tuple[CommitLog, Loop, JournaledStore], caplog: pytest.LogCaptureFixture
) -> None:
    noted, loop, store = ledger
    caplog.set_level("INFO")
    open_tables(store)
    commit(noted, part("large", os.urandom(20_000)))
    with full_disk(path.with_name(path.name + "-wal").stat().st_size + 4096):
        loop.advance(300.0)
    assert 6 <= caplog.text.count("stay in the journal") <= 12
    loop.advance(2.0)
    assert caplog.text.count("app: its SQLite file takes changes again") == 1
    caplog.clear()
    commit(noted, part("large", os.urandom(30_000)))
    with full_disk(4096):
        loop.advance(3.0)
    assert "stay in the journal" in caplog.text, "another failure is said at once"
    noted.close(erase=False)


def test_changes_that_a_full_disk_does_not_take_are_said_more_and_more_rarely(
    path: Path, ledger: tuple[CommitLog, Loop, JournaledStore], caplog: pytest.LogCaptureFixture
) -> None:
    noted, loop, _ = ledger
    batch = Decision(Catalog("app"))
    batch.put_later(part("large", os.urandom(20_000)))
    noted.commit(batch)
    with full_disk(100):
        loop.advance(300.0)
    assert 6 <= caplog.text.count("tried again several times a second") <= 12
    loop.advance(1.0)
    assert [row.id for row in read_rows(path)] == ["large"]
    noted.close(erase=False)


# -- damage, and other users ---------------------------------------------------------------------------------------


def test_a_journal_without_its_sqlite_file_is_refused_by_name_and_left_as_it_is(path: Path) -> None:
    store = made(path)
    store.commit([Put(query("a"))])
    copy = left_by(path)
    store.close()
    for file in copy.parent.glob("catalog.sqlite3*"):
        file.unlink()
    before = copy.with_name("catalog.journal.3").read_bytes()
    for attempt in (journaled, read_rows):
        with pytest.raises(CatalogDamaged, match=f"{copy}: .*no such file, but catalog.journal.3, which belongs to it"):
            attempt(copy)
    assert names(copy) == ["catalog.journal.3", "catalog.lock"]
    assert copy.with_name("catalog.journal.3").read_bytes() == before


def spoil_its_file(path: Path) -> None:
    path.write_bytes(b"text")


def spoil_a_segment(path: Path) -> None:
    path.with_name("catalog.journal.3").write_bytes(b"text")


def another_catalogs(path: Path) -> None:
    store = journaled(path.parent.with_name("another") / path.name)
    in_parts(store, [Put(query("x"))], [Put(query("y"))], [Put(query("z"))])
    shutil.copy(store.path.with_name("catalog.journal.3"), path.parent)
    store.close(erase=True)


def kept(path: Path) -> dict[str, bytes]:
    """All but what SQLite notes of its readers."""
    return {file.name: file.read_bytes() for file in path.parent.iterdir() if not file.name.endswith("-shm")}


SPOILING = [spoil_its_file, spoil_a_segment, another_catalogs, Path.unlink]


@pytest.mark.parametrize("spoil", SPOILING)
def test_damage_is_refused_by_name_with_its_journal_as_it_is_or_set_aside_with_it(
    path: Path, spoil: Callable[[Path], None], caplog: pytest.LogCaptureFixture
) -> None:
    for n in (1, 2):
        store = made(path)
        in_parts(store, [Put(query("a"))], [Put(query("b"))])
        copy = left_by(path)
        store.close(erase=True)
        for file in copy.parent.iterdir():
            path.parent.mkdir(exist_ok=True)
            file.rename(path.parent / file.name)
        if spoil is Path.unlink:
            path.with_name("catalog.sqlite3-wal").unlink(missing_ok=True)
        spoil(path)
        lock = path.with_name("catalog.lock")
        lock.unlink()
        before = kept(path)
        with pytest.raises(CatalogDamaged, match=f'{path}: expected a catalog, got .*on_damage = "aside"'):
            open_store(path)
        lock.unlink()
        assert kept(path) == before
        store = open_store(path, on_damage="aside")
        assert (content(store), store.epoch, segments(path)) == ([], 1, [])
        for name, data in before.items():
            if name.startswith("catalog.journal."):
                name = f"catalog.sqlite3.damaged-{n}-{name}"
            elif "damaged" not in name:
                name = name.replace("catalog.sqlite3", f"catalog.sqlite3.damaged-{n}")
            assert path.with_name(name).read_bytes() == data
        assert f"renamed to catalog.sqlite3.damaged-{n}" in caplog.text
        store.commit([Put(query("c"))])
        store.close(erase=True)


def test_a_journal_left_beside_another_copy_of_its_catalog_is_not_mixed_with_it(
    path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As someone does who puts a good copy in a damaged catalog's place."""
    store = journaled(path)
    store.commit([Put(query("a"))])
    store.close()
    good = path.read_bytes()
    store = journaled(path)
    store.commit([Drop("queries", "a"), Put(query("b"))])
    store.tidy()
    store.commit([Put(query("c"))])
    copy = left_by(path)
    store.close()
    for file in copy.parent.glob("catalog.sqlite3-*"):
        file.unlink()
    copy.write_bytes(good)
    store = journaled(copy)
    assert content(store) == [query("a")]
    assert f"{copy}: catalog.sqlite3 was removed, cut off, damaged, or put back from an older copy" in caplog.text
    store.close()


def test_segments_are_the_users_alone_and_those_of_another_are_refused(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = os.umask(0)
    try:
        store = journaled(path)
        store.commit([Put(query("a"))])
    finally:
        os.umask(before)
    segment = path.with_name("catalog.journal.1")
    assert stat.S_IMODE(segment.stat().st_mode) == 0o600
    copy = left_by(path)
    store.close()
    segment = copy.with_name("catalog.journal.1")
    segment.chmod(0o666)
    with belonging_to_another(segment), pytest.raises(CatalogError, match=rf"{segment}: expected to belong to user"):
        open_store(copy)
    assert stat.S_IMODE(segment.stat().st_mode) == 0o666
    with monkeypatch.context() as patch:
        patch.setattr(os, "unlink", lambda *_, **__: (_ for _ in ()).throw(OSError(5, "broken")))
        store = journaled(copy)
    assert stat.S_IMODE(segment.stat().st_mode) == 0o600
    assert content(store) == [query("a")]
    store.close()


def test_a_catalog_that_is_opened_changed_and_closed_while_it_is_read_is_read_again(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = journaled(path)
    store.commit([Put(query("a"))])
    store.close()
    read, readings = opening.sqlite_store.read_catalog, 0

    def read_slowly(folder: Folder, path: Path) -> Any:
        nonlocal readings
        readings += 1
        found = read(folder, path)
        if readings == 1:
            monkeypatch.setattr(opening.sqlite_store, "read_catalog", read)
            store = journaled(path)
            store.commit([Drop("queries", "a"), Put(query("b"))])
            store.close()
            monkeypatch.setattr(opening.sqlite_store, "read_catalog", read_slowly)
        return found

    monkeypatch.setattr(opening.sqlite_store, "read_catalog", read_slowly)
    assert read_rows(path) == [query("b")]
    assert readings == 2


def test_what_a_dormant_registrar_holds_is_found_in_its_journal_and_forgotten_with_it(path: Path) -> None:
    store = journaled(path)
    in_parts(store, [Put(Peer("hub")), Put(query("a"))], [Put(Peer("maker")), Put(query("b"))], [Drop("queries", "a")])
    copy = left_by(path, "app")
    store.close()
    forget(RegistrarConfig("app"), copy.parent.parent)
    assert read_rows(copy) == [query("b")]
    assert names(copy) == ["catalog.lock", "catalog.sqlite3"]


# -- values of every size ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("durability", ["process", "power"])
@pytest.mark.parametrize(
    ("bad", "error"),
    [
        (query("b", 2**63), OverflowError),
        (query("b", 2**64 - 1), OverflowError),
        (query("b", 2**64), OverflowError),
        (query("b", -(2**63) - 1), OverflowError),
        (query("b\udc80"), UnicodeEncodeError),
    ],
)
def test_a_value_that_no_catalog_holds_takes_its_whole_commit_back(
    path: Path, durability: str, bad: Row, error: type[Exception]
) -> None:
    store = open_store(path, durability=durability)  # type: ignore[arg-type]
    store.commit([Put(query("a"))])
    for changes in ([Put(bad)], [Put(query("c")), Put(bad), Drop("queries", "a")]):
        with pytest.raises(error):
            store.commit(changes)
        assert in_order(read_rows(path)) == content(store) == [query("a")]
    extremes = [query("b", 2**63 - 1), query("c", -(2**63)), query("d", 2**32), query("e", 0xCF)]
    store.commit([Put(row) for row in extremes])
    store.tidy()
    store.close()
    assert in_order(read_rows(path)) == [query("a"), *extremes]


def test_a_row_that_sqlite_would_not_take_is_not_acknowledged(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limit is a gigabyte; here it is lower, for both."""
    monkeypatch.setattr(journaled_store, "_LONGEST", 5000)
    store = journaled(path)
    store.commit([Put(part("many", b"x" * 4000)), Put(part("more", b"x" * 4000))])
    with pytest.raises(OverflowError, match="one: expected a row of up to 5000 bytes, got 50"):
        store.commit([Put(query("a")), Put(part("one", b"x" * 5000))])
    assert [row.id for row in content(store)] == ["many", "more"]
    store.close()


def test_a_row_of_20_megabytes_and_a_commit_of_100_000_changes_go_the_same_way(path: Path) -> None:
    store = journaled(path)
    huge = part("huge", os.urandom(20_000_000))
    many: list[Row] = [ServedQuery(f"{n:06}", "r", "app", "", 1, n) for n in range(100_000)]
    store.commit([Put(huge)])
    store.commit([Put(row) for row in many])
    copy = left_by(path)
    assert len(read_rows(copy)) == 100_001
    store.commit([Drop("queries", row.id) for row in many[:-1]])
    store.tidy()
    assert content(store) == [many[-1], huge]
    store.close()
    assert in_order(read_rows(path)) == [many[-1], huge]
    store = journaled(copy)
    assert content(store) == [*many, huge]
    store.close()
    assert names(copy) == ["catalog.lock", "catalog.sqlite3"]


# -- threads and processes -----------------------------------------------------------------------------------------


def test_threads_commit_while_others_fold_and_load(path: Path) -> None:
    store = journaled(path)
    ended = threading.Event()
    wrong: list[object] = []

    def work(name: str) -> None:
        for n in range(400):
            store.commit([Put(query(f"{name}{i}", n)) for i in range(3)])

    def fold() -> None:
        while not ended.is_set():
            store.tidy()

    def look() -> None:
        while not ended.is_set():
            for rows in (rows_of(store.load()), read_rows(path)):
                by_name: dict[str, set[int]] = {}
                for row in rows:
                    assert isinstance(row, ServedQuery)
                    by_name.setdefault(row.id[0], set()).add(row.seq)
                wrong.extend(seqs for seqs in by_name.values() if len(seqs) > 1)

    others = [threading.Thread(target=target) for target in (fold, fold, look)]
    workers = [threading.Thread(target=work, args=(name,)) for name in "abcd"]
    for thread in (*others, *workers):
        thread.start()
    for thread in workers:
        thread.join()
    ended.set()
    for thread in others:
        thread.join()
    assert wrong == []
    expected = [query(f"{name}{i}", 399) for name in "abcd" for i in range(3)]
    assert content(store) == expected
    copy = left_by(path)
    store.close()
    assert in_order(read_rows(path)) == in_order(read_rows(copy)) == expected


COMMITTER = """
import sys, threading
from rr_actors.registrar.model.rows import Drop, Put, ServedQuery, rows_of
from rr_actors.storage.opening import open_store
store = open_store(sys.argv[1])
def fold():
    while True:
        store.tidy()
n = max((row.seq for row in rows_of(store.load())), default=0)
threading.Thread(target=fold, daemon=True).start()
sys.setswitchinterval(1e-4)
print(n, flush=True)
while True:
    n += 1
    changes = [Put(ServedQuery(f"{n}-{i}", "r" * (n % 7 * 300), "app", "", 1, n)) for i in range(20)]
    if n > 3:
        changes += [Drop("queries", f"{n - 3}-{i}") for i in range(20)]
    store.commit(changes)
    print(n, flush=True)
"""


def expected_of(last: int) -> list[Row]:
    batches = range(max(1, last - 2), last + 1)
    return in_order(ServedQuery(f"{n}-{i}", "r" * (n % 7 * 300), "app", "", 1, n) for n in batches for i in range(20))


def last_of(rows: list[Row]) -> int:
    return max((row.seq for row in rows if isinstance(row, ServedQuery)), default=0)


@pytest.mark.slow
def test_a_process_killed_while_it_commits_and_folds_leaves_all_of_a_commit_or_none(path: Path) -> None:
    pause, chance = threading.Event(), Random(1)
    acknowledged = 0
    found: Counter[int] = Counter()
    for epoch in range(1, 61):
        command = [sys.executable, "-c", COMMITTER, str(path)]
        with subprocess.Popen(command, cwd=REPOSITORY, text=True, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() != ""
            pause.wait(chance.uniform(0, 0.1))  # the moment is random; what is waited for is nothing
            process.send_signal(signal.SIGKILL)
            acknowledged = int([str(acknowledged), *process.stdout.read().split()][-1])
        found[len(segments(path))] += 1
        rows = in_order(read_rows(path))
        last = last_of(rows)
        assert last in (acknowledged, acknowledged + 1)
        assert rows == expected_of(last)
        store = journaled(left_by(path))
        assert (content(store), store.epoch) == (rows, epoch + 1)
        store.close()
        acknowledged = last
        if epoch >= 12 and len(found) > 1:
            break
    assert len(found) > 1, "the moments were not very different"


READER = """
import json, sys
from rr_actors.storage.opening import read_rows
print("go", flush=True)
seen = readings = 0
while True:
    rows = read_rows(sys.argv[1])
    numbers = sorted({row.seq for row in rows})
    last = max(numbers, default=0)
    assert last >= seen, (last, seen)
    assert numbers == list(range(max(1, last - 2), last + 1)), numbers
    assert len(rows) == 20 * len(numbers), (last, len(rows))
    seen = last
    readings += 1
    if readings % 20 == 0:
        print(json.dumps([readings, last]), flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize("reopened", [False, True], ids=["open", "opened and closed"])
def test_another_process_reads_states_that_never_go_back_while_a_store_commits_and_folds(
    path: Path, reopened: bool
) -> None:
    store = journaled(path)
    ended = threading.Event()
    n = 0

    def fold(store: JournaledStore, ended: threading.Event) -> None:
        while not ended.is_set():
            store.tidy()

    with subprocess.Popen(
        [sys.executable, "-c", READER, str(path)], cwd=REPOSITORY, text=True, stdout=subprocess.PIPE
    ) as reader:
        assert reader.stdout is not None
        assert reader.stdout.readline() == "go\n"
        lines: list[str] = []
        listening = threading.Thread(target=lambda: lines.extend(reader.stdout or ()))
        listening.start()
        try:
            while len(lines) < 15 and reader.poll() is None:
                ended = threading.Event()
                folding = threading.Thread(target=fold, args=(store, ended))
                folding.start()
                for _ in range(200):
                    n += 1
                    changes: list[Change] = [Put(query(f"{n}-{i}", n)) for i in range(20)]
                    changes += [Drop("queries", f"{n - 3}-{i}") for i in range(20)]
                    store.commit(changes)
                ended.set()
                folding.join()
                if reopened:
                    store.close()
                    store = journaled(path)
        finally:
            reader.kill()
            listening.join()
    assert len(lines) >= 15, "it stopped at an error"
    assert json.loads(lines[-1])[1] > 0
    store.close()
