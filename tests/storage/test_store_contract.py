"""What every Store promises (store.py), over the three of them; then what those on disk promise besides.

What is the journal's alone is in test_journal*.py.
"""

from __future__ import annotations

import contextlib
import os
import random
import resource
import shutil
import signal
import sqlite3
import stat
import subprocess
import sys
import threading
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from hypothesis import HealthCheck, given, settings

from rr_actors.base.errors import CatalogDamaged, CatalogError, CatalogLocked, CatalogVersion
from rr_actors.base.pickling import dumps, loads
from rr_actors.base.scarcity import wanted_by
from rr_actors.registrar.model.rows import Change, Drop, Peer, Put, Row, ServedQuery, content_of, rows_of
from rr_actors.registrar.model.store import MemoryStore, Store
from rr_actors.storage.damage import errors_named
from rr_actors.storage.opening import open_store, read_rows
from rr_actors.storage.sql_tables import OLDEST_VERSION, SCHEMA_VERSION
from support import descriptors
from support_stores import COMMITS, in_order, part, query, states

ROOT = Path(__file__).parents[2]


class FileDisk:
    """A catalog on disk. With durability "power" its commits are synced."""

    def __init__(self, directory: Path, durability: str = "process") -> None:
        self.path = directory / "reg" / "catalog.sqlite3"
        self.durability = durability

    def open(self, **options: Any) -> Store:
        return open_store(self.path, **{"durability": self.durability, **options})


@pytest.fixture(params=["process", "power", "none"])
def new_store(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[], Store]:
    """Makes a store of an empty catalog, of each durability."""
    return MemoryStore if request.param == "none" else FileDisk(tmp_path, request.param).open


@pytest.fixture
def catalog(tmp_path: Path) -> FileDisk:
    return FileDisk(tmp_path)


@pytest.fixture(params=["process", "power"])
def either(request: pytest.FixtureRequest, tmp_path: Path) -> FileDisk:
    return FileDisk(tmp_path, request.param)


@pytest.fixture
def power(tmp_path: Path) -> FileDisk:
    return FileDisk(tmp_path, "power")


def content(store: Store) -> list[Row]:
    return in_order(rows_of(store.load()))


# -- every store ---------------------------------------------------------------------------------------------------


def test_a_new_catalog_is_empty_and_in_its_first_epoch(new_store: Callable[[], Store]) -> None:
    store = new_store()
    assert (content(store), store.epoch) == ([], 1)
    store.close()


@given(commits=COMMITS)
@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_was_committed_is_loaded(new_store: Callable[[], Store], commits: list[list[Change]]) -> None:
    store = new_store()
    for changes in commits:
        store.commit(changes)
    assert content(store) == states(commits)[-1]
    store.close(erase=True)


@given(commits=COMMITS)
@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_was_committed_is_loaded_after_it_was_opened_again(either: FileDisk, commits: list[list[Change]]) -> None:
    store = either.open()
    for changes in commits:
        store.commit(changes)
    store.close()
    store = either.open()
    assert content(store) == states(commits)[-1]
    assert content(store) == states(commits)[-1], "a second time as well"
    store.close(erase=True)


@given(commits=COMMITS)
@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_copy_is_a_closed_catalog_with_the_rows_that_were_given(
    either: FileDisk, tmp_path: Path, commits: list[list[Change]]
) -> None:
    store = either.open()
    for changes in commits[:-1]:
        store.commit(changes)
    given = content_of(states(commits)[-1])
    to = tmp_path / "copy" / "catalog.sqlite3"
    store.copy(given, to)
    assert sorted(path.name for path in to.parent.iterdir()) == ["catalog.sqlite3"]
    again = open_store(to)
    assert (again.load(), again.epoch) == (given, store.epoch + 1)
    again.close(erase=True)
    store.close(erase=True)


def change_what_is_loaded(store: Store) -> None:
    for _ in range(2):
        loaded = store.load()
        assert loaded == content_of([query("a"), query("b")])
        del loaded["queries"]["a"]
        loaded["peers"]["p"] = Peer("p")


