"""RegistrarActor: owns one catalog, and all that belongs to one registrar. Its Monitor decides what comes in.

It lives on the process's loop, and its servers and clients with it. Nothing here blocks but the commit.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, Protocol

from rr_actors.base.config import RegistrarConfig
from rr_actors.base.errors import MailboxFull, NotSerializable, RegistrarDown, RrError, UsageError
from rr_actors.base.names import new_id
from rr_actors.base.steps import Steps
from rr_actors.registrar.core import digests
from rr_actors.registrar.engine.monitor import LoadWaiter, Monitor, RegistrarState, UnloadWaiter, answered_by_line
from rr_actors.registrar.engine.progress import ProgressListeners, ProgressReports
from rr_actors.registrar.engine.server_table import Servers, ServerTypes
from rr_actors.registrar.links.consumer_links import Consumers
from rr_actors.registrar.links.provider_link import Client
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.messages import (
    Failure,
    Load,
    Loaded,
    LoadRefused,
    error_of,
    failure_of,
)
from rr_actors.registrar.model.rows import Change, Drop, Held, Hold, Notice
from rr_actors.runtime import interpreter
from rr_actors.runtime.event_loop import FORKED
from rr_actors.storage.store import Store
from rr_actors.wire.transport import Attach, Hello, Welcome

logger = logging.getLogger("rr_actors.registrar")


class Audience(Protocol):
    """Who hears of what this registrar holds."""

    @property
    def holder(self) -> Any:
        """The Registrar that people use."""
        ...

    def hear(self, held: Held, notice: Notice, heard: Callable[[bool], None], *, repeated: bool) -> None:
        """A status for one of its queries; `heard` is called on the loop when its callbacks are through, with whether
        one of them has dealt with it."""
        ...

    def forget(self, query_id: str) -> None:
        """A query is held no more."""
        ...


class RegistrarActor(RegistrarState):
    """One registrar of this process.

    Args:
        node: the process's runtime: dispatcher, transports, directory.
        name: the registrar's.
        store: its catalog's storage, open.
    """

    def __init__(self, node: Any, name: str, config: RegistrarConfig, store: Store) -> None:
        self.node = node
        self.workers = node.dispatcher.workers
        super().__init__(name, config, store, node.dispatcher.loop, self.workers)
        self._commits.watched = node.watched
        self.serving = False
        self.servers = Servers(self)
        self.clients: dict[str, Client] = {}
        self.audience: Audience | None = None
        self.callback_failures = 0
        self.on_failure: Callable[[BaseException], None] | None = None
        self.progress = ProgressReports(self)
        self.listeners = ProgressListeners()
        self.consumers = Consumers(self)
        self.types = ServerTypes(self)
        self.monitor = Monitor(self)

    # -- life ----------------------------------------------------------------------------------------------------

    def settle(self) -> None:
        """Have a row of all that threads are loading: somebody is about to look at all that there is.

        Raises:
            CatalogError: it has to be written where, and that is not possible.
        """
        if self.catalog.in_flight and not self.closed:
            self.commit(((c.AddInFlight(), None),))

    def begin(self) -> None:
        """Take up what the catalog says was going on, and look for the providers of what it holds."""
        self.lock_in_use(in_use=True)
        self.monitor.run(c.BeginAgain())
        with self.lock:
            providers = {**self.whole().peers, **self.catalog.outbound}
        for provider in providers:
            self.client(provider).want()

    async def next_change(self, timeout_s: float) -> None:
        """Return when something has been decided, or after `timeout_s` seconds."""
        await self.monitor.next_change(timeout_s)

    def serve(self) -> None:
        """From now on others are let in, and statuses that were waiting are heard."""
        self.serving = True
        self.monitor.hear_held_back()

    def accept(self, hello: Hello) -> tuple[Welcome, Attach]:
        """Let a consumer in.

        Raises:
            RegistrarDown: not serving yet (its own loads excepted), or no longer.
        """
        if self.closed or not (self.serving or hello.origin == self.name):
            status = "stopped" if self.closed else "starting"
            raise RegistrarDown(f"registrar {self.name!r}: {status}", registrar=self.name, status=status)
        return Welcome(self.epoch), self.consumers.attach(hello.origin)

    def accept_direct(self, hello: Hello) -> tuple[Welcome, Attach]:
        """Let in a thread of a consumer that has a link already.

        Raises:
            RegistrarDown: not serving.
        """
        welcome, _ = self.accept(hello)
        return welcome, self.consumers.attach_direct(hello.origin)

    def leave_to_parent(self) -> None:
        """In a forked child: take nothing, and give nothing back."""
        self.closed = True
        self.lock_in_use(in_use=False)
        self._why_down = FORKED

    def down(self) -> RegistrarDown:
        """See RegistrarState: where all registrars of this process are being closed, it says why."""
        if self.node.stopping:
            self._why_down = f"closed, as {self.node.stopping}"
        return super().down()

    def close(self, *, erase: bool = False) -> None:
        """Write what is unsaved and let everything go; nothing is released. Each step is tried. On the loop.

        Raises:
            Exception, ExceptionGroup: what went wrong.
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
        for unload_waiter in unloads.values():
            steps.take("telling who unloads", unload_waiter, down)
        steps.take("closing its catalog", lambda: self._commits.close(erase=erase))
        self.lock_in_use(in_use=False)
        steps.end(f"registrar {self.name!r}: not closed altogether")

    def fail(self, error: Exception) -> None:
        """A defect: the actor cannot go on. Its supervisor starts it again from its catalog."""
        logger.critical("registrar %s: failed", self.name, exc_info=error)
        self._why_down = "closed after a defect, which the log has; open it again: its catalog is as it was"
        self.close()
        if self.on_failure is not None:
            self.on_failure(error)
        else:
            self.node.registrar_failed(self.name)

    # -- what comes in -------------------------------------------------------------------------------------------

    def post(self, command: c.Command, *, more: bool = False) -> None:
        """Give the registrar a command; on the loop. `more`: others follow, to be decided together."""
        if not self.closed:
            self.monitor.put(command, more=more or self.node.dispatcher.more)

    def join_here(self, load: Load, epoch: int) -> Loaded | None:
        """Join what is loaded and held here, for a thread of a consumer in this process; None: it has to ask.

        Args:
            epoch: the consumer's incarnation.
        """
        if self.closed or interpreter.possible() or not self.consumers.listens_to(load.origin, epoch):
            return None
        return self.join(load)

    def refusal(self, loaded: Loaded, error: NotSerializable) -> LoadRefused:
        """What a consumer hears instead of an answer that is too long for a frame; on the loop."""
        resource = self.catalog.resources.get(loaded.resource_id)
        server = None if resource is None else self.servers.get(resource.server)
        failure = failure_of(error) if server is None else server.load_failure(error)
        return LoadRefused(loaded.query_id, failure)

    def ask(self, ask: c.Ask, waiter: LoadWaiter) -> None:
        """Load: `waiter` hears how it ended."""
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
        """Unload a query of one's own; `waiter` hears how it ended."""
        if self.closed:
            waiter(self.down())
            return
        with self.lock:  # a thread that has looked, and is letting it go, is first
            known = query_id in self.unloads
            if not known:
                self.unloads[query_id] = waiter
        if known:
            waiter(error_of(failures.unknown_query(self.catalog, query_id)))
        else:
            self.post(c.Release(query_id))

    # -- what threads leave to the loop: the line broke, or the thread gave up ------------------------------------

    def go_on_loading(self, query_id: str, waiter: LoadWaiter, command: c.Command) -> None:
        """Go on with a load that a thread has begun by itself; `waiter` hears how it ends.

        Args:
            command: Got, SendAgain or GiveUp.
        """
        if self.closed:
            waiter(None, self.down())
            return
        given_up = isinstance(command, c.GiveUp)  # it hears when what becomes of it is on disk
        self.loads[query_id] = self._unless_loaded(query_id, waiter) if given_up else waiter
        self.post(command)
        held = self.catalog.held.get(query_id)
        if query_id in self.loads and not self.waiting and (held is None or held.hold is Hold.OWED):
            del self.loads[query_id]
            name = self.name
            waiter(held, RegistrarDown(f"registrar {name!r}: the load has ended", registrar=name, status=""))

    def _unless_loaded(self, query_id: str, waiter: LoadWaiter) -> LoadWaiter:
        """Pass on how a load failed; that it is held is not heard by one who has given it up, and will be told so."""

        def ended(held: Held | None, error: RrError | None) -> None:
            if error is None:
                self.loads[query_id] = ended
            else:
                waiter(held, error)

        return ended

    def go_on_unloading(self, query_id: str, waiter: UnloadWaiter, refusal: Failure | None = None) -> None:
        """Go on with an unload that a thread has begun by a line of its own; `waiter` hears how it ended.

        Args:
            refusal: what the thread's line has answered; without, the line is no more. The client hears of it as well.
        """
        if self.closed:
            waiter(self.down())
            return
        with self.lock:  # no thread is just letting it go
            other = self.unloads.get(query_id, answered_by_line)
            held = self.whole().held.get(query_id)
            is_owed = held is not None and held.hold is Hold.OWED
            goes_on = other is answered_by_line and held is not None and (is_owed or refusal is None)
            if goes_on:
                self.unloads[query_id] = waiter
            elif other is answered_by_line:
                self.unloads.pop(query_id, None)
        if other is not answered_by_line:  # refused, and somebody is trying again
            self._wait_with(query_id, waiter, other, refusal)
        elif not goes_on:
            waiter(error_of(refusal) if held is not None and refusal is not None else None)
        elif not is_owed:  # refused, by another way
            self.post(c.Release(query_id))
        elif refusal is None:
            self.post(c.SendAgain(query_id))

    def _wait_with(self, query_id: str, waiter: UnloadWaiter, other: UnloadWaiter, refusal: Failure | None) -> None:
        """Let `waiter` hear that it was refused, or else what `other` hears, who waits already."""
        if refusal is not None:
            waiter(error_of(refusal))
            return

        def ended(error: RrError | None) -> None:
            other(error)
            waiter(error)

        self.unloads[query_id] = ended

    # -- clients, rows -------------------------------------------------------------------------------------------

    def client(self, provider: str) -> Client:
        """The client of a provider, made if there is none."""
        client = self.clients.get(provider)
        if client is None:
            client = self.clients[provider] = Client(self, provider)
        return client

    def held_at(self, provider: str) -> list[Held] | None:
        """What is held there; None while anything is not decided, as it could change that."""
        with self.lock:
            return None if self.waiting else digests.held_at(self.whole(), provider)

    def commit_rows(self, changes: list[Change]) -> None:
        """Write rows that no decision is about: stored servers. On the loop.

        Raises:
            CatalogError: not written.
        """
        self.monitor.run(c.SetRows(changes))

    def consumer_lost(self, origin: str) -> None:
        """A consumer's link is down, or another has taken its place."""
        if not self.closed:
            self.post(c.ConsumerLost(origin))

    def commit_counts(self) -> dict[str, int]:
        """How many commits there were, and of those during recordings how many, and microseconds."""
        log = self._commits
        return {"commits": log.count, "timed_commits": log.timed, "commit_us": int(log.timed_s * 1e6)}

    def save(self) -> None:
        """Write what has not been written yet.

        Raises:
            CatalogError: it was not.
        """
        self._commits.save()

    def reload_catalog(self) -> None:
        """Take the catalog as it is on disk, and agree anew with providers and consumers. On the loop.

        Raises:
            UsageError: a load or unload is in flight.
            CatalogError: it cannot be read, or what had to be written before could not be.
        """
        with self.lock:  # meanwhile no thread lets anything go
            if self.busy():
                raise UsageError(f"{self.name}: load_catalog() while a load or unload is in flight; wait for it")
            old = self.whole()
            catalog = Catalog(self.name, self._commits.content(), self.epoch)
            catalog.servers.update(old.servers)
            catalog.listened, catalog.in_flight = old.listened, old.in_flight
            catalog.seq = catalog.since = max(catalog.seq, old.seq)
            self.catalog = catalog
            self.consumers.close()  # they connect again, and hear what is not here any more
            for client in list(self.clients.values()):
                client.link_again()
            self.begin()
            self.servers.register_again()

    def force(self, target: str, waiter: UnloadWaiter) -> None:
        """Unload a resource that others may hold; `waiter` hears how it ended. On the loop."""
        self.post(c.ForceUnload(target, new_id(), waiter))

    def force_at_stop(self, resource_id: str, waiter: UnloadWaiter, why: str) -> None:
        """As force(), because this registrar is being closed."""
        self.post(c.ForceUnload(resource_id, new_id(), waiter, f"unloaded, as {why}"))

    def newest_first(self) -> list[str]:
        """The queries this registrar holds for itself, newest first."""
        with self.lock:
            catalog = self.whole()
            return catalog.newest_first(id for id, row in catalog.held.items() if row.hold is not Hold.OWED)

    def forget_peers(self) -> None:
        """Nothing is held anywhere: there is nobody to look for when this catalog is opened again."""
        with self.lock:
            self.commit_rows([Drop("peers", name) for name in self.whole().peers])

    def busy(self) -> bool:
        """Whether a load or unload is in flight on either side."""
        with self.lock:
            catalog = self.whole()
        waits = self.waiting or self.loads or self.unloads or catalog.in_flight
        return bool(waits or catalog.closings or catalog.recovering or catalog.moving or catalog.unsettled)
