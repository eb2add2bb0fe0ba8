"""Flips: at each step of the folding of a catalog, each byte of each of its files is flipped, and the catalog opened.

Files are also cut off, emptied, removed, made zeros for a page, and put back as they were before. What another sound
file has is there each time, nothing is lost in silence, and what is said names the damaged file.

    python -m fuzz.flips [--step 1] [--durability process]
"""

from __future__ import annotations

import argparse
import functools
import itertools
import logging
import os
import shutil
import sqlite3
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

from fuzz.damage import Warnings
from rr_actors.base.errors import CatalogError
from rr_actors.registrar.model.rows import Change, Phase, Put, Resource, Row, ServedQuery, State, rows_of
from rr_actors.storage.opening import Durability, open_store
from rr_actors.storage.sqlite_store import segments_among
from rr_actors.storage.witness import Witness

_NAME = "catalog.sqlite3"
_PAGE = 4096
_WRITING = ("open", "pwrite", "ftruncate", "unlink", "rename", "replace")

Rows = frozenset[Row]


class Stage(NamedTuple):
    """A catalog as a kill at some moment leaves it.

    `rows`: what it has. `possible`: its rows after each commit that its SQLite file may not have without its -wal.
    `is_folded`: whether the file and its -wal have all.
    """

    name: str
    directory: Path
    rows: Rows
    possible: frozenset[Rows]
    is_folded: bool


def _changes(number: int) -> list[Change]:
    id_ = f"r{number:03}"
    return [
        Put(ServedQuery(id_, id_, "app", "", 1, number)),
        Put(Resource(id_, "thing", id_.encode() * 200, None, Phase.LOADED, State.OK, "", 1)),
    ]


# -- the stages ----------------------------------------------------------------------------------------------------


class _Recorder:
    """Plays a history on a catalog, and copies its directory whenever a step is about to be done."""

    def __init__(self, place: Path, durability: Durability, watched: ExitStack) -> None:
        self.live = place / "live"
        self.path = self.live / "app" / _NAME
        self.stages: list[Stage] = []
        self._doing = ""
        self._place = place
        self._seen: set[tuple[tuple[str, bytes], ...]] = set()
        watched.enter_context(_each_step(self.live, self._before))
        self._store = open_store(self.path, durability=durability, witness=Witness(self.live, "app"))
        self._states: list[Rows] = [frozenset()]
        self._safe = 0  # how many states the SQLite file has for certain
        self._folded = 0
        self._next = 0

    def commit(self, count: int) -> None:
        for _ in range(count):
            changes = _changes(self._next)
            self._store.commit(changes)
            self._states.append(self._states[-1] | {change.row for change in changes if isinstance(change, Put)})
            self._next += 1

    def copy(self, name: str) -> None:
        """Add a stage, unless all files but the -shm are those of an earlier one."""
        files = sorted(file for file in self.live.rglob("*") if file.is_file() and not file.name.endswith("-shm"))
        found = tuple((str(file), file.read_bytes()) for file in files)
        if found in self._seen:
            return
        self._seen.add(found)
        directory = self._place / "stages" / str(len(self.stages))
        shutil.copytree(self.live, directory)
        possible = frozenset(self._states[self._safe :])
        self.stages.append(Stage(name, directory, self._states[-1], possible, self._folded == self._next))

    def do(self, name: str, do: Callable[[], None]) -> None:
        """Copy the catalog before each step of `do`, and after the last."""
        self._doing = name
        do()
        self._doing = ""
        self.copy(f"after {name}")

    def _before(self, what: str) -> None:
        if self._doing:
            self.copy(f"{self._doing}, before {what}")

    def fold(self) -> None:
        self._store.upkeep()
        self._folded = self._next

    def settle(self) -> None:
        self._store.tidy()
        self._safe = self._folded = self._next

    def close(self) -> None:
        self._store.close()
        self._safe = self._folded = self._next


