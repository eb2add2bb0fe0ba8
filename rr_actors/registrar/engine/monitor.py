"""Monitor: how a registrar deals with what comes in: decide, apply, commit (under its lock), and then act.

In that order: changes are on disk before anything of them leaves. If the commit fails, nothing has happened.

Whoever brings a message decides it. The loop decides what it reads as it reads it, all messages of one read as one
batch. The thread that ran a callback decides what follows from its end. What the decisions cause is done in the order
of the decisions, on the loop; only the answer to one direct line is given by the thread that has decided it.

Messages wait only while something else has to be first: the rest of the same read; what is done now (then they follow
it); a commit that failed, and is tried again a moment later; and where many share a commit (durability "power", or
`save_on_modify=False`) until the loop's next turn.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import msgspec

from rr_actors.base.errors import CatalogError, RrError
from rr_actors.base.names import new_id
from rr_actors.registrar.core.decide import decide, obey, refuse_uncommitted
from rr_actors.registrar.engine.effect_runner import Acting
from rr_actors.registrar.engine.registrar_state import RegistrarState
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import effects as e
from rr_actors.registrar.model.effects import Effect
from rr_actors.registrar.model.messages import Describe, Load, LoadRefused, failure_of
from rr_actors.registrar.model.transaction import Batch
from rr_actors.runtime import interpreter

logger = logging.getLogger("rr_actors.registrar")

_STARTING = (c.Register, c.Unregister)  # what may start a status, which needs an id
_AT_ONCE = 128  # with more, those who wait for the first answers do not wait for the last ones
_RETRY_S = 0.25

Item = tuple[Any, str | None]
"""A message and the registrar that sent it, or a command of this process and None."""


class Monitor:
    """That of one registrar. On the loop, but for decide_here.

    Args:
        registrar: its actor, whose servers, links and callers Acting deals with.
    """

    def __init__(self, registrar: Any) -> None:
        self._registrar = registrar
        self._state: RegistrarState = registrar
        self._dispatcher = registrar.node.dispatcher
        self._acting = Acting(registrar)
        self._effects: deque[list[Effect]] = deque()  # of each batch, to be done on the loop
        self._waiting = self._state.waiting
        self._gathers = not self._state.row_by_row
        self._busy = False  # deciding, or acting: what comes in meanwhile follows
        self._scheduled = False  # there will be a turn
        self._held_up = False  # what could not be committed is tried again later, and nothing before it
        self._changed = asyncio.Event()

    # -- what comes in -----------------------------------------------------------------------------------------------

    def put(self, what: Any, sender: str | None = None, *, more: bool = False) -> None:
        """Decide a message, behind what waits, and act; with `more` in the loop's next turn, or with what follows."""
        if not (self._waiting or self._busy or self._held_up or more or self._gathers or self._state.is_inside()):
            self._busy = True
            try:
                self._decide(((what, sender),))
                self._do_effects()
            finally:
                self._busy = False
            if self._waiting:
                self._take_up()
            return
        self._waiting.append((what, sender))
        if self._busy or self._held_up:
            return
        if more or self._gathers or self._state.is_inside():
            if not self._scheduled:
                self._scheduled = True
                self._dispatcher.loop.call_soon(self._turn)
        else:
            self._take_up()

    def decide_here(self, command: c.Command) -> bool:
        """Decide a command in the thread that brings it, and answer by that if a direct line waits; False: not so.

        What else follows is done on the loop, in its order.
        """
        state = self._state
        if state.closed or self._gathers or interpreter.possible():  # in a fork nobody gives the lock back
            return False
        with state.lock:
            if state.closed or self._waiting:
                return False
            try:
                batch = state.commit(obey, command, "")
            except Exception:  # as the loop will find, and say: a full disk, or a defect
                return False
            answer = self._acting.by_thread(batch.effects)
            if answer is None:
                self._effects.append(batch.effects)
        if answer is None:
            self._dispatcher.hand_over(self.act)
        else:
            answer()
        return True

    def run(self, work: Callable[[Batch], object]) -> None:
        """Have work(batch) decide, commit that, and act.

        Raises:
            CatalogError: not committed; nothing has happened.
        """
        with self._state.lock:
            self._effects.append(self._state.commit(work).effects)
        if self._state.is_inside():
            self._dispatcher.call(self.act)
        else:
            self.act()

    async def next_change(self, timeout_s: float) -> None:
        """Return when something has been decided, or after `timeout_s` seconds."""
        self._changed.clear()
        try:
            await asyncio.wait_for(self._changed.wait(), timeout_s)
        except TimeoutError:
            return

    def close(self) -> None:
        """Decide nothing more, and act on nothing later."""
        self._waiting.clear()
        self._effects.clear()
        self._acting.close()

    # -- taking up ---------------------------------------------------------------------------------------------------

    def _turn(self) -> None:
        self._scheduled = False
        self._take_up()

    def _take_up(self) -> None:
        if self._busy:
            return
        self._busy = True
        try:
            while self._waiting and not self._held_up:
                with self._state.lock:  # no thread decides anything between what waits and what it comes to
                    count = min(len(self._waiting), _AT_ONCE)
                    self._decide([self._waiting.popleft() for _ in range(count)])
                self._do_effects()
                if count == _AT_ONCE and self._waiting:
                    self._scheduled = True
                    self._dispatcher.loop.call_soon(self._turn)
                    return
        finally:
            self._busy = False

    def _decide(self, items: Sequence[Item]) -> None:
        try:
            with self._state.lock:  # until what could not be committed waits again: no thread overtakes it
                try:
                    batch = self._state.commit(self._decide_each, items)
                    if batch.effects:
                        self._effects.append(batch.effects)
                except CatalogError as error:
                    self._not_committed(items, error)
        except Exception as error:
            self._registrar.fail(error)

    def _decide_each(self, batch: Batch, items: Sequence[Item]) -> None:
        for item, sender in items:
            if sender is None:
                obey(batch, item, new_id() if type(item) in _STARTING else "")
            elif type(item) is Load:
                self._decide_load(batch, item, sender)
            elif type(item) is Describe:
                self._registrar.servers.describe(batch, item, sender)
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

    def _not_committed(self, items: Sequence[Item], error: CatalogError) -> None:
        """Nothing of these has happened: refuse what can be refused, and do the rest again a little later."""
        logger.error("%s: not committed, nothing was done: %s", self._state.name, error)
        again: list[Item] = []

        def refuse(batch: Batch) -> None:
            again.extend(refuse_uncommitted(batch, items, failure_of(error)))

        self._effects.append(self._state.commit(refuse).effects)
        if again:
            self._waiting.extendleft(reversed(again))
            self._held_up = True
            self._dispatcher.loop.call_later(_RETRY_S, self._try_again)

    def _try_again(self) -> None:
        self._held_up = False
        self._turn()

    # -- acting ------------------------------------------------------------------------------------------------------

    def act(self) -> None:
        """Do what has been decided, in the order of the decisions; and decide what comes in meanwhile behind it."""
        if self._busy:  # it follows what is done now
            return
        self._busy = True
        try:
            self._do_effects()
        finally:
            self._busy = False
        self._take_up()

    def _do_effects(self) -> None:
        try:
            while self._effects:
                self._acting.do(self._effects.popleft())
        except Exception as error:
            self._registrar.fail(error)
        self._changed.set()
