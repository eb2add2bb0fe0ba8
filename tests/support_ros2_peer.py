"""A node of ROS 2 in a process of its own, which has the client's file and no rr_actors. A test writes it commands.

`python support_ros2_peer.py CLIENT NAME LEASE_S SLOW_S`: each line of its input is a command, {"do": ..., ...}; each
line of its output tells what it has heard. With SLOW_S its executor stands still for so long after each callback.
"""
# pyright: reportMissingImports=false, reportOptionalMemberAccess=false, reportArgumentType=false

import importlib.util
import json
import queue
import sys
import threading
import time

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from std_msgs.msg import Bool, String
from std_srvs.srv import SetBool


def say(**fields):
    print(json.dumps(fields), flush=True)


class Peer:
    def __init__(self, client, name, lease_s):
        self.node = rclpy.create_node(name)
        self.client = client.Ros2Client(self.node, lease_s=lease_s, resend_s=0.3)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.commands = queue.SimpleQueue()
        self.held, self.services, self.topics = {}, {}, {}
        self.unanswered = {}  # sent again until it is answered: when it was sent last, and how it is sent
        self.node.create_subscription(String, "/rr/answers", self.hear_answer, 100)
        self.node.create_timer(0.02, self.obey)

    def obey(self):
        while not self.commands.empty():
            command = self.commands.get()
            getattr(self, command.pop("do"))(**command)
        for key, (sent_at, send) in list(self.unanswered.items()):
            if time.monotonic() - sent_at >= 1.0:
                self.send(key, send)

    def send(self, key, send):
        """Send it, and again until `unanswered` has the key no more: the other side may not be known yet, or be new."""
        self.unanswered[key] = time.monotonic(), send
        send()

    def hear_answer(self, got):
        answer = json.loads(got.data)
        self.unanswered.pop((answer["for"], answer["id"]), None)
        say(answer=answer)

    def load(self, key, server, request):
        def heard(status):
            say(key=key, status=status.state, message=status.message, reason=status.reason, response=status.response)

        def ended(future):
            if future.exception() is not None:
                error = future.exception()
                say(key=key, failed=error.type, text=str(error), trace=error.trace)
            else:
                say(key=key, loaded=held.response, query=held.query, id=held.id)

        held = self.held[key] = self.client.load(server, request, heard)
        held.future.add_done_callback(ended)

    def unload(self, key):
        end = self.client.unload(self.held[key])
        end.add_done_callback(lambda future: say(key=key, unloaded=future.exception() is None))

    def awaited(self, key, server, request):
        """Load in a coroutine of the executor."""

        async def run():
            held = await self.client.load(server, request)
            say(key=key, loaded=held.response)
            await self.client.unload(held)
            say(key=key, unloaded=True)

        self.executor.create_task(run)

    def write(self, topic, text):
        if topic not in self.topics:
            self.topics[topic] = self.node.create_publisher(String, topic, 100)
        key = topic.rpartition("/")[2], json.loads(text)["id"]
        self.send(key, lambda: self.topics[topic].publish(String(data=text)))

    def call(self, service, data):
        if service not in self.services:
            self.services[service] = self.node.create_client(SetBool, service)
        key = service, time.monotonic()

        def ended(done):
            if self.unanswered.pop(key, None) is not None:  # else it was sent twice, and answered twice
                say(service=service, ok=done.result().success, answer=json.loads(done.result().message))

        def send():
            self.services[service].call_async(SetBool.Request(data=data)).add_done_callback(ended)

        self.send(key, send)

    def hear(self, topic, flag):
        qos = rclpy.qos.QoSProfile(depth=1, durability=rclpy.qos.DurabilityPolicy.TRANSIENT_LOCAL)
        self.node.create_subscription(Bool if flag else String, topic, lambda got: say(topic=topic, data=got.data), qos)

    def serve(self, service):
        self.node.create_service(SetBool, service, lambda request, response: response)
        say(serves=service)


def main():
    file, name, lease_s, slow_s = sys.argv[1:]
    spec = importlib.util.spec_from_file_location("ros2_client", file)
    client = sys.modules["ros2_client"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(client)
    rclpy.init()
    peer = Peer(client, name, float(lease_s))

    def read():
        for line in sys.stdin:
            peer.commands.put(json.loads(line))
        rclpy.shutdown()

    threading.Thread(target=read, daemon=True).start()
    say(up=name, imported=[one for one in sys.modules if one.startswith("rr_actors")])
    try:
        while rclpy.ok():
            peer.executor.spin_once(timeout_sec=1.0)
            time.sleep(float(slow_s))
    except ExternalShutdownException:
        pass


if __name__ == "__main__":
    main()
