"""Ros2Client: a node of ROS 2 loads from a bridge of rr_actors, and hears how its resources are.

This file needs rclpy and std_msgs alone. A node that has no rr_actors copies it, and imports it from there.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import time
import uuid
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol, cast

State = Literal["LOADING", "OK", "UPDATE", "WARNING", "ERROR", "FATAL", "FAILED", "RELEASED"]

_DEPTH = 1000


class _Message(Protocol):
    data: str


class _Publisher(Protocol):
    def publish(self, msg: object, /) -> None: ...


class Node(Protocol):
    """What is used of an rclpy.node.Node."""

    def get_fully_qualified_name(self) -> str:
        """Return "/namespace/name"."""
        ...

    def create_publisher(self, kind: type, topic: str, depth: int, /) -> _Publisher:
        """Return a publisher."""
        ...

    def create_subscription(self, kind: type, topic: str, call: Callable[[_Message], None], depth: int, /) -> object:
        """Return a subscription."""
        ...

    def create_timer(self, period_s: float, call: Callable[[], None], /) -> object:
        """Return a timer."""
        ...

    def destroy_timer(self, timer: object, /) -> object:
        """End a timer."""
        ...

    def destroy_subscription(self, subscription: object, /) -> object:
        """End a subscription."""
        ...

    def destroy_publisher(self, publisher: _Publisher, /) -> object:
        """End a publisher."""
        ...


class Future(Protocol):
    """What is used of an rclpy.task.Future."""

    def done(self) -> bool:
        """Return whether it has ended."""
        ...

    def result(self) -> object:
        """Return its result, or raise its error."""
        ...

    def set_result(self, result: object, /) -> None:
        """End it."""
        ...

    def set_exception(self, exception: Exception, /) -> None:
        """End it with an error."""
        ...

    def add_done_callback(self, call: Callable[[Future], object], /) -> None:
        """Call this with the future when it has ended."""
        ...

    def __await__(self) -> Generator[None, None, object]:
        """Wait for its end, in a coroutine that an executor runs."""
        ...


class _Tasks(Protocol):
    def Future(self) -> Future: ...  # noqa: N802 - its name there


class _StdMsgs(Protocol):
    String: type[_Message]


class RosLoadFailed(RuntimeError):
    """The bridge has refused a load or an unload, or the load has failed.

    Attributes:
        type: the class of the error there, "LoadFailed", "NotAllowed" or "InvalidRequest".
        trace: pairs of the server whose callback failed and its error, innermost first.
        details: what else the error has, such as `expected` and `got`.
    """

    def __init__(
        self, message: str, type: str = "", trace: Sequence[tuple[str, str]] = (), details: Mapping[str, object] = {}
    ) -> None:
        super().__init__(message)
        self.type, self.trace, self.details = type, tuple(trace), dict(details)


@dataclass(frozen=True)
class Ros2Status:
    """A status of a resource that the node holds.

    Attributes:
        state: OK, UPDATE, WARNING, ERROR or FATAL.
        message: text for people.
        response: the new response of an UPDATE.
        source: the server where the status began, "registrar/server".
        reason: "revoked", "lease_ended", "owner_gone", "lost": the bridge knows the hold no more; "" else.
    """

    state: State
    message: str = ""
    response: object = None
    source: str = ""
    reason: str = ""


StatusCallback = Callable[[Ros2Status], object]


@dataclass(eq=False)
class Ros2Query:
    """One hold on a resource. `await` it in a coroutine that the executor runs; it is the Ros2Query then, or raises.

    Attributes:
        id: of this hold, chosen here.
        query: its id at the bridge; "" until it is loaded.
        response: the newest response.
        state: LOADING, FAILED, RELEASED, or that of the last status.
        future: ends when it is loaded: ``rclpy.spin_until_future_complete(node, held.future)``.
    """

    id: str
    server: str
    request: object
    future: Future
    priority: int | None = 0
    query: str = ""
    response: object = None
    state: State = "LOADING"
    on_status: StatusCallback | None = None
    _ends: list[Future] = field(default_factory=list["Future"], repr=False)
    _sent_at: float = 0.0

    def __await__(self) -> Generator[None, None, Ros2Query]:
        """Wait until it is loaded."""
        yield from self.future.__await__()
        self.future.result()
        return self


class Ros2Client:
    """Loads from a bridge for one node. Its callbacks run in the executor that spins the node, and none of them waits.

    What it sends again and again until it is answered has the same id, so each load and unload happens once. While the
    node is spun, its leases are renewed. If the node ends or stands still, they end.
    """

    def __init__(self, node: Node, namespace: str = "/rr", *, lease_s: float = 10.0, resend_s: float = 1.0) -> None:
        """Make publishers, subscriptions and a timer of the node.

        Args:
            namespace: that of the bridge's `[json]`.
            lease_s: seconds after which the bridge releases what the node does not renew. Default: 10.0. Raise it for
                a node that may stand still for longer.
            resend_s: seconds after which a message without an answer is sent again. Default: 1.0. Lower it in tests.
        """
        self._node, self._lease_s, self._resend_s = node, lease_s, resend_s
        self._owner = node.get_fully_qualified_name()
        self._tasks = cast("_Tasks", importlib.import_module("rclpy.task"))
        self._string = cast("_StdMsgs", importlib.import_module("std_msgs.msg")).String
        self._held: dict[str, Ros2Query] = {}
        self._renewed_at = 0.0
        verbs = ("load", "unload", "renew")
        self._publishers = {v: node.create_publisher(self._string, f"{namespace}/{v}", _DEPTH) for v in verbs}
        self._subscriptions = [
            node.create_subscription(self._string, f"{namespace}/{topic}", call, _DEPTH)
            for topic, call in (("answers", self._answered), ("status", self._said))
        ]
        self._timer = node.create_timer(min(resend_s, lease_s / 3), self._tick)

    def load(
        self, server: str, request: object = None, on_status: StatusCallback | None = None, *, priority: int | None = 0
    ) -> Ros2Query:
        """Begin to load; return the hold at once. Its `future` ends when it is loaded, or has failed.

        Args:
            server: "registrar/server", one that the bridge allows.
            request: what JSON has; None: no fields.
            on_status: called with each Ros2Status, in the executor.
        """
        given: object = dict[str, object]() if request is None else request
        held = Ros2Query(uuid.uuid4().hex, server, given, self._tasks.Future(), priority, on_status=on_status)
        self._held[held.id] = held
        self._send_load(held)
        return held

    def unload(self, held: Ros2Query) -> Future:
        """Begin to release; return a future of the end. A hold that has ended is released already."""
        end = self._tasks.Future()
        if self._held.get(held.id) is not held:
            end.set_result(None)
            return end
        held._ends.append(end)  # pyright: ignore[reportPrivateUsage] - same file
        self._send_unload(held)
        return end

    def close(self) -> None:
        """Release everything, without an answer, and end what was made of the node."""
        for held in list(self._held.values()):
            self._send_unload(held)
            self._finish(held, "RELEASED")
        self._node.destroy_timer(self._timer)
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)

    # -- what is sent ------------------------------------------------------------------------------------------------

    def _send_load(self, held: Ros2Query) -> None:
        fields = {"server": held.server, "request": held.request, "lease_s": self._lease_s, "priority": held.priority}
        self._send("load", held, fields)

    def _send_unload(self, held: Ros2Query) -> None:
        self._send("unload", held, {})

    def _send(self, verb: str, held: Ros2Query, fields: Mapping[str, object]) -> None:
        held._sent_at = time.monotonic()  # pyright: ignore[reportPrivateUsage] - same file
        message = self._string()
        message.data = json.dumps({"id": held.id, "owner": self._owner, **fields})
        self._publishers[verb].publish(message)

    def _tick(self) -> None:
        now = time.monotonic()
        is_renewal = now - self._renewed_at >= self._lease_s / 3
        if is_renewal:
            self._renewed_at = now
        for held in list(self._held.values()):
            is_overdue = now - held._sent_at >= self._resend_s  # pyright: ignore[reportPrivateUsage] - same file
            if held._ends:  # pyright: ignore[reportPrivateUsage] - same file
                if is_overdue:
                    self._send_unload(held)
            elif not held.future.done():
                if is_overdue:
                    self._send_load(held)
            elif is_renewal:
                self._send("renew", held, {})

    # -- what is heard -----------------------------------------------------------------------------------------------

    def _mine(self, message: _Message) -> tuple[Ros2Query, dict[str, object]] | None:
        """Return the hold that a message is about; None if it is another node's, or cannot be read."""
        with contextlib.suppress(ValueError):
            table: object = json.loads(message.data)
            if isinstance(table, dict):
                fields = cast("dict[str, object]", table)
                held = self._held.get(str(fields.get("id")))
                if held is not None and fields.get("owner") == self._owner:
                    return held, fields
        return None

    def _answered(self, message: _Message) -> None:
        if (mine := self._mine(message)) is None:
            return
        held, fields = mine
        verb, is_ok = fields.get("for"), fields.get("ok") is True
        if verb == "load" and not held.future.done():
            if is_ok:
                held.query, held.response, held.state = str(fields.get("query")), fields.get("response"), "OK"
                held.future.set_result(held)
            else:
                self._finish(held, "FAILED", _error_in(fields))
        elif verb == "unload" and held._ends:  # pyright: ignore[reportPrivateUsage] - same file
            error = None if is_ok else _error_in(fields)
            if error is None or error.type == "UnknownQuery":  # a bridge that was restarted does not know it
                self._finish(held, "RELEASED")
            else:
                ends, held._ends = held._ends, []  # pyright: ignore[reportPrivateUsage] - same file
                for end in ends:
                    end.set_exception(error)
        elif verb == "renew" and not is_ok and held.future.done():
            self._lose(held, Ros2Status("FATAL", str(_error_in(fields)), reason="lost"))

    def _said(self, message: _Message) -> None:
        if (mine := self._mine(message)) is None:
            return
        held, fields = mine
        state = cast("State", fields.get("state"))
        texts = (str(fields.get(name, "")) for name in ("source", "reason"))
        status = Ros2Status(state, str(fields.get("message", "")), fields.get("response"), *texts)
        if status.reason in ("lease_ended", "owner_gone"):
            self._lose(held, status)
            return
        if held.future.done():
            held.state = "FATAL" if held.state == "FATAL" else state
        if "response" in fields:
            held.response = status.response
        if held.on_status is not None:
            held.on_status(status)

    def _lose(self, held: Ros2Query, status: Ros2Status) -> None:
        """Note that the bridge holds it no more."""
        self._finish(held, "FATAL", RosLoadFailed(status.message))
        if held.on_status is not None:
            held.on_status(status)

    def _finish(self, held: Ros2Query, state: State, error: RosLoadFailed | None = None) -> None:
        del self._held[held.id]
        held.state = state
        ends, held._ends = held._ends, []  # pyright: ignore[reportPrivateUsage] - same file
        for end in ends:
            end.set_result(None)
        if not held.future.done():
            held.future.set_exception(error or RosLoadFailed(f"{held.server}: it was released while it was loading"))


def _error_in(fields: Mapping[str, object]) -> RosLoadFailed:
    """Return the error that an answer has."""
    given = fields.get("error")
    table = cast("dict[str, object]", given) if isinstance(given, dict) else {}
    trace = cast("list[dict[str, object]]", table.get("trace") or [])
    frames = [(str(frame.get("origin")), str(frame.get("message"))) for frame in trace]
    details = cast("dict[str, object]", table.get("details") or {})
    return RosLoadFailed(str(table.get("message")), str(table.get("type")), frames, details)
