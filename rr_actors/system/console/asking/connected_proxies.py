"""ConnectedProxy: an actor of a running system, as a connected program calls its methods."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, TypeVar

from rr_actors.actors.messaging.futures import Reply, fail
from rr_actors.base.values.canonical import Codec
from rr_actors.system.console.asking.actor_calls import CallActor, given_bytes
from rr_actors.system.console.connected_queries import SystemConnections
from rr_actors.system.console.console_questions import ListMethods

T = TypeVar("T")

GRACE_S = 0.5
"""How long an answer may take, in addition to the time limit of its request: it says more than that none came."""

_LISTING_S = 10.0
_answer = Codec(None, "answer")


def in_thread(reply: Reply[T], call: Callable[[], T]) -> None:
    """Have a new thread make a call, and set the reply. The application's executor may be full of other calls."""
    threading.Thread(target=_make, args=(reply, call), name="rr-connection", daemon=True).start()


def _make(reply: Reply[T], call: Callable[[], T]) -> None:
    try:
        reply.set(call())
    except BaseException as error:  # it is for the thread that reads the reply
        fail(reply, error)
    finally:
        del reply  # the error has a traceback with this frame


class ConnectedProxy:
    """An actor of the system, by its id. Connection.proxy() makes it::

        connection.proxy("budgets").set_capacity("watts", 60).get()

    A call returns a future at once, as that of a proxy in the application does. Arguments and answers are plain data:
    an answer that is a dataclass comes as a dict. dir() has the methods of the actor.

    Raises, by the future:
        NotFound: there is no such actor, or it has no such method.
        UsageError: the method does not take these arguments.
        NotSerializable: an argument or the answer is no plain data, or too long.
        RrError: the actor did not answer in time, or the method raised.
    """

    def __init__(self, connections: SystemConnections, actor: str, limit_s: float) -> None:
        self._connections, self._actor, self._limit_s = connections, actor, limit_s

    def __getattr__(self, method: str) -> Callable[..., Reply[Any]]:
        if method.startswith("_"):  # such as a hook of copy, or of a notebook
            raise AttributeError(f"{self!r} has no attribute {method!r}")

        def call(*args: Any, **kwargs: Any) -> Reply[Any]:
            reply: Reply[Any] = Reply()
            in_thread(reply, lambda: self._call(method, args, kwargs))
            return reply

        call.__name__ = method
        return call

    def _call(self, method: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        given = given_bytes(self._actor, method, args, kwargs)
        command = CallActor(self._actor, method, given, self._limit_s)
        return _answer.show(self._connections.ask(command, self._limit_s + GRACE_S).answer)

    def __dir__(self) -> list[str]:
        return [row.name for row in self._connections.ask(ListMethods(self._actor), _LISTING_S).rows]

    def __repr__(self) -> str:
        return f"<ConnectedProxy of {self._actor}>"
