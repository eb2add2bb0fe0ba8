"""Batches: what a registrar's actor does with the messages of one wake-up: decides, commits, and then acts on them.

In that order, for all of them together: changes are on disk before anything of them leaves. If the commit fails,
nothing has happened.
"""

from __future__ import annotations

import asyncio
import functools
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING

import msgspec

from rr_actors.actors.acting import Acting
from rr_actors.actors.inbox import Item
from rr_actors.core import commands as c
from rr_actors.core import effects as e
from rr_actors.core.batch import Batch
from rr_actors.core.decide import decide, obey
from rr_actors.core.uncommitted import refuse_uncommitted
from rr_actors.errors import CatalogError, RrError
from rr_actors.messages import Describe, Load, LoadRefused, failure_of
from rr_actors.names import new_id

if TYPE_CHECKING:
    from rr_actors.actors.ledger import Ledger
    from rr_actors.actors.registrar import RegistrarActor

logger = logging.getLogger("rr_actors.registrar")

_STARTING = (c.Register, c.Unregister)  # what may start a status, which needs an id


class Batches:
    """Those of one registrar. On the loop."""

    def __init__(self, registrar: RegistrarActor, ledger: Ledger) -> None:
        self._registrar = registrar
        self._ledger = ledger
        self._acting = Acting(registrar)
        self._changed = asyncio.Event()

    def take_up(self, items: list[Item]) -> Callable[[], None] | None:
        """Decide what the inbox gives, and commit it; returns what is then to be done."""
        registrar = self._registrar
        if registrar.closed:
            registrar.inbox.clear()
            return None
        return self.decided(
            [pair for pair in items if type(pair[0]) is not c.Got or registrar.under_way.take_up(pair[0])]
        )

    def decided(self, items: list[Item]) -> Callable[[], None] | None:
        """Decide, and commit; returns what is then to be done."""
        try:
            batch = self._registrar.commit(functools.partial(self._decide, items))
        except CatalogError as error:
            self._not_committed(items, error)
            return None
        except Exception as error:
            self._registrar.fail(error)
            return None
        return functools.partial(self._do, batch)

    def run(self, work: Callable[[Batch], object]) -> None:
        """Have work(batch) decide, commit that, and act.

        Raises:
            CatalogError: not committed; nothing has happened.
        """
        self._act(self._registrar.commit(work))

    async def next_change(self, timeout_s: float) -> None:
        """Return when something has been decided, or after `timeout_s` seconds."""
        self._changed.clear()
        try:
            await asyncio.wait_for(self._changed.wait(), timeout_s)
        except TimeoutError:
            return

    def close(self) -> None:
        """Act on nothing later."""
        self._acting.close()

    def _do(self, batch: Batch) -> None:
        try:
            self._act(batch)
        except Exception as error:
            self._registrar.fail(error)

    def _act(self, batch: Batch) -> None:
        if batch.effects:
            self._acting.do(batch.effects)
        self._changed.set()

    def _decide(self, items: list[Item], batch: Batch) -> None:
        registrar = self._registrar
        for item, sender in items:
            if sender is None:
                obey(batch, item, new_id() if type(item) in _STARTING else "")
            elif type(item) is Load:
                self._decide_load(batch, item, sender)
            elif type(item) is Describe:
                registrar.servers.describe(batch, item, sender)
            else:
                decide(batch, item, sender)

    def _decide_load(self, batch: Batch, load: Load, sender: str) -> None:
        server = self._registrar.servers.get(load.server)
        if server is not None and batch.catalog.joinable(load.server, load.request) is None:
            try:
                canonical = server.request.canonical(load.request, server.origin)
            except RrError as error:
                batch.cause(e.Reply(sender, LoadRefused(load.query_id, failure_of(error))))
                return
            if canonical != load.request:
                load = msgspec.structs.replace(load, request=canonical)
        decide(batch, load, sender)

    def _not_committed(self, items: list[Item], error: CatalogError) -> None:
        """Nothing of this wake-up has happened: refuse what can be refused, and do the rest again a little later."""
        registrar = self._registrar
        logger.error("%s: not committed, nothing was done: %s", registrar.name, error)
        again: list[Item] = []

        def refuse(batch: Batch) -> None:
            again.extend(refuse_uncommitted(batch, items, failure_of(error)))

        self.run(refuse)
        if again:
            registrar.inbox.put_back(again)
