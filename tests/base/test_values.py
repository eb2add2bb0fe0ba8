"""Values: what arrives is what was sent, in type and value, with annotations and without; or an error says why not."""

from __future__ import annotations

import collections
import datetime
import enum
import re
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import Any, NamedTuple

import attrs
import msgspec
import numpy as np
import numpy.typing as npt
import pydantic
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import rr_actors as rr
from rr_actors.base.values.canonical import Codec, encode
from rr_actors.base.values.codecs import KINDS

ROOT = Path(__file__).resolve().parents[2]


def same(left: Any, right: Any) -> bool:
    """Equal, and of the same types all the way down."""
    if type(left) is not type(right):
        return False
    if isinstance(left, np.ndarray):
        return left.dtype == right.dtype and left.shape == right.shape and left.tobytes() == right.tobytes()
    if isinstance(left, dict):
        return len(left) == len(right) and all(
            any(same(key, other) and same(part, right[other]) for other in right if other == key)
            for key, part in left.items()
        )
    if isinstance(left, (list, tuple)):
        return len(left) == len(right) and all(map(same, left, right))
    if isinstance(left, (set, frozenset)):
        return left == right and sorted(map(repr, map(type, left))) == sorted(map(repr, map(type, right)))
    if isinstance(left, (float, complex)):
        return repr(left) == repr(right)
    return bool(left == right)


class Mode(enum.Enum):
    FAST = "fast"
    SLOW = "slow"


class Level(enum.IntEnum):
    LOW = 1


class Word(enum.StrEnum):
    A = "a"


@dataclass(frozen=True)
class Pose:
    x: float = 0.0


@dataclass(frozen=True)
class Scan:
    topic: str


class Struct(msgspec.Struct, frozen=True):
    topic: str


class OpenStruct(msgspec.Struct, frozen=True):
    name: str
    anything: Any


class Point(NamedTuple):
    x: int
    y: int


@attrs.frozen
class Wheel:
    radius: float


class Model(pydantic.BaseModel):
    name: str
    at: datetime.datetime
    poses: dict[str, tuple[int, ...]] = {}


class Polygon:
    """A class of one's own that is no plain data."""

    def __init__(self, *corners: tuple[float, float]) -> None:
        self.corners = corners

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Polygon) and self.corners == other.corners

    def __hash__(self) -> int:
        return hash(self.corners)


rr.codec(Polygon, lambda polygon: polygon.corners, lambda corners: Polygon(*corners))

TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
LEAVES = (
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False)
    | TEXT
    | st.binary(max_size=8)
    | st.binary(max_size=8).map(bytearray)
    | st.datetimes()
    | st.datetimes(timezones=st.just(datetime.UTC))
    | st.dates()
    | st.times()
    | st.timedeltas()
    | st.uuids()
    | st.decimals(allow_nan=False)
    | st.complex_numbers(allow_nan=False)
    | st.builds(range, st.integers(-9, 9), st.integers(-9, 9), st.integers(1, 3))
    | TEXT.filter(lambda text: "\0" not in text).map(Path)
    | st.floats(width=32, allow_nan=False).map(np.float32)
    | st.integers(-100, 100).map(np.int16)
    | st.lists(st.floats(allow_nan=False), max_size=4).map(np.array)
    | st.lists(st.tuples(st.floats(allow_nan=False), st.floats(allow_nan=False)), max_size=3).map(lambda c: Polygon(*c))
)
KEYS = TEXT | st.integers(-9, 9)
HASHABLE = st.one_of(st.integers(-9, 9), TEXT, st.uuids(), st.dates())
VALUES = st.recursive(
    LEAVES,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.lists(inner, max_size=3).map(tuple)
        | st.dictionaries(TEXT, inner, max_size=3)
        | st.dictionaries(st.integers(-9, 9), inner, max_size=3)
        | st.dictionaries(st.dates(), inner, max_size=3)
        | st.dictionaries(st.tuples(st.integers(0, 3), TEXT), inner, max_size=3)
        | st.sets(st.integers(-9, 9))
        | st.sets(st.dates(), max_size=3)
        | st.frozensets(st.tuples(TEXT, st.integers(0, 3)), max_size=3)
    ),
    max_leaves=8,
)


