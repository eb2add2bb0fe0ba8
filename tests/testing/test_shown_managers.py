"""Every manager that a page or an example shows, and every ready-made one, passes check_manager."""

from __future__ import annotations

import contextlib
import importlib
import os
import pty
import select
import socket
import sys
import threading
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import msgspec
import pytest
from hypothesis import strategies as st

import rr_actors as rr
from rr_actors.managers import (
    Actions,
    Alternative,
    Budgets,
    Choices,
    Choose,
    Components,
    LoadComponent,
    Pool,
    Programs,
    RunAction,
    RunProgram,
    Share,
    Supply,
)
from rr_actors.testing import check_manager
from support_shown import module_of, shown_managers

BUDGETS = rr.ChildSpec(Budgets, id="budgets", args=([Pool("watts", 100)],))
PROGRAMS = rr.ChildSpec(Programs, id="programs")
NAMES = ("front", "rear")

LEFT_OUT = {
    "docs/crash-test.md Supplies": "it has a fault, for a reader to see it found",
    "docs/crash-test.md Counters": "two of its callbacks race, for a reader to see it",
    "docs/planning.md Sources": "its servers stand for two drivers, and live as long as their process",
    "examples/applications/debugging.py Cameras": "its load callback stops in the debugger",
    "examples/recipes/pipeline.py Pipelines": "its programs are ended by their own end of file",
    "examples/lab/crash_in_unload.py Files": "it dies in its unload callback, for a student to see",
    "examples/lab/kill_in_a_load.py Maps": "its load takes 6 s, for a student to kill it",
    "examples/lab/refused_ring.py Maps": "it takes part in a ring, for a student to see it refused",
    "examples/lab/refused_ring.py Cameras": "it takes part in a ring, for a student to see it refused",
    "examples/lab/tour_guide.py Guide": "its programs fill the memory that there is",
    "examples/tour_guide.py Guide": "its programs fill the memory that there is",
    "examples/lab/keep.py Radios": "one of its radios is silent, for a student to see it replaced",
}


class Needs(NamedTuple):
    """How a manager is checked."""

    requests: Callable[[ModuleType, Path], Any] = lambda module, place: NAMES
    args: tuple[Any, ...] = ()
    id: str = ""
    beside: Callable[[ModuleType], list[rr.ChildSpec]] = lambda module: []
    more: tuple[str, ...] = ()


def just(*requests: Any) -> Callable[[ModuleType, Path], Any]:
    return lambda module, place: requests


def by_server(**requests: tuple[Any, ...]) -> Callable[[ModuleType, Path], Any]:
    return lambda module, place: requests


def with_budgets(module: ModuleType) -> list[rr.ChildSpec]:
    return [BUDGETS]


def with_programs(module: ModuleType) -> list[rr.ChildSpec]:
    return [PROGRAMS]


def with_class(name: str) -> Callable[[ModuleType], list[rr.ChildSpec]]:
    return lambda module: [rr.ChildSpec(getattr(module, name), id=name.lower())]


def a_file(module: ModuleType, place: Path) -> Any:
    (place / "motor").write_text("a motor")
    return (str(place / "motor"),)


AT_THE_END = contextlib.ExitStack()


def a_port(module: ModuleType, place: Path) -> Any:
    other = AT_THE_END.enter_context(socket.create_server(("127.0.0.1", 0), backlog=1000))
    host, port = other.getsockname()
    return ({"host": host, "port": port},)


def an_instrument(module: ModuleType, place: Path) -> Any:
    """A pseudo-terminal that answers, as that of the recipe, until the test ends."""
    (inside, outside), (stopped, stop) = pty.openpty(), os.pipe()
    tty.setraw(outside)

    def answer() -> None:
        while stopped not in select.select([inside, stopped], [], [])[0]:
            os.read(inside, 100)
            os.write(inside, b"multimeter 7\n")

    answering = threading.Thread(target=answer)
    answering.start()
    for fd in (inside, outside, stopped):
        AT_THE_END.callback(os.close, fd)
    AT_THE_END.callback(answering.join)
    AT_THE_END.callback(os.close, stop)  # first: the other end of the pipe can be read then
    return (os.ttyname(outside),)


