"""Loads and unloads: how the calling thread sends each one, and how the result comes back.

Every load that the loop sends is a Loading, the future of its query (Loads.begin). A thread waits for it, a task awaits
it, a caller gets it with ``block=False``, and a group waits for several. A thread that waits sends the load itself if
it can, on a connection of its own (links/provider_link.py), and then there is no Loading. No call waits on the loop.
"""

from __future__ import annotations

import abc
import asyncio
import contextlib
import functools
import math
import threading
import time
import weakref
from collections.abc import Callable, Sequence
from typing import Any, Protocol, TypeVar

import pykka

from rr_actors.actors.messaging import ask_cycles
from rr_actors.actors.messaging.futures import Reply, fail
from rr_actors.actors.remote.hub import why_registrar_too_early
from rr_actors.actors.turns import has_a_turn
from rr_actors.base.errors import NotSerializable, RrError, Unavailable, UnknownServer, UsageError, shortened
from rr_actors.base.names import ServerId, new_id
from rr_actors.base.values.failure import Failure, error_of, failure_of
from rr_actors.registrar.arguments import LoadOptions, check_allowed
from rr_actors.registrar.engine.bulk_release import Releases
from rr_actors.registrar.engine.registrar_actor import RegistrarActor, UnloadWaiter
from rr_actors.registrar.links.provider_link import ProviderLink
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.messages import Loaded, LoadRefused, Message, Unload, Unloaded, UnloadRefused
from rr_actors.registrar.model.rows import STANDBY, Held, Hold, Resource
from rr_actors.registrar.progress_hearers import Hearing, HearsHere, HearsInWorkers, HearsOnThisLoop, hearer_of
from rr_actors.registrar.queries import Query, Views, loaded, loaded_directly
from rr_actors.registrar.servers.callback_context import Current, check_not_own, serving
from rr_actors.runtime.callback_errors import described
from rr_actors.runtime.shielding import Flag
from rr_actors.runtime.time_limits import TimeLimits, deadline_of, left_until
from rr_actors.runtime.workers import LetsIn, LettingIn
from rr_actors.wire.name_service import Presence
from rr_actors.wire.thread_connections import BlockingLink, ThreadConnections
from rr_actors.wire.transport import Exchange
from rr_actors.wire.unix_sockets import paused

T = TypeVar("T")

CALL_TIMEOUT_S = 30.0
"""Seconds for which a thread waits until the loop has answered a short call."""

_NOTED = 256
"""So many calls without waiting are noted, before those that are answered are forgotten."""

_ANSWERS_AT_ONCE = 16
"""The most answers of this process to tasks that come without a turn of their event loop."""

_FAR = 4
"""For how many of these an answer of another process counts."""

GRACE_S = 5.0
"""Seconds for which a thread waits, after a time limit, until the loop says how the call has ended."""


