"""Bad bytes wherever bytes come in: only named errors, no hang, no growth.

Each test makes RR_FUZZ inputs: a hundred by default, 20000 for a long run. What is covered elsewhere is not repeated:
test_frames.py mutilates a registrar's stream and the handshake, test_store_contract.py single bytes of a catalog.
"""

from __future__ import annotations

import contextlib
import gc
import os
import random
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rr_actors.actors.remote import protocol
from rr_actors.base.config import RegistrarConfig, SystemConfig
from rr_actors.base.errors import (
    CatalogDamaged,
    CatalogVersion,
    ConfigError,
    InvalidRequest,
    NotSerializable,
    Unavailable,
)
from rr_actors.base.values.canonical import Codec
from rr_actors.managers.components import read_registry
from rr_actors.managers.robots import read_robots
from rr_actors.registrar.links import remote_calls
from rr_actors.registrar.model.messages import Message
from rr_actors.registrar.model.rows import Held, Hold, Peer, Phase, Put, Resource, Row, ServedQuery, State, rows_of
from rr_actors.storage.opening import open_store, read_rows
from rr_actors.supervision import control_channel
from rr_actors.supervision.core.specs import Supervisor
from rr_actors.wire.frames import FrameReader
from rr_actors.wire.handshake import AcceptorHandshake, DiallerHandshake
from rr_actors.wire.transport import Hello
from support_managers import Order
from support_transports import frame

EXAMPLES = int(os.environ.get("RR_FUZZ", "100"))
fuzz = settings(
    max_examples=EXAMPLES,
    deadline=10_000,  # milliseconds: a hang
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
)

pytestmark = pytest.mark.timeout(60 if EXAMPLES < 1000 else 3600)


# -- messages ------------------------------------------------------------------------------------------------------

WIRES: dict[str, Any] = {"registrar": Message, "handle": remote_calls.HandleMessage, "actors": protocol.Letter}
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text(max_size=9) | st.binary(),
    lambda inner: st.lists(inner, max_size=6) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
    max_leaves=12,
)


@st.composite
def message_like(draw: st.DrawFn) -> bytes:
    """A frame's body: a message's tag and fields of other types, a depth without bottom, or just bytes."""
    match draw(st.integers(0, 3)):
        case 0:
            return draw(st.binary(max_size=200))
        case 1:
            return b"\x91" * draw(st.integers(100, 5000)) + b"\xc0"
        case 2:
            body = msgspec.msgpack.encode(draw(PLAIN))
            return body[: draw(st.integers(0, len(body)))]
        case _:
            tag = draw(st.integers(0, 40) | st.text(max_size=8))
            return msgspec.msgpack.encode([tag, *draw(st.lists(PLAIN, max_size=9))])


@pytest.mark.parametrize("wire", WIRES)
@fuzz
@given(body=message_like())
def test_whatever_comes_in_a_frame_is_a_message_or_a_named_error(wire: str, body: bytes) -> None:
    reader: FrameReader[Any] = FrameReader(msgspec.msgpack.Decoder(WIRES[wire]), 100_000)
    messages = reader.feed(frame(body))
    assert len(messages) + (reader.error is not None) + reader.ended == 1
    assert reader.error is None or type(reader.error) is Unavailable
    assert all(isinstance(message, msgspec.Struct) for message in messages)


@fuzz
@given(bodies=st.lists(message_like(), min_size=1, max_size=5), cut=st.integers(0, 400))
def test_a_control_channel_takes_messages_or_closes(bodies: list[bytes], cut: int) -> None:
    received: list[Any] = []
    channel = control_channel.Channel("root/a", received.append, lambda: None)
    stream = b"".join(frame(body) for body in bodies)
    for part in (stream[:cut], stream[cut:]):
        channel.data_received(part)
    assert all(isinstance(message, control_channel.Message) for message in received)


HELLO = Hello("registrar", "cameras", "app", 7)