WATTS = {"name": "arm", "watts": 4.0}
LENSES = Needs(args=("no",), beside=with_class("Lenses"), more=("Lenses",))
NO_FIELDS = just({})
SHOWN = {
    "docs/crash-test.md Cameras": Needs(args=("ACME",), beside=with_class("Lenses"), more=("Lenses",)),
    "docs/crash-test.md Lenses": Needs(just(35, 50)),
    "docs/planning.md Maps": Needs(beside=with_class("Cameras")),
    "docs/planning.md Devices": Needs(just(WATTS), beside=with_budgets),
    "docs/planning.md Kitchen": Needs(by_server(lamp=NAMES, oven=(WATTS,)), beside=with_budgets),
    "docs/recording.md Robots": Needs(beside=with_class("Lidars"), more=("Lidars",)),
    "docs/replacing.md Robots": Needs(beside=with_class("Lidars")),
    "docs/rewind.md Lenses": Needs(by_server(lens=NAMES, mount=NAMES)),
    "docs/supervision.md Port": Needs(just(1, 2), args=("tty",)),
    "docs/tutorial.md Cameras": Needs(lambda module, place: (module.OpenCamera("/dev/video0"),)),
    "docs/tutorial.md Motors": Needs(a_file),
    "docs/two-computers.md Arm": Needs(a_port),
    "docs/upgrading.md Cameras": Needs(lambda module, place: (module.OpenCamera("left"),)),
    "docs/upgrading.md Cameras 2": Needs(lambda module, place: (module.OpenCamera("left"),)),
    "docs/values.md Sensors": Needs(by_server(range=({"name": "lidar", "rate": 5.0},), all=({},))),
    "docs/values.md Models": Needs(id="models"),
    "docs/values.md Planner": Needs(beside=with_class("Models"), more=("Models",)),
    "examples/async_load.py Slow": Needs(just(2, 3)),
    "examples/brownout.py Devices": Needs(lambda module, place: tuple(module.DEVICES)[:2], beside=with_budgets),
    "examples/crash.py Counters": Needs(just(1, 2)),
    "examples/dependencies.py Parts": Needs(just("arm", "lidar"), args=([],)),
    "examples/first_resource.py Cameras": Needs(lambda module, place: (module.OpenCamera("/dev/video0", 30),)),
    "examples/generator.py Devices": Needs(
        lambda module, place: {"device": tuple(module.DEVICES)[:2], "generator": ("diesel",)}, beside=with_budgets
    ),
    "examples/keep.py Radios": Needs(beside=with_programs),
    "examples/lab/brownout.py Devices": Needs(lambda module, place: tuple(module.WATTS)[:2], beside=with_budgets),
    "examples/lab/generator.py Devices": Needs(
        lambda module, place: {"device": tuple(module.WATTS)[:2]}, args=(True,), beside=with_budgets
    ),
    "examples/lab/handled_status.py Cameras": LENSES,
    "examples/lab/rebinding.py Sensors": Needs(NO_FIELDS, args=(20.0,)),
    "examples/lab/sharing_and_parts.py Cameras": LENSES._replace(args=()),
    "examples/lab/umrf.py Cameras": Needs(args=("broken",)),
    "examples/rebinding.py Sensors": Needs(NO_FIELDS, args=(20.0,)),
    "examples/recipes/classroom.py Desk": Needs(just("result = 1"), beside=with_class("Robots")),
    "examples/recipes/serial_lab.py Instruments": Needs(an_instrument),
    "examples/replacing.py Robots": Needs(beside=with_class("Lidars")),
}


@pytest.fixture(autouse=True)
def _at_the_end() -> Iterator[None]:
    yield
    AT_THE_END.close()