class Calls:
    """The calls of any thread to one registrar's actor."""

    def __init__(self, actor: RegistrarActor) -> None:
        self.actor = actor
        self.dispatcher = actor.node.dispatcher
        self.limits = TimeLimits(self.dispatcher.loop)
        self._unshared = 0
        # no references: a closed event loop never ends its turn, and would keep its task
        self._turn: tuple[weakref.ref[asyncio.AbstractEventLoop], weakref.ref[asyncio.Task[Any]]] | None = None
        self._unawaited: dict[tuple[int, str], weakref.ref[Reply[Any]]] = {}  # the last of each sender and provider
        self._many = _NOTED

    def check_open(self) -> None:
        """Raise RegistrarDown if the registrar is closed."""
        if self.actor.closed:
            raise self.actor.down()

    def check_may_wait(self) -> None:
        """Raise UsageError in a finalizer that the garbage collector runs in the middle of a decision."""
        if has_a_turn():
            text = f"registrar {self.actor.name!r}: called in a finalizer (__del__), where waiting would hang"
            raise UsageError(f"{text}; start a thread for it, or use a form that does not wait (block=False)")

    def check_order(self, what: object, registrar: str, wait: str, starting: str = "") -> None:
        """Raise UsageError if an on_start waits for this code, and a provider starts only after it.

        Args:
            what: what this code wants, for the error.
            wait: the verb for what on_start should do later.
            starting: the path of the manager whose on_start waits; "": of one whose on_start runs this code.
        """
        client = self.actor.clients.get(registrar)
        if client is not None and client.link is not None:  # the provider is up
            return
        if why := why_registrar_too_early(self.actor.node.directory, registrar, wait, starting):
            raise UsageError(f"{what}: {why}", registrar=registrar)

    def connections_to(self, client: ProviderLink) -> ThreadConnections[Exchange] | None:
        """Return the connections of threads to a provider, beside the present link; None if the link is to be used.

        There are none while something that the caller has sent by the link is unanswered: the messages of one sender
        keep their order. There are none before the provider is reconciled over the present link. By then its Peer row
        is on disk, by which it is found after a crash. The first call goes by the link: to open a connection costs more
        than one call saves.
        """
        catalog, provider = self.actor.catalog, client.provider
        if self._unawaited and self._would_overtake(provider):
            return None
        if catalog.up.get(provider) != client.opened or provider not in catalog.peers:
            return None
        if self.actor.closed or self.dispatcher.closed:  # in a forked child, all of this belongs to the parent
            return None
        if client.is_uncalled:
            client.is_uncalled = False
            return None
        return client.connections

    def note_unawaited(self, provider: str, future: Reply[Any]) -> None:
        """Note that the calling thread, or task, goes on while the loop sends what it has asked of a provider."""
        if len(self._unawaited) >= self._many:
            for key, noted in list(self._unawaited.items()):
                if (other := noted()) is None or other.done():
                    self._unawaited.pop(key, None)
            self._many = max(_NOTED, 2 * len(self._unawaited))
        self._unawaited[_sender(), provider] = weakref.ref(future)

    def _would_overtake(self, provider: str) -> bool:
        """Return whether the last thing that the calling thread, or task, has so asked of a provider is unanswered."""
        key = _sender(), provider
        noted = self._unawaited.get(key)
        if noted is None:
            return False
        future = noted()
        if future is not None and not future.done():
            return True
        self._unawaited.pop(key, None)
        return False

    def line_of_task(self, connections: ThreadConnections[Exchange], query_id: str) -> BlockingLink | None:
        """Return a connection for the running task's call about a query; None if the loop has to ask instead.

        If other tasks have asked in this turn of their event loop, the loop asks: it sends and reads many at once.
        """
        task = asyncio.current_task()
        if task is None or self.dispatcher.is_loop_thread() or not self._is_alone(task):
            return None
        line = connections.take_idle(query_id, self.dispatcher.workers.submit)
        if line is None or isinstance(line, BlockingLink):
            return line
        connections.give_back(line)
        return None

    def _is_alone(self, task: asyncio.Task[Any]) -> bool:
        loop = asyncio.get_running_loop()
        if self._turn is None or self._turn[0]() is not loop:
            self._turn = weakref.ref(loop), weakref.ref(task)
            loop.call_soon(self._end_turn)
        return self._turn[1]() is task

    def _end_turn(self) -> None:
        self._turn = None

    async def let_others_in(self, weight: int) -> None:
        """Let the other tasks of the event loop have their turns, after answers that came without one."""
        self._unshared += weight
        if self._unshared >= _ANSWERS_AT_ONCE:
            self._unshared = 0
            await asyncio.sleep(0)

    def call(self, fn: Callable[..., T], *args: Any) -> T:
        """Run fn on the loop, behind the commands that threads have given it before, and return what it returns.

        Raises:
            RegistrarDown: the registrar is closed. Unavailable: the loop does not answer.
            Exception: what fn raised.
        """
        self.check_open()
        self.check_may_wait()
        if self.dispatcher.is_loop_thread():
            return fn(*args)
        reply: Reply[T] = Reply()
        answered = Flag()  # and not reply.get(), which refuses to wait in a coroutine
        self.dispatcher.call(self._run_in_order, reply, answered, fn, args)
        if not answered.wait(CALL_TIMEOUT_S):
            raise Unavailable(f"registrar {self.actor.name!r}: its loop has not answered for {CALL_TIMEOUT_S:g} s")
        return reply.take()

    def _run_in_order(self, reply: Reply[T], answered: Flag, fn: Callable[..., T], args: tuple[Any, ...]) -> None:
        self.actor.take_turns()
        try:
            reply.set(fn(*args))
        except Exception as error:
            fail(reply, error)
        answered.set()

    def start(self, begin: Callable[[Callable[[RrError | None], None]], None]) -> Reply[None]:
        """Have begin(done) called on the loop, and return a reply, which done(error) sets, or the registrar's close."""
        future: Reply[None] = Reply()
        actor = self.actor

        def done(error: RrError | None) -> None:
            actor.callers.discard(done)
            settle(future, error)

        def work() -> None:
            if actor.closed:
                done(actor.down())
            else:
                actor.callers.add(done)
                begin(done)

        self.dispatcher.call(work)
        return future

    def command(self, command: Callable[[Any], Any], what: str) -> None:
        """Have a command decided, behind what the thread has asked for before, and wait for its answer.

        This thread decides it if it can, else the loop. In both cases the loop has carried out what follows, such as
        messages to holders, when this returns: what the caller says next does not overtake that.

        Args:
            command: makes the command of a function that takes the answer; or of None, if the decision is made here.

        Raises:
            RrError: the answer is this error.
        """
        self.check_open()
        if not (has_a_turn() or self.dispatcher.is_behind()) and self.dispatcher.may_block():
            done = threading.Event()
            answer = self.actor.answer_here(command, done.set)
            if answer is not None:
                if not done.wait(CALL_TIMEOUT_S):
                    raise Unavailable(f"registrar {self.actor.name!r}: {what} took longer than {CALL_TIMEOUT_S:g} s")
                if answer.failure is not None:
                    raise error_of(answer.failure)
                return
        self.finish(self.start(lambda done: self.actor.post(command(done))), CALL_TIMEOUT_S, what)

    def finish(self, future: Reply[Any], timeout_s: float | None, what: str, grace_s: float = 0.0) -> Any:
        """Return the reply's value. Wait `timeout_s`, and `grace_s` more for the loop to say how the call ended.

        Raises:
            Unavailable: no reply came in time. RrError: the reply was set with this error.
        """
        self.check_may_wait()
        try:
            return future.take(timeout=None if timeout_s is None else timeout_s + grace_s)
        except pykka.Timeout:
            raise Unavailable(f"registrar {self.actor.name!r}: {what} took longer than {timeout_s:g} s") from None


def _sender() -> int:
    """Return what tells the calling task from others, or the thread that runs none. It may be reused after its end."""
    loop = asyncio._get_running_loop()
    task = None if loop is None else asyncio.current_task(loop)
    return threading.get_ident() if task is None else id(task)


def settle(future: Reply[Any], error: Exception | None, value: Any = None) -> None:
    """Set the reply with the error, or with the value if there is no error."""
    future.set(value) if error is None else fail(future, error)


def with_notes(errors: Sequence[RrError]) -> RrError:
    """Return the first error, with the others as its notes."""
    for other in errors[1:]:
        errors[0].add_note(f"and {type(other).__name__}: {other}")
    return errors[0]


# -- in flight ---------------------------------------------------------------------------------------------------------


class InFlight(Reply[T], abc.ABC):
    """A load or an unload by the loop: the future of its end, and its time limit.

    Attributes:
        limit_s: seconds that it may take from the time when begin() is called; None: no limit.
    """

    limit_s: float | None
    _limits: TimeLimits

    def begin(self, start: Callable[..., object], *args: Any) -> None:
        """Begin the time limit, and call `start`, which sends the load or unload. On the loop."""
        if self.limit_s is not None:
            self._limits.begin(self.limit_s, self.give_up)
        start(*args)

    def end(self, error: RrError | None, value: Any = None) -> None:
        """End the time limit, and set the future. On the loop."""
        if self.limit_s is not None:
            self._limits.end(self.limit_s, self.give_up)
        self.set(value) if error is None else fail(self, error)

    @abc.abstractmethod
    def give_up(self) -> None:
        """Give it up, as its time is over. On the loop."""