def test_what_was_loaded_is_the_callers_to_change(new_store: Callable[[], Store]) -> None:
    store = new_store()
    store.commit([Put(query("a")), Put(query("b"))])
    change_what_is_loaded(store)
    store.close()


def test_what_was_loaded_at_an_opening_is_the_callers_to_change(either: FileDisk) -> None:
    store = either.open()
    store.commit([Put(query("a")), Put(query("b"))])
    store.close()
    store = either.open()
    change_what_is_loaded(store)
    store.close()
    store = either.open()
    assert content(store) == [query("a"), query("b")]
    store.close()


def test_the_changes_of_one_commit_apply_in_their_order(new_store: Callable[[], Store]) -> None:
    store = new_store()
    store.commit(
        [Put(query("a")), Drop("queries", "a"), Put(query("b")), Put(query("a", seq=2)), Put(query("b", seq=3))]
    )
    store.commit([Drop("queries", "a"), Put(query("a", seq=4)), Drop("queries", "b")])
    assert content(store) == [query("a", seq=4)]
    store.close()


def test_an_empty_commit_changes_nothing(new_store: Callable[[], Store]) -> None:
    store = new_store()
    store.commit([Put(query("a"))])
    store.commit([])
    assert content(store) == [query("a")]
    store.close()


def test_every_opening_counts_the_epoch_up(either: FileDisk) -> None:
    epochs: list[int] = []
    for _ in range(3):
        store = either.open()
        epochs.append(store.epoch)
        store.close()
    assert epochs == [1, 2, 3]


def test_a_second_open_is_refused_until_the_first_is_closed_and_disturbs_nothing(either: FileDisk) -> None:
    store = either.open()
    store.commit([Put(query("a"))])
    for _ in range(2):
        with pytest.raises(CatalogLocked, match="this process") as caught:
            either.open()
        assert caught.value.details["pid"] == os.getpid()
    store.commit([Put(query("b"))])
    store.close()
    store = either.open()
    assert content(store) == [query("a"), query("b")]
    assert store.epoch == 2
    store.close()


def test_an_erased_catalog_starts_again_from_nothing(either: FileDisk) -> None:
    store = either.open()
    store.commit([Put(query("a"))])
    store.close(erase=True)
    store = either.open()
    assert (content(store), store.epoch) == ([], 1)
    store.close()


def test_a_store_opened_in_one_thread_serves_another(new_store: Callable[[], Store]) -> None:
    store = new_store()
    thread = threading.Thread(target=store.commit, args=([Put(query("a")), Put(part("b"))],))
    thread.start()
    thread.join()
    assert content(store) == [query("a"), part("b")]
    store.close()


# -- on disk: the file ---------------------------------------------------------------------------------------------


def test_the_catalog_can_be_read_with_any_sqlite_tool_while_it_is_open(either: FileDisk) -> None:
    store = either.open()
    store.commit([Put(query("q1")), Put(part("r1", b"\x81")), Put(Peer("hub"))])
    store.tidy()
    reader = sqlite3.connect(either.path)
    assert reader.execute("SELECT id, origin, seq FROM queries").fetchall() == [("q1", "app", 1)]
    assert reader.execute("SELECT server, request, response, phase, state FROM resources").fetchall() == [
        ("camera", b"\x81", None, "loaded", "OK")
    ]
    assert reader.execute("PRAGMA user_version").fetchall() == [(SCHEMA_VERSION,)]
    reader.close()
    store.close()


def test_its_rows_can_be_read_while_it_is_open_and_when_it_is_not(either: FileDisk) -> None:
    assert read_rows(either.path) == []
    assert not either.path.parent.exists()
    store = either.open()
    store.commit([Put(query("a")), Put(part("b"))])
    assert in_order(read_rows(either.path)) == [query("a"), part("b")]
    store.commit([Drop("queries", "a")])
    store.close()
    assert read_rows(str(either.path)) == [part("b")]
    either.path.write_bytes(b"text")
    with pytest.raises(CatalogDamaged, match=str(either.path)):
        read_rows(either.path)
    assert either.path.read_bytes() == b"text"
    assert sorted(file.name for file in either.path.parent.iterdir()) == ["catalog.lock", "catalog.sqlite3"]


