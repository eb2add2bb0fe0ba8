"""What travels between processes, code included, and what errors say of the part that cannot."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import dataclasses
import errno
import functools
import io
import multiprocessing
import pickle
import queue
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import cloudpickle
import pykka
import pytest

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base.errors import InvalidRequest, InvalidSpec, NotSerializable
from rr_actors.base.pickling import LARGE_BYTES, Large, dumps, dumps_large, loads
from rr_actors.base.values.canonical import Codec, encode

ROOT = Path(__file__).parents[2]

# A user's script: types in __main__, annotations that are text, msgspec has looked at them. It sends them to a process
# that has never heard of them, which uses them and sends them back.
SCRIPT = '''
from __future__ import annotations
import enum, functools, subprocess, sys, typing
from dataclasses import dataclass, field
import attrs, msgspec
from rr_actors.base.values.canonical import Codec, encode
from rr_actors.base.pickling import dumps, loads
from rr_actors.base.values.canonical import Codec, encode

T = typing.TypeVar("T")
LIMIT = 5

class Mode(enum.Enum):
    FAST = "fast"
    SLOW = "slow"

@dataclass(frozen=True)
class Device:
    path: str
    mode: Mode = Mode.FAST

@dataclass(frozen=True, slots=True)
class Camera:
    device: Device
    fps: int = 30
    tags: list[str] = field(default_factory=list)
    second: Camera | None = None

class Scan(msgspec.Struct, kw_only=True, frozen=True, rename="camel", tag="scan"):
    of_device: Device
    ranges: list[float] = []
    second: Scan | None = None
    KIND: typing.ClassVar[str] = "2d"

    def __post_init__(self):
        if len(self.ranges) > LIMIT:
            raise ValueError("too many ranges")

    def own_class(self):
        return __class__

class Scan3d(Scan):
    layers: int = 4

    def __post_init__(self):
        super().__post_init__()
        if self.layers > LIMIT:
            raise ValueError("too many layers")

class Point(typing.NamedTuple):
    x: int
    device: Device = Device("/")

class Options(typing.TypedDict, total=False):
    width: typing.Required[int]
    device: Device

@attrs.frozen
class Wheel:
    radius: float
    device: Device

@dataclass
class Box(typing.Generic[T]):
    content: T

@dataclass
class Node:
    above: typing.Optional["Node"] = None
    below: list["Node"] = field(default_factory=list)
    kind: typing.Literal["Node"] = "Node"

Nodes = typing.TypedDict("Nodes", {"roots": typing.List["Node"]})
Count = typing.Annotated[int, msgspec.Meta(ge=1, le=LIMIT, title="Node")]

class Bounded(msgspec.Struct, frozen=True):
    count: Count
    name: typing.Annotated[str, msgspec.Meta(pattern="^[a-z]+$", extra={"key": "Node"})] = "a"

class Manager:
    served = 0

    def load(self, request: Camera) -> Scan:
        return Scan(of_device=request.device)

    def limit(self):
        return LIMIT

device = Device("/dev/video0")
TYPES = [Camera, Scan, Scan3d, Point, Options, Wheel, Box[Device], Node, Nodes, Count, Bounded]
VALUES = [
    Camera(device, second=Camera(Device("b", Mode.SLOW))),
    Scan(of_device=device, second=Scan(of_device=device)),
    Scan3d(of_device=device, layers=5),
    Point(3),
    {"width": 3, "device": device},
    Wheel(0.5, device),
    Box(device),
    Node(Node(), [Node(), Node(below=[Node()])]),
    {"roots": [Node()]},
    5,
    Bounded(1),
]
RAW = [Codec(type_).canonical(encode(value)) for type_, value in zip(TYPES, VALUES)]  # leaves msgspec's caches

CHILD = """
import sys, typing
from rr_actors.base.values.canonical import Codec, encode
from rr_actors.base.pickling import dumps, loads
from rr_actors.base.values.canonical import Codec, encode
blob = sys.stdin.buffer.read()
types, values, raws, manager, load, make = loads(blob)
for type_, again, value, raw in zip(types, loads(blob)[0], values, raws):
    assert type_ == again and hash(type_) == hash(again)
    assert encode(value) == raw
    assert Codec(type_).decode(raw) == value
    assert Codec(type_).canonical(raw) == raw
