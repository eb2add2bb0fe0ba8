"""Loads and unloads: how the calling thread sends each one, and how the result comes back.

A caller waits in its thread, by a future, or by `await`. The registrar's actor sends the load or unload. For a thread
that waits, the thread itself sends it, on a connection of its own (links/provider_link.py). No call waits on the loop.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import threading
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import msgspec
import pykka

from rr_actors.actors.messaging.futures import Reply, fail
from rr_actors.base.errors import NotSerializable, RrError, Unavailable, UnknownServer, UsageError, shortened
from rr_actors.base.names import ServerId, new_id
from rr_actors.registrar.engine.bulk_release import Releases
from rr_actors.registrar.engine.monitor import is_deciding
from rr_actors.registrar.engine.registrar_actor import RegistrarActor, UnloadWaiter
from rr_actors.registrar.engine.server import Current, check_not_own, serving
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import failures
from rr_actors.registrar.model.messages import (
    Failure,
    Loaded,
    LoadRefused,
    Message,
    Unload,
    Unloaded,
    UnloadRefused,
    error_of,
    failure_of,
)
from rr_actors.registrar.model.rows import Held, Hold, Resource
from rr_actors.registrar.progress_hearers import Hearer, HearingWait, in_workers, on_this_loop
from rr_actors.registrar.queries import Query, StatusCallback, Views, loaded, loaded_directly
from rr_actors.runtime.time_limits import TimeLimits, deadline_of, left_until
from rr_actors.wire.name_service import Status
from rr_actors.wire.transport import Exchange

T = TypeVar("T")

CALL_TIMEOUT_S = 30.0
"""Seconds for which a thread waits until the loop has answered a short call."""
GRACE_S = 5.0
"""Seconds for which a thread waits, after a time limit, until the loop says how the call has ended."""


class Wait:
    """The wait of one thread until the loop has done one task."""

    __slots__ = ("_lock", "done", "error", "value")

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lock.acquire()
        self.done = False
        self.value: Any = None
        self.error: BaseException | None = None

    def ended(self, value: Any, error: Exception | None) -> None:
        """Note how the task ended, and wake the thread that waits. On the loop."""
        self.value = value
        self.error = error
        self.done = True
        self._lock.release()

    def done_within(self, timeout_s: float | None) -> bool:
        """Wait at most `timeout_s` seconds, and return whether the task is done."""
        return self._lock.acquire(timeout=-1 if timeout_s is None else max(0.0, timeout_s))


class Calls:
    """The calls of any thread to one registrar's actor."""

    def __init__(self, actor: RegistrarActor) -> None:
        self.actor = actor
        self.dispatcher = actor.node.dispatcher
        self.limits = TimeLimits(self.dispatcher.loop)

    def check_open(self) -> None:
        """Raise RegistrarDown if the registrar is closed."""
        if self.actor.closed:
            raise self.actor.down()

    def check_may_wait(self) -> None:
        """Raise UsageError in a finalizer that the garbage collector runs in the middle of a decision."""
        if is_deciding():
            text = f"registrar {self.actor.name!r}: called in a finalizer (__del__), where waiting would hang"
            raise UsageError(f"{text}; start a thread for it, or use a form that does not wait (block=False)")

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
        wait = Wait()
        self.dispatcher.call(self._run_in_order, wait, fn, args)
        if not wait.done_within(CALL_TIMEOUT_S):
            raise Unavailable(f"registrar {self.actor.name!r}: its loop has not answered for {CALL_TIMEOUT_S:g} s")
        if wait.error is not None:
            raise wait.error
        return wait.value

    def _run_in_order(self, wait: Wait, fn: Callable[..., Any], args: tuple[Any, ...]) -> None:
        self.actor.monitor.decide_waiting()
        try:
            value = fn(*args)
        except Exception as error:
            wait.ended(None, error)
        else:
            wait.ended(value, None)

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
        """Give the actor a command, and wait for its answer. `command` makes it of a function that takes the answer.

        Raises:
            RrError: the answer is this error.
        """
        self.check_open()
        self.finish(self.start(lambda done: self.actor.post(command(done))), CALL_TIMEOUT_S, what)

    def finish(self, future: Reply[Any], timeout_s: float | None, what: str, grace_s: float = 0.0) -> Any:
        """Return the reply's value. Wait `timeout_s`, and `grace_s` more for the loop to say how the call ended.

        Raises:
            Unavailable: no reply came in time. RrError: the reply was set with this error.
        """
        self.check_may_wait()
        try:
            return future.get(timeout=None if timeout_s is None else timeout_s + grace_s)
        except pykka.Timeout:
            raise Unavailable(f"registrar {self.actor.name!r}: {what} took longer than {timeout_s:g} s") from None


