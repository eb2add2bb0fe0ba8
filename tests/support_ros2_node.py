"""A node of ROS 2 in a process of its own: `python support_ros2_node.py [WORD...] --ros-args ...`, with these words:

lifecycle  it is a lifecycle node, and prints each transition
refuses    it does not configure; hangs: it does not answer that; breaks: it is finalized when it is deactivated
late       it comes into the graph after a second
deaf       it ignores SIGINT and SIGTERM
"""
# pyright: reportMissingImports=false, reportOptionalMemberAccess=false, reportArgumentType=false

import signal
import sys
import time

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions

WORDS = set(sys.argv[1:])


class Stepwise(LifecycleNode):
    def _step(self, name):
        print(f"{self.get_name()} {name}", flush=True)
        if name == "configure" and "refuses" in WORDS:
            return TransitionCallbackReturn.FAILURE
        if name == "configure" and "hangs" in WORDS:
            time.sleep(3600)
        return TransitionCallbackReturn.SUCCESS

    def on_configure(self, state):
        return self._step("configure")

    def on_activate(self, state):
        return self._step("activate")

    def on_deactivate(self, state):
        self._step("deactivate")
        return TransitionCallbackReturn.ERROR if "breaks" in WORDS else TransitionCallbackReturn.SUCCESS

    def on_error(self, state):
        self._step("error")
        return TransitionCallbackReturn.FAILURE

    def on_cleanup(self, state):
        return self._step("cleanup")


def main():
    if "late" in WORDS:
        time.sleep(1)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO if "deaf" in WORDS else None)
    if "deaf" in WORDS:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_IGN)
    node = Stepwise("unnamed") if "lifecycle" in WORDS else rclpy.create_node("unnamed")
    node.declare_parameter("rate", 0.0)
    node.declare_parameter("frame", "")
    rate, frame = (node.get_parameter(name).value for name in ("rate", "frame"))
    print(f"{node.get_fully_qualified_name()} is up: rate {rate!r}, frame {frame!r}", flush=True)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        print("ended", flush=True)


if __name__ == "__main__":
    main()
