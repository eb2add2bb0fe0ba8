"""Ledger: what of a registrar's catalog is on disk, and what is still to be written."""

from __future__ import annotations

import logging
from asyncio import AbstractEventLoop, TimerHandle
from collections.abc import Iterable

from rr_actors.actors import turns
from rr_actors.actors.workers import Workers
from rr_actors.config import RegistrarConfig
from rr_actors.core.catalog import Batch
from rr_actors.errors import CatalogError, Unavailable
from rr_actors.records import TABLE_OF, Change, Put, Row, Table
from rr_actors.store import Store

logger = logging.getLogger("rr_actors.registrar")

_SAVE_SOON_S = 0.05
_RETRY_S = 0.25


class Ledger:
    """Commits batches to the store: at once what must be there, a moment later what could be rebuilt.

    With save_on_modify off everything is written each save interval, and at closing. On the loop.
    """

    def __init__(
        self, name: str, config: RegistrarConfig, store: Store, loop: AbstractEventLoop, workers: Workers
    ) -> None:
        self._name = name
        self._store = store
        self._loop = loop
        self._workers = workers
        self._at_once = config.save_on_modify
        self._delay_s = _SAVE_SOON_S if config.save_on_modify else config.save_interval_s
        self._unsaved: dict[tuple[Table, str], Change] = {}
        self._timer: TimerHandle | None = None

    def rows(self) -> Iterable[Row]:
        """What is on disk; what is unsaved is forgotten."""
        self._unsaved.clear()
        return self._store.load()

    def commit(self, batch: Batch) -> None:
        """Write a batch's changes, or note them for later; older ones that wait are written before.

        Raises:
            CatalogError: nothing was written.
        """
        if batch.changes and self._at_once:
            turns.hurry()
            try:
                if self._unsaved or batch.later:
                    self._store.commit([*self._unsaved.values(), *batch.changes, *batch.later.values()])
                    self._unsaved.clear()
                else:
                    self._store.commit(batch.changes)
            finally:
                turns.relax()
            if self._store.wants_tidying():
                self._tidy()
        elif batch.changes or batch.later:
            for change in batch.changes:
                self._unsaved[_key(change)] = change
            self._unsaved.update(batch.later)
            if self._timer is None:
                self._timer = self._loop.call_later(self._delay_s, self._save_later)

    def save(self) -> None:
        """Write what has not been written yet.

        Raises:
            CatalogError: it was not, and stays noted.
        """
        if self._unsaved:
            self._store.commit(list(self._unsaved.values()))
            self._unsaved.clear()

    def _tidy(self) -> None:
        def done(_result: None, error: BaseException | None) -> None:
            if error is not None:
                logger.warning("%s: %s", self._name, error)

        try:
            self._workers.submit(self._store.tidy, done=done)
        except Unavailable as error:
            done(None, error)

    def close(self, *, erase: bool) -> None:
        """Write what is unsaved and give the store back; with `erase`, remove it."""
        if self._timer is not None:
            self._timer.cancel()
        try:
            self.save()
        except CatalogError:
            logger.exception("%s: could not save at closing", self._name)
        self._store.close(erase=erase)

    def _save_later(self) -> None:
        self._timer = None
        try:
            self.save()
        except CatalogError as error:
            logger.error("%s: %s; tried again later", self._name, error)
            self._timer = self._loop.call_later(_RETRY_S, self._save_later)


def _key(change: Change) -> tuple[Table, str]:
    if isinstance(change, Put):
        return TABLE_OF[type(change.row)], change.row.id
    return change.table, change.id
