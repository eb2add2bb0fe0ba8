"""A dead letter: a message that reaches nobody is counted and kept, so that somebody sees it.

python examples/dead_letter.py
"""

import tempfile

import rr_actors as rr


class Greeter(rr.Actor):
    def on_receive(self, message: str) -> None:
        print("hello,", message)


def main() -> None:
    children = [rr.ChildSpec(Greeter, id="greeter", placement="thread")]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        greeter = system.ref("greeter")
        greeter.ask("world")
        system.supervisor().terminate_child("greeter")
        try:
            greeter.tell("is anybody there?")
        except rr.ActorDeadError as error:
            print("the sender hears:", error)
        letters = system.dead_letters()
        for letter in letters.letters:
            print(f"dead letter to {letter.to}: {letter.message}")
        print("dead letters:", letters.count)


if __name__ == "__main__":
    main()
