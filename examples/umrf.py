"""Graphs of actions: a branch, a state machine, and a fallback when a camera fails.

python examples/umrf.py                   a table
python examples/umrf.py --picture FILE    and a picture of the last graph: an SVG file
"""

from __future__ import annotations

import itertools
import sys
import tempfile
from pathlib import Path

import msgspec

import rr_actors as rr
from rr_actors.managers import Actions, draw_graph

GRAPHS = Path(__file__).with_name("umrf")


class LookAtDoor(rr.Action):
    class Input(msgspec.Struct):
        is_open: bool

    def run(self, given: Input) -> bool:
        return given.is_open


class Choose(rr.Action):
    class Input(msgspec.Struct):
        choice: str

    class Output(msgspec.Struct):
        chosen: str

    def run(self, given: Input) -> Output:
        return self.Output(given.choice)


class Words(msgspec.Struct):
    words: str


class Say(rr.Action):
    Input = Output = Words

    def run(self, given: Words) -> Words:
        return given


class Dispatch(rr.Action):
    class Output(msgspec.Struct):
        state: str

    states = itertools.chain(["to shelf", "pick up", "to door", "put down", "done"])

    def run(self, given: object) -> Output:
        return self.Output(next(self.states))


class Drive(rr.Action):
    def run(self, given: dict[str, str]) -> bool:
        return True


class Handle(Drive): ...


class TakePicture(rr.Action):
    class Input(msgspec.Struct):
        camera: str

    class Output(msgspec.Struct):
        picture: str

    def run(self, given: Input) -> Output:
        camera = self.load("cameras/camera", given.camera)  # released when this action has ended
        return self.Output(f"a picture of {camera.response}")


class Cameras(rr.Manager):
    @rr.server("camera")
    def open_camera(self, name: str) -> str:
        if name == "broken":
            raise OSError("no such camera")
        return name


ACTIONS = [LookAtDoor, Choose, Say, Dispatch, Drive, Handle, TakePicture]


def main() -> None:
    actions = rr.ChildSpec(Actions, id="actions", kwargs={"actions": ACTIONS, "graphs": str(GRAPHS)})
    children = [rr.ChildSpec(Cameras, id="cameras"), actions]
    with tempfile.TemporaryDirectory() as state, rr.System(children, state_dir=state) as system:
        app = system.open_registrar("app")
        print("graph      result   says                what ran")
        for graph, inputs in (("greet", {"is_open": False}), ("deliver", {}), ("inspect", {})):
            ended = rr.run_graph(app, graph, inputs=inputs, timeout_s=60)
            ran = ", ".join(name for name, state in ended.states.items() if state != "UNINITIALIZED")
            print(f"{graph:<10} {ended.result:<8} {ended.outputs.get('words', ''):<19} {ran}", flush=True)
            if "--picture" in sys.argv and graph == "inspect":
                picture = Path(sys.argv[sys.argv.index("--picture") + 1])
                picture.write_text(draw_graph(str(GRAPHS / "inspect.json"), ended.states))
                print(f"{picture} is drawn")


if __name__ == "__main__":
    main()
