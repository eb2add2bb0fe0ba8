"""Calls: how a user's thread has something done on the loop, and waits for it: never for ever, never on the loop."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterable
from typing import Any, TypeVar

import pykka

from rr_actors.actors.messaging.futures import Reply, fail
from rr_actors.base.errors import RrError, Unavailable, UsageError
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.model.rows import Held
from rr_actors.runtime.time_limits import Deadlines, Limited

T = TypeVar("T")

CALL_TIMEOUT_S = 30.0
"""How long the loop may take for what it only has to look up."""
GRACE_S = 5.0
"""How long, after a time limit, for the loop to say how it ended."""


class Wait:
    """One thread waiting for one thing that the loop does."""

    __slots__ = ("_lock", "done", "error", "value")

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lock.acquire()
        self.done = False
        self.value: Any = None
        self.error: BaseException | None = None

    def load_ended(self, _held: Held | None, error: RrError | None) -> None:
        """How a load ended."""
        self.error = error
        self.done = True
        self._lock.release()

    def run(self, fn: Callable[..., Any], args: tuple[Any, ...]) -> None:
        """Run fn on the loop, for the thread that waits."""
        try:
            self.value = fn(*args)
        except Exception as error:
            self.error = error
        self.done = True
        self._lock.release()

    def done_within(self, timeout_s: float | None) -> bool:
        """Wait; whether it is done."""
        return self._lock.acquire(timeout=-1 if timeout_s is None else max(0.0, timeout_s))


class Calls:
    """Calls to one registrar's actor."""

    def __init__(self, actor: RegistrarActor) -> None:
        self.actor = actor
        self.dispatcher = actor.node.dispatcher
        self._deadlines = Deadlines(self.dispatcher.loop)

    def check_open(self) -> None:
        """Raise if the registrar is closed.

        Raises:
            RegistrarDown: it is.
        """
        if self.actor.closed:
            raise self.actor.down()

    def is_inside(self) -> bool:
        """Whether the calling thread is in the middle of a decision, of this registrar or another of the process."""
        return any(registrar.is_inside() for registrar in list(self.actor.node.registrars.values()))

    def check_may_wait(self) -> None:
        """Raise if the calling thread is in the middle of a decision: a finalizer, which the garbage collector runs.

        Raises:
            UsageError: it is.
        """
        if self.is_inside():
            text = f"registrar {self.actor.name!r}: called in a finalizer (__del__), where waiting would hang"
            raise UsageError(f"{text}; start a thread for it, or use a form that does not wait (block=False)")

    def post(self, command: Any) -> None:
        """Give the actor a command."""
        self.dispatcher.call(self.actor.post, command)

    def call(self, fn: Callable[..., T], *args: Any) -> T:
        """Run fn on the loop and return what it returns.

        Raises:
            RegistrarDown: closed. Unavailable: the loop does not answer.
            Exception: what fn raised.
        """
        self.check_open()
        self.check_may_wait()
        if self.dispatcher.is_loop_thread():
            return fn(*args)
        wait = Wait()
        self.dispatcher.call(wait.run, fn, args)
        if not wait.done_within(CALL_TIMEOUT_S):
            raise Unavailable(f"registrar {self.actor.name!r}: its loop has not answered for {CALL_TIMEOUT_S:g} s")
        if wait.error is not None:
            raise wait.error
        return wait.value

    def ask_other(self, registrar: str, method: str, *args: Any) -> Any:
        """Call a method of another registrar of the system, wherever it runs.

        Raises:
            RrError: what it raised, or that it is not there.
        """
        node = self.actor.node
        here = node.registrars.get(registrar)
        if here is not None and here.audience is not None:
            return getattr(here.audience.holder, method)(*args)
        return self.finish(node.handle(registrar).call(method, args, {}), CALL_TIMEOUT_S, f"{method} of {registrar!r}")

    def start(self, begin: Callable[[Callable[[RrError | None], None]], None]) -> Reply[None]:
        """Have begin(done) called on the loop; the reply is set by done(error)."""
        future: Reply[None] = Reply()
        self.dispatcher.call(begin, functools.partial(settle, future))
        return future

    def command(self, command: Callable[..., Any], what: str) -> None:
        """Give the actor a command made with a ticket, and wait for its answer.

        Raises:
            RrError: what it was answered with.
        """
        self.check_open()
        self.finish(self.start(lambda done: self.actor.post(command(done))), CALL_TIMEOUT_S, what)

    def finish(
        self, future: Reply[Any], timeout_s: float | None, what: str, overdue: Callable[[], None] | None = None
    ) -> Any:
        """Wait for the reply; after `timeout_s`, `overdue` has a last chance to say how it ends.

        Raises:
            Unavailable: it took too long. RrError: what the reply was set with.
        """
        self.check_may_wait()
        try:
            return future.get(timeout=timeout_s)
        except pykka.Timeout:
            if overdue is not None:
                self.dispatcher.call(overdue)
                try:
                    return future.get(timeout=GRACE_S)
                except pykka.Timeout:
                    pass
            raise Unavailable(f"registrar {self.actor.name!r}: {what} took longer than {timeout_s:g} s") from None

    def limit(self, timeout_s: float, limited: Limited) -> None:
        """Have it called overdue after `timeout_s` seconds, unless it is done by then. On the loop."""
        self._deadlines.add(timeout_s, limited)


def settle(future: Reply[None], error: RrError | None) -> None:
    """Set the reply as a waiter hears how something ended."""
    future.set(None) if error is None else fail(future, error)


class Together:
    """The reply of many calls, set when all have ended; the first error is raised then, the others are its notes.

    `pending` are the calls that have not ended. On the loop.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self.reply: Reply[None] = Reply()
        self.pending = dict.fromkeys(names)
        self._errors: list[RrError] = []
        if not self.pending:
            self.reply.set()

    def ended(self, name: str, error: RrError | None) -> None:
        """How one of them ended."""
        del self.pending[name]
        if error is not None:
            self._errors.append(error)
        if self.pending:
            return
        for other in self._errors[1:]:
            self._errors[0].add_note(f"and {type(other).__name__}: {other}")
        settle(self.reply, self._errors[0] if self._errors else None)
