"""Node: one process's part of a system: loop, transports, directory, hosted registrars, the way to other actors."""

from __future__ import annotations

import asyncio
import functools
import logging
import os
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from rr_actors.actors.messaging import dead_letters
from rr_actors.actors.messaging.dead_letters import DeadLetter
from rr_actors.actors.refs import ActorRef, ref_to
from rr_actors.actors.remote.hub import ActorHub, hub, remove_hub, set_hub
from rr_actors.actors.remote.protocol import CODECS
from rr_actors.base.config import RegistrarConfig, SystemConfig
from rr_actors.base.errors import (
    CatalogError,
    InvalidName,
    NameTaken,
    NotFound,
    RegistrarDown,
    RrError,
    Unavailable,
    UnknownQuery,
    UnknownRegistrar,
    shown,
)
from rr_actors.base.names import CLIENTS, new_id
from rr_actors.base.steps import Steps
from rr_actors.registrar.engine.bulk_release import Releases
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.links.provider_link import THREADS
from rr_actors.registrar.model.commands import ForceUnload, GiveUp
from rr_actors.registrar.model.messages import Failure, Gone, Message, retired
from rr_actors.runtime.event_loop import Dispatcher, acquire, release
from rr_actors.runtime.garbage import left_alone
from rr_actors.runtime.processes.process import Spawner
from rr_actors.storage.opening import open_store
from rr_actors.storage.store import MemoryStore, Store
from rr_actors.storage.witness import Witness
from rr_actors.system.hosting.recorder import Recorder
from rr_actors.system.hosting.remote_calls import KIND, Door, HandleLine, HandleMessage
from rr_actors.system.hosting.run_files import Keeper, Watched
from rr_actors.wire.local_transport import LocalTransport
from rr_actors.wire.name_service import Directory, Entry, Status, actor_key, registrar_key
from rr_actors.wire.transport import Attach, Hello, Link, Welcome
from rr_actors.wire.unix_transport import UnixTransport

logger = logging.getLogger("rr_actors")

_GONE = Status.GONE
_RECONCILE_S = 1.0
"""How long a registrar that comes back waits for the lists of running providers before it is used."""
_LOOK_AGAIN_S = 0.05  # a provider that goes away meanwhile sends nothing


class SystemInfo(msgspec.Struct, frozen=True):
    """The facts that every process of a system needs. Children get them with the payload of their launch."""

    name: str
    state_dir: str
    run_dir: str
    key: bytes
    config: SystemConfig
    log_levels: dict[str, int] = {}
    """The application's loggers' levels, by name, at the system's start. Children send up no record below them."""


