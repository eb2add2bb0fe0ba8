"""A bounded buffer: it notes who wants to put or to take, and tells them when there is room, or an item.

python examples/bounded_buffer.py
"""

from __future__ import annotations

import tempfile
from typing import Any

import rr_actors as rr


class Buffer(rr.Actor):
    def __init__(self, size: int) -> None:
        self.size, self.items, self.puts, self.takes = size, list[Any](), list[Any](), list[Any]()

    def on_receive(self, message: Any) -> None:
        (self.takes if message[0] == "take" else self.puts).append(message[1:])
        while self.items or self.puts:
            while self.puts and len(self.items) < self.size:
                producer, item = self.puts.pop(0)
                self.items.append(item)
                print("has", self.items)
                producer.tell(self.actor_ref)
            if not self.takes:
                return
            self.takes.pop(0)[0].tell((self.actor_ref, self.items.pop(0)))


class Producer(rr.Actor):
    left = 5

    def on_receive(self, message: Any) -> None:
        if self.left:  # the message is the buffer, which has room
            self.left -= 1
            message.tell(("put", self.actor_ref, self.left))


class Consumer(rr.Actor):
    def on_receive(self, message: Any) -> None:
        buffer, item = message
        print("takes", item)
        buffer.tell(("take", self.actor_ref)) if item else self.stop()


def main() -> None:
    actors = [(Buffer, (2,)), (Producer, ()), (Consumer, ())]
    children = [rr.ChildSpec(cls, args=args, placement="thread", restart="transient") for cls, args in actors]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        buffer, consumer = system.ref("Buffer"), system.ref("Consumer")
        ended = rr.monitor(consumer)
        system.ref("Producer").tell(buffer)
        buffer.tell(("take", consumer))
        ended.wait(10)


if __name__ == "__main__":
    main()
