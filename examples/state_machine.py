"""A state machine: an actor whose state is the method that handles the next message. What it does not know fails.

python examples/state_machine.py
"""

import logging
import tempfile

import rr_actors as rr


class Turnstile(rr.Actor):
    def __init__(self) -> None:
        self.coins, self.state = 0, self.locked

    def on_receive(self, message: str) -> str:
        if message not in ("coin", "push"):
            raise ValueError(f"{self.state.__name__}: expected coin or push, got {message}")
        return self.state(message)

    def locked(self, message: str) -> str:
        if message == "push":
            return "stays locked"
        self.coins, self.state = self.coins + 1, self.unlocked
        return "unlocks"

    def unlocked(self, message: str) -> str:
        if message == "push":
            self.state = self.locked
            return f"lets one through, and locks after {self.coins} coins"
        self.coins += 1
        return "keeps the coin"


def main() -> None:
    logging.getLogger("rr_actors").setLevel(logging.CRITICAL)
    children = [rr.ChildSpec(Turnstile, id="turnstile", placement="thread")]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        for message in ("push", "coin", "coin", "kick", "push", "push"):
            answer = system.ref("turnstile").ask(message, block=False)
            print(f"{message}: {answer.exception() or answer.get()}")


if __name__ == "__main__":
    main()
