"""What a held query takes: in the provider's process, in the consumer's, and on disk."""

from __future__ import annotations

import gc
import sqlite3
import tracemalloc
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import psutil

from benchmarks.table import Row
from benchmarks.workload import Ask, load_all, running

IN_PROCESS = 1_000
ON_DISK = 400
_WARM_UP = 2_000


def memory(sizes: Sequence[int]) -> list[Row]:
    """Bytes a query: all on one resource, so that it is the queries alone; then each with a resource of its own."""
    rows: list[Row] = []
    for size in sizes:
        rows += _measure(size, each_its_own=False)
    return rows + _measure(sizes[0], each_its_own=True)


def _measure(size: int, *, each_its_own: bool) -> list[Row]:
    with running("process") as (system, consumer), _traced():
        (child,) = system.supervisor().which_children()
        assert child.pid is not None
        provider = psutil.Process(child.pid)
        registrars = (system.registrar("provider"), consumer)
        files = [registrar.directory for registrar in registrars]
        kept = load_all(consumer, (Ask(-1) for _ in range(_WARM_UP)))  # what grows once has grown
        _save(registrars)
        before = [_private(provider), _allocated(), *map(_stored, files)]
        kept += load_all(consumer, (Ask(number if each_its_own else -1) for number in range(size)))
        _save(registrars)
        after = [_private(provider), _allocated(), *map(_stored, files)]
        del kept
    each = [(now - then) / size for now, then in zip(after, before, strict=True)]
    if each_its_own:
        return [
            Row(f"memory, provider: a resource of {size:,} and its query", each[0], "B"),
            Row(f"disk, provider: a resource of {size:,} and its query", each[2], "B"),
        ]
    return [
        Row(f"memory, provider: one of {size:,} queries", each[0], "B", at_most=IN_PROCESS),
        Row(f"memory, consumer: one of {size:,} queries, its Query object too", each[1], "B"),
        Row(f"disk, provider: one of {size:,} queries", each[2], "B", at_most=ON_DISK),
        Row(f"disk, consumer: one of {size:,} queries, with request and response", each[3], "B"),
    ]


def _save(registrars: Iterable[Any]) -> None:
    for registrar in registrars:
        registrar.save_catalog()  # what waits in its journal, too


@contextmanager
def _traced() -> Iterator[None]:
    """What this process has freed before is used again: its size says nothing, so allocations are traced."""
    tracemalloc.start()
    try:
        yield
    finally:
        tracemalloc.stop()


def _allocated() -> int:
    gc.collect()
    return tracemalloc.get_traced_memory()[0]


def _private(process: psutil.Process) -> int:
    return process.memory_full_info().uss


def _stored(directory: Path) -> int:
    """The size of the database, what is still in its write-ahead log included."""
    (file,) = (path for path in directory.iterdir() if path.suffix not in {".lock", ""} and _is_database(path))
    with closing(sqlite3.connect(f"{file.as_uri()}?mode=ro", uri=True)) as connection:
        pages = connection.execute("PRAGMA page_count").fetchone()[0]
        return pages * connection.execute("PRAGMA page_size").fetchone()[0]


def _is_database(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(6) == b"SQLite"