camera, scan, scan3d = types[:3]
assert type(values[0]) is camera and type(values[1]) is scan and scan3d.__mro__[1] is scan
assert values[1].own_class() is scan and scan.KIND == "2d"
for too_much in ({"ranges": [1.0] * 6}, {"layers": 6}):
    try:
        scan3d(of_device=values[0].device, **too_much)
    except ValueError as error:
        assert "too many" in str(error)
    else:
        raise AssertionError(too_much)
for bounded, value in (types[-2], 0), (types[-1], {"count": 6}), (types[-1], {"count": 1, "name": "A"}):
    try:
        Codec(bounded).decode(encode(value))
    except ValueError as error:
        raise AssertionError(value) from error
    except TypeError as error:
        assert "expected" in str(error)
    else:
        raise AssertionError(value)
assert typing.get_type_hints(type(manager).load) == {"request": camera, "return": scan}
assert typing.get_type_hints(load.func) == {"request": camera, "return": scan}
assert isinstance(load(values[0]), scan) and manager.limit() == 5
sys.stdout.buffer.write(dumps((types, values, raws, manager, load, make("made there"))))
"""

if __name__ == "__main__":
    manager = Manager()
    sent = (TYPES, VALUES, RAW, manager, functools.partial(Manager.load, manager), lambda path: Device(path))
    blob = dumps(sent, "everything")
    Manager.served = 7
    LIMIT = 6
    method = Manager.load
    child = subprocess.run([sys.executable, "-c", CHILD], input=blob, stdout=subprocess.PIPE, check=True)
    types, values, raws, manager, load, made = loads(child.stdout)
    for mine, back in zip(TYPES, types):
        assert mine is back or mine == back
    assert values == VALUES and raws == RAW and [type(value) for value in values] == [type(value) for value in VALUES]
    assert type(made) is Device and made == Device("made there") and values[0].device.mode is Mode.FAST
    assert type(manager) is Manager and Manager.served == 7 and Manager.load is method and manager.limit() == 6
    Codec(Camera).decode(RAW[0])
    print("good")
'''


def test_everything_of_a_users_main_travels_to_a_process_that_knows_nothing_of_it_and_back(tmp_path: Path) -> None:
    script = tmp_path / "robot.py"
    script.write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, script], env={"PYTHONPATH": str(ROOT)}, capture_output=True, text=True, check=False
    )
    assert (done.stdout, done.stderr) == ("good\n", "")


def test_a_field_without_a_default_has_none_where_its_class_arrives() -> None:
    home = (
        "from dataclasses import dataclass\n"
        "@dataclass\nclass Camera:\n    device: str\n    fps: int = 30\n"
        "sys.stdout.buffer.write(dumps(Camera))"
    )
    code = f"import sys\nfrom rr_actors.base.pickling import dumps\n{home}"
    camera = loads(subprocess.run([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, check=True).stdout)
    device, fps = dataclasses.fields(camera)
    assert device.default is dataclasses.MISSING
    assert fps.default_factory is dataclasses.MISSING
    with pytest.raises(InvalidRequest, match=r"device: expected str, got nothing"):
        Codec(camera).canonical(encode({"fps": 3}))


def test_what_is_made_in_a_function_travels_too() -> None:
    class Local:
        def __init__(self, factor: int) -> None:
            self.factor = factor

        def times(self, n: int) -> int:
            return self.factor * n

    blob = dumps((Local(3), lambda x: Local(x).times(2)))
    local, function = loads(blob)
    assert type(local) is Local
    assert (local.times(2), function(5)) == (6, 10)


def test_code_keeps_the_name_of_its_file_and_its_lines() -> None:
    def outer() -> Callable[[], int]:
        return lambda: 1 // 0

    there = loads(dumps(outer))
    assert there.__code__ is not outer.__code__
    assert there.__code__ == outer.__code__  # but for the file's name, which it does not compare
    for code in (there.__code__, there().__code__):
        assert code.co_filename == __file__


def test_a_class_that_comes_back_is_left_as_it_is_at_home() -> None:
    class Counter:
        count = 1

    blob = dumps(Counter)
    Counter.count = 2
    assert loads(blob) is Counter
    assert Counter.count == 2


def test_a_class_that_arrived_takes_the_newer_state_that_arrives_later(tmp_path: Path) -> None:
    home = "class Counter: count = 1\nfirst = dumps(Counter)\nCounter.count = 2\nsecond = dumps(Counter)\n"
    code = (
        f"import sys\nfrom rr_actors.base.pickling import dumps\n{home}sys.stdout.buffer.write(dumps((first, second)))"
    )
    sent = subprocess.run([sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, check=True).stdout
    first, second = loads(sent)
    counter = loads(first)
    assert counter.count == 1
    assert dumps(counter) != b"", "passed on meanwhile: it is not at home here for that"
    assert loads(second) is counter
    assert counter.count == 2


@pytest.mark.parametrize(
    "value", [None, 1, 1.5, "text", b"bytes", [1, (2, 3)], {"a": {1, 2}}, Path("a"), ValueError("x")]
)
def test_plain_values_are_pickled_plainly(value: Any) -> None:
    assert dumps(value) == pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
    assert repr(loads(dumps(value))) == repr(value)


def test_text_that_speaks_of_main_is_only_text() -> None:
    assert loads(dumps("__main__")) == "__main__"


def test_a_module_registered_to_travel_by_value_does() -> None:
    import support

    cloudpickle.register_pickle_by_value(support)
    try:
        assert b"_make_skeleton_class" in dumps(support.Calls)
    finally:
        cloudpickle.unregister_pickle_by_value(support)
    assert b"_make_skeleton_class" not in dumps(support.Calls)


# -- what cannot travel --------------------------------------------------------------------------------------------

LOCK = threading.Lock()


def closure() -> Any:
    lock = threading.Lock()
    return lambda request: lock


class Holder:
    def __init__(self) -> None:
        self.parts = {"a": [1, LOCK]}

    def load(self, request: object) -> None:
        """A callback that takes the whole object along."""


class Slotted:
    __slots__ = ("lock",)

    def __init__(self) -> None:
        self.lock = LOCK


class Stubborn:
    def __reduce__(self) -> Any:
        raise RuntimeError("not me")


def local_class() -> Any:
    class Local:
        lock = LOCK

    return Local


def nested(depth: int) -> list[Any]:
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


def cyclic() -> Any:
    value: dict[str, Any] = {}
    value["self"] = [value, LOCK]
    return value


LOCKED = "cannot pickle '_thread.lock' object"
CANNOT: list[tuple[Any, str, str]] = [
    (closure(), "load callback: closure variable 'lock'", LOCKED),
    (local_class(), "load callback: attribute 'lock'", LOCKED),
    (Holder(), "load callback: attribute 'parts': item 'a': item 1", LOCKED),
    (Holder().load, "load callback: its object: attribute 'parts': item 'a': item 1", LOCKED),
    (functools.partial(print, 1, LOCK), "load callback: argument 1", LOCKED),
    (functools.partial(print, sep=closure()), "load callback: argument 'sep': closure variable 'lock'", LOCKED),
    (lambda lock=LOCK: lock, "load callback: a default", LOCKED),
    ((1, {2}, {3: LOCK}), "load callback: item 2: item 3", LOCKED),
    (Slotted(), "load callback: attribute 'lock'", LOCKED),
    (LOCK, "load callback", LOCKED),
    ([Stubborn()], "load callback: item 0", "RuntimeError: not me"),
    ((n for n in [1]), "load callback", "cannot pickle 'generator' object"),
    (cyclic(), "load callback: item 'self': item 1", LOCKED),
    (nested(100_000), "load callback", "nested too deeply"),
]


@pytest.mark.parametrize(("value", "path", "problem"), CANNOT)
def test_what_cannot_travel_is_refused_with_the_path_of_the_part(value: Any, path: str, problem: str) -> None:
    with pytest.raises(NotSerializable) as caught:
        dumps(value, "load callback")
    assert str(caught.value).startswith(f"{path}: {problem}; ")
    assert caught.value.details["path"] == path
    assert caught.value.__cause__ is not None


class Task(multiprocessing.Process):
    """A class of somebody's own on an immovable one."""


