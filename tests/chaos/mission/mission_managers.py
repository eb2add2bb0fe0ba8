"""The managers of the mission: sensors that are chosen and kept, and a graph of actions that loads them."""

from __future__ import annotations

import functools
import hashlib
import json
import os
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import msgspec

from chaos.callback_log import Journal
from chaos.victim_managers import LOG_TO, Recorded, cut_links
from rr_actors.managers import Action, Actions, Alternative, Choices, Choose, Keeper
from rr_actors.registrar.declarations import server

SENSORS = ("sensors-1", "sensors-2")
PLANNERS = ("choices", "keeper", "actions")
SETTLE_S = 0.2
"""So long an alternative has to be well until a choice returns to it."""
ACT_S = 0.02
"""How long an action takes."""
UNLUCKY_ARMS = 120
"""Of 256 loads of arms, so many fail."""
ACT, ACTED, SEEN, RELEASED = "act", "acted", "seen-the-end", "released"
"""Words of the journal. Its subject is "mission/round/action" for the first two, and a mission for the others."""

ALTERNATIVES = (
    Alternative("range", "sensors-1/camera", "front", provides={"rate_hz": 30}, timeout_s=5.0),
    Alternative("range", "sensors-2/lidar", "front", provides={"rate_hz": 20}, timeout_s=5.0),
    Alternative("range", "sensors-2/camera", "spare", provides={"rate_hz": 10}, timeout_s=5.0),
    Alternative("arm", "sensors-1/lidar", "arm", break_first=True, timeout_s=5.0),
    Alternative("arm", "sensors-2/camera", "arm", break_first=True, timeout_s=5.0),
)
CHOICES = (Choose("range"), Choose("range", prefer=["-rate_hz"]), Choose("range", {"rate_hz": "<25"}), Choose("arm"))


def _table(kind: str, **fields: object) -> str:
    """Return a table of a TOML file."""
    return "\n".join([f"[[{kind}]]", *(f"{key} = {json.dumps(value)}" for key, value in fields.items()), ""])


def _keeps(replicas: int, request: str) -> str:
    """Return a file with this number of radios, and request in the place of theirs and the beacons'."""
    beacons = {"server": "sensors-2/lidar", "request": request, "replicas": 2, "after": ["radio"]}
    tables = [
        _table("keep", name="radio", server="sensors-1/camera", request=request, replicas=replicas),
        _table("keep", name="beacon", **beacons),
        _table("group", name="dock"),
        _table("group.member", server="sensors-2/camera", request="dock"),
        _table("group.member", server="sensors-1/lidar", request="dock"),
        _table("keep", name="dock", server="keeper/group", request="dock"),
    ]
    return "\n".join(tables)


DESIRED: Mapping[str, str] = {
    "all": _keeps(3, "kept-{instance}"),
    "less": _keeps(1, "kept-{instance}"),
    "others": _keeps(3, "other-{instance}"),
    "nothing": "",
}
"""What the keeper is to keep, by name."""


class Sensors(Recorded):
    """Serves "camera", which outlives a crash, and "lidar", which is lost in it.

    One load in ten fails, and of those of an arm nearly each second one, so that a choice loses all of them at times.
    """

    @server("camera", recovery="keep")
    def open_camera(self, name: str) -> str:
        return self._open(name)

    @open_camera.unload
    def close_camera(self, name: str, response: str) -> None:
        self.unmake()

    @server("lidar", recovery="lost")
    def open_lidar(self, name: str) -> str:
        return self._open(name)

    @open_lidar.unload
    def close_lidar(self, name: str, response: str) -> None:
        self.unmake()

    def on_receive(self, message: Any) -> Any:
        if message == "cut":
            cut_links()
        return message

    def _open(self, name: str) -> str:
        with self.recorded("load") as now:
            luck = hashlib.sha256(f"{now.resource_id} {now.attempt}".encode()).digest()
            time.sleep(luck[0] / 255 * 0.01)
            if luck[1] < (UNLUCKY_ARMS if name == "arm" else 25):
                raise ValueError("out of luck")
        return f"{self.registrar.name} {name}"


class Chooser(Choices):
    """Choices whose links can be cut."""

    def on_receive(self, message: Any) -> Any:
        return _cut(message) or super().on_receive(message)


class Caretaker(Keeper):
    """A Keeper whose links can be cut."""

    def on_receive(self, message: Any) -> Any:
        return _cut(message) or super().on_receive(message)


class Patrol(Actions):
    """Actions whose links can be cut."""

    def on_receive(self, message: Any) -> Any:
        return _cut(message) or super().on_receive(message)


