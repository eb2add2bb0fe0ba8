"""Durability "power" on a model of a disk that loses what no fsync has covered, and whose fdatasync fails.

The model records what the store writes, makes, renames, removes and syncs through Python. SQLite writes its files past
it: they are as SQLite promises to leave them. An image is what a power cut may leave: any of the writes, and any of the
directory's changes, that were not synced.
"""

from __future__ import annotations

import errno
import os
import random
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rr_actors.base.errors import CatalogError
from rr_actors.registrar.model.rows import Change, Content, Drop, Put, ServedQuery, apply, content_of
from rr_actors.registrar.model.store import Store
from rr_actors.storage.opening import Durability, open_store

CATALOG = "catalog.sqlite3"
OF_SQLITE = (CATALOG, f"{CATALOG}-wal", f"{CATALOG}-shm")


@dataclass
class Write:
    """A write or a truncation of a file: on the disk, not yet, or lost by a failed sync, but perhaps there."""

    at: int
    data: bytes | None
    state: Literal["sure", "open", "failed"] = "open"


@dataclass
class File:
    """A file that the store writes: `whole` is its content at the last sync if it is not written by os.pwrite."""

    fd: int
    writes: list[Write] = field(default_factory=list)
    whole: bytes = b""

    def content(self) -> bytes:
        return os.pread(self.fd, os.fstat(self.fd).st_size, 0)

    def synced(self) -> None:
        self.whole = self.content()
        for write in self.writes:
            if write.state == "open":
                write.state = "sure"

    def after_a_cut(self, chance: random.Random) -> bytes:
        if not self.writes:
            now = self.content()
            return chance.choice([self.whole, now, now[: chance.randint(0, len(now))]]) if now != self.whole else now
        left = bytearray()
        for write in self.writes:
            if write.state != "sure" and chance.random() < 0.5:
                continue
            if write.data is None:
                del left[write.at :]
            left.extend(bytes(max(0, write.at - len(left))))
            if write.data is not None:
                left[write.at : write.at + len(write.data)] = write.data
        return bytes(left)


