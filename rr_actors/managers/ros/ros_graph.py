"""RosGraph: what a bridge needs of ROS, the same of ROS 1 and ROS 2, and of the graph in tests.

NodeGraph: what a manager of nodes needs of it.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Protocol

from rr_actors.base.errors import NameTaken
from rr_actors.managers.ros.ros_lifecycle import Lifecycle

DISCOVERY_S = 2.0
"""Seconds until a new node has seen the others: 0.3 s, or longer on a busy machine. Nothing in ROS says when."""

Answered = Callable[[bool, str], object]
"""It gives the answer to a call of a service: whether it has succeeded, and a text. From any thread."""


class RosGraph(Protocol):
    """One node in the graph of ROS. From any thread.

    What it calls runs in the thread that spins the node, and must not wait.
    """

    @property
    def node(self) -> str:
        """The full name of the node, "/rr_bridge"."""
        ...

    def nodes(self) -> frozenset[str]:
        """Return the full names of all nodes that are in the graph now."""
        ...

    def offers(self) -> Mapping[str, frozenset[str]]:
        """Return the services and topics that nodes serve or publish now: by their names, the nodes."""
        ...

    def hear(self, topic: str, call: Callable[[str], object]) -> None:
        """Call `call(text)` for each String of a topic."""
        ...

    def publish(self, topic: str, *, latched: bool = False) -> Callable[[str], object]:
        """Publish Strings; return what publishes one. Latched: a node that comes later gets the last one."""
        ...

    def show(self, topic: str) -> Callable[[bool], object]:
        """Publish Bools, latched; return what publishes one."""
        ...

    def serve(self, service: str, call: Callable[[bool, Answered], object]) -> None:
        """Serve a SetBool: call `call(data, answered)` for each request. Its answer may come at any later time."""
        ...

    def close(self) -> None:
        """Leave the graph. What is published after that goes nowhere."""
        ...


class NodeGraph(Protocol):
    """The graph of ROS as one node of it sees it. From any thread."""

    @property
    def domain(self) -> int:
        """The domain: nodes of another one are not in the graph."""
        ...

    def nodes(self) -> frozenset[str]:
        """Return the full names of all nodes that are in the graph now."""
        ...

    def instances(self, node: str) -> frozenset[str]:
        """Return a text for each process that has a node of this full name now.

        One that was killed stays in the graph for a while. One that is started after that has another text.
        """
        ...

    def lifecycle(self, node: str) -> Lifecycle:
        """Return the services of a lifecycle node."""
        ...

    def close(self) -> None:
        """Leave the graph."""
        ...


def own_name(registrar: str, directory: Path) -> str:
    """Return a name for the node of a manager: it has the same after a restart, and no other on this machine has it."""
    place = hashlib.sha256(str(directory).encode()).hexdigest()[:8]
    return f"rr_{re.sub('[^A-Za-z0-9_]', '_', registrar)}_{place}"


def check_free(graph: RosGraph, names: Iterable[str]) -> None:
    """Check that no other node offers one of these names.

    A node of this graph's own name is what a process before this one has left: it was killed.

    Raises:
        NameTaken: another node offers one. `.name`, `.node`
    """
    offers = graph.offers()
    for name in names:
        for other in sorted(offers.get(name, frozenset()) - {graph.node}):
            text = f"{name}: node {other} offers it already: expected a name that no other node has"
            raise NameTaken(f"{text}; end that node, or give the bridge another name", name=name, node=other)
