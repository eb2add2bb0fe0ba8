"""Canonical bytes: what is equal, what is not, and what errors say of the part that does not fit."""

from __future__ import annotations

import datetime
import enum
import itertools
import threading
import typing
import uuid
from dataclasses import dataclass, field
from decimal import Decimal
from typing import Annotated, Any, Literal, NamedTuple, TypedDict

import attrs
import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rr_actors.base.errors import InvalidRequest, NotSerializable
from rr_actors.base.values.canonical import Codec, encode
from support_cycles import leaves_cycle


class Mode(enum.Enum):
    FAST = "fast"
    SLOW = "slow"


@dataclass(frozen=True)
class Pose:
    x: float = 0.0
    y: float = 0.0


@dataclass(frozen=True)
class OpenCamera:
    device: str
    fps: int = 30
    mode: Mode = Mode.FAST
    pose: Pose = field(default_factory=Pose)
    tags: list[str] = field(default_factory=list)
    gains: dict[str, float] = field(default_factory=dict)
    region: tuple[int, int] | None = None
    next: OpenCamera | None = None


class Scan(msgspec.Struct, frozen=True):
    topic: str
    rate: Annotated[int, msgspec.Meta(ge=1)] = 10
    kind: Literal["2d", "3d"] = "2d"


class Point(NamedTuple):
    x: int
    label: str = ""


class Options(TypedDict, total=False):
    width: typing.Required[int]
    height: int


@attrs.frozen
class Wheel:
    radius: float
    pose: Pose = attrs.field(factory=Pose)


class Red(msgspec.Struct, tag=True):
    level: int


class Blue(msgspec.Struct, tag=True):
    depth: int


VALUES: list[tuple[Any, Any]] = [
    (OpenCamera, OpenCamera("/dev/video0", region=(1, 2), next=OpenCamera("b", gains={"r": 1.5}))),
    (Scan, Scan("scan", kind="3d")),
    (Point, Point(3, "c")),
    (Options, {"width": 3}),
    (Wheel, Wheel(0.5)),
    (Red | Blue, Blue(3)),
    (list[Pose], [Pose(1.0), Pose(2.0)]),
    (dict[int, str], {3: "c", 1: "a"}),
    (set[int], {5, 3, 4}),
    (int | str | None, None),
    (bytes, b"\0\xff"),
    (datetime.datetime, datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)),
    (uuid.UUID, uuid.UUID(int=5)),
    (Decimal, Decimal("1.50")),
    (None, {"a": [1, 2.5, None, True, "é", b"\1"], "b": {"c": {}}}),
]
PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False)
    | st.text(st.characters(exclude_categories=["Cs"]))
    | st.binary(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(st.characters(exclude_categories=["Cs"])), inner),
    max_leaves=10,
)


# -- equal and different -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("type_", "value"), VALUES)
def test_a_value_comes_back_as_it_was(type_: Any, value: Any) -> None:
    codec, raw = Codec(type_), encode(value)
    assert codec.decode(raw) == value
    assert type(codec.decode(raw)) is type(value)
    assert codec.canonical(raw) == raw


@given(value=PLAIN)
def test_any_plain_value_comes_back_as_it_was_without_a_type(value: Any) -> None:
    raw = encode(value)
    assert Codec().decode(raw) == value
    assert Codec().canonical(raw) == raw


@settings(max_examples=40)
@given(items=st.dictionaries(st.text(st.characters(exclude_categories=["Cs"])), PLAIN, max_size=4), data=st.data())
def test_the_order_of_a_dict_does_not_matter(items: dict[str, Any], data: st.DataObject) -> None:
    shuffled = dict(data.draw(st.permutations(list(items.items()))))
    assert encode(shuffled) == encode(items)
    assert encode([{1: shuffled}]) == encode([{1: items}])


@pytest.mark.parametrize("keys", [(2, 1, 3), (0.5, 1, 1.5), ((1, 2), (0, 5)), ("b", "a")])
def test_nor_does_it_when_its_keys_are_not_strings(keys: tuple[Any, ...]) -> None:
    made = {encode({"outer": {key: str(key) for key in order}}) for order in itertools.permutations(keys)}
    assert len(made) == 1


def test_nor_do_the_order_of_a_set_and_of_a_types_fields() -> None:
    assert encode({"b", "a", "c"}) == encode({"c", "a", "b"})
    assert encode({"fps": 30, "device": "a"}) == encode({"device": "a", "fps": 30})
    assert Codec(set[int]).canonical(encode([3, 1, 2, 3])) == encode({1, 2, 3})


