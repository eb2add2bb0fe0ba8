"""Tell against ask: a tell returns at once and hears nothing; an ask waits for the answer, and hears the error.

An error in a handler that was told ends the actor, and its supervisor starts it again: its count is lost.

python examples/tell_and_ask.py
"""

import logging
import tempfile

import rr_actors as rr


class Counter(rr.Actor):
    count = 0

    def on_receive(self, message: int) -> int:
        if message < 0:
            raise ValueError("only upward")
        self.count += message
        return self.count


def main() -> None:
    logging.getLogger("rr_actors").setLevel(logging.CRITICAL)  # the errors are what this shows
    children = [rr.ChildSpec(Counter, id="counter", placement="thread")]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        counter = system.ref("counter")
        for _ in range(3):
            counter.tell(10)
        print("told three times, then asked:", counter.ask(0))
        print("asked, and heard the error:", counter.ask(-1, block=False).exception())
        print("the actor lives, and has:", counter.ask(0))
        ended = rr.monitor(counter)
        counter.tell(-1)
        print("told, and heard nothing")
        ended.wait(10)
        counter.wait_running()
        print("the actor is another one, and has:", counter.ask(0))


if __name__ == "__main__":
    main()
