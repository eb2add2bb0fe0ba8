"""rr_actors.ros2: a bridge to ROS 2, the client of it for nodes in Python, and nodes as resources."""

from __future__ import annotations

from rr_actors.base.errors import MissingDependency, NotAllowed
from rr_actors.managers.ros.ros2_client import Ros2Client as Client
from rr_actors.managers.ros.ros2_client import Ros2Query, Ros2Status, RosLoadFailed
from rr_actors.managers.ros.ros2_graph import Ros2Graph
from rr_actors.managers.ros.ros_bridge import RosBridge
from rr_actors.managers.ros.ros_config import Json, Switch
from rr_actors.managers.ros.ros_errors import RosTimeout, TransitionFailed
from rr_actors.managers.ros.ros_graph import NodeGraph, RosGraph
from rr_actors.managers.ros.ros_nodes import RosNode, RosNodes
from rr_actors.managers.ros.ros_programs import RunNode

__all__ = [
    "Bridge",
    "Client",
    "Json",
    "MissingDependency",
    "Nodes",
    "NotAllowed",
    "Ros2Query",
    "Ros2Status",
    "RosLoadFailed",
    "RosNode",
    "RosTimeout",
    "RunNode",
    "Switch",
    "TransitionFailed",
]


class Bridge(RosBridge):
    """Lets nodes of ROS 2 load resources of this system: a manager in a process of its own.

    Each Switch is one fixed request as a service. Json is any request to what is allowed, on topics. What a node holds
    is released when it says so, when its lease ends, or when it has left the graph. If the bridge is killed, its next
    process goes on with what was held.

    rclpy has to be importable: source your distribution, or install its wheels. The domain is that of the environment,
    `ROS_DOMAIN_ID`.
    """

    def _join(self, node: str) -> RosGraph:
        return Ros2Graph(node, self._rr_failed)


class Nodes(RosNodes):
    """Serves `node`: starts, configures, activates, pauses and ends nodes of ROS 2, as resources.

    A node is loaded when it is in the graph, and a lifecycle node when it is active. A paused lifecycle node is
    inactive. One that nobody needs is deactivated, cleaned up, and ended. A node that dies concerns its holders alone:
    they hear FATAL at once, with the last lines of its output. Its program is a resource of a manager Programs of the
    system.

    rclpy has to be importable, as for Bridge. The domain is that of the environment, `ROS_DOMAIN_ID`.
    """

    def _join(self, node: str) -> NodeGraph:
        return Ros2Graph(node, self._rr_failed)