def exchanged(actor: RegistrarActor, client: ProviderLink, line: Exchange, message: Message, deadline: float) -> Any:
    """Send a message on a connection of the calling thread, and return the answer. Record both if there is a recording.

    Raises:
        TimeoutError: no answer came in time. OSError: the connection broke, and the message may have arrived.
        NotSerializable: the message is too long, and was not sent.
    """
    node = actor.node
    if node.watched.level[0] <= 1:
        return line.exchange(message, deadline)
    actor.recorder.message("sent", actor.name, client.provider, message)
    answer = line.exchange(message, deadline)
    actor.recorder.message("received", actor.name, client.provider, answer)
    return answer


async def exchanged_awaited(
    actor: RegistrarActor, client: ProviderLink, line: BlockingLink, message: Message, deadline: float
) -> Any:
    """Exchange as exchanged() does, in a task; if that is inside a serial manager, another callback may come in."""
    recorded = actor.node.watched.level[0] > 1
    if recorded:
        actor.recorder.message("sent", actor.name, client.provider, message)
    answer = await LetsIn(line.exchange_awaited(message, deadline))
    if recorded:
        actor.recorder.message("received", actor.name, client.provider, answer)
    return answer


def answered(actor: RegistrarActor, client: ProviderLink, message: Message) -> Any:
    """Return a provider's answer if it is in this process, and answers at once; None if it has not taken the message.

    Record both if there is a recording.
    """
    at = time.time() if actor.node.watched.level[0] > 1 else None
    answer = client.answer_at_once(message)
    if answer is not None and at is not None:
        actor.recorder.message("sent", actor.name, client.provider, message, at)
        actor.recorder.message("received", actor.name, client.provider, answer)
    return answer


# -- loads -------------------------------------------------------------------------------------------------------------


class LoadWays(Protocol):
    """The ways to load with one registrar, of this process or another. From any thread."""

    def begin(self, target: ServerId, request: bytes, parent: str, options: LoadOptions) -> Reply[Query]:
        """Begin a load, and return the future of its query at once. cancel() withdraws the load."""
        ...

    def wait(self, target: ServerId, request: bytes, parent: str, options: LoadOptions) -> Query:
        """Load a resource, and return its query when the resource is held."""
        ...

    async def awaited(self, target: ServerId, request: bytes, parent: str, options: LoadOptions) -> Query:
        """Load a resource, awaited on any event loop. Cancelled, the load is withdrawn."""
        ...


class Loading(InFlight[Query]):
    """A load by the loop: the future of its query. cancel() withdraws it, and so does an await that is cancelled."""

    hearing: Hearing | None = None

    def __init__(self, loads: Loads, query: Query, limit_s: float | None, timeout_s: float | None) -> None:
        super().__init__()
        self._loads, self._limits, self.query = loads, loads.limits, query
        self.limit_s, self.timeout_s = limit_s, timeout_s  # the second as the caller gave it
        if query.parent:
            loads.actor.part_times.began(query.parent)

    def ended(self, held: Held | None, error: RrError | None) -> None:
        """Note how the load has ended. On the loop."""
        if self.query.parent:
            self._loads.actor.part_times.ended(self.query.parent)
        if error is None and held is not None:
            loaded(self.query, held)
        else:
            self._loads.views.forget(self.query.id)
        if self.hearing is not None:
            self._loads.actor.listeners.forget(self.query.id)
        self.end(error, self.query)
        if self.hearing is not None:
            self.hearing.ended()  # last: the thread that it wakes reads at once how the load has ended

    def check_wait(self) -> None:
        """Raise UsageError if on_start waits for this load, and the provider starts only after it."""
        self._loads.check_order(ServerId(self.query.registrar, self.query.server), self.query.parent)

    def unawaited(self) -> None:
        """Withdraw the load, or release the query, which nobody has got."""
        if not self.cancel():
            self._loads.withdraw(self.query)

    def give_up(self) -> None:
        """Withdraw the load, as its time is over. On the loop."""
        actor = self._loads.actor
        if not actor.closed:
            actor.post(c.GiveUp(self.query.id, _too_late(actor, self.query, self.timeout_s)))


