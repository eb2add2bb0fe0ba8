"""RosNodes: the manager of nodes. It starts, configures, activates, deactivates and ends them, as resources.

The program of a node is a part of it, which a manager Programs runs: so its death is known at once, and not when DDS
notices. What this manager adds is what ROS knows: whether the node is in the graph, and its lifecycle.
"""

from __future__ import annotations

import abc
import asyncio
import functools
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
from msgspec.structs import replace

from rr_actors.base.errors import NameTaken, RrError, UnknownQuery, few, text_of
from rr_actors.base.names import check_name
from rr_actors.base.reporting.log import Log
from rr_actors.managers.ros.ros_errors import NodeFailed, RosTimeout
from rr_actors.managers.ros.ros_graph import DISCOVERY_S, NodeGraph, own_name
from rr_actors.managers.ros.ros_lifecycle import Goal, Lifecycle, bring, state_of
from rr_actors.managers.ros.ros_programs import DOMAIN, RunNode, check_node, program_of
from rr_actors.registrar.declarations import server
from rr_actors.registrar.engine.server import ServerSpec, checked_spec, checked_whole
from rr_actors.registrar.manager import Manager
from rr_actors.registrar.model.health import Health, HealthOf
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query, Status
from rr_actors.registrar.servers.callback_context import current
from rr_actors.system.registrar_lookup import registrar_in

logger = Log("rr_actors.managers.ros")

_POLL_S = 0.02
_LOAD_MARGIN_S = 10.0  # for the start of a program that is ready at once
_END_S = 5.0  # for a program that is called lost
_TICK_S = 0.05  # a process's start is known to 10 ms
_LAST_S = 3.0  # for the transitions of a node at the last stop, which has an end

_SEEN: dict[str, tuple[State, str]] = {
    "inactive": (State.WARNING, "it was deactivated, and not by its manager"),
    "unconfigured": (State.ERROR, "it is unconfigured, and not by its manager: it has failed, or was cleaned up"),
    "finalized": (State.FATAL, "it is finalized: it has failed for good, or was shut down"),
    "errorprocessing": (State.ERROR, "it handles an error"),
}


class RosNode(msgspec.Struct, frozen=True):
    """The response: the node's full name, and its program's pid and start, as of a Program."""

    name: str
    pid: int
    start_time: float


@dataclass
class _Running:
    """What is known of a node that this process has started or found again."""

    request: RunNode
    instances: frozenset[str]
    lifecycle: Lifecycle | None


