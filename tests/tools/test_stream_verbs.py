"""The command line at streams: which there are, who reads them, how fast they are, and what is in their frames."""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import threading
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy
import pytest

import rr_actors as rr
from support import LIMIT_S, eventually, kill, wait_respawned
from support_cli import run_cli

pytestmark = pytest.mark.usefixtures("runtime_dir")

Start = Callable[..., rr.System]


class Odd:
    """Its pickle cannot be read."""

    def __reduce__(self) -> tuple[Any, ...]:
        return int, ("no number",)


class Cameras(rr.Manager):
    """A camera has the streams "images" and "notes"; a board has one, with the default name."""

    def __init__(self) -> None:
        self.streams: dict[str, rr.Publisher] = {}
        self.ended = threading.Event()

    @rr.server("camera", recovery="reload")
    def open_camera(self, device: str) -> None:
        for name in ("images", "notes"):
            self.streams[name] = rr.current().open_stream(name)

    @rr.server("board")
    def open_board(self, device: str) -> None:
        self.streams["stream"] = rr.current().open_stream()

    @rr.server("plain")
    def open_plain(self) -> None: ...

    def publish(self, name: str, value: object, times: int) -> list[int]:
        return [self.streams[name].publish(value) for _ in range(times)]

    def go_on(self, name: str, what: str) -> None:
        """Publish values of a kind again and again, from a thread."""
        made = {"grey": picture(2, 3), "colour": picture(4, 5, 3), "text": "a note", "odd": Odd()}
        values = {**made, "numbers": numpy.arange(6.0), "bytes": bytes(range(10)), "none": picture(2, 3, 2)}

        def run() -> None:
            while not self.ended.wait(0.01):
                self.streams[name].publish(values[what])

        threading.Thread(target=run, daemon=True).start()

    def on_stop(self) -> None:
        self.ended.set()


def picture(*shape: int) -> Any:
    return numpy.arange(numpy.prod(shape), dtype="u1").reshape(shape)


def said(*arguments: object) -> str:
    """What a command prints that succeeds."""
    ran = run_cli(*arguments)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


def refused(*arguments: object) -> str:
    """What a command says in one line that fails."""
    ran = run_cli(*arguments)
    assert ran.returncode in (2, 4), ran.stdout + ran.stderr
    (line,) = ran.stderr.splitlines()
    assert "Traceback" not in line
    return line


@pytest.fixture
def system(start: Start) -> rr.System:
    return start(rr.ChildSpec(Cameras, id="cameras"))


@pytest.fixture
def camera(system: rr.System) -> rr.Query:
    return system.open_registrar("app").load(Cameras.open_camera, "front")


@pytest.fixture
def reader(system: rr.System, camera: rr.Query) -> Iterator[rr.StreamReader]:
    """A reader that has come, and takes no frame."""
    with camera.stream("images") as reader:
        eventually(lambda: system.ref("cameras").proxy().publish("images", 0, 1).get() == [1])
        yield reader


def test_streams_lists_what_is_open_and_who_reads_it(
    system: rr.System, camera: rr.Query, reader: rr.StreamReader
) -> None:
    cameras = system.ref("cameras").proxy()
    before = json.loads(said("streams", "--json", "images"))[0]["missed"]
    cameras.publish("images", bytes(1000), 5).get()

    images, notes = json.loads(said("streams", "--json"))
    ran = said("streams")

    assert [row["name"] for row in (images, notes)] == ["images", "notes"]
    assert (images["server"], images["request"]) == ("cameras/camera", '"front"')
    assert images["frames"] >= 6
    assert images["age_s"] >= 0
    (one,) = images["readers"]
    assert (one["registrar"], one["pid"], one["keep"]) == ("app", os.getpid(), "latest")
    assert images["missed"] == one["missed"] == before + 5  # it has taken none, and the newest waits for it
    assert (notes["frames"], notes["rate"], notes["age_s"], notes["readers"]) == (0, 0.0, None, [])
    assert f"app (process {os.getpid()}, missed {before + 5})" in ran
    assert "no frame" in ran