class Taught(threading.Thread):
    """One that knows how to travel."""

    def __reduce__(self) -> tuple[Any, ...]:
        return Taught, ()


@contextlib.contextmanager
def opened(name: str) -> Iterator[Any]:
    """An immovable object."""
    with contextlib.ExitStack() as stack:
        one, other = multiprocessing.Pipe()
        stack.enter_context(one)
        stack.enter_context(other)
        match name:
            case "multiprocessing.connection.Connection":
                yield one
            case "multiprocessing.queues.Queue":
                queued: Any = multiprocessing.Queue()
                yield queued
                queued.close()
                queued.join_thread()
            case "_io.TextIOWrapper" | "_io.BufferedReader":
                yield stack.enter_context(Path(__file__).open("r" if "Text" in name else "rb"))
            case "socket.socket":
                yield stack.enter_context(socket.socket())
            case "pykka._ref.ActorRef" | "test_pickling.Plain":
                ref = Plain.start()
                stack.callback(ref.stop)
                yield ref if "Ref" in name else Plain.started
            case _:
                yield IMMOVABLE[name]()


class Plain(pykka.ThreadingActor):
    """An actor of Pykka's; `started` is the newest."""

    started: Plain

    def __init__(self) -> None:
        super().__init__()
        Plain.started = self