class RosNodes(Manager):
    """What the managers of nodes of both versions do. A version's class joins its graph."""

    _rr_side_by_side = True
    _discovery_s = DISCOVERY_S

    def __init__(
        self,
        programs: str = "programs",
        *,
        idle: Literal["unload", "pause"] = "unload",
        linger_s: float = 0.0,
        paused_s: float | None = None,
    ) -> None:
        """Run the programs by the child of the system that runs Programs.

        Args:
            programs: the name of that child.
            idle, linger_s, paused_s: what becomes of a node that nobody needs, as for register_server(). A lifecycle
                node that is paused is inactive. Any other goes on, unless its Programs pause, too.

        Raises:
            InvalidName: `programs` is no name.
        """
        self._programs = check_name(programs, "programs")
        self._idleness = {"idle": idle, "linger_s": linger_s, "paused_s": paused_s}
        self._lock = threading.Lock()
        self._graph: NodeGraph | None = None
        self._sees_from = 0.0  # when this node has seen the others
        self._names: dict[str, str] = {}  # the resource that has a name in the graph, by that name
        self._running: dict[str, _Running] = {}  # by resource
        self._gone: dict[str, frozenset[str]] = {}  # by name: instances that have ended, and may still be in the graph

    @abc.abstractmethod
    def _join(self, node: str) -> NodeGraph:
        """Be a node of this name in the graph. If its thread ends by an error, this manager fails with that.

        Raises:
            MissingDependency: the libraries of ROS cannot be imported.
        """

    def on_start(self) -> None:
        """Join the graph.

        Raises:
            MissingDependency: the libraries of ROS cannot be imported.
            ConfigError: the environment has no domain of ROS.
        """
        self._joined()

    @server("node", idle="pause", health=Health())  # each as its request and its manager say: see _rr_adapted()
    def run_node(self, request: RunNode) -> RosNode:
        """Start a node, wait until it is in the graph, and configure and activate a lifecycle node.

        A crash may repeat this. A program that still runs then is taken over, in the state that its node is in.
        """
        me, graph, name = current(), self._joined(), request.full_name
        check_node(request, graph.domain)
        program = program_of(request, graph.domain, os.environ)
        self._claim(name, me.resource_id)
        try:
            before, gone = self._before(graph, name, is_first=me.attempt == 1)
            began = time.clock_gettime(time.CLOCK_BOOTTIME)
            part: Query = self.registrar.load(f"{self._programs}/program", program, timeout_s=_LOAD_MARGIN_S)
            check = functools.partial(_check_wanted, me.stopping, part)
            is_new = part.response.start_time >= began - _TICK_S
            running = self._seen(graph, request, part, before if is_new else gone, check)
            self._running[me.resource_id] = running
            if running.lifecycle is not None:
                bring(name, running.lifecycle, "active", request.timeout_s, check)
        except BaseException:
            self._forget(me.resource_id)
            raise
        return RosNode(name, part.response.pid, part.response.start_time)

    @run_node.unload
    def end_node(self, request: RunNode, response: RosNode | None) -> None:
        """Deactivate a lifecycle node, and clean it up. Its program is ended after that, as its part."""
        me = current()
        running = self._running.get(me.resource_id)
        if running is not None and running.lifecycle is not None and not me.interrupted and self._lives(me.resource_id):
            self._brought(request, running.lifecycle, "unconfigured", me.resource_id)
        self._forget(me.resource_id)

    @run_node.recover
    def find_node(self, request: RunNode, response: RosNode) -> RosNode:
        """Find a node again that runs."""
        me, graph = current(), self._joined()
        self._claim(request.full_name, me.resource_id)
        part = next(iter(self.registrar.children(me.resource_id)), None)
        if part is None:
            raise NodeFailed("its program is gone")
        check = functools.partial(_check_wanted, me.stopping, part)
        running = self._seen(graph, request, part, frozenset(), check)
        self._running[me.resource_id] = running
        if running.lifecycle is not None:
            state_of(request.full_name, running.lifecycle, request.timeout_s, check)
        return response

    @run_node.status
    def node_status(self, request: RunNode, status: Status) -> None:
        """Have the program of a node that is lost ended before its holders hear of that: another may take its name."""
        if status.state is not State.FATAL or status.reason == "revoked":  # which is unloaded like any other
            return
        id = current().resource_id
        for part in self.registrar.children(id):
            if part.state is not State.FATAL:
                self._call_lost(part, status.message)
        self._forget(id)

    @run_node.health
    def probe_node(self, request: RunNode, response: RosNode) -> Status | None:
        """Return in which state a lifecycle node is, if it is not the one that its manager has brought it to."""
        running = self._running.get(current().resource_id)
        if running is None or running.lifecycle is None or request.health is None:
            return None
        state = state_of(response.name, running.lifecycle, request.health.timeout_s)
        if state == "active":
            return None
        found, said = _SEEN.get(state, (State.WARNING, f"it is {state}"))
        return Status(found, f"node {response.name}: expected active, got {state}: {said}")

    @run_node.pause
    def deactivate_node(self, request: RunNode, response: RosNode) -> None:
        """Deactivate a lifecycle node."""
        running = self._running.get(current().resource_id)
        if running is not None and running.lifecycle is not None:
            bring(response.name, running.lifecycle, "inactive", request.timeout_s)

    @run_node.resume
    def activate_node(self, request: RunNode, response: RosNode) -> None:
        """Activate it again."""
        running = self._running.get(current().resource_id)
        if running is not None and running.lifecycle is not None:
            bring(response.name, running.lifecycle, "active", request.timeout_s)

    def _rr_adapted(self, spec: ServerSpec) -> ServerSpec:
        unused = {} if self._idleness["idle"] == "pause" else {"pause": None, "resume": None}
        return checked_whole(checked_spec(replace(spec, **self._idleness, **unused, health=HealthOf(self._health_of))))

    def _health_of(self, resource_id: str) -> Health | None:
        running = self._running.get(resource_id)
        return None if running is None or running.lifecycle is None else running.request.health

    async def _rr_after_stop(self, final: bool) -> None:
        """Leave the graph, however this manager ends. What ends its nodes at the last stop is done before."""
        await super()._rr_after_stop(final)
        with self._lock:
            graph, self._graph = self._graph, None
        if graph is not None:
            await asyncio.to_thread(graph.close)

    # -- the graph -----------------------------------------------------------------------------------------------------

    def _joined(self) -> NodeGraph:
        """Return the graph, joined at first use: recover callbacks run before on_start, and in parallel."""
        with self._lock:
            if self._graph is None:
                self._graph = self._join(own_name(self.registrar.name, self.registrar.directory))
                self._sees_from = time.monotonic() + self._discovery_s
            return self._graph

    def _claim(self, name: str, resource: str) -> None:
        """Have a name in the graph for one resource.

        Raises:
            NameTaken: another node of this manager has it. `.name`
        """
        with self._lock:
            other = self._names.setdefault(name, resource)
        if other != resource:
            text = f"{name}: another node of {self.registrar.name} has this name already, resource {other}"
            raise NameTaken(f"{text}: expected a name that no other node has", name=name)

    def _before(self, graph: NodeGraph, name: str, *, is_first: bool) -> tuple[frozenset[str], frozenset[str]]:
        """Return the instances of a name before its node is started, and those of them that have ended.

        Raises:
            NameTaken: one of them is a node that runs. `.name`
        """
        time.sleep(max(0.0, self._sees_from - time.monotonic()))  # a load that comes just after the start
        there = graph.instances(name)
        with self._lock:
            gone = self._gone[name] = self._gone.get(name, frozenset()) & there
        if is_first and there - gone:  # later, it may be the program that the attempt before has started
            text = f"{name}: a node of this name is in the graph already, and {self.registrar.name} has not started it"
            what_next = "end that node, or rename this; if it was killed, it is there for some 20 s more"
            raise NameTaken(f"{text}: expected a name that no other node has; {what_next}", name=name)
        return there, gone

    def _seen(
        self, graph: NodeGraph, request: RunNode, part: Query, before: frozenset[str], check: Callable[[], object]
    ) -> _Running:
        """Return the node as soon as it is in the graph.

        Raises:
            RosTimeout: it was not there in time. `.node`, `.expected`
        """
        name, limit = request.full_name, time.monotonic() + request.timeout_s
        while not (instances := graph.instances(name) - before):
            check()
            if time.monotonic() >= limit:
                raise _unseen(graph, request, part)
            time.sleep(_POLL_S)
        return _Running(request, instances, graph.lifecycle(name) if request.lifecycle else None)

    def _forget(self, resource: str) -> None:
        """Note that a node has ended or is going to: its name is free, though it may be in the graph for a while."""
        with self._lock:
            running = self._running.pop(resource, None)
            self._names = {name: other for name, other in self._names.items() if other != resource}
            if running is not None:
                name = running.request.full_name
                self._gone[name] = self._gone.get(name, frozenset()) | running.instances
        if running is not None and running.lifecycle is not None:
            running.lifecycle.close()

    # -- ending --------------------------------------------------------------------------------------------------------

    def _lives(self, resource: str) -> bool:
        """Return whether the program of a node runs."""
        return any(part.state is not State.FATAL for part in self.registrar.children(resource))

    def _brought(self, request: RunNode, lifecycle: Lifecycle, goal: Goal, resource: str) -> None:
        """Bring a node to a state before its end; log if it cannot be: it is ended in any case."""

        def check() -> None:
            if not self._lives(resource):
                raise NodeFailed("its program has ended")

        try:
            limit_s = min(request.timeout_s, _LAST_S) if self._rr_final else request.timeout_s
            bring(request.full_name, lifecycle, goal, limit_s, check)
        except RrError as error:
            logger.warning("%s: ended without being %s: %s", self.registrar.name, goal, text_of(error))

    def _call_lost(self, part: Query, message: str) -> None:
        try:
            programs = registrar_in(self._rr_node, part.registrar, patient=True, owner=self)
            programs.send_status(part.resource_id, Status(State.FATAL, message))
            part.wait_status(State.FATAL, timeout_s=_END_S)
        except UnknownQuery:
            return  # it is gone
        except RrError as error:
            logger.warning("%s: the program of a lost node could not be ended: %s", self.registrar.name, text_of(error))


