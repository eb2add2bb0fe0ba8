"""Node: one process's part of a system, with the registrars that are open in it."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from rr_actors.actors.messaging.message_notes import notes
from rr_actors.base.config import RegistrarConfig
from rr_actors.base.errors import (
    CatalogError,
    NameTaken,
    RegistrarDown,
    RrError,
    Unavailable,
    UnknownQuery,
    UnknownRegistrar,
    counted,
)
from rr_actors.base.names import CONNECTED, REGISTRAR, new_id
from rr_actors.base.reporting.log import Log
from rr_actors.base.steps import Steps
from rr_actors.base.values.failure import Failure
from rr_actors.hosting.process_node import ProcessNode, SystemInfo
from rr_actors.registrar.engine.bulk_release import Releases
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.engine.registrar_base import Opening
from rr_actors.registrar.links.provider_link import THREADS
from rr_actors.registrar.links.recorder import Recorder
from rr_actors.registrar.links.remote_calls import KIND, Door, HandleLine, HandleMessage
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.commands import ForceUnload, GiveUp
from rr_actors.registrar.model.messages import Fetch, Gone, Message, retired
from rr_actors.registrar.model.store import Store
from rr_actors.registrar.servers.callback_context import current_or_none, serving
from rr_actors.runtime.garbage import left_alone
from rr_actors.wire.name_service import NameEntry, Presence, registrar_key
from rr_actors.wire.transport import Attach, Hello, Link, Welcome

logger = Log("rr_actors")

_GONE = Presence.GONE
_RECONCILE_S = 1.0
"""How long a registrar that comes back waits for the lists of running providers before it is used."""
_RECOVER_S = 2.0
"""How long on_start and the other servers of a registrar wait for its recover callbacks."""
_REMOVE_S = 2.0
_REMOVED_AT_ONCE = 16
_HEARD_S = 1.0
_TELL_S = 5.0  # how long a provider may take to write that a registrar is gone
_LOOK_AGAIN_S = 0.05  # a provider that goes away meanwhile sends nothing

MESSAGES: dict[str, Any] = {"registrar": Message, THREADS: Message, KIND: HandleMessage}
"""The message type of each kind of link to a registrar."""


Whole = tuple[str, str]
"""The name of a registrar, and the id of a resource that it serves."""


class Node(ProcessNode):
    """This process's part of a system, with its registrars, and the handles on registrars of other processes.

    Args:
        open_catalog: opens the catalog of a registrar in the system's state directory; it blocks.
        remove_unneeded: removes those catalogs of registrars there that have nothing to be missed; it blocks.
    """

    def __init__(
        self,
        info: SystemInfo,
        path: str = "root",
        *,
        on_event: Callable[[dict[str, Any]], None],
        open_catalog: Callable[[RegistrarConfig, str], Store],
        remove_unneeded: Callable[[Sequence[str], str], None],
    ) -> None:
        super().__init__(info, path, MESSAGES, on_event=on_event)
        self.registrars: dict[str, RegistrarActor] = {}
        self.recorder = Recorder(path, self.dispatcher, self.emit, self._sender)
        notes.begin(self.watched, self.recorder)
        self._open_catalog = open_catalog
        self._remove_catalogs = remove_unneeded
        self._opening: set[str] = set()  # names of registrars whose catalogs are being read
        self._left: set[str] = set()  # names of registrars that are gone for good, with catalogs to be looked at
        self._removing: asyncio.Task[None] | None = None
        self._closing = False
        self._handles: dict[str, HandleLine] = {}

    def _sender(self) -> tuple[str, str]:
        running = current_or_none()
        return (self.path, "") if running is None else (serving(running).path, running.resource_id)

    async def _close(self, steps: Steps) -> None:
        steps.take("sending what is recorded", self.recorder.close)
        steps.take("ending the notes of messages", notes.end, self.recorder)
        for name in list(self.registrars):
            steps.take(f"closing registrar {name!r}", self.close_registrar, name, Presence.STOPPED)
        for line in list(self._handles.values()):
            steps.take("closing the line of a handle", line.close)
        self._closing = True
        if self._removing is not None:  # from now on the state directory may be another system's
            await asyncio.wait((self._removing,))
        await super()._close(steps)

    def accept(self, hello: Hello) -> tuple[Welcome, Attach]:
        """Accept a link for a registrar or for the actors of this process."""
        if hello.kind not in ("registrar", THREADS, KIND):
            return super().accept(hello)
        registrar = self.registrars.get(hello.to)
        if registrar is not None:
            if hello.kind != KIND:
                return registrar.accept(hello)
            if registrar.audience is not None:
                return Welcome(0), functools.partial(Door, self, registrar.audience.holder)
        raise UnknownRegistrar(f"registrar {hello.to!r}: not in this process", registrar=hello.to)

    def handle(self, registrar: str) -> HandleLine:
        """Return the line to a registrar of another process, for its handle. From any thread."""
        if registrar not in self._handles:  # of the lines that several threads make at once, all take the first
            self._handles.setdefault(registrar, HandleLine(self, registrar))
        return self._handles[registrar]

    def find(self, registrar: str) -> NameEntry | None:
        """Return the entry of a registrar: this process's if it is open here, else the directory's; None if unknown."""
        if registrar in self.registrars:
            return NameEntry(Presence.UP, self.local.address)
        return super().find(registrar)

    def statuses(self) -> dict[str, Presence]:
        """Return the statuses of the system's registrars that are not gone, by name."""
        found = ((name, self.status_of(name)) for name in sorted({*self.directory.registrars(), *self.registrars}))
        return {name: status for name, status in found if status is not None and status is not _GONE}

    # -- registrars ----------------------------------------------------------------------------------------------

    async def open_registrar(self, name: str, config: RegistrarConfig, manager: str = "") -> RegistrarActor:
        """Lock and read a catalog, and continue its unfinished work. `serve_registrar` accepts the links of others.

        Args:
            manager: the path of the manager that it is for; without one it is the application's.

        Raises:
            NameTaken: the registrar is open in this process already, or up in another.
            CatalogError: the catalog is locked, damaged or of another version, or cannot be written.
        """
        if name in self.registrars or name in self._opening:
            raise NameTaken(f"registrar {name!r}: open already in this process; close it first", name=name)
        entry = self.find(name)
        deaths = ""
        if entry is not None and entry.status is Presence.STARTING:
            deaths = entry.why
            self._announce(config, had_process=bool(deaths))
        if self.info.place is not None:
            self.info.place.check()
        self._opening.add(name)
        try:
            with left_alone():  # the rows stay, perhaps a million of them
                store = await self._open_store(config)
                path = f"{manager}/{REGISTRAR}" if manager else name
                known = self.registrars, self.recorder
                registrar = RegistrarActor.made(path, Opening(self, name, config, store, *known, manager or self.path))
                registrar.begin_life(self.dispatcher, self.hub)
                registrar.catalog.deaths = deaths
                self.registrars[name] = registrar
                registrar.begin()
        finally:
            self._opening.discard(name)
        return registrar

    def _announce(self, config: RegistrarConfig, *, had_process: bool) -> None:
        """Write where a starting registrar will be, for its consumers to prepare while a catalog is read."""
        if had_process or os.path.exists(config.catalog_path(self.info.state_dir)):
            self.directory.announce(registrar_key(config.name), self.transport.address)

    async def _open_store(self, config: RegistrarConfig) -> Store:
        """Open a catalog. If that is cancelled, as by Ctrl-C, close the catalog."""
        opening = asyncio.ensure_future(self.dispatcher.workers.run(self._open_catalog, config, self.info.state_dir))
        try:
            return await asyncio.shield(opening)
        except asyncio.CancelledError:
            await asyncio.wait((opening,))
            if opening.exception() is None:
                await self.dispatcher.workers.run(opening.result().close)
            raise

    async def settle(self, registrar: RegistrarActor) -> None:
        """Wait at most 2 s for the recover callbacks to end, and at most 1 s for the lists of providers that are up.

        Reloads begin when on_start has returned, so they are not waited for.
        """
        deadline = time.monotonic() + _RECOVER_S
        while not registrar.closed and time.monotonic() < deadline:
            with registrar.lock:
                catalog = registrar.whole()
                if catalog.recovering.keys() <= catalog.early.keys():
                    break
            await registrar.next_change(_LOOK_AGAIN_S)
        deadline = time.monotonic() + _RECONCILE_S
        while time.monotonic() < deadline and not registrar.closed:
            with registrar.lock:
                catalog = registrar.whole()
                waiting = [peer for peer in catalog.peers if peer not in catalog.up and peer != registrar.name]
            if not any(self.status_of(peer) is Presence.UP for peer in waiting):
                return
            await registrar.next_change(_LOOK_AGAIN_S)
        logger.info("%s: not all providers have answered within %g s", registrar.name, _RECONCILE_S)

    def serve_registrar(self, registrar: RegistrarActor) -> None:
        """Accept the links of others, publish the registrar's address, and drop the origins that are gone.

        In this order: retire() marks an origin as gone, and then tells the registrars whose address it finds.
        """
        registrar.serve()
        self.directory.publish(registrar_key(registrar.name), self.transport.address)
        with registrar.lock:
            catalog = registrar.whole()
            origins = {**catalog.by_origin, **catalog.notices_to}
        for origin in filter(self._is_gone, origins):
            registrar.receive(Gone(origin), origin)

    def _is_gone(self, registrar: str) -> bool:
        status = self.status_of(registrar)
        if status is not None or not registrar.startswith(CONNECTED):
            return status is _GONE
        # If an application is killed, its next start alone gives up these. Later ones find no catalog of them.
        return not os.path.exists(self.config.registrar(registrar).catalog_path(self.info.state_dir).parent)

    def close_registrar(self, name: str, status: Presence | None) -> None:
        """Close a registrar if it is open, and write its status into the directory; None: write nothing."""
        registrar = self.registrars.pop(name, None)
        if registrar is not None:
            steps = Steps()
            if status is _GONE:
                for client in registrar.clients.values():
                    steps.take(f"taking leave of {client.provider}", client.take_leave)
            erase = status is _GONE and registrar.config.erase_on_destruct
            steps.take("closing it", lambda: registrar.close(erase=erase))
            if status is not None and self._ours(name):
                steps.take("leaving word of it", self.directory.mark, registrar_key(name), status)
            steps.end(f"registrar {name!r}: not closed altogether")

    def _ours(self, name: str) -> bool:
        entry = self.directory.lookup(registrar_key(name))
        return entry is None or entry.status is not Presence.UP or entry.address == self.transport.address

    async def dismiss(self, names: Sequence[str], timeout_s: float | None) -> None:
        """Wind registrars down, each within `timeout_s`, while all of them serve; then close them for good.

        Consumers come before their providers, so a whole is unloaded before its parts, and its releases are answered.

        Raises:
            Exception, ExceptionGroup: the errors of the steps; the registrars are closed all the same.
        """
        steps, left = Steps(), list(names)
        while left:
            name = next((name for name in left if not self._provides_for(name, left)), left[0])  # else they form a ring
            left.remove(name)
            what = f"releasing what registrar {name!r} holds, and unloading what it serves"
            await steps.take_async(what, self.wind_down(name, timeout_s))
        for name in names:
            config = None if (registrar := self.registrars.get(name)) is None else registrar.config
            steps.take(f"closing registrar {name!r}", self.close_registrar, name, _GONE)
            if config is not None:
                self._look_whether_needed(config)
            self.owners.pop(name, None)
        steps.end("not all registrars are closed as they should be")

    def _provides_for(self, provider: str, consumers: Sequence[str]) -> bool:
        """Return whether one of these registrars holds something at the provider, which is another."""
        for name in consumers:
            if name != provider and (registrar := self.registrars.get(name)) is not None:
                registrar.settle()
                with registrar.lock:
                    if registrar.whole().outbound.get(provider):
                        return True
        return False

    async def wind_down(self, name: str, timeout_s: float | None) -> None:
        """Wind a registrar down for good: release all it holds and unload all it serves, within `timeout_s`.

        While the whole process stops, what other registrars of the process serve on top of it is unloaded before.
        """
        registrar = self.registrars.get(name)
        if registrar is None or registrar.closed:
            return
        registrar.begin_closing(self._why_closing(registrar))
        try:
            await asyncio.wait_for(self._release_everything(registrar), timeout_s)
        except TimeoutError:
            left = len(registrar.catalog.held), len(registrar.catalog.resources)
            queries, resources = counted(left[0], "query"), counted(left[1], "resource")
            logger.warning("%s: closed with %s and %s left", name, queries, resources)
        if not registrar.closed:
            try:
                registrar.end_closing()
            except CatalogError as error:
                logger.warning("%s: opened again it will look for providers that it needs no more: %s", name, error)

    async def _release_everything(self, registrar: RegistrarActor) -> None:
        registrar.settle()
        self._withdraw_loads(registrar)
        releases: Releases | None = None
        try:
            if self.stopping:
                await self._unload_wholes(registrar)
            await self._unload_everything(registrar)
            tried: set[str] = set()
            for _ in range(2):
                queries = [query_id for query_id in registrar.newest_first() if query_id not in tried]
                if releases is not None and not queries:
                    break
                tried.update(queries)
                owed = self._owed_to_absent(registrar, queries)
                released = _AllDone(self.dispatcher.loop, len(queries) - len(owed), registrar.name)
                releases = Releases(registrar, queries, functools.partial(_unless_owed, released, owed))
                await released.future
                if owed:
                    releases.hurry()
                registrar.begin_closing(self._why_closing(registrar), own=True)
                registrar.settle()  # what is owed is so on disk then
                self._withdraw_loads(registrar)  # and what threads have loaded meanwhile is released, too
            await self._until_heard(registrar)
        except asyncio.CancelledError:
            if releases is None:  # a callback does not end: only its own resource's parts wait for it
                with registrar.lock:
                    held = registrar.whole().held
                    queries = [query_id for query_id in registrar.newest_first() if not held[query_id].parent]
                releases = Releases(registrar, queries, lambda _query_id, _error: None)
            releases.hurry()
            registrar.settle()  # all of them are owed then, on disk
            raise

    async def _until_heard(self, registrar: RegistrarActor) -> None:
        """Wait at most 1 s for the consumers with links to deal with what was said to them."""
        deadline = time.monotonic() + _HEARD_S
        while time.monotonic() < deadline and not registrar.closed:
            with registrar.lock:
                catalog = registrar.whole()
                waiting = [origin for origin in catalog.consumers if catalog.notices_to.get(origin)]
            if not waiting:
                return
            await registrar.next_change(_LOOK_AGAIN_S)

    def _owed_to_absent(self, registrar: RegistrarActor, queries: Sequence[str]) -> set[str]:
        """Return the queries whose release does not end now, and log them: nobody opens their providers meanwhile.

        A dormant provider waits for a person. While the process stops, so does one that was stopped by itself: one
        that stopped with its supervisor comes back with it.
        """
        if not queries:
            return set()
        with registrar.lock:
            held = registrar.whole().held
            where = {id: held[id].registrar for id in queries if id in held}
        absent = {name: status for name in set(where.values()) if (status := self._absent(name)) is not None}
        owed = {id for id, name in where.items() if name in absent}
        for name, count in Counter(where[id] for id in owed).items():
            text = "%s: %d releases are owed to %s, and follow when that is opened again: it is %s"
            logger.warning(text, registrar.name, count, name, absent[name])
        return owed

    def _absent(self, name: str) -> Presence | None:
        """Return a registrar's status if nobody opens it again while this process closes its own."""
        entry = self.find(name)
        if entry is None or entry.turn is not None:
            return None
        absent = entry.status is Presence.DORMANT or (entry.status is Presence.STOPPED and bool(self.stopping))
        return entry.status if absent else None

    def _why_closing(self, registrar: RegistrarActor) -> str:
        return self.stopping or f"registrar {registrar.name!r} is being closed"

    def _withdraw_loads(self, registrar: RegistrarActor) -> None:
        """End this registrar's own loads in flight. The waiting callers get the reason as their error."""
        for query_id in list(registrar.loads):
            held = registrar.catalog.held.get(query_id)
            if held is not None:
                text = f"{held.registrar}/{held.server}: the load is withdrawn, as {self._why_closing(registrar)}"
                failure = Failure("RegistrarDown", text, {"registrar": registrar.name, "status": "stopped"})
                registrar.post(GiveUp(query_id, failure))

    async def _unload_wholes(self, registrar: RegistrarActor) -> None:
        """Unload what has a part at the registrar and is served by others of this process, the highest first."""
        tried: set[Whole] = set()
        while self._provides_for(registrar.name, list(self.registrars)) and (
            highest := _highest_above(registrar.name, self.registrars.values(), tried)
        ):
            tried |= highest
            unloaded = _AllDone(self.dispatcher.loop, len(highest), registrar.name)
            for owner, resource_id in highest:
                why = f"unloaded, as {self._why_closing(registrar)}"
                self.registrars[owner].post(ForceUnload(resource_id, new_id(), unloaded, why))
            await unloaded.future

    async def _unload_everything(self, registrar: RegistrarActor) -> None:
        with registrar.lock:
            catalog = registrar.whole()
            waiting = [row for row in catalog.resources.values() if row.server not in catalog.servers]
        for row in waiting:
            logger.error("%s: resource %s %s", registrar.name, row.id, failures.waits_for_server(catalog, row))
        tried: set[str] = set()
        while resources := _next_to_unload(registrar, tried):
            tried.update(resources)
            unloaded = _AllDone(self.dispatcher.loop, len(resources), registrar.name)
            for resource_id in resources:
                why = f"unloaded, as {self._why_closing(registrar)}"
                registrar.post(ForceUnload(resource_id, new_id(), unloaded, why))
            await unloaded.future

    async def retire(self, name: str) -> set[str]:
        """Mark a registrar as gone for good, and have every provider that is up release what it held.

        Other providers read it in the directory when they are back. Return those that have been told.
        """
        if self.status_of(name) is not _GONE:  # an existing entry may also have the reason
            self.directory.mark(registrar_key(name), _GONE)
        told: set[str] = set()
        for registrar in list(self.registrars.values()):
            registrar.receive(Gone(name), name)
            registrar.take_turns()
            if name not in registrar.catalog.by_origin:
                told.add(registrar.name)
        for provider in [*self.directory.registrars(), *self.directory.other_hosts_registrars()]:
            entry = self.find(provider)
            if provider in self.registrars or entry is None or entry.status is not Presence.UP:
                continue
            if await self._tell_gone(provider, entry.address, name):
                told.add(provider)
        return told

    async def bury(self, name: str) -> None:
        """Retire the registrar of a manager that has ended for good."""
        await self.retire(name)
        self._look_whether_needed(self.config.registrar(name))

    def _look_whether_needed(self, config: RegistrarConfig) -> None:
        """Remove the catalog of a registrar that is gone for good, if it has nothing to be missed, a moment later.

        Some are opened again at once. What the end of the process leaves is removed by the next start of the system.
        """
        if config.location is not None or config.durability == "none":  # a directory that the user chose is the user's
            return
        if not self._left and self._removing is None:
            self._remove_later()
        self._left.add(config.name)

    def _remove_later(self) -> None:
        self.dispatcher.loop.call_later(_REMOVE_S, self._begin_to_remove)

    def _begin_to_remove(self) -> None:
        if not self._closing:
            self._removing = self.dispatcher.loop.create_task(self._remove_unneeded())

    async def _remove_unneeded(self) -> None:
        left, self._left = list(self._left), set()
        try:
            while left and not self._closing:
                some, left = left[:_REMOVED_AT_ONCE], left[_REMOVED_AT_ONCE:]
                gone = [name for name in some if name not in self._opening and self.status_of(name) is _GONE]
                with contextlib.suppress(Unavailable):  # no worker is free: the next start of the system removes them
                    await self.dispatcher.workers.run(self._remove_catalogs, gone, self.info.state_dir)
        finally:
            self._removing = None
            if self._left:
                self._remove_later()

    async def _tell_gone(self, provider: str, address: str, name: str) -> bool:
        try:
            hello = Hello("registrar", provider, retired(name), 0)
            decided = _Decided(self.dispatcher.loop)
            link = await self.transport.connect(address, hello, lambda _link: decided)
            link.send(Gone(name))
            link.send(Fetch(retired(name)))  # it is decided after Gone, so its answer says that Gone is on disk
            link.flush()
            try:
                return await asyncio.wait_for(decided.answer, _TELL_S)
            except TimeoutError:
                logger.warning("%s has not answered that it releases what %s held", provider, name)
            finally:
                link.close()
        except RegistrarDown:
            logger.info("%s is not up; it hears that %s is gone when it comes back", provider, name)
        except RrError as error:
            logger.warning("could not tell %s that %s is gone: %s", provider, name, error)
        return False


