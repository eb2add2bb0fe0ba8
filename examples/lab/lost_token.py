"""A token ring: three actors pass a token on, and the one that has it is killed.

The token is a message. Each node keeps it for a second, and sends it on.

Look for: node b's new process; who has the token after that.

Why: a message that is being handled dies with its actor. The supervisor starts the actor again, but does not send a
message again: it cannot know what was done already. So somebody must watch, and decide.
"""

# /// lab
# place = 21
# question = "Node b is killed while it has the token. What will become of the token?"
# levers = [{name = "watch", label = "b is watched by", choices = ["nobody", "the program, with a monitor"]}]
# [answers]
# "b has it again, in its new process" = {prints = "b has it again"}
# "it is gone, and the ring stands still" = {prints = "the ring stands still"}
# "the one that watches makes a new one" = {prints = "a new token goes round"}
# ///

from __future__ import annotations

import time
from typing import Any

import rr_actors as rr


class Node(rr.Actor):
    def on_receive(self, message: Any) -> None:
        hops, others = message
        time.sleep(1)  # here it may use what all of them share
        if hops:
            others[0].tell((hops - 1, [*others[1:], others[0]]))


def holder(system: rr.System) -> str:
    return next((id for id in "abc" if system.mailbox(id).look().handled is not None), "")


def main(state_dir: str, watch: str = "nobody") -> None:
    with rr.System([rr.ChildSpec(Node, id=id) for id in "abc"], state_dir=state_dir) as system:
        a, b, c = (system.ref(id) for id in "abc")
        time.sleep(2)
        a.tell((100, [b, c, a]))
        seen = ""
        for _ in range(60):
            now = holder(system)
            if now and now != seen:
                print(f"{now} has the token", flush=True)
                seen = now
                if now == "b":
                    break
            time.sleep(0.1)
        monitor = rr.monitor(b)
        b.kill()
        print(f"b is killed: {monitor.wait(10)}", flush=True)
        while b.pid is None:
            time.sleep(0.1)
        if watch != "nobody":
            a.tell((4, [b, c, a]))
        time.sleep(1.5)
        found = {holder(system) for _ in range(20) if time.sleep(0.1) is None}
        if watch != "nobody":
            print(f"a new token goes round: {', '.join(sorted(found - {''}))}", flush=True)
        else:
            print("b has it again" if "b" in found else "nobody has the token: the ring stands still", flush=True)
        time.sleep(3)
