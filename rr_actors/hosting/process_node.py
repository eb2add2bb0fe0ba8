"""ProcessNode: what one process of a system has before any registrar is open in it."""

from __future__ import annotations

import abc
import time
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

import msgspec

from rr_actors.actors.messaging import dead_letters
from rr_actors.actors.messaging.dead_letters import DeadLetter
from rr_actors.actors.refs import ActorRef, ref_to
from rr_actors.actors.remote.hub import ActorHub, hub, remove_hub, set_hub
from rr_actors.actors.remote.protocol import CODECS
from rr_actors.base.config import SystemConfig
from rr_actors.base.errors import InvalidName, NotFound, Unavailable, shown
from rr_actors.base.folder import Place
from rr_actors.base.names import is_part
from rr_actors.base.reporting.log import Log
from rr_actors.base.reporting.tracebacks import ProcessStacks, stacks_here
from rr_actors.base.steps import Steps
from rr_actors.hosting.run_files import RunKeeper, Watched
from rr_actors.runtime.event_loop import Dispatcher, acquire, release
from rr_actors.runtime.processes.process import Spawner
from rr_actors.wire.local_transport import LocalTransport
from rr_actors.wire.name_service import Directory, NameEntry, OtherHosts, Presence, registrar_key
from rr_actors.wire.transport import Attach, Hello, Welcome
from rr_actors.wire.unix_transport import UnixTransport

logger = Log("rr_actors")


class SystemInfo(msgspec.Struct, frozen=True):
    """The facts that every process of a system needs. Children get them with the payload of their launch."""

    name: str
    state_dir: str
    run_dir: str
    key: bytes
    config: SystemConfig
    place: Place | None = None
    """The state directory, to look whether it is still there."""
    log_levels: dict[str, int] = {}
    """The application's loggers' levels, by name, at the system's start. Children send up no record below them."""
    debug: bool = False
    """Whether actors can be paused."""
    hosts: OtherHosts | None = None
    """This host's name and its routes to others; None: the system ends at this host."""


def _unheard(*_said: object) -> None:
    """Do nothing: no supervisor of another process hears it."""


Ask = Callable[[str, float], Awaitable[ProcessStacks]]
"""A function that asks the process of a child, or one below it: by the path of that child, within so many seconds."""


class Stacks:
    """The way to the stacks of this process and of all processes below it. On the loop, except for paths().

    The loop of a process answers, so a thread of a user may be busy or wait for ever. The process that started it asks,
    over the control channel. So each process knows the way to those directly below it, and passes on a question for one
    further down.
    """

    def __init__(self) -> None:
        self._below: dict[str, Ask] = {}

    def paths(self) -> list[str]:
        """Return the paths of the children that have processes directly below this one. From any thread."""
        return list(self._below)

    def add(self, path: str, ask: Ask) -> None:
        """Add the process of a child, in the place of the one that it had before."""
        self._below[path] = ask

    def remove(self, path: str, ask: Ask) -> None:
        """Remove the process of a child, which has ended, unless another has its place already."""
        if self._below.get(path) == ask:
            del self._below[path]

    async def of(self, path: str, limit_s: float) -> ProcessStacks:
        """Return the stacks of the process in which the child at this path runs.

        Raises:
            Unavailable: the process has ended, or did not answer in time.
        """
        above = path
        while above:
            if (ask := self._below.get(above)) is not None:
                return await ask(path, limit_s)
            above = above.rpartition("/")[0]
        return stacks_here()


