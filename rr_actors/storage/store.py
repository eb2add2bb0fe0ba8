"""Store: the contract of a catalog's storage. Implementations stand beside it; one contract test suite runs over all.

Guarantees every implementation gives:

- `commit` is atomic: all of its changes are there after a crash, or none. When it returns they are there ("process":
  after SIGKILL of this process; "power": after a power cut too). When it raises, none of them is.
- `load` returns exactly what was committed, for the caller to keep and to change.
- one open store a catalog: a second `open` raises CatalogLocked until the first is closed or its process is dead.

Obligations: after an exception from `commit` the caller treats the batch as not having happened; `close` is called
once; nothing is called after it. A store is used from one thread at a time, `tidy` excepted.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from rr_actors.registrar.model.rows import Change, Content


class Store(Protocol):
    """A catalog's storage, opened and locked."""

    @property
    def epoch(self) -> int:
        """How often this catalog has been opened, this time included: the registrar's incarnation, from 1."""
        ...

    def load(self) -> Content:
        """Return every row; the caller may keep what it gets, and change it.

        Raises:
            CatalogDamaged: a row cannot be read.
        """
        ...

    def commit(self, changes: Sequence[Change]) -> None:
        """Write all changes in their order, atomically.

        Raises:
            CatalogError: it could not be written (disk full, I/O error); nothing was.
        """
        ...

    def wants_tidying(self) -> bool:
        """Whether tidy() should be called, a moment after what has been committed."""
        ...

    def tidy(self) -> None:
        """Bring what others read of it up to date, and keep commits fast and the files small.

        May take long: in another thread, while commits go on.

        Raises:
            CatalogError: it could not be done; nothing is lost by that.
        """
        ...

    def close(self, *, erase: bool = False) -> None:
        """Release the lock; with `erase`, remove the catalog from disk as well.

        Raises:
            CatalogError: it could not be removed; it is as it was, or gone but for files that do not matter.
        """
        ...