IMMOVABLE: dict[str, Callable[[], Any]] = {
    "multiprocessing.synchronize.Lock": multiprocessing.Lock,
    "multiprocessing.synchronize.Event": multiprocessing.Event,
    "multiprocessing.sharedctypes.Synchronized": lambda: multiprocessing.Value("i", 1),
    "test_pickling.Task": Task,
    "threading.Event": threading.Event,
    "queue.Queue": queue.Queue,
    "asyncio.locks.Event": asyncio.Event,
    "asyncio.queues.Queue": asyncio.Queue,
    "concurrent.futures._base.Future": concurrent.futures.Future,
    "pykka._threading.ThreadingFuture": pykka.ThreadingFuture,
    "rr_actors.actors.messaging.futures.Reply": Reply,
}
HINTS = {
    "multiprocessing.connection.Connection": "pass the reference of an actor",
    "multiprocessing.queues.Queue": "an actor's mailbox is the queue",
    "_io.TextIOWrapper": "send the path",
    "_io.BufferedReader": "send the path",
    "socket.socket": "open it there",
    "pykka._ref.ActorRef": "derive the actor from rr_actors.Actor",
    "test_pickling.Plain": "send its reference",
    "multiprocessing.synchronize.Lock": "ask that actor",
    "multiprocessing.sharedctypes.Synchronized": "one actor own the value",
    "test_pickling.Task": "ChildSpec",
    "rr_actors.actors.messaging.futures.Reply": "send its result",
}


@pytest.mark.parametrize("name", sorted({*IMMOVABLE, *HINTS}))
def test_what_belongs_to_its_process_is_refused_by_name_with_what_to_use_instead(name: str) -> None:
    with opened(name) as thing, pytest.raises(NotSerializable) as caught:
        dumps({"part": [1, thing]}, "message to root/a")
    text = str(caught.value)
    assert text.startswith(f"message to root/a: item 'part': item 1: cannot pickle {name!r} object; ")
    assert "it cannot leave its process: " in text
    assert HINTS.get(name, "") in text


def test_what_looks_like_it_and_can_travel_does() -> None:
    assert loads(dumps(io.StringIO("text"))).read() == "text"
    assert loads(dumps(io.BytesIO(b"bytes"))).read() == b"bytes"
    assert isinstance(loads(dumps(Taught())), Taught)
    assert loads(dumps(lambda: sys.stdout))() is sys.stdout
    assert (
        loads(dumps("multiprocessing.connection and asyncio.locks")) == "multiprocessing.connection and asyncio.locks"
    )


class Odd(Exception):
    """Its args are not what its __init__ takes."""

    def __init__(self, *, device: str, code: int) -> None:
        super().__init__(f"{device} failed")
        self.device = device
        self.code = code

    def __str__(self) -> str:
        return f"{self.device}: code {self.code}"