def test_a_program_sees_the_same_streams(system: rr.System, camera: rr.Query, reader: rr.StreamReader) -> None:
    images, notes = system.streams()
    assert (images.id, images.name, images.server) == (f"{camera.resource_id}/images", "images", "cameras/camera")
    assert (images.resource_id, images.consumers, notes.consumers) == (camera.resource_id, 1, 0)
    assert images.age_s is not None
    assert (notes.rate_hz, notes.bytes_per_s, notes.missed, notes.age_s) == (0.0, 0.0, 0, None)

    cameras = system.ref("cameras").proxy()
    assert eventually(lambda: cameras.publish("images", 0, 1).get() and system.streams()[0].rate_hz > 0)
    assert [stream.name for stream in system.registrar("cameras").streams()] == ["images", "notes"]
    camera.unload()
    assert eventually(lambda: system.streams() == [])


def test_streams_chooses_and_says_when_there_is_none(system: rr.System, camera: rr.Query) -> None:
    assert [row["name"] for row in json.loads(said("streams", "notes", "--json", "--registrar", "cameras"))] == [
        "notes"
    ]
    assert run_cli("streams", "nothing").stderr == "no stream matches\n"
    camera.unload()
    assert run_cli("streams").stderr == "no stream is open\n"
    assert "nobody" in refused("streams", "--registrar", "nobody")


def test_why_names_the_readers_of_a_stream(camera: rr.Query, reader: rr.StreamReader) -> None:
    told = said("why", camera.resource_id)

    assert f"Its stream 'images' is read by app (process {os.getpid()}" in told
    assert "Its stream 'notes' has no reader." in told


def test_the_rate_is_what_is_published_whether_anybody_reads_or_not(system: rr.System, camera: rr.Query) -> None:
    system.ref("cameras").proxy().go_on("images", "text").get()
    eventually(lambda: json.loads(said("streams", "images", "--json"))[0]["rate"] > 1)

    line = said("stream", camera.resource_id, "images", "--count", 1)
    facts = json.loads(said("stream", 'cameras/camera "front"', "images", "--rate", "--count", 1, "--json"))

    assert "/s, newest " in line
    assert "nobody reads it" in line
    assert facts["rate"] > 0
    assert facts["bytes_s"] == 0.0


def test_a_rate_goes_on_after_a_crash_of_the_manager(system: rr.System, camera: rr.Query) -> None:
    wait_respawned(system, "cameras", kill(system, "cameras"))
    eventually(lambda: said("streams", "images", "--json") != "[]\n")

    assert "newest no frame, nobody reads it" in said("stream", camera.resource_id, "images", "--count", 1)


def test_echo_shows_each_frame_as_a_line(system: rr.System, camera: rr.Query) -> None:
    cameras = system.ref("cameras").proxy()
    cameras.go_on("notes", "text").get()
    cameras.go_on("images", "grey").get()

    lines = said("stream", camera.resource_id, "notes", "--echo", "--count", 3).splitlines()
    fact = json.loads(said("stream", camera.resource_id, "images", "--echo", "--count", 1, "--json"))

    assert len(lines) == 3
    assert all(line.endswith("'a note'") for line in lines)
    assert fact["value"] == "array of shape (2, 3) and type uint8"
    assert fact["number"] > 0


def test_echo_ends_with_the_resource(system: rr.System, camera: rr.Query) -> None:
    system.ref("cameras").proxy().go_on("notes", "text").get()
    command = [sys.executable, "-m", "rr_actors", "stream", camera.resource_id, "notes", "--echo"]
    echo = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert echo.stdout is not None
    assert echo.stdout.readline().endswith("'a note'\n")

    camera.unload()

    _, told = echo.communicate(timeout=LIMIT_S * 3)
    assert (echo.returncode, told) == (0, "stream 'notes': its resource was unloaded\n")


def pixels(png: bytes) -> tuple[tuple[int, int, int], bytes]:
    """Return width, height and colour type of a PNG, and its bytes without the byte before each line."""
    assert png[:8] == b"\x89PNG\r\n\x1a\n"
    chunks, at = dict[bytes, bytes](), 8
    while at < len(png):
        (size,) = struct.unpack_from(">I", png, at)
        kind, body = png[at + 4 : at + 8], png[at + 8 : at + 8 + size]
        assert struct.unpack_from(">I", png, at + 8 + size)[0] == zlib.crc32(kind + body)
        chunks[kind], at = body, at + 12 + size
    width, height, _, colour, *_ = struct.unpack(">IIBBBBB", chunks[b"IHDR"])
    lines = zlib.decompress(chunks[b"IDAT"])
    row = len(lines) // height
    return (width, height, colour), b"".join(lines[at + 1 : at + row] for at in range(0, len(lines), row))