@settings(max_examples=400, deadline=None)
@given(value=VALUES)
def test_a_value_of_any_supported_type_arrives_as_it_was_without_annotations(value: Any) -> None:
    codec = Codec()
    raw = codec.encode(value)
    assert same(codec.decode(raw), value)
    assert codec.canonical(raw) == raw, "canonical"


@dataclass
class Holder:
    """Typed fields, and fields that may hold anything."""

    name: str
    anything: Any
    options: dict[str, Any]
    pose: Pose = Pose()
    seen: dict[int, Pose] = field(default_factory=dict[int, Pose])
    path: Path = Path()
    shape: Polygon | None = None


@settings(max_examples=150, deadline=None)
@given(
    value=VALUES, options=st.dictionaries(TEXT, VALUES, max_size=2), corners=st.lists(st.just((1.0, 2.0)), max_size=2)
)
def test_and_in_the_fields_of_a_declared_type(value: Any, options: dict[str, Any], corners: Any) -> None:
    made = Holder("a", value, options, Pose(1.5), {3: Pose(2.0), 1: Pose()}, Path("/dev/video0"), Polygon(*corners))
    codec = Codec(Holder)
    raw = codec.encode(made)
    got = codec.decode(raw)
    assert type(got) is Holder
    assert same(got.anything, value)
    assert same(got.options, options)
    assert (got.pose, got.seen, got.path, got.shape) == (made.pose, made.seen, made.path, made.shape)
    assert codec.canonical(raw) == raw


MODEL = Model(name="a", at=datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC), poses={"b": (1, 2), "a": ()})
DECLARED: list[tuple[Any, Any]] = [
    (Mode, Mode.FAST),
    (Level, Level.LOW),
    (Word, Word.A),
    (Pose, Pose(1.5)),
    (Struct, Struct("a")),
    (OpenStruct, OpenStruct("a", {"b": (1, 2)})),
    (Point, Point(1, 2)),
    (Wheel, Wheel(1.5)),
    (Model, MODEL),
    (Polygon, Polygon((1.0, 2.0))),
    (Path, Path("/dev/video0")),
    (complex, 1 + 2j),
    (range, range(1, 9, 2)),
    (np.float64, np.float64(1.5)),
    (np.ndarray, np.array([[1, 2], [3, 4]], np.uint8)),
    (npt.NDArray[np.float64], np.array([1.5])),
    (bytearray, bytearray(b"a")),
    (datetime.datetime, datetime.datetime(2026, 1, 1)),  # noqa: DTZ001 - such ones too
    (datetime.timedelta, datetime.timedelta(seconds=1.5)),
    (uuid.UUID, uuid.UUID(int=5)),
    (Decimal, Decimal("1.50")),
    (tuple[int, str], (1, "a")),
    (set[str], {"a", "b"}),
    (frozenset[int], frozenset({1})),
    (Pose | Scan, Scan("a")),
    (Pose | Scan | None, Pose(2.0)),
    (Pose | Model, MODEL),
]


@pytest.mark.parametrize(("type_", "value"), DECLARED)
def test_a_value_of_a_declared_type_arrives_as_it_was_alone_and_in_lists_and_dicts(type_: Any, value: Any) -> None:
    for declared, given_ in ((type_, value), (list[type_], [value, value]), (dict[str, type_], {"k": value})):
        codec = Codec(declared)
        raw = codec.encode(given_)
        assert same(codec.decode(raw), given_)
        assert codec.canonical(raw) == raw
    assert encode(value) == Codec(type_).canonical(encode(value)), "what consumer and provider call the same request"


NEEDS_ANNOTATION = [Mode.FAST, Level.LOW, Word.A, Pose(), Struct("a"), Point(1, 2), Wheel(1.0), MODEL]
OTHERS = [collections.OrderedDict(a=1), collections.Counter("aab"), memoryview(b"a")]