class Loads:
    """The loads of one registrar. From any thread."""

    def __init__(self, calls: Calls, views: Views) -> None:
        self.actor = calls.actor
        self.calls = calls
        self.limits = calls.limits
        self.views = views
        self._starting = set[str]()  # the queries for whose loads on_start waits

    def begin(self, target: ServerId, request: bytes, parent: str, options: LoadOptions, query_id: str = "") -> Loading:
        """Begin a load, and return the future of its query at once. A worker calls the hearer of its progress.

        Args:
            query_id: the id that the query gets; "": a new one.

        Raises:
            RegistrarDown: the registrar is closed. UsageError: `progress` is no callable.
        """
        hearer = None if options.progress is False else hearer_of(options.progress, self.actor)
        query = self.views.new(query_id or new_id(), target, request, parent, options.codec)
        try:
            self._listen(query, options)
            hearing = None if hearer is None else HearsInWorkers(hearer, query.id)
            loading = self._begin(query, request, options, hearing)
            self.calls.note_unawaited(target.registrar, loading)
            return loading
        except RrError:
            raise
        except BaseException:  # such as KeyboardInterrupt: the caller never gets the future
            self.withdraw(query)
            raise

    def wait(self, target: ServerId, request: bytes, parent: str, options: LoadOptions, query_id: str = "") -> Query:
        """Load a resource, and return its query when the resource is held. This thread hears of the progress.

        Args:
            query_id: the id of a part that an interrupted run of a callback may have asked for already.

        Raises:
            RrError: how the load ended.
        """
        self.check_order(target, parent)
        dispatcher = self.calls.dispatcher
        if has_a_turn() or asyncio._get_running_loop() is not None:  # else this thread is no loop's
            dispatcher.check_may_block(f"{self.actor.name}.load('{target}')")
            self.calls.check_may_wait()
        hearer = None if options.progress is False else hearer_of(options.progress, self.actor)
        query = self.views.new(query_id or new_id(), target, request, parent, options.codec)
        starts = not self.actor.serving and ask_cycles.starting() is not None
        if starts:
            self._starting.add(query.id)
        if parent:
            self.actor.part_times.began(parent)
        try:
            self._listen(query, options)
            with LettingIn():
                if hearer is not None:
                    self._wait_hearing(query, request, options, HearsHere(hearer))
                elif query_id or not self._directly(query, request, options):
                    self._wait_for(self._begin(query, request, options))
        except RrError:
            raise
        except BaseException:  # such as KeyboardInterrupt: the caller never gets the query
            self.withdraw(query)
            raise
        finally:
            if parent:
                self.actor.part_times.ended(parent)
            self.actor.catalog.wait_limits.pop(query.id, None)
            self.actor.listeners.places.pop(query.id, None)
            if starts:
                self._starting.discard(query.id)
        return query

    async def awaited(self, target: ServerId, request: bytes, parent: str, options: LoadOptions) -> Query:
        """Load a resource, awaited on any event loop, which hears of the progress. Cancelled, the load is withdrawn.

        Raises:
            RrError: how the load ended.
        """
        self.check_order(target, parent)
        hearer = hearer_of(options.progress, self.actor)
        query = self.views.new(new_id(), target, request, parent, options.codec)
        starts = not self.actor.serving and ask_cycles.starting() is not None
        if starts:
            self._starting.add(query.id)
        if parent:
            self.actor.part_times.began(parent)
        try:
            self._listen(query, options)
            if hearer is not None:
                return await self._begin(query, request, options, HearsOnThisLoop(hearer))
            if not (await self._joined(query, request, options) or await self._awaited(query, request, options)):
                await self._begin(query, request, options)
            return query
        except RrError:
            raise
        except BaseException:  # cancelled, or KeyboardInterrupt, which may come anywhere
            self.withdraw(query)
            raise
        finally:
            if parent:
                self.actor.part_times.ended(parent)
            self.actor.catalog.wait_limits.pop(query.id, None)
            self.actor.listeners.places.pop(query.id, None)
            if starts:
                self._starting.discard(query.id)
            if hearer is not None:
                hearer.close()

    async def _joined(self, query: Query, request: bytes, options: LoadOptions) -> bool:
        """Join a resource of this process that others hold, as a thread does. Return False if the loop has to load."""
        actor, id = self.actor, query.id
        client = actor.clients.get(query.registrar)
        if client is None or (epoch := client.epoch_here()) is None or self.calls.connections_to(client) is None:
            return False
        load = actor.begin_directly(query, request, _unheard, _rank(options), options.own)
        if load is None:
            return False
        self.views.add(query)
        answer = answered(actor, client, load)
        if answer is None and actor.forget_refused(id):
            return False
        if type(answer) is not Loaded or client.checksums.get(query.server, 0) != answer.types:
            command: c.Command = c.SendAgain(id)
        elif actor.hold(answer):
            loaded_directly(query, answer.resource_id, answer.response, answer.state)
            await self.calls.let_others_in(1)
            return True
        else:
            command = c.Got(id, answer.resource_id, answer.response, answer.state, epoch)
        loading = Loading(self, query, options.timeout_s, options.timeout_s)
        self.calls.dispatcher.call(loading.begin, actor.go_on_loading, id, loading.ended, command)
        await loading
        return True

    def check_order(self, target: ServerId, parent: str = "") -> None:
        """Raise UsageError if an on_start waits for this load, and the provider starts only after it.

        Args:
            parent: the resource of this registrar whose callback loads. on_start may wait for that in turn, as for a
                resource with a `cost`.
        """
        actor = self.actor
        client = actor.clients.get(target.registrar)
        if client is not None and client.link is not None:  # the provider is up, as for nearly all loads
            return
        starting = actor.path if parent and not actor.serving and self._is_for_start(parent) else ""
        self.calls.check_order(target, target.registrar, "load", starting)

    def _is_for_start(self, resource_id: str) -> bool:
        """Return whether on_start waits for a load of a resource, or for one of which that is a part."""
        with self.actor.lock:
            catalog, seen, wholes = self.actor.whole(), set[str](), [resource_id]
            while wholes:
                for query in catalog.queries_of(wholes.pop()):
                    if query.id in self._starting:
                        return True
                    if query.origin == self.actor.name and query.parent and query.parent not in seen:
                        seen.add(query.parent)
                        wholes.append(query.parent)
        return False

    def _listen(self, query: Query, options: LoadOptions) -> None:
        self.calls.check_open()
        if options.own:
            check_allowed(options.priority, self.actor.config)
        if options.wait_s is not None:
            self.actor.catalog.wait_limits[query.id] = round(1000 * options.wait_s)
        if options.on_status is not None:
            self.views.callbacks.set(query.id, described(options.on_status, "load: on_status"), options.loop)

    def _begin(self, query: Query, request: bytes, options: LoadOptions, hearing: Hearing | None = None) -> Loading:
        """Have the loop send a load."""
        loading = Loading(self, query, options.timeout_s, options.timeout_s)
        loading.withdraw = functools.partial(self.withdraw, query)
        if hearing is not None:
            loading.hearing = hearing
            self.actor.listeners.add(query.id, hearing.progressed)
        facts = query.id, query.registrar, query.server, request, query.parent, next(self.actor.sequence)
        ask = c.AskProvider(*facts, _rank(options), options.own)
        self.calls.dispatcher.call(loading.begin, self._ask, loading, ask)
        return loading

    def _ask(self, loading: Loading, ask: c.AskProvider) -> None:
        self.views.add(loading.query)
        self.actor.ask(ask, loading.ended)

    def _wait_hearing(self, query: Query, request: bytes, options: LoadOptions, hearing: HearsHere) -> None:
        limit_s = options.timeout_s
        try:
            loading = self._begin(query, request, options, hearing)
            hearing.hear_within(None if limit_s is None else limit_s + GRACE_S)
            self._end_of(loading, 0.0)
        finally:
            hearing.close()

    def _wait_for(self, loading: Loading) -> None:
        """Wait until a load has ended. The loop ends an overdue load; the thread waits a little longer for that."""
        self._end_of(loading, None if loading.limit_s is None else loading.limit_s + GRACE_S)

    def _end_of(self, loading: Loading, within_s: float | None) -> None:
        """Return if the load has succeeded within this time.

        Raises:
            RrError: it has failed, or the loop does not say in time how it has ended.
        """
        try:
            loading.take(timeout=within_s)
        except pykka.Timeout:
            raise error_of(_too_late(self.actor, loading.query, loading.timeout_s)) from None

    def withdraw(self, query: Query) -> None:
        """Withdraw a load for which no caller waits any more, at any stage: asked for, loading, or held."""
        self.views.forget(query.id)
        with contextlib.suppress(Unavailable):  # the loop has ended, and with it all that this process holds
            self.calls.dispatcher.call(self._withdraw_now, query)

    def _withdraw_now(self, query: Query) -> None:
        self.views.forget(query.id)
        if not self.actor.closed:
            server = query.server_id
            text = f"{server}: the load was cancelled, or its caller was interrupted"
            self.actor.post(c.GiveUp(query.id, Failure("LoadError", text, {"server": server}), unheard=True))

    # -- directly ------------------------------------------------------------------------------------------------

    def _directly(self, query: Query, request: bytes, options: LoadOptions) -> bool:
        """Load on a connection of this thread's own. Return False if the loop has to load instead.

        Raises:
            RrError: how the load ended.
        """
        actor = self.actor
        client = actor.clients.get(query.registrar)
        if client is None or (connections := self.calls.connections_to(client)) is None:
            return False
        line: Exchange | None = None
        over: list[RrError] = []  # with the error, once the loop has ended this load; at any moment

        def ended(_held: Held | None, error: RrError | None) -> None:
            if error is not None and line is not None:  # a load that succeeded is answered on the connection, too
                over.append(error)
                connections.cut(line)

        timeout_s = options.timeout_s
        deadline = math.inf if timeout_s is None else time.monotonic() + timeout_s
        try:
            line = connections.take(timeout_s)
            if line is None:
                return False
            load = actor.begin_directly(query, request, ended, _rank(options), options.own)
            if load is None:
                connections.give_back(line)
                return False
            self.views.add(query)
            answer = exchanged(actor, client, line, load, deadline)
            connections.give_back(line)
        except (OSError, NotSerializable) as error:
            command = self._not_answered(query, error, timeout_s)
        except BaseException:  # such as KeyboardInterrupt, which may come anywhere
            connections.drop_mine()
            raise
        else:
            if type(answer) is Loaded and client.checksums.get(query.server, 0) == answer.types and actor.hold(answer):
                loaded_directly(query, answer.resource_id, answer.response, answer.state)
                return True
            command = self._not_held(query, client, answer, line.epoch)
        connections.drop_mine()
        if not over:
            try:
                self._go_on(query, command, left_until(deadline), timeout_s)
            except RrError:
                if not over:
                    raise
        if over:
            raise over.pop()  # the error has this frame, and would have itself
        return True

    async def _awaited(self, query: Query, request: bytes, options: LoadOptions) -> bool:
        """Load on a connection of this task's own. Return False if the loop has to load instead.

        Raises:
            RrError: how the load ended.
        """
        actor = self.actor
        client = actor.clients.get(query.registrar)
        if client is None or (connections := self.calls.connections_to(client)) is None:
            return False
        line: BlockingLink | None = None
        over: list[RrError] = []  # as in _directly()

        def ended(_held: Held | None, error: RrError | None) -> None:
            if error is not None and line is not None:
                over.append(error)
                connections.cut(line)

        timeout_s = options.timeout_s
        deadline = deadline_of(timeout_s)
        try:
            line = self.calls.line_of_task(connections, query.id)
            if line is None:
                return False
            load = actor.begin_directly(query, request, ended, _rank(options), options.own)
            if load is None:
                connections.give_back(line)
                return False
            self.views.add(query)
            answer = await exchanged_awaited(actor, client, line, load, deadline)
            connections.give_back(line)
        except (OSError, NotSerializable) as error:
            command = self._not_answered(query, error, timeout_s)
        except BaseException:  # cancelled, or KeyboardInterrupt, which may come anywhere
            connections.drop_mine(query.id)
            raise
        else:
            if type(answer) is Loaded and client.checksums.get(query.server, 0) == answer.types and actor.hold(answer):
                loaded_directly(query, answer.resource_id, answer.response, answer.state)
                await self.calls.let_others_in(_FAR)
                return True
            command = self._not_held(query, client, answer, line.epoch)
        connections.drop_mine(query.id)
        if not over:
            limit_s = None if isinstance(command, c.GiveUp) else left_until(deadline)
            loading = Loading(self, query, limit_s, timeout_s)
            self.calls.dispatcher.call(loading.begin, actor.go_on_loading, query.id, loading.ended, command)
            try:
                await loading
            except RrError:
                if not over:
                    raise
            finally:
                loading.forget_error()
        if over:
            raise over.pop()  # the error has this frame, and would have itself
        return True

    def _not_answered(self, query: Query, error: Exception, timeout_s: float | None) -> c.Command:
        """Return the loop's command after a question that has no answer on its connection."""
        if isinstance(error, TimeoutError):
            return c.GiveUp(query.id, _too_late(self.actor, query, timeout_s), unheard=True)
        if isinstance(error, OSError):
            return c.SendAgain(query.id)
        return c.GiveUp(query.id, failure_of(error), unheard=True)

    def _not_held(self, query: Query, client: ProviderLink, answer: Loaded | LoadRefused, epoch: int) -> c.Command:
        """Return the loop's command after an answer that refuses the load, or that was not stored.

        Args:
            epoch: the provider's.

        Raises:
            RrError: the load was refused, and the loop does not know of it.
        """
        actor, id = self.actor, query.id
        if isinstance(answer, Loaded):
            if client.checksums.get(query.server, 0) != answer.types:
                return c.SendAgain(id)  # the link brings the types, and then the answer once more
            return c.Got(id, answer.resource_id, answer.response, answer.state, epoch)
        if not actor.forget_refused(id):
            # The loop may have sent the load again. It is withdrawn, on disk, before the caller hears the error.
            return c.GiveUp(id, answer.failure, unheard=True)
        self.views.forget(id)
        raise error_of(answer.failure)

    def _go_on(self, query: Query, command: c.Command, left_s: float | None, timeout_s: float | None) -> None:
        """Have the registrar's actor go on with the load, or end it, and wait until the load has ended."""
        loading = Loading(self, query, None if isinstance(command, c.GiveUp) else left_s, timeout_s)
        self.calls.dispatcher.call(loading.begin, self.actor.go_on_loading, query.id, loading.ended, command)
        if not isinstance(command, c.GiveUp):
            self._wait_for(loading)
            return
        with contextlib.suppress(pykka.Timeout):
            loading.take(timeout=GRACE_S)
        raise error_of(command.failure)  # the loop does not answer: it withdraws the load later