@pytest.mark.parametrize(("what", "head"), [("grey", (3, 2, 0)), ("colour", (5, 4, 2))])
def test_a_picture_is_saved_as_png(
    system: rr.System, camera: rr.Query, tmp_path: Path, what: str, head: tuple[int, int, int]
) -> None:
    system.ref("cameras").proxy().go_on("images", what).get()

    told = said("stream", camera.resource_id, "images", "--save", tmp_path / "it.png")

    assert told.startswith("saved frame ")
    size = head[0] * head[1] * (3 if what == "colour" else 1)
    assert pixels((tmp_path / "it.png").read_bytes()) == (head, bytes(range(size)))


def test_arrays_and_bytes_are_saved(system: rr.System, camera: rr.Query, tmp_path: Path) -> None:
    cameras = system.ref("cameras").proxy()
    cameras.go_on("images", "numbers").get()
    cameras.go_on("notes", "bytes").get()

    said("stream", camera.resource_id, "images", "--save", tmp_path / "it.npy")
    said("stream", camera.resource_id, "notes", "--save", tmp_path / "it.bin")

    assert numpy.load(tmp_path / "it.npy").tolist() == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    assert (tmp_path / "it.bin").read_bytes() == bytes(range(10))


def test_a_stream_is_recorded_as_one_reader_more(system: rr.System, camera: rr.Query, tmp_path: Path) -> None:
    system.ref("cameras").proxy().go_on("images", "colour").get()

    told = said("stream", camera.resource_id, "images", "--record", tmp_path / "f", "--count", "3")

    recorded = rr.read_stream(tmp_path / "f")
    assert told.startswith(f"recorded 3 frames in {tmp_path / 'f'}")
    assert [frame.value.shape for frame in recorded] == [(4, 5, 3)] * 3
    assert (recorded.server, recorded.request, recorded.response) == ("cameras/camera", camera.request, None)
    ran = run_cli("stream", camera.resource_id, "images", "--record", tmp_path / "g", "--limit-bytes", "1000")
    assert ran.stderr == f"{tmp_path / 'g'} has reached its limit of 1000 bytes\n"
    ran = run_cli("stream", camera.resource_id, "images", "--record", tmp_path / "f")
    assert "f: expected a new file, got FileExistsError" in ran.stderr


@pytest.mark.parametrize(
    ("what", "options", "told"),
    [
        ("text", ("--rate", "--echo"), "expected one of --rate, --echo, --save FILE and --record FILE, got several"),
        ("text", ("--save", "it.jpeg"), "expected a file that ends with .png, .npy or .bin, got 'it.jpeg'"),
        ("text", ("--save", "old.png"), "expected a new file, got old.png, which is there already"),
        ("text", ("--save", "new.png"), "'a note', cannot be saved"),
        ("none", ("--save", "new.png"), "a picture is an array of unsigned bytes, height by width, or"),
        ("odd", ("--echo",), "a frame cannot be read here: "),
        ("", ("--echo", "--timeout", "0.1"), "no frame within 0.1 s"),
    ],
)
def test_what_cannot_be_shown_or_saved_says_why(
    system: rr.System,
    camera: rr.Query,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    what: str,
    options: tuple[str, ...],
    told: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("old.png").touch()
    if what:
        system.ref("cameras").proxy().go_on("images", what).get()

    assert told in refused("stream", camera.resource_id, "images", *options)
    assert not [name for name in ("new.png", "it.jpeg") if Path(name).exists()]


def test_a_stream_that_there_is_not_is_named(system: rr.System, camera: rr.Query) -> None:
    app = system.registrar("app")
    plain = app.load(Cameras.open_plain)

    assert "'nothing': no resource has this id" in refused("stream", "nothing")
    assert "has no stream 'imagse'; it has: 'images', 'notes'; did you mean 'images'" in refused(
        "stream", camera.resource_id, "imagse"
    )
    assert "has several streams: give the name of one after its id, of 'images', 'notes'" in refused(
        "stream", camera.resource_id
    )
    assert "has no stream that is open" in refused("stream", plain.resource_id)


def test_the_only_stream_needs_no_name(system: rr.System) -> None:
    board = system.open_registrar("app").load(Cameras.open_board, "a")

    assert "no frame" in said("stream", board.resource_id, "--count", 1)