def test_its_files_are_private(either: FileDisk) -> None:
    before = os.umask(0)
    try:
        store = either.open()
        store.commit([Put(query("a"))])
        store.tidy()
        store.commit([Put(query("b"))])
    finally:
        os.umask(before)
    directory = either.path.parent
    assert stat.S_IMODE(directory.stat().st_mode) == 0o700
    modes = {file.name: stat.S_IMODE(file.stat().st_mode) for file in directory.iterdir()}
    names = {"catalog.lock", "catalog.sqlite3", "catalog.sqlite3-shm", "catalog.sqlite3-wal"}
    assert modes.keys() == names | {"catalog.journal.2"}
    assert set(modes.values()) == {0o600}
    store.close()


def test_a_catalog_that_holds_nothing_is_a_lock_two_descriptors_and_no_wait_for_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[int] = []
    monkeypatch.setattr(os, "fsync", synced.append)
    before = descriptors()
    path = tmp_path / "reg" / "catalog.sqlite3"
    store = open_store(path)
    try:
        assert [file.name for file in path.parent.iterdir()] == ["catalog.lock"]
        assert len(descriptors() - before) == 2  # the lock, and the directory
        assert synced == []
        assert read_rows(path) == []
        store.commit([Put(query("a"))])
        store.commit([Drop("queries", "a")])
        store.tidy()
        assert [file.name for file in path.parent.iterdir()] == ["catalog.lock"], "it has come to nothing"
        store.commit([Put(query("a"))])
        assert synced == [], "no commit waits for the disk"
        store.tidy()
        assert len(synced) == 1
        with contextlib.closing(sqlite3.connect(path)) as connection:
            assert connection.execute("PRAGMA journal_mode").fetchall() == [("wal",)]
            assert connection.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
            assert connection.execute("SELECT epoch, folded FROM meta").fetchall() == [(1, 1)]
    finally:
        store.close()


def test_closing_leaves_one_file_and_an_empty_lock_and_erasing_not_even_the_directory(either: FileDisk) -> None:
    before = descriptors()
    store = either.open()
    store.commit([Put(query("a"))])
    store.close()
    assert sorted(file.name for file in either.path.parent.iterdir()) == ["catalog.lock", "catalog.sqlite3"]
    assert either.path.with_name("catalog.lock").read_bytes() == b""
    either.open().close(erase=True)
    assert not either.path.parent.exists()
    assert not descriptors() - before


def test_erasing_leaves_what_is_not_the_catalogs(either: FileDisk) -> None:
    store = either.open()
    (either.path.parent / "notes.txt").write_text("mine")
    store.close(erase=True)
    assert [file.name for file in either.path.parent.iterdir()] == ["notes.txt"]


def test_the_file_does_not_grow_with_use(either: FileDisk) -> None:
    store = either.open()

    def use(rounds: range) -> int:
        for n in rounds:
            ids = [f"{n:08}-{i:04}" for i in range(300)]
            for changes in (
                [Put(row) for id_ in ids for row in (query(id_), part(id_, id_.encode() * 10))],
                [Drop(table, id_) for id_ in ids for table in ("queries", "resources")],
            ):
                store.commit(changes)
                if store.wants_tidying():
                    store.tidy()
        return sum(file.stat().st_size for file in either.path.parent.iterdir())

    first = use(range(30))
    assert use(range(30, 120)) <= first * 1.1
    assert content(store) == []
    store.close()


@pytest.mark.parametrize("durability", ["process", "power"])
def test_both_durabilities_write_the_same(catalog: FileDisk, durability: str) -> None:
    store = catalog.open(durability=durability)
    store.commit([Put(query(str(n))) for n in range(10)])
    store.close()
    store = catalog.open()
    assert len(content(store)) == 10
    store.close()


# -- on disk: killed processes -------------------------------------------------------------------------------------

