"""Catalogs that earlier versions wrote: they are read, and migrated in one commit when they are opened."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.registrar.model.rows import ServedQuery
from rr_actors.storage.opening import open_store, read_rows
from rr_actors.storage.sql_tables import OLDEST_VERSION, SCHEMA, SCHEMA_VERSION
from support_cli import run_cli
from support_old_catalogs import CHILDREN

CATALOGS = sorted((Path(__file__).parent / "catalogs").glob("version_*.tar.gz"))


@pytest.fixture(params=CATALOGS, ids=lambda path: path.name.partition(".")[0])
def old(request: pytest.FixtureRequest, state_dir: Path) -> Path:
    """The state directory of a system of an earlier version, which was killed."""
    with tarfile.open(request.param) as archive:
        archive.extractall(state_dir, filter="data")
    return state_dir


def version_of(catalog: Path) -> int:
    with sqlite3.connect(catalog) as connection:
        return int(connection.execute("PRAGMA user_version").fetchone()[0])


def test_there_is_a_catalog_of_each_version_that_can_be_opened() -> None:
    assert [path.name for path in CATALOGS] == [f"version_{n}.tar.gz" for n in range(OLDEST_VERSION, SCHEMA_VERSION)]


def test_a_system_that_is_started_on_old_catalogs_has_everything(old: Path, start: Callable[..., rr.System]) -> None:
    journals = list(old.glob("*/catalog.journal.*"))
    assert len(journals) == 3
    system = start(*CHILDREN, state_dir=old)
    app = system.open_registrar("app")
    assert {(query.server_id, query.request) for query in app.queries()} == {
        ("wholes/whole", "first"),
        ("wholes/whole", "stuck"),
        ("wholes/whole", "second"),  # in a journal
        ("parts/part", "part of first"),
    }
    assert {query.request: query.state for query in app.queries()}["first"] is rr.State.WARNING
    phases = {info.request: str(info.phase) for info in system.registrar("wholes").resources()}
    assert phases == {"first": "loaded", "second": "loaded", "stuck": "unload_failed"}
    holders = {info.request: sorted(info.holders) for info in system.registrar("parts").resources()}
    assert holders == {"part of first": ["app", "wholes"], "part of stuck": ["wholes"], "part of second": ["wholes"]}
    for query in list(app.queries()):
        if query.request != "stuck":
            query.unload()
    assert {info.request for info in system.registrar("parts").resources()} == {"part of stuck"}


def test_an_old_catalog_is_migrated_when_it_is_opened_and_not_when_it_is_read(old: Path) -> None:
    catalog = old / "wholes" / "catalog.sqlite3"
    before = {path.name: path.read_bytes() for path in catalog.parent.iterdir() if not path.name.endswith("-shm")}
    rows = read_rows(catalog)
    after = {path.name: path.read_bytes() for path in catalog.parent.iterdir() if not path.name.endswith("-shm")}
    assert before == after
    assert len([row for row in rows if isinstance(row, ServedQuery)]) == 3
    store = open_store(catalog)
    content = store.load()
    store.close()
    assert version_of(catalog) == SCHEMA_VERSION
    with sqlite3.connect(catalog) as connection:
        assert dict(connection.execute("SELECT name, sql FROM sqlite_schema WHERE sql IS NOT NULL")) == SCHEMA
    assert sorted(row.id for rows in content.values() for row in rows.values()) == sorted(row.id for row in rows)
    assert sorted(row.id for row in read_rows(catalog)) == sorted(row.id for row in rows)


def test_a_migration_that_fails_leaves_the_old_catalog(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    catalog = old / "wholes" / "catalog.sqlite3"
    rows = read_rows(catalog)
    version = version_of(catalog)

    def refuse(*_: Any) -> Any:
        raise sqlite3.OperationalError("disk I/O error")

    with monkeypatch.context() as patch:
        patch.setattr("rr_actors.storage.sql_tables.statements", refuse)
        with pytest.raises(rr.CatalogError, match="disk I/O error"):
            open_store(catalog)
    assert version_of(catalog) == version < SCHEMA_VERSION
    assert sorted(row.id for row in read_rows(catalog)) == sorted(row.id for row in rows)


@pytest.mark.parametrize("command", ["inspect", "check"])
def test_the_command_line_reads_old_catalogs_and_new_ones(old: Path, command: str, tmp_path: Path) -> None:
    copy = tmp_path / "new"
    shutil.copytree(old, copy)
    for name in os.listdir(copy):
        open_store(copy / name / "catalog.sqlite3").close()
    said = [run_cli(command, place) for place in (old, copy)]
    assert [result.returncode for result in said] == [0, 0]
    assert said[0].stdout.replace(str(old), "") == said[1].stdout.replace(str(copy), "")


def test_a_catalog_of_a_newer_version_is_refused_by_name(old: Path) -> None:
    catalog = old / "parts" / "catalog.sqlite3"
    with sqlite3.connect(catalog) as connection:
        connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    with pytest.raises(rr.CatalogVersion, match=f"got version {SCHEMA_VERSION + 1} of a newer rr_actors") as caught:
        open_store(catalog)
    assert str(catalog) in str(caught.value)
