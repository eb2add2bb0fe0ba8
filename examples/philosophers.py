"""Dining philosophers: a fork is an actor, and who has its turn has the fork. A meal needs two of them.

If each takes the left fork first, the asks close a ring, and the last of them is refused at once. If each takes the
fork with the lower number first, no ring is possible.

python examples/philosophers.py
"""

from __future__ import annotations

import logging
import tempfile
import threading
from collections.abc import Callable
from typing import Any

import rr_actors as rr

N = 3


class Fork(rr.Actor):
    def on_receive(self, message: Any) -> str:
        who, others, all_have_one = message
        if not others:
            return f"philosopher {who} eats"
        all_have_one()
        answer: str = others[0].ask((who, others[1:], all_have_one))
        return answer


def dine(forks: list[rr.ActorRef[Any]], orders: list[list[int]], all_have_one: Callable[[], object]) -> None:
    meals: list[Any] = []
    for who, (first, second) in enumerate(orders):
        meals.append(forks[first].ask((who, [forks[second]], all_have_one), block=False))
    errors = [error for meal in meals if (error := meal.exception()) is not None]
    eaten = len(meals) - len(errors)
    for error in errors:
        print(f"  refused: a ring of {len(error.ring) - 1} forks")
    print(f"  {eaten} of {len(meals)} have eaten")


def main() -> None:
    logging.getLogger("rr_actors").setLevel(logging.CRITICAL)  # the refusal is what this shows
    children = [rr.ChildSpec(Fork, id=f"fork{number}", placement="thread") for number in range(N)]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        forks = [system.ref(f"fork{number}") for number in range(N)]
        left_first = [[who, (who + 1) % N] for who in range(N)]
        print("each takes the left fork first")
        dine(forks, left_first, threading.Barrier(N).wait)
        print("each takes the fork with the lower number first")
        dine(forks, [sorted(order) for order in left_first], lambda: None)


if __name__ == "__main__":
    main()