def _next_to_unload(registrar: RegistrarActor, tried: set[str]) -> list[str]:
    """Return the untried resources on which nothing else here depends. Their own parts are released with them.

    If there are none, return the rest: their holders could not be unloaded.
    """

    def is_part(id: str) -> bool:
        return any(query.origin == registrar.name and query.parent for query in catalog.queries_of(id))

    with registrar.lock:
        catalog = registrar.whole()
        left = [row.id for row in catalog.resources.values() if row.id not in tried and row.server in catalog.servers]
        return [id for id in left if not is_part(id)] or left


def _highest_above(name: str, registrars: Iterable[RegistrarActor], tried: set[Whole]) -> set[Whole]:
    """Return the untried resources with a part at registrar `name`, or in a part of theirs, that are no such part.

    It looks at what these registrars hold. The registrar's own resources are left out. Of a ring, it returns all.
    """
    wholes: dict[Whole, list[Whole]] = {}
    for registrar in registrars:
        with registrar.lock:
            for row in registrar.whole().held.values():
                if row.parent and row.resource_id:
                    wholes.setdefault((row.registrar, row.resource_id), []).append((registrar.name, row.parent))
    found: set[Whole] = set()
    left = [whole for part in wholes if part[0] == name for whole in wholes[part]]
    while left:
        if (whole := left.pop()) not in found:
            found.add(whole)
            left += wholes.get(whole, ())
    above = {whole for whole in found if whole[0] != name} - tried
    return {whole for whole in above if above.isdisjoint(wholes.get(whole, ()))} or above