def _check_wanted(stopping: threading.Event, part: Query) -> None:
    """Raise if nobody waits for the node any more, or its program has ended."""
    if part.state is State.FATAL:
        try:
            said = part.wait_status(State.FATAL, timeout_s=_POLL_S).message
        except RrError:  # a process before this one has heard it
            said = "its program has ended"
        raise NodeFailed(said)
    if stopping.is_set():
        raise NodeFailed("the node was not ready yet, and nobody waits for it any more")


def _unseen(graph: NodeGraph, request: RunNode, part: Query) -> RosTimeout:
    """Return the error for a node that did not come into the graph, with what is seen of the reason."""
    name, domain = request.full_name, graph.domain
    expected = f"the node in the graph of domain {domain}"
    text = f"node {name}: expected it in the graph of domain {domain} within {request.timeout_s:g} s; it is not there"
    other = _domain_of(part.response.pid)
    if other not in ("", str(domain)):
        text = f"{text}, as its program runs in domain {other}"
    elif near := sorted(one for one in graph.nodes() if one.rpartition("/")[2] == request.name):
        text = f"{text}, but {few(near)} is"
    else:
        text = f"{text}, and its program runs: it may be no node, one that gives itself a name, or in another domain"
    return RosTimeout(text, node=name, expected=expected)


def _domain_of(pid: int) -> str:
    """Return the domain in the environment with which a process was started; "" if it cannot be read."""
    try:
        variables = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return ""
    given = [one.partition(b"=")[2] for one in variables if one.startswith(f"{DOMAIN}=".encode())]
    return given[-1].decode(errors="replace") if given else ""