class OddOs(OSError):
    """One on an exception with fields of its own."""

    def __init__(self, code: int) -> None:
        super().__init__(code, "no such device", "/dev/x")


class ByItself(Exception):
    """One that knows how to travel."""

    def __init__(self, *, device: str) -> None:
        super().__init__()
        self.device = device
        self.made_by = "init"

    def __reduce__(self) -> tuple[Any, ...]:
        return functools.partial(ByItself, device=self.device), ()


class CannotReduce(ByItself):
    """One whose own code fails when it is to travel."""

    def __reduce__(self) -> tuple[Any, ...]:
        raise RuntimeError("not me")

    def __str__(self) -> str:
        return f"{self.device} jams"


class WithoutTruth(ByItself):
    """One that is asked for its truth, and fails."""

    def __reduce__(self) -> tuple[Any, ...]:
        return functools.partial(WithoutTruth, device=self.device), ()

    def __bool__(self) -> bool:
        raise RuntimeError("neither")


class Fragile(Exception):
    """Its text is made of what cannot travel."""

    def __str__(self) -> str:
        return f"locked: {type(self.lock).__name__}"

    def __init__(self) -> None:
        super().__init__()
        self.lock = threading.Lock()


def test_an_exception_arrives_as_its_own_class_with_text_attributes_notes_and_cause() -> None:
    error = Odd(device="arm", code=3)
    error.add_note("look at the arm")
    error.__cause__ = OddOs(errno.ENODEV)
    for _ in range(2):  # and travels on
        error = loads(dumps(error))
        assert type(error) is Odd
        assert (str(error), error.device, error.code, error.args) == ("arm: code 3", "arm", 3, ("arm failed",))
        assert error.__notes__ == ["look at the arm"]
        cause = error.__cause__
        assert type(cause) is OddOs
        assert (cause.errno, cause.strerror, cause.filename) == (errno.ENODEV, "no such device", "/dev/x")


def test_an_exception_that_reduces_itself_is_made_as_it_says() -> None:
    error = ByItself(device="arm")
    error.add_note("look")
    made = loads(dumps(error))
    assert (type(made), made.device, made.made_by, made.__notes__) == (ByItself, "arm", "init", ["look"])


def test_an_exception_whose_own_way_to_travel_fails_arrives_in_parts() -> None:
    made: Any = CannotReduce(device="arm")
    for _ in range(2):
        made = loads(dumps([made]))[0]
        assert type(made).__name__ == "CannotReduce"
        assert isinstance(made, CannotReduce)
        assert (str(made), made.device) == ("arm jams", "arm")


def test_the_truth_of_an_exception_is_not_asked_for() -> None:
    made = loads(dumps(WithoutTruth(device="arm")))
    assert (type(made), made.device, made.made_by) == (WithoutTruth, "arm", "init")


def test_a_group_of_exceptions_arrives_with_all_of_them() -> None:
    made = loads(dumps(ExceptionGroup("both", [Odd(device="a", code=1), ValueError("b")])))
    assert [type(each) for each in made.exceptions] == [Odd, ValueError]
    assert made.exceptions[0].code == 1


def test_an_exception_with_a_part_that_cannot_travel_arrives_with_its_text_and_is_caught() -> None:
    made: Any = Fragile()
    for _ in range(2):
        made = loads(dumps(made))
        assert isinstance(made, Fragile)
        assert str(made) == "locked: lock"
        assert type(made).__name__ == "Fragile"
    made = loads(dumps(ValueError("kept", threading.Lock())))
    assert type(made) is ValueError
    assert made.args[0] == "kept"


def test_an_error_of_this_package_with_a_detail_that_cannot_travel_arrives_with_the_others() -> None:
    made: Any = InvalidSpec("wrong", field="load", expected="a callable", got=threading.Lock())
    for _ in range(2):
        made = loads(dumps(made))
        assert (type(made), made.field, made.details["expected"]) == (InvalidSpec, "load", "a callable")
        assert "lock" in made.details["got"]


