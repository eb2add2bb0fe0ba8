"""Streams that are recorded and replayed: what is in the file, what a kill leaves, and what a consumer gets."""

from __future__ import annotations

import itertools
import os
import resource
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy
import pytest

import rr_actors as rr
from rr_actors.managers.replays import Replays, Schedule
from rr_actors.streams.stream_file import StreamHeader, StreamWriter
from support import eventually, kill, pid_of, wait_respawned

Start = Callable[..., rr.System]
HEADER = StreamHeader("images", "0" * 32, "cameras/camera", None, None, 5.0)


class Feed(msgspec.Struct):
    device: str
    images: rr.Stream


class Cameras(rr.Manager):
    """A stream of each kind of value."""

    def __init__(self) -> None:
        self.stops: dict[str, threading.Event] = {}

    @rr.server("camera", recovery="reload")
    def open_camera(self, device: str) -> Feed:
        images = rr.current().open_stream("images")
        stop = self.stops[rr.current().resource_id] = threading.Event()
        threading.Thread(target=self._grab, args=(device, images, stop), daemon=True).start()
        return Feed(device, images.stream)

    @open_camera.unload
    def close_camera(self, device: str, response: Feed) -> None:
        self.stops.pop(rr.current().resource_id).set()

    def on_stop(self) -> None:
        for stop in list(self.stops.values()):
            stop.set()

    def _grab(self, device: str, images: rr.Publisher, stop: threading.Event) -> None:
        for i in itertools.count():
            shape = {"pictures": (64, 64, 3), "large": (512, 512, 3)}.get(device)
            images.publish({"number": i} if shape is None else numpy.full(shape, i % 256, "u1"))
            if stop.wait(0.002):
                return


@pytest.fixture
def app(start: Start) -> rr.Registrar:
    return start(rr.ChildSpec(Cameras, id="cameras", placement="thread")).open_registrar("app")


def write(path: Path, *values: Any, gap_s: float = 0.5, limit_bytes: int = 2**20, header: Any = HEADER) -> Path:
    writer = StreamWriter(path, header, limit_bytes)
    for i, value in enumerate(values):
        stream = rr.Stream(header.resource_id, header.name)
        if not writer.write(rr.StreamFrame(value, i + 1, 100.0 + i * gap_s, 0, stream)):
            break
    writer.close()
    return path


def test_a_recording_has_the_frames_with_their_times_and_what_was_loaded(app: rr.Registrar, tmp_path: Path) -> None:
    camera = app.load(Cameras.open_camera, "front")
    with rr.record_stream(camera, tmp_path / "front.frames", keep="all") as recording:
        assert eventually(lambda: recording.frames >= 10)
    recorded = rr.read_stream(tmp_path / "front.frames")
    frames = list(recorded)
    assert (recorded.name, recorded.server, recorded.request) == ("images", "cameras/camera", "front")
    assert recorded.response == {"device": "front", "images": {"resource_id": camera.resource_id, "name": "images"}}
    assert len(frames) == len(recorded) == recording.frames
    assert (recorded.missed, recorded.is_cut, recording.why) == (0, False, "")
    first = frames[0].number
    assert [frame.number for frame in frames] == list(range(first, first + len(frames)))
    assert [frame.value["number"] for frame in frames] == [frame.number - 1 for frame in frames]
    assert recorded.times == [frame.published_at for frame in frames]
    assert recorded.duration_s == frames[-1].published_at - frames[0].published_at > 0
    assert oct((tmp_path / "front.frames").stat().st_mode & 0o777) == "0o600"


def test_pictures_lie_in_the_pages_of_the_file(app: rr.Registrar, tmp_path: Path) -> None:
    with (
        app.load(Cameras.open_camera, "pictures") as camera,
        rr.record_stream(camera, tmp_path / "f", "images") as recording,
    ):
        assert eventually(lambda: recording.frames >= 3)
    for frame in rr.read_stream(tmp_path / "f"):
        assert (frame.value == (frame.number - 1) % 256).all()
        assert frame.value.shape == (64, 64, 3)
        assert not frame.value.flags.writeable
        assert frame.value.ctypes.data % 64 == 0


