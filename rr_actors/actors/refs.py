"""ActorRef: Pykka's reference to an actor, wherever it runs. Picklable, with a time-out on every ask."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from types import EllipsisType, SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal, cast, overload

import pykka
from pykka import ActorDeadError
from pykka import Timeout as Timeout  # for the console

from rr_actors.actors.messaging import ask_cycles, dead_letters
from rr_actors.actors.messaging.ask_cycles import Target
from rr_actors.actors.messaging.futures import ExcInfo, Reply, StopReply, error_of
from rr_actors.actors.messaging.mailbox import Ended, Envelope, StopActor, has_ended, is_stop, put
from rr_actors.actors.messaging.message_notes import ASK, STOP, TELL, Stamp, notes
from rr_actors.actors.remote.hub import ActorHub, ask_timeout_s, has_stopped, hub, running, urn_of_path
from rr_actors.actors.remote.peer import Line, Whereabouts
from rr_actors.actors.remote.proxy import Attributes, DistantInbox, DistantProxy, Mirror, attributes_of, local_proxy
from rr_actors.base.errors import ActorUnavailable, NotSerializable, Unavailable, UsageError, is_a, shown
from rr_actors.base.values.codecs import NoForm, codec, codec_of_subclass
from rr_actors.runtime import event_loop
from rr_actors.runtime.time_limits import deadline_of, left_until, time_limit

if TYPE_CHECKING:
    from pykka._actor import ActorInbox
    from typing_extensions import TypeVar

    A = TypeVar("A", bound=pykka.Actor, default=Any)  # an ActorRef alone is an ActorRef[Any]
else:
    from typing import TypeVar

    A = TypeVar("A", bound=pykka.Actor)

_LOOK_S = 0.005  # between two questions to an actor that is to run

StopReason = Literal["normal", "shutdown"]


class ActorRef(pykka.ActorRef[A]):
    """A reference to an actor. It adds to what Pykka documents of ask, tell, stop, is_alive and proxy.

    It can be pickled and used in any process of the system. A reference to a supervised actor has its path in the tree,
    and still works when the actor was respawned. References to the same actor are equal.

    Attributes:
        path: "root/cameras" for a supervised actor, None for any other.
    """

    path: str | None

    def __init__(self, actor: A, target: Target, path: str | None) -> None:
        super().__init__(actor)
        self._target = target
        self.path = path

    @overload
    def ask(self, message: Any, *, block: Literal[False], timeout: float | EllipsisType | None = ...) -> Reply[Any]: ...
    @overload
    def ask(self, message: Any, *, block: bool = True, timeout: float | EllipsisType | None = ...) -> Any: ...

    def ask(  # pyright: ignore[reportIncompatibleMethodOverride]  # its futures are Replies
        self, message: Any, *, block: bool = True, timeout: float | EllipsisType | None = ...
    ) -> Any:
        """Send a message and wait for the reply; with block=False return a future, which may be awaited.

        Args:
            timeout: seconds; by default the system's ask_timeout_s (30 s). None: no limit.

        Raises:
            pykka.Timeout: no reply came in time.
            pykka.ActorDeadError: the actor has ended.
            ActorUnavailable: the actor is being respawned.
            MailboxFull: the actor's mailbox, or the connection to its process, is full.
            NotSerializable: the actor is in another process, and the message cannot be pickled.
            UsageError: the call would hang (on the event loop, in an `async def` handler, in a ring of asks), or
                `timeout` is no number of seconds. Nothing was sent.
            Exception: the error of the actor's handler. A note has its traceback if it ran in another process.
        """
        reply = self._new_reply()
        if not block:
            stamp = notes.sent(ASK, self._target.name, message) if notes.watched.level[0] > 1 else None
            reply.withdraw = self._send(message, reply, (), stamp) or _nothing
            return reply
        limit_s = ask_timeout_s() if timeout is ... else time_limit(timeout, "timeout")
        event_loop.check_may_block(f"asking {self._target.name}")
        ask_cycles.check_ring(self._target)
        stamp = notes.sent(ASK, self._target.name, message) if notes.watched.level[0] > 1 else None
        return self._ask(message, reply, stamp, limit_s, limit_s)

    def _ask(
        self, message: Any, reply: Reply[Any], stamp: Stamp | None, limit_s: float | None, left_s: float | None
    ) -> Any:
        """Send the message and wait for `left_s` seconds, what is left of `limit_s`."""
        give_up = self._send(message, reply, ask_cycles.chain(), stamp)
        try:
            return self._heard(reply.take(timeout=left_s), stamp)
        except pykka.Timeout:
            if give_up is not None:
                give_up()
            if left_s != limit_s and not reply.done():
                raise reply.overdue(limit_s) from None
            raise

    def _heard(self, value: Any, stamp: Stamp | None) -> Any:
        """Return the value of a reply, which is noted if the message was."""
        if stamp is not None:
            notes.heard(stamp, self._target.name, value)
        return value

    def tell(self, message: Any) -> None:
        """Send a message, and return at once. It becomes a dead letter if an actor in another process does not take it.

        Raises:
            ActorDeadError, ActorUnavailable, MailboxFull, NotSerializable: as for ask().
        """
        stamp = notes.sent(TELL, self._target.name, message) if notes.watched.level[0] > 1 else None
        try:
            put(self, Envelope(message, stamp=stamp), self._target.name)
        except ActorDeadError as error:
            _note_dead(self, message, error)
            raise

    @overload
    def stop(
        self,
        *,
        block: Literal[True] = True,
        timeout: float | None = None,
        reason: StopReason = "normal",
        final: bool = False,
    ) -> bool: ...
    @overload
    def stop(
        self, *, block: Literal[False], timeout: float | None = None, reason: StopReason = "normal", final: bool = False
    ) -> Reply[bool]: ...
    @overload
    def stop(
        self, *, block: bool = True, timeout: float | None = None, reason: StopReason = "normal", final: bool = False
    ) -> bool | Reply[bool]: ...

    def stop(
        self, *, block: bool = True, timeout: float | None = None, reason: StopReason = "normal", final: bool = False
    ) -> bool | Reply[bool]:
        """Stop the actor and wait until it has ended. Return False if it was dead already, or is being respawned.

        Args:
            timeout: seconds. None: no limit.
            reason: "normal": the actor first handles the messages in its mailbox. "shutdown", for supervisors: it
                does not.
            final: nobody will start it again (for supervisors).

        Raises:
            pykka.Timeout: the actor has not ended in time.
            UsageError: the call would hang, as for ask(), or `timeout` is no number of seconds.
        """
        reply = StopReply(self._target)
        if block:
            time_limit(timeout, "timeout")
            event_loop.check_may_block(f"stopping {self._target.name}")
            ask_cycles.check_ring(self._target)
            ask_cycles.check_end(self._target.urn, f"stop() of {self._target.name}")
        stamp = notes.sent(STOP, self._target.name, reason) if notes.watched.level[0] > 1 else None
        self._stop(reply, reason, stamp, final=final)
        return reply.get(timeout=timeout) if block else reply

    def is_alive(self) -> bool:
        """Return whether the actor is alive. This asks its process, if it is another one."""
        return not self.actor_stopped.is_set()

    def wait_running(self, timeout_s: float | None = 30.0) -> None:
        """Wait until the actor runs, and answers: after a kill, until its supervisor has started it again.

        Raises:
            ActorUnavailable: it does not run in time. `.id`
            UsageError: waiting is refused here, or `timeout_s` is no number of seconds.
        """
        limit_s = time_limit(timeout_s)
        event_loop.check_may_block(f"waiting for {self._target.name}")
        deadline = deadline_of(limit_s)
        while not self.is_alive():
            if left_until(deadline) == 0:
                text = f"{self._target.name}: expected to run within {timeout_s:g} s, and does not"
                raise ActorUnavailable(text, id=self._target.name)
            time.sleep(_LOOK_S)

    @property
    def pid(self) -> int | None:
        """The id of the actor's process; None if the actor is dead or is being respawned."""
        return os.getpid() if self.is_alive() else None

    def kill(self) -> bool:
        """Kill the actor's process (SIGKILL). Its supervisor then acts as after a crash.

        No on_stop and no atexit handler runs. Only children with a process of their own can be killed.

        Returns:
            False if the actor is dead, or is being respawned.

        Raises:
            UsageError: the actor shares its process with others, or nobody supervises it.
        """
        process = hub(self.path)
        if self.path is None or process is None:
            raise UsageError(f"{self} has no process of its own that could be killed: stop() it")
        return process.kill(Whereabouts(self._target, self.path, ""))

    def proxy(self) -> pykka.ActorProxy[A]:
        """Return a pykka.ActorProxy: an object with the actor's attributes and methods.

        Raises:
            pykka.ActorDeadError: the actor has ended.
            ActorUnavailable: the actor is being respawned.
        """
        return local_proxy(self)

    def attributes(self) -> Attributes:
        """Return the actor's public attributes, for its proxies.

        Raises:
            pykka.ActorDeadError: the actor has ended.
        """
        actor = self._actor_weakref()
        if actor is None or not self.is_alive():
            raise Ended(f"{self} not found", self._target.name)
        return attributes_of(actor)

    def _new_reply(self) -> Reply[Any]:
        return Reply(self._target)

    def _send(
        self, message: Any, reply: Reply[Any], chain: ask_cycles.Chain, stamp: Stamp | None
    ) -> Callable[[], None] | None:
        """Send a message, or set the error on `reply`. Return what to call when nobody waits for the reply any more."""
        try:
            put(self, Envelope(message, reply, chain, stamp), self._target.name)
        except (ActorDeadError, Unavailable) as error:  # MailboxFull is one
            reply.set_exception()
            _note_dead(self, message, error)

    def _stop(self, reply: StopReply, reason: StopReason, stamp: Stamp | None, *, final: bool) -> None:
        self._send(StopActor(reason, final=final), reply, (), stamp)

    def __str__(self) -> str:
        return self._target.name

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ActorRef) and cast("ActorRef[Any]", other)._target.urn == self._target.urn

    def __hash__(self) -> int:
        return hash(self._target.urn)

    def __reduce__(self) -> tuple[Any, ...]:
        process = hub(self.path)
        if self.path is None and process is None:
            raise NotSerializable(
                f"the reference to {self} cannot leave this process: no System runs here, so nobody could reach it",
                path="ActorRef",
            )
        return _restore, (self._target, self.path, "" if process is None else process.address)