COMMITTER = """
import sys
from rr_actors.registrar.model.rows import Drop, Put, ServedQuery, rows_of
from rr_actors.storage.opening import open_store
store = open_store(sys.argv[1], durability=sys.argv[2])
n = max((row.seq for row in rows_of(store.load())), default=0)
print(n, flush=True)
while True:
    n += 1
    changes = [Put(ServedQuery(f"{n}-{i}", "r" * 500, "app", "", 1, n)) for i in range(20)]
    if n > 3:
        changes += [Drop("queries", f"{n - 3}-{i}") for i in range(20)]
    store.commit(changes)
    print(n, flush=True)
"""
HOLDER = """
import sys
from rr_actors.storage.opening import open_store
store = open_store(sys.argv[1])
print("open", flush=True)
sys.stdin.read()
"""
FORKING_HOLDER = """
import os, sys
from rr_actors.storage.opening import open_store
store = open_store(sys.argv[1])
if os.fork() == 0:
    print("forked", flush=True)
    sys.stdin.read()
    os._exit(0)
sys.stdin.read()
"""
OPENER = """
import itertools, sys
from rr_actors.base.errors import CatalogLocked
from rr_actors.registrar.model.rows import Put, ServedQuery, rows_of
from rr_actors.storage.opening import open_store
print("go", flush=True)
for n in itertools.count():
    store = open_store(f"{sys.argv[1]}/{n % 7}/catalog.sqlite3")
    assert len(rows_of(store.load())) in (0, 1), rows_of(store.load())
    store.commit([Put(ServedQuery("a", "", "", "", 1, n))])
    store.close(erase=n % 3 != 0)
"""


@pytest.fixture
def processes() -> Iterator[list[subprocess.Popen[str]]]:
    started: list[subprocess.Popen[str]] = []
    yield started
    for process in started:
        with process:  # closes its pipes
            process.kill()