def settle(future: Reply[Any], error: Exception | None, value: Any = None) -> None:
    """Set the reply with the error, or with the value if there is no error."""
    future.set(value) if error is None else fail(future, error)


def with_notes(errors: Sequence[RrError]) -> RrError:
    """Return the first error, with the others as its notes."""
    for other in errors[1:]:
        errors[0].add_note(f"and {type(other).__name__}: {other}")
    return errors[0]


# -- loads -------------------------------------------------------------------------------------------------------------

Ended = Callable[[Held | None, RrError | None], None]


def _recorded(actor: RegistrarActor, line: Exchange, provider: str, message: Message, deadline: float) -> Any:
    """Send a message and return the answer, as `line.exchange` does, and record both."""
    recorder = actor.node.recorder
    recorder.message("sent", actor.name, provider, message)
    answer = line.exchange(message, deadline)
    recorder.message("received", actor.name, provider, answer)
    return answer


class Loads:
    """The loads of one registrar. From any thread."""

    def __init__(self, calls: Calls, views: Views) -> None:
        self.actor = calls.actor
        self.calls = calls
        self.views = views

    # -- three ways to wait --------------------------------------------------------------------------------------

    def wait(
        self,
        target: ServerId,
        request: bytes,
        parent: str,
        on_status: StatusCallback | None,
        timeout_s: float | None,
        hearer: Hearer | None = None,
        query_id: str = "",
    ) -> Query:
        """Load a resource, and return its query when the resource is held.

        Args:
            hearer: called in this thread. With one, the loop sends the load.
            query_id: the id of a part that an interrupted run of a callback may have asked for already.

        Raises:
            RrError: how the load ended.
        """
        dispatcher = self.calls.dispatcher
        if is_deciding() or not dispatcher.may_block():
            dispatcher.check_may_block(f"{self.actor.name}.load('{target}')")
            self.calls.check_may_wait()
        query = self.views.new(query_id or new_id(), target, request, parent)
        try:
            self._listen(query, on_status)
            if hearer is not None:
                self._wait_hearing(query, request, timeout_s, hearer)
            elif query_id or not self._directly(query, request, timeout_s):
                wait = Wait()
                dispatcher.call(self._begin, query, self._ask(query, request), wait.ended)
                self._await_end(wait, query, timeout_s, timeout_s)
        except RrError:
            raise
        except BaseException:  # such as KeyboardInterrupt: the caller never gets the query
            self._withdraw(query)
            raise
        return query

    def _wait_hearing(self, query: Query, request: bytes, timeout_s: float | None, hearer: Hearer) -> None:
        wait = HearingWait(hearer)
        self.actor.listeners.add(query.id, wait.progressed)
        try:
            self.calls.dispatcher.call(self._begin, query, self._ask(query, request), wait.ended)
            self._await_end(wait, query, timeout_s, timeout_s)
        finally:
            self.actor.listeners.forget(query.id)
            hearer.close()

    def future(
        self,
        target: ServerId,
        request: bytes,
        parent: str,
        on_status: StatusCallback | None,
        timeout_s: float | None,
        hearer: Hearer | None = None,
    ) -> Reply[Query]:
        """Begin a load, and return a future of its query at once. A worker calls `hearer`."""
        future: Reply[Query] = Reply()
        query = self.views.new(new_id(), target, request, parent)

        def ended(_held: Held | None, error: RrError | None) -> None:
            settle(future, error, query)
            if hearer is not None:
                self.actor.listeners.forget(query.id)
                with contextlib.suppress(Unavailable):  # the registrar's workers have ended, and the bar with them
                    self.actor.workers.serial(("progress", query.id), hearer.close)

        try:
            self._listen(query, on_status)
            if hearer is not None:
                self.actor.listeners.add(query.id, in_workers(hearer, self.actor, query.id))
            future.withdraw = functools.partial(self._withdraw, query)
            self.calls.dispatcher.call(self._begin, query, self._ask(query, request), ended, timeout_s)
        except RrError:
            raise
        except BaseException:  # such as KeyboardInterrupt: the caller never gets the future
            self._withdraw(query)
            raise
        return future

    async def result(
        self,
        target: ServerId,
        request: bytes,
        parent: str,
        on_status: StatusCallback | None,
        timeout_s: float | None,
        hearer: Hearer | None = None,
    ) -> Query:
        """Load a resource, awaited on any event loop, which calls `hearer`. If it is cancelled, the load is withdrawn.

        Raises:
            RrError: how the load ended.
        """
        query = self.views.new(new_id(), target, request, parent)
        loop = asyncio.get_running_loop()
        future: asyncio.Future[RrError | None] = loop.create_future()  # asyncio logs an exception that nobody reads

        def settle(error: RrError | None) -> None:
            with contextlib.suppress(asyncio.InvalidStateError):  # cancelled, perhaps by a Ctrl-C just now
                future.set_result(error)

        def ended(_held: Held | None, error: RrError | None) -> None:
            try:
                loop.call_soon_threadsafe(settle, error)
            except RuntimeError:  # the event loop is closed, with the task that waited
                self._withdraw(query)

        try:
            self._listen(query, on_status)
            if hearer is not None:
                self.actor.listeners.add(query.id, on_this_loop(hearer))
            self.calls.dispatcher.call(self._begin, query, self._ask(query, request), ended, timeout_s)
            if (error := await future) is not None:
                raise error
        except RrError:
            raise
        except BaseException:  # cancelled, or KeyboardInterrupt, which may come anywhere
            self._withdraw(query)
            raise
        finally:
            if hearer is not None:
                self.actor.listeners.forget(query.id)
                hearer.close()
        return query

    def _listen(self, query: Query, on_status: StatusCallback | None) -> None:
        self.calls.check_open()
        if on_status is not None:
            self.views.listen(query.id, on_status)

    def _withdraw(self, query: Query) -> None:
        """Withdraw a load for which no caller waits any more, at any stage: asked for, loading, or held."""
        with contextlib.suppress(Unavailable):  # the loop has ended, and with it all that this process holds
            self.calls.dispatcher.call(self._withdraw_now, query)

    def _withdraw_now(self, query: Query) -> None:
        self.views.forget(query.id)
        if not self.actor.closed:
            server = query.server_id
            text = f"{server}: the load was cancelled, or its caller was interrupted"
            self.actor.post(c.GiveUp(query.id, Failure("LoadError", text, {"server": server}), unheard=True))

    def _ask(self, query: Query, request: bytes) -> c.Ask:
        """Return the command with which the loop asks for the load."""
        seq = next(self.actor.sequence)
        return c.Ask(query.id, query.registrar, query.server, request, query.parent, seq)

    def _begin(self, query: Query, ask: c.Ask, ended: Ended, timeout_s: float | None = None) -> None:
        """Have the registrar's actor load the resource. On the loop.

        Args:
            ended: called when the load has ended.
            timeout_s: seconds after which the load is withdrawn; None: the thread that waits does that.
        """

        def resolved(held: Held | None, error: RrError | None) -> None:
            if error is None and held is not None:
                loaded(query, held)
            else:
                self.views.forget(query.id)
            if timeout_s is not None:
                self.calls.limits.end(timeout_s, overdue)
            ended(held, error)

        def overdue() -> None:
            if not self.actor.closed:
                self.actor.post(c.GiveUp(query.id, _too_late(self.actor, query, timeout_s)))

        self.views.add(query)
        if timeout_s is not None:
            self.calls.limits.begin(timeout_s, overdue)
        self.actor.ask(ask, resolved)

    def _await_end(self, wait: Wait | HearingWait, query: Query, left_s: float | None, timeout_s: float | None) -> None:
        if not wait.done_within(left_s):
            self.calls.dispatcher.call(self.actor.post, c.GiveUp(query.id, _too_late(self.actor, query, timeout_s)))
            wait.done_within(GRACE_S)
        if wait.error is not None:
            raise wait.error
        if not wait.done:
            raise error_of(_too_late(self.actor, query, timeout_s))

    # -- directly ------------------------------------------------------------------------------------------------

    def _directly(self, query: Query, request: bytes, timeout_s: float | None) -> bool:
        """Load on a connection of this thread's own. Return False if the loop has to load instead.

        Raises:
            RrError: how the load ended.
        """
        actor = self.actor
        client = actor.clients.get(query.registrar)
        if client is None or (connections := client.connections) is None:
            return False
        line: Exchange | None = None
        over: list[RrError] = []  # with the error, once the loop has ended this load; at any moment

        def ended(_held: Held | None, error: RrError | None) -> None:
            if error is not None and line is not None:  # a load that succeeded is answered on the connection, too
                over.append(error)
                connections.cut(line)

        deadline = deadline_of(timeout_s)
        try:
            line = connections.take(timeout_s)
            if line is None:
                return False
            load = actor.begin_directly(query, request, ended)
            if load is None:
                connections.give_back(line)
                return False
            self.views.add(query)
            if actor.node.watched.level[0] <= 1:
                answer = line.exchange(load, deadline)
            else:
                answer = _recorded(actor, line, query.registrar, load, deadline)
            connections.give_back(line)
        except TimeoutError:
            command = c.GiveUp(query.id, _too_late(actor, query, timeout_s), unheard=True)
        except OSError:
            command = c.SendAgain(query.id)
        except NotSerializable as error:
            command = c.GiveUp(query.id, failure_of(error), unheard=True)
        except BaseException:  # such as KeyboardInterrupt, which may come anywhere
            connections.drop_mine()
            raise
        else:
            if type(answer) is Loaded and client.checksums.get(query.server, answer.types) != answer.types:
                command = c.SendAgain(query.id)  # the link brings the types, and then the answer once more
            elif type(answer) is Loaded and actor.hold(answer):
                loaded_directly(query, answer.resource_id, answer.response)
                return True
            else:
                command = self._not_held(query, answer)
        connections.drop_mine()
        if not over:
            left_s = left_until(deadline)
            try:
                self._go_on(query, command, left_s, timeout_s)
            except RrError:
                if not over:
                    raise
        if over:
            raise over[0]
        return True

    def _not_held(self, query: Query, answer: Loaded | LoadRefused) -> c.Command:
        """Return the loop's command after an answer that refuses the load, or that this thread could not store.

        Raises:
            RrError: the load was refused, and the loop does not know of it.
        """
        actor, id = self.actor, query.id
        if isinstance(answer, Loaded):
            return c.Got(id, answer.resource_id, answer.response)
        if not actor.forget_refused(id):
            # The loop may have sent the load again. It is withdrawn, on disk, before the caller hears the error.
            return c.GiveUp(id, answer.failure, unheard=True)
        self.views.forget(id)
        raise error_of(answer.failure)

    def _go_on(self, query: Query, command: c.Command, left_s: float | None, timeout_s: float | None) -> None:
        """Have the registrar's actor go on with the load, or end it, and wait until the load has ended."""
        wait = Wait()

        def ended(held: Held | None, error: RrError | None) -> None:
            if error is None and held is not None:
                loaded(query, held)
            wait.ended(held, error)

        self.calls.dispatcher.call(self.actor.go_on_loading, query.id, ended, command)
        if isinstance(command, c.GiveUp):
            wait.done_within(GRACE_S)
            raise wait.error or error_of(command.failure)  # the disk is full: the loop withdraws the load later
        self._await_end(wait, query, left_s, timeout_s)


