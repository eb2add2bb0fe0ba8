"""What another user has planted in the place of one of our files is not followed, waited for, emptied or changed."""

from __future__ import annotations

import os
import stat
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from rr_actors.base.errors import CatalogDamaged, CatalogError, ConfigError, RrError
from rr_actors.base.folder import Folder, NotAFile
from rr_actors.hosting.run_files import Watched
from rr_actors.registrar.model.rows import Peer, Put, rows_of
from rr_actors.storage.opening import open_store
from rr_actors.storage.witness import LastOpening, Witness
from rr_actors.wire.name_service import Directory, open_state_dir
from rr_actors.wire.unix_sockets import SocketDir

SECRET = b"what nobody may empty"


class Planted:
    """Something in the place of a file, and what it leads to."""

    def __init__(self, place: Path, target: Path, plant: Callable[[Path, Path], None]) -> None:
        self.place = place
        self.target = target
        target.write_bytes(SECRET)
        target.chmod(0o664)
        if place.exists() or place.is_symlink():
            place.unlink()
        plant(place, target)
        self._before = self._looks()

    def _looks(self) -> tuple[int, int, int]:
        found = self.place.lstat()
        return (found.st_ino, found.st_mode, found.st_size)

    def is_as_it_was(self) -> bool:
        """Whether neither of them has been touched."""
        target = (self.target.read_bytes(), stat.S_IMODE(self.target.stat().st_mode))
        return target == (SECRET, 0o664) and self._looks() == self._before

    def target_is_as_it_was(self) -> bool:
        return (self.target.read_bytes(), stat.S_IMODE(self.target.stat().st_mode)) == (SECRET, 0o664)


def link(place: Path, target: Path) -> None:
    place.symlink_to(target)


def dangling_link(place: Path, target: Path) -> None:
    place.symlink_to(target.with_name("not there"))


def pipe(place: Path, _target: Path) -> None:
    os.mkfifo(place)


def device(place: Path, _target: Path) -> None:
    """As root a device of its own; else nobody can make one, and a link to one is what there is."""
    if os.geteuid() == 0:
        os.mknod(place, stat.S_IFCHR | 0o666, os.makedev(1, 3))
    else:
        place.symlink_to("/dev/null")


def hard_link(place: Path, target: Path) -> None:
    place.hardlink_to(target)


def directory(place: Path, _target: Path) -> None:
    place.mkdir()


PLANTS = [link, dangling_link, pipe, device, hard_link, directory]

OF_A_CATALOG = [
    "catalog.lock",
    "catalog.sqlite3",
    "catalog.sqlite3-wal",
    "catalog.sqlite3-shm",
    "catalog.journal.1",
    "catalog.journal.7",
]


@pytest.fixture
def catalog(tmp_path: Path) -> Path:
    """A closed catalog with a row, in a directory that a group may write."""
    path = tmp_path / "shared" / "catalog.sqlite3"
    store = open_store(path)
    store.commit([Put(Peer("maker"))])
    store.close()
    path.parent.chmod(0o770)
    return path


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("name", OF_A_CATALOG)
@pytest.mark.timeout(20)
def test_what_is_planted_in_the_place_of_a_catalogs_file_is_refused_or_not_used_and_left_as_it_is(
    catalog: Path, tmp_path: Path, name: str, plant: Callable[[Path, Path], None]
) -> None:
    planted = Planted(catalog.with_name(name), tmp_path / "precious", plant)
    error = CatalogError if name == "catalog.lock" else CatalogDamaged
    with pytest.raises(error, match=name.replace(".", r"\.")):
        open_store(catalog)
    assert planted.is_as_it_was()
    assert stat.S_IMODE(catalog.parent.stat().st_mode) == 0o750, "the directory comes first"


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("name", [name for name in OF_A_CATALOG if name != "catalog.lock"])
def test_set_aside_it_is_renamed_and_what_it_leads_to_stays(
    catalog: Path, tmp_path: Path, name: str, plant: Callable[[Path, Path], None]
) -> None:
    planted = Planted(catalog.with_name(name), tmp_path / "precious", plant)
    store = open_store(catalog, on_damage="aside")
    assert rows_of(store.load()) == []
    store.close()
    assert planted.target_is_as_it_was()