def start(processes: list[subprocess.Popen[str]], code: str, *args: str) -> subprocess.Popen[str]:
    """Start Python on this code and return when it has printed its first line."""
    process = subprocess.Popen(
        [sys.executable, "-c", code, *args], cwd=ROOT, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    processes.append(process)
    assert process.stdout is not None
    assert process.stdout.readline() != ""
    return process


def kill(process: subprocess.Popen[str]) -> list[str]:
    """SIGKILL it, and return what it had printed by then."""
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    assert process.stdout is not None
    return process.stdout.read().split()


@pytest.mark.slow
@pytest.mark.parametrize("durability", ["process", "power"])
def test_a_process_killed_while_it_commits_leaves_all_of_a_commit_or_none(
    catalog: FileDisk, processes: list[subprocess.Popen[str]], durability: str
) -> None:
    pause = threading.Event()
    chance = random.Random(durability)
    acknowledged = 0
    for epoch in range(1, 9):
        process = start(processes, COMMITTER, str(catalog.path), durability)
        pause.wait(chance.uniform(0, 0.05))  # the moment is random; what is waited for is nothing
        acknowledged = int([str(acknowledged), *kill(process)][-1])
        copy = FileDisk(catalog.path.parent.parent / f"copy{epoch}")
        shutil.copytree(catalog.path.parent, copy.path.parent)
        store = copy.open()
        last = max((row.seq for row in rows_of(store.load()) if isinstance(row, ServedQuery)), default=0)
        assert last in (acknowledged, acknowledged + 1)
        batches = range(max(1, last - 2), last + 1)
        expected = [ServedQuery(f"{n}-{i}", "r" * 500, "app", "", 1, n) for n in batches for i in range(20)]
        assert content(store) == in_order(expected)
        assert store.epoch == epoch + 1
        store.close()
        acknowledged = last


@pytest.mark.slow
def test_a_process_killed_while_it_opens_closes_or_erases_leaves_a_catalog_that_opens(
    tmp_path: Path, processes: list[subprocess.Popen[str]]
) -> None:
    pause = threading.Event()
    chance = random.Random(1)
    for _ in range(8):
        process = start(processes, OPENER, str(tmp_path))
        pause.wait(chance.uniform(0, 0.05))
        kill(process)
        for directory in tmp_path.iterdir():
            store = open_store(directory / "catalog.sqlite3")
            assert len(content(store)) <= 1
            store.close()


def test_a_catalog_that_a_living_process_has_open_is_refused_naming_it_and_free_once_it_is_killed(
    catalog: FileDisk, processes: list[subprocess.Popen[str]]
) -> None:
    process = start(processes, HOLDER, str(catalog.path))
    with pytest.raises(CatalogLocked, match=f"{catalog.path}.*process {process.pid} holds") as caught:
        catalog.open()
    assert (caught.value.details["pid"], caught.value.details["path"]) == (process.pid, str(catalog.path))
    kill(process)
    catalog.open().close()


def test_a_child_that_the_holder_forked_does_not_keep_the_lock_when_the_holder_is_killed(
    catalog: FileDisk, processes: list[subprocess.Popen[str]]
) -> None:
    process = start(processes, FORKING_HOLDER, str(catalog.path))
    process.send_signal(signal.SIGKILL)
    process.wait()
    catalog.open().close()
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.close()  # the child leaves, and its end of the other pipe closes
    assert process.stdout.read() == ""


# -- on disk: full disks and other obstacles -----------------------------------------------------------------------


def test_a_commit_that_fails_leaves_the_last_committed_state_and_the_next_one_succeeds(either: FileDisk) -> None:
    store = either.open()
    store.commit([Put(query("a")), Put(part("r"))])
    wal = either.path.with_name("catalog.sqlite3-wal")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    for changes in (
        [Put(part("r", b"x" * 100_000))],
        [Drop("queries", "a"), Put(query("b")), Put(part("r", b"x" * 10**5))],
    ):
        written = wal.stat().st_size if wal.exists() else 0
        resource.setrlimit(resource.RLIMIT_FSIZE, (written + 8192, hard))  # as if the disk were full
        try:
            with pytest.raises(CatalogError, match="none of them is written") as caught:
                store.commit(changes)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        assert caught.value.details["path"] == str(either.path)
        assert content(store) == [query("a"), part("r")]
    store.commit([Put(query("c"))])
    store.close()
    store = either.open()
    assert content(store) == [query("a"), query("c"), part("r")]
    store.close()


def test_closing_after_a_failure_leaves_one_file_and_no_descriptor(either: FileDisk) -> None:
    before = descriptors()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    store = either.open()
    store.commit([Put(query("a"))])
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        for fail in (lambda: store.commit([Put(query("b"))]), store.tidy):
            with contextlib.suppress(CatalogError):
                fail()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    store.close()
    assert sorted(file.name for file in either.path.parent.iterdir()) == ["catalog.lock", "catalog.sqlite3"]
    assert not descriptors() - before
    assert read_rows(either.path) == [query("a")]


def test_a_row_that_cannot_be_written_takes_its_whole_commit_back(either: FileDisk) -> None:
    store = either.open()
    with pytest.raises(OverflowError):
        store.commit([Put(query("a")), Put(part("r")), Put(query("b", seq=2**63))])
    with pytest.raises(OverflowError):
        store.commit([Put(query("b", seq=2**63))])
    assert content(store) == []
    store.commit([Put(query("c"))])
    assert content(store) == [query("c")]
    store.close()


def test_a_full_disk_when_the_file_is_made_is_an_error_that_names_the_catalog_and_loses_nothing(
    either: FileDisk,
) -> None:
    """With durability "power" that is when it is opened; else some time after the first commit."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        if either.durability == "power":
            with pytest.raises(CatalogError, match=str(either.path)):
                either.open()
        else:
            store = either.open()
            store.commit([Put(query("a"))])
            with pytest.raises(CatalogError, match=f"{either.path}: .* they stay in the journal, and are safe there"):
                store.tidy()
            store.close()
            assert read_rows(either.path) == [query("a")]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    store = either.open()
    assert content(store) == ([] if either.durability == "power" else [query("a")])
    store.close()
    assert sorted(file.name for file in either.path.parent.iterdir()) == ["catalog.lock", "catalog.sqlite3"]


def test_a_place_where_no_directory_can_be_is_an_error_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("a file")
    with pytest.raises(
        CatalogError, match="expected a directory and files that this process may read and write"
    ) as caught:
        open_store(tmp_path / "file" / "catalog.sqlite3")
    assert caught.value.details["path"] == str(tmp_path / "file" / "catalog.sqlite3")


# -- on disk: files that are no catalog ----------------------------------------------------------------------------


def saved(catalog: FileDisk, rows: int = 50) -> bytes:
    """Make a catalog with some rows and return the bytes of its file."""
    store = catalog.open()
    store.commit([Put(row) for n in range(rows) for row in (query(f"q{n:03}", n), part(f"r{n:03}", b"request" * n))])
    store.close()
    return catalog.path.read_bytes()


def altered(sql: str) -> typing.Callable[[Path], None]:
    def alter(path: Path) -> None:
        connection = sqlite3.connect(path)
        connection.executescript(sql)
        connection.close()

    return alter


def cut(size: int) -> typing.Callable[[Path], None]:
    return lambda path: os.truncate(path, size)


def without_its_file(path: Path) -> None:
    path.with_name(path.name + "-wal").write_bytes(b"what was not yet in the file")
    path.unlink()


def text(path: Path) -> None:
    path.write_text("[registrars]\n" * 100)


def foreign(path: Path) -> None:
    path.unlink()
    altered("CREATE TABLE songs (title TEXT)")(path)


NO_CATALOGS: dict[str, typing.Callable[[Path], None]] = {
    "empty": cut(0),
    "only a header": cut(100),
    "cut in its first page": cut(3000),
    "cut in the middle": cut(20_000),
    "text": text,
    "another program's": foreign,
    "only its -wal": without_its_file,
    "no application id": altered("PRAGMA application_id = 0"),
    "version 0": altered("PRAGMA user_version = 0"),
    "not in WAL mode": altered("PRAGMA journal_mode = DELETE"),
    "a table too few": altered("DROP TABLE held"),
    "a table too many": altered("CREATE TABLE songs (title TEXT)"),
    "an unknown phase": altered("UPDATE resources SET phase = 'flying' WHERE id = 'r007'"),
    "another phase": altered("UPDATE resources SET phase = 'loading' WHERE id = 'r007'"),
    "text in a number": altered("UPDATE queries SET seq = 'seven' WHERE id = 'q007'"),
    "invalid UTF-8": altered("UPDATE queries SET origin = CAST(x'ff' AS TEXT) WHERE id = 'q007'"),
    "no epoch": altered("DELETE FROM meta"),
    "another epoch": altered("UPDATE meta SET epoch = 77"),
    "two epochs": altered("INSERT INTO meta VALUES ('b', 1, 0, '', 0)"),
}


@pytest.mark.parametrize("damage", NO_CATALOGS.values(), ids=NO_CATALOGS.keys())
def test_a_damaged_or_foreign_file_is_refused_by_name_and_left_as_it_is(
    catalog: FileDisk, damage: typing.Callable[[Path], None]
) -> None:
    saved(catalog)
    damage(catalog.path)
    catalog.path.with_name("catalog.lock").unlink()
    before = {file: file.read_bytes() for file in catalog.path.parent.iterdir()}
    for _ in range(2):
        with pytest.raises(
            CatalogDamaged, match=f'{catalog.path}: expected a catalog, got .*on_damage = "aside"'
        ) as caught:
            catalog.open()
        assert caught.value.details["path"] == str(catalog.path)
        catalog.path.with_name("catalog.lock").unlink()
        assert {file: file.read_bytes() for file in catalog.path.parent.iterdir()} == before


@pytest.mark.parametrize("damage", NO_CATALOGS.values(), ids=NO_CATALOGS.keys())
def test_with_on_damage_aside_it_is_renamed_and_an_empty_catalog_takes_its_place(
    catalog: FileDisk, damage: typing.Callable[[Path], None], caplog: pytest.LogCaptureFixture
) -> None:
    for n in (1, 2):
        saved(catalog)
        damage(catalog.path)
        before = {file.name: file.read_bytes() for file in catalog.path.parent.glob("catalog.sqlite3*")}
        store = catalog.open(on_damage="aside")
        assert (content(store), store.epoch) == ([], 1)
        store.commit([Put(query("a"))])
        store.close(erase=True)
        for name, data in before.items():
            if "damaged" not in name:
                name = name.replace("catalog.sqlite3", f"catalog.sqlite3.damaged-{n}")
            assert catalog.path.with_name(name).read_bytes() == data
        assert f"renamed to catalog.sqlite3.damaged-{n}" in caplog.text


@pytest.mark.slow
def test_every_byte_that_is_wrong_is_found_or_does_not_matter(catalog: FileDisk) -> None:
    good = saved(catalog)
    store = catalog.open()
    rows = content(store)
    store.close()
    good = catalog.path.read_bytes()
    chance = random.Random(1)
    found = 0
    for at in [*range(0, 100, 3), *(chance.randrange(len(good)) for _ in range(300))]:
        bad = bytearray(good)
        bad[at] ^= chance.randrange(1, 256)
        catalog.path.write_bytes(bad)
        try:
            store = catalog.open()
        except (CatalogDamaged, CatalogVersion):
            found += 1
            assert catalog.path.read_bytes() == bad
        else:
            assert (content(store), store.epoch) == (rows, 3), f"byte {at}"
            store.close()
    assert found > 50


def test_rows_that_are_gone_from_a_large_catalog_are_noticed_too(catalog: FileDisk) -> None:
    """No row is wrong then; SQLite finds it, in another thread while the rows are read."""
    store = catalog.open()
    store.commit([Put(part(f"{n:05}", b"x" * 1000)) for n in range(5000)])
    store.close()
    good = catalog.path.read_bytes()
    assert len(good) > 4 * 2**20
    page = int.from_bytes(good[16:18], "big")
    leaves = [at for at in range(0, len(good), page) if good[at] == 10 and good[at + 4] > 1]  # with so many rows
    for at in random.Random(1).sample(leaves, 5):
        bad = bytearray(good)
        bad[at + 4] -= 1
        catalog.path.write_bytes(bad)
        with pytest.raises(CatalogDamaged, match="SQLite finds damaged"):
            catalog.open()
        assert catalog.path.read_bytes() == bad
    catalog.path.write_bytes(good)
    store = catalog.open()
    assert len(content(store)) == 5000
    store.close()


def test_a_torn_wal_is_read_up_to_its_last_whole_commit(power: FileDisk) -> None:
    store = power.open()
    for n in range(20):
        store.commit([Put(query(f"{n:02}-{i}", n)) for i in range(5)])
        store.upkeep()
    copy = FileDisk(power.path.parent.parent / "copy")
    shutil.copytree(power.path.parent, copy.path.parent)
    store.close()
    torn = FileDisk(power.path.parent.parent / "torn")
    shutil.copytree(copy.path.parent, torn.path.parent)
    os.truncate(torn.path.with_name("catalog.sqlite3-wal"), 9000)
    assert len(read_rows(torn.path)) == 100, "the journal has what the -wal has lost"
    for segment in copy.path.parent.glob("catalog.journal.*"):
        segment.unlink()
    files = {file: file.read_bytes() for file in copy.path.parent.iterdir()}
    wal = copy.path.with_name("catalog.sqlite3-wal")
    kept: set[int] = set()
    for size in range(0, len(files[wal]), 4000):
        for file, data in files.items():
            file.write_bytes(data)
        os.truncate(wal, size)
        store = copy.open()
        rows = content(store)
        assert rows == [query(f"{n:02}-{i}", n) for n in range(len(rows) // 5) for i in range(5)]
        kept.add(len(rows) // 5)
        store.close()
    assert {0, 10, 19} <= kept


@pytest.mark.parametrize("version", [OLDEST_VERSION - 1, SCHEMA_VERSION + 1])
@pytest.mark.parametrize("on_damage", ["refuse", "aside"])
def test_another_version_is_refused_and_left_as_it_is_whatever_on_damage_says(
    catalog: FileDisk, on_damage: str, version: int
) -> None:
    saved(catalog)
    altered(f"PRAGMA user_version = {version}; CREATE TABLE songs (title TEXT)")(catalog.path)
    before = catalog.path.read_bytes()
    with pytest.raises(
        CatalogVersion, match=f"{catalog.path}.*version {SCHEMA_VERSION}, got version {version}"
    ) as caught:
        catalog.open(on_damage=on_damage)
    assert (caught.value.details["expected"], caught.value.details["got"]) == (SCHEMA_VERSION, version)
    assert catalog.path.read_bytes() == before


def test_tidying_beside_commits_keeps_the_wal_small_and_loses_nothing(power: FileDisk) -> None:
    path, store = power.path, power.open()
    wal = path.with_name(path.name + "-wal")
    largest = tidied = 0
    for number in range(3000):
        store.commit([Put(ServedQuery(f"{number % 1000:032x}", "r", "app", "", 1, number))])
        if number % 20 == 0:
            tidier = threading.Thread(target=store.upkeep)
            tidier.start()
            store.commit([Put(ServedQuery(f"{number % 1000:032x}", "r", "app", "", 1, number))])
            tidier.join()
            tidied += wal.stat().st_size == 0
            largest = max(largest, wal.stat().st_size)
    store.close()
    assert tidied >= 2
    assert largest < 6 * 2**20
    assert {row.id: row.seq for row in read_rows(path) if isinstance(row, ServedQuery)} == {
        f"{n % 1000:032x}": n for n in range(2000, 3000)
    }


def test_small_commits_of_large_rows_are_copied_before_a_commit_has_to_do_it(power: FileDisk) -> None:
    path, store = power.path, power.open()
    wal = path.with_name(path.name + "-wal")
    largest = 0
    for number in range(4_000):
        if number % 10 == 9:
            store.upkeep()
            largest = max(largest, wal.stat().st_size)
        changes: list[Change] = [Put(part(f"{number:032x}", b"x" * 400))]
        if number >= 300:
            changes.append(Drop("resources", f"{number - 300:032x}"))
        store.commit(changes)
    store.close()
    assert largest < 3.2 * 2**20


def test_a_catalog_that_may_only_be_read_is_told_with_what_helps(tmp_path: Path) -> None:
    path = tmp_path / "catalog.sqlite3"
    path.touch()
    told = f"{path}: expected to read and write the catalog, got: .*readonly.*may be written .* try again"
    with (
        contextlib.closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as database,
        pytest.raises(CatalogError, match=told),
        errors_named(path),
    ):
        database.execute("create table t (a)")


@pytest.mark.parametrize(
    ("code", "room", "named"),
    [
        (sqlite3.SQLITE_FULL, 10**9, "ENOSPC"),
        (sqlite3.SQLITE_IOERR, 4096, "ENOSPC"),  # it could not make a file longer, and does not say why
        (sqlite3.SQLITE_IOERR, 10**9, ""),
        (sqlite3.SQLITE_NOMEM, 10**9, "ENOMEM"),
    ],
)
def test_what_sqlite_had_too_little_of_is_named_and_known_to_those_who_start_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, room: int, named: str
) -> None:
    path = tmp_path / "catalog.sqlite3"
    error = sqlite3.OperationalError("as SQLite says it")
    error.sqlite_errorcode = code
    with monkeypatch.context() as patch:
        patch.setattr(os, "statvfs", lambda _: mock.Mock(f_bavail=room // 4096, f_frsize=4096))
        with pytest.raises(CatalogError) as caught, errors_named(path):
            raise error
    arrived = loads(dumps(caught.value))
    for found in (caught.value, arrived):
        assert wanted_by(found).partition(":")[0] == named
        assert f"{path}: " in str(found)
        assert named in str(found)
        assert "as SQLite says it" in str(found)