class Disk:
    """What the disk has for certain, and what it may have. `at_sync` is called before each sync."""

    def __init__(self, place: Path, patch: pytest.MonkeyPatch, at_sync: Callable[[], None]) -> None:
        self.place = place
        self.files: dict[int, File] = {}
        self.entries: dict[str, int] = {}  # that a sync of the directory has covered
        self.wal_kept = 0  # bytes of the -wal that SQLite has synced
        self.wal_before = b""  # it may be back after it was emptied
        self.syncs = 0
        self.fails: Callable[[int], bool] = lambda _: False
        self._at_sync = at_sync
        self.busy = False
        self._os: dict[str, Any] = {
            name: getattr(os, name) for name in ("open", "pwrite", "ftruncate", "fsync", "fdatasync")
        }
        patch.setattr(os, "open", self._open)
        patch.setattr(os, "pwrite", self._pwrite)
        patch.setattr(os, "ftruncate", self._ftruncate)
        patch.setattr(os, "fsync", self._sync("fsync"))
        patch.setattr(os, "fdatasync", self._sync("fdatasync"))

    def close(self) -> None:
        for file in self.files.values():
            os.close(file.fd)

    def _open(self, path: Any, flags: int, mode: int = 0o777, *, dir_fd: int | None = None) -> int:
        fd = self._os["open"](path, flags, mode, dir_fd=dir_fd)
        if not self.busy and flags & os.O_CREAT and (inode := os.fstat(fd).st_ino) not in self.files:
            self.files[inode] = File(self._os["open"](f"/proc/self/fd/{fd}", os.O_RDONLY))  # keeps the inode
        return fd

    def _pwrite(self, fd: int, data: bytes, at: int) -> int:
        written = self._os["pwrite"](fd, data, at)
        if (file := self.files.get(os.fstat(fd).st_ino)) is not None:
            file.writes.append(Write(at, bytes(data[:written])))
        return written

    def _ftruncate(self, fd: int, size: int) -> None:
        self._os["ftruncate"](fd, size)
        if (file := self.files.get(os.fstat(fd).st_ino)) is not None:
            file.writes.append(Write(size, None))

    def _sync(self, name: str) -> Callable[[int], None]:
        def sync(fd: int) -> None:
            if self.busy:
                return
            self.busy = True
            self.look_at_wal()
            try:
                self._at_sync()
            finally:
                self.busy = False
            self.syncs += 1
            inode, fails = os.fstat(fd).st_ino, self.fails(self.syncs)
            if fails and (file := self.files.get(inode)) is not None:
                for write in file.writes:
                    if write.state == "open":
                        write.state = "failed"
            if fails:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            if inode == self.place.stat().st_ino:
                self.entries = self.names()
            elif (file := self.files.get(inode)) is not None:
                file.synced()

        return sync

    def names(self) -> dict[str, int]:
        return {entry.name: entry.inode() for entry in os.scandir(self.place)}

    def opened(self) -> None:
        """SQLite has synced its -wal, and the directory for it."""
        wal = self.place / OF_SQLITE[1]
        self.wal_kept = wal.stat().st_size if wal.exists() else 0

    def look_at_wal(self) -> bytes:
        wal = self.place / OF_SQLITE[1]
        now = wal.read_bytes() if wal.exists() else b""
        if len(now) < self.wal_kept:
            self.wal_kept = 0
        if now:
            self.wal_before = now
        return now

    def image(self, to: Path, chance: random.Random) -> None:
        """Make a directory as a power cut may leave it now."""
        shutil.rmtree(to, ignore_errors=True)
        to.mkdir(parents=True)
        now = self.names()
        for name in {*now, *self.entries} - set(OF_SQLITE):
            inode = chance.choice([self.entries.get(name), now.get(name)])
            if inode in self.files:  # SQLite's copy of a -wal is of no use after a cut
                (to / name).write_bytes(self.files[inode].after_a_cut(chance))
                (to / name).chmod(0o600)
        if CATALOG in now and (self.entries.get(CATALOG) == now[CATALOG] or chance.random() < 0.5):
            shutil.copy(self.place / CATALOG, to / CATALOG)
            if wal := self.look_at_wal():
                wal = wal[: chance.choice([self.wal_kept, len(wal), chance.randint(self.wal_kept, len(wal))])]
            else:
                wal = chance.choice([b"", self.wal_before])
            if wal or chance.random() < 0.5:
                (to / f"{CATALOG}-wal").write_bytes(wal)
                (to / f"{CATALOG}-wal").chmod(0o600)


class Run:
    """A store on a disk, the rows that it has acknowledged, and the commit that it has not answered."""

    def __init__(self, tmp_path: Path, patch: pytest.MonkeyPatch, seed: int, images: int) -> None:
        self.path = tmp_path / "state" / "app" / CATALOG
        self.path.parent.mkdir(parents=True)
        self.copy = tmp_path / "image" / "app"
        self.disk = Disk(self.path.parent, patch, self.check)
        self.chance = random.Random(seed)
        self.images = images
        self.acknowledged: Content = content_of(())
        self.asked: Sequence[Change] = ()
        self.in_doubt: Sequence[Change] = ()  # refused while the disk does not even take the cutting off
        self.store: Store | None = None
        self.epoch = 0

    def check(self, images: int | None = None) -> None:
        """Open what power cuts at this moment may leave: it has what is acknowledged, and nothing that was refused."""
        was, self.disk.busy = self.disk.busy, True
        try:
            for _ in range(self.images if images is None else images):
                self.disk.image(self.copy, self.chance)
                durability: Durability = "process" if self.chance.random() < 0.8 else "power"
                found = open_store(self.copy / CATALOG, durability=durability)
                content, epoch = found.load(), found.epoch
                found.close()
                assert content in [self.acknowledged, *map(self._with, (self.asked, self.in_doubt))]
                assert epoch > self.epoch
        finally:
            self.disk.busy = was

    def _with(self, changes: Sequence[Change]) -> Content:
        content: Content = {table: dict(rows) for table, rows in self.acknowledged.items()}
        apply(content, changes)
        return content

    def step(self, step: Any) -> None:
        match step:
            case "open":
                self.store = open_store(self.path, durability="power")
                self.disk.opened()
                self.epoch = self.store.epoch
                assert self.store.load() == self.acknowledged
            case "close":
                store, self.store = self.store, None
                if store is not None:  # else its closing has failed
                    store.close()
            case "fold":
                assert self.store is not None
                self.store.upkeep()
            case "tidy":
                assert self.store is not None
                self.store.tidy()
            case _:
                assert self.store is not None
                self.asked = step
                try:
                    self.store.commit(step)
                finally:
                    self.asked = ()
                self.acknowledged = self._with(step)
                self.in_doubt = ()
        self.disk.look_at_wal()
        self.check()