def test_what_means_the_same_to_a_typed_server_is_the_same_request() -> None:
    codec = Codec(OpenCamera)
    whole = encode(OpenCamera("a", pose=Pose(1.0, 0.0)))
    assert codec.canonical(encode({"device": "a", "pose": {"x": 1}})) == whole
    assert codec.canonical(encode({"pose": {"y": 0, "x": 1.0}, "fps": 30, "device": "a"})) == whole
    assert codec.canonical(msgspec.msgpack.encode(OpenCamera("a", pose=Pose(1.0)))) == whole, "of another order"
    assert Codec(Scan).canonical(encode({"topic": "t"})) == encode(Scan("t"))


@dataclass(slots=True)
class Slotted:
    level: int = 3


@dataclass
class Derived(Slotted):
    depth: int = 4
    inner: Pose = Pose(2.0)


@pytest.mark.parametrize("type_", [Slotted, Derived, Wheel, Point, Scan, OpenCamera])
def test_a_request_that_was_decoded_is_the_same_request_when_it_is_passed_on(type_: Any) -> None:
    given = {Wheel: {"radius": 1.0}, Point: [1], Scan: {"topic": "t"}, OpenCamera: {"device": "a"}}.get(type_, {})
    made = type_(*given.values()) if isinstance(given, dict) else type_(*given)
    assert encode(Codec(type_).decode(encode(given))) == encode(made)
    nested = Codec(dict[str, list[type_]]).decode(encode({"a": [given]}))
    assert encode(nested) == encode({"a": [made]})


def test_what_differs_is_another_request() -> None:
    requests = [
        OpenCamera("a"),
        OpenCamera("b"),
        OpenCamera("a", fps=31),
        OpenCamera("a", tags=["x"]),
        {},
        [],
        None,
        "",
    ]
    requests += [0, False, [0], [[0]], {"a": 0}, {"a": None}]
    assert len({encode(request) for request in requests}) == len(requests)


# -- values that are not plain data --------------------------------------------------------------------------------


class Camera:
    pass


def nested(depth: int) -> list[Any]:
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


def cyclic() -> dict[str, Any]:
    value: dict[str, Any] = {"name": "a", "parts": [{}]}
    value["parts"][0]["whole"] = value
    return value


@dataclass
class Job:
    name: str
    run: Any


class Loose(msgspec.Struct, frozen=True):
    name: str
    value: Any = None


def test_a_struct_may_have_a_field_of_any_type() -> None:
    for value in (None, {"parts": [1, "two"]}):
        assert Codec(Loose).decode(encode(Loose("outer", value))) == Loose("outer", value)


NOT_PLAIN: list[tuple[Any, str, str]] = [
    (Camera(), "request", "an object of type test_canonical.Camera"),
    ({"options": [1, 2, {"callback": encode}]}, "request.options[2].callback", "a function (encode)"),
    (Job("a", lambda: 1), "request.run", "a function (<lambda>)"),
    (Job("a", [threading.Lock()]), "request.run[0]", "an object of type _thread.lock"),
    (Red(level=Camera()), "request.level", "an object of type test_canonical.Camera"),  # type: ignore[arg-type]
    (Point(3, Camera()), "request.label", "an object of type test_canonical.Camera"),  # type: ignore[arg-type]
    (Wheel(Camera()), "request.radius", "an object of type test_canonical.Camera"),  # type: ignore[arg-type]
    ({"my key": Camera}, "request['my key']", "the class Camera"),
    ({"a": {Camera: 1}}, f"request.a: key {Camera!r}", "the class Camera"),
    ({"a": [2**70]}, "request.a[0]", "an integer of more than 64 bits"),
    ({"a": "\ud800"}, "request.a", "a string with a lone surrogate"),
    ({"a": {1: 1, "b": 2}}, "request.a", "a dict whose keys cannot be put in order"),
    ({"a": {1, "b"}}, "request.a", "a set whose items cannot be put in order"),
    (cyclic(), "request.parts[0].whole", "a dict that contains itself"),
    (nested(100_000), "request", "one that is nested too deeply"),
]


@pytest.mark.parametrize(("value", "path", "got"), NOT_PLAIN)
def test_a_value_that_is_not_plain_is_refused_with_the_path_of_the_part(value: Any, path: str, got: str) -> None:
    with pytest.raises(NotSerializable) as caught:
        encode(value)
    assert str(caught.value).startswith(f"{path}: expected plain data (")
    assert str(caught.value).endswith(f", got {got}")
    assert caught.value.details["path"] == path


def test_the_path_begins_with_what_it_is() -> None:
    with pytest.raises(NotSerializable, match=r"^response\.topic: "):
        encode({"topic": Camera()}, what="response")