@pytest.mark.parametrize("plant", PLANTS)
def test_what_is_planted_while_a_catalog_is_open_is_not_written_to(
    tmp_path: Path, plant: Callable[[Path, Path], None]
) -> None:
    catalog = tmp_path / "own" / "catalog.sqlite3"
    store = open_store(catalog)
    store.commit([Put(Peer("one"))])
    store.tidy()
    planted = Planted(catalog.with_name("catalog.journal.2"), tmp_path / "precious", plant)
    with pytest.raises(CatalogError, match=r"expected to write 1 change.* to its journal"):
        store.commit([Put(Peer("two"))])
    assert planted.target_is_as_it_was()
    store.close()
    assert planted.target_is_as_it_was()


@pytest.mark.parametrize("location", ["maker", "rooms/maker"])
def test_a_link_in_the_place_of_a_catalogs_own_directory_is_refused_and_what_it_leads_to_left_as_it_is(
    tmp_path: Path, location: str
) -> None:
    state, target = tmp_path / "state", tmp_path / "precious"
    state.mkdir()
    target.mkdir()
    (target / "maker").mkdir()
    target.chmod(0o775)
    (target / "maker").chmod(0o775)
    first = state / Path(location).parts[0]
    first.symlink_to(target)
    with pytest.raises(CatalogError, match="expected a directory of the catalog's own, got a symbolic link"):
        open_store(state / location / "catalog.sqlite3", witness=Witness(state, "maker"))
    assert first.is_symlink()
    assert [stat.S_IMODE(path.stat().st_mode) for path in (target, target / "maker")] == [0o775, 0o775]
    assert [path.name for path in target.rglob("*")] == ["maker"]


def test_a_location_that_a_user_has_chosen_may_be_a_link(tmp_path: Path) -> None:
    state, other = tmp_path / "state", tmp_path / "other"
    state.mkdir()
    other.mkdir()
    chosen = tmp_path / "chosen"
    chosen.symlink_to(other)
    store = open_store(chosen / "catalog.sqlite3", witness=Witness(state, "maker"))
    store.commit([Put(Peer("hub"))])
    store.close()
    assert (other / "catalog.sqlite3").exists()


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("name", ["catalog.sqlite3.new", "catalog.sqlite3.new-journal", "catalog.sqlite3-wal"])
def test_what_is_planted_before_a_catalog_is_made_is_not_written_to(
    tmp_path: Path, name: str, plant: Callable[[Path, Path], None]
) -> None:
    catalog = tmp_path / "own" / "catalog.sqlite3"
    catalog.parent.mkdir()
    planted = Planted(catalog.with_name(name), tmp_path / "precious", plant)
    try:
        store = open_store(catalog)
    except CatalogError:
        assert planted.is_as_it_was()
    else:
        store.close()
        assert planted.target_is_as_it_was()


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize("name", ["system.lock", "run", "run/watched", "run/names"])
@pytest.mark.timeout(20)
def test_what_is_planted_in_a_state_directory_is_refused_by_name_and_left_as_it_is(
    tmp_path: Path, name: str, plant: Callable[[Path, Path], None]
) -> None:
    state = tmp_path / "state"
    state.mkdir()
    state.chmod(0o770)
    if "/" not in name:
        if (name, plant) == ("run", directory):  # it is one
            return
        planted = Planted(state / name, tmp_path / "precious", plant)
        with pytest.raises(ConfigError, match=name):
            open_state_dir(state)
        assert planted.is_as_it_was()
        assert stat.S_IMODE(state.stat().st_mode) == 0o700, "the directory comes first"
        return
    opened = open_state_dir(state)
    try:
        planted = Planted(opened.run_dir / name.partition("/")[2], tmp_path / "precious", plant)
        if name == "run/watched":
            with pytest.raises(ConfigError, match="watched"):
                Watched(opened.run_dir)
            assert planted.is_as_it_was()
        elif plant is not directory:
            with pytest.raises(ConfigError, match="names"):
                Directory(opened.run_dir).publish("r.app", "1.sock")
            assert planted.is_as_it_was()
    finally:
        opened.close()
    assert planted.target_is_as_it_was()