def test_a_recording_ends_with_its_query_and_at_its_limit(app: rr.Registrar, tmp_path: Path) -> None:
    camera = app.load(Cameras.open_camera, "pictures")
    small = rr.record_stream(camera, tmp_path / "small", limit_bytes=50_000)
    assert small.wait(30)
    assert small.why == "the file has reached its limit of 50000 bytes"
    assert small.frames == len(rr.read_stream(tmp_path / "small")) == 3
    assert small.size_bytes == (tmp_path / "small").stat().st_size <= 50_000
    recording = rr.record_stream(camera, tmp_path / "whole")
    camera.unload()
    assert recording.wait(30)
    assert recording.why == "the query is released"
    recording.stop()


def test_what_is_wrong_with_a_new_recording_is_named(app: rr.Registrar, tmp_path: Path) -> None:
    camera = app.load(Cameras.open_camera, "front")
    (tmp_path / "there").touch()
    new, record = tmp_path / "x", cast(Any, rr.record_stream)
    for arguments, options, said in (
        ((camera, tmp_path / "there"), {}, "there: expected a new file, got FileExistsError"),
        ((camera, tmp_path / "none" / "x"), {}, "x: expected a new file, got FileNotFoundError"),
        ((camera, 3), {}, "file: expected the file of a recorded stream, got 3"),
        ((camera, new), {"limit_bytes": 0}, "limit_bytes: expected a whole number of bytes above 0, got 0"),
        ((camera, new, "image"), {}, "has no stream 'image'; there are: 'images'"),
        ((camera, new), {"keep": "some"}, "keep: expected 'latest' or 'all', got 'some'"),
        (("camera", new), {}, "record_stream: query: expected a Query, got 'camera'"),
    ):
        with pytest.raises(rr.RrError, match=said):
            record(*arguments, **options)
    assert not new.exists()


def test_a_disk_without_room_leaves_whole_frames(tmp_path: Path) -> None:
    writer = StreamWriter(tmp_path / "f", HEADER, 2**30)
    frame = rr.StreamFrame(b"x" * 100_000, 1, 1.0, 0, rr.Stream("0" * 32, "images"))
    assert writer.write(frame)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (150_000, before[1]))
    try:
        with pytest.raises(OSError, match="File too large"):
            writer.write(frame)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert writer.write(frame)
    recorded = rr.read_stream(tmp_path / "f")
    assert (len(recorded), recorded.is_cut) == (2, False)


def test_a_file_that_is_cut_anywhere_has_the_whole_frames_before(tmp_path: Path) -> None:
    values = [{"i": i, "picture": numpy.full(5000, i, "u1")} for i in range(3)]
    data = write(tmp_path / "f", *values).read_bytes()
    counts: list[int] = []
    for cut in (*range(0, 400, 7), *range(400, len(data), 1013), len(data) - 1, len(data)):
        (tmp_path / "cut").write_bytes(data[:cut])
        try:
            recorded = rr.read_stream(tmp_path / "cut")
        except rr.ConfigError:
            assert not counts  # the header alone is missing
            continue
        counts.append(len(recorded))
        assert [frame.value["i"] for frame in recorded] == list(range(len(recorded)))
    assert counts == sorted(counts)
    assert counts[-2:] == [2, 3]


def test_a_pipe_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")

    with pytest.raises(rr.ConfigError, match=r"pipe: expected the file of a recorded stream, got .*a pipe, and no reg"):
        rr.read_stream(tmp_path / "pipe")


