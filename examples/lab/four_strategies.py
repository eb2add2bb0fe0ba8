"""The four strategies side by side: the same child is killed under each of four supervisors.

A strategy says which children start again when one of them ends. Each supervisor has three children. Those of
`simple_one_for_one` have no names: they are copies of one template, and the first counts as a, the second as b.

Look for: a number in the box of each child that has been started again. Compare the four supervisors.

Why: one_for_one starts only the killed child again. one_for_all starts all three again, as none can go on without the
others. rest_for_one starts the killed child again, and those that were started after it, as they may depend on it.
simple_one_for_one is one_for_one for copies of one template.
"""

# /// lab
# place = 1
# question = "Which children will start again under rest_for_one?"
# levers = [
#     {name = "child", label = "killed child", choices = ["b", "a", "c"]},
# ]
# [answers]
# a = {event = "restarted", path = "root/rest_for_one/a"}
# b = {event = "restarted", path = "root/rest_for_one/b"}
# c = {event = "restarted", path = "root/rest_for_one/c"}
# ///

from __future__ import annotations

import time
from typing import Any

import rr_actors as rr


class Worker(rr.Actor):
    pass


def three(strategy: Any) -> rr.Supervisor:
    ids = ["template"] if strategy == "simple_one_for_one" else ["a", "b", "c"]
    return rr.Supervisor([rr.ChildSpec(Worker, id=id) for id in ids], id=strategy, strategy=strategy)


def main(state_dir: str, child: str = "b") -> None:
    strategies = ("one_for_one", "one_for_all", "rest_for_one", "simple_one_for_one")
    with rr.System([three(strategy) for strategy in strategies], state_dir=state_dir) as system:
        for _ in range(3):  # this one begins without children: they are made from its template
            system.supervisor("root/simple_one_for_one").start_child([])
        time.sleep(3)
        for strategy in strategies:
            oldest_first = system.supervisor(f"root/{strategy}").which_children()[::-1]
            killed = oldest_first["abc".index(child)]
            print(f"SIGKILL to {killed.id} under {strategy}", flush=True)
            killed.kill()
            time.sleep(3)
        time.sleep(3)