@contextmanager
def _each_step(directory: Path, before: Callable[[str], None]) -> Generator[None]:
    """Call `before` before each operation on a file below `directory`, and each statement of SQLite."""
    is_busy = False

    def step(what: str) -> None:
        nonlocal is_busy
        if not is_busy:
            is_busy = True
            try:
                before(what)
            finally:
                is_busy = False

    connect, real = sqlite3.connect, {name: getattr(os, name) for name in _WRITING}

    def watched(name: str) -> Callable[..., Any]:
        def operation(file: Any, *args: Any, **options: Any) -> Any:
            place = os.readlink(f"/proc/self/fd/{file}") if isinstance(file, int) else os.fsdecode(file)
            if name != "open" or args[0] & (os.O_WRONLY | os.O_RDWR):
                step(f"{name} {Path(place).name}")
            return real[name](file, *args, **options)

        return operation

    class Cursor(sqlite3.Cursor):
        def execute(self, sql: str, parameters: Any = (), /) -> sqlite3.Cursor:
            step(sql.split("(")[0].split(" VALUES")[0])
            return super().execute(sql, parameters)

    class Connection(sqlite3.Connection):
        def cursor(self, factory: Any = Cursor) -> Any:
            return super().cursor(factory)

        def execute(self, sql: str, parameters: Any = (), /) -> sqlite3.Cursor:
            return self.cursor().execute(sql, parameters)

    with ExitStack() as patched:
        for name in _WRITING:
            patched.enter_context(mock.patch.object(os, name, watched(name)))
        patched.enter_context(mock.patch.object(sqlite3, "connect", functools.partial(connect, factory=Connection)))
        yield


def stages(place: Path, durability: Durability) -> list[Stage]:
    """Make a catalog, and return what each step of its folding, settling and closing can leave."""
    with ExitStack() as watched:
        history = _Recorder(place, durability, watched)
        _play(history)
    return list(_with_half_copied(history.stages, place))


def _play(history: _Recorder) -> None:
    history.commit(3)
    history.copy("never folded")
    history.do("first folding", history.fold)
    history.do("first settling", history.settle)
    for _ in range(3):
        history.commit(4)
        history.fold()
    history.commit(2)
    history.copy("folded thrice, and two commits")
    history.do("folding", history.fold)
    history.do("settling", history.settle)
    history.commit(2)
    history.do("closing", history.close)


