"""Ros2Graph: a node of ROS 2, by rclpy. The one module that uses it.

rclpy comes with a distribution, or as wheels, for one version of Python: it is no dependency of rr_actors, and is
imported when a bridge starts. The protocols below are what is used of it.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import threading
from collections import defaultdict
from collections.abc import Awaitable, Callable, Mapping, Sequence
from concurrent.futures import Future
from types import ModuleType
from typing import Protocol, TypeVar, cast

from rr_actors.base.errors import MissingDependency, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.base.toml import wrong
from rr_actors.managers.ros.ros_graph import Answered
from rr_actors.managers.ros.ros_lifecycle import Lifecycle, Transition
from rr_actors.managers.ros.ros_programs import DOMAIN

logger = Log("rr_actors.managers.ros")

INSTALL = (
    "ROS is not sourced: run `source /opt/ros/DISTRIBUTION/setup.bash` in the shell that starts the system, with the "
    "Python of that distribution; or `pip install 'ros-jazzy-rclpy[fastrtps]' ros-jazzy-std-msgs ros-jazzy-std-srvs`"
)
_DEPTH = 1000  # of messages that wait for a slow reader
_LAST_DOMAIN = 232  # the ports of the next one are above 65535: Fast DDS ends the process for that
_OF_ALL_NODES = ("/parameter_events", "/rosout")  # each node publishes one of them, if not both

T = TypeVar("T")


class _Message(Protocol):
    data: str


class _Flag(Protocol):
    data: bool


class _SetBoolRequest(Protocol):
    data: bool


class _SetBoolResponse(Protocol):
    success: bool
    message: str


class _Publisher(Protocol):
    def publish(self, msg: object, /) -> None: ...


class _Guard(Protocol):
    def trigger(self) -> None: ...


class _Context(Protocol):
    def get_domain_id(self) -> int: ...


class _Reply(Protocol):
    def add_done_callback(self, call: Callable[[_Reply], object], /) -> None: ...
    def cancelled(self) -> bool: ...
    def exception(self) -> BaseException | None: ...
    def result(self) -> object: ...


class _Client(Protocol):
    def call_async(self, request: object, /) -> _Reply: ...
    def remove_pending_request(self, reply: _Reply, /) -> None: ...


class _EndpointInfo(Protocol):
    node_name: str
    node_namespace: str
    endpoint_gid: Sequence[int]


class _State(Protocol):
    label: str


class _StateAnswer(Protocol):
    current_state: _State


class _TransitionRequest(Protocol):
    @property
    def transition(self) -> _Transition: ...


class _Transition(Protocol):
    id: int
    label: str


class _TransitionAnswer(Protocol):
    success: bool


class _GetState(Protocol):
    def Request(self) -> object: ...  # noqa: N802


class _ChangeState(Protocol):
    def Request(self) -> _TransitionRequest: ...  # noqa: N802


class _LifecycleSrvs(Protocol):
    GetState: _GetState
    ChangeState: _ChangeState


class _Future(Awaitable[tuple[bool, str]], Protocol):
    def set_result(self, result: tuple[bool, str], /) -> None: ...


_NamesAndTypes = Sequence[tuple[str, Sequence[str]]]


class _Node(Protocol):
    def get_fully_qualified_name(self) -> str: ...
    def get_node_names_and_namespaces(self) -> Sequence[tuple[str, str]]: ...
    def get_service_names_and_types_by_node(self, node: str, namespace: str, /) -> _NamesAndTypes: ...
    def get_publisher_names_and_types_by_node(self, node: str, namespace: str, /) -> _NamesAndTypes: ...
    def create_subscription(
        self, kind: type, topic: str, call: Callable[[_Message], None], qos: object, /
    ) -> object: ...
    def create_publisher(self, kind: type, topic: str, qos: object, /) -> _Publisher: ...
    def create_service(
        self,
        kind: type,
        name: str,
        call: Callable[[_SetBoolRequest, _SetBoolResponse], Awaitable[_SetBoolResponse]],
        *,
        callback_group: object,
    ) -> object: ...
    def create_client(self, kind: object, name: str, *, callback_group: object) -> _Client: ...
    def destroy_client(self, client: _Client, /) -> object: ...
    def get_publishers_info_by_topic(self, topic: str, /) -> Sequence[_EndpointInfo]: ...
    def create_guard_condition(self, call: Callable[[], None], /) -> _Guard: ...
    def destroy_node(self) -> None: ...


class _Executor(Protocol):
    def add_node(self, node: _Node, /) -> object: ...
    def spin(self) -> None: ...
    def shutdown(self) -> object: ...


class _Rclpy(Protocol):
    def init(self, *, context: _Context) -> None: ...
    def create_node(
        self, name: str, *, context: _Context, enable_rosout: bool, start_parameter_services: bool
    ) -> _Node: ...
    def shutdown(self, *, context: _Context) -> None: ...


class _Contexts(Protocol):
    def Context(self) -> _Context: ...  # noqa: N802 - its name there


class _Executors(Protocol):
    def SingleThreadedExecutor(self, *, context: _Context) -> _Executor: ...  # noqa: N802


class _Groups(Protocol):
    def ReentrantCallbackGroup(self) -> object: ...  # noqa: N802


class _Tasks(Protocol):
    def Future(self) -> _Future: ...  # noqa: N802


class _Durability(Protocol):
    VOLATILE: object
    TRANSIENT_LOCAL: object


class _Qos(Protocol):
    DurabilityPolicy: _Durability

    def QoSProfile(self, *, depth: int, durability: object) -> object: ...  # noqa: N802


class _StdMsgs(Protocol):
    String: type[_Message]
    Bool: type[_Flag]


class _StdSrvs(Protocol):
    SetBool: type


class Libraries:
    """The modules of ROS 2 that are used."""

    def __init__(self) -> None:
        """Import them.

        Raises:
            MissingDependency: one cannot be imported. `.module`, `.install`
        """
        self.rclpy = cast("_Rclpy", _imported("rclpy"))
        self.contexts = cast("_Contexts", _imported("rclpy.context"))
        self.executors = cast("_Executors", _imported("rclpy.executors"))
        self.groups = cast("_Groups", _imported("rclpy.callback_groups"))
        self.tasks = cast("_Tasks", _imported("rclpy.task"))
        self.qos = cast("_Qos", _imported("rclpy.qos"))
        self.std_msgs = cast("_StdMsgs", _imported("std_msgs.msg"))
        self.std_srvs = cast("_StdSrvs", _imported("std_srvs.srv"))


def _imported(name: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:  # or it is of another version of Python
        text = f"{name} cannot be imported ({error}). {INSTALL}"
        raise MissingDependency(text, module=name, install=INSTALL) from error


class Ros2Graph:
    """A node in the graph of ROS 2, with a context of its own, and the thread that spins it."""

    def __init__(self, node: str, failed: Callable[[BaseException], object]) -> None:
        """Be a node of this name, in the domain that the environment says.

        Args:
            failed: called once if the thread ends by an error: from then on the node hears nothing.

        Raises:
            MissingDependency: rclpy, std_msgs or std_srvs cannot be imported.
            ConfigError: ROS_DOMAIN_ID is no domain. `.key`, `.expected`, `.got`
        """
        check_domain(os.environ.get(DOMAIN, ""))
        ros = self._ros = Libraries()
        self._context = ros.contexts.Context()
        ros.rclpy.init(context=self._context)  # in a context of its own: it handles no signal
        self._node = ros.rclpy.create_node(
            node, context=self._context, enable_rosout=False, start_parameter_services=False
        )
        self._name = self._node.get_fully_qualified_name()
        self._guard = self._node.create_guard_condition(lambda: None)
        self._executor = ros.executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._failed, self._is_closed = failed, False
        self._lock = threading.Lock()  # to publish or wake, and to leave
        self._thread = threading.Thread(target=self._spin, name="ros spin", daemon=True)
        self._thread.start()

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except Exception as error:
            if not self._is_closed:
                logger.error("the node %s spins no more: %s", self._name, text_of(error))
                self._failed(error)

    @property
    def node(self) -> str:
        """The full name of the node."""
        return self._name

    @property
    def domain(self) -> int:
        """The domain: nodes of another one are not in the graph."""
        return self._context.get_domain_id()

    def nodes(self) -> frozenset[str]:
        """Return the full names of all nodes that are in the graph now."""
        return frozenset(_full(name, namespace) for name, namespace in self._node.get_node_names_and_namespaces())

    def offers(self) -> Mapping[str, frozenset[str]]:
        """Return the services and topics that nodes serve or publish now: by their names, the nodes."""
        found: defaultdict[str, set[str]] = defaultdict(set)
        for name, namespace in set(self._node.get_node_names_and_namespaces()):
            for names in (
                self._node.get_service_names_and_types_by_node,
                self._node.get_publisher_names_and_types_by_node,
            ):
                try:
                    listed = names(name, namespace)
                except Exception:  # rclpy has a class for it that is not public: the node has just gone
                    continue
                for offered, _types in listed:
                    found[offered].add(_full(name, namespace))
        return {name: frozenset(nodes) for name, nodes in found.items()}

    def instances(self, node: str) -> frozenset[str]:
        """Return a text for each process that has a node of this full name now: of what a node publishes, its number.

        DDS numbers what a process publishes, and the first 12 bytes are of that process.
        """
        found = {
            bytes(info.endpoint_gid[:12]).hex()
            for topic in _OF_ALL_NODES
            for info in self._node.get_publishers_info_by_topic(topic)
            if _full(info.node_name, info.node_namespace) == node
        }
        return frozenset(found or ({"unnumbered"} if node in self.nodes() else ()))

    def lifecycle(self, node: str) -> Lifecycle:
        """Return the services of a lifecycle node.

        Raises:
            MissingDependency: lifecycle_msgs cannot be imported.
        """
        return _LifecycleServices(
            cast("_LifecycleSrvs", _imported("lifecycle_msgs.srv")),
            self._node,
            node,
            self._ros.groups.ReentrantCallbackGroup(),
            self._unless_closed,
        )

    def hear(self, topic: str, call: Callable[[str], object]) -> None:
        """Call `call(text)` for each String of a topic."""

        def heard(message: _Message) -> None:
            call(message.data)

        self._node.create_subscription(self._ros.std_msgs.String, topic, heard, self._quality(latched=False))

    def publish(self, topic: str, *, latched: bool = False) -> Callable[[str], object]:
        """Publish Strings; return what publishes one."""
        kind = self._ros.std_msgs.String
        publisher = self._node.create_publisher(kind, topic, self._quality(latched=latched))

        def publish(text: str) -> None:
            message = kind()
            message.data = text
            self._unless_closed(lambda: publisher.publish(message))

        return publish

    def show(self, topic: str) -> Callable[[bool], object]:
        """Publish Bools, latched; return what publishes one."""
        kind = self._ros.std_msgs.Bool
        publisher = self._node.create_publisher(kind, topic, self._quality(latched=True))

        def publish(value: bool) -> None:
            message = kind()
            message.data = value
            self._unless_closed(lambda: publisher.publish(message))

        return publish

    def serve(self, service: str, call: Callable[[bool, Answered], object]) -> None:
        """Serve a SetBool. While its answer is awaited, the executor goes on with others."""

        async def called(request: _SetBoolRequest, response: _SetBoolResponse) -> _SetBoolResponse:
            future = self._ros.tasks.Future()

            def answered(succeeded: bool, text: str) -> None:
                future.set_result((succeeded, text))
                self._unless_closed(self._guard.trigger)  # the executor waits for its entities, and not for the future

            call(request.data, answered)
            response.success, response.message = await future
            return response

        # In the node's own group, nothing else would run while one call waits for its answer.
        group = self._ros.groups.ReentrantCallbackGroup()
        self._node.create_service(self._ros.std_srvs.SetBool, service, called, callback_group=group)

    def close(self) -> None:
        """Leave the graph, and end the thread."""
        with self._lock:
            if self._is_closed:
                return
            self._is_closed = True
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()
        self._ros.rclpy.shutdown(context=self._context)

    def _unless_closed(self, call: Callable[[], object]) -> None:
        with self._lock:
            if not self._is_closed:
                call()

    def _quality(self, *, latched: bool) -> object:
        durability = self._ros.qos.DurabilityPolicy
        if latched:
            return self._ros.qos.QoSProfile(depth=1, durability=durability.TRANSIENT_LOCAL)
        return self._ros.qos.QoSProfile(depth=_DEPTH, durability=durability.VOLATILE)


class _LifecycleServices:
    """The services of one lifecycle node, by clients of ours."""

    def __init__(
        self,
        srvs: _LifecycleSrvs,
        own: _Node,
        node: str,
        group: object,
        unless_closed: Callable[[Callable[[], object]], None],
    ) -> None:
        self._srvs, self._own, self._unless_closed = srvs, own, unless_closed
        self._get = own.create_client(srvs.GetState, f"{node}/get_state", callback_group=group)
        self._change = own.create_client(srvs.ChangeState, f"{node}/change_state", callback_group=group)

    def ask_state(self) -> Future[str]:
        """Ask for its state."""
        return self._ask(
            self._get, self._srvs.GetState.Request(), lambda got: cast("_StateAnswer", got).current_state.label
        )

    def ask_transition(self, transition: Transition) -> Future[bool]:
        """Ask for a transition by its name: to one that it cannot make now, a node says no; by number, it fails."""
        request = self._srvs.ChangeState.Request()
        request.transition.label = transition
        return self._ask(self._change, request, lambda got: cast("_TransitionAnswer", got).success)

    def close(self) -> None:
        """End the clients."""
        self._unless_closed(lambda: self._own.destroy_client(self._get))
        self._unless_closed(lambda: self._own.destroy_client(self._change))

    def _ask(self, client: _Client, request: object, read: Callable[[object], T]) -> Future[T]:
        asked: Future[T] = Future()

        def ended(reply: _Reply) -> None:
            if reply.cancelled() or not asked.set_running_or_notify_cancel():
                return
            error = reply.exception()
            if error is not None:
                asked.set_exception(error)
            else:
                asked.set_result(read(reply.result()))

        def ask() -> None:
            reply = client.call_async(request)
            reply.add_done_callback(ended)

            def forget(asked: Future[T]) -> None:
                if asked.cancelled():
                    with contextlib.suppress(Exception):  # it has just been answered
                        client.remove_pending_request(reply)

            asked.add_done_callback(forget)

        self._unless_closed(ask)
        return asked


def check_domain(given: str) -> None:
    """Check what the environment says of the domain; "" is domain 0.

    Raises:
        ConfigError: it is no number from 0 to 232. `.key`, `.expected`, `.got`
    """
    number = given.strip()
    if number and not (number.isdecimal() and int(number) <= _LAST_DOMAIN):
        raise wrong(None, DOMAIN, f"a whole number from 0 to {_LAST_DOMAIN}", given, where="environment")


def _full(name: str, namespace: str) -> str:
    return f"{namespace.rstrip('/')}/{name}"
