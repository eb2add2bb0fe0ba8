"""Ping-pong: two actors in processes of their own, and what they send each other, as a sequence diagram.

python examples/ping_pong.py
"""

import tempfile
from typing import Any

import rr_actors as rr


class Pong(rr.Actor):
    def on_receive(self, message: Any) -> Any:
        return f"{message}, pong"


class Ping(rr.Actor):
    def on_receive(self, message: Any) -> Any:
        pong, count = message
        ball = "ping"
        for _ in range(count):
            ball = pong.ask(ball)
        return ball


def main() -> None:
    children = [rr.ChildSpec(Pong, id="pong"), rr.ChildSpec(Ping, id="ping")]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        with system.record() as recording:
            print(system.ref("ping").ask((system.ref("pong"), 2)))
        print(recording.messages().sequence())


if __name__ == "__main__":
    main()