def _with_half_copied(found: list[Stage], place: Path) -> Iterator[Stage]:
    """Yield the stages, and between them those in which SQLite has copied a part of the -wal's pages."""
    for before, after in itertools.pairwise(found):
        yield before
        old, new = (stage.directory / "app" / _NAME for stage in (before, after))
        spare = old.with_name(f"{_NAME}.spare-wal")
        if not (spare.exists() and old.exists() and old.read_bytes() != new.read_bytes()):
            continue
        data, newer = old.read_bytes(), new.read_bytes()
        pages = len(newer) // _PAGE
        for count in sorted({1, pages // 2, pages - 1}):
            directory = place / "stages" / f"{before.directory.name}-{count}"
            shutil.copytree(before.directory, directory)
            mixed = newer[: count * _PAGE] + data[count * _PAGE :]
            (directory / "app" / _NAME).write_bytes(mixed)
            yield before._replace(name=f"{before.name}, {count} of {pages} pages copied", directory=directory)
    yield found[-1]


# -- what is done to a file ----------------------------------------------------------------------------------------


def _hurts(file: Path, earlier: bytes | None, step: int, begin: int) -> Iterator[tuple[str, bytes | None]]:
    """Yield what is done to the file, and what it has then; None: it is removed."""
    data = file.read_bytes()
    for at in range(begin % step, len(data), step):
        changed = bytearray(data)
        changed[at] ^= 1 << at % 8
        yield f"byte {at} flipped", bytes(changed)
    yield "removed", None
    yield "emptied", b""
    yield "cut in half", data[: len(data) // 2]
    if len(data) > _PAGE:
        page = begin % (len(data) // _PAGE) * _PAGE
        yield f"zeros from byte {page} on", data[:page] + bytes(_PAGE) + data[page + _PAGE :]
    if earlier not in (None, data):
        yield "put back as it was before", earlier


# -- what comes of it ----------------------------------------------------------------------------------------------


def _opened(path: Path, durability: Durability, warnings: list[str]) -> tuple[Rows | None, str]:
    """Open a catalog; return its rows, None if it is refused, and what is said."""
    warnings.clear()
    try:
        store = open_store(path, durability=durability, witness=Witness(path.parent.parent, "app"))
    except CatalogError as error:
        return None, str(error)
    try:
        return frozenset(rows_of(store.load())), "\n".join(warnings)
    finally:
        store.close()


def _wrong(stage: Stage, file: Path, rows: Rows | None, text: str, durability: Durability, *, at_end: bool) -> str:
    """Return what must not have come of damage to the file; "" if all is well."""
    newest = segments_among(os.listdir(stage.directory / "app"), file.with_name(_NAME))[-1:]
    is_alone = file.name == _NAME or ([file.name] == newest and not stage.is_folded)
    is_alone = is_alone or (durability == "power" and file.name.endswith("-wal"))
    if text and file.name not in text:
        return f"what is said names another file: {text}"
    if rows == stage.rows:
        return ""
    if not text and not (at_end and rows in stage.possible):
        return "SILENCE" if rows is not None else "refused without a word"
    if not is_alone:
        return f"other files have what is lost: {text}"
    if rows is not None and file.name != _NAME and rows not in stage.possible:
        return f"{len(rows)} rows, which there were after no commit: {text}"
    return ""


def sweep(
    place: Path, durability: Durability, *, step: int, chosen: Callable[[int, Stage], bool] = lambda *_: True
) -> tuple[Counter[str], list[str]]:
    """Hurt each file of each chosen stage; return how often what came of it, and what must not have been.

    Args:
        place: an empty directory.
        step: each byte whose number is a multiple of this, moved by one for each file, is flipped.
    """
    counts: Counter[str] = Counter()
    failures: list[str] = []
    handler, logger = Warnings(), logging.getLogger("rr_actors.storage")
    logger.addHandler(handler)
    propagates, logger.propagate = logger.propagate, False
    earlier: dict[str, bytes] = {}
    try:
        for number, stage in enumerate(stages(place, durability)):
            files = sorted(file for file in (stage.directory / "app").iterdir() if file.is_file())
            if chosen(number, stage):
                untouched, text = _hurt_and_opened(stage, None, b"", durability, handler.texts)
                if untouched != stage.rows or text:
                    failures.append(f"{stage.name}: untouched: {text or untouched}")
                for file in files:
                    for what, data in _hurts(file, earlier.get(file.name), step, number):
                        rows, text = _hurt_and_opened(stage, file, data, durability, handler.texts)
                        at_end = not what.startswith("byte")  # it may have been cut off at the end of a record
                        wrong = _wrong(stage, file, rows, text, durability, at_end=at_end)
                        if wrong:
                            failures.append(f"{stage.name}: {file.name} {what}: {wrong}")
                        counts["refused" if rows is None else "right" if rows == stage.rows else "warned"] += 1
            earlier |= {file.name: file.read_bytes() for file in files}
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagates
    return counts, failures


def _hurt_and_opened(
    stage: Stage, file: Path | None, data: bytes | None, durability: Durability, warnings: list[str]
) -> tuple[Rows | None, str]:
    work = stage.directory.parent.with_name("work")
    shutil.copytree(stage.directory, work)
    try:
        if file is not None and data is None:
            (work / "app" / file.name).unlink()
        elif file is not None and data is not None:
            (work / "app" / file.name).write_bytes(data)
        return _opened(work / "app" / _NAME, durability, warnings)
    finally:
        shutil.rmtree(work)


def main() -> int:
    """Run it from the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m fuzz.flips", description="Flip each byte of a catalog's files.")
    parser.add_argument("--step", type=int, default=1, help="1: each byte; 100: each hundredth")
    parser.add_argument("--durability", choices=("process", "power"), default="process")
    options = parser.parse_args()
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(prefix="rr-flips-", dir=memory if os.access(memory, os.W_OK) else None) as place:
        counts, failures = sweep(Path(place), options.durability, step=options.step)
    for failure in failures:
        print(failure)
    print(f"{sum(counts.values())} times: {dict(counts)}; {len(failures)} must not have been")
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