def test_a_file_that_is_damaged_ends_at_the_damage_or_is_refused(tmp_path: Path) -> None:
    data = bytearray(write(tmp_path / "f", *range(20)).read_bytes())
    whole = len(rr.read_stream(tmp_path / "f"))
    for at in range(0, len(data), 11):
        (tmp_path / "bad").write_bytes(data[:at] + bytes([data[at] ^ 0x5A]) + data[at + 1 :])
        try:
            recorded = rr.read_stream(tmp_path / "bad")
        except rr.ConfigError:
            assert at < len(data) - 20 * 40  # in the header
        else:
            assert [frame.value for frame in recorded] == list(range(len(recorded)))
            assert len(recorded) < whole
            assert recorded.is_cut
    for text in (b"", b"no recording", b"rr_actors stream 1\n", b"rr_actors stream 2\n" + bytes(40)):
        (tmp_path / "other").write_bytes(text)
        with pytest.raises(rr.ConfigError, match="other: expected the file of a recorded stream, got"):
            rr.read_stream(tmp_path / "other")


class Recorder(rr.Manager):
    """Records large pictures as long as it lives, each life into a file of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def on_start(self) -> None:
        self.camera = self.registrar.load(Cameras.open_camera, "large")
        self.recording = rr.record_stream(self.camera, self.folder / f"{os.getpid()}.frames")


def test_a_recorder_that_is_killed_leaves_what_can_be_read(start: Start, tmp_path: Path) -> None:
    children = [rr.ChildSpec(Cameras, id="cameras"), rr.ChildSpec(Recorder, id="recorder", args=(tmp_path,))]
    system = start(rr.Supervisor(children, max_restarts=10))
    file = tmp_path / f"{pid_of(system, 'recorder')}.frames"
    assert eventually(lambda: file.exists() and len(rr.read_stream(file)) >= 3)
    kill(system, "recorder")
    frames = list(rr.read_stream(file))
    assert len(frames) >= 3
    assert all((frame.value == (frame.number - 1) % 256).all() for frame in frames)


# -- replays -----------------------------------------------------------------------------------------------------------


def due(times: dict[str, list[float]], speed: float = 1.0, loops: bool = False, most: int = 20) -> list[Any]:
    return [(round(at, 6), name, i) for at, name, i in itertools.islice(Schedule(times, speed, loops=loops), most)]


def test_frames_are_due_as_they_were_recorded() -> None:
    assert due({"a": [10.0, 10.5, 11.5]}) == [(0, "a", 0), (0.5, "a", 1), (1.5, "a", 2)]
    assert due({"a": [10.0, 10.5, 11.5]}, speed=2.0) == [(0, "a", 0), (0.25, "a", 1), (0.75, "a", 2)]
    assert due({"a": [10.0, 11.0], "b": [10.25, 10.5]}) == [(0, "a", 0), (0.25, "b", 0), (0.5, "b", 1), (1, "a", 1)]
    assert due({"a": [10.0, 11.0]}, loops=True, most=5) == [
        (0, "a", 0),
        (1, "a", 1),
        (2, "a", 0),
        (3, "a", 1),
        (4, "a", 0),
    ]
    assert due({"a": [10.0]}, loops=True, most=3) == [(0, "a", 0), (0.01, "a", 0), (0.02, "a", 0)]
    assert due({"a": [10.0, 9.0, 11.0]}) == [(0, "a", 0), (-1, "a", 1), (1, "a", 2)]  # the clock was set back
    assert due({"a": []}, loops=True) == []


def record_front(app: rr.Registrar, file: Path) -> Path:
    with app.load(Cameras.open_camera, "front") as camera, rr.record_stream(camera, file, keep="all") as recording:
        assert eventually(lambda: recording.frames >= 20)
    return file


def frames_of(camera: rr.Query, count: int) -> list[rr.StreamFrame]:
    with camera.stream("images", keep="all", timeout_s=30) as reader:
        return list(itertools.islice(reader, count))


@pytest.fixture
def front(app: rr.Registrar, tmp_path: Path) -> Path:
    return record_front(app, tmp_path / "front.frames")


def test_a_consumer_gets_from_a_replay_what_it_got_from_the_camera(start: Start, front: Path) -> None:
    system = start(rr.ChildSpec(Replays, id="cameras", args=([front],)), state_dir=front.parent / "other")
    app = system.open_registrar("app")
    camera = app.load("cameras/camera", "front", response_type=Feed)
    assert camera.response.device == "front"
    assert camera.response.images == rr.Stream(camera.resource_id, "images")
    recorded = list(rr.read_stream(front))
    got = frames_of(camera, len(recorded) + 5)
    numbers = [frame.value["number"] for frame in got]
    first = numbers[0] - recorded[0].value["number"]
    values = [frame.value["number"] for frame in recorded]
    assert numbers == [values[(first + i) % len(values)] for i in range(len(got))]
    assert [frame.number for frame in got] == list(range(got[0].number, got[0].number + len(got)))
    assert all(0 <= frame.age_s < 60 for frame in got)
    with pytest.raises(rr.LoadFailed, match='nothing is recorded for the request "rear"; expected one of "front"'):
        app.load("cameras/camera", "rear")


def test_a_reader_goes_on_when_a_replay_was_killed(start: Start, front: Path) -> None:
    system = start(rr.ChildSpec(Replays, id="cameras", args=([front],)), state_dir=front.parent / "other")
    camera = system.open_registrar("app").load("cameras/camera", "front")
    with camera.stream("images", timeout_s=30) as reader:
        next(reader)
        wait_respawned(system, "cameras", kill(system, "cameras"))
        assert eventually(lambda: next(reader).number < 1000)
    camera.unload()
    assert eventually(lambda: not system.streams())


def test_a_file_that_is_gone_at_a_crash_ends_nothing_but_its_own_resource(
    start: Start, app: rr.Registrar, front: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rear = tmp_path / "rear.frames"
    with app.load(Cameras.open_camera, "rear") as camera, rr.record_stream(camera, rear) as recording:
        assert eventually(lambda: recording.frames >= 3)
    system = start(rr.ChildSpec(Replays, id="cameras", args=([front, rear],)), state_dir=tmp_path / "other")
    consumer = system.open_registrar("app")
    here, gone = (consumer.load("cameras/camera", device) for device in ("front", "rear"))
    rear.unlink()
    wait_respawned(system, "cameras", kill(system, "cameras"))
    assert eventually(lambda: gone.state is rr.State.FATAL)
    assert frames_of(here, 3)
    assert "cameras goes on without what it cannot read:" in caplog.text
    with pytest.raises(rr.LoadFailed, match=r'expected one of "front"; .*rear\.frames: expected the file'):
        consumer.load("cameras/camera", "rear")
    system.supervisor().terminate_child("cameras")
    with pytest.raises(rr.StartFailed, match=r"rear\.frames"):
        system.supervisor().restart_child("cameras")


def test_what_is_wrong_with_a_replay_is_named(tmp_path: Path) -> None:
    file, empty = write(tmp_path / "f", 1, 2), write(tmp_path / "empty")
    for arguments, said in (
        (([file, file],), "f: expected another stream or request than in .*f, got stream 'images' again"),
        (([empty],), "empty: expected a recorded stream with a frame, got none"),
        (([tmp_path / "none"],), "none: expected the file of a recorded stream, got FileNotFoundError"),
        (([],), r"files: expected a list of files, got \[\]"),
        ((file,), "files: expected a list of files, got"),
    ):
        with pytest.raises(rr.RrError, match=said):
            cast(Any, Replays)(*arguments)
    for options, said in (({"speed": 0}, "speed: expected a number above 0"), ({"loop": 1}, "loop: expected True or")):
        with pytest.raises(rr.UsageError, match=said):
            cast(Any, Replays)([file], **options)
