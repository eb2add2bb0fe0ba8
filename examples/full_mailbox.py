"""A full mailbox: the sender of one message too many hears it at once, and decides. Nothing is lost in silence.

An ask instead of a tell has the sender wait for each answer: it cannot be faster than the actor.

python examples/full_mailbox.py
"""

import tempfile
import threading
import time

import rr_actors as rr

paper = threading.Event()


class Printer(rr.Actor):
    mailbox_limit = 3

    def on_receive(self, message: int) -> int:
        paper.wait()
        return message


def main() -> None:
    children = [rr.ChildSpec(Printer, id="printer", placement="thread")]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        printer, mailbox = system.ref("printer"), system.mailbox("printer")
        printer.tell(0)
        while mailbox.look().handled is None:  # until the printer has it, and waits for paper
            time.sleep(0.01)
        refused: list[int] = []
        for page in range(1, 6):
            try:
                printer.tell(page)
            except rr.MailboxFull:
                refused.append(page)
        print("waiting:", mailbox.look().length, "refused:", refused)
        paper.set()
        while mailbox.look().length:
            time.sleep(0.01)
        print("asked, one after another:", [printer.ask(page) for page in refused])


if __name__ == "__main__":
    main()