@fuzz
@given(
    acceptor=st.booleans(),
    pieces=st.lists(
        st.binary(max_size=300)
        | st.sampled_from([b"rr_actor", b"rr_actor\x00\x01", b"rr_actor\x00\x02" + bytes(64), bytes(4), b"\xff" * 4]),
        max_size=8,
    ),
)
def test_a_handshake_without_the_key_ends_with_a_named_error_or_waits(acceptor: bool, pieces: list[bytes]) -> None:
    key = bytes(range(32))
    side = AcceptorHandshake(key) if acceptor else DiallerHandshake(key, HELLO)
    try:
        for piece in pieces:
            side.receive(piece)
    except Unavailable:
        return
    assert not side.done
    assert len(side.rest) < 5000  # a proof, a greeting: never more than the block that is to come


@pytest.mark.parametrize("kind", [None, Order, dict[str, int], list[tuple[int, str]]], ids=str)
@fuzz
@given(body=message_like())
def test_whatever_comes_as_a_request_is_one_or_a_named_error(kind: Any, body: bytes) -> None:
    codec = Codec(kind)
    try:
        codec.decode(body, "maker/thing")
        codec.canonical(body)
    except (InvalidRequest, NotSerializable):  # the second of what is nested too deeply
        pass


# -- TOML ----------------------------------------------------------------------------------------------------------

SYSTEM = b"""
frame_limit_bytes = 16777216
durability = "process"
preload = ["json"]
[registrars.cameras]
durability = "power"
save_interval_s = 10
"""
REGISTRAR = b'name = "cameras"\nlocation = "x"\nsave_interval_s = 1.5\nsave_on_modify = true\non_damage = "aside"\n'
TREE = b"""
strategy = "rest_for_one"
max_restarts = 3
[[children]]
actor = "support_managers:Shop"
id = "a"
kwargs = { root = "x" }
backoff = { delay_s = 0.1 }
[[children]]
id = "inner"
placement = "process"
[[children.children]]
actor = "support_managers:Shop"
args = ["y"]
shutdown_s = "infinity"
"""
COMPONENTS = b"""
[[component]]
name = "usb-camera"
type = "camera"
program = { command = "/usr/bin/camera", arguments = ["${device}"] }
reliability = 0.8
parameters = { device = "/dev/0" }
"""
ROBOTS = b"""
[[robot]]
name = "rover"
driver = { type = "driver", parameters = { device = "/dev/0" } }
sensors = [ { type = "camera" } ]
"""
READERS: dict[str, tuple[Callable[[Path], object], bytes]] = {
    "registrar": (RegistrarConfig.from_toml, REGISTRAR),
    "system": (SystemConfig.from_toml, SYSTEM),
    "tree": (Supervisor.from_toml, TREE),
    "components": (read_registry, COMPONENTS),
    "robots": (read_robots, ROBOTS),
}
VALUES = st.sampled_from(
    [
        b"nan", b"-inf", b"1e999", b"9" * 5000, b"-1", b"0", b"true", b"''", b'"\\u0000"', b'"/"', b"[]", b"[[]]",
        b"{}", b"1979-05-27T07:32:00Z", b"07:32:00", b"[" * 3000 + b"]" * 3000, b"[" * 900, b"{a=" * 900,
        b'"' + b"x" * 3000 + b'"', b"0x" + b"f" * 5000, b'"a:b"', b'":"', b'"os:system"', b'"rr_actors:nothing"',
        b'"\xff"', b"\x00", b"a.b.c = 1",
    ]
)  # fmt: skip


