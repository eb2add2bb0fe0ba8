"""Batches: what a registrar's actor does with the messages of one wake-up: decides, commits, and then acts on them.

In that order, for all of them together: changes are on disk before anything of them leaves. If the commit fails,
nothing has happened.
"""

from __future__ import annotations

import asyncio
import functools
import logging
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

import msgspec

from rr_actors.actors.acting import Acting
from rr_actors.actors.inbox import Item
from rr_actors.core import commands as c
from rr_actors.core import effects as e
from rr_actors.core.batch import Batch
from rr_actors.core.decide import decide, obey
from rr_actors.core.effects import Effect
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
        self._effects: deque[list[Effect]] = deque()  # of each batch, to be done on the loop
        self._is_acting = False
        self._changed = asyncio.Event()

    def take_up(self, items: list[Item]) -> Callable[[], None] | None:
        """Decide what the inbox gives, and commit it; returns what is then to be done."""
        registrar = self._registrar
        if registrar.closed:
            registrar.inbox.clear()
            return None
        return self.decide(
            [pair for pair in items if type(pair[0]) is not c.Got or registrar.under_way.take_up(pair[0])]
        )

    def decide(self, items: list[Item]) -> Callable[[], None] | None:
        """Decide, and commit; returns what is then to be done. On the loop."""
        try:
            self._commit(functools.partial(self._decide, items))
        except CatalogError as error:
            self._not_committed(items, error)
            return None
        except Exception as error:
            self._registrar.fail(error)
            return None
        return self.act

    def decide_here(self, command: c.Command) -> bool:
        """Decide a command in the thread that brings it, and answer by that if a direct line waits; False: not so.

        What else follows is done on the loop, in its order.
        """
        registrar = self._registrar
        if registrar.closed:  # in a forked child nobody gives the lock back
            return False
        with registrar.lock:
            if registrar.closed or not registrar.inbox.is_quiet or not self._ledger.row_by_row:
                return False
            try:
                batch = registrar.commit(functools.partial(obey, command=command, event=""))
            except Exception:  # as the loop will find, and say: a full disk, or a defect
                return False
            answer = self._acting.by_thread(batch.effects)
            if answer is None:
                self._effects.append(batch.effects)
        if answer is None:
            registrar.node.dispatcher.hand_over(self.act)
        else:
            answer()
        return True

    def run(self, work: Callable[[Batch], object]) -> None:
        """Have work(batch) decide, commit that, and act. On the loop.

        Raises:
            CatalogError: not committed; nothing has happened.
        """
        self._commit(work)
        self.act()

    def act(self) -> None:
        """Do what has been decided, in the order of the decisions. On the loop."""
        if self._is_acting:  # what acts now goes on with it
            return
        self._is_acting = True
        try:
            while self._effects:
                self._acting.do(self._effects.popleft())
        except Exception as error:
            self._registrar.fail(error)
        finally:
            self._is_acting = False
        self._changed.set()

    def _commit(self, work: Callable[[Batch], object]) -> None:
        with self._registrar.lock:
            batch = self._registrar.commit(work)
            if batch.effects:
                self._effects.append(batch.effects)

    async def next_change(self, timeout_s: float) -> None:
        """Return when something has been decided, or after `timeout_s` seconds."""
        self._changed.clear()
        try:
            await asyncio.wait_for(self._changed.wait(), timeout_s)
        except TimeoutError:
            return

    def close(self) -> None:
        """Act on nothing later."""
        self._effects.clear()
        self._acting.close()

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
