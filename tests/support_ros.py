"""A graph of ROS in this process, for tests of what a bridge does: nodes, topics and services without ROS."""

from __future__ import annotations

import json
import queue
import threading
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from typing import Any

from rr_actors.managers.ros.ros_bridge import RosBridge
from rr_actors.managers.ros.ros_graph import Answered, NodeGraph, RosGraph
from rr_actors.managers.ros.ros_lifecycle import Transition
from rr_actors.managers.ros.ros_nodes import RosNodes
from support import eventually


class World:
    """Everything that nodes share. A callback runs in the thread that publishes or calls."""

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self.present = dict[str, int]()
        self.offered = defaultdict[str, set[str]](set)
        self.hearers = defaultdict[str, list[tuple[str, Callable[[Any], object]]]](list)
        self.latched = dict[str, Any]()
        self.services = dict[str, Callable[[bool, Answered], object]]()
        self.joined = list[str]()  # the nodes that have joined, also again
        self.processes = defaultdict[str, set[str]](set)  # by the name of their node; one that was killed is left here
        self.lifecycles = dict[str, FakeLifecycle]()

    def publish(self, topic: str, value: Any) -> None:
        with self.lock:
            hearers = list(self.hearers[topic])
        for _, hear in hearers:
            hear(value)

    def leave(self, node: str) -> None:
        with self.lock:
            self.present.pop(node, None)
            for nodes in self.offered.values():
                nodes.discard(node)
            for topic, hearers in self.hearers.items():
                self.hearers[topic] = [one for one in hearers if one[0] != node]

    def call(self, service: str, data: bool, timeout_s: float = 30.0) -> tuple[bool, Any]:
        """Call a SetBool, and return its answer."""
        answers = queue.SimpleQueue[tuple[bool, str]]()
        eventually(lambda: service in self.services)
        self.services[service](data, lambda ok, text: answers.put((ok, text)))
        ok, text = answers.get(timeout=timeout_s)
        return ok, json.loads(text)


class FakeGraph:
    """One node in a World."""

    def __init__(self, world: World, node: str) -> None:
        self._world, self._node = world, f"/{node.lstrip('/')}"
        world.present[self._node] = 1
        world.joined.append(self._node)

    @property
    def node(self) -> str:
        return self._node

    def nodes(self) -> frozenset[str]:
        return frozenset(self._world.present)

    def offers(self) -> Mapping[str, frozenset[str]]:
        with self._world.lock:
            return {name: frozenset(nodes) for name, nodes in self._world.offered.items()}

    def hear(self, topic: str, call: Callable[[str], object]) -> None:
        with self._world.lock:
            self._world.hearers[topic].append((self._node, call))

    def publish(self, topic: str, *, latched: bool = False) -> Callable[[str], object]:
        return self._publisher(topic, latched=latched)

    def show(self, topic: str) -> Callable[[bool], object]:
        return self._publisher(topic, latched=True)

    def _publisher(self, topic: str, *, latched: bool) -> Callable[[Any], object]:
        with self._world.lock:
            self._world.offered[topic].add(self._node)

        def publish(value: Any) -> None:
            if latched:
                self._world.latched[topic] = value
            self._world.publish(topic, value)

        return publish

    def serve(self, service: str, call: Callable[[bool, Answered], object]) -> None:
        with self._world.lock:
            self._world.offered[service].add(self._node)
            self._world.services[service] = call

    @property
    def domain(self) -> int:
        return DOMAIN

    def instances(self, node: str) -> frozenset[str]:
        return frozenset(self._world.processes[node])

    def lifecycle(self, node: str) -> FakeLifecycle:
        return self._world.lifecycles[node]

    def close(self) -> None:
        self._world.leave(self._node)


DOMAIN = 7
_TRANSITIONS = {
    ("unconfigured", "configure"): "inactive",
    ("inactive", "activate"): "active",
    ("active", "deactivate"): "inactive",
    ("inactive", "cleanup"): "unconfigured",
}


class FakeLifecycle:
    """A lifecycle node: its state, the transitions that it was asked for, and how it behaves."""

    def __init__(self) -> None:
        self.state, self.asked = "unconfigured", list[str]()
        self.refuses = dict[str, str]()  # a transition, and the state in which the node is then
        self.loses = list[str]()  # transitions of which the next request does not arrive
        self.is_silent = self.is_closed = False
        self.hears: Callable[[str], object] = self.asked.append

    def ask_state(self) -> Future[str]:
        asked: Future[str] = Future()
        if not self.is_silent:
            asked.set_result(self.state)
        return asked

    def ask_transition(self, transition: Transition) -> Future[bool]:
        asked: Future[bool] = Future()
        if transition in self.loses:
            self.loses.remove(transition)
        elif not self.is_silent:
            self.hears(transition)
            refused = transition in self.refuses
            now = self.refuses[transition] if refused else _TRANSITIONS.get((self.state, transition))
            self.state = now or self.state
            asked.set_result(now is not None and not refused)
        return asked

    def close(self) -> None:
        self.is_closed = True


WORLDS = dict[str, World]()
"""By the name that a test has given: a bridge in a thread of this process finds its own by that."""


class FakeBridge(RosBridge):
    """A bridge into a World of this process."""

    _discovery_s = 0.0

    def __init__(self, world: str, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.world = world

    def _join(self, node: str) -> RosGraph:
        return FakeGraph(WORLDS[self.world], node)

    def on_receive(self, message: Any) -> None:
        raise RuntimeError(message)  # so its supervisor starts it again


class FakeNodes(RosNodes):
    """A manager of nodes of a World of this process."""

    _discovery_s = 0.0

    def __init__(self, world: str, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.world = world

    def _join(self, node: str) -> NodeGraph:
        return FakeGraph(WORLDS[self.world], node)

    def on_receive(self, message: Any) -> None:
        raise RuntimeError(message)  # so its supervisor starts it again


class Node:
    """A node that loads by JSON, and has heard what the bridge said of it."""

    def __init__(self, world: World, name: str, namespace: str = "/rr") -> None:
        self.world, self.name, self.namespace = world, f"/{name}", namespace
        self.graph = FakeGraph(world, name)
        self.answers, self.statuses = list[dict[str, Any]](), list[dict[str, Any]]()
        self.graph.hear(f"{namespace}/answers", lambda text: self._note(self.answers, text))
        self.graph.hear(f"{namespace}/status", lambda text: self._note(self.statuses, text))

    def _note(self, to: list[dict[str, Any]], text: str) -> None:
        table = json.loads(text)
        if table["owner"] in (self.name, ""):
            to.append(table)

    def send(self, verb: str, **fields: Any) -> None:
        self.world.publish(f"{self.namespace}/{verb}", json.dumps({"owner": self.name, **fields}))

    def ask(self, verb: str, **fields: Any) -> dict[str, Any]:
        """Send a message, and return its answer."""
        before = len(self.answers)
        self.send(verb, **fields)
        return next(self._from(before, verb))

    def _from(self, before: int, verb: str) -> Iterator[dict[str, Any]]:
        def found() -> list[dict[str, Any]]:
            return [one for one in self.answers[before:] if one["for"] == verb]

        eventually(lambda: bool(found()))
        yield from found()