class ProcessNode(abc.ABC):
    """This process's part of a system: its loop, transports and directory, and the way to actors elsewhere.

    It is used on the loop; `start` and `close` are awaited there. The registrar's room adds the registrars (Node).

    Args:
        info: the system's.
        path: the path of the supervisor or child that this process runs, "root" for the system's own process.
        messages: by kind of link, the messages that it carries, besides those between actors.
        on_event: called on the loop with each event of this process and of those below, as plain data.
    """

    def __init__(
        self, info: SystemInfo, path: str, messages: Mapping[str, Any], *, on_event: Callable[[dict[str, Any]], None]
    ) -> None:
        self.info = info
        self.path = path
        self.config = info.config
        self.directory = Directory(info.run_dir, keeps=True, place=info.place)
        try:
            self.watched = Watched(info.run_dir)
            self.dispatcher: Dispatcher = acquire(workers_limit=info.config.workers_limit)
        except BaseException:
            self.directory.close()
            raise
        self.local = LocalTransport()
        self.transport = UnixTransport(
            info.run_dir,
            info.key,
            {**messages, **CODECS},
            frame_limit_bytes=info.config.frame_limit_bytes,
            segments_limit_bytes=info.config.segments_limit_bytes,
        )
        self.keeper = RunKeeper(self.directory, self.transport, self.watched, info.place)
        self.stopping = ""  # why all registrars here are being closed
        self.owners: dict[str, object] = {}  # kept alive, by the name of a registrar that is open for the application
        self.on_event = on_event
        self.on_death_in_callback: Callable[[str, bool], None] = _unheard
        """Called with the callbacks that ran when the process died that a registrar of this one had before, and whether
        one of them is not run again."""
        self.accused: set[str] = set()  # the registrars of which this is so
        self.on_acquitted: Callable[[], None] = _unheard
        """Called when all these callbacks have run again, and this process lives."""
        self.on_resumed: Callable[[str], None] = _unheard
        """Called with each callback that goes on with such work before its registrar serves."""
        self.stacks = Stacks()
        self.spawner = Spawner(info.config.preload, info.run_dir)
        self.keeper.also.append(self.spawner.reap)
        self.hub = ActorHub(
            self.dispatcher,
            self.transport,
            self.directory,
            name=path,
            ask_timeout_s=info.config.ask_timeout_s,
            debug=info.debug,
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
            self.owners.clear()
            await self._close(steps)
        steps.end(f"{self.path}: not closed altogether")

    async def _close(self, steps: Steps) -> None:
        steps.take("ending to look after the files", self.keeper.stop)
        try:
            await steps.take_async("closing the links of this process", self.local.close())
            await steps.take_async("closing the links to other processes", self.transport.close())
        finally:
            steps.take("closing the directory of names", self.directory.close)
            steps.take("closing the byte that says who watches", self.watched.close)
            self.dispatcher.loop.call_soon(release)  # after the callbacks of the closed transports

    def accept(self, hello: Hello) -> tuple[Welcome, Attach]:
        """Accept a link for the actors of this process."""
        return self.hub.accept(hello)

    @abc.abstractmethod
    def close_registrar(self, name: str, status: Presence | None) -> None:
        """Close a registrar if it is open, and write its status into the directory; None: write nothing."""

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
        if not found and (part := self.part(id)) is not None:
            return part
        text = f"several have this id: {', '.join(found)}" if found else f"there are: {', '.join(known) or 'none'}"
        raise NotFound(f"ref({shown(id)}): expected the id or the path of one actor; {text}", id=id, known=tuple(known))

    def part(self, id: str) -> ActorRef[Any] | None:
        """Return a reference to an actor that is a part of another one; None if the directory knows none of this path.

        Args:
            id: "cameras/registrar" for the registrar of a manager, "app" for one of the application; "/clients/maps"
                behind it for its client of a provider.
        """
        top = self.path.partition("/")[0]
        paths = (f"{top}/{id}", id) if is_part(id) else (id,)
        return next((ref_to(path) for path in paths if is_part(path) and self._is_actor(path)), None)

    def _is_actor(self, path: str) -> bool:
        try:
            entry = self.directory.actor(path)
        except InvalidName:
            return False
        return entry is not None and entry.status is not Presence.GONE

    def find(self, registrar: str) -> NameEntry | None:
        """Return the entry of a registrar; None if it is unknown."""
        return self.directory.lookup(registrar_key(registrar))

    def status_of(self, registrar: str) -> Presence | None:
        """Return the status of the entry that find() returns; None if the registrar is unknown."""
        entry = self.find(registrar)
        return None if entry is None else entry.status

    def emit(self, event: str, **facts: Any) -> None:
        """Pass an event with its facts to on_event; `at` is now, if they do not say when it happened."""
        self.on_event({"event": event, "at": time.time(), **facts})

    def _dead_letter(self, letter: DeadLetter, count: int) -> None:
        facts = msgspec.structs.asdict(letter) | {"count": count}
        try:
            self.dispatcher.call(lambda: self.emit("dead_letter", **facts))
        except Unavailable:
            logger.debug("a dead letter was not told: the loop has ended")