def _cut(message: Any) -> bool:
    if message == "cut":
        cut_links()
    return message == "cut"


def write_files(directory: Path) -> None:
    """Write the files that the keeper is given, and the graph that is a part of others."""
    for name in DESIRED:
        desired_file(directory, name).write_text(DESIRED[name])
    graphs_folder(directory).mkdir()
    (graphs_folder(directory) / "survey.json").write_text(json.dumps(_SURVEY))


def graphs_folder(directory: Path) -> Path:
    """Return the folder of the graphs that actions are given."""
    return directory / "graphs"


def desired_file(directory: Path, name: str) -> Path:
    """Return the path of a file that the keeper is given."""
    return directory / f"keep-{name}.toml"


class Place(msgspec.Struct):
    """What each action is given, and gives: the mission, and which round it is in."""

    mission: str
    round: int
    rounds: int


class Step(Action):
    """An action that notes its beginning and its end."""

    Input: ClassVar = Place
    Output: ClassVar = Place

    def run(self, given: Place) -> Any:
        subject = f"{given.mission}/{given.round}/{type(self).__name__}"
        journal().note("actions", ACT, subject, self.attempt)
        try:
            return self.do(given)
        finally:
            journal().note("actions", ACTED, subject, self.attempt)

    def do(self, given: Place) -> Any:
        """Do what is special about the step."""
        self.stopping.wait(ACT_S)
        return given


class Start(Step):
    """Begins the first round."""


class Look(Step):
    """Needs ranges, by a choice."""

    def do(self, given: Place) -> Any:
        self.load("choices/choice", CHOICES[given.round % 2], timeout_s=5.0)
        return super().do(given)


class Fetch(Step):
    """Needs a sensor of its own, and fails now and then."""

    def do(self, given: Place) -> Any:
        self.load("sensors-1/lidar", f"fetch-{given.round}", timeout_s=5.0)
        if hashlib.sha256(given.mission.encode()).digest()[given.round] < 12:
            raise ValueError("nothing to fetch")
        return super().do(given)


class Aim(Step):
    """The first of a survey, which is a graph of its own."""


class Shoot(Step):
    """The last of a survey: it has a process of its own, and takes that with it now and then."""

    isolate: ClassVar = True
    timeout_s: ClassVar = 5.0

    def do(self, given: Place) -> Any:
        if hashlib.sha256(given.mission.encode()).digest()[-given.round] < 12:
            os._exit(1)
        return super().do(given)


class Turn(Step):
    """Comes after a survey, and begins the next round; or says that it was the last."""

    def do(self, given: Place) -> Any:
        super().do(given)
        return given.round < given.rounds, Place(given.mission, given.round + 1, given.rounds)


class Finish(Step):
    """Comes after the last round."""


STEPS = (Start, Look, Fetch, Aim, Shoot, Turn, Finish)
"""In the order in which they run."""


def _graph(name: str, below: Mapping[str, Sequence[str]], words: Mapping[tuple[str, str], list[str]]) -> dict[str, Any]:
    """Return a graph; of its actions the first is its entry, and the last its exit."""
    first, last = next(iter(below)), [*below][-1]

    def parent(parent: str, child: str) -> dict[str, Any]:
        relation = {"name": parent, "required": child == "Survey"}
        return {**relation, "conditions": words.get((parent, child), [])}

    return {
        "graph_name": name,
        "graph_entry": [{"name": first}],
        "graph_exit": [{"name": last}],
        "actions": [
            {
                "name": one,
                "children": [{"name": child} for child in children],
                "parents": [parent(above, one) for above, children_of in below.items() if one in children_of],
            }
            for one, children in below.items()
        ],
    }


_SURVEY = _graph("Survey", {"Aim": ["Shoot"], "Shoot": []}, {})
GRAPH = _graph(
    "patrol",
    {
        "Start": ["Look", "Fetch"],
        "Look": ["Survey"],
        "Fetch": ["Survey"],
        "Survey": ["Turn"],
        "Turn": ["Look", "Fetch", "Finish"],
        "Finish": [],
    },
    {
        ("Turn", "Look"): ["on_false -> ignore"],
        ("Turn", "Fetch"): ["on_false -> ignore"],
        ("Turn", "Finish"): ["on_true -> ignore", "on_false -> run"],
    },
)
"""Start, then rounds of Look beside Fetch, which the graph Survey joins, and Turn; then Finish."""


@functools.cache
def journal() -> Journal:
    """Return this process's journal."""
    return Journal(os.environ[LOG_TO])
