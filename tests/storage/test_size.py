"""What a catalog takes of the disk follows what is in it now, not what was in it once."""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import subprocess
import sys
import textwrap
import time
from contextlib import closing
from pathlib import Path

import pytest

from rr_actors.registrar.model.rows import Change, Drop, Phase, Put, Resource, ServedQuery, State, rows_of
from rr_actors.registrar.model.store import Store
from rr_actors.storage import sqlite_store
from rr_actors.storage.opening import Durability, open_store, read_rows
from support import REPOSITORY
from support_slow import few_now

FEW, MANY, PART = 10, 40_000, 2_000
SPARE_BYTES = 2 * 2**20
DURABILITIES: list[Durability] = ["process", "power"]


def put(number: int) -> list[Change]:
    id_ = f"{number:032}"
    return [
        Put(Resource(id_, "thing", b"x" * 40, b"y" * 40, Phase.LOADED, State.OK, "", 1)),
        Put(ServedQuery(id_, id_, "app", "", 1, number)),
    ]


def drop(number: int) -> list[Change]:
    id_ = f"{number:032}"
    return [Drop("queries", id_), Drop("resources", id_)]


def fill_and_empty(store: Store, first: int = FEW) -> int:
    """Put many rows and drop them again; return how large the directory was meanwhile."""
    largest = 0
    for change in (put, drop):
        for begin in range(first, first + MANY, PART):
            store.commit([each for number in range(begin, begin + PART) for each in change(number)])
            if store.wants_tidying():
                store.tidy()
            if begin == first + MANY - PART and change is put:
                largest = size_of(store)
    return largest


def size_of(store: Store) -> int:
    directory: Path = store.path.parent  # pyright: ignore[reportAttributeAccessIssue]  # of those that have one
    return sum(file.stat().st_size for file in directory.iterdir())


@pytest.mark.timeout(120)
@pytest.mark.parametrize("durability", DURABILITIES)
def test_what_was_filled_and_emptied_is_small_again(tmp_path: Path, durability: Durability) -> None:
    store = open_store(tmp_path / "app" / "catalog.sqlite3", durability=durability)
    store.commit([change for number in range(FEW) for change in put(number)])
    largest = fill_and_empty(store)
    store.tidy()
    assert largest > 4 * SPARE_BYTES
    assert size_of(store) < SPARE_BYTES
    assert {row.id for row in rows_of(store.load())} == {f"{number:032}" for number in range(FEW)}
    store.close()
    assert len(read_rows(tmp_path / "app" / "catalog.sqlite3")) == 2 * FEW


@pytest.mark.timeout(120)
def test_a_tool_that_reads_meanwhile_delays_that_and_fails_nothing(tmp_path: Path) -> None:
    path = tmp_path / "app" / "catalog.sqlite3"
    store = open_store(path)
    store.commit([change for number in range(FEW) for change in put(number)])
    store.tidy()
    with closing(sqlite3.connect(path, isolation_level=None)) as tool:
        tool.execute("BEGIN")
        (seen,) = tool.execute("SELECT count(*) FROM queries").fetchone()
        fill_and_empty(store)
        store.tidy()
        assert tool.execute("SELECT count(*) FROM queries").fetchone() == (seen,)
    store.commit(put(FEW))
    store.tidy()
    assert size_of(store) < SPARE_BYTES
    store.close()


PROGRAM = """
import sys
from pathlib import Path
from rr_actors.storage import sqlite_store
from rr_actors.storage.opening import open_store
import test_size

sqlite_store._SPARE_BYTES = 0
sqlite_store._TIDY_PAGES = 0
store = open_store(Path(sys.argv[1]), durability=sys.argv[2])
round = int(sys.argv[3]) * 1_000_000
while True:
    round += 100
    store.commit([change for number in range(round, round + 90) for change in test_size.put(number)])
    store.tidy()
    store.commit([change for number in range(round, round + 90) for change in test_size.drop(number)])
    print(round, flush=True)
    store.tidy()
"""


@pytest.mark.timeout(120)
@pytest.mark.parametrize("durability", few_now(["power"], ["process"]))
def test_a_process_that_is_killed_while_its_file_is_made_smaller_has_lost_nothing(
    tmp_path: Path, durability: Durability
) -> None:
    path = tmp_path / "app" / "catalog.sqlite3"
    store = open_store(path, durability=durability)
    store.commit([change for number in range(FEW) for change in put(number)])
    store.close()
    chance, paths = (
        random.Random(1),
        os.pathsep.join([str(REPOSITORY), str(Path(__file__).parent), str(REPOSITORY / "tests")]),
    )
    for attempt in range(1, 7):
        command = [sys.executable, "-c", textwrap.dedent(PROGRAM), str(path), durability, str(attempt)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, env={**os.environ, "PYTHONPATH": paths}) as program:
            assert program.stdout is not None
            for _ in range(3):
                assert program.stdout.readline()
            time.sleep(chance.uniform(0.0, 0.05))
            program.send_signal(signal.SIGKILL)
        found = {row.id for row in read_rows(path)}
        assert {f"{number:032}" for number in range(FEW)} <= found
        assert len(found) in (FEW, FEW + 90)
        store = open_store(path, durability=durability)
        left = sorted(int(id_) for id_ in found)[FEW:]
        store.commit([change for number in left for change in drop(number)])
        store.close()


def test_a_file_that_cannot_be_made_smaller_stays_and_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sqlite_store, "_SPARE_BYTES", -(10**9))
    monkeypatch.setattr(sqlite_store, "_SHRINK", "VACUUM INTO '/nowhere/at/all'")
    store = open_store(tmp_path / "app" / "catalog.sqlite3")
    store.commit(put(1))
    with pytest.raises(sqlite_store.CatalogError):
        store.tidy()
    store.commit(put(2))
    monkeypatch.undo()
    store.tidy()
    assert len(list(rows_of(store.load()))) == 4
    store.close()