def _rank(options: LoadOptions) -> int:
    """Return a load's priority as rows have it."""
    return STANDBY if options.priority is None else options.priority


def _too_late(actor: RegistrarActor, query: Query, timeout_s: float | None) -> Failure:
    """Return the failure of a load that has taken too long. Its text says what the provider seems to be doing."""
    server = f"{query.registrar}/{query.server}"
    place = actor.listeners.places.get(query.id)
    if place is None:
        does = _CALLBACK.format("load callback, or an unload for which it waits,")
    else:
        ago = "" if place.since is None else f" (asked for it {max(0.0, time.time() - place.since):.3g} s ago)"
        does = f"and has said last that the load is {place.text}{ago}"
    status, doing = _doing(actor, query.registrar, does)
    text = f"{server}: not loaded within {timeout_s:g} s; {query.registrar} is {doing}; the load is withdrawn"
    details: dict[str, Any] = {"server": server, "timeout_s": timeout_s, "status": str(status)}
    if place is not None:
        details |= {"holder": place.holder, "since": place.since}
    hosts = actor.node.info.hosts
    if hosts is not None and (away := hosts.unreachable(actor.node.directory, query.registrar)) is not None:
        return Failure("HostUnreachable", text, details | {"host": away.name, "since_s": time.time() - away.since})
    return Failure("LoadTimeout", text, details)


