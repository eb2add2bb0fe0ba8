"""Dining philosophers: a fork is an actor, and who has its turn has the fork. A meal needs two of them.

If each takes the left fork first, the asks close a ring, and the last of them is refused at once. If each takes the
fork with the lower number first, no ring is possible.

python examples/philosophers.py
"""

import logging
import tempfile
import threading
from typing import Any

import rr_actors as rr

N = 3


class Fork(rr.Actor):
    def on_receive(self, message: Any) -> Any:
        other, all_have_one = message
        if other is None:
            return "eaten"
        all_have_one()
        return other.ask((None, all_have_one))


def dine(title: str, forks: list[rr.ActorRef[Any]], orders: list[list[int]], all_have_one: Any) -> None:
    print(title)
    meals = [forks[first].ask((forks[second], all_have_one), block=False) for first, second in orders]
    errors: list[Any] = [error for meal in meals if (error := meal.exception()) is not None]
    for error in errors:
        print(f"  refused: a ring of {len(error.ring) - 1} forks")
    print(f"  {N - len(errors)} of {N} have eaten")


def main() -> None:
    logging.getLogger("rr_actors").setLevel(logging.CRITICAL)  # the refusal is what this shows
    children = [rr.ChildSpec(Fork, id=f"fork{number}", placement="thread") for number in range(N)]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        forks = [system.ref(f"fork{number}") for number in range(N)]
        orders = [[who, (who + 1) % N] for who in range(N)]
        dine("each takes the left fork first", forks, orders, threading.Barrier(N).wait)
        dine("each takes the fork with the lower number first", forks, [sorted(it) for it in orders], lambda: None)


if __name__ == "__main__":
    main()