@pytest.mark.parametrize("value", [*NEEDS_ANNOTATION, *OTHERS], ids=lambda value: type(value).__name__)
def test_what_only_an_annotation_brings_back_is_refused_without_one_and_the_error_says_so(value: Any) -> None:
    name = type(value).__name__
    says = rf"got an? {name}, which only a declared type brings back: annotate .*request_type.* rr\.codec"
    for given_, path in ((value, ""), ({"parts": [1, value]}, r"\.parts\[1\]"), ((value,), r"\[0\]")):
        with pytest.raises(rr.InvalidRequest, match=rf"^s/t: request{path}: expected any plain value, {says}"):
            Codec().decode(encode(given_), "s/t")
        with pytest.raises(rr.InvalidResponse, match=f"^s/t: response{path}: .*{says}"):
            Codec().encode(given_, "s/t")


@pytest.mark.parametrize("value", [Pose(1.0), {"x": 1.0}, {"x": 1}], ids=["class", "dict", "int"])
def test_a_declared_type_decides_whatever_was_sent(value: Any) -> None:
    assert Codec(Pose).decode(encode(value)) == Pose(1.0)
    assert Codec(list[Pose]).decode(encode((value,))) == [Pose(1.0)]
    assert Codec(Pose).canonical(encode(value)) == encode(Pose(1.0))
    assert Codec(dict[str, float]).decode(encode(value)) == {"x": 1.0}


def test_a_union_names_its_classes_when_something_else_comes() -> None:
    with pytest.raises(rr.InvalidRequest, match=r"expected one of Pose, Scan, got a 'Wheel'"):
        Codec(Pose | Scan).decode(encode(Wheel(1.0)))
    with pytest.raises(rr.InvalidRequest, match=r"expected a value of one of the classes Pose, Scan, got dict"):
        Codec(Pose | Scan).decode(encode({"topic": "a"}))


@dataclass
class TwoKinds:
    part: Pose | Scan


def test_a_union_of_classes_in_a_field_is_refused_and_the_error_says_the_way_out() -> None:
    with pytest.raises(rr.NotSerializable, match=r"TwoKinds: .*msgspec Structs with a tag.*rr\.codec"):
        Codec(TwoKinds)


UNSUPPORTED: list[tuple[Any, str]] = [
    (object(), "an object of type builtins.object"),
    (collections.deque([1]), "an object of type collections.deque"),
    (np.array([object()]), "a numpy value of dtype object: pass .tolist() of it"),
    (np.datetime64("2026-01-01"), "a numpy value of dtype datetime64"),
    (np.ma.array([1]), "an object of type numpy"),
]


@pytest.mark.parametrize(("value", "says"), UNSUPPORTED)
def test_a_value_that_cannot_travel_is_refused_where_it_is_sent_and_the_error_names_the_way_out(
    value: Any, says: str
) -> None:
    with pytest.raises(
        rr.NotSerializable, match=r"request\.a: expected plain data .* with an rr\.codec, got " + re.escape(says)
    ):
        encode({"a": value})


class Shape:
    """Its codec raises, or returns what cannot be sent."""

    def __init__(self, act: Callable[[], Any]) -> None:
        self.act = act


rr.codec(Shape, lambda shape: shape.act(), lambda data: Shape(lambda: data))


@dataclass
class Drawing:
    shape: Shape


class Sealed(pydantic.BaseModel):
    name: str = "x"

    @pydantic.model_serializer
    def seal(self) -> dict[str, str]:
        raise OverflowError("the seal is broken")


def raise_error(error: Exception) -> Any:
    raise error


@pytest.mark.parametrize("around", [lambda value: {"a": value}, lambda value: {"a": Drawing(value)}])
@pytest.mark.parametrize(
    ("act", "says"),
    [
        (lambda: raise_error(ValueError("not closed")), r"raised ValueError: not closed"),
        (lambda: raise_error(TypeError("no corner")), r"raised TypeError: no corner"),
        (lambda: raise_error(OverflowError("too large")), r"raised OverflowError: too large"),
        (lambda: [object()], r"returned .*object"),
        (lambda: 1 << 70, r"returned .*64 bits|returned .*ints"),
    ],
)
def test_the_error_of_a_codecs_encode_is_in_the_refusal(around: Any, act: Any, says: str) -> None:
    words = rf"request\.a.*: .*, got a test_values\.Shape, whose rr\.codec {says}"
    with pytest.raises(rr.NotSerializable, match=words):
        encode(around(Shape(act)))


