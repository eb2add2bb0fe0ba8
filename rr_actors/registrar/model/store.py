"""Store: the contract of a catalog's storage. rr_actors/storage implements it; one test suite checks all stores.

The simplest one, MemoryStore, is here.

Each implementation guarantees:

- `commit` is atomic: after a crash, all of its changes are stored, or none. If it has returned, they are stored
  ("process": after SIGKILL of this process; "power": after a power cut too). If it has raised, none of them is.
- `load` returns exactly the committed rows. The caller may keep and change the result.
- A catalog has one open store: a second `open` raises CatalogLocked until the first is closed or its process is dead.

The caller's duties: if `commit` raises, it treats the changes as not made. It calls `close` once, and nothing after it.
It uses a store from one thread at a time; only `upkeep`, `tidy` and `copy` may run in another.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from rr_actors.registrar.model.rows import Change, Content, apply, content_of


class Store(Protocol):
    """A catalog's storage, opened and locked."""

    @property
    def epoch(self) -> int:
        """The number of this opening of the catalog, from 1: the registrar's incarnation."""
        ...

    def load(self) -> Content:
        """Return every row, for the caller to keep and change; raise CatalogDamaged if a row cannot be read."""
        ...

    def commit(self, changes: Sequence[Change]) -> None:
        """Write all changes in their order, atomically.

        Raises:
            CatalogError: the changes could not be written (disk full, I/O error); nothing was written.
        """
        ...

    def wants_tidying(self) -> bool:
        """Return whether the caller should call upkeep() a moment after its commits."""
        ...

    def upkeep(self) -> None:
        """Bring the file up to date for other readers, and keep commits fast and the files small.

        This may take long: call it in another thread, while commits continue.

        Raises:
            CatalogError: the files could not be written; nothing is lost.
        """
        ...

    def tidy(self) -> None:
        """Do what upkeep() does, and leave nothing of it to be done later.

        This may take long: call it in another thread, while commits continue.

        Raises:
            CatalogError: the files could not be written; nothing is lost.
        """
        ...

    def copy(self, content: Content, path: Path) -> None:
        """Write these rows, in the place of its own, as a closed catalog at a new path. From any thread.

        The copy is on the disk when this returns. A store that is lost with its process copies nothing.

        Raises:
            CatalogError: the copy could not be written.
        """
        ...

    def close(self, *, erase: bool = False) -> None:
        """Release the lock; with `erase`, remove the catalog from disk as well.

        Raises:
            CatalogError: the catalog could not be removed; it is as before, or only files without meaning are left.
        """
        ...


def is_needed(content: Content) -> bool:
    """Return whether the next opening of a catalog would miss its rows; types of servers come again when needed."""
    return any(rows for table, rows in content.items() if table != "server_types")


class MemoryStore:
    """A Store of a catalog in memory, which is lost with this object: for durability "none"."""

    def __init__(self) -> None:
        self.epoch = 1
        self._content: Content = content_of(())

    def load(self) -> Content:
        return {table: dict(rows) for table, rows in self._content.items()}

    def commit(self, changes: Sequence[Change]) -> None:
        apply(self._content, changes)

    def wants_tidying(self) -> bool:
        return False

    def upkeep(self) -> None:
        """Do nothing."""

    def tidy(self) -> None:
        """Do nothing."""

    def copy(self, content: Content, path: Path) -> None:
        """Do nothing."""

    def close(self, *, erase: bool = False) -> None:
        """Do nothing."""