# -- bytes that do not fit -----------------------------------------------------------------------------------------

MISFITS: list[tuple[Any, Any, str, str, str]] = [
    (OpenCamera, {"device": "a", "fps": "30"}, "request.fps", "int", "str"),
    (OpenCamera, {"device": 3}, "request.device", "str", "int"),
    (OpenCamera, {}, "request.device", "str", "nothing"),
    (OpenCamera, {"device": "a", "mode": "idle"}, "request.mode", "one of 'fast', 'slow'", "one it refuses"),
    (OpenCamera, {"device": "a", "tags": ["b", 3]}, "request.tags[1]", "str", "int"),
    (OpenCamera, {"device": "a", "gains": {"r": "x"}}, "request.gains[...]", "float", "str"),
    (OpenCamera, {"device": "a", "region": [1]}, "request.region", "tuple[int, int] | None of length 2", "1"),
    (OpenCamera, {"device": "a", "region": [1, None]}, "request.region[1]", "int", "None"),
    (OpenCamera, {"device": "a", "pose": [1, 2]}, "request.pose", "Pose", "a list"),
    (OpenCamera, {"device": "a", "next": {"device": "b", "fps": 1.5}}, "request.next.fps", "int", "float"),
    (OpenCamera, "camera", "request", "OpenCamera", "str"),
    (OpenCamera, None, "request", "OpenCamera", "None"),
    (Scan, {"topic": "t", "rate": 0}, "request.rate", "int >= 1", "one that is not"),
    (Scan, {"topic": "t", "kind": "4d"}, "request.kind", "one of '2d', '3d'", "one it refuses"),
    (Point, {"x": 1}, "request", "Point", "a dict"),
    (Point, ["1"], "request[0]", "int", "str"),
    (Options, {"height": 1}, "request.width", "int", "nothing"),
    (Wheel, {"radius": "big"}, "request.radius", "float", "str"),
    (dict[int, str], {"a": "b"}, "request (a key)", "int", "str"),
    (list[int], {"a": 1}, "request", "list[int]", "a dict"),
    (int | None, "x", "request", "int | None", "str"),
]


@pytest.mark.parametrize(("type_", "value", "path", "expected", "got"), MISFITS)
def test_a_request_of_the_wrong_type_is_refused_naming_server_field_and_type(
    type_: Any, value: Any, path: str, expected: str, got: str
) -> None:
    codec = Codec(type_)
    for read in (codec.decode, codec.canonical):
        with pytest.raises(InvalidRequest) as caught:
            read(encode(value), "cameras/camera")
        assert str(caught.value).startswith(f"cameras/camera: {path}: expected {expected}, got {got}")
        details = caught.value.details
        assert (details["server"], details["path"], details["expected"]) == ("cameras/camera", path, expected)


UNKNOWN: list[tuple[Any, Any, str, str]] = [
    (OpenCamera, {"device": "a", "fsp": 10}, "request", "the unknown field 'fsp'; did you mean 'fps'?"),
    (OpenCamera, {"device": "a", "pose": {"z": 1.0}}, "request.pose", "the unknown field 'z'"),
    (OpenCamera, {"device": "a", "next": {"device": "b", "colour": 1}}, "request.next", "the unknown field 'colour'"),
    (Scan, {"topic": "t", "Topic": "t"}, "request", "the unknown field 'Topic'; did you mean 'topic'?"),
    (Options, {"width": 1, "hight": 2}, "request", "the unknown field 'hight'; did you mean 'height'?"),
    (Wheel, {"radius": 1, "r": 2}, "request", "the unknown field 'r'"),
    (list[Pose], [{}, {"q": 1}], "request[1]", "the unknown field 'q'"),
    (dict[str, Pose], {"a": {"q": 1}}, "request['a']", "the unknown field 'q'"),
]


@pytest.mark.parametrize(("type_", "value", "path", "got"), UNKNOWN)
def test_a_field_that_the_type_has_not_is_refused_with_the_nearest_that_it_has(
    type_: Any, value: Any, path: str, got: str
) -> None:
    with pytest.raises(InvalidRequest) as caught:
        Codec(type_).canonical(encode(value), "cameras/camera")
    assert str(caught.value).startswith(f"cameras/camera: {path}: expected fields ")
    assert str(caught.value).endswith(f", got {got}")


def test_the_tag_of_a_tagged_struct_is_not_an_unknown_field() -> None:
    assert Codec(Red).canonical(encode({"type": "Red", "level": 3})) == encode(Red(3))
    assert Codec(Red | Blue).canonical(msgspec.msgpack.encode({"level": 3, "type": "Red"})) == encode(Red(3))