@st.composite
def mutilated(draw: st.DrawFn, good: bytes) -> bytes:
    """A file in which lines are gone, doubled or swapped, values are others, bytes are wrong."""
    lines = good.splitlines(keepends=True)
    for _ in range(draw(st.integers(0, 3))):
        at = draw(st.integers(0, len(lines) - 1))
        match draw(st.integers(0, 4)):
            case 0:
                lines[at] = b"\n"
            case 1:
                lines.insert(at, lines[draw(st.integers(0, len(lines) - 1))])
            case 2:
                other = draw(st.integers(0, len(lines) - 1))
                lines[at], lines[other] = lines[other], lines[at]
            case 3:
                lines[at] = lines[at].partition(b"=")[0].rstrip() + b" = " + draw(VALUES) + b"\n"
            case _:
                lines.insert(at, draw(st.sampled_from([b"x = ", b"name = ", b"[children]\n"])) + draw(VALUES) + b"\n")
    data = bytearray(b"".join(lines))
    for _ in range(draw(st.integers(0, 2))):
        data[draw(st.integers(0, len(data) - 1))] = draw(st.integers(0, 255))
    return bytes(data[: draw(st.integers(0, len(data)))]) if draw(st.integers(0, 9)) == 0 else bytes(data)


@pytest.mark.parametrize("reader", READERS)
@fuzz
@given(data=st.data())
def test_a_mutilated_toml_file_is_read_or_a_config_error_that_names_it(
    tmp_path: Path, reader: str, data: st.DataObject
) -> None:
    read, good = READERS[reader]
    file = tmp_path / "fuzzed.toml"
    file.write_bytes(data.draw(mutilated(good)))
    refused: ConfigError | None = None
    try:
        read(file)
    except ConfigError as error:
        refused = error
    if refused is not None:
        assert str(file) in str(refused)
        assert refused.file == str(file)


@pytest.mark.parametrize("reader", READERS)
def test_the_files_that_are_mutilated_are_good(tmp_path: Path, reader: str) -> None:
    read, good = READERS[reader]
    file = tmp_path / "good.toml"
    file.write_bytes(good)
    assert read(file)


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(
    ("value", "says"),
    [
        (b"9" * 5000, "limit"),
        (b"0x" + b"f" * 5000, "does not fit into 64 bits"),
        (b"9223372036854775808", "does not fit into 64 bits"),
        (b"[" * 3000 + b"]" * 3000, "nested too deeply"),
        (b'"\xff"', "UTF-8"),
    ],
    ids=["a long number", "a long hexadecimal number", "a number over 64 bits", "deep", "not UTF-8"],
)
def test_what_a_toml_parser_stumbles_over_is_a_config_error(
    tmp_path: Path, reader: str, value: bytes, says: str
) -> None:
    file = tmp_path / "bad.toml"
    file.write_bytes(b"durability = " + value)
    with pytest.raises(ConfigError, match=says):
        READERS[reader][0](file)


# -- catalogs ------------------------------------------------------------------------------------------------------


def rows() -> list[Row]:
    found: list[Row] = [Peer("maker")]
    for n in range(40):
        found.append(Resource(f"r{n:02}", "thing", b"q" * n, b"a", Phase.LOADED, State.OK, "", 1))
        found.append(ServedQuery(f"q{n:02}", f"r{n:02}", "app", "", 1, n))
        held = Held(f"h{n:02}", "maker", "thing", b"q" * n, b"a", f"r{n:02}", "", 1, n, Hold.HELD, State.OK)
        found.append(held)
    return found


