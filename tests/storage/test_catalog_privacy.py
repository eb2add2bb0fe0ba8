"""A catalog is one user's: what others could write is tightened, or refused and left as it is."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors.base.errors import CatalogError
from rr_actors.registrar.model.rows import Peer, Put, rows_of
from rr_actors.storage.opening import open_store
from support_stores import belonging_to_another


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


@pytest.fixture
def catalog(tmp_path: Path) -> Path:
    """A closed catalog with a row."""
    path = tmp_path / "elsewhere" / "catalog.sqlite3"
    store = open_store(path)
    store.commit([Put(Peer("maker"))])
    store.close()
    return path


def test_files_that_others_may_read_are_tightened_when_they_are_opened(catalog: Path) -> None:
    catalog.chmod(0o666)
    lock = catalog.with_suffix(".lock")
    lock.chmod(0o644)
    store = open_store(catalog)
    try:
        assert rows_of(store.load()) == [Peer("maker")]
        assert {mode_of(path) for path in catalog.parent.iterdir()} == {0o600}
    finally:
        store.close()


@pytest.mark.parametrize(("loose", "tight"), [(0o777, 0o755), (0o770, 0o750), (0o755, 0o755), (0o700, 0o700)])
def test_a_directory_that_others_may_write_is_tightened(catalog: Path, loose: int, tight: int) -> None:
    catalog.parent.chmod(loose)
    open_store(catalog).close()
    assert mode_of(catalog.parent) == tight


def test_a_directory_that_all_share_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    with pytest.raises(CatalogError, match=f"{shared}: .*that all share .*choose a directory in it"):
        open_store(shared / "catalog.sqlite3")
    assert mode_of(shared) == 0o1777
    assert list(shared.iterdir()) == []


@pytest.mark.parametrize("what", ["the directory", "the catalog", "a -wal", "the lock", "a segment"])
def test_what_belongs_to_another_user_is_refused_and_left_as_it_is(catalog: Path, what: str) -> None:
    names = {"a -wal": "catalog.sqlite3-wal", "the lock": "catalog.lock"}
    names |= {"a segment": "catalog.journal.1", "the catalog": "catalog.sqlite3"}
    theirs = catalog.parent if what == "the directory" else catalog.with_name(names[what])
    theirs.touch()
    theirs.chmod(0o755 if what == "the directory" else 0o644)
    mode, content = mode_of(theirs), catalog.read_bytes()
    with (
        belonging_to_another(theirs),
        pytest.raises(CatalogError, match=rf"{theirs}: expected to belong to user {os.geteuid()}"),
    ):
        open_store(catalog)
    assert mode_of(theirs) == mode
    assert catalog.read_bytes() == content


def test_a_registrar_whose_location_all_share_does_not_open(tmp_path: Path) -> None:
    shared = tmp_path / "shared"
    shared.mkdir()
    shared.chmod(0o1777)
    with rr.System(state_dir=tmp_path / "state") as system:
        with pytest.raises(CatalogError, match="all share"):
            system.open_registrar("app", rr.RegistrarConfig("app", location=shared))
        assert system.open_registrar("other").name == "other"
