"""Whatever is done to the files of a catalog: the right rows, an error that names it, or a warning. Never silence."""

from __future__ import annotations

import logging
import os
import resource
import shutil
import sqlite3
import stat
import threading
import zlib
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path

import pytest

import rr_actors as rr
from fuzz import damage
from rr_actors.base.errors import CatalogDamaged, CatalogLocked
from rr_actors.base.folder import Folder
from rr_actors.registrar.model.rows import Change, Drop, Peer, Put, ServedQuery, rows_of
from rr_actors.registrar.model.store import Store
from rr_actors.storage import opening
from rr_actors.storage.opening import Durability, open_store, read_rows, remove_unneeded
from rr_actors.storage.witness import LastOpening, Witness, tell_of_missing
from rr_actors.wire.name_service import open_state_dir
from support_slow import few_now
from support_stores import in_order, segments_of


@pytest.mark.parametrize("times", few_now([110], [330]))
def test_a_sample_of_flips_cuts_swaps_and_removals_in_every_state_is_never_silent(tmp_path: Path, times: int) -> None:
    """The whole of it: python -m fuzz.damage."""
    counts, failures = damage.run(times, 5, tmp_path)
    assert failures == []
    outcomes = {outcome for _, outcome in counts}
    assert {"right", "error", "warning"} <= outcomes