def _unless_owed(released: _AllDone, owed: set[str], query_id: str, error: RrError | None) -> None:
    if query_id not in owed:
        released(error)


class _AllDone:
    """The outcome of `count` calls. It is called at the end of each; `future` is done after the last."""

    def __init__(self, loop: asyncio.AbstractEventLoop, count: int, name: str) -> None:
        self.future: asyncio.Future[None] = loop.create_future()
        self._left = count
        self._name = name
        self._told: Counter[str] = Counter()  # a full disk gives the same error each time
        if not count:
            self.future.set_result(None)

    def __call__(self, error: RrError | None) -> None:
        if self.future.done():  # cancelled
            return
        if error is not None and not isinstance(error, UnknownQuery):  # it was released with another resource
            text = str(error)
            self._told[text] += 1
            if self._told[text] == 1:
                logger.error("%s: %s", self._name, text)
        self._left -= 1
        if not self._left:
            self.future.set_result(None)
            for text, times in self._told.items():
                if times > 1:
                    logger.error("%s: %d times: %s", self._name, times, text)


class _Decided:
    """The receiver of a link on which a registrar is said to be gone. `answer`: whether its provider has decided it."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.answer: asyncio.Future[bool] = loop.create_future()

    def received(self, link: Link, message: Any) -> None:
        if not self.answer.done():
            self.answer.set_result(True)

    def lost(self, link: Link, reason: Exception | None) -> None:
        if not self.answer.done():
            self.answer.set_result(False)
