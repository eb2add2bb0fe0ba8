"""ShortCuts: what a thread decides and writes by itself, without waiting for the loop.

Letting go of a query that is held: the thread takes the lock of who decides. While nothing but notes waits to be taken
up, what the catalog says is so: it writes that the query is owed, and notes that for the loop. Notes are taken up in
their order and before whatever comes in later, so the loop never decides without them. Not by a thread that a signal
handler may interrupt: one that waits for the loop would wait for ever.

And joining what is loaded and held, by the fast path (RegistrarState.join).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rr_actors.actors import interruptions
from rr_actors.actors.left_lines import answered_by_line
from rr_actors.core import commands as c
from rr_actors.core import holding
from rr_actors.errors import CatalogError
from rr_actors.messages import Load, Loaded

if TYPE_CHECKING:
    from rr_actors.actors.ledger import Ledger
    from rr_actors.actors.registrar import RegistrarActor


class ShortCuts:
    """Those of one registrar. From any thread."""

    def __init__(self, registrar: RegistrarActor, ledger: Ledger) -> None:
        self._registrar = registrar
        self._ledger = ledger

    def let_go(self, query_id: str) -> bool:
        """Have a query owed, for a thread that lets it go by a line of its own; False: not that way.

        The note of a brief hold is taken back; of what is held a row says that it is owed. What waits to be taken up
        may be a status of it: that would find a query that nobody knows, and be done with.

        After True the thread must tell the provider and note what that answers, or leave it to left_lines.
        """
        registrar = self._registrar
        if interruptions.possible():
            return False
        with registrar.lock:
            if not registrar.inbox.is_quiet:
                return False
            return registrar.under_way.let_go(query_id) or self._owe(query_id)

    def _owe(self, query_id: str) -> bool:
        registrar = self._registrar
        row = holding.owed_directly(registrar.catalog, query_id)
        if row is None or query_id in registrar.unloads or registrar.closed:
            return False
        try:
            if not self._ledger.commit_row(row):
                return False
        except CatalogError:  # as the loop will find, and say
            return False
        registrar.unloads[query_id] = answered_by_line
        registrar.inbox.note(c.LettingGo(query_id))
        return True

    def join(self, load: Load, epoch: int) -> Loaded | None:
        """Join what is loaded and held here, for a thread of a consumer in this process; None: it has to ask.

        Args:
            epoch: the consumer's incarnation.
        """
        registrar = self._registrar
        if interruptions.possible():
            return None
        with registrar.lock:
            if not registrar.inbox.is_quiet or not registrar.consumers.listens_to(load.origin, epoch):
                return None
            return registrar.join(load)

    def join_at_once(self, load: Load) -> Loaded | None:
        """Join what is loaded and held here, as the Load comes in on a direct line; None: by the inbox. On the loop."""
        with self._registrar.lock:
            return self._registrar.join(load) if self._registrar.inbox.is_quiet else None
