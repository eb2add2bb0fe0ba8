"""Host: one process as a place where actors live: its node, its way to other processes' actors, its fork server."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import msgspec
import pykka

from rr_actors.actors import dead_letters
from rr_actors.actors.actor import BaseActor, OnExit
from rr_actors.actors.dead_letters import DeadLetter
from rr_actors.actors.hosted import Hosted, HostedActor, HostedThread, Place
from rr_actors.actors.hub import ActorHub, hub, remove_hub, set_hub
from rr_actors.actors.letters import CODECS
from rr_actors.actors.node import Node, SystemInfo
from rr_actors.errors import InvalidSpec, Unavailable, shown
from rr_actors.processes import Spawner
from rr_actors.steps import Steps
from rr_actors.transport import Attach, Hello, Welcome

__all__ = ["Host", "Hosted", "Place", "check_hostable"]

logger = logging.getLogger("rr_actors")


class Host:
    """This process, for whoever starts actors in it and processes from it. Used on the loop.

    Args:
        info: the system's.
        path: of the supervisor or child that this process is for, "root" for the system's own process.
        on_event: hears on the loop what happens here and in the processes below, as plain data.
    """

    def __init__(
        self, info: SystemInfo, path: str = "root", *, on_event: Callable[[dict[str, Any]], None] | None = None
    ) -> None:
        self.node = Node(info, path, codecs=CODECS, accept=self._accept, on_event=on_event)
        self.spawner = Spawner(info.config.preload)
        self.hub = ActorHub(
            self.node.dispatcher,
            self.node.transport,
            self.node.directory,
            name=path,
            ask_timeout_s=info.config.ask_timeout_s,
        )

    async def open(self) -> None:
        """Listen, and become the process's way to actors elsewhere."""
        await self.node.start()
        set_hub(self.hub)
        dead_letters.office.listener = self._dead_letter

    async def close(self) -> None:
        """Let everything go. All actors here and all processes started from here must have ended. Each step is tried.

        Raises:
            Exception, ExceptionGroup: what went wrong.
        """
        steps = Steps()
        try:
            ending = self.node.dispatcher.workers.run(self.spawner.close)
            await steps.take_async("ending the server that processes are forked from", ending)
        finally:
            steps.take("closing the way to other processes' actors", self.hub.close)
            steps.take("removing it", self._remove_hub)
            await steps.take_async("closing the node", self.node.close())
        steps.end(f"{self.node.path}: not closed altogether")

    def _remove_hub(self) -> None:
        if remove_hub(self.hub) and hub() is None:
            dead_letters.office.listener = None

    def prepare(self, cls: type[Any], path: str, on_exit: OnExit, *, once: bool = False) -> Hosted:
        """An actor of the class `cls` that is to live here under `path`; start() it.

        Args:
            on_exit: called on the loop, once, when the actor has ended by itself. Not if its start failed, nor for what
                stop() returns.
            once: it is temporary: when it has ended, nobody starts it again.

        Raises:
            InvalidSpec: the class cannot be hosted.
        """
        check_hostable(cls, path)
        kind = HostedActor if issubclass(cls, BaseActor) else HostedThread
        return kind(self.node, self.hub, cls, path, on_exit, once=once)

    def _dead_letter(self, letter: DeadLetter, count: int) -> None:
        facts = msgspec.structs.asdict(letter) | {"count": count}
        try:
            self.node.dispatcher.call(lambda: self.node.emit("dead_letter", **facts))
        except Unavailable:
            logger.debug("a dead letter was not told: the loop has ended")

    def _accept(self, hello: Hello) -> tuple[Welcome, Attach]:
        return self.hub.accept(hello)


def check_hostable(cls: Any, where: str, args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None) -> None:
    """That `cls` is a class that can be a child, and that somebody takes its arguments.

    Raises:
        InvalidSpec: of the field actor_class_or_manager, args or kwargs.
    """
    if not (isinstance(cls, type) and issubclass(cls, pykka.Actor)):
        expected = "a subclass of rr_actors.Manager, rr_actors.Actor or pykka.ThreadingActor, or a Supervisor"
        raise InvalidSpec(
            f"{where}: actor_class_or_manager: expected {expected}, got {shown(cast('object', cls))}",
            field="actor_class_or_manager",
            expected=expected,
            got=cls,
        )
    if cls.__init__ in (BaseActor.__init__, pykka.Actor.__init__):  # those take anything, and do nothing with it
        for field, given in (("args", args), ("kwargs", kwargs)):
            if given:
                expected = f"none, as {cls.__name__} has no __init__ of its own"
                text = f"{where}: {field}: expected {expected}, got {shown(given)}"
                raise InvalidSpec(text, field=field, expected=expected, got=given)
