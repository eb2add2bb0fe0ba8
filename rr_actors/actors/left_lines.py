"""LeftLines: loads and unloads that a thread began on a line of its own (direct.py), and has left to its registrar.

The line broke, or the thread gave up: the registrar's actor goes on, or says how it ended.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rr_actors.core import commands as c
from rr_actors.errors import RegistrarDown, RrError
from rr_actors.messages import Failure, error_of
from rr_actors.records import Held, Hold

if TYPE_CHECKING:
    from rr_actors.actors.registrar import LoadWaiter, RegistrarActor, UnloadWaiter


class LeftLines:
    """Those of one registrar. On the loop."""

    def __init__(self, registrar: RegistrarActor) -> None:
        self._registrar = registrar

    def load(self, query_id: str, waiter: LoadWaiter, command: c.Command) -> None:
        """Go on with a load; `waiter` hears how it ends.

        Args:
            command: SendAgain, or GiveUp.
        """
        registrar = self._registrar
        registrar.inbox.catch_up()
        held = registrar.catalog.held.get(query_id)
        hold = held.hold if held is not None else None
        answered = hold is Hold.HELD and not isinstance(command, c.GiveUp)
        noted = any(isinstance(item, c.Ask) and item.query_id == query_id for item, _ in registrar.inbox)
        if not registrar.closed and not answered and (noted or hold in (Hold.PENDING, Hold.HELD)):
            given_up = isinstance(command, c.GiveUp)  # it hears when what becomes of it is on disk
            registrar.loads[query_id] = self._unless_loaded(query_id, waiter) if given_up else waiter
            registrar.post(command)
            registrar.inbox.catch_up()
            return
        registrar.post(command)  # its line is no more
        name = registrar.name
        ended = RegistrarDown(f"registrar {name!r}: the load has ended", registrar=name, status="")
        waiter(held, None if answered else ended)

    def _unless_loaded(self, query_id: str, waiter: LoadWaiter) -> LoadWaiter:
        """Pass on how a load failed; that it is held is not heard by one who has given it up, and will be told so."""

        def ended(held: Held | None, error: RrError | None) -> None:
            if error is None:
                self._registrar.loads[query_id] = ended
            else:
                waiter(held, error)

        return ended

    def unload(self, query_id: str, waiter: UnloadWaiter, refusal: Failure | None = None) -> None:
        """Go on with an unload; `waiter` hears how it ended.

        Args:
            refusal: what the thread's line has answered; without, the line is no more. The client hears of it as well.
        """
        registrar = self._registrar
        registrar.under_way.own_up(query_id)
        if registrar.closed:
            registrar.release(query_id, waiter)
            return
        with registrar.lock:  # no thread is just writing that it is owed
            mine = registrar.unloads.get(query_id, answered_by_line) is answered_by_line
            if mine:
                registrar.unloads[query_id] = waiter
        registrar.inbox.catch_up()
        other = registrar.unloads.get(query_id)
        if mine and other is not waiter:
            return  # it has heard
        if not mine and other is not None:  # refused, and somebody is trying again
            self._join(query_id, waiter, other, refusal)
            return
        registrar.unloads[query_id] = waiter
        held = registrar.catalog.held.get(query_id)
        noted = any(isinstance(item, c.LettingGo) and item.query_id == query_id for item, _ in registrar.inbox)
        if noted or (held is not None and held.hold is Hold.OWED):
            if refusal is None:
                registrar.post(c.SendAgain(query_id))
        elif held is not None and refusal is None:  # refused, by another way
            registrar.post(c.Release(query_id))
        else:
            del registrar.unloads[query_id]
            waiter(error_of(refusal) if held is not None and refusal is not None else None)

    def _join(self, query_id: str, waiter: UnloadWaiter, other: UnloadWaiter, refusal: Failure | None) -> None:
        """Let `waiter` hear that it was refused, or else what `other` hears, who waits already."""
        if refusal is not None:
            waiter(error_of(refusal))
            return

        def ended(error: RrError | None) -> None:
            other(error)
            waiter(error)

        self._registrar.unloads[query_id] = ended


def answered_by_line(_error: RrError | None) -> None:
    """How an unload ended that a thread does by a line of its own: it hears there."""