class Node:
    """This process's part of a system. It is used on the loop; `start` and `close` are awaited there.

    Args:
        info: the system's.
        path: the path of the supervisor or child that this process runs, "root" for the system's own process.
        on_event: called on the loop with each event of this process and of those below, as plain data.
    """

    def __init__(self, info: SystemInfo, path: str = "root", *, on_event: Callable[[dict[str, Any]], None]) -> None:
        self.info = info
        self.path = path
        self.config = info.config
        self.directory = Directory(Path(info.run_dir), keeps=True)
        try:
            self.watched = Watched(Path(info.run_dir))
            self.dispatcher: Dispatcher = acquire(workers_limit=info.config.workers_limit)
        except BaseException:
            self.directory.close()
            raise
        self.local = LocalTransport()
        self.transport = UnixTransport(
            Path(info.run_dir),
            info.key,
            {"registrar": Message, THREADS: Message, KIND: HandleMessage, **CODECS},
            frame_limit_bytes=info.config.frame_limit_bytes,
        )
        self.keeper = Keeper(self.directory, self.transport, self.watched)
        self.registrars: dict[str, RegistrarActor] = {}
        self._opening: set[str] = set()  # names of registrars whose catalogs are being read
        self.stopping = ""  # why all registrars here are being closed
        self.owner: object | None = None  # kept alive while a registrar is open that the application uses
        self.on_event = on_event
        self.recorder = Recorder(path, self.dispatcher, self.emit)
        self._handles: dict[str, HandleLine] = {}
        self.spawner = Spawner(info.config.preload)
        self.hub = ActorHub(
            self.dispatcher, self.transport, self.directory, name=path, ask_timeout_s=info.config.ask_timeout_s
        )

    async def start(self) -> None:
        """Listen for links, and become the process's way to actors elsewhere."""
        await self.local.listen(self.accept)
        await self.transport.listen(self.accept)
        self.keeper.start()
        set_hub(self.hub)
        dead_letters.office.listener = self._dead_letter

    async def close(self) -> None:
        """Close the fork server, the links, every registrar (nothing is released), and at last the loop.

        All actors here and all processes started from here must have ended. Each step is tried.

        Raises:
            Exception, ExceptionGroup: the errors of the steps.
        """
        steps = Steps()
        try:
            ending = self.dispatcher.workers.run(self.spawner.close)
            await steps.take_async("ending the server that processes are forked from", ending)
        finally:
            steps.take("closing the way to other processes' actors", self.hub.close)
            if remove_hub(self.hub) and hub() is None:
                dead_letters.office.listener = None
            self.owner = None
            await self._close(steps)
        steps.end(f"{self.path}: not closed altogether")

    async def _close(self, steps: Steps) -> None:
        steps.take("sending what is recorded", self.recorder.close)
        steps.take("ending to look after the files", self.keeper.stop)
        for name in list(self.registrars):
            steps.take(f"closing registrar {name!r}", self.close_registrar, name, Status.STOPPED)
        for line in list(self._handles.values()):
            steps.take("closing the line of a handle", line.close)
        try:
            await steps.take_async("closing the links of this process", self.local.close())
            await steps.take_async("closing the links to other processes", self.transport.close())
        finally:
            steps.take("closing the directory of names", self.directory.close)
            self.dispatcher.loop.call_soon(release)  # after the callbacks of the closed transports

    def accept(self, hello: Hello) -> tuple[Welcome, Attach]:
        """Accept a link for a registrar or for the actors of this process."""
        if hello.kind not in ("registrar", THREADS, KIND):
            return self.hub.accept(hello)
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

    def ref(self, id: str, near: str = "") -> ActorRef[Any]:
        """Return a reference to a supervised actor of the system, found by the directory alone. From any thread.

        Args:
            id: the actor's child id, or its path, with or without the root's name.
            near: the path of the asking actor. If several actors have that id, its sibling is returned.

        Raises:
            NotFound: no actor has that id, or several have and none is a sibling; `.known` has the paths of all.
        """
        top = self.path.partition("/")[0]
        siblings = near.rpartition("/")[0] or top
        tried = [f"{top}/{id}", id] if "/" in id else [f"{siblings}/{id}"]
        for path in tried:
            if self._is_actor(path):
                return ref_to(path)
        known = [path for path in self.directory.actor_paths(top) if self._is_actor(path)]
        found = [path for path in known if path.endswith(f"/{id}")]
        if len(found) == 1:
            return ref_to(found[0])
        text = f"several have this id: {', '.join(found)}" if found else f"there are: {', '.join(known) or 'none'}"
        raise NotFound(f"ref({shown(id)}): expected the id or the path of one actor; {text}", id=id, known=tuple(known))

    def _is_actor(self, path: str) -> bool:
        try:
            entry = self.directory.lookup(actor_key(path))
        except InvalidName:
            return False
        return entry is not None and entry.status is not _GONE

    def find(self, registrar: str) -> Entry | None:
        """Return the entry of a registrar: this process's if it is open here, else the directory's; None if unknown."""
        if registrar in self.registrars:
            return Entry(Status.UP, self.local.address)
        return self.directory.lookup(registrar_key(registrar))

    def status_of(self, registrar: str) -> Status | None:
        """Return the status of the entry that find() returns; None if the registrar is unknown."""
        entry = self.find(registrar)
        return None if entry is None else entry.status

    def statuses(self) -> dict[str, Status]:
        """Return the statuses of the system's registrars that are not gone, by name."""
        found = ((name, self.status_of(name)) for name in sorted({*self.directory.registrars(), *self.registrars}))
        return {name: status for name, status in found if status is not None and status is not _GONE}

    # -- registrars ----------------------------------------------------------------------------------------------

    async def open_registrar(self, name: str, config: RegistrarConfig) -> RegistrarActor:
        """Lock and read a catalog, and continue its unfinished work. `serve_registrar` accepts the links of others.

        Raises:
            NameTaken: the registrar is open in this process already, or up in another.
            CatalogError: the catalog is locked, damaged or of another version, or cannot be written.
        """
        if name in self.registrars or name in self._opening:
            raise NameTaken(f"registrar {name!r}: open already in this process; close it first", name=name)
        entry = self.find(name)
        deaths = ""
        if entry is not None and entry.status is Status.STARTING:
            deaths = entry.why
            self.directory.announce(registrar_key(name), self.transport.address)
        path = config.catalog_path(self.info.state_dir)
        self._opening.add(name)
        try:
            with left_alone():  # the rows stay, perhaps a million of them
                witness = Witness(self.info.state_dir, name)
                store = await self._open_store(path, config, witness)
                registrar = RegistrarActor(self, name, config, store)
                registrar.catalog.deaths = deaths
                self.registrars[name] = registrar
                registrar.begin()
        finally:
            self._opening.discard(name)
        return registrar

    async def _open_store(self, path: Path, config: RegistrarConfig, witness: Witness) -> Store:
        """Open a catalog. If that is cancelled, as by Ctrl-C, close the catalog."""
        opening = asyncio.ensure_future(self.dispatcher.workers.run(_open, path, config, witness))
        try:
            return await asyncio.shield(opening)
        except asyncio.CancelledError:
            await asyncio.wait((opening,))
            if opening.exception() is None:
                await self.dispatcher.workers.run(opening.result().close)
            raise

    async def settle(self, registrar: RegistrarActor) -> None:
        """Wait until every recover callback has ended, and at most 1 s for the lists of providers that are up."""
        while registrar.catalog.recovering and not registrar.closed:
            await registrar.monitor.next_change(_LOOK_AGAIN_S)
        deadline = time.monotonic() + _RECONCILE_S
        while time.monotonic() < deadline and not registrar.closed:
            with registrar.lock:
                catalog = registrar.whole()
                waiting = [peer for peer in catalog.peers if peer not in catalog.up and peer != registrar.name]
            if not any(self.status_of(peer) is Status.UP for peer in waiting):
                return
            await registrar.monitor.next_change(_LOOK_AGAIN_S)
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
            registrar.monitor.receive(Gone(origin), origin)

    def _is_gone(self, registrar: str) -> bool:
        status = self.status_of(registrar)
        if status is not None or not registrar.startswith(CLIENTS):
            return status is _GONE
        # If an application is killed, its next start alone gives up its clients. Later ones find no catalog of them.
        return not os.path.exists(self.config.registrar(registrar).catalog_path(self.info.state_dir))

    def close_registrar(self, name: str, status: Status | None) -> None:
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
        return entry is None or entry.status is not Status.UP or entry.address == self.transport.address

    async def dismiss(self, name: str, timeout_s: float | None) -> None:
        """Wind a registrar down, and close it for good.

        Raises:
            Exception, ExceptionGroup: the errors of the steps; the registrar is closed all the same.
        """
        steps = Steps()
        await steps.take_async("releasing what it holds, and unloading what it serves", self.wind_down(name, timeout_s))
        steps.take("closing it", self.close_registrar, name, _GONE)
        if all(actor.on_failure is not None for actor in self.registrars.values()):  # only those of managers are left
            self.owner = None
        steps.end(f"registrar {name!r}: not closed as it should be")

    async def wind_down(self, name: str, timeout_s: float | None) -> None:
        """Wind a registrar down for good: release all it holds and unload all it serves, within `timeout_s`."""
        registrar = self.registrars.get(name)
        if registrar is None or registrar.closed:
            return
        try:
            await asyncio.wait_for(self._release_everything(registrar), timeout_s)
        except TimeoutError:
            left = len(registrar.catalog.held), len(registrar.catalog.resources)
            logger.warning("%s: closed with %d queries and %d resources left", name, *left)
        if not registrar.closed and not registrar.catalog.held:
            try:
                registrar.forget_peers()
            except CatalogError as error:
                logger.warning("%s: opened again it will look for providers that it needs no more: %s", name, error)

    async def _release_everything(self, registrar: RegistrarActor) -> None:
        registrar.settle()
        self._withdraw_loads(registrar)
        releases: Releases | None = None
        try:
            await self._unload_everything(registrar)
            queries = registrar.newest_first()
            released = _AllDone(self.dispatcher.loop, len(queries), registrar.name)
            releases = Releases(registrar, queries, lambda _query_id, error: released(error))
            await released.future
        except asyncio.CancelledError:
            if releases is None:  # a callback does not end: only its own resource's parts wait for it
                with registrar.lock:
                    held = registrar.whole().held
                    queries = [query_id for query_id in registrar.newest_first() if not held[query_id].parent]
                releases = Releases(registrar, queries, lambda _query_id, _error: None)
            releases.hurry()
            registrar.settle()  # all of them are owed then, on disk
            raise

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

    async def _unload_everything(self, registrar: RegistrarActor) -> None:
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
        for registrar in list(self.registrars.values()):
            registrar.monitor.receive(Gone(name), name)
        told = set(self.registrars)
        for provider in self.directory.registrars():
            entry = self.find(provider)
            if provider in self.registrars or entry is None or entry.status is not Status.UP:
                continue
            if await self._tell_gone(provider, entry.address, name):
                told.add(provider)
        return told

    async def _tell_gone(self, provider: str, address: str, name: str) -> bool:
        try:
            hello = Hello("registrar", provider, retired(name), 0)
            link = await self.transport.connect(address, hello, lambda _link: _NOBODY)
            link.send(Gone(name))
            link.close()
            return True
        except RegistrarDown:
            logger.info("%s is not up; it hears that %s is gone when it comes back", provider, name)
        except RrError as error:
            logger.warning("could not tell %s that %s is gone: %s", provider, name, error)
        return False

    def emit(self, event: str, **facts: Any) -> None:
        """Pass an event with its facts to on_event."""
        self.on_event({"event": event, **facts})

    def _dead_letter(self, letter: DeadLetter, count: int) -> None:
        facts = msgspec.structs.asdict(letter) | {"count": count}
        try:
            self.dispatcher.call(lambda: self.emit("dead_letter", **facts))
        except Unavailable:
            logger.debug("a dead letter was not told: the loop has ended")


def _next_to_unload(registrar: RegistrarActor, tried: set[str]) -> list[str]:
    """Return the untried resources on which nothing else here depends. Their own parts are released with them.

    If there are none, return the rest: their holders could not be unloaded.
    """

    def is_part(id: str) -> bool:
        return any(query.origin == registrar.name and query.parent for query in catalog.queries_of(id))

    with registrar.lock:
        catalog = registrar.whole()
        left = [id for id in catalog.resources if id not in tried]
        return [id for id in left if not is_part(id)] or left


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


class _Nobody:
    def received(self, link: Link, message: Any) -> None:
        logger.debug("not expected on a link that only tells: %r", message)

    def lost(self, link: Link, reason: Exception | None) -> None:
        if reason is not None:
            logger.debug("a link that only tells was lost: %s", reason)


_NOBODY = _Nobody()


def _open(path: Path, config: RegistrarConfig, witness: Witness) -> Store:
    if config.durability == "none":
        return MemoryStore()
    return open_store(path, durability=config.durability, on_damage=config.on_damage, witness=witness)