def test_the_error_of_a_models_own_code_is_in_the_refusal() -> None:
    with pytest.raises(rr.NotSerializable, match=r"request\.a: .*Sealed, whose own code raised .*the seal is broken"):
        encode({"a": Sealed()})


@pytest.mark.parametrize(
    "moment",
    [
        datetime.datetime.max.replace(tzinfo=datetime.timezone(datetime.timedelta(hours=-5))),
        datetime.datetime.min.replace(tzinfo=datetime.timezone(datetime.timedelta(hours=5))),
    ],
)
def test_a_datetime_that_has_no_year_in_utc_is_refused_as_that(moment: datetime.datetime) -> None:
    with pytest.raises(rr.NotSerializable, match=r"request\.a\[0\]: .* got a datetime whose year in UTC .* 1 to 9999"):
        encode({"a": [moment]})


class TaggedModel(pydantic.BaseModel):
    tags: set[str] = set()


class Lossy(pydantic.BaseModel):
    ratio: float
    secret: str = pydantic.Field(default="", exclude=True)


@pytest.mark.parametrize(
    "model", [TaggedModel(tags={"a", "b"}), Lossy(ratio=1.0, secret="x"), Lossy(ratio=float("inf"))]
)
def test_a_pydantic_model_that_would_not_come_back_as_it_is_is_refused(model: Any) -> None:
    with pytest.raises(rr.NotSerializable, match=f"a {type(model).__name__} .*rr.codec"):
        encode(model)


# -- between processes ---------------------------------------------------------------------------------------------


class Echo(rr.Manager):
    @rr.server("any")
    def load_any(self, request):  # type: ignore[no-untyped-def]
        return [type(request).__name__, request]

    @rr.server("either")
    def load_either(self, request: Pose | Scan) -> Pose | Scan:
        return Scan("of a pose") if isinstance(request, Pose) else Pose(2.0)

    @rr.server("model")
    def load_model(self, request: Model) -> npt.NDArray[np.float64]:
        return np.array([len(request.name)], np.float64)

    @rr.server("undeclared")
    def load_undeclared(self, request):  # type: ignore[no-untyped-def]
        return Pose(1.0)


def test_values_go_to_a_managers_process_and_back_as_they_are(start: Callable[..., rr.System]) -> None:
    app = start(rr.ChildSpec(Echo, id="echo")).open_registrar("app")

    for value in ((1, "a"), {3, 1}, datetime.date(2026, 1, 1), Path("/dev"), Polygon((1.0, 2.0)), np.array([[1, 2]])):
        name, back = app.load("echo/any", value).response
        assert name == type(value).__name__
        assert same(back, value)
        assert same(app.load("echo/any", {"in": value}).response[1], {"in": value})
    one, other = (app.load("echo/any", {"x": (1, 2), "y": value}) for value in ({3, 1, 2}, {2, 3, 1}))
    assert one.resource_id == other.resource_id, "equal requests are one resource"
    assert app.load("echo/any", (1, 2)).resource_id != app.load("echo/any", [1, 2]).resource_id
    assert app.load(Echo.load_either, Pose()).response == Scan("of a pose")
    assert app.load(Echo.load_either, Scan("a")).response == Pose(2.0)
    assert same(app.load(Echo.load_model, MODEL).response, np.array([1.0]))


def test_what_would_change_its_type_fails_the_load_and_says_why(start: Callable[..., rr.System]) -> None:
    app = start(rr.ChildSpec(Echo, id="echo")).open_registrar("app")

    with pytest.raises(rr.InvalidRequest, match=r"echo/any: request: .* got a Pose, which only a declared type brings"):
        app.load("echo/any", Pose())
    with pytest.raises(rr.LoadFailed, match=r"InvalidResponse: response: .* got a Pose, which only a declared type"):
        app.load("echo/undeclared", 1)
    assert app.queries() == []