@contextmanager
def running(tmp_path: Path, seed: int = 0, images: int = 2) -> Iterator[Run]:
    with pytest.MonkeyPatch.context() as patch:
        run = Run(tmp_path, patch, seed, images)
        try:
            yield run
        finally:
            patch.undo()
            if run.store is not None:
                run.store.close()
            run.disk.close()


def put(number: int, size: int = 10) -> list[Change]:
    return [Put(ServedQuery(f"p{number}", "r" * size, "app", "", 1, number))]


A, B, C = put(1), put(2, 5000), put(3)
SCRIPT: list[Any] = [
    "open", A, B, "fold", C, [Drop("queries", "p1")], "fold", put(4), "tidy", A, "close",
    "open", put(5), "fold", put(6), "tidy", put(7), "fold", put(8), "close", "open", "tidy", put(9), "close",
]  # fmt: skip
STEPS = st.one_of(
    st.sampled_from(["fold", "tidy", "reopen"]),
    st.builds(put, st.integers(0, 9), st.sampled_from([1, 3000])),
    st.integers(0, 9).map(lambda number: [Drop("queries", f"p{number}")]),
)


@given(st.lists(STEPS, max_size=15), st.integers(0, 2**32))
@settings(max_examples=15, deadline=None)
def test_a_power_cut_loses_nothing_acknowledged_at_any_moment(
    tmp_path_factory: pytest.TempPathFactory, steps: list[Any], seed: int
) -> None:
    with running(tmp_path_factory.mktemp("cut"), seed) as run:
        run.step("open")
        for step in steps:
            if step == "reopen":
                run.step("close")
                run.step("open")
            else:
                run.step(step)
        run.step("close")


def syncs_of_the_script(tmp_path: Path) -> int:
    with running(tmp_path / "counted", images=0) as run:
        for step in SCRIPT:
            run.step(step)
        return run.disk.syncs


@pytest.mark.parametrize("times", [1, 2], ids=["once", "and the cutting off, too"])
def test_a_sync_that_fails_refuses_one_commit_and_neither_loses_nor_brings_back_any(tmp_path: Path, times: int) -> None:
    """Each sync of the script fails in turn, and what it would have written may never get to the disk."""
    refused = 0
    for first in range(1, syncs_of_the_script(tmp_path) + 1):
        with running(tmp_path / str(first), seed=first, images=0) as run:
            run.disk.fails = lambda number, first=first: first <= number < first + times
            for step in SCRIPT:
                for _ in range(times + 1):
                    try:
                        run.step(step)
                    except CatalogError:
                        refused += isinstance(step, list)
                        run.in_doubt = step if isinstance(step, list) and times > 1 else ()
                        run.check(images=3)
                    else:
                        break
                else:
                    pytest.fail(f"{step!r} still fails when the disk does not")
            run.check(images=3)
    assert refused >= 5
