"""A class of thirty students on one machine: each has a process, and shares the robot; one crash is nobody else's."""

from __future__ import annotations

import tempfile
from typing import Any

import rr_actors as rr

GOOD = "result = sum(range(100))"
BETTER = "result = 4950"
BAD = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"


class Robots(rr.Manager):
    @rr.server("robot", recovery="keep")
    def load_robot(self, name: str) -> str:
        return f"simulator of {name}"


class Desk(rr.Manager):
    """Runs what a student hands in, with the robot."""

    @rr.server("answer", recovery="keep")
    def run(self, program: str) -> int:
        names: dict[str, Any] = {"robot": self.registrar.load(Robots.load_robot, "clearbot").response}
        exec(program, names)
        return names["result"]


def main() -> None:
    ids = [f"student{number}" for number in range(1, 31)]
    children = [rr.ChildSpec(Robots, id="robots"), *(rr.ChildSpec(Desk, id=id) for id in ids)]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        app = system.open_registrar("teacher")
        with app.load_all([(f"{id}/answer", GOOD) for id in ids]) as answers:
            print("right:", [answer.response for answer in answers].count(4950))
            print("robots:", len(system.registrar("robots").resources()))
            try:
                app.load("student7/answer", BAD)
            except rr.LoadFailed:
                print("student7 crashes each time")
            print("the next try of student7:", app.load("student7/answer", BETTER).response)
            print("as before:", [str(answer.fetch_state()) for answer in answers].count("OK"))


if __name__ == "__main__":
    main()