_CALLBACK = "its {} has not returned yet, or what it returned is not on disk yet"


def _doing(actor: RegistrarActor, provider: str, does: str) -> tuple[Presence, str]:
    """Return the directory's status of a provider that has not answered, and words for the status.

    `does` says for what a provider that is up may keep the caller waiting.
    """
    entry = actor.node.find(provider)
    if entry is None:
        return Presence.GONE, _DOING[Presence.GONE]
    if entry.status is Presence.UP:
        return Presence.UP, paused(entry.address) or f"up, {does}"
    return entry.status, f"{_DOING[entry.status]}{entry.because}"


_DOING = {
    Presence.STARTING: "starting, or being started again",
    Presence.STOPPED: "stopped",
    Presence.GONE: "gone for good",
    Presence.DORMANT: "dormant: its process died, and nobody has opened it again",
}


# -- unloads -----------------------------------------------------------------------------------------------------------
#
# The registrar's actor releases a query; or a thread that waits does so, on a connection of its own. The thread writes
# that the release is owed, asks the provider, and forgets the query (RegistrarState). If the provider is down,
# the thread hears so when its time is up. The release stays owed, on disk, until the provider is back.


Release = Callable[[str, UnloadWaiter], None]


class Unloading(InFlight[None]):
    """An unload by the loop: the future of its end."""

    def __init__(self, unloads: Unloads, query_id: str, limit_s: float | None, timeout_s: float | None) -> None:
        super().__init__()
        self._unloads, self._limits, self.query_id = unloads, unloads.calls.limits, query_id
        self.limit_s, self.timeout_s = limit_s, timeout_s  # the second as the caller gave it

    def check_wait(self) -> None:
        """Raise UsageError if on_start waits for this unload, and the provider starts only after it."""
        self._unloads.check_order(self.query_id)

    def give_up(self) -> None:
        """Send its caller the error that the provider has not answered in time. On the loop."""
        self._unloads.release_overdue(self.query_id, self.timeout_s)


class UnloadingAll(Reply[None]):
    """The unloads of several queries: the future of their end."""

    def __init__(self, unloads: Unloads, query_ids: Sequence[str]) -> None:
        super().__init__()
        self._unloads, self.query_ids = unloads, query_ids

    def check_wait(self) -> None:
        """Raise UsageError if on_start waits for these unloads, and a provider starts only after it."""
        for query_id in self.query_ids:
            self._unloads.check_order(query_id)


class UnloadWays(Protocol):
    """The ways to unload with one registrar, of this process or another. From any thread."""

    def begin(self, query_id: str, timeout_s: float | None) -> Reply[None]:
        """Begin to release a query, and return a future of its end at once."""
        ...

    def wait(self, query_id: str, timeout_s: float | None) -> None:
        """Release a query, and return when that is done."""
        ...

    async def awaited(self, query_id: str, timeout_s: float | None) -> None:
        """Release a query, awaited on any event loop. Cancelled, the release goes on."""
        ...

    def force_begin(self, target: str, timeout_s: float | None) -> Reply[None]:
        """Begin to unload a resource that the registrar serves, even if it is held."""
        ...

    def force_wait(self, target: str, timeout_s: float | None) -> None:
        """Unload a resource that the registrar serves, even if it is held, and return when that is done."""
        ...

    def begin_all(self, server: ServerId | None, timeout_s: float | None) -> Reply[None]:
        """Begin to release all queries at a server, or, for None, all that the registrar holds for itself."""
        ...

    def wait_all(self, server: ServerId | None, timeout_s: float | None) -> None:
        """Release what begin_all() releases, and return when all have been tried."""
        ...


