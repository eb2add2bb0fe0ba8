"""A poisoned message: it ends the process that handles it.

A parser gets the messages "one", "poison", "two" and "three", one after another. "poison" ends its process, as a defect
in a C library would. Then the parser is stopped, and gets "four".

Look for: the parser's new process after the poison, and how many messages wait for it; what becomes of "four".

Why: the actor starts again, and the message is not sent again. If it were, the actor would end each time. So the
message is lost, and its sender decides: a sender that asks gets an error. A message to a stopped actor is a dead
letter.
"""

# /// lab
# place = 6
# question = "The parser's process ends at the poison. What will its new process do with this message?"
# [answers]
# "get it again, and end again" = {prints = "two: no answer"}
# "never see it" = {prints = "two: TWO"}
# ///

from __future__ import annotations

import os
import time

import rr_actors as rr


class Parser(rr.Actor):
    def on_receive(self, message: str) -> str:
        if message == "poison":
            os._exit(139)  # as a defect in a C library would end it
        return message.upper()


def main(state_dir: str) -> None:
    with rr.System([rr.ChildSpec(Parser, id="parser")], state_dir=state_dir) as system:
        parser = system.ref("parser")
        for message in ("one", "poison", "two", "three"):
            time.sleep(3)
            try:
                print(f"{message}: {parser.ask(message, timeout=20)}", flush=True)
            except (rr.ActorUnavailable, rr.ActorDeadError) as error:
                print(f"{message}: no answer ({type(error).__name__})", flush=True)
        system.supervisor().terminate_child("parser")
        try:
            parser.tell("four")
        except rr.ActorDeadError:
            print("four: nobody is there", flush=True)
        time.sleep(5)
