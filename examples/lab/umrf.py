"""Actions as a graph: the robot drives, takes a picture, and reports.

Each action is a class, and the graph says which one runs when: if the arm's camera fails, the spare one is tried. An
action's run is a resource: what it loads is its part, and is released when the run has ended.

Look for: the graph's parts, one for each action that runs; if the manager of the actions is killed, which action runs
again, and which do not.

Why: each step of the graph is on disk before the next one begins. After a crash the actions that had ended stay so, and
the one that ran begins again, as its next attempt.
"""

# /// lab
# place = 18
# question = "A picture is to be taken with the arm's camera, or else with the spare one. What will happen?"
# levers = [
#     {name = "broken", label = "the broken camera", choices = ["arm", "none", "spare"]},
#     {name = "killed", label = "what is killed during a picture", choices = ["nobody", "actions"]},
# ]
# [answers]
# "the arm's camera takes it" = {prints = "TakePicture_0 is FINISHED"}
# "the spare camera takes it" = {prints = "TakePicture_1 is FINISHED"}
# "the graph ends with an error" = {prints = "the graph ends with on_error"}
# "the drive runs again" = {prints = "Drive begins, attempt 2"}
# "the spare camera begins again, as attempt 2" = {prints = "the camera spare, attempt 2"}
# ///

from __future__ import annotations

import os
import signal
import threading
import time

import msgspec

import rr_actors as rr
from rr_actors.managers import Actions

GRAPH = {
    "graph_name": "inspect",
    "graph_entry": [{"name": "Drive"}],
    "graph_exit": [{"name": "Report"}],
    "actions": [
        {"name": "Drive", "children": [{"name": "TakePicture"}]},
        {
            "name": "TakePicture",
            "input_parameters": {"camera": {"pvf_type": "string", "pvf_value": "arm"}},
            "parents": [{"name": "Drive"}],
            "children": [{"name": "TakePicture", "instance_id": 1}, {"name": "Report"}],
        },
        {
            "name": "TakePicture",
            "instance_id": 1,
            "input_parameters": {"camera": {"pvf_type": "string", "pvf_value": "spare"}},
            "parents": [{"name": "TakePicture", "conditions": ["on_true -> ignore", "on_error -> run"]}],
            "children": [{"name": "Report"}],
        },
        {
            "name": "Report",
            "parents": [
                {"name": "TakePicture", "required": False, "conditions": ["on_error -> ignore"]},
                {"name": "TakePicture", "instance_id": 1, "required": False},
            ],
        },
    ],
}


class Step(rr.Action):
    def run(self, given: object) -> None:
        print(f"{type(self).__name__} begins, attempt {self.attempt}", flush=True)
        self.stopping.wait(3)


class Drive(Step): ...


class Report(Step): ...


class TakePicture(rr.Action):
    class Input(msgspec.Struct):
        camera: str

    def run(self, given: Input) -> None:
        print(f"TakePicture begins with the camera {given.camera}, attempt {self.attempt}", flush=True)
        self.load("cameras/camera", given.camera)
        self.stopping.wait(4)


class Cameras(rr.Manager):
    def __init__(self, broken: str) -> None:
        self.broken = broken

    @rr.server("camera")
    def open_camera(self, name: str) -> str:
        time.sleep(1)
        if name == self.broken:
            raise OSError("no such camera")
        return name


def main(state_dir: str, broken: str = "arm", killed: str = "nobody") -> None:
    actions = rr.ChildSpec(Actions, id="actions", kwargs={"actions": [Drive, TakePicture, Report]})
    with rr.System([rr.ChildSpec(Cameras, id="cameras", args=(broken,)), actions], state_dir=state_dir) as system:
        app = system.open_registrar("app")
        time.sleep(2)
        if killed == "actions":
            pid = next(child.pid for child in system.supervisor().which_children() if child.id == "actions")
            threading.Timer(6.5, os.kill, (pid, signal.SIGKILL)).start()
        ended = rr.run_graph(app, GRAPH, timeout_s=60)
        for name, state in ended.states.items():
            print(f"{name} is {state}", flush=True)
        print(f"the graph ends with {ended.result}", flush=True)
        time.sleep(2)
