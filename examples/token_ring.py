"""A token ring: actors in processes of their own pass a token on. Who has it may use what all share; nobody asks.

python examples/token_ring.py
"""

import tempfile
from typing import Any

import rr_actors as rr


class Node(rr.Actor):
    def __init__(self) -> None:
        self.turns = 0

    def on_receive(self, message: Any) -> Any:
        match message:
            case "turns":
                return self.turns
            case "next", node:
                self.next = node
            case "token", hops:
                self.turns += 1  # here it may use the shared thing
                self.next.tell(("token", hops - 1) if hops else "the end")
            case _:
                self.stop()
        return None


def main() -> None:
    children = [rr.ChildSpec(Node, id=id, restart="transient") for id in "abc"]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        a, b, c = (system.ref(id) for id in "abc")
        for node, following in ((a, b), (b, c), (c, a)):
            node.tell(("next", following))
        ended = rr.monitor(c)
        a.tell(("token", 7))
        print(ended.wait(10))
        print("turns:", a.ask("turns"), "of a,", b.ask("turns"), "of b")


if __name__ == "__main__":
    main()