class Unloads:
    """The unloads of one registrar. From any thread."""

    def __init__(self, calls: Calls, views: Views) -> None:
        self._actor = calls.actor
        self.calls = calls
        self._views = views

    def wait(self, query_id: str, timeout_s: float | None) -> None:
        """Release a query, and return when that is done.

        Raises:
            RrError: how the unload ended.
        """
        if has_a_turn():  # a finalizer, which the garbage collector runs: it cannot wait
            self.begin(query_id, timeout_s)
            return
        self.check_order(query_id)
        with LettingIn():
            if not self._directly(query_id, timeout_s):
                self._finish(self.begin(query_id, timeout_s))

    async def awaited(self, query_id: str, timeout_s: float | None) -> None:
        """Release a query, awaited on any event loop. Cancelled, the release goes on.

        Raises:
            RrError: how the unload ended.
        """
        self.check_order(query_id)
        if not await self._directly_awaited(query_id, timeout_s):
            await self.begin(query_id, timeout_s)

    def check_order(self, query_id: str) -> None:
        """Raise UsageError if on_start waits for this unload, and the provider starts only after it."""
        held = None if ask_cycles.starting() is None else self._actor.catalog.held.get(query_id)
        if held is not None:
            self.calls.check_order(f"unloading {held.registrar}/{held.server}", held.registrar, "unload")

    def begin(self, query_id: str, timeout_s: float | None) -> Unloading:
        """Begin to release a query, and return a future of its end at once."""
        held = self._actor.catalog.held.get(query_id)
        unloading = self._begin(Unloading(self, query_id, timeout_s, timeout_s), self.release)
        if held is not None:
            self.calls.note_unawaited(held.registrar, unloading)
        return unloading

    def _begin(self, unloading: Unloading, release: Release) -> Unloading:
        self.calls.dispatcher.call(unloading.begin, release, unloading.query_id, unloading.end)
        return unloading

    def _finish(self, unloading: Unloading) -> None:
        self.calls.finish(unloading, unloading.limit_s, f"unloading {unloading.query_id}", GRACE_S)

    def force_wait(self, target: str, timeout_s: float | None) -> None:
        """Unload a resource served here, even if it is held, and return when that is done.

        Raises:
            RrError: how the unload ended.
        """
        begin = functools.partial(self.force_begin, target, timeout_s)
        self._end_of(target, "the forced unload", "with block=False it does not wait", begin, timeout_s)

    def revoke(self, target: str, why: str, grace_s: float, timeout_s: float | None) -> None:
        """Have all holders let a resource go that is served here, and return when it is unloaded.

        Raises:
            RrError: how the unload ended.
        """
        grace_ms = round(grace_s * 1000)
        start = functools.partial(self._actor.revoke, target, why, grace_ms)
        begin = functools.partial(self.calls.start, start)
        self._end_of(target, "the revocation", "another thread may make it", begin, timeout_s)

    def reload(self, target: str, timeout_s: float | None) -> None:
        """Unload a resource that is served here, load it again, and return when that is done.

        Raises:
            RrError: how the reload ended.
        """
        begin = functools.partial(self.calls.start, functools.partial(self._actor.reload, target))
        self._end_of(target, "the reload", "another thread may make it", begin, timeout_s, "reloading")

    def _end_of(
        self,
        target: str,
        called: str,
        instead: str,
        begin: Callable[[], Reply[None]],
        timeout_s: float | None,
        doing: str = "unloading",
    ) -> None:
        resource, is_served = self.calls.call(self._find, target)

        def is_of_it(me: Current) -> bool:
            return serving(me) is self._actor and resource is not None and resource.id == me.resource_id

        what = f"registrar {self._actor.name!r}: {called} of {shortened(target)}"
        check_not_own(what, is_of_it, instead)
        what = f"{doing} {shortened(target)}"
        if resource is not None and not is_served:
            what += f", which waits for its server {self._actor.catalog.origin_of(resource)!r} to be registered again,"
        self.calls.finish(begin(), timeout_s, what)

    def _find(self, target: str) -> tuple[Resource | None, bool]:
        """Return a resource that is served here, and whether its server is registered. On the loop."""
        with self._actor.lock:
            catalog = self._actor.whole()
            resource = catalog.find(target)
            return resource, resource is not None and resource.server in catalog.servers

    def force_begin(self, target: str, timeout_s: float | None) -> Reply[None]:
        """Begin to unload a resource served here, even if it is held, and return a future of its end at once.

        The future has no time limit.
        """
        return self.calls.start(functools.partial(self._actor.force, target))

    def begin_all(self, server: ServerId | None, timeout_s: float | None) -> Reply[None]:
        """Release every query at a server, or what is held for the registrar itself, newest first.

        The future is set when all have been tried.

        Raises:
            UnknownServer: the registrar holds nothing at that server, and never did.
        """

        def is_wanted(held: Held | Query) -> bool:
            return not held.parent if server is None else (held.registrar, held.server) == server

        if server is not None:
            self.calls.call(self._check_client, server)
        reply = self.calls.call(self._many_now, is_wanted, timeout_s)
        for provider in list(self._actor.clients) if server is None else [server.registrar]:
            self.calls.note_unawaited(provider, reply)
        return reply

    def wait_all(self, server: ServerId | None, timeout_s: float | None) -> None:
        """Release as begin_all() does, and return when all have been tried."""
        self.begin_all(server, timeout_s).get()

    def _check_client(self, server: ServerId) -> None:
        if self._views.was_at(server):
            return
        with self._actor.lock:
            held = self._actor.whole().held.values()
            known = tuple(sorted({f"{row.registrar}/{row.server}" for row in held if row.hold is not Hold.OWED}))
        at = "it holds nothing at any server" if not known else f"it holds something at {', '.join(known)}"
        text = f"unload_client({str(server)!r}): registrar {self._actor.name!r} holds nothing there and never did; {at}"
        raise UnknownServer(text, server=str(server), known=known)

    # -- directly ------------------------------------------------------------------------------------------------

    def _directly(self, query_id: str, timeout_s: float | None) -> bool:
        """Release a query on a connection of this thread's own. Return False if the loop has to do it instead.

        Raises:
            RrError: how the unload ended.
        """
        actor = self._actor
        held = actor.catalog.held.get(query_id)
        client = None if held is None else actor.clients.get(held.registrar)
        connections = None if client is None else self.calls.connections_to(client)
        if client is None or connections is None or not self.calls.dispatcher.may_block():
            return False
        deadline = deadline_of(timeout_s)
        answer: Any = None
        try:
            line = connections.take(timeout_s)
            if line is None:
                return False
            if not actor.owe(query_id):
                connections.give_back(line)
                return False
            unload = Unload(query_id, actor.name)
            answer = exchanged(actor, client, line, unload, deadline)
            connections.give_back(line)
            if type(answer) is Unloaded and not actor.forget_released(query_id):
                self.calls.dispatcher.call(actor.receive, answer, client.provider)
        except OSError:  # also TimeoutError, and then no time is left
            connections.drop_mine()
        except BaseException:  # such as KeyboardInterrupt: the loop goes on with the release
            connections.drop_mine()
            self.calls.dispatcher.call(actor.go_on_unloading, query_id, _no_one)
            raise
        if type(answer) is Unloaded:
            self._views.forget(query_id)
        else:
            refusal = answer.failure if type(answer) is UnloadRefused else None
            self.go_on(Unloading(self, query_id, left_until(deadline), timeout_s), refusal)
        return True

    async def _directly_awaited(self, query_id: str, timeout_s: float | None) -> bool:
        """Release a query on a connection of this task's own, or by a call if the provider is in this process.

        Return False if the loop has to do it instead.
        """
        actor, calls = self._actor, self.calls
        held = actor.catalog.held.get(query_id)
        client = None if held is None else actor.clients.get(held.registrar)
        connections = None if client is None else calls.connections_to(client)
        if client is None or connections is None:
            return False
        deadline = deadline_of(timeout_s)
        answer: Any = None
        line: BlockingLink | None = None
        try:
            if client.epoch_here() is None and (line := calls.line_of_task(connections, query_id)) is None:
                return False
            if not actor.owe(query_id):
                if line is not None:
                    connections.give_back(line)
                return False
            unload = Unload(query_id, actor.name)
            if line is None:
                answer = answered(actor, client, unload)
            else:
                answer = await exchanged_awaited(actor, client, line, unload, deadline)
                connections.give_back(line)
            if type(answer) is Unloaded and not actor.forget_released(query_id):
                calls.dispatcher.call(actor.receive, answer, client.provider)
        except OSError:  # also TimeoutError, and then no time is left
            connections.drop_mine(query_id)
        except BaseException:  # cancelled, or KeyboardInterrupt: the loop goes on with the release
            connections.drop_mine(query_id)
            with contextlib.suppress(Unavailable):  # the loop has ended, and with it all that this process holds
                calls.dispatcher.call(actor.go_on_unloading, query_id, _no_one)
            raise
        if type(answer) is not Unloaded:
            refusal = answer.failure if type(answer) is UnloadRefused else None
            unloading = Unloading(self, query_id, left_until(deadline), timeout_s)
            await self._begin(unloading, functools.partial(actor.go_on_unloading, refusal=refusal))
            return True
        self._views.forget(query_id)
        await calls.let_others_in(1 if line is None else _FAR)
        return True

    def go_on(self, unloading: Unloading, refusal: Failure | None) -> None:
        """Have the loop go on with an unload that this thread has begun, and return when that is done.

        Args:
            refusal: the answer on the thread's connection; None: the connection broke, or has no answer yet.
        """
        self._finish(self._begin(unloading, functools.partial(self._actor.go_on_unloading, refusal=refusal)))

    # -- on the loop ---------------------------------------------------------------------------------------------

    def release(self, query_id: str, done: UnloadWaiter) -> None:
        """Have the registrar's actor release a query, and call `done` with the error, or with None."""
        theirs = self._actor.catalog.queries.get(query_id)
        if query_id not in self._actor.catalog.held and theirs is not None and theirs.origin != self._actor.name:
            done(error_of(failures.not_holder(query_id, theirs.origin, self._actor.name)))
        else:
            self._actor.release(query_id, done)

    def release_overdue(self, query_id: str, timeout_s: float | None) -> None:
        """Send all waiters for the unload of a query the error that its provider has not answered in time."""
        actor = self._actor
        held = actor.catalog.held.get(query_id)
        if actor.closed or held is None:
            return
        provider = repr(held.registrar)
        status, doing = _doing(actor, held.registrar, _CALLBACK.format("unload callback, or one before it,"))
        text = (
            f"query {query_id}: {provider} did not answer within {timeout_s:g} s; the release is owed and will be sent"
        )
        details = {"registrar": held.registrar, "timeout_s": timeout_s, "status": str(status)}
        failure = Failure("Unavailable", f"{text}; {provider} is {doing}", details)
        actor.post(c.ReleaseOverdue(query_id, failure))

    def _many_now(self, wanted: Callable[[Held | Query], bool], timeout_s: float | None) -> Reply[None]:
        """Begin to release. The reply raises the first error; the others are its notes."""
        reply = UnloadingAll(self, ())
        errors: list[RrError] = []

        def ended(query_id: str, error: RrError | None) -> None:
            del pending[query_id]
            if error is not None:
                errors.append(error)
            if not pending:
                settle(reply, with_notes(errors) if errors else None)

        def overdue() -> None:
            releases.hurry()
            for query_id in list(pending):
                self.release_overdue(query_id, timeout_s)

        with self._actor.lock:  # meanwhile no thread releases one of them
            held = self._actor.whole().held
            mine = [id for id in self._actor.newest_first() if wanted(held[id]) and held[id].hold is Hold.HELD]
            pending = dict.fromkeys(mine)
            reply.query_ids = mine
            releases = Releases(self._actor, mine, ended)
        self._views.forget_taken(wanted)
        if not mine:
            reply.set()
        elif timeout_s is not None and pending:
            self.calls.limits.begin(timeout_s, overdue)
            reply.when_set(lambda: self.calls.limits.end(timeout_s, overdue))
        return reply


def _unheard(_held: Held | None, _error: RrError | None) -> None:
    pass  # how a load has ended that its task asks for again


def _no_one(_error: RrError | None) -> None:
    """Ignore how an unload has ended: its caller was interrupted."""