def strategies(requests: Any) -> Any:
    if isinstance(requests, dict):
        return {server: st.sampled_from(some) for server, some in requests.items()}
    return st.sampled_from(requests)


def check(shown: str, place: Path, monkeypatch: pytest.MonkeyPatch, kills: int) -> None:
    needs = SHOWN.get(shown, Needs())
    name = "shown_" + "".join(letter if letter.isalnum() else "_" for letter in shown)
    (place / f"{name}.py").write_text(module_of(shown, needs.more))
    monkeypatch.syspath_prepend(str(place))
    monkeypatch.chdir(place)  # some write a file there
    module = importlib.import_module(name)
    try:
        cls = getattr(module, shown.split()[1])
        child = rr.ChildSpec(cls, id=needs.id or cls.__name__.lower(), args=needs.args)
        requests = strategies(needs.requests(module, place))
        done = check_manager(child, requests, beside=needs.beside(module), kills=kills, limit_s=100)
    finally:
        del sys.modules[name]
    assert done.kills >= min(kills, 3)


def test_what_is_said_here_is_shown_somewhere() -> None:
    everything = set(shown_managers())
    assert (SHOWN.keys() | LEFT_OUT.keys()) - everything == set()
    assert len(everything) > 50


@pytest.mark.timeout(150)
@pytest.mark.parametrize("shown", ["README.md Cameras", "docs/streams.md Cameras"])
def test_two_managers_that_are_shown_pass(shown: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check(shown, tmp_path, monkeypatch, kills=3)


@pytest.mark.slow
@pytest.mark.timeout(150)
@pytest.mark.parametrize("shown", sorted(set(shown_managers()) - LEFT_OUT.keys()))
def test_each_manager_that_is_shown_passes(shown: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check(shown, tmp_path, monkeypatch, kills=12)


class Sensors(rr.Manager):
    """What a choice chooses from."""

    @rr.server("lidar", recovery="keep")
    def open_lidar(self, place: str) -> str:
        return place


class Tell(rr.Action):
    """An action that ends at once."""

    class Input(msgspec.Struct):
        words: str

    Output = Input

    def run(self, given: Input) -> Input:
        return given


COMPONENT = """
[[component]]
name = "sleeper"
type = "lidar"
program = { command = "sleep", arguments = ["1000"], grace_s = 1 }
"""
SLEEPS = [RunProgram("sleep", ("1000",), instance=name) for name in NAMES]
WAYS = [Alternative("range", "sensors/lidar", request="roof")]
SHARES = [Share("watts", 10.0, instance="a"), Share("watts", 20.0, instance="b")]
READY_MADE: dict[str, tuple[rr.ChildSpec, list[rr.ChildSpec], dict[str, Any]]] = {
    "Budgets": (BUDGETS, [], {"share": SHARES, "supply": [Supply("watts", 5.0, instance="c")]}),
    "Programs": (PROGRAMS, [], {"program": SLEEPS}),
    "Choices": (
        rr.ChildSpec(Choices, id="choices", args=(WAYS,)),
        [rr.ChildSpec(Sensors, id="sensors")],
        {"choice": [Choose("range")]},
    ),
    "Components": (
        rr.ChildSpec(Components, id="components", args=("components.toml",)),
        [PROGRAMS],
        {"component": [LoadComponent("lidar"), LoadComponent("lidar", instance="b")]},
    ),
    "Actions": (
        rr.ChildSpec(Actions, id="actions", kwargs={"actions": [Tell]}),
        [],
        {"action": [RunAction("Tell", {"words": "one"}), RunAction("Tell", {"words": "two"})]},
    ),
}


@pytest.mark.slow
@pytest.mark.timeout(200)
@pytest.mark.parametrize("name", READY_MADE)
def test_a_ready_made_manager_passes(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "components.toml").write_text(COMPONENT)
    monkeypatch.chdir(tmp_path)
    child, beside, requests = READY_MADE[name]
    done = check_manager(child, strategies(requests), beside=beside, kills=15, limit_s=120)
    assert done.kills >= 3
