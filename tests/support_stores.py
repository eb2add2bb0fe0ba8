"""Rows, commits and what comes of them: for the tests of the stores."""

from __future__ import annotations

import contextlib
import os
import typing
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import strategies as st

from rr_actors.base.folder import Folder
from rr_actors.registrar.model.rows import (
    TABLE_OF,
    TABLES,
    Change,
    Drop,
    Int64,
    Phase,
    Put,
    Resource,
    Row,
    ServedQuery,
    State,
)
from rr_actors.storage.sqlite_store import segments_among


def folder_of(catalog: Path) -> Folder:
    """The catalog's directory, until nobody uses it any more."""
    return Folder.at(catalog.parent)


def segments_of(catalog: Path) -> list[Path]:
    """The segments of its journal that there are, in their order."""
    names = os.listdir(catalog.parent) if catalog.parent.is_dir() else []
    return [catalog.with_name(name) for name in segments_among(names, catalog)]


@contextlib.contextmanager
def belonging_to_another(path: Path) -> Iterator[None]:
    """The file or directory is another user's; only root can do it really."""
    if os.geteuid() == 0:
        os.chown(path, 65534, -1)
        yield
        os.chown(path, 0, -1)
        return
    theirs, stat, fstat = path.stat().st_ino, os.stat, os.fstat

    def changed(found: os.stat_result) -> os.stat_result:
        return os.stat_result((*found[:4], found.st_uid + 1, *found[5:])) if found.st_ino == theirs else found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "stat", lambda *args, **options: changed(stat(*args, **options)))
        patch.setattr(os, "fstat", lambda fd: changed(fstat(fd)))
        yield


Rows = dict[tuple[str, str], Row]
"""By table and id."""


def query(id_: str, seq: int = 1) -> ServedQuery:
    return ServedQuery(id_, "r1", "app", "", 1, seq)


def part(id_: str, request: bytes = b"\x01") -> Resource:
    return Resource(id_, "camera", request, None, Phase.LOADED, State.OK, "", 1)


def in_order(rows: Iterable[Row]) -> list[Row]:
    return sorted(rows, key=lambda row: (TABLE_OF[type(row)], row.id))


def after(rows: Rows, changes: Iterable[Change]) -> Rows:
    """What rows become by a commit."""
    rows = dict(rows)
    for change in changes:
        if isinstance(change, Put):
            rows[TABLE_OF[type(change.row)], change.row.id] = change.row
        else:
            rows.pop((change.table, change.id), None)
    return rows


def states(commits: Iterable[Sequence[Change]]) -> list[list[Row]]:
    """What there is after each of the commits, and before the first."""
    rows: Rows = {}
    found: list[list[Row]] = [[]]
    for changes in commits:
        rows = after(rows, changes)
        found.append(in_order(rows.values()))
    return found


def values(type_: Any) -> st.SearchStrategy[Any]:
    """Any value of a row's field."""
    if type_ is str:
        return st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
    if type_ is bytes:
        return st.binary(max_size=300)
    if type_ is bool:
        return st.booleans()
    if type_ == Int64:
        return st.integers(-(2**63), 2**63 - 1)
    if typing.get_args(type_):
        return st.one_of([st.none() if item is type(None) else values(item) for item in typing.get_args(type_)])
    return st.sampled_from(list(type_))


def rows_of(cls: type[Row], ids: st.SearchStrategy[str]) -> st.SearchStrategy[Row]:
    fields = {field.name: values(field.type) for field in msgspec.structs.fields(cls)}
    return st.builds(cls, **{**fields, "id": ids})


IDS = st.sampled_from(["", "a", "b", "c\0", "é"])
ROWS = st.one_of([rows_of(cls, IDS) for cls in TABLES.values()])
CHANGES: st.SearchStrategy[Change] = st.one_of(
    st.builds(Put, ROWS), st.builds(Drop, st.sampled_from(list(TABLES)), IDS)
)
COMMITS = st.lists(st.lists(CHANGES, max_size=8), max_size=5)