def test_an_exception_whose_class_is_unknown_there_is_caught_as_its_base(tmp_path: Path) -> None:
    (tmp_path / "elsewhere.py").write_text(
        "class Jammed(LookupError):\n    def __init__(self, *, n):\n        super().__init__(f'{n} jams')\n"
        "        self.n = n\n"
    )
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); import elsewhere; from rr_actors.base.pickling import dumps\n"
        "sys.stdout.buffer.write(dumps(elsewhere.Jammed(n=2)))"
    )
    blob = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=True, capture_output=True).stdout
    error = loads(blob)
    assert isinstance(error, LookupError)
    assert (type(error).__name__, str(error), vars(error)["n"]) == ("Jammed", "2 jams", 2)


def test_an_exception_that_contains_itself_travels() -> None:
    error = Odd(device="arm", code=1)
    error.own = [error]  # type: ignore[attr-defined]
    made = loads(dumps(error))
    assert str(made) == "arm: code 1"
    assert "its own part" in str(made.own[0])


def test_an_annotation_that_cannot_travel_remains_text() -> None:
    code = (
        "from __future__ import annotations\nimport threading\nfrom rr_actors.base.pickling import dumps, loads\n"
        "class Driver: lock = threading.Lock()\nclass Request: pass\n"
        "def load(request: Request, driver: Driver, other: Unknown): return 3\n"
        "def unload(request: Request, other: Unknown): return 3\n"
        "print(loads(dumps(load)).__annotations__, loads(dumps(unload)).__annotations__)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stderr == ""
    assert done.stdout == (
        "{'request': 'Request', 'driver': 'Driver', 'other': 'Unknown'}"
        " {'request': <class '__main__.Request'>, 'other': 'Unknown'}\n"
    )


def test_a_global_variable_of_main_that_cannot_travel_is_named() -> None:
    code = (
        "import threading\nfrom rr_actors.base.pickling import dumps\nlock = threading.Lock()\n"
        "def load(request): return lock\n"
        "try: dumps(load, 'load callback')\nexcept Exception as error: print(error.path)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("load callback: global variable 'lock'\n", "")


_LONG = b"\x93" * 70_000
"""Bytes that a pickle has where it names a class."""


@pytest.mark.parametrize(
    "holder",
    [
        lambda item: [item],
        lambda item: (_LONG, item),
        lambda item: {"a": _LONG, "b": item},
        lambda item: {item: _LONG},
        lambda item: [[_LONG, item]],
        lambda item: {"a": {"b": (item,)}},
        lambda item: [*range(100), item],
        lambda item: {**dict.fromkeys(range(100), _LONG), "b": item},
        lambda item: {_LONG, item},
        lambda item: Envelope(_LONG, item),
    ],
)
@pytest.mark.parametrize("pack", [lambda value: dumps(value), lambda value: dumps_large(value, "value")])
def test_what_cannot_leave_its_process_is_found_wherever_it_is_among_long_bytes(
    holder: Callable[[Any], Any], pack: Callable[[Any], Any]
) -> None:
    with pytest.raises(NotSerializable, match=r"asyncio\.locks\.Lock"):
        pack(holder(asyncio.Lock()))


@dataclasses.dataclass(frozen=True)
class Envelope:
    data: bytes
    item: Any


@pytest.mark.parametrize(
    "value", [_LONG, bytearray(_LONG), "x" * 70_000, [_LONG, "__main__", 1.5, None], (_LONG,), {"__main__": _LONG}]
)
def test_long_bytes_and_text_travel_as_they_are(value: Any) -> None:
    assert loads(dumps(value)) == value
    assert dumps(value) == pickle.dumps(value, pickle.HIGHEST_PROTOCOL)


def test_a_value_is_large_whatever_another_thread_pickles_meanwhile() -> None:
    value = b"x" * LARGE_BYTES
    steps: list[int] = []

    def small_one_after_each_step(_frame: FrameType, _event: str, _arg: object) -> Any:
        dumps_large("small", "value")
        steps.append(1)
        return small_one_after_each_step

    before = sys.gettrace()
    sys.settrace(small_one_after_each_step)
    try:
        packed = dumps_large(value, "value")
    finally:
        sys.settrace(before)
    assert len(steps) > 5
    assert type(packed) is Large