def test_the_sample_would_find_silence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As it was: nobody knew which segments there had been."""
    monkeypatch.setattr("rr_actors.storage.catalog_lock._read", lambda _fd: (None, None))
    _, failures = damage.run(220, 1, tmp_path)
    assert any("SILENCE" in failure for failure in failures)


# -- one by one ----------------------------------------------------------------------------------------------------


def committed(number: int) -> list[Change]:
    return [Put(ServedQuery(f"q{number:03}", "r" * 500, "app", "", 1, number))]


def left_by(place: Path, durability: Durability, *, folded: int = 40, more: int = 5) -> Path:
    """What a killed process leaves: an opening that was closed, one with folds, and commits behind them."""
    path, witness = place / "live" / "app" / "catalog.sqlite3", Witness(place / "live", "app")
    store = open_store(path, durability=durability, witness=witness)
    store.commit([Put(Peer("before"))])
    store.close()
    store = open_store(path, durability=durability, witness=witness)
    for number in range(folded):
        store.commit(committed(number))
        (store.upkeep if number % 20 else store.tidy)()
    for number in range(folded, folded + more):
        store.commit(committed(number))
    shutil.copytree(place / "live", place / "left")
    store.close()
    return place / "left" / "app" / "catalog.sqlite3"


def fill(path: Path) -> None:
    """Have a catalog made with a row."""
    store = opened(path, "process")
    store.commit([Put(Peer("hub"))])
    store.close()


def opened(path: Path, durability: Durability) -> Store:
    return open_store(path, durability=durability, witness=Witness(path.parent.parent, path.parent.name))


@pytest.mark.parametrize("durability", ["process", "power"])
def test_what_a_killed_process_left_is_read_without_a_word(
    tmp_path: Path, durability: Durability, caplog: pytest.LogCaptureFixture
) -> None:
    store = opened(left_by(tmp_path, durability), durability)
    assert len(rows_of(store.load())) == 46
    store.close()
    assert warnings_in(caplog) == []


def warnings_in(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


def flip_in_the_middle(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def flip_in_its_header(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[16] ^= 1
    path.write_bytes(data)


def cut_in_half(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


SPOIL: list[Callable[[Path], None]] = [flip_in_the_middle, flip_in_its_header, cut_in_half, Path.unlink]


@pytest.mark.parametrize("durability", ["process", "power"])
@pytest.mark.parametrize("spoil", SPOIL)
def test_rows_that_vanish_with_a_killed_registrars_wal_are_told_of(
    tmp_path: Path, durability: Durability, spoil: Callable[[Path], None], caplog: pytest.LogCaptureFixture
) -> None:
    path = left_by(tmp_path, durability)
    spoil(path.with_name("catalog.sqlite3-wal"))
    for _ in range(2):
        store = opened(path, durability)
        rows = rows_of(store.load())
        store.close()
        assert len(rows) == 46, "the journal has what the file has not taken"
    (text,) = warnings_in(caplog)
    assert str(path) in text
    assert "catalog.sqlite3-wal was removed, cut off, damaged" in text
    assert "nothing is lost" in text


def empty(path: Path) -> None:
    path.write_bytes(b"")


def make_zeros(path: Path) -> None:
    path.write_bytes(bytes(99))


@pytest.mark.parametrize("spoil", [*SPOIL, empty, make_zeros])
def test_commits_that_vanish_with_the_newest_segment_are_told_of(
    tmp_path: Path, spoil: Callable[[Path], None], caplog: pytest.LogCaptureFixture
) -> None:
    path = left_by(tmp_path, "process")
    segment = segments_of(path)[-1]
    spoil(segment)
    if spoil is flip_in_its_header:
        with pytest.raises(CatalogDamaged, match=segment.name):
            opened(path, "process")
        return
    store = opened(path, "process")
    assert len(rows_of(store.load())) < 46
    store.close()
    assert any(segment.name in text for text in warnings_in(caplog))


def test_a_directory_that_is_removed_is_told_of_at_the_start_and_when_it_is_opened(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    fill(tmp_path / "state" / "app" / "catalog.sqlite3")
    shutil.rmtree(tmp_path / "state" / "app")
    with rr.System(state_dir=tmp_path / "state") as system:
        assert f"app: expected its catalog {tmp_path}/state/app/catalog.sqlite3" in caplog.text
        caplog.clear()
        system.open_registrar("app")
        assert "app: expected its catalog" in caplog.text
        caplog.clear()
    with rr.System(state_dir=tmp_path / "state") as system:
        system.open_registrar("app")
    assert warnings_in(caplog) == []


def test_a_catalog_whose_location_was_changed_is_not_said_to_be_removed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    one, two = (tmp_path / name / "catalog.sqlite3" for name in ("one", "two"))
    for path in (one, two):
        store = open_store(path, witness=Witness(tmp_path, "app"))
        store.commit(committed(1))
        store.close()
    (text,) = warnings_in(caplog)
    assert f"app: expected its catalog {one}, which is there, got {two} in another location" in text
    assert "removed" not in text
    caplog.clear()
    open_store(one, witness=Witness(tmp_path, "app")).close()
    (text,) = warnings_in(caplog)
    assert f"app: expected its catalog {two}, which is there, got {one} in another location" in text
    shutil.rmtree(one.parent)
    caplog.clear()
    open_store(two, witness=Witness(tmp_path, "app")).close()
    assert "another catalog than the one that app had last" in caplog.text


def test_a_catalog_that_is_all_in_its_journal_is_missed_and_one_that_has_come_to_nothing_is_not(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    state = tmp_path / "state"
    path = state / "app" / "catalog.sqlite3"
    store = opened(path, "process")
    store.commit(committed(1))
    store.commit([Drop("queries", "q001")])
    store.tidy()
    assert Witness(state, "app").known() is None
    store.commit(committed(2))
    shutil.copytree(state, tmp_path / "killed")
    store.close()
    shutil.rmtree(state)
    (tmp_path / "killed").rename(state)
    assert tell_of_missing(state) == warnings_in(caplog) == []
    shutil.rmtree(path.parent)
    assert tell_of_missing(state) == ["app"]
    caplog.clear()
    store = opened(path, "process")
    assert store.epoch == 2
    store.close()
    assert f"app: expected its catalog {path} (opened 1 times), got none" in caplog.text


def test_directories_that_are_swapped_are_refused_by_name(tmp_path: Path) -> None:
    for name in ("one", "two"):
        fill(tmp_path / name / "catalog.sqlite3")
    (tmp_path / "one").rename(tmp_path / "three")
    (tmp_path / "two").rename(tmp_path / "one")
    with (
        rr.System(state_dir=tmp_path) as system,
        pytest.raises(CatalogDamaged, match=r"'two' in the place of .* 'one'"),
    ):
        system.open_registrar("one")


def test_an_erased_catalog_is_not_missed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    config = rr.RegistrarConfig("app", erase_on_destruct=True)
    for _ in range(2):
        with rr.System(state_dir=tmp_path) as system:
            system.open_registrar("app", config).close()
    assert warnings_in(caplog) == []


def test_an_older_copy_is_told_from_the_one_that_was_opened_last_and_its_epoch_is_not_used_twice(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "app" / "catalog.sqlite3"
    fill(path)
    shutil.copytree(path.parent, tmp_path / "copy")
    for _ in range(3):
        opened(path, "process").close()
    shutil.rmtree(path.parent)
    (tmp_path / "copy").rename(path.parent)
    store = opened(path, "process")
    assert store.epoch == 5
    store.close()
    assert "expected its state of opening 4 or later, got that of opening 1" in caplog.text


def test_a_file_under_another_catalogs_wal_is_refused(tmp_path: Path) -> None:
    """SQLite would apply the one to the other."""
    path = left_by(tmp_path / "one", "power")
    other = left_by(tmp_path / "two", "power")
    shutil.copy(other, path)
    with pytest.raises(CatalogDamaged, match="with this one's -wal"):
        opened(path, "power")


def test_what_the_lock_says_is_read_again_only_as_it_was_written(tmp_path: Path) -> None:
    path = left_by(tmp_path, "process")
    lock = path.with_name("catalog.lock")
    good = lock.read_text()
    assert f" {42:020} " in good
    for at in range(len(good)):
        for character in ("0", "x", "\n"):
            lock.write_text(good[:at] + character + good[at + 1 :])
            store = opened_copy(path, tmp_path / "copy")
            assert len(rows_of(store.load())) == 46
            store.close()


def opened_copy(path: Path, place: Path) -> Store:
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(path.parent.parent, place)
    return opened(place / "app" / path.name, "process")


def test_a_catalog_says_whose_it_is_and_how_far_it_has_come(tmp_path: Path) -> None:
    path = left_by(tmp_path, "power")
    store = opened(path, "power")
    store.commit([Put(Peer("more"))])
    with closing(sqlite3.connect(path)) as connection:
        ((id_, epoch, folded, registrar),) = connection.execute("SELECT id, epoch, folded, registrar FROM meta")
    assert (epoch, registrar) == (3, "app")
    assert Witness(tmp_path / "left", "app").known() == LastOpening(id_, 3, str(path))
    assert f"{id_} 3 journal {folded + 1:020} {folded:020}" in path.with_name("catalog.lock").read_text()
    assert in_order(rows_of(store.load()))[0] == Peer("before")
    store.close()
    assert path.with_name("catalog.lock").read_text() == ""


@pytest.mark.parametrize("missing", [0, 2])
def test_the_lock_of_an_earlier_version_without_a_journal_says_how_many_commits_are_missing(
    tmp_path: Path, missing: int, caplog: pytest.LogCaptureFixture
) -> None:
    path = left_by(tmp_path, "power", folded=5, more=0)
    opened(path, "power").close()
    with closing(sqlite3.connect(path)) as connection:
        ((id_, epoch, folded),) = connection.execute("SELECT id, epoch, folded FROM meta")
    noted = f"{id_} {epoch} tables {folded + missing:020} {folded + missing:020} {folded:020}"
    path.with_name("catalog.lock").write_text(f"1\n{noted} {zlib.crc32(noted.encode()):08x}\n")
    for durability in ("power", "process"):
        store = opened(path, durability)
        rows = len(rows_of(store.load()))
        store.commit([Put(Peer("more"))])
        store.close()
        assert len(read_rows(path)) == max(rows, 1 + 5 + 1)
    texts = warnings_in(caplog)
    assert len(texts) == bool(missing)
    assert all(f"its last {missing} commit(s) are missing" in text for text in texts)


def test_a_disk_without_room_leaves_the_record_of_a_catalog_as_it_was(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    witness = Witness(tmp_path, "app")
    witness.note(LastOpening("id", 1, "/nowhere"))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20, before[1]))
    try:
        witness.note(LastOpening("id", 2, "/nowhere"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert (tmp_path / ".catalogs" / ".app.new").stat().st_size == 20
    assert "File too large" in caplog.text
    assert witness.known() == LastOpening("id", 1, "/nowhere")
    witness.note(LastOpening("id", 3, "/nowhere"))
    assert witness.known() == LastOpening("id", 3, "/nowhere")


def test_a_power_cut_leaves_the_record_of_a_catalog_for_which_commits_survive_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Of what was not synced, it takes a file's content, and the new name of a file."""
    path, record, fsync = left_by(tmp_path, "power"), tmp_path / "left" / ".catalogs" / "app", os.fsync
    older = shutil.copytree(path.parent, tmp_path / "older")
    synced: list[tuple[int, bool]] = []  # what, and whether the new record had its name by then
    before = record.stat().st_ino

    def synced_to_disk(fd: int) -> None:
        synced.append((os.fstat(fd).st_ino, record.stat().st_ino != before))
        fsync(fd)

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", synced_to_disk)
        opened(path, "power").close()
    assert (record.stat().st_ino, False) in synced
    assert (record.parent.stat().st_ino, True) in synced
    shutil.rmtree(path.parent)
    shutil.copytree(older, path.parent)
    opened(path, "power").close()
    assert "it was put back from an older copy" in caplog.text


