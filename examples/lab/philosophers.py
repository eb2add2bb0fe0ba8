"""Dining philosophers: each needs two forks, and takes one after the other.

A fork that is asked has its turn for as long as the meal takes. With `tell`, a fork notes who waits for it, and nobody
waits in a handler.

Look for: the errors, and when they come; who has eaten at the end.

Why: in one process a ring of asks is found where it closes, and its last ask is refused at once. Asks of several
processes that close a ring together wait until their time limits. With tells nobody waits in a handler, so nobody sees
the ring. An order of the forks, the same for all, makes a ring impossible.
"""

# /// lab
# place = 20
# question = "Three philosophers take the left fork, think, and then want the right one. What will they do?"
# levers = [
#     {name = "way", label = "forks are taken by", choices = ["ask", "tell"]},
#     {name = "where", label = "forks live in", choices = ["one process", "processes of their own"]},
#     {name = "first", label = "first they take", choices = ["the left fork", "the fork with the lower number"]},
# ]
# [answers]
# "one is refused at once, the others eat" = {prints = "refused: "}
# "all wait, until a time limit ends one" = {prints = "waited without success: "}
# "all eat, one after another" = {prints = "have eaten: 3 of 3"}
# "all wait for ever" = {prints = "have eaten: 0 of 3"}
# ///

from __future__ import annotations

import time
from typing import Any

import rr_actors as rr

THINK_S = 2.0


class Fork(rr.Actor):
    # asked: the meal is eaten in its turn; told: it goes to the first who wants it, and then to the next
    def __init__(self) -> None:
        self.waiting: list[rr.ActorRef[Any]] = []

    def on_receive(self, message: Any) -> str:
        match message:
            case "meal", [], _:
                return "has eaten"
            case "meal", [other], limit_s:
                time.sleep(THINK_S)
                return other.ask(("meal", [], limit_s), timeout=limit_s)
            case "take", philosopher:
                self.waiting.append(philosopher)
                if len(self.waiting) == 1:
                    philosopher.tell("yours")
            case _:
                self.waiting.pop(0)
                if self.waiting:
                    self.waiting[0].tell("yours")
        return ""


class Philosopher(rr.Actor):
    meals = 0
    have = 0

    def on_receive(self, message: Any) -> int:
        match message:
            case "dinner", forks:
                self.forks = forks
                self.forks[0].tell(("take", self.actor_ref))
            case "yours":
                self.have += 1
                if self.have == 1:
                    time.sleep(THINK_S)
                    self.forks[1].tell(("take", self.actor_ref))
                else:
                    self.meals += 1
                    for fork in self.forks:
                        fork.tell("back")
            case _:
                pass
        return self.meals


def main(state_dir: str, way: str = "ask", where: str = "one process", first: str = "the left fork") -> None:
    at = "thread" if where == "one process" else "process"
    children = [rr.ChildSpec(Fork, id=f"fork{number}", placement=at) for number in range(3)]
    children += [rr.ChildSpec(Philosopher, id=f"philosopher{number}", placement=at) for number in range(3)]
    with rr.System(children, state_dir=state_dir) as system:
        time.sleep(2)
        orders = [(at, (at + 1) % 3) for at in range(3)]
        if first != "the left fork":
            orders = [(min(order), max(order)) for order in orders]
        forks = [system.ref(f"fork{at}") for at in range(3)]
        pairs = [[forks[left], forks[right]] for left, right in orders]
        if way == "ask":
            limits = (6, 20, 20)  # seconds
            answers = [
                one.ask(("meal", [other], limit_s), block=False)
                for (one, other), limit_s in zip(pairs, limits, strict=True)
            ]
            errors = [error for answer in answers if (error := answer.exception()) is not None]
            for error in errors:
                said = "refused" if isinstance(error, rr.UsageError) else "waited without success"
                print(f"{said}: {error}", flush=True)
            eaten = 3 - len(errors)
        else:
            table = [system.ref(f"philosopher{at}") for at in range(3)]
            for philosopher, pair in zip(table, pairs, strict=True):
                philosopher.tell(("dinner", pair))
            time.sleep(5 * THINK_S)
            eaten = sum(philosopher.ask("meals?") for philosopher in table)
        print(f"have eaten: {eaten} of 3", flush=True)
        time.sleep(4)
