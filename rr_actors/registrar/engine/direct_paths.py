"""The fast paths for one row: a load that joins others, an unload that leaves others, and those of direct lines."""

from __future__ import annotations

from typing import Protocol

from rr_actors.registrar.core import holding
from rr_actors.registrar.core.loading import join, loaded
from rr_actors.registrar.core.unloading import leave
from rr_actors.registrar.engine.registrar_state import LoadWaiter, RegistrarState, answered_by_line, may_be_interrupted
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.catalog import ABSENT
from rr_actors.registrar.model.messages import Load, Loaded, Unload, Unloaded
from rr_actors.registrar.model.rows import OK, PENDING, Held


class Asked(Protocol):
    """The query that a thread is about to load."""

    id: str
    registrar: str
    server: str
    parent: str


class DirectPaths(RegistrarState):
    """The catalog of one registrar, with the fast paths of threads that load and release by their own direct lines."""

    def join(self, load: Load) -> Loaded | None:
        """Decide a Load by the fast path, and write its row. Return None if it has to be decided like any message.

        The loop calls it, and a thread of this process that loads.
        """
        with self.lock:
            catalog = self.catalog
            if catalog.unfinished is not None:
                self.whole()
            query = None if self.waiting else join(catalog, load)
            if query is None:
                return None
            try:
                catalog.unfinished = [("queries", query.id, ABSENT)]
                written = self.commits.commit_row(query)
                if written:
                    catalog.set("queries", query.id, query)
                    catalog.joined[load.server] = catalog.joined.get(load.server, 0) + 1
                catalog.unfinished = None
            except Exception:  # a defect: decide() will meet it again, and report it
                return None
            if not written:
                return None
            return loaded(catalog, query.id, catalog.resources[query.resource_id])

    def leave(self, unload: Unload) -> Unloaded | None:
        """Decide an Unload of a resource that others hold, too. Return None if the loop has to decide it.

        A thread of this process calls it. If it is interrupted behind the commit, the query is released, and the thread
        does not get the answer.
        """
        with self.lock:
            if self.waiting or self.closed or not leave(self.whole(), unload):
                return None
            try:
                self.commit(((unload, unload.origin),))
            except Exception:  # a full disk, or a defect: the loop will meet it again, and report it
                return None
            return Unloaded(unload.query_id)

    def begin_directly(
        self, query: Asked, request: bytes, ended: LoadWaiter, priority: int = 0, own: bool = False
    ) -> Load | None:
        """Note a load that the calling thread is about to send; return None if the loop has to send or refuse it.

        If the load ends by another way than the thread's, `ended` hears how. `own`: the caller gave a priority.
        """
        id, registrar, server, parent = query.id, query.registrar, query.server, query.parent
        attempt, seq = 0, next(self.sequence)
        if self.catalog.shut:
            return None
        if not parent:
            self.loads[id] = ended  # without the lock: the id is new, and each dict takes it in one step
            asked = Held(id, registrar, server, request, None, "", "", 0, seq, PENDING, OK, priority, own)
            self.catalog.in_flight[id] = asked
        elif may_be_interrupted():
            return None
        else:
            with self.enter():
                resource = self.whole().resources.get(parent)
                if resource is None:
                    return None
                attempt = resource.attempt
                if not own:
                    priority = self.catalog.inherited(parent)
                self.loads[id] = ended
                asked = Held(id, registrar, server, request, None, "", parent, attempt, seq, PENDING, OK, priority, own)
                self.catalog.in_flight[id] = asked
        return Load(id, server, request, self.name, parent, attempt, seq, priority, own)

    def hold(self, answer: Loaded | c.Got) -> bool:
        """Add the row of a query that a thread has loaded. Return False if the answer has to be decided, as Got."""
        if self.closed or may_be_interrupted():
            return False
        with self.lock:
            catalog = self.catalog
            if catalog.unfinished is not None:
                self.whole()
            if self.waiting:
                return False
            held = holding.hold(catalog, self.commits.unsaved, answer)
            if held:
                self.loads.pop(answer.query_id, None)
                if not self.commits.saving:
                    self.commits.save_soon()
            return held

    def forget_refused(self, query_id: str) -> bool:
        """Forget a load that was refused to its thread. Return False if the loop may know of it, and has to end it."""
        if may_be_interrupted():
            return False
        with self.lock:
            catalog = self.whole()
            if query_id not in catalog.in_flight:
                return False
            self.loads.pop(query_id, None)
            del catalog.in_flight[query_id]
            return True

    def owe(self, query_id: str) -> bool:
        """Mark as owed a query that a thread releases by its own line; return False if Release has to be decided.

        The row is written, a moment later if the disk has nothing of the query: after an earlier crash the provider
        says whether it is still held. After True the thread must tell the provider. It then passes the answer to
        forget_released(), or leaves the release to the registrar's actor.
        """
        if self.closed or may_be_interrupted():
            return False
        with self.lock:
            if self.waiting or self.closed or query_id in self.unloads:
                return False
            catalog = self.catalog
            if catalog.unfinished is not None:
                self.whole()
            is_owed = holding.owe(catalog, self.commits.unsaved, query_id, self.commits.commit_row)
            if is_owed:
                self.unloads[query_id] = answered_by_line
            return is_owed

    def forget_released(self, query_id: str) -> bool:
        """Forget a query that its provider has released after owe(); return False if Unloaded has to be decided."""
        if self.closed:
            return False
        with self.lock:
            if self.waiting:
                return False
            catalog = self.catalog
            if catalog.unfinished is not None:
                self.whole()
            gone = holding.forget_released(catalog, self.commits.unsaved, query_id)
            if gone:
                self.unloads.pop(query_id, None)
                if not self.commits.saving:
                    self.commits.save_soon()
            return gone