def _too_late(actor: RegistrarActor, query: Query, timeout_s: float | None) -> Failure:
    """Return the failure of a load that has taken too long. Its text says what the provider seems to be doing."""
    server = f"{query.registrar}/{query.server}"
    status, doing = _doing(actor, query.registrar, "load callback, or the unload callback before it,")
    text = f"{server}: not loaded within {timeout_s:g} s; {query.registrar} is {doing}; the load is withdrawn"
    return Failure("LoadTimeout", text, {"server": server, "timeout_s": timeout_s, "status": str(status)})


def _doing(actor: RegistrarActor, provider: str, callback: str) -> tuple[Status, str]:
    """Return the directory's status of a provider that has not answered, and words for the status.

    `callback` names the callbacks for which a provider that is up may keep the caller waiting.
    """
    entry = actor.node.find(provider)
    if entry is None:
        return Status.GONE, _DOING[Status.GONE]
    if entry.status is Status.UP:
        return Status.UP, f"up, its {callback} has not returned yet"
    return entry.status, f"{_DOING[entry.status]}{entry.because}"


_DOING = {
    Status.STARTING: "starting, or being started again",
    Status.STOPPED: "stopped",
    Status.GONE: "gone for good",
    Status.DORMANT: "dormant: its process died, and nobody has opened it again",
}


