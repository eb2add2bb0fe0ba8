"""Files of text: configurations, trees, registries of components, descriptions of robots; what a manager remembers."""

from __future__ import annotations

import tempfile
import zlib
from collections.abc import Callable
from pathlib import Path

from fuzz.target import Feed, Target
from rr_actors.actors.actor import Actor
from rr_actors.base.config import RegistrarConfig, SystemConfig
from rr_actors.base.errors import CatalogError, ConfigError
from rr_actors.managers.components import read_registry
from rr_actors.managers.planning.reliability import FALL, Reliabilities
from rr_actors.managers.robots import read_robots
from rr_actors.storage.child_records import ChildRecord, decode, encode
from rr_actors.streams.stream import Stream, StreamFrame
from rr_actors.streams.stream_file import RecordedStream, StreamHeader, StreamWriter
from rr_actors.supervision.core.specs import Supervisor


class Idle(Actor):
    """What the trees are made of."""


_REGISTRAR = b"""name = "cameras"
location = "x"
save_interval_s = 1.5
save_on_modify = true
erase_on_destruct = false
durability = "power"
on_damage = "aside"
"""
_SYSTEM = b"""frame_limit_bytes = 16777216
mailbox_limit = 10
ask_timeout_s = 1
durability = "process"
preload = ["json"]
[registrars.cameras]
durability = "power"
save_interval_s = 10
[registrars]
arms = { on_damage = "aside" }
"""
_TREE = b"""strategy = "rest_for_one"
max_restarts = 3
within_s = 5.0
[[children]]
actor = "fuzz.files:Idle"
id = "a"
kwargs = { root = "x" }
restart = "transient"
backoff = { delay_s = 0.1, maximum_s = 10.0 }
[[children]]
id = "inner"
placement = "process"
[[children.children]]
actor = "fuzz.files:Idle"
id = "b"
args = ["y"]
shutdown_s = "infinity"
"""
_COMPONENTS = b"""[[component]]
name = "usb-camera"
type = "camera"
reliability = 0.8
parameters = { device = "/dev/0", "a b" = 1 }
[component.program]
command = "/usr/bin/camera"
arguments = ["${device}"]
environment = { A = "b" }
ready = { line = "scanning", timeout_s = 5 }
"""
_ROBOTS = b"""[[robot]]
name = "rover"
driver = { type = "driver", parameters = { device = "/dev/0" } }
controller = { type = "pilot" }
sensors = [ { type = "camera" }, { type = "imu", parameters = { rate = 1.5, on = true } } ]
"""
_WORDS = (
    b"nan", b"-inf", b"1e999", b"-1", b"0x", b"9223372036854775808", b"true", b"''", b'"""', b"'''", b'"\\u0000"',
    b'"\\U0010ffff"', b"[[", b"]]", b"[children]", b"{}", b"1979-05-27T07:32:00Z", b"07:32:00", b"1979-05-27", b" = ",
    b"[" * 300, b'"a:b"', b'"os:path"', b'"fuzz.files:Idle.x"', b"a.b.c = 1\n", b"#", b"\r\n", b"backoff", b"args",
    b"children", b'id = "a"\n', b'strategy = "simple_one_for_one"\n', b"intensity", b"permanent", b"infinity",
)  # fmt: skip


def _reader(about: str, read: Callable[[Path], object], good: bytes) -> Target:
    def prepare(directory: Path) -> Feed:
        file = directory / "fuzzed.toml"

        def feed(data: bytes) -> None:
            file.write_bytes(data)
            try:
                read(file)
            except ConfigError as error:
                assert type(error) is ConfigError
                assert str(file) in str(error)
                assert error.file == str(file)
                repr(error.details)

        return feed

    lines = good.splitlines(keepends=True)
    parts = [b"".join(lines[:at]) for at in range(1, len(lines))]
    return Target(about, prepare, lambda: [good, *parts], words=_WORDS)


READERS = {
    "registrar.toml": _reader("a registrar's configuration", RegistrarConfig.from_toml, _REGISTRAR),
    "system.toml": _reader("a system's configuration", SystemConfig.from_toml, _SYSTEM),
    "tree.toml": _reader("a tree of supervisors", Supervisor.from_toml, _TREE),
    "components.toml": _reader("a registry of components", read_registry, _COMPONENTS),
    "robots.toml": _reader("descriptions of robots", read_robots, _ROBOTS),
}


def _prepare_reliability(directory: Path) -> Feed:
    file = directory / "reliability.json"

    def feed(data: bytes) -> None:
        """Whatever is in it: a component is trusted between 0 and 1, and the next failure is remembered."""
        file.write_bytes(data)
        before = Reliabilities(file).of("a", 1.0)
        assert 0 <= before <= 1
        after = Reliabilities(file).lower("a", 1.0, "another failure")
        assert after in (before, before * FALL)
        assert Reliabilities(file).of("a", 1.0) == after

    return feed


def _prepare_child(_directory: Path) -> Feed:
    def feed(data: bytes) -> None:
        """With a checksum that is right, too: it is the record of this child, or a named error."""
        for file in (data, b"rr-child %08x %b" % (zlib.crc32(data), data)):
            try:
                assert (record := decode(file, "file", "pool", "a")).id == "a"
                assert decode(encode(record), "file", "pool", "a") == record
            except CatalogError as error:
                assert error.path == "file"

    return feed


def _children() -> list[bytes]:
    whole = [encode(ChildRecord("pool", id, 7, b"arguments")) for id in ("a", "b")]
    return [part for file in whole for part in (file, file[18:])]


def _recorded(frames: int) -> bytes:
    """Return the file of a recorded stream."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "frames")
        writer = StreamWriter(file, StreamHeader("s", "0" * 32, "a/b", b"\xa1r", None, 1.0), 2**20)
        for i in range(frames):
            writer.write(StreamFrame(bytearray(5000) if i == 1 else i, i + 1, float(i), 0, Stream("0" * 32, "s")))
        writer.close()
        return file.read_bytes()


def _prepare_recorded(directory: Path) -> Feed:
    file = directory / "frames"

    def feed(data: bytes) -> None:
        """A ConfigError names the file; or there are whole frames within it. No pickle is opened for that."""
        file.unlink(missing_ok=True)  # the one before may still be mapped
        file.write_bytes(data)
        try:
            recorded = RecordedStream(file)
        except ConfigError as error:
            assert str(file) in str(error)
            assert error.file == str(file)
        else:
            assert len(recorded) == len(recorded.times) <= len(data) // 40
            assert recorded.missed >= 0

    return feed


RECORDED = Target("a recorded stream", _prepare_recorded, lambda: [_recorded(n) for n in (0, 1, 3)], longest=8192)

CHILD = Target("the record of a child", _prepare_child, _children)

RELIABILITY = Target(
    "what the component manager remembers of failures",
    _prepare_reliability,
    lambda: [b"", b'{"reliability": {"a": 0.5, "b": 1}, "counted": ["f"]}', b'{"reliability": {"a": 1e-7}}'],
    words=(b'"reliability"', b'"counted"', b'"a"', b"\\ud800", b"1e999", b"null", b"[[[[[[[[", b'{"a":{"a":{"a":'),
)
