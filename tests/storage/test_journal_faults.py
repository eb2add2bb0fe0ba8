"""A fault at every single operation on a file: what was acknowledged is there, and the next attempt works."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import pytest

from rr_actors.base.errors import CatalogError
from rr_actors.registrar.model.rows import Change, Drop, Peer, Put, Row, rows_of
from rr_actors.registrar.model.store import Store
from rr_actors.storage import catalog_lock
from rr_actors.storage.journaled_store import JournaledStore
from rr_actors.storage.opening import open_store, read_rows
from rr_actors.storage.sqlite_store import SqliteTables
from support_stores import Rows, after, in_order, part, query

DISK = ("open", "pwrite", "ftruncate", "unlink", "rename", "replace")
REAL = {name: getattr(os, name) for name in DISK}
CONNECT = sqlite3.connect
_WRITING = "pwrite catalog.journal"


class Crash(BaseException):
    """The process is dead: nothing catches this, and nothing that it tries from then on is done."""


class Faults:
    """Counts the operations on files below a directory and in SQLite, and has one of them go wrong.

    Attributes:
        at: the number of that operation, from 1; 0 for none.
        how: what happens then.
        log: what there was.
        hit: whether that has happened.
        dead: whether the process is as good as dead.
    """

    def __init__(self, directory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.directory = directory
        self.at = 0
        self.how: How = _as_ever
        self.log: list[str] = []
        self.hit = False
        self.dead = False
        for name in DISK:
            monkeypatch.setattr(os, name, self._operation(name))
        faults = self

        class Cursor(sqlite3.Cursor):
            def execute(self, sql: str, parameters: Any = (), /) -> sqlite3.Cursor:
                return faults.do(f"SQLite: {sql.split()[0]}", lambda _: sqlite3.Cursor.execute(self, sql, parameters))

        class Connection(sqlite3.Connection):
            def cursor(self, factory: Any = Cursor) -> Any:
                return super().cursor(factory)

            def execute(self, sql: str, parameters: Any = (), /) -> sqlite3.Cursor:
                return self.cursor().execute(sql, parameters)

        def connect(place: Any, **options: Any) -> sqlite3.Connection:
            return CONNECT(place, **options, factory=sqlite3.Connection if place == ":memory:" else Connection)

        monkeypatch.setattr(sqlite3, "connect", connect)

    def arm(self, at: int, how: How) -> None:
        self.at, self.how, self.log, self.hit = at, how, [], False

    def disarm(self) -> None:
        self.at, self.dead = 0, False

    def do(self, what: str, do: Callable[[int | None], Any]) -> Any:
        if self.dead:
            raise Crash
        self.log.append(what)
        if len(self.log) != self.at:
            return do(None)
        self.hit = True
        return self.how(self, what, do)

    def crash(self) -> NoReturn:
        left_by(self.directory)
        self.dead = True
        raise Crash

    def _operation(self, name: str) -> Callable[..., Any]:
        real = REAL[name]

        def operation(file: Any, *args: Any, **options: Any) -> Any:
            path = Path(os.readlink(f"/proc/self/fd/{file}") if isinstance(file, int) else os.fsdecode(file))
            directory = options.get("dir_fd", options.get("src_dir_fd"))
            if directory is not None:
                path = Path(os.readlink(f"/proc/self/fd/{directory}")) / path
            to_read = name == "open" and not args[0] & (os.O_WRONLY | os.O_RDWR)
            if to_read or not path.is_relative_to(self.directory):
                return real(file, *args, **options)

            def do(size: int | None) -> Any:
                """With a size, only so much of what there is to write."""
                return real(file, *args, **options) if size is None else real(file, args[0][:size], *args[1:])

            return self.do(f"{name} {path.name}", do)

        return operation


How = Callable[[Faults, str, Callable[[int | None], Any]], Any]


def _as_ever(_faults: Faults, _what: str, do: Callable[[int | None], Any]) -> Any:
    return do(None)


class Run:
    """A history, played on a catalog: what is acknowledged, and what is under way.

    Args:
        left: the directory of a catalog that a crash has left, to begin with.
        rows: what is in it.
    """

    def __init__(self, path: Path, left: Path | None = None, rows: Rows | None = None) -> None:
        self.path = path
        if left is not None:
            shutil.copytree(left, path.parent)
        self.store: Store | None = None
        self.rows: Rows = rows or {}
        self.next: Rows | None = None  # what it will be if what is under way is done

    @property
    def possible(self) -> list[list[Row]]:
        """What may be on disk."""
        states = [self.rows] if self.next is None else [self.rows, self.next]
        return [in_order(rows.values()) for rows in states]

    def play(self, step: Any) -> None:
        match step:
            case "open" | "open for power":
                self.store = open_store(self.path, durability="power" if "power" in step else "process")
                assert in_order(rows_of(self.store.load())) in self.possible
            case "tidy":
                assert self.store is not None
                self.store.tidy()
            case "fold":
                assert self.store is not None
                self.store.upkeep()
            case "close" | "erase":
                store, self.store = self.store, None
                assert store is not None
                self.next = {} if step == "erase" else None
                store.close(erase=step == "erase")
                self._done()
            case changes:
                assert self.store is not None
                self.next = after(self.rows, changes)
                self.store.commit(changes)
                self._done()

    def play_all(self, history: Sequence[Any]) -> None:
        for step in history:
            self.play(step)

    def _done(self) -> None:
        if self.next is not None:
            self.rows, self.next = self.next, None

    def forget(self) -> None:
        """Let go of everything, and remove it."""
        if self.store is not None:
            self.store.close()
        for lock in catalog_lock.held():
            lock.release()
        shutil.rmtree(self.path.parent, ignore_errors=True)


A: list[Change] = [Put(query("a")), Put(part("r", b"x" * 3000))]
B: list[Change] = [Put(query("b")), Drop("queries", "a"), Put(Peer("hub"))]
C: list[Change] = [Put(query("a", 7)), Drop("resources", "r")]
D: list[Change] = [Put(query(f"d{n}", n)) for n in range(40)]
E: list[Change] = [Drop("queries", f"d{n}") for n in range(40)]
HISTORY: list[Any] = [
    "open", A, B, "tidy", C, "tidy", D, E, "close", "open", A, D, "tidy", "fold", B, "fold", C, "fold", A, "close",
    "open for power", C, D, "tidy", "close", "open", E, A, "erase", "open", B, "tidy", C, "close",
]  # fmt: skip


AFTER_A_CRASH: list[Any] = ["open", D, "close"]
AFTER_A_CRASH_FOR_POWER: list[Any] = ["open for power", D, "close"]


class Scene(NamedTuple):
    """Where a history is played, again and again."""

    path: Path
    faults: Faults
    history: Sequence[Any]
    left: Path | None
    rows: Rows

    def run(self) -> Run:
        return Run(self.path, self.left, self.rows)

    def operations(self) -> list[str]:
        """What happens when nothing goes wrong."""
        run = self.run()
        run.play_all(self.history)
        log = list(self.faults.log)
        run.forget()
        return log


@pytest.fixture(params=["from nothing", "after a crash", "after a crash, for power"])
def scene(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Scene]:
    with monkeypatch.context() as patch:
        path = tmp_path / "live" / "catalog.sqlite3"
        left, rows = (None, {}) if request.param == "from nothing" else crashed(tmp_path / "left", patch)
        histories = {"from nothing": HISTORY, "after a crash": AFTER_A_CRASH}
        history = histories.get(request.param, AFTER_A_CRASH_FOR_POWER)
        yield Scene(path, Faults(path.parent, patch), history, left, rows)


def crashed(directory: Path, patch: pytest.MonkeyPatch) -> tuple[Path, Rows]:
    """A catalog with something folded, a segment that is folded and still there, and three that are not."""
    run = Run(directory / "catalog.sqlite3")
    run.play_all(["open", A, D])
    assert isinstance(run.store, JournaledStore)
    with patch.context() as full:
        full.setattr(os, "unlink", lambda *_, **__: _raise(OSError(errno.EIO, "broken")))
        run.play("tidy")
        full.setattr(SqliteTables, "fold", lambda *_: _raise(CatalogError("full", path="")))
        for changes in (B, C, E):
            run.play(changes)
            with contextlib.suppress(CatalogError):
                run.play("tidy")
        run.play(B)
    left = left_by(directory).parent.rename(directory.with_name("crashed"))
    assert sorted(path.name for path in left.glob("*journal*")) == [f"catalog.journal.{n}" for n in range(1, 6)]
    run.forget()
    return left, run.rows


def _raise(error: Exception) -> NoReturn:
    raise error


def left_by(directory: Path) -> Path:
    """A copy of the directory as it is now; return the catalog in it."""
    copy = directory.with_name("copy")
    shutil.rmtree(copy, ignore_errors=True)
    if directory.exists():
        shutil.copytree(directory, copy)
    return copy / "catalog.sqlite3"


def check(path: Path, possible: list[list[Row]], where: str) -> None:
    """What a crash left is read, opens, has one of the possible states, takes a commit, and is whole again."""
    assert in_order(read_rows(path)) in possible, where
    store = open_store(path)
    found = in_order(rows_of(store.load()))
    assert found in possible, where
    store.commit([Put(Peer("after"))])
    store.close()
    left = sorted(file.name for file in path.parent.iterdir() if not file.name.startswith("catalog.sqlite3.new"))
    assert left == ["catalog.lock", "catalog.sqlite3"], where
    assert in_order(read_rows(path)) == in_order([*found, Peer("after")]), where


# -- crashes -------------------------------------------------------------------------------------------------------


def dies_before(faults: Faults, _what: str, _do: Callable[[int | None], Any]) -> NoReturn:
    faults.crash()


def dies_after(faults: Faults, _what: str, do: Callable[[int | None], Any]) -> NoReturn:
    with contextlib.suppress(FileNotFoundError):
        do(None)
    faults.crash()


def dies_in_the_middle(faults: Faults, what: str, do: Callable[[int | None], Any]) -> NoReturn:
    do(20 if what.startswith(_WRITING) else None)
    faults.crash()


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("how", [dies_before, dies_after, dies_in_the_middle])
def test_a_crash_at_any_operation_leaves_what_was_acknowledged_or_one_commit_more(scene: Scene, how: How) -> None:
    log = scene.operations()
    assert len(log) > 15
    for at, what in enumerate(log, 1):
        if how is dies_in_the_middle and not what.startswith(_WRITING):
            continue
        scene.faults.arm(at, how)
        run = scene.run()
        with pytest.raises(Crash):
            run.play_all(scene.history)
        scene.faults.disarm()
        check(scene.path.parent.with_name("copy") / scene.path.name, run.possible, f"operation {at}, {what}")
        run.forget()


# -- errors --------------------------------------------------------------------------------------------------------


def no_space(faults: Faults, what: str, do: Callable[[int | None], Any]) -> NoReturn:
    if what.startswith("SQLite"):
        _sqlite_error("database or disk is full", sqlite3.SQLITE_FULL)
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def broken(faults: Faults, what: str, do: Callable[[int | None], Any]) -> NoReturn:
    if what.startswith("SQLite"):
        _sqlite_error("disk I/O error", sqlite3.SQLITE_IOERR)
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def short(_faults: Faults, what: str, do: Callable[[int | None], Any]) -> Any:
    """The rest is written at the next attempt."""
    return do(20 if what.startswith(_WRITING) else None)


def short_and_full(faults: Faults, what: str, do: Callable[[int | None], Any]) -> Any:
    if not what.startswith(_WRITING):
        return do(None)
    faults.arm(1, no_space)
    return do(20)


def short_and_broken_for_good(faults: Faults, what: str, do: Callable[[int | None], Any]) -> Any:
    """What it has left cannot even be cut off again."""
    if not what.startswith(_WRITING):
        return do(None)

    def and_again(faults: Faults, what: str, do: Callable[[int | None], Any]) -> NoReturn:
        faults.arm(1, broken)
        broken(faults, what, do)

    faults.arm(1, and_again)
    return do(20)


def _sqlite_error(text: str, code: int) -> NoReturn:
    error = sqlite3.OperationalError(text)
    error.sqlite_errorcode = code
    raise error


@pytest.mark.slow
@pytest.mark.timeout(240)
@pytest.mark.parametrize("how", [no_space, broken, short, short_and_full, short_and_broken_for_good])
def test_an_error_at_any_operation_changes_nothing_and_the_next_attempt_works(scene: Scene, how: How) -> None:
    path, faults = scene.path, scene.faults
    errors = 0
    for at, what in enumerate(scene.operations(), 1):
        if how in (short, short_and_full, short_and_broken_for_good) and not what.startswith(_WRITING):
            continue
        where = f"operation {at}, {what}"
        faults.arm(at, how)
        run = scene.run()
        looks = 3  # after the error
        for step in scene.history:
            before, opened = run.rows, run.store
            try:
                run.play(step)
            except CatalogError as error:
                errors += 1
                named = str(path) in str(error)
                assert named, where
                _is_as_before(run, before, opened, where)
                if step not in ("close", "erase"):
                    run.play(step)
            if faults.hit:
                looks -= 1
                assert in_order(read_rows(path)) == in_order(run.rows.values()), where
                if path.exists():
                    check(left_by(path.parent), run.possible, where)
                if not looks:
                    break
        faults.disarm()
        assert faults.hit
        run.forget()
    assert errors or how is short or scene.history is AFTER_A_CRASH_FOR_POWER


def _is_as_before(run: Run, before: Rows, opened: Store | None, where: str) -> None:
    if run.store is None and opened is not None:  # closing; one that was to be erased may be gone
        run.rows = after({}, map(Put, read_rows(run.path)))
        assert in_order(run.rows.values()) in run.possible, where
        run.next = None
        return
    run.next = None
    assert in_order(read_rows(run.path)) == in_order(before.values()), where
    if opened is not None:
        assert in_order(rows_of(opened.load())) == in_order(before.values()), where