@pytest.mark.parametrize("plant", PLANTS)
def test_what_is_planted_in_the_place_of_a_name_is_no_entry_and_is_replaced(
    tmp_path: Path, plant: Callable[[Path, Path], None]
) -> None:
    directory_ = Directory(tmp_path / "run")
    planted = Planted(tmp_path / "run" / "names" / "r.app", tmp_path / "precious", plant)
    assert directory_.lookup("r.app") is None
    try:
        directory_.publish("r.app", "1.sock")
    except ConfigError:
        assert plant is directory
    assert planted.target_is_as_it_was()


@pytest.mark.parametrize("plant", PLANTS)
def test_what_is_planted_in_the_place_of_a_socket_is_refused_and_left_as_it_is(
    tmp_path: Path, plant: Callable[[Path, Path], None]
) -> None:
    planted = Planted(tmp_path / "1.sock", tmp_path / "precious", plant)
    sockets = SocketDir(tmp_path)
    with pytest.raises(RrError, match=r"1\.sock"):
        sockets.bind("1.sock")
    with pytest.raises(OSError):
        sockets.connect("1.sock")
    sockets.close()
    assert planted.is_as_it_was()


@pytest.mark.parametrize("plant", PLANTS)
def test_what_is_planted_in_the_place_of_a_witness_is_not_used(
    tmp_path: Path, plant: Callable[[Path, Path], None], caplog: pytest.LogCaptureFixture
) -> None:
    witness = Witness(tmp_path, "app")
    witness.note(LastOpening("id", 1, "/nowhere"))
    planted = Planted(tmp_path / ".catalogs" / "app", tmp_path / "precious", plant)
    assert witness.known() is None
    assert "app" in caplog.text
    witness.note(LastOpening("id", 2, "/nowhere"))
    assert planted.target_is_as_it_was()


def test_a_pipe_that_comes_between_the_look_and_the_opening_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.mkfifo(tmp_path / "file")
    with Folder.at(tmp_path) as folder, monkeypatch.context() as patch:
        patch.setattr(Folder, "look", lambda *_: None)
        with pytest.raises(NotAFile, match="a pipe"):
            folder.open("file")


def test_a_link_that_comes_between_the_look_and_the_opening_is_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    planted = Planted(tmp_path / "file", tmp_path / "precious", link)
    with Folder.at(tmp_path) as folder, monkeypatch.context() as patch:
        patch.setattr(Folder, "look", lambda *_: None)
        with pytest.raises(OSError, match="symbolic links"):
            folder.open("file", os.O_RDWR | os.O_TRUNC | os.O_CREAT)
    assert planted.is_as_it_was()


def test_somebody_who_exchanges_a_file_all_the_time_gets_nothing_emptied(tmp_path: Path) -> None:
    """A link to what is precious and a file of its own, in turns, as fast as can be."""
    precious = tmp_path / "precious"
    precious.write_bytes(SECRET)
    place = tmp_path / "place"
    place.mkdir()
    ended = threading.Event()

    def exchange() -> None:
        while not ended.is_set():
            (place / "new").symlink_to(precious)
            (place / "new").rename(place / "file")
            (place / "new").write_bytes(b"ours")
            (place / "new").rename(place / "file")

    thread = threading.Thread(target=exchange)
    thread.start()
    refused = opened = 0
    try:
        with Folder.at(place) as folder:
            while refused < 20 or opened < 20:
                try:
                    folder.open("file", os.O_RDWR | os.O_CREAT | os.O_TRUNC).close()
                    opened += 1
                except OSError:
                    refused += 1
    finally:
        ended.set()
        thread.join()
    assert precious.read_bytes() == SECRET
