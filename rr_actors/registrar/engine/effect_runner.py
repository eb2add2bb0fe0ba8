"""The effects of a decision, carried out once it is on disk: one method for each kind."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

from rr_actors.base.reporting.log import Log
from rr_actors.base.values.canonical import text_of_value
from rr_actors.base.values.failure import error_of
from rr_actors.registrar.engine.registrar_base import RegistrarBase
from rr_actors.registrar.links.consumer_links import Consumers
from rr_actors.registrar.links.provider_link import ProviderLink, ProviderLinks
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import effects as e
from rr_actors.registrar.model.effects import Effect
from rr_actors.registrar.model.roles import BEGUN
from rr_actors.registrar.model.rows import OWED, is_revocation
from rr_actors.registrar.servers.registered_servers import RegisteredServers
from rr_actors.runtime.thread_rules import any_thread, on_loop, with_lock
from rr_actors.runtime.time_limits import RunningTimers

logger = Log("rr_actors.registrar")

_SAID_AGAIN_S = 60.0
_NAMED = 3  # callbacks that a message names
_CALLBACKS = frozenset((e.StartCallback, e.Hear))


@on_loop
class EffectRunner:
    """Carries out the effects that decisions cause, for a registrar's actor."""

    def __init__(
        self, registrar: RegistrarBase, consumers: Consumers, servers: RegisteredServers, links: ProviderLinks
    ) -> None:
        self._registrar = registrar
        self._consumers = consumers
        self._servers = servers
        self._clients = links
        self._loop = registrar.node.dispatcher.loop
        self._workers = registrar.node.dispatcher.workers
        self._timers = RunningTimers(self._loop)
        self._dirty: dict[str, ProviderLink] = {}  # the clients with unsent requests
        self._silent_until: dict[str, float] = {}  # by consumer: when the log says next that it is behind
        self._methods: dict[type, Callable[[Any], None]] = {
            e.SendReply: self._reply,
            e.SendRequest: self._request,
            e.Connect: self._connect,
            e.StartCallback: self._start_callback,
            e.SetTimer: self._set_timer,
            e.LoadResolved: self._load_resolved,
            e.UnloadResolved: self._unload_resolved,
            e.Receive: self._receive,
            e.Hear: self._hear,
            e.FellBehind: self._fell_behind,
            e.AnswerCall: self._answer,
            e.Happened: self._happened,
            e.Died: self._died,
            e.Acquitted: self._acquitted,
            e.RingBroken: self._ring_broken,
            e.InLine: self._in_line,
        }

    def do(self, effects: Sequence[Effect]) -> None:
        """Carry out the effects in their order; at the end each client sends its requests, and each link is flushed.

        A decision has its events before its answers, some of which leave at once, by direct lines. A process that is
        killed after an answer has therefore sent the event. Worker threads are woken once for all callbacks: otherwise
        the first callback might end, and its thread sleep again, before the second is submitted.
        """
        methods = self._methods
        if len(effects) > 1 and not _CALLBACKS.isdisjoint(map(type, effects)):
            self._workers.threads.gather()
            try:
                for effect in effects:
                    methods[type(effect)](effect)
            finally:
                self._workers.threads.go()
        else:
            for effect in effects:
                methods[type(effect)](effect)
        if self._consumers.unflushed:
            self._consumers.flush()
        if self._dirty:
            dirty, self._dirty = self._dirty, {}
            for client in dirty.values():
                client.take_turns()

    @with_lock
    def by_thread(self, effects: Sequence[Effect]) -> Callable[[], None] | None:
        """Return a function that any thread may call to carry out the effects; None if the loop has to.

        A thread may send only the answer to one direct line, which has no order with other messages. Watchers hear of
        an event before the answer, so while anybody hears of events, the loop sends both.
        """
        answer: e.SendReply | None = None
        for effect in effects:
            if type(effect) is e.SendReply and answer is None:
                answer = effect
            elif type(effect) is not e.Happened or effect.kept or self._is_heard():
                return None
        return _nothing if answer is None else self._consumers.by_line(answer.message)

    def close(self) -> None:
        """Cancel all timers."""
        self._timers.close()

    # -- messages ------------------------------------------------------------------------------------------------

    def _reply(self, effect: e.SendReply) -> None:
        self._consumers.send(effect.origin, effect.message)

    def _request(self, effect: e.SendRequest) -> None:
        client = self._clients[effect.registrar]
        client.enqueue(effect)
        self._dirty[effect.registrar] = client

    def _connect(self, effect: e.Connect) -> None:
        self._clients[effect.registrar].deliver(effect)

    def _receive(self, effect: e.Receive) -> None:
        self._registrar.receive(effect.message, effect.sender)

    # -- callbacks -----------------------------------------------------------------------------------------------

    def _start_callback(self, effect: e.StartCallback) -> None:
        server = self._servers.get(effect.resource.server)
        if server is not None:
            server.deliver(effect)
        elif BEGUN[effect.role].phase is None:
            self._registrar.post(c.CallbackEnded(effect.role, effect.resource.id, notice=effect.notice))

    # -- timers --------------------------------------------------------------------------------------------------

    def _set_timer(self, effect: e.SetTimer) -> None:
        if effect.delay_s is None:
            self._timers.cancel(effect.key)
        else:
            self._timers.set(effect.key, effect.delay_s, functools.partial(self._fired, effect))

    def _fired(self, effect: e.SetTimer) -> None:
        if effect.key in self._registrar.outside:
            self._set_timer(effect)
        else:
            self._registrar.post(effect.command)

    @on_loop
    def let_in(self, key: str) -> None:
        """Let the time limit of a callback begin that has waited for room."""
        self._timers.restart(key)

    # -- waiting callers and listeners ---------------------------------------------------------------------------

    def _load_resolved(self, effect: e.LoadResolved) -> None:
        held = effect.held
        self._registrar.catalog.wait_limits.pop(held.id, None)
        self._registrar.listeners.places.pop(held.id, None)
        if effect.failure is not None:
            self._forget(held.id)
        waiter = self._registrar.loads.pop(held.id, None)
        if waiter is not None:
            waiter(held, None if effect.failure is None else error_of(effect.failure))

    def _unload_resolved(self, effect: e.UnloadResolved) -> None:
        held = self._registrar.catalog.held.get(effect.query_id)
        if effect.failure is None or (held is not None and held.hold is OWED):  # else the query is held, or will be
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

    def _heard(self, effect: e.Hear, handled: bool) -> None:
        revoked = effect.notice.reason != "" and is_revocation(effect.notice)
        self._registrar.post(c.Heard(effect.held.id, effect.notice.event, handled, revoked))

    def _fell_behind(self, effect: e.FellBehind) -> None:
        if effect.dropped:
            who = f"{effect.origin} (query {effect.query_id})" if effect.query_id else "its own status callback"
            text = "%s: more than %d statuses of resource %s wait for %s: the %d oldest that are not FATAL are dropped"
            backlog = self._registrar.catalog.backlog
            logger.error(text, self._registrar.name, backlog, effect.resource_id, who, effect.dropped)
            return
        now = self._loop.time()
        if now >= self._silent_until.get(effect.origin, 0.0):
            self._silent_until[effect.origin] = now + _SAID_AGAIN_S
            text = "%s: %s is behind with its statuses: %d of query %s wait there, and newer ones here"
            logger.warning(text, self._registrar.name, effect.origin, effect.on_way, effect.query_id)

    def _forget(self, query_id: str) -> None:
        if self._registrar.audience is not None:
            self._registrar.audience.forget(query_id)

    def _answer(self, effect: e.AnswerCall) -> None:
        effect.ticket(None if effect.failure is None else error_of(effect.failure))

    @any_thread
    def _is_heard(self) -> bool:
        """Return whether anybody hears of events."""
        return self._registrar.on_happened is not None or self._registrar.node.watched.level[0] > 0

    def _happened(self, effect: e.Happened) -> None:
        registrar, resource = self._registrar, effect.resource
        if registrar.on_happened is not None:
            registrar.on_happened()
        if not (effect.kept or registrar.node.watched.level[0]):
            return
        facts: dict[str, Any] = {"request": text_of_value(resource.request), "detail": effect.detail}
        if title := registrar.title_of(resource):
            facts["title"] = title
        if effect.notice is not None:
            with registrar.lock:
                holders = dict.fromkeys(q.origin for q in registrar.catalog.queries_of(resource.id) if not q.parent)
            facts |= {"status_id": effect.notice.event, "source": effect.notice.source, "heard_by": ", ".join(holders)}
        server = registrar.catalog.origin_of(resource)
        where = {"registrar": registrar.name, "server": server, "resource_id": resource.id}
        registrar.node.emit(effect.what, **where, **facts, kept=effect.kept)

    def _died(self, effect: e.Died) -> None:
        name = self._registrar.name
        for given_up in effect.given_up:
            logger.error("%s: %s", name, given_up)
        ran = "; ".join(effect.runs[:_NAMED]) + ("; and others" if len(effect.runs) > _NAMED else "")
        self._registrar.node.accused.add(name)
        self._registrar.node.on_death_in_callback(ran, bool(effect.given_up))

    def _acquitted(self, _effect: e.Acquitted) -> None:
        node = self._registrar.node
        node.accused.discard(self._registrar.name)
        if not node.accused:
            node.on_acquitted()

    def _in_line(self, effect: e.InLine) -> None:
        if effect.text:
            self._registrar.progress.place(effect.resource_id, effect.text, effect.holder, effect.since)
        else:
            self._registrar.progress.forget(effect.resource_id)

    def _ring_broken(self, effect: e.RingBroken) -> None:
        logger.error("%s: %s", self._registrar.name, effect.why)


def _nothing() -> None:
    """Do nothing: the decision has no answer to send."""