class Damaged:
    """A catalog with rows in its file and in its -wal, to be damaged again and again."""

    def __init__(self, directory: Path) -> None:
        self.path = directory / "reg" / "catalog.sqlite3"
        store = open_store(self.path)
        store.commit([Put(row) for row in rows()])
        store.close()
        store = open_store(self.path)  # its -wal
        store.commit([Put(Peer("another"))])
        self.files = {path: path.read_bytes() for path in self.path.parent.glob("catalog.sqlite3*")}
        self.rows = set(rows_of(store.load()))
        self.saved = self.rows - {Peer("another")}
        store.close()
        self.closed = {self.path: self.path.read_bytes()}

    def write(self, files: dict[Path, bytes]) -> None:
        for path in self.path.parent.iterdir():
            path.unlink()
        for path, content in files.items():
            path.write_bytes(content)

    def check(self, files: dict[Path, bytes], whole: bool) -> None:
        """Read it, then open it: what it held, or a named error that leaves it as it is."""
        self.write(files)
        expected = [self.rows] if whole else [self.rows, self.saved]
        try:
            assert set(read_rows(self.path)) in expected
        except (CatalogDamaged, CatalogVersion):
            pass
        refused, store = "", None
        try:
            store = open_store(self.path)
        except (CatalogDamaged, CatalogVersion) as error:
            refused = str(error)
        if store is None:
            assert str(self.path) in refused
            assert self.path.read_bytes() == files[self.path]
            return
        try:
            assert set(rows_of(store.load())) in expected
            store.commit([Put(Peer("more"))])
        finally:
            store.close()


@fuzz
@given(data=st.data())
def test_a_closed_catalog_with_wrong_bytes_is_whole_or_refused(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    damaged = _catalog(tmp_path_factory)
    content = bytearray(damaged.closed[damaged.path])
    match data.draw(st.integers(0, 3)):
        case 0:
            for _ in range(data.draw(st.integers(1, 6))):
                content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
        case 1:
            del content[data.draw(st.integers(0, len(content) - 1)) :]
        case 2:
            page = 4096 * data.draw(st.integers(0, len(content) // 4096 - 1))
            content[page : page + 4096] = bytes(4096)
        case _:
            at = data.draw(st.integers(0, len(content) - 1))
            some = data.draw(st.binary(min_size=1, max_size=64))
            content[at : at + len(some)] = some
    damaged.check({damaged.path: bytes(content)}, whole=True)


@fuzz
@given(data=st.data())
def test_a_wal_with_wrong_bytes_is_read_up_to_there_or_refused(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    damaged = _catalog(tmp_path_factory)
    files = dict(damaged.files)
    wal = damaged.path.with_name("catalog.sqlite3-wal")
    content = bytearray(files[wal])
    for _ in range(data.draw(st.integers(0, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    files[wal] = bytes(content[: data.draw(st.integers(0, len(content)))])
    files.pop(damaged.path.with_name("catalog.sqlite3-shm"), None)
    damaged.check(files, whole=False)


_catalogs: list[Damaged] = []


def _catalog(factory: pytest.TempPathFactory) -> Damaged:
    if not _catalogs:
        _catalogs.append(Damaged(factory.mktemp("fuzz")))
    return _catalogs[0]


# -- growth --------------------------------------------------------------------------------------------------------


def test_bad_bytes_leave_nothing_in_memory(tmp_path: Path) -> None:
    chance = random.Random(8)
    damaged = Damaged(tmp_path)
    file = tmp_path / "bad.toml"

    def feed(count: int) -> None:
        for _ in range(count):
            for wire in WIRES.values():
                FrameReader(msgspec.msgpack.Decoder(wire), 10_000).feed(frame(chance.randbytes(60)))
            control_channel.Channel("root/a", lambda message: None, lambda: None).data_received(
                frame(chance.randbytes(60))
            )
            for read, good in READERS.values():
                bad = bytearray(good)
                bad[chance.randrange(len(bad))] = chance.randrange(256)
                file.write_bytes(bad)
                with contextlib.suppress(ConfigError):
                    read(file)
            content = bytearray(damaged.closed[damaged.path])
            content[chance.randrange(len(content))] ^= 255
            damaged.check({damaged.path: bytes(content)}, whole=True)

    feed(20)
    gc.collect()
    tracemalloc.start()
    try:
        sizes: list[int] = []
        for count in (10, 30, 30):
            feed(count)
            gc.collect()
            sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    # Python's table of interned strings, which has the parts of each Path, may grow by 2 MB in one of the two rounds
    assert min(sizes[1] - sizes[0], sizes[2] - sizes[1]) < 75_000
