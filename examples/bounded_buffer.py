"""A bounded buffer: it notes who wants to put or to take, and tells them when there is room, or an item.

python examples/bounded_buffer.py
"""

import tempfile
from typing import Any

import rr_actors as rr


class Buffer(rr.Actor):
    def __init__(self) -> None:
        self.items, self.puts, self.takes = list[Any](), list[Any](), list[Any]()

    def on_receive(self, message: Any) -> None:
        (self.takes if message[0] == "take" else self.puts).append(message[1:])
        while (has_room := self.puts and len(self.items) < 2) or (self.takes and self.items):
            if has_room:
                self.items.append(self.puts[0][1])
                print("has", self.items)
                self.puts.pop(0)[0].tell(self.actor_ref)
            else:
                self.takes.pop(0)[0].tell((self.actor_ref, self.items.pop(0)))


class Producer(rr.Actor):
    left = iter((4, 3, 2, 1, 0))

    def on_receive(self, message: Any) -> None:
        if (item := next(self.left, None)) is not None:  # the message is the buffer, which has room
            message.tell(("put", self.actor_ref, item))


class Consumer(rr.Actor):
    def on_receive(self, message: Any) -> None:
        print("takes", message[1])
        message[0].tell(("take", self.actor_ref)) if message[1] else self.stop()


if __name__ == "__main__":
    children = [rr.ChildSpec(kind, placement="thread", restart="transient") for kind in (Buffer, Producer, Consumer)]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        system.ref("Producer").tell(system.ref("Buffer"))
        system.ref("Buffer").tell(("take", system.ref("Consumer")))
        rr.monitor(system.ref("Consumer")).wait(10)