# -- unloads -----------------------------------------------------------------------------------------------------------
#
# The registrar's actor releases a query; or a thread that waits does so, on a connection of its own. The thread writes
# that the release is owed, asks the provider, and forgets the query (engine/monitor.py). If the provider is down, the
# thread hears so when its time is up. The release stays owed, on disk, until the provider is back.


Release = Callable[[str, UnloadWaiter], None]


class _Unloading(msgspec.Struct):
    """One unload by the loop: one object, as thousands may be in flight, and the garbage collector visits each."""

    unloads: Unloads
    query_id: str
    left_s: float | None
    timeout_s: float | None
    reply: Reply[None]

    def begin(self, release: Release) -> None:
        """Begin the time limit, and release the query."""
        if self.left_s is not None:
            self.unloads.calls.limits.begin(self.left_s, self._overdue)
        release(self.query_id, self._ended)

    def _ended(self, error: RrError | None) -> None:
        if self.left_s is not None:
            self.unloads.calls.limits.end(self.left_s, self._overdue)
        settle(self.reply, error)

    def _overdue(self) -> None:
        self.unloads.release_overdue(self.query_id, self.timeout_s)


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
        if is_deciding():  # a finalizer, which the garbage collector runs: it cannot wait
            self.future(query_id, timeout_s)
        elif not self._directly(query_id, timeout_s):
            self._finish(self.release, query_id, timeout_s, timeout_s)

    def _finish(self, release: Release, query_id: str, left_s: float | None, timeout_s: float | None) -> None:
        reply: Reply[None] = Reply()
        self.calls.dispatcher.call(_Unloading(self, query_id, left_s, timeout_s, reply).begin, release)
        self.calls.finish(reply, left_s, f"unloading {query_id}", GRACE_S)

    def future(self, query_id: str, timeout_s: float | None) -> Reply[None]:
        """Begin to release a query, and return a future of its end at once."""
        reply: Reply[None] = Reply()
        self.calls.dispatcher.call(_Unloading(self, query_id, timeout_s, timeout_s, reply).begin, self.release)
        return reply

    def force_wait(self, target: str, timeout_s: float | None) -> None:
        """Unload a resource served here, even if it is held, and return when that is done.

        Raises:
            RrError: how the unload ended.
        """
        resource, is_served = self.calls.call(self._find, target)

        def is_of_it(me: Current) -> bool:
            return serving(me) is self._actor and resource is not None and resource.id == me.resource_id

        what = f"registrar {self._actor.name!r}: the forced unload of {shortened(target)}"
        check_not_own(what, is_of_it, "with block=False it does not wait")
        what = f"unloading {shortened(target)}"
        if resource is not None and not is_served:
            what += f", which waits for its server {self._actor.catalog.origin_of(resource)!r} to be registered again,"
        self.calls.finish(self.force_future(target), timeout_s, what)

    def _find(self, target: str) -> tuple[Resource | None, bool]:
        """Return a resource that is served here, and whether its server is registered. On the loop."""
        with self._actor.lock:
            catalog = self._actor.whole()
            resource = catalog.find(target)
            return resource, resource is not None and resource.server in catalog.servers

    def force_future(self, target: str) -> Reply[None]:
        """Begin to unload a resource served here, even if it is held, and return a future of its end at once."""
        return self.calls.start(functools.partial(self._actor.force, target))

    def many(self, wanted: Callable[[Held], bool], timeout_s: float | None) -> Reply[None]:
        """Release every held query that `wanted` accepts, newest first. The future is set when all have been tried."""
        return self.calls.call(self._many_now, wanted, timeout_s)

    def at_server(self, server: ServerId, timeout_s: float | None) -> Reply[None]:
        """Release every query that is held at a server, newest first. The future is set when all have been tried.

        Raises:
            UnknownServer: the registrar holds nothing at that server, and never did.
        """
        self.calls.call(self._check_client, server)
        return self.many(lambda held: (held.registrar, held.server) == server, timeout_s)

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
        connections = None if client is None else client.connections
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
            if actor.node.watched.level[0] <= 1:
                answer = line.exchange(unload, deadline)
            else:
                answer = _recorded(actor, line, client.provider, unload, deadline)
            connections.give_back(line)
            if type(answer) is Unloaded and not actor.forget_released(query_id):
                self.calls.dispatcher.call(actor.monitor.receive, answer, client.provider)
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
            left_s = left_until(deadline)
            go_on = functools.partial(actor.go_on_unloading, refusal=refusal)
            self._finish(go_on, query_id, left_s, timeout_s)
        return True

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
        status, doing = _doing(actor, held.registrar, "unload callback, or one before it,")
        text = (
            f"query {query_id}: {provider} did not answer within {timeout_s:g} s; the release is owed and will be sent"
        )
        details = {"registrar": held.registrar, "timeout_s": timeout_s, "status": str(status)}
        failure = Failure("Unavailable", f"{text}; {provider} is {doing}", details)
        actor.post(c.ReleaseOverdue(query_id, failure))

    def _many_now(self, wanted: Callable[[Held], bool], timeout_s: float | None) -> Reply[None]:
        """Begin to release. The reply raises the first error; the others are its notes."""
        reply: Reply[None] = Reply()
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
            releases = Releases(self._actor, mine, ended)
        if not mine:
            reply.set()
        elif timeout_s is not None and pending:
            self.calls.limits.begin(timeout_s, overdue)
            reply.add_done_callback(lambda _: self.calls.limits.end(timeout_s, overdue))
        return reply


def _no_one(_error: RrError | None) -> None:
    """Ignore how an unload has ended: its caller was interrupted."""