@dataclass
class Positive:
    n: int

    def __post_init__(self) -> None:
        if self.n < 0:
            raise ValueError("n must not be negative")
        if self.n == 13:
            raise KeyError("unlucky")


@pytest.mark.parametrize(("n", "says"), [(-1, "n must not be negative"), (13, "KeyError: 'unlucky'")])
def test_a_request_that_its_own_type_refuses_is_an_invalid_request(n: int, says: str) -> None:
    with pytest.raises(InvalidRequest, match=f"s/t: request: expected Positive, got one it refuses: {says}"):
        Codec(Positive).decode(encode({"n": n}), "s/t")


GARBAGE = [
    b"",
    b"\xc1",
    b"\xa1\xff",
    b"\x91" * 5000,
    b"\x01\x02",
    b"\xc7\x01\xff\x00",
    b"\x81\x80\x01",
    b"\xdd" + b"\xff" * 4,
]


@pytest.mark.parametrize("raw", GARBAGE)
@pytest.mark.parametrize("type_", [None, OpenCamera])
def test_bytes_that_are_no_messagepack_are_an_invalid_request(raw: bytes, type_: Any) -> None:
    with pytest.raises(InvalidRequest, match=r"^s/t: request( \(a key\))?: expected "):
        Codec(type_).decode(raw, "s/t")


@pytest.mark.parametrize("depth", [300, 3000, 100_000])
@pytest.mark.parametrize("type_", [None, Any, list[Any], OpenCamera])
def test_bytes_nested_deeply_are_canonical_or_an_invalid_request(type_: Any, depth: int) -> None:
    lists = b"\xdc\x00\x01" * depth + b"\x01"  # each in a longer form than it needs
    cameras = b"\x82\xa6device\xa1a\xa4next" * depth + b"\x81\xa6device\xa1a"
    codec = Codec(type_)
    try:
        canonical = codec.canonical(cameras if type_ is OpenCamera else lists)
    except (InvalidRequest, NotSerializable):
        return
    assert codec.canonical(canonical) == canonical


def test_bytes_of_a_dict_without_an_order_are_refused_naming_the_server() -> None:
    with pytest.raises(
        NotSerializable, match=r"^s/t: request: expected .*, got a dict whose keys cannot be put in ord"
    ):
        Codec().canonical(msgspec.msgpack.encode({"x": 1, 2: 3}), "s/t")


@given(raw=st.binary(max_size=60))
def test_any_bytes_decode_or_are_an_invalid_request(raw: bytes) -> None:
    for codec in (Codec(), Codec(OpenCamera), Codec(Point), Codec(dict[int, str])):
        try:
            codec.canonical(raw)
        except (InvalidRequest, NotSerializable):
            continue


# -- types ---------------------------------------------------------------------------------------------------------


@dataclass
class Unresolved:
    scan: NoSuchType  # type: ignore[name-defined]  # noqa: F821


@dataclass
class WithLock:
    lock: threading.Thread


@attrs.frozen
class WithPrivate:
    _level: int = 3


@dataclass
class EitherInAField:
    part: OpenCamera | Pose


BAD_TYPES: list[tuple[Any, str]] = [
    (Unresolved, "request type Unresolved: name 'NoSuchType' is not defined"),
    (WithLock, "request type WithLock.lock: expected plain data"),
    (list[Camera], "request type list[Camera]: expected plain data"),
    (list[WithPrivate], "request type list[WithPrivate]._level: msgspec leaves out private fields"),
    (EitherInAField, "may not contain more than one dataclass"),
    (3, "request type 3: "),
    ((), "request type (): "),
]


@pytest.mark.parametrize(("type_", "says"), BAD_TYPES)
def test_a_type_that_no_plain_data_can_be_of_is_refused_when_the_codec_is_made(type_: Any, says: str) -> None:
    with pytest.raises(NotSerializable) as caught:
        Codec(type_)
    assert says in str(caught.value)


@pytest.mark.parametrize("type_", [Any, object, None, type(None)])
def test_any_object_and_none_are_types_too(type_: Any) -> None:
    assert Codec(type_).decode(encode(None)) is None


def test_a_value_that_names_classes_within_its_type_leaves_nothing_to_the_collector() -> None:
    codec = Codec(dict[str, Pose])
    raw = encode({"base": Pose(1.0)})
    assert codec.decode(raw) == {"base": Pose(1.0)}
    assert not leaves_cycle(lambda: codec.decode(raw))
    assert not leaves_cycle(lambda: Codec(None).show(raw))
