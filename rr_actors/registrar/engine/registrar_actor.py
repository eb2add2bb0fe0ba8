"""RegistrarActor: has one catalog, and all other parts of one registrar. Its Monitor decides messages and commands.

It lives on the process's loop, with its servers and clients. Nothing here blocks except a commit. Two of its parts are
in this file: the servers that are registered here (Servers), and the types of providers' servers (ServerTypes).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, Protocol

from rr_actors.base.config import RegistrarConfig
from rr_actors.base.errors import (
    CatalogError,
    MailboxFull,
    NameTaken,
    NotSerializable,
    RegistrarDown,
    RrError,
    UsageError,
)
from rr_actors.base.names import ServerId, new_id
from rr_actors.base.steps import Steps
from rr_actors.registrar.core import digests
from rr_actors.registrar.engine.monitor import LoadWaiter, Monitor, RegistrarState, UnloadWaiter, answered_by_line
from rr_actors.registrar.engine.progress import ProgressListeners, ProgressReports
from rr_actors.registrar.engine.server import ServerActor
from rr_actors.registrar.links.consumer_links import Consumers
from rr_actors.registrar.links.provider_link import THREADS, Client
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.messages import Described, Failure, Load, Loaded, LoadRefused, error_of, failure_of
from rr_actors.registrar.model.rows import Change, Drop, Held, Hold, Notice, Put, ServerType
from rr_actors.runtime import interpreter
from rr_actors.runtime.event_loop import FORKED
from rr_actors.storage.store import Store
from rr_actors.wire.name_service import Status
from rr_actors.wire.transport import Attach, Hello, Welcome

_RETRY_S = 0.25

logger = logging.getLogger("rr_actors.registrar")


class Audience(Protocol):
    """The listeners to the queries that this registrar holds."""

    holder: Any  # the Registrar that users call

    def hear(self, held: Held, notice: Notice, heard: Callable[[bool], None], *, repeated: bool) -> None:
        """Run the callbacks that listen to a query, for a status of it.

        Then call `heard` on the loop, with whether one of them has dealt with the status.
        """
        ...

    def forget(self, query_id: str) -> None:
        """Drop the listeners of a query that is not held any more."""
        ...


class RegistrarActor(RegistrarState):
    """One registrar of this process. `node` has what all of them share: dispatcher, transports, directory."""

    def __init__(self, node: Any, name: str, config: RegistrarConfig, store: Store) -> None:
        self.node = node
        self.workers = node.dispatcher.workers
        super().__init__(name, config, store, node.dispatcher.loop, self.workers)
        self._commits.watched = node.watched
        self.serving = False
        self.servers = Servers(self)
        self.clients: dict[str, Client] = {}
        self.callers: set[UnloadWaiter] = set()  # the callbacks of commands whose end somebody waits for
        self.audience: Audience | None = None
        self.callback_failures = 0
        self.on_failure: Callable[[BaseException], None] | None = None
        self.progress = ProgressReports(self)
        self.listeners = ProgressListeners()
        self.consumers = Consumers(self)
        self.types = ServerTypes(self)
        self.monitor = Monitor(self)

    # -- start and stop ------------------------------------------------------------------------------------------

    def settle(self) -> None:
        """Add the rows of all loads in flight, as somebody is about to read all rows.

        Raises:
            CatalogError: with the rows, something has to be written, and that failed.
        """
        if self.catalog.in_flight and not self.closed:
            self.commit(((c.AddInFlight(), None),))

    def begin(self) -> None:
        """Go on with the work that the catalog says was in progress, and look for the providers of its queries."""
        self.lock_in_use(in_use=True)
        self.monitor.run(c.BeginAgain())
        with self.lock:
            providers = {**self.whole().peers, **self.catalog.outbound}
        for provider in providers:
            self.client(provider).want()

    def serve(self) -> None:
        """Let in consumers from now on, and decide the statuses that waited."""
        self.serving = True
        self.monitor.hear_held_back()

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
        self.lock_in_use(in_use=False)
        self._why_down = FORKED

    def down(self) -> RegistrarDown:
        """Return the error that callers of a closed registrar get, with the reason if the process is stopping."""
        if self.node.stopping:
            self._why_down = f"closed, as {self.node.stopping}"
        return super().down()

    def close(self, *, erase: bool = False) -> None:
        """Write unsaved changes, and close the links and the catalog; no query is released. On the loop.

        Each step is tried, also after one that failed.

        Args:
            erase: remove the catalog, unless a provider that is down has to be told that queries are released.

        Raises:
            Exception, ExceptionGroup: the errors of the steps that failed.
        """
        if self.closed:
            return
        self.closed = True
        steps = Steps()
        for part in (self.monitor, self.consumers, *self.clients.values()):
            steps.take(f"closing its {type(part).__name__}", part.close)
        down = self.down()
        loads, self.loads = self.loads, {}
        for load_waiter in loads.values():
            steps.take("telling who loads", load_waiter, None, down)
        unloads, self.unloads = self.unloads, {}
        for waiter in (*unloads.values(), *self.callers):
            steps.take("telling who unloads, or has given a command", waiter, down)
        with self.lock:
            catalog = self.whole()
            told = catalog.outbound.keys() <= catalog.up.keys()
        steps.take("closing its catalog", lambda: self._commits.close(erase=erase and told))
        self.lock_in_use(in_use=False)
        steps.end(f"registrar {self.name!r}: not closed altogether")

    def fail(self, error: Exception) -> None:
        """Close the registrar after a defect. Its supervisor starts it again from its catalog."""
        logger.critical("registrar %s: failed", self.name, exc_info=error)
        self._why_down = "closed after a defect, which the log has; open it again: its catalog is as it was"
        self.close()
        if self.on_failure is not None:
            self.on_failure(error)
        else:  # no supervisor starts it; it may be opened again
            self.node.close_registrar(self.name, Status.DORMANT)

    # -- messages and commands -----------------------------------------------------------------------------------

    def post(self, command: c.Command, *, more: bool = False) -> None:
        """Have the Monitor decide a command. On the loop. `more`: others follow, to be decided together with it."""
        if not self.closed:
            self.monitor.put(command, more=more or self.node.dispatcher.more)

    def join_here(self, load: Load, hello: Hello) -> Loaded | None:
        """Decide a Load of a thread of this process, with the Hello of its line, by the fast path.

        Return None if the Load has to be sent.
        """
        if self.closed or interpreter.possible() or not self.consumers.listens_to(hello):
            return None
        return self.join(load)

    def refusal(self, loaded: Loaded, error: NotSerializable) -> LoadRefused:
        """Return the refusal that replaces an answer that is too long for a frame. On the loop."""
        resource = self.catalog.resources.get(loaded.resource_id)
        server = None if resource is None else self.servers.get(resource.server)
        failure = failure_of(error) if server is None else server.load_failure(error)
        return LoadRefused(loaded.query_id, failure)

    def ask(self, ask: c.Ask, waiter: LoadWaiter) -> None:
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

    def client(self, provider: str) -> Client:
        """Return the client of a provider; make it if there is none."""
        client = self.clients.get(provider)
        if client is None:
            client = self.clients[provider] = Client(self, provider)
        return client

    def held_at(self, provider: str) -> list[Held] | None:
        """Return the rows held at a provider; None while messages wait that could change them."""
        with self.lock:
            return None if self.waiting else digests.held_at(self.whole(), provider)

    def commit_rows(self, changes: list[Change]) -> None:
        """Write rows that need no decision, such as stored servers, as Monitor.run() does. On the loop."""
        self.monitor.run(c.SetRows(changes))

    def commit_counts(self) -> dict[str, int]:
        """Return the number of commits, the number of timed commits, and the microseconds that these took."""
        log = self._commits
        return {"commits": log.count, "timed_commits": log.timed, "commit_us": int(log.timed_s * 1e6)}

    def save(self) -> None:
        """Write the unsaved changes, as CommitLog.save() does."""
        self._commits.save()

    def reload_catalog(self) -> None:
        """Read the catalog from the disk again, and reconcile with all providers and consumers. On the loop.

        Raises:
            UsageError: a load or unload is in flight.
            CatalogError: the catalog cannot be read, or unsaved changes could not be written before.
        """
        with self.lock:  # so that no thread releases a query meanwhile
            if self.busy():
                raise UsageError(f"{self.name}: load_catalog() while a load or unload is in flight; wait for it")
            old = self.whole()
            catalog = Catalog(self.name, self._commits.content(), self.epoch)
            catalog.servers.update(old.servers)
            catalog.listened, catalog.in_flight = old.listened, old.in_flight
            catalog.since = max(catalog.since, old.since, *(row.seq for row in old.held.values()))
            self.catalog = catalog
            self.consumers.close()  # they connect again, and reconcile
            for client in list(self.clients.values()):
                client.link_again()
            self.begin()
            self.servers.register_again()

    def force(self, target: str, waiter: UnloadWaiter) -> None:
        """Unload a resource that others may hold; `waiter` hears how it ended. On the loop."""
        self.post(c.ForceUnload(target, new_id(), waiter))

    def newest_first(self) -> list[str]:
        """Return the queries that this registrar holds, newest first."""
        with self.lock:
            catalog = self.whole()
            return catalog.newest_first(id for id, row in catalog.held.items() if row.hold is not Hold.OWED)

    def forget_peers(self) -> None:
        """Remove all Peer rows: nothing is held anywhere, so the next start has no provider to look for."""
        with self.lock:
            self.commit_rows([Drop("peers", name) for name in self.whole().peers])

    def busy(self) -> bool:
        """Return whether a load or unload is in flight on either side."""
        with self.lock:
            catalog = self.whole()
        waits = self.waiting or self.loads or self.unloads or catalog.in_flight
        return bool(waits or catalog.closings or catalog.recovering or catalog.moving or catalog.unsettled)


class Servers:
    """The servers of one registrar, by name; get() returns None if there is none. On the loop."""

    def __init__(self, registrar: Any) -> None:
        self._registrar = registrar
        self._by_name: dict[str, ServerActor] = {}
        self.get: Callable[[str], ServerActor | None] = self._by_name.get

    def names(self) -> list[str]:
        """Return the names of all servers, in the order in which they were registered."""
        return list(self._by_name)

    def register(self, server: ServerActor) -> None:
        """Add a server, and go on with its resources; raise NameTaken if there is a server of that name."""
        registrar, name = self._registrar, server.spec.name
        old = self._by_name.get(name)
        if old is not None and not old.restored:
            text = f"server {server.origin}: registered already; unregister it first, or take another name"
            raise NameTaken(text, name=name)
        self._by_name[name] = server
        registrar.consumers.tell_all(Described(name, server.facts.types))
        if old is None:
            registrar.post(c.Register(server.facts, new_id()))
        else:
            registrar.catalog.servers[name] = server.facts

    def register_again(self) -> None:
        """Register all servers again, in a catalog that was read anew."""
        for server in self._by_name.values():
            self._registrar.post(c.Register(server.facts, new_id()))

    def unregister(self, name: str, done: Callable[[RrError | None], None]) -> None:
        """Remove a server when all its resources are released; `done` hears how that ended."""
        registrar = self._registrar

        def ended(error: RrError | None) -> None:
            if name not in registrar.catalog.servers:
                self._by_name.pop(name, None)
            done(error)

        registrar.post(c.Unregister(name, new_id(), ended))


class ServerTypes:
    """The types of the servers of one registrar's providers; its catalog keeps them. On the loop."""

    def __init__(self, registrar: Any) -> None:
        self._registrar = registrar
        self._wanting: dict[str, list[Callable[[], None]]] = {}

    def tell(self, server: ServerId, told: Callable[[], None]) -> None:
        """Call `told` when the types of a provider's server are known."""
        if str(server) in self._registrar.catalog.server_types:
            told()
            return
        self._wanting.setdefault(str(server), []).append(told)
        self._registrar.client(server.registrar).describe(server.server, at_once=True)

    def described(self, server: str, blob: bytes) -> None:
        """Keep the types that a provider has sent, and call the callers that wait for them."""
        registrar = self._registrar
        if registrar.closed:
            return
        known = registrar.catalog.server_types.get(server)
        if known is None or known.blob != blob:
            row = ServerType(server, blob)  # written now: after a respawn, on_start reads queries before a link is up
            try:
                registrar.commit_rows([Put(row)])
            except CatalogError as error:  # a full disk, for instance: the callers wait, within their time limits
                logger.warning("%s: the types of %s are written later: %s", registrar.name, server, error)
                registrar.node.dispatcher.loop.call_later(_RETRY_S, self.described, server, blob)
                return
        for told in self._wanting.pop(server, ()):
            told()