def test_a_power_cut_leaves_the_new_directories_of_a_catalog_for_which_commits_survive_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes the name of a directory from a directory above that was not synced."""
    state, fsync = tmp_path / "new" / "state", os.fsync
    synced: list[tuple[int, list[str]]] = []  # a directory, and what was in it

    def synced_to_disk(fd: int) -> None:
        if stat.S_ISDIR(os.fstat(fd).st_mode):
            synced.append((os.fstat(fd).st_ino, os.listdir(fd)))
        fsync(fd)

    monkeypatch.setattr(os, "fsync", synced_to_disk)
    open_state_dir(state).close()
    open_store(state / "app" / "catalog.sqlite3", durability="power").close()
    for directory in (state.parent, state, state / "app"):
        assert any(inode == directory.parent.stat().st_ino and directory.name in names for inode, names in synced)


def test_records_that_cannot_be_reached_are_told_of_and_hold_up_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / ".catalogs").write_bytes(b"something else")
    witness = Witness(tmp_path, "app")
    for use in (witness.known, lambda: witness.note(LastOpening("id", 1, "/nowhere")), lambda: witness.forget(1)):
        assert not use()
        assert "cannot be read or written" in caplog.text
        caplog.clear()


# -- catalogs that are not needed any more -----------------------------------------------------------------------------


def test_the_epochs_of_a_catalog_that_was_removed_are_not_used_again(tmp_path: Path) -> None:
    """A link or a line of an earlier incarnation must not be taken for one of a later."""
    path, witness = tmp_path / "app" / "catalog.sqlite3", Witness(tmp_path, "app")
    other = tmp_path / "other" / "catalog.sqlite3"
    epochs: list[int] = []
    for _ in range(4):
        for _ in range(3):
            store = open_store(path, witness=witness)
            epochs.append(store.epoch)
            store.close()
        remove_unneeded(path, witness)
        assert not path.parent.exists()
        open_store(other, witness=Witness(tmp_path, "other")).close()
        remove_unneeded(other, Witness(tmp_path, "other"))  # has epochs of its own, which change nothing
    assert epochs == sorted(set(epochs))


@pytest.mark.parametrize("spoil", [shutil.rmtree, lambda place: (place / "catalog.sqlite3").write_bytes(b"no catalog")])
def test_the_epochs_of_a_catalog_that_is_lost_are_not_used_again(
    tmp_path: Path, spoil: Callable[[Path], object]
) -> None:
    path, witness = tmp_path / "app" / "catalog.sqlite3", Witness(tmp_path, "app")
    for _ in range(3):
        fill(path)
    spoil(path.parent)
    store = open_store(path, witness=witness, on_damage="aside")
    assert store.epoch == 4
    store.close()


def test_a_catalog_that_has_committed_nothing_is_removed_without_being_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, witness = tmp_path / "app" / "catalog.sqlite3", Witness(tmp_path, "app")
    open_store(path, witness=witness).close()
    monkeypatch.setattr(opening, "open_store", None)
    remove_unneeded(path, witness)
    assert not path.parent.exists()


def test_a_catalog_with_a_row_is_not_removed_nor_one_that_is_open(tmp_path: Path) -> None:
    path, witness = tmp_path / "app" / "catalog.sqlite3", Witness(tmp_path, "app")
    store = open_store(path, witness=witness)
    with pytest.raises(CatalogLocked):
        remove_unneeded(path, witness)
    store.commit([Put(Peer("hub"))])
    store.close()
    remove_unneeded(path, witness)
    store = open_store(path, witness=witness)
    assert rows_of(store.load()) == [Peer("hub")]
    store.close()


@pytest.mark.parametrize("durability", ["process", "power"])
def test_a_crash_in_the_middle_of_a_removal_leaves_a_catalog_that_opens_and_that_nobody_misses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, durability: Durability
) -> None:
    path, witness = tmp_path / "app" / "catalog.sqlite3", Witness(tmp_path, "app")
    unlink, left = os.unlink, 0

    def dies(name: str, **options: int) -> None:
        nonlocal left
        left -= name.startswith("catalog.")
        if left < 0:
            raise KeyboardInterrupt
        unlink(name, **options)

    ends = 0
    for at in range(10):
        left = at
        store = open_store(path, durability=durability, witness=witness)
        with monkeypatch.context() as patch:
            patch.setattr(os, "unlink", dies)
            try:
                store.close(erase=True)
            except KeyboardInterrupt:
                ends += 1
        tell_of_missing(tmp_path)
        again = open_store(path, durability=durability, witness=witness)
        assert again.epoch > store.epoch
        again.close()
    assert 2 <= ends < 10
    assert caplog.messages == []


def test_an_opening_waits_for_no_directory_that_is_being_removed_and_makes_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "app" / "catalog.sqlite3"
    check_owner, removed = Folder.check_owner, 0

    def removed_meanwhile(folder: Folder) -> os.stat_result:
        nonlocal removed
        if removed < 2:
            removed += 1
            path.parent.rmdir()
        return check_owner(folder)

    monkeypatch.setattr(Folder, "check_owner", removed_meanwhile)
    with closing(open_store(path)) as store:
        store.commit([Put(Peer("hub"))])
    assert removed == 2
    assert read_rows(path) == [Peer("hub")]


def test_an_opening_that_meets_a_removal_finds_all_that_was_committed(tmp_path: Path) -> None:
    path, witness = tmp_path / "app" / "catalog.sqlite3", Witness(tmp_path, "app")
    ended = threading.Event()
    failures: list[BaseException] = []

    def remove() -> None:
        while not ended.is_set():
            try:
                remove_unneeded(path, witness)
            except CatalogLocked:
                pass
            except BaseException as error:
                failures.append(error)

    def opened_again() -> Store:
        while True:
            with suppress(CatalogLocked):
                return open_store(path, witness=witness)

    thread = threading.Thread(target=remove)
    thread.start()
    epochs = [0]
    try:
        for number in range(60):
            store = opened_again()
            assert rows_of(store.load()) == ([] if number % 2 == 0 else [Peer("hub")])
            assert store.epoch > epochs[-1]
            epochs.append(store.epoch)
            store.commit([Put(Peer("hub"))] if number % 2 == 0 else [Drop("peers", "hub")])
            store.close()
    finally:
        ended.set()
        thread.join()
    assert failures == []
