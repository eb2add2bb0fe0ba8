"""Replays: the manager that serves recorded streams in the place of the manager whose streams they were.

The files say which servers there were, and with which requests and responses. So an application that loads
"cameras/camera" runs with a manager `Replays` under the id "cameras", without a camera and without a change.
"""

from __future__ import annotations

import heapq
import os
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

import msgspec

from rr_actors.base.checks import is_number, path_text
from rr_actors.base.errors import ConfigError, NotFound, UsageError, few, shown, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.canonical import encode, json_of, shown_plain
from rr_actors.managers.planning.kept_record import KeptRecord
from rr_actors.registrar.manager import Beginning, Manager
from rr_actors.registrar.servers.callback_context import current
from rr_actors.streams.publisher import Publisher
from rr_actors.streams.stream_file import RecordedStream, header_of

logger = Log("rr_actors.managers.replays")

_LEAST_GAP_S = 0.01  # between two rounds of a loop that has one frame

P = TypeVar("P")


class Schedule(Generic[P]):
    """When the frames of some recordings are due, from the start of the first round. Pure.

    Args:
        times: of each recording, when its frames were published.
        speed: how many seconds of the recordings pass in one second.
        loops: whether the first frame follows the last one, after the mean time between two.
    """

    def __init__(self, times: Mapping[P, Sequence[float]], speed: float, *, loops: bool) -> None:
        self._times, self._speed, self._loops = times, speed, loops

    def __iter__(self) -> Iterator[tuple[float, P, int]]:
        """Yield (seconds from the start, recording, number of the frame in it), in the order of time.

        A clock that was set back while the stream was recorded does not send a frame back: it is due at once.
        """
        some = [[(at, i, name) for i, at in enumerate(times)] for name, times in self._times.items() if times]
        if not some:
            return
        began = min(times[0][0] for times in some)
        whole_s = max(max(at for at, _, _ in times) for times in some) - began
        most = max(map(len, some))
        round_s = max(whole_s + (whole_s / (most - 1) if most > 1 else 0.0), _LEAST_GAP_S)
        start_s = 0.0
        while True:
            for at, i, name in heapq.merge(*some, key=lambda one: one[0]):
                yield (start_s + at - began) / self._speed, name, i
            if not self._loops:
                return
            start_s += round_s


class _Served(msgspec.Struct):
    """The run of the system that has read the files, and the server of each."""

    run: str = ""
    servers: dict[str, str] = {}


class Replays(Manager):
    """Serves recorded streams: publishes their frames in the times in which they were recorded.

    It has the servers that the files name, each for the requests that the files have. The response is that of the
    recorded resource as plain data; what names its streams names those of the replay. All streams of a resource begin
    when it is loaded, and each resource that is loaded anew begins anew.

    If a file is gone or damaged when the supervisor restarts the manager, the others are served, and the log has a
    WARNING. Who holds a resource of that file hears FATAL.
    """

    _rr_side_by_side = True

    def __init__(self, files: Sequence[str | os.PathLike[str]], *, speed: float = 1.0, loop: bool = True) -> None:
        """Read what the files of rr.record_stream() have; their values are read when they are due.

        Args:
            files: they have pickles, so code of their writers may run here.
            speed: 2.0: twice as fast as it was.
            loop: whether the first frame follows the last one. If not, the streams stay open, and have no more frames.

        Raises:
            ConfigError: a file cannot be read, is no recorded stream, has no frame, or two are of the same stream of
                the same resource.
            UsageError: another argument is wrong.
        """
        if not is_number(speed) or speed <= 0:
            raise UsageError(f"Replays: speed: expected a number above 0, got {shown(speed)}")
        if not isinstance(loop, bool):  # pyright: ignore[reportUnnecessaryIsInstance]
            raise UsageError(f"Replays: loop: expected True or False, got {shown(loop)}")
        if not isinstance(files, list | tuple) or not files:
            raise UsageError(f"Replays: files: expected a list of files, got {shown(cast('object', files))}")
        self._servers: dict[str, _Server] = {}
        self._speed, self._loops = float(speed), loop
        beginning = self._rr_beginning()
        if beginning is None:
            self._read_files(files, {})
        else:
            self._begin_with(beginning, files)

    def _begin_with(self, beginning: Beginning, files: Sequence[str | os.PathLike[str]]) -> None:
        record = KeptRecord(beginning.directory / "replays.json", _Served)
        is_restart = record.now.run == beginning.run and not beginning.by_hand
        servers, problems = self._read_files(files, record.now.servers if is_restart else {})
        said = f"goes on without what it cannot read: {'; '.join(problems)}" if problems else ""
        if said:
            logger.warning("%s %s", beginning.name, said)
        beginning.note(said)
        if not is_restart:
            record.now = _Served(beginning.run, servers)
            record.save()

    def _read_files(
        self, files: Sequence[str | os.PathLike[str]], before: Mapping[str, str]
    ) -> tuple[dict[str, str], list[str]]:
        """Read the files; return the server of each, and what is wrong with those that were right `before`."""
        servers: dict[str, str] = {}
        problems: list[str] = []
        for file in files:
            path = str(Path(path_text(file)).absolute())
            try:
                servers[path] = self._add(RecordedStream(file))
            except ConfigError as error:
                if path not in before:
                    raise
                self._server(before[path]).unread.append(str(error))
                problems.append(str(error))
        return servers, problems

    def _add(self, recorded: RecordedStream) -> str:
        if not recorded.frames:
            raise _wrong(recorded, "a recorded stream with a frame", "none")
        name = recorded.server.rpartition("/")[2]
        self._server(name).add(recorded)
        return name

    def _server(self, name: str) -> _Server:
        if name not in self._servers:
            self._servers[name] = _Server(name, self._speed, loops=self._loops)
        return self._servers[name]

    def on_start(self) -> None:
        """Serve what the files name."""
        for name, server in self._servers.items():
            self.registrar.register_server(name, server.load, server.unload, recovery="reload")

    def on_stop(self) -> None:
        """End the replays."""
        for server in self._servers.values():
            server.stop()


