"""Acting: does what the decisions want done, once it is on disk. One method for each kind of effect."""

from __future__ import annotations

import functools
import logging
from asyncio import TimerHandle
from collections.abc import Callable, Sequence
from typing import Any

from rr_actors.base.errors import RrError
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import effects as e
from rr_actors.registrar.model.effects import Effect
from rr_actors.registrar.model.messages import Load, error_of, failure_of
from rr_actors.registrar.model.rows import Hold

logger = logging.getLogger("rr_actors.registrar")


_CALLBACKS = frozenset((e.StartLoad, e.StartUnload, e.StartRecover, e.StartStatus, e.Hear))


class Acting:
    """The hands of a registrar's actor. On the loop."""

    def __init__(self, registrar: Any) -> None:
        self._registrar = registrar
        self._loop = registrar.node.dispatcher.loop
        self._workers = registrar.node.dispatcher.workers
        self._timers: dict[str, TimerHandle] = {}
        self._dirty: dict[int, Any] = {}
        self._methods: dict[type, Callable[[Any], None]] = {
            e.Reply: self._reply,
            e.Request: self._request,
            e.Connect: self._connect,
            e.StartLoad: self._start_load,
            e.StartUnload: self._start_unload,
            e.StartRecover: self._start_recover,
            e.StartStatus: self._start_status,
            e.SetTimer: self._set_timer,
            e.LoadResolved: self._load_resolved,
            e.UnloadResolved: self._unload_resolved,
            e.Receive: self._receive,
            e.Hear: self._hear,
            e.Answer: self._answer,
            e.Happened: self._happened,
        }

    def do(self, effects: Sequence[Effect]) -> None:
        """Do them in their order; what is sent leaves at the end, each link's messages in one go.

        What has happened is told before: a process that is killed when it has answered has told of it. And threads
        are woken for all callbacks together, as the first might be done and asleep again before the second comes.
        """
        methods = self._methods
        if len(effects) > 1 and not _CALLBACKS.isdisjoint(map(type, effects)):
            self._workers.gather()
            try:
                for effect in effects:
                    methods[type(effect)](effect)
            finally:
                self._workers.go()
        else:
            for effect in effects:
                methods[type(effect)](effect)
        self._registrar.consumers.flush()
        if self._dirty:
            dirty, self._dirty = self._dirty, {}
            for link in dirty.values():
                link.flush()

    def by_thread(self, effects: Sequence[Effect]) -> Callable[[], None] | None:
        """What does them in any thread; None: they need the loop. From any thread, with the lock.

        That is the answer to one direct line, which has no order with anything else. What watchers are told comes
        before the answer, so it is the loop that answers while there are any.
        """
        answer: e.Reply | None = None
        for effect in effects:
            if type(effect) is e.Reply and answer is None:
                answer = effect
            elif type(effect) is not e.Happened or self._registrar.node.watched:
                return None
        return _nothing if answer is None else self._registrar.consumers.by_line(answer.message)

    def close(self) -> None:
        """Let nothing fire any more."""
        for timer in self._timers.values():
            timer.cancel()

    # -- messages ------------------------------------------------------------------------------------------------

    def _reply(self, effect: e.Reply) -> None:
        self._registrar.consumers.send(effect.origin, effect.message)

    def _request(self, effect: e.Request) -> None:
        client = self._registrar.client(effect.registrar)
        link = client.link
        if link is None:
            client.want()
            return
        up = self._registrar.catalog.up.get(effect.registrar)
        if up is None or up.link != client.opened:
            return  # decided for a link before this one: when this is reconciled, what is open is sent again
        try:
            if type(effect.message) is Load:
                client.describe(effect.message.server)
            link.send(effect.message)
        except RrError as error:
            self._not_sent(effect, error)
            return
        self._dirty[id(link)] = link

    def _not_sent(self, effect: e.Request, error: RrError) -> None:
        if type(effect.message) is Load:
            self._registrar.post(c.GiveUp(effect.message.query_id, failure_of(error)))
            return
        name = self._registrar.name
        logger.error("%s: %s; closing the link, what is open is sent again over the next", name, error)
        link = self._registrar.client(effect.registrar).link
        if link is not None:
            link.close()

    def _connect(self, effect: e.Connect) -> None:
        self._registrar.client(effect.registrar).want()

    def _receive(self, effect: e.Receive) -> None:
        self._registrar.receive(effect.message, effect.sender)

    # -- callbacks -----------------------------------------------------------------------------------------------

    def _start_load(self, effect: e.StartLoad) -> None:
        server = self._registrar.servers.get(effect.resource.server)
        if server is not None:
            server.start_load(effect.resource)

    def _start_unload(self, effect: e.StartUnload) -> None:
        server = self._registrar.servers.get(effect.resource.server)
        if server is not None:
            server.start_unload(effect.resource)

    def _start_recover(self, effect: e.StartRecover) -> None:
        server = self._registrar.servers.get(effect.resource.server)
        if server is not None:
            server.start_recover(effect.resource, effect.reload)

    def _start_status(self, effect: e.StartStatus) -> None:
        server = self._registrar.servers.get(effect.resource.server)
        if server is None or server.spec.status is None:
            self._registrar.post(c.StatusDone(effect.resource.id, effect.notice, effect.provider, handled=False))
        else:
            server.start_status(effect.resource, effect.notice, effect.provider, repeated=effect.repeated)

    # -- timers --------------------------------------------------------------------------------------------------

    def _set_timer(self, effect: e.SetTimer) -> None:
        old = self._timers.pop(effect.key, None)
        if old is not None:
            old.cancel()
        if effect.delay_s is not None:
            fire = functools.partial(self._timer_fired, effect.key, effect.command)
            self._timers[effect.key] = self._loop.call_later(effect.delay_s, fire)

    def _timer_fired(self, key: str, command: c.Command) -> None:
        self._timers.pop(key, None)
        self._registrar.post(command)

    # -- who waits and who listens -------------------------------------------------------------------------------

    def _load_resolved(self, effect: e.LoadResolved) -> None:
        held = effect.held
        if effect.failure is not None:
            self._forget(held.id)
        waiter = self._registrar.loads.pop(held.id, None)
        if waiter is not None:
            waiter(held, None if effect.failure is None else error_of(effect.failure))

    def _unload_resolved(self, effect: e.UnloadResolved) -> None:
        held = self._registrar.catalog.held.get(effect.query_id)
        if effect.failure is None or (held is not None and held.hold is Hold.OWED):  # else it is held, or will be again
            self._forget(effect.query_id)
        waiter = self._registrar.unloads.pop(effect.query_id, None)
        if waiter is not None:
            waiter(None if effect.failure is None else error_of(effect.failure))

    def _hear(self, effect: e.Hear) -> None:
        audience = self._registrar.audience
        if audience is None:
            self._heard(effect, False)
            return
        audience.hear(effect.held, effect.notice, functools.partial(self._heard, effect), repeated=effect.repeated)
        if effect.notice.released:
            audience.forget(effect.held.id)

    def _heard(self, effect: e.Hear, handled: bool) -> None:
        self._registrar.post(c.Heard(effect.held.id, effect.notice.event, handled))

    def _forget(self, query_id: str) -> None:
        if self._registrar.audience is not None:
            self._registrar.audience.forget(query_id)

    def _answer(self, effect: e.Answer) -> None:
        effect.ticket(None if effect.failure is None else error_of(effect.failure))

    def _happened(self, effect: e.Happened) -> None:
        if self._registrar.node.watched:
            name = self._registrar.name
            facts = {"resource_id": effect.resource_id, "detail": effect.detail}
            self._registrar.node.emit(effect.what, registrar=name, server=f"{name}/{effect.server}", **facts)


def _nothing() -> None:
    """What is done where nothing is to be done."""
