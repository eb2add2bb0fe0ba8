"""ShortCuts: what is decided and written by itself, without the inbox, or without waiting for the loop.

By threads: letting go of a query that is held, joining a resource of this process that is loaded and held, and telling
that a callback has returned, where one direct line waits for that and nothing else follows. The thread takes the lock
of who decides. While nothing but notes waits to be taken up, what the catalog says is so: it writes what changes, and
notes for the loop what it has done. The catalog in memory is the loop's own; notes are taken up in their order and
before whatever comes in later, so the loop never decides without them. Not by a thread that a signal handler may
interrupt: one that waits for the loop would wait for ever.

By the loop, while nothing but notes waits, of what a direct line asks for: joining what is loaded and held, without a
batch; and before the notes, which are not about the same, the first load of a resource, and letting go.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rr_actors.actors import interruptions
from rr_actors.actors.left_lines import answered_by_line
from rr_actors.core import commands as c
from rr_actors.core import holding, loading, unloading
from rr_actors.core.decide import told_directly
from rr_actors.errors import CatalogError
from rr_actors.messages import Load, Loaded, Message, Unload

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
            query = loading.joined_directly(registrar.catalog, load)
            if query is None or not registrar.inbox.is_quiet or not registrar.consumers.listens_to(load.origin, epoch):
                return None
            try:
                if not self._ledger.commit_row(query):
                    return None
                registrar.inbox.note(loading.note_joined(registrar.catalog, query))
            except CatalogError:
                return None
            except BaseException:  # KeyboardInterrupt, say: it may be on disk, and has to be known when it is withdrawn
                registrar.inbox.note(loading.note_joined(registrar.catalog, query))
                raise
            resource = registrar.catalog.resources[query.resource_id]
            return Loaded(query.id, resource.id, resource.response or b"")

    def join_at_once(self, load: Load) -> Loaded | None:
        """Join what is loaded and held here, as the Load comes in on a direct line; None: by the inbox. On the loop."""
        registrar = self._registrar
        catalog = registrar.catalog
        query = loading.joined_directly(catalog, load)
        if query is None:
            return None
        with registrar.lock:
            try:
                if not registrar.inbox.is_quiet or not self._ledger.commit_row_here(query):
                    return None
            except Exception:  # as the batch will find, and say: a full disk, or a defect
                return None
            catalog.set("queries", query.id, query)
        resource = catalog.resources[query.resource_id]
        return Loaded(query.id, resource.id, resource.response or b"")

    def overtakes(self, message: Message) -> bool:
        """Whether what a direct line says is decided before what is noted. On the loop, with the lock."""
        registrar = self._registrar
        if not registrar.inbox.is_quiet or not self._ledger.row_by_row:
            return False
        if type(message) is Load:
            return loading.is_first(registrar.catalog, message)
        return type(message) is Unload and unloading.is_held(registrar.catalog, message)

    def tell(self, done: c.LoadDone | c.UnloadDone) -> bool:
        """Write how a callback has ended, and answer who waits for that, by the thread that ran it; False: by the loop.

        What watchers are told of comes before the answer, so it is the loop that answers while there are any.
        """
        registrar = self._registrar
        routes = registrar.consumers.routes
        if registrar.closed or not routes.lines_wait:  # in a forked child nobody gives the lock back
            return False
        with registrar.lock:
            if registrar.closed or registrar.node.watched or not registrar.inbox.is_quiet:
                return False
            told = told_directly(registrar.catalog, done)
            line = None if told is None else routes.line_of(told.answer)
            answer = None if told is None or line is None else line.answering(told.answer)
            if told is None or answer is None:
                return False
            try:
                if not self._ledger.commit_now(told.changes):
                    return False
            except Exception:  # as the batch will find, and say: a full disk, or a defect
                return False
            routes.answered(told.answer)
            registrar.inbox.note(done)
        answer()
        return True
