"""A state machine: an actor whose state is the method that handles the next message. What a state does not know fails.

python examples/state_machine.py
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable

import rr_actors as rr


class Turnstile(rr.Actor):
    def __init__(self) -> None:
        self.coins = 0
        self.state: Callable[[str], str] = self.locked

    def on_receive(self, message: str) -> str:
        return self.state(message)

    def locked(self, message: str) -> str:
        match message:
            case "coin":
                self.coins += 1
                self.state = self.unlocked
                return "unlocks"
            case "push":
                return "stays locked"
            case _:
                raise ValueError(f"locked: expected coin or push, got {message}")

    def unlocked(self, message: str) -> str:
        match message:
            case "push":
                self.state = self.locked
                return f"lets one through, and locks after {self.coins} coins"
            case "coin":
                self.coins += 1
                return "keeps the coin"
            case _:
                raise ValueError(f"unlocked: expected coin or push, got {message}")


def main() -> None:
    logging.getLogger("rr_actors").setLevel(logging.CRITICAL)
    children = [rr.ChildSpec(Turnstile, id="turnstile", placement="thread")]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        for message in ("push", "coin", "coin", "kick", "push", "push"):
            try:
                print(f"{message}: {system.ref('turnstile').ask(message)}")
            except ValueError as error:
                print(f"{message}: {error}")


if __name__ == "__main__":
    main()
