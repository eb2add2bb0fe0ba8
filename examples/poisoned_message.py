"""A poisoned message: it kills whoever handles it. The actor is started again, and the message is not sent again.

What must not be lost the sender asks for: then it hears what became of it, and decides. The rest is a dead letter.

python examples/poisoned_message.py
"""

from __future__ import annotations

import os
import tempfile
import threading

import pykka

import rr_actors as rr


class Parser(rr.Actor):
    def on_receive(self, message: str) -> str:
        if message == "poison":
            os._exit(139)  # as a defect in a library of C would end it
        return message.upper()


def main() -> None:
    back = threading.Event()
    children = [rr.ChildSpec(Parser, id="parser")]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        system.subscribe(lambda event: back.set() if event["event"] == "restarted" else None)
        parser = system.ref("parser")
        for message in ("one", "poison", "two"):
            try:
                print(f"{message}: {parser.ask(message)}", flush=True)
            except (rr.ActorUnavailable, pykka.ActorDeadError) as error:
                print(f"{message}: no answer ({type(error).__name__})", flush=True)
                back.wait(10)

        system.supervisor().terminate_child("parser")
        try:
            parser.tell("three")
        except pykka.ActorDeadError:
            print("three: nobody is there", flush=True)
        print("dead letters:", [(letter.to, letter.message) for letter in system.dead_letters().letters], flush=True)


if __name__ == "__main__":
    main()
