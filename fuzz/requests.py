"""Requests: bytes decoded into the type that a callback declares, and made canonical."""

from __future__ import annotations

import datetime
import enum
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, NamedTuple, TypedDict

import attrs
import msgspec

from fuzz.packed import after, samples
from fuzz.target import Target
from rr_actors.base.errors import InvalidRequest, NotSerializable
from rr_actors.base.values.canonical import Codec


class Colour(enum.Enum):
    RED = "red"
    BLUE = "blue"


@dataclass(frozen=True)
class Order:
    name: str
    parts: tuple[str, ...] = ()
    size: float = 1.0
    options: dict[str, Any] = field(default_factory=dict[str, Any])


class Circle(msgspec.Struct, tag=True, frozen=True):
    radius: Annotated[float, msgspec.Meta(ge=0)]


class Square(msgspec.Struct, tag=True, forbid_unknown_fields=True):
    side: int = 1


class Point(NamedTuple):
    x: int
    y: int = 0


class Options(TypedDict, total=False):
    deep: bool
    mode: Literal["a", "b"]


@attrs.define
class Grip:
    force: int
    fingers: list[int] = attrs.field(factory=list[int])


@dataclass
class Gaps:
    first: int
    shown: Grip | None = None
    hidden: int = field(default=3, init=False)


@dataclass
class Scene:
    shapes: list[Circle | Square]
    at: Point
    options: Options
    colour: Colour = Colour.RED
    seen: set[int] = field(default_factory=set[int])
    when: datetime.datetime | None = None
    order: Order | None = None
    grips: dict[int, Grip] = field(default_factory=dict[int, Grip])
    anything: Any = None


KINDS: list[Any] = [
    None, Order, Circle | Square, Point, Options, Grip, Gaps, Scene, dict[str, int], list[tuple[int, str]],
    dict[int, Any], set[int], Colour, int | str | None,
]  # fmt: skip
_CODECS = [Codec(kind) for kind in KINDS]


def _seeds() -> list[bytes]:
    typed = [bytes([at]) + body for at, kind in enumerate(KINDS) if kind is not None for body in samples(kind)]
    return [*typed, *(b"\0" + body for kind in KINDS[1:] for body in samples(kind))]


def _feed(data: bytes) -> None:
    """Byte 0: the type. What is accepted has canonical bytes, which mean the same and are their own canonical bytes."""
    if not data:
        return
    codec, raw = _CODECS[data[0] % len(_CODECS)], data[1:]
    codec.show(raw)
    try:
        codec.decode(raw, "maker/thing")
        canonical = codec.canonical(raw, "maker/thing")
    except (InvalidRequest, NotSerializable) as error:
        assert type(error) in (InvalidRequest, NotSerializable)
        assert str(error).startswith("maker/thing: request")
        return
    assert codec.canonical(canonical) == canonical
    assert codec.encode(codec.decode(canonical)) == canonical


REQUESTS = Target(
    f"requests, as {len(KINDS)} types that callbacks may declare",
    lambda directory: _feed,
    _seeds,
    after(1),
    words=tuple(word.encode() for word in ("name", "parts", "Circle", "type", "radius", "hidden", "colour", "red")),
)
