"""The disk turns read-only under a running system, and later writable again.

A file system with open files cannot be remounted read-only by hand, but the kernel does it after an I/O error. Here
every operation that writes fails as it would then.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.registrar.model.rows import Held
from rr_actors.storage.opening import read_rows
from support import catalog_path, eventually, serve

WRITES = ("pwrite", "ftruncate", "unlink", "rename", "replace", "mkdir")


class Disk:
    """Refuses to be written while `read_only`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.read_only = False
        disk = self
        for name in WRITES:
            monkeypatch.setattr(os, name, self._refusing(getattr(os, name)))
        open_ = os.open

        def opened(path: Any, flags: int, *args: Any, **options: Any) -> int:
            if flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC):
                disk.check()
            return open_(path, flags, *args, **options)

        monkeypatch.setattr(os, "open", opened)
        connect = sqlite3.connect

        class Cursor(sqlite3.Cursor):
            def execute(self, sql: str, parameters: Any = (), /) -> sqlite3.Cursor:
                if disk.read_only and not sql.startswith(("SELECT", "ROLLBACK", "PRAGMA page", "PRAGMA free")):
                    raise sqlite3.OperationalError("attempt to write a readonly database")
                return super().execute(sql, parameters)

        class Connection(sqlite3.Connection):
            def cursor(self, factory: Any = Cursor) -> Any:
                return super().cursor(factory)

        monkeypatch.setattr(sqlite3, "connect", lambda *args, **options: connect(*args, **options, factory=Connection))

    def check(self) -> None:
        if self.read_only:
            raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    def _refusing(self, real: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any, **options: Any) -> Any:
            self.check()
            return real(*args, **options)

        return call


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[Disk]:
    disk = Disk(monkeypatch)
    yield disk
    disk.read_only = False


@pytest.mark.parametrize("durability", ["process", "power"])
def test_what_cannot_be_written_is_refused_by_name_and_the_rest_goes_on(
    disk: Disk, system: rr.System, state_dir: Path, durability: Any
) -> None:
    config = rr.RegistrarConfig(durability=durability)
    provider, app = system.open_registrar("provider", config), system.open_registrar("app", config)
    served = serve(provider, "thing")
    held = [app.load("provider/thing", number) for number in range(20)]
    disk.read_only = True
    for number in range(20, 40):
        with pytest.raises(rr.CatalogError, match=r"got: .*[Rr]ead-?only"):
            app.load("provider/thing", number, timeout_s=5.0)
    for query in held[:3]:
        with pytest.raises((rr.CatalogError, rr.Unavailable), match=r"got: .*[Rr]ead-?only|the release is owed"):
            query.unload(timeout_s=0.5)
    assert {query.id for query in held[3:]} <= {query.id for query in app.queries()}
    assert [query.response for query in held] == [{"of": n, "number": n + 1} for n in range(20)]
    disk.read_only = False
    late = app.load("provider/thing", 40, timeout_s=5.0)
    for query in held[:3]:
        with contextlib.suppress(rr.UnknownQuery):  # its release was owed, and is done
            query.unload(timeout_s=5.0)
    expected = {late.id, *(query.id for query in held[3:])}
    assert {query.id for query in app.queries()} == expected
    eventually(lambda: {query.id for query in app.fetch_queries("provider")} == expected)
    app.save_catalog()
    rows = read_rows(catalog_path(state_dir, "app"))
    assert {row.id for row in rows if isinstance(row, Held)} == expected
    eventually(lambda: len(served.loads) - len(served.unloads) == len(expected), what="nothing is held by nobody")
