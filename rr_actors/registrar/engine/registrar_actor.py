"""RegistrarActor: has one catalog, and all other parts of one registrar. Its monitor decides messages and commands.

It lives on the process's loop, with its servers and clients. Nothing here blocks except a commit.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection

from rr_actors.actors.messaging.exit_reports import ExitReport, abnormal
from rr_actors.actors.turns import CLOSED
from rr_actors.base.errors import MailboxFull, NotSerializable, RegistrarDown, RrError, UsageError
from rr_actors.base.names import new_id
from rr_actors.base.reporting.log import Log
from rr_actors.base.steps import Steps
from rr_actors.base.values.failure import Failure, error_of, failure_of
from rr_actors.registrar.engine.effect_runner import EffectRunner
from rr_actors.registrar.engine.progress import ProgressReports
from rr_actors.registrar.engine.registrar_base import Opening, RegistrarBase
from rr_actors.registrar.engine.registrar_state import LoadWaiter, UnloadWaiter, answered_by_line
from rr_actors.registrar.links.consumer_links import Consumers
from rr_actors.registrar.links.local_line import LocalLine
from rr_actors.registrar.links.provider_link import THREADS, ProviderLink, ProviderLinks, ServerTypes
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.messages import Loaded, LoadRefused, Message
from rr_actors.registrar.model.rows import Held, Hold
from rr_actors.registrar.servers.part_times import PartTimes
from rr_actors.registrar.servers.registered_servers import RegisteredServers
from rr_actors.registrar.servers.server_actor import RequestReader
from rr_actors.registrar.servers.server_base import load_failure
from rr_actors.runtime.callback_errors import raised_by
from rr_actors.runtime.event_loop import FORKED
from rr_actors.runtime.thread_rules import on_loop
from rr_actors.streams.publishers import Publishers
from rr_actors.wire.name_service import Presence
from rr_actors.wire.transport import Attach, Exchange, Hello, Welcome

_RETRY_S = 0.25

logger = Log("rr_actors.registrar")


class RegistrarActor(RegistrarBase):
    """One registrar of this process."""

    def __init__(self, opening: Opening) -> None:
        super().__init__(opening)
        self.callers: set[UnloadWaiter] = set()  # the callbacks of commands whose end somebody waits for
        self.on_defect: Callable[[BaseException], None] | None = None
        self.progress = ProgressReports(self)
        self.part_times = PartTimes()
        self.publishers = Publishers(self.node.config.segments_limit_bytes, self.node.dispatcher.loop)
        self.consumers = Consumers(self)
        self.servers = RegisteredServers(self, self.consumers)
        self.clients = ProviderLinks(self)
        self.types = ServerTypes(self, self.clients)
        self.runner = EffectRunner(self, self.consumers, self.servers, self.clients)
        self.reader = RequestReader(self, self.consumers, self.servers.get)

    # -- start and stop ------------------------------------------------------------------------------------------

    def settle(self) -> None:
        """Add the rows of all loads in flight, as somebody is about to read all rows.

        Raises:
            CatalogError: with the rows, something has to be written, and that failed.
        """
        if self.catalog.in_flight and not self.closed:
            self.commit(((c.AddInFlight(), None),))

    @on_loop
    def begin(self) -> None:
        """Go on with the work that the catalog says was in progress, and look for the providers of its queries."""
        self.lock_in_use(in_use=True)
        self.run(c.BeginAgain())
        if self.serving:  # the catalog is read again
            self.post(c.BeginServing(new_id()))
        with self.lock:
            providers = {**self.whole().peers, **self.catalog.outbound}
        for provider in providers:
            self.client(provider).want()

    @on_loop
    def serve(self) -> None:
        """Let in consumers from now on, and decide the statuses that waited."""
        self.serving = True
        self.servers.open_probes()
        self.post(c.BeginServing(new_id()))
        self.hear_held_back()

    @on_loop
    def accept(self, hello: Hello) -> tuple[Welcome, Attach]:
        """Let in the link of a consumer, or the direct line of a thread of a consumer that has a link already.

        Raises:
            RegistrarDown: the registrar is closed, or not serving yet; its own loads are let in before it serves.
        """
        if self.closed or not (self.serving or hello.origin == self.name):
            status = "stopped" if self.closed else "starting"
            raise RegistrarDown(f"registrar {self.name!r}: {status}", registrar=self.name, status=status)
        return Welcome(self.epoch), self.consumers.attach_direct if hello.kind == THREADS else self.consumers.attach

    def leave_to_parent(self) -> None:
        """Stop using this registrar in a forked child: its links and its catalog belong to the parent process."""
        self.closed = True
        self._why_down = FORKED

    def down(self) -> RegistrarDown:
        """Return the error that callers of a closed registrar get, with the reason if the process is stopping."""
        if self.node.stopping:
            self._why_down = f"closed, as {self.node.stopping}"
        return super().down()

    @on_loop
    def close(self, *, erase: bool = False, report: ExitReport = CLOSED) -> None:
        """Write unsaved changes, and close the links and the catalog; no query is released.

        Each step is tried, also after one that failed.

        Args:
            erase: remove the catalog, unless a provider has to be told that queries are released.
            report: how it ends, for those that monitor it.

        Raises:
            Exception, ExceptionGroup: the errors of the steps that failed.
        """
        if self.closed:
            return
        self.closed = True
        steps = Steps()
        steps.take("dropping what waits", self.drop_all)
        for part in (self.servers, self.consumers, *self.clients.values()):
            steps.take(f"closing its {type(part).__name__}", part.close)
        steps.take("stopping its callbacks", self.stop_callbacks)
        steps.take("closing its streams", self.publishers.close_all)
        down = self.down()
        loads, self.loads = self.loads, {}
        for load_waiter in loads.values():
            steps.take("telling who loads", load_waiter, None, down)
        unloads, self.unloads = self.unloads, {}
        for waiter in (*unloads.values(), *self.callers):
            steps.take("telling who unloads, or has given a command", waiter, down)
        steps.take("noting what callbacks run", self.commit, ((c.EndProcess(), None),))
        steps.take("closing its catalog", self._close_catalog, erase)
        self.lock_in_use(in_use=False)
        steps.take("reporting its end", self.end_life, report)
        steps.end(f"registrar {self.name!r}: not closed altogether")

    def _close_catalog(self, erase: bool) -> None:
        """Close the catalog, also after a defect because of which its rows cannot be looked at."""
        owes = True
        try:
            with self.lock:
                catalog = self.whole()
                owes = bool(catalog.outbound or catalog.peers)
        finally:
            self.commits.close(erase=erase and not owes)

    @on_loop
    def fail(self, error: Exception) -> None:
        """Close the registrar after a defect. Its supervisor starts it again from its catalog."""
        logger.critical("registrar %s: failed", self.name, exc_info=error)
        self._why_down = "closed after a defect, which the log has; open it again: its catalog is as it was"
        steps = Steps()
        steps.take("closing it", functools.partial(self.close, report=abnormal(raised_by(error))))
        if self.on_defect is not None:
            steps.take("reporting its defect", self.on_defect, error)
        else:  # no supervisor starts it; it may be opened again
            steps.take("freeing its name", self.node.close_registrar, self.name, Presence.DORMANT)
        steps.report(logger, f"registrar {self.name!r}: not closed altogether")

    # -- what its parts ask of each other ------------------------------------------------------------------------

    def expel(self, origin: str) -> None:
        self.consumers.expel(origin)

    def fence(self, hosts: Collection[str]) -> None:
        self.consumers.fence(hosts)

    def described(self, server: str, types: bytes) -> None:
        self.types.described(server, types)

    def line(self, hello: Hello) -> Exchange:
        return LocalLine(self.node, self, hello)

    def answer_at_once(self, message: Message, hello: Hello) -> Message | None:
        return None if self.closed else self.consumers.answer_here(message, hello)

    def refusal(self, loaded: Loaded, error: NotSerializable) -> LoadRefused:
        resource = self.catalog.resources.get(loaded.resource_id)
        server = None if resource is None else self.servers.get(resource.server)
        failure = failure_of(error) if server is None else load_failure(error, server.origin)
        return LoadRefused(loaded.query_id, failure)

    # -- loads and unloads ---------------------------------------------------------------------------------------

    @on_loop
    def ask(self, ask: c.AskProvider, waiter: LoadWaiter) -> None:
        """Load; `waiter` hears how the load ended."""
        if self.closed:
            waiter(None, self.down())
            return
        limit = self.node.config.mailbox_limit
        if len(self.loads) >= limit:
            text = f"registrar {self.name!r}: {limit} loads are in flight, its limit (SystemConfig.mailbox_limit)"
            waiter(None, MailboxFull(text, name=self.name, limit=limit))
            return
        self.loads[ask.query_id] = waiter
        self.post(ask)

    @on_loop
    def release(self, query_id: str, waiter: UnloadWaiter) -> None:
        """Release a query of this registrar; `waiter` hears how the release ended."""
        if self.closed:
            waiter(self.down())
            return
        with self.lock:  # a thread may be releasing the query in owe(): it notes that under this lock
            known = query_id in self.unloads
            if not known:
                self.unloads[query_id] = waiter
        if known:
            waiter(error_of(failures.unknown_query(self.catalog, query_id)))
        else:
            self.post(c.Release(query_id))

    # -- loads and unloads that a thread leaves to the loop: its line broke, or it gave up ------------------------

    @on_loop
    def go_on_loading(self, query_id: str, waiter: LoadWaiter, command: c.Command) -> None:
        """Go on with a load that a thread has begun, by Got, SendAgain or GiveUp; `waiter` hears how it ends."""
        if self.closed:
            waiter(None, self.down())
            return
        given_up = isinstance(command, c.GiveUp)  # its caller hears when the end of the load is on disk
        self.loads[query_id] = self._unless_loaded(query_id, waiter) if given_up else waiter
        self.post(command)
        held = self.catalog.held.get(query_id)
        if query_id in self.loads and not self.waiting and (held is None or held.hold is Hold.OWED):
            del self.loads[query_id]
            name = self.name
            waiter(held, RegistrarDown(f"registrar {name!r}: the load has ended", registrar=name, status=""))

    def _unless_loaded(self, query_id: str, waiter: LoadWaiter) -> LoadWaiter:
        """Return a waiter that passes on a failure only: a caller that has given up does not hear of success."""

        def ended(held: Held | None, error: RrError | None) -> None:
            if error is None:
                self.loads[query_id] = ended
            else:
                waiter(held, error)

        return ended

    @on_loop
    def go_on_unloading(self, query_id: str, waiter: UnloadWaiter, refusal: Failure | None = None) -> None:
        """Go on with an unload that a thread has begun by its own line; `waiter` hears how it ends.

        Args:
            refusal: the answer on the thread's line, which the link brings, too; None: the line broke.
        """
        if self.closed:
            waiter(self.down())
            return
        with self.lock:  # so that no thread is in owe() or forget_released() now
            other = self.unloads.get(query_id, answered_by_line)
            held = self.whole().held.get(query_id)
            is_owed = held is not None and held.hold is Hold.OWED
            goes_on = other is answered_by_line and held is not None and (is_owed or refusal is None)
            if goes_on:
                self.unloads[query_id] = waiter
            elif other is answered_by_line:
                self.unloads.pop(query_id, None)
        if other is not answered_by_line:  # the unload was refused, and another caller is trying again
            self._wait_with(query_id, waiter, other, refusal)
        elif not goes_on:
            waiter(error_of(refusal) if held is not None and refusal is not None else None)
        elif not is_owed:  # held again: the link has brought the refusal
            self.post(c.Release(query_id))
        elif refusal is None:
            self.post(c.SendAgain(query_id))

    def _wait_with(self, query_id: str, waiter: UnloadWaiter, other: UnloadWaiter, refusal: Failure | None) -> None:
        """Give `waiter` the refusal of its own unload, or else the result for which `other` waits already."""
        if refusal is not None:
            waiter(error_of(refusal))
            return

        def ended(error: RrError | None) -> None:
            other(error)
            waiter(error)

        self.unloads[query_id] = ended

    # -- clients, rows -------------------------------------------------------------------------------------------

    def client(self, provider: str) -> ProviderLink:
        """Return the client of a provider; make it if there is none."""
        return self.clients[provider]

    def commit_counts(self) -> dict[str, int]:
        """Return the number of commits, the number of timed commits, and the microseconds that these took."""
        log = self.commits
        return {"commits": log.count, "timed_commits": log.timed, "commit_us": int(log.timed_s * 1e6)}

    def save(self) -> None:
        """Write the unsaved changes, as CommitLog.save() does."""
        self.commits.save()

    @on_loop
    def reload_catalog(self) -> None:
        """Read the catalog from the disk again, and reconcile with all providers and consumers.

        Raises:
            UsageError: a load or unload is in flight.
            CatalogError: the catalog cannot be read, or unsaved changes could not be written before.
        """
        with self.lock:  # so that no thread releases a query meanwhile
            if self.busy():
                raise UsageError(f"{self.name}: load_catalog() while a load or unload is in flight; wait for it")
            old = self.whole()
            catalog = self.stored_catalog()
            catalog.servers.update(old.servers)
            catalog.unread.update((id, why) for id, why in old.unread.items() if id in catalog.resources)
            catalog.listened, catalog.in_flight = old.listened, old.in_flight
            catalog.since = max(catalog.since, old.since, *(row.seq for row in old.held.values()))
            self.catalog = catalog
            self.consumers.close()  # they connect again, and reconcile
            for client in list(self.clients.values()):
                client.link_again()
            self.begin()
            self.servers.register_again()

    @on_loop
    def force(self, target: str, waiter: UnloadWaiter) -> None:
        """Unload a resource that others may hold; `waiter` hears how it ended."""
        self.post(c.ForceUnload(target, new_id(), waiter, clears=True))

    @on_loop
    def reload(self, target: str, waiter: UnloadWaiter) -> None:
        """Unload a resource and load it again; `waiter` hears how that ended."""
        self.post(c.Reload(target, waiter))

    @on_loop
    def revoke(self, target: str, why: str, grace_ms: int, waiter: UnloadWaiter) -> None:
        """Have all holders let a resource go; `waiter` hears how that ended."""
        self.post(c.Revoke(target, new_id(), why, grace_ms, waiter))

    def newest_first(self) -> list[str]:
        """Return the queries that this registrar holds, newest first."""
        with self.lock:
            catalog = self.whole()
            return catalog.newest_first(id for id, row in catalog.held.items() if row.hold is not Hold.OWED)

    def begin_closing(self, why: str, *, own: bool = False) -> None:
        """Load nothing for others any more; `own`: nor for this registrar. Callers get `why` in their error."""
        text = f"registrar {self.name!r}: loads nothing any more, as {why}"
        failure = Failure("RegistrarDown", text, {"registrar": self.name, "status": "stopped"})
        self.run(c.BeginClosing(failure, own))

    def end_closing(self) -> None:
        """Have the catalog keep only what is still to be released; raise CatalogError if that cannot be written."""
        self.run(c.EndClosing())

    def busy(self) -> bool:
        """Return whether a load or unload is in flight on either side."""
        with self.lock:
            catalog = self.whole()
        waits = self.waiting or self.loads or self.unloads or catalog.in_flight
        return bool(waits or catalog.closings or catalog.recovering or catalog.moving or catalog.unsettled)