class _Server:
    """A server of recorded resources.

    Attributes:
        unread: why files of this server cannot be read any more.
    """

    def __init__(self, name: str, speed: float, *, loops: bool) -> None:
        self._name, self._speed, self._loops = name, speed, loops
        self._streams: dict[bytes | None, dict[str, RecordedStream]] = {}  # by the request; None: by any
        self._stops: dict[str, threading.Event] = {}  # of the replays that run, by resource
        self.unread: list[str] = []

    def add(self, recorded: RecordedStream) -> None:
        """Serve a recorded stream, too."""
        request = None if header_of(recorded).request is None else encode(recorded.request)
        streams = self._streams.setdefault(request, {})
        if (other := streams.get(recorded.name)) is not None:
            raise _wrong(recorded, f"another stream or request than in {other.file}", f"stream {recorded.name!r} again")
        streams[recorded.name] = recorded

    def load(self, request: Any) -> Any:
        """Open the streams of a resource, and begin to publish."""
        asked = encode(shown_plain(encode(request)))
        streams = self._streams.get(asked, self._streams.get(None))
        if streams is None:
            known = [json_of(shown_plain(raw)) for raw in self._streams if raw is not None]
            text = f"server {self._name!r}: nothing is recorded for the request {json_of(shown_plain(asked))}"
            text = "; ".join([f"{text}; expected one of {few(known) or 'none'}", *self.unread])
            raise NotFound(text, id=self._name, known=tuple(known))
        me = current()
        publishers = {stream: me.open_stream(stream) for stream in streams}
        stop = self._stops[me.resource_id] = threading.Event()
        replay = _Replay(streams, publishers, stop, self._speed, loops=self._loops)
        threading.Thread(target=replay.run, args=(me.loaded,), name=f"replay {self._name}", daemon=True).start()
        recorded = next(iter(streams.values()))
        return _renamed(recorded.response, recorded.resource_id, me.resource_id)

    def unload(self, request: Any, response: Any) -> None:
        """End the replay of a resource."""
        if (stop := self._stops.pop(current().resource_id, None)) is not None:
            stop.set()

    def stop(self) -> None:
        """End all replays."""
        for stop in list(self._stops.values()):
            stop.set()


class _Replay:
    """The streams of one resource, while they are published."""

    def __init__(
        self,
        streams: Mapping[str, RecordedStream],
        publishers: Mapping[str, Publisher],
        stop: threading.Event,
        speed: float,
        *,
        loops: bool,
    ) -> None:
        self._streams, self._publishers, self._stop = streams, publishers, stop
        self._schedule = Schedule({name: one.times for name, one in streams.items()}, speed, loops=loops)
        self._unread: set[str] = set()

    def run(self, loaded: threading.Event) -> None:
        """Publish each frame when it is due; one that is late follows at once."""
        loaded.wait()
        began = time.monotonic()
        for due_s, name, i in self._schedule:
            if self._stop.wait(max(0.0, began + due_s - time.monotonic())):
                return
            self._publish(name, i)

    def _publish(self, name: str, i: int) -> None:
        publisher = self._publishers[name]
        if not publisher.wanted:
            publisher.publish(None)  # it counts
            return
        try:
            publisher.publish(self._streams[name].frame(i).value)
        except Exception as error:  # of the value's own code
            if name not in self._unread:
                self._unread.add(name)
                logger.warning("%s: frames cannot be read here: %s", self._streams[name].file, text_of(error))


def _renamed(response: Any, before: str, now: str) -> Any:
    """Return a plain response with the streams of another resource in the place of those that it names."""
    if isinstance(response, dict):
        table = cast("dict[Any, Any]", response)
        if table.keys() == {"resource_id", "name"} and table["resource_id"] == before:
            return {**table, "resource_id": now}
        return {key: _renamed(value, before, now) for key, value in table.items()}
    if isinstance(response, list | tuple):
        parts = [_renamed(part, before, now) for part in cast("Sequence[Any]", response)]
        return parts if isinstance(response, list) else tuple(parts)
    return response


def _wrong(recorded: RecordedStream, expected: str, got: str) -> ConfigError:
    text = f"Replays: {recorded.file}: expected {expected}, got {got}"
    return ConfigError(text, file=str(recorded.file), key="", expected=expected, got=got)