class DistantReply(Reply[Any]):
    """The reply of an actor that may be respawned: if it dies first, its entry in the directory decides the error."""

    def __init__(self, where: Whereabouts) -> None:
        super().__init__(where.target)
        self._where = where

    def set_exception(self, exc_info: ExcInfo | BaseException | None = None) -> None:
        """Set the exception that get() raises; for a dead actor, the error from the directory."""
        error = error_of(exc_info)
        if has_ended(error, self._where.target.name):
            error = _as_directory_says(self._where, error)
        super().set_exception(error)

    def overdue(self, timeout_s: float | None) -> pykka.Timeout:
        """Return the error for a caller who got no answer in time; it says if a signal stopped its process."""
        process = hub(self._where.path)
        why = "" if process is None else process.paused(self._where)
        return pykka.Timeout(f"{super().overdue(timeout_s)}{why}")


def _as_directory_says(where: Whereabouts, dead: BaseException) -> BaseException:
    """Return the error for an actor that its last process reported `dead`: it may be being respawned."""
    process = hub(where.path)
    return dead if where.path is None or process is None else process.missing(where)


class DistantRef(ActorRef[A]):
    """A reference that looks for the actor each time: in this process, or in another one.

    Args:
        where: the actor's path, or its URN and the address of its process.
    """

    def __init__(self, where: Whereabouts) -> None:
        # Not super().__init__: it would keep a reference to one actor of this process.
        self._where = where
        self._class: type[A] | None = None
        self._line: Line | None = None  # the line to its process at the last ask
        self._target = where.target
        self.path = where.path
        self.actor_urn = where.target.urn

    @property
    def actor_class(self) -> type[A]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The actor's class. The first use asks the actor's process, and waits.

        Raises:
            pykka.ActorDeadError, ActorUnavailable: the actor has ended, or is being respawned.
            NotSerializable: the class cannot be pickled.
        """
        local = self._local()
        if local is not None:
            return local.actor_class
        if self._class is None:
            self._class = cast("type[A]", self._inquire("class"))
        return self._class

    @property
    def actor_inbox(self) -> ActorInbox:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The actor's inbox, or an object that sends envelopes to it."""
        local = self._local()
        return DistantInbox(self) if local is None else local.actor_inbox

    @property
    def actor_stopped(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        """An object whose is_set() returns whether the actor has ended."""
        local = self._local()
        return SimpleNamespace(is_set=lambda: not self.is_alive()) if local is None else local.actor_stopped

    @property
    def _actor_weakref(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        local = self._local()
        if local is None:
            return lambda: Mirror(self, self.attributes)
        return local._actor_weakref  # pyright: ignore[reportPrivateUsage]

    def tell(self, message: Any) -> None:
        local = self._local()
        stamp = notes.sent(TELL, self._target.name, message) if notes.watched.level[0] > 1 else None
        try:
            if local is None:
                self._hub().tell(self._where, message, stamp)
                return
            put(local, Envelope(message, stamp=stamp), self._target.name)
        except (ActorDeadError, ActorUnavailable) as error:
            said = _as_directory_says(self._where, error) if isinstance(error, Ended) else error
            _note_dead(self, message, said)
            raise said from None

    def is_alive(self) -> bool:
        """Return whether the actor is alive. This asks its process; False if the process does not answer.

        On the loop and in an `async def` handler, which must not wait, this asks only the directory.
        """
        local = self._local()
        if local is not None:
            return local.is_alive()
        try:
            return bool(self._inquire("alive"))
        except (ActorDeadError, Unavailable, pykka.Timeout):
            return False
        except UsageError:  # waiting is refused here: only the directory can be asked
            process = hub(self.path)
            return process is not None and process.may_be_alive(self._where)

    @property
    def pid(self) -> int | None:
        local = self._local()
        if local is not None:
            return os.getpid() if local.is_alive() else None
        process = hub(self.path)
        return None if process is None else process.pid(self._where)

    def proxy(self) -> pykka.ActorProxy[A]:
        local = self._local()
        if local is not None and self.path is None:
            return local.proxy()
        return DistantProxy(actor_ref=self, inquire=self.attributes)

    def attributes(self) -> Attributes:
        """Return the actor's public attributes, for its proxies. This asks the actor's process, and waits.

        Raises:
            pykka.ActorDeadError, ActorUnavailable: the actor has ended, or is being respawned.
            UsageError: waiting is refused here.
        """
        local = self._local()
        actor = None if local is None else local._actor_weakref()  # pyright: ignore[reportPrivateUsage]
        if actor is not None:
            return attributes_of(actor)
        return self._inquire("attributes")

    def _new_reply(self) -> Reply[Any]:
        return DistantReply(self._where)

    def _ask(
        self, message: Any, reply: Reply[Any], stamp: Stamp | None, limit_s: float | None, left_s: float | None
    ) -> Any:
        process = hub(self.path)
        if process is None or process.local(self._target.urn) is not None:
            return super()._ask(message, reply, stamp, limit_s, left_s)
        deadline = deadline_of(left_s)
        waiting = ask_cycles.begin_wait(reply)
        try:
            if self._ask_now(process, message, reply, stamp, limit_s):
                return self._heard(reply.take(), stamp)
        finally:
            ask_cycles.end_wait(waiting, reply)
        return super()._ask(message, reply, stamp, limit_s, left_until(deadline))

    def _ask_now(
        self, process: ActorHub, message: Any, reply: Reply[Any], stamp: Stamp | None, limit_s: float | None
    ) -> bool:
        try:
            line = self._line
            if line is None or not process.has(line):
                line = self._line = process.line_to(self._where)
            if line is None or not line.may_ask:
                return False
            return process.ask_now(line, self._where, message, reply, ask_cycles.chain(), stamp, limit_s)
        except TimeoutError:
            raise reply.overdue(limit_s) from None
        except (ActorDeadError, Unavailable) as error:
            reply.set_exception()
            _note_dead(self, message, error)
            return True

    def _send(
        self, message: Any, reply: Reply[Any], chain: ask_cycles.Chain, stamp: Stamp | None
    ) -> Callable[[], None] | None:
        try:
            local = self._local()
            if local is None:
                return self._hub().ask(self._where, message, reply, chain, stamp)
            put(local, Envelope(message, reply, chain, stamp), self._target.name)
        except (ActorDeadError, Unavailable) as error:
            reply.set_exception()
            _note_dead(self, message, error)
        return None

    def _stop(self, reply: StopReply, reason: StopReason, stamp: Stamp | None, *, final: bool) -> None:
        if self._local() is not None:
            super()._stop(reply, reason, stamp, final=final)
            return
        try:
            self._hub().halt(self._where, reply, reason, stamp, final=final)
        except (ActorDeadError, Unavailable):
            reply.set_exception()

    def _inquire(self, what: str) -> Any:
        event_loop.check_may_block(f"asking about {self._target.name}")
        limit_s = ask_timeout_s()
        reply = self._hub().inquire(self._where, what)
        try:
            return reply.get(timeout=limit_s)
        except pykka.Timeout:
            why = self._hub().paused(self._where)
            text = f"no reply after {limit_s} seconds: the {what} of {self._target.name}{why}"
            raise pykka.Timeout(text) from None

    def _local(self) -> pykka.ActorRef[A] | None:
        process = hub(self.path)
        return running.get(self._target.urn) if process is None else process.local(self._target.urn)

    def _hub(self) -> ActorHub:
        process = hub(self.path)
        if process is None:
            if has_stopped(self.path):
                raise Ended(f"{self} not found: its system has stopped", self._target.name)
            raise ActorUnavailable(
                f"{self._target.name} is in another process, and no System runs in this one", id=self._target.name
            )
        return process

    def __reduce__(self) -> tuple[Any, ...]:
        return _restore, (self._target, self.path, self._where.address)


def watch(ref: DistantRef[Any], fire: Callable[[str, str], None]) -> Callable[[], None]:
    """Call fire(reason, detail) when an actor of another process has ended; return a function that ends the watch."""
    return ref._hub().watch(ref._where, fire)  # pyright: ignore[reportPrivateUsage]  # same file


def inquire(ref: ActorRef[Any], what: str) -> Reply[Any]:
    """Send a question about an actor of another process to that process, whose loop answers."""
    distant = cast("DistantRef[Any]", ref)
    return distant._hub().inquire(distant._where, what)  # pyright: ignore[reportPrivateUsage]  # same file


def why_silent(ref: ActorRef[Any]) -> str:
    """Return words, "; it is ...", for an error if a signal has stopped the process of an actor; "" else."""
    process = hub(ref.path)
    where = cast("DistantRef[Any]", ref)._where  # pyright: ignore[reportPrivateUsage]  # same file
    return "" if process is None else process.paused(where)


def ref_to(path: str) -> ActorRef[Any]:
    """Return the reference to the supervised actor at `path`, "root/cameras", whether or not it runs now."""
    return DistantRef(Whereabouts(Target(urn_of_path(path), path), path, ""))


def _path_of(ref: ActorRef[Any]) -> str:
    if ref.path is None:
        raise NoForm(
            f"a reference to {ref}, which no supervisor of a system starts again: start it as a child, "
            f"system.start_child(rr.ChildSpec(...)); only the path of such an actor can be stored"
        )
    return ref.path


def _at(path: Any) -> ActorRef[Any]:
    if type(path) is not str or not path:
        raise ValueError(f"expected the path of an actor, got {shown(path)}")
    return ref_to(path)


# In requests and responses a reference is the path of its actor, which is the same after a respawn.
codec(ActorRef, _path_of, _at)
codec_of_subclass(DistantRef, ActorRef)


def _restore(target: Target, path: str | None, address: str) -> pykka.ActorRef[Any]:
    if path is None and (local := running.get(target.urn)) is not None:
        return local
    return DistantRef(Whereabouts(target, path, address))


class Registered(dict[pykka.ActorRef[Any], None]):
    """The list of running actors in Pykka's registry, with its operations on a list that take a look-up here.

    A list compares the actor that ends with each that was started before it.
    """

    def append(self, ref: pykka.ActorRef[Any]) -> None:
        """Add a reference after the others."""
        self[ref] = None

    def remove(self, ref: pykka.ActorRef[Any]) -> None:
        """Remove a reference that is in it."""
        del self[ref]

    def __getitem__(self, part: slice) -> list[pykka.ActorRef[Any]]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return list(self)[part]


with pykka.ActorRegistry._actor_refs_lock:  # pyright: ignore[reportPrivateUsage]
    _registry: Any = pykka.ActorRegistry
    _registry._actor_refs = Registered.fromkeys(_registry._actor_refs)


def local_of(ref: pykka.ActorRef[Any]) -> pykka.ActorRef[Any] | None:
    """Return the reference to the actor itself, if it lives in this process, or lived here and is dead."""
    return ref._local() if isinstance(ref, DistantRef) else ref  # pyright: ignore[reportPrivateUsage]


def ref_in(what: Any) -> pykka.ActorRef[Any] | None:
    """Return `what` if it is a reference, or the reference of a proxy, an actor or a SupervisorRef; else None."""
    try:
        ref = getattr(what, "actor_ref", what)
    except Exception:  # raised by the object's own code
        return None
    return cast("pykka.ActorRef[Any]", ref) if is_a(ref, pykka.ActorRef) else None


def _note_dead(ref: pykka.ActorRef[Any], message: Any, error: BaseException) -> None:
    if isinstance(error, ActorDeadError | ActorUnavailable) and not is_stop(message):
        why = "is being started again" if isinstance(error, ActorUnavailable) else "has ended, or never was"
        dead_letters.office.record(str(ref), [message], why, unheard=0)


def _nothing() -> None:
    """Do nothing: an actor of this process checks that the reply is not cancelled before it handles the message."""