# -- old bytes and bad bytes ---------------------------------------------------------------------------------------

OLD: list[tuple[Any, str]] = [
    (None, "c0"),
    ({"b": [1, 2.5, "é"], "a": {"z": b"\1", "c": True}}, "82a16182a163c3a17ac40101a1629301cb4004000000000000a2c3a9"),
    ({2: "b", 1: "a"}, "8201a16102a162"),
    ({(1, 2): 0, (0, 5): 1}, "8292000501920102" + "00"),
    (datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC), "d6ff6955b900"),
]


@pytest.mark.parametrize(("value", "old"), OLD)
def test_builtin_values_have_the_bytes_that_old_catalogs_have(value: Any, old: str) -> None:
    assert encode(value).hex() == old


def test_what_old_catalogs_have_of_a_declared_type_is_read() -> None:
    old = msgspec.msgpack.encode({"name": "a", "anything": [1], "options": {}, "pose": {"x": 2.0}})
    assert Codec(Holder).decode(old) == Holder("a", [1], {}, Pose(2.0))
    assert Codec(Pose).decode(msgspec.msgpack.encode(Pose(1.5))) == Pose(1.5)


EXT = msgspec.msgpack.Ext
BAD = [
    EXT(16, b""),
    EXT(16, b"\xa4Pose\xc0"),
    EXT(17, b"\xa9os.system\xa2ls"),
    EXT(16, b"\xa9os.system\xa2ls"),
    EXT(2, msgspec.msgpack.encode([[]])),
    EXT(5, msgspec.msgpack.encode("2026-99-01")),
    EXT(11, msgspec.msgpack.encode([1, 2, 0])),
    EXT(14, msgspec.msgpack.encode(["|O8", [1], b"\0" * 8])),
    EXT(14, msgspec.msgpack.encode(["<f8", [1 << 62, 1 << 62], b""])),
    EXT(14, msgspec.msgpack.encode(["<f8", [-1], b"\0" * 16])),
    EXT(15, msgspec.msgpack.encode(["<f8", b""])),
    EXT(99, b"a"),
]


@pytest.mark.parametrize("bad", BAD)
@pytest.mark.parametrize("type_", [None, Pose, Holder, Pose | Scan, Polygon, np.ndarray, Model, dict[str, Any]])
def test_damaged_extensions_are_refused_and_name_no_class_that_is_looked_up(bad: Any, type_: Any) -> None:
    codec = Codec(type_)
    for value in (bad, [bad], {"topic": bad}):
        raw = msgspec.msgpack.encode(value)
        with pytest.raises(rr.InvalidRequest, match=r"^s/t: request"):
            codec.canonical(raw, "s/t")


# -- the page ------------------------------------------------------------------------------------------------------


def rows() -> Iterator[tuple[str, str, str]]:
    """Type, example, and what happens without an annotation."""
    for line in (ROOT / "docs" / "values.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        if len(cells) == 4 and cells[0].startswith("`"):
            yield cells[0].strip("`"), cells[1].strip("`"), cells[2]


NAMES = {**globals(), "np": np, "UUID": uuid.UUID, "dt": datetime, **vars(datetime)}


@pytest.mark.parametrize(("type_", "example", "without"), list(rows()), ids=lambda cell: cell)
def test_the_table_of_types_is_true(type_: str, example: str, without: str) -> None:
    declared, value = eval(type_, dict(NAMES)), eval(example, dict(NAMES))
    assert same(Codec(declared).decode(Codec(declared).encode(value)), value)
    if without == "kept":
        assert same(Codec().decode(Codec().encode(value)), value)
    else:
        assert without == "refused"
        with pytest.raises(rr.InvalidResponse):
            Codec().encode(value)


def test_the_table_has_every_type_that_the_code_keeps() -> None:
    listed = {eval(type_, dict(NAMES)) for type_, _, without in rows() if without == "kept"}
    bare = {getattr(type_, "__origin__", type_) for type_ in listed}
    assert {kind.type for kind in KINDS} - {type(Path())} <= bare
    assert {Path, bool, int, float, str, bytes, list, dict, np.ndarray} <= bare
