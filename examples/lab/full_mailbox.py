"""A full mailbox: a sensor sends faster than a filter works.

A mailbox has a bound. Who asks waits for each answer. Who tells goes on at once.

Look for: the number of messages that wait; what the sensor hears; the dead letters in the events.

Why: who asks becomes as slow as the actor that answers. Who tells an actor of its own process hears MailboxFull at the
bound. In another process the filter's side finds the mailbox full, when the sender has long gone on: what it does not
take is a dead letter.
"""

# /// lab
# place = 19
# question = "The sensor sends ten readings a second, the filter handles two. What will it see within ten seconds?"
# levers = [
#     {name = "way", label = "it sends by", choices = ["tell", "ask"]},
#     {name = "where", label = "the filter is in", choices = ["another process", "its own process"]},
#     {name = "limit", label = "bound of the mailbox", choices = [20, 1000]},
# ]
# [answers]
# "MailboxFull" = {prints = "hears MailboxFull"}
# "nothing: readings become dead letters" = {prints = "dead letters: "}
# "each answer, as slow as the filter" = {prints = "as slow as the filter"}
# "nothing: all of them wait" = {prints = "all of them wait"}
# ///

from __future__ import annotations

import time

import rr_actors as rr


class Filter(rr.Actor):
    def on_receive(self, message: int) -> int:
        time.sleep(0.5)
        return message


class Roomy(Filter):
    mailbox_limit = 1000


class Narrow(Filter):
    mailbox_limit = 20


def main(state_dir: str, way: str = "tell", where: str = "another process", limit: int = 20) -> None:
    placement = "thread" if where == "its own process" else "process"
    child = rr.ChildSpec(Narrow if limit == 20 else Roomy, id="filter", placement=placement)
    with rr.System([child], state_dir=state_dir) as system:
        time.sleep(2)
        reader, mailbox = system.ref("filter"), system.mailbox("filter")
        sent, refused = 0, 0
        end = time.monotonic() + 10
        while time.monotonic() < end:
            try:
                if way == "ask":
                    reader.ask(sent)
                else:
                    reader.tell(sent)
            except rr.MailboxFull:
                refused += 1
            sent += 1
            if sent % 10 == 0:
                print(f"sent {sent}, and {mailbox.look().length} wait", flush=True)
            time.sleep(0.1)
        if way == "ask":
            print(f"it sent {sent}: it is as slow as the filter", flush=True)
        elif refused:
            print(f"it hears MailboxFull, {refused} times", flush=True)
        elif dead := system.dead_letters().count:
            print(f"it hears nothing; dead letters: {dead}", flush=True)
        else:
            print("all of them wait", flush=True)
        time.sleep(3)
