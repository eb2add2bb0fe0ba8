"""The type of a pickled value is read from its bytes, and nothing is unpickled."""

from __future__ import annotations

import dataclasses
import enum
from typing import Any, NamedTuple

import msgspec
import pytest
from pykka.messages import ProxyCall

from rr_actors.base import pickling
from rr_actors.base.pickled_types import type_in


@dataclasses.dataclass
class Data:
    x: int = 1


class Struct(msgspec.Struct):
    x: int = 1


class Pair(NamedTuple):
    x: int = 1


class Plain:
    def __init__(self) -> None:
        self.x = 1


class Colour(enum.Enum):
    RED = 1


CLASSES = (Data(), Struct(), Pair(), Plain(), Colour.RED, ProxyCall(("open",), (1,), {}), ValueError("x"))
BUILT_IN = (
    {"a": Data()},
    [1],
    {1},
    (Data(), 1),
    (1, 2, 3, 4),
    (),
    "text",
    "t",
    "x" * 9000,
    b"x",
    1,
    -1,
    10**30,
    2.5,
    True,
)


@pytest.mark.parametrize("value", [*CLASSES, *BUILT_IN], ids=lambda value: type(value).__name__)
def test_the_type_is_known(value: Any) -> None:
    assert type_in(pickling.dumps(value)) == type(value).__name__


@pytest.mark.parametrize("base", [(), (msgspec.Struct,), (Plain,)])
def test_the_type_is_known_of_a_class_that_travels_by_value(base: tuple[type, ...]) -> None:
    cls: Any = type("Reckon", base, {"__module__": "__main__"})
    assert type_in(pickling.dumps(cls())) == "Reckon"


def test_of_what_it_cannot_read_it_says_nothing() -> None:
    assert type_in(b"") == type_in(b"\x80\x05") == type_in(b"\xff\xff") == ""
    assert type_in(pickling.dumps(frozenset({1}))) == ""


def test_no_code_of_the_value_runs() -> None:
    assert type_in(pickling.dumps(Trap())) == "sprung"


class Trap:
    def __reduce__(self) -> Any:
        return sprung, ()


def sprung() -> None:
    raise AssertionError("it was unpickled")
