"""The programs that show a fault again have the values that were found, whatever these are called."""

from __future__ import annotations

import enum
import pathlib
from typing import Any

import msgspec
import pytest

import rr_actors as rr
import support_planted as planted
from rr_actors.testing import Load, Unload
from rr_actors.testing.failure_programs import program_of
from rr_actors.testing.scenario_notes import Fault


class Colours(enum.Flag):
    RED = 1
    BLUE = 2


class Update(msgspec.Struct, frozen=True):
    """A request that has the name of a step."""

    name: str


class Path(msgspec.Struct, frozen=True):
    """And one that has the name of what a program imports."""

    name: str


VALUES = [
    float("nan"),
    float("inf"),
    float("-inf"),
    1.5,
    Colours.RED,
    Colours.RED | Colours.BLUE,
    Update("a"),
    Path("b"),
]


@pytest.mark.parametrize(
    "value", [*VALUES, VALUES, pathlib.Path("c"), {"of": (Path("d"), pathlib.Path("e"))}], ids=repr
)
def test_a_program_has_the_values_of_its_steps(value: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    steps = (Load("port", value), Unload(1))
    fault = Fault("no callback takes longer than its limit", "")
    program = program_of(rr.ChildSpec(planted.Ports, id="ports"), steps, fault, beside=(), callback_s=1.0, options={})
    played = list[Any]()
    monkeypatch.setattr(
        "rr_actors.testing.play_steps", lambda manager, steps, **options: played.append((manager, steps))
    )

    exec(compile(program, "program.py", "exec"), {"__name__": "__main__"})

    ((manager, found),) = played
    assert (manager, repr(tuple(found))) == (planted.Ports, repr(steps))
