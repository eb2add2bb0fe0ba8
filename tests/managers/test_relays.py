"""Relays: a program connects once, and hears another source when the one that it heard has failed."""

from __future__ import annotations

import contextlib
import os
import socket
import socketserver
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.managers import Alternative, Choices, Choose
from support import Served, eventually, kill, serve, wait_respawned

Start = Callable[..., rr.System]
LIMIT_S = 30.0
BOUND = Choose("range", bind="relay")


class Answer(socketserver.StreamRequestHandler):
    """Say hello, and answer each line; or send zeros until nobody has read for a second, if the line is "zeros"."""

    server: Any

    def handle(self) -> None:
        name = self.server.source.name
        with contextlib.suppress(OSError):
            self.wfile.write(f"hello {name}\n".encode())
            for line in self.rfile:
                if line == b"zeros\n":
                    self.zeros()
                self.wfile.write(f"{name}: ".encode() + line)

    def zeros(self) -> None:
        self.connection.settimeout(1)
        with contextlib.suppress(TimeoutError):
            while True:
                self.server.source.sent += self.connection.send(bytes(10_000))
        self.server.source.is_stuck.set()
        self.connection.settimeout(None)


class UnixServer(socketserver.ThreadingUnixStreamServer):
    daemon_threads = True


class TcpServer(socketserver.ThreadingTCPServer):
    daemon_threads = True


class Source:
    """A server of lines at a Unix socket, or at a TCP port if `path` is None. A context manager."""

    def __init__(self, name: str, path: Path | None) -> None:
        self.name, self.sent, self.is_stuck = name, 0, threading.Event()
        self.accepted: list[socket.socket] = []
        server: Any
        if path is None:
            server = TcpServer(("127.0.0.1", 0), Answer)
            self.address = f"tcp:127.0.0.1:{server.server_address[1]}"
        else:
            server = UnixServer(str(path), Answer)
            self.address = f"unix:{path}"
        server.source = self
        process_request = server.process_request

        def accept(request: socket.socket, client: Any) -> None:
            self.accepted.append(request)
            process_request(request, client)

        server.process_request = accept
        self._server = server
        self._thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)

    def __enter__(self) -> Source:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """End as a process does that is killed: all its sockets are closed."""
        self._server.shutdown()
        for one in self.accepted:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
        self.close()

    def close(self) -> None:
        """Close what listens, also if it never ran."""
        self._server.server_close()
        if self.address.startswith("unix:"):
            Path(self.address.removeprefix("unix:")).unlink(missing_ok=True)


class Program:
    """A program that knows nothing but an address."""

    def __init__(self, address: str) -> None:
        kind, _, rest = address.partition(":")
        host, _, port = rest.rpartition(":")
        self.socket = socket.socket(socket.AF_UNIX if kind == "unix" else socket.AF_INET)
        self.socket.settimeout(LIMIT_S)
        try:
            self.socket.connect(rest if kind == "unix" else (host, int(port)))
        except OSError:
            self.socket.close()
            raise
        self._file = self.socket.makefile("rb")

    def hears(self) -> str:
        return self._file.readline().decode().strip()

    def says(self, line: str) -> None:
        self.socket.sendall(f"{line}\n".encode())

    def asks(self, line: str) -> str:
        self.says(line)
        return self.hears()

    def reads(self, count: int) -> bytes:
        return self._file.read(count)


class World:
    """Choices, and the sensors "camera" and "lidar" in this process, each with a source."""

    def __init__(self, start: Start, folder: Path, kinds: str = "unix unix", **options: Any) -> None:
        options = {"settle_s": 600, **options}
        named = zip(("camera", "lidar"), kinds.split(), strict=True)
        self.sources = {name: Source(name, folder / name if kind == "unix" else None) for name, kind in named}
        alternatives = [Alternative("range", f"sensors/{name}") for name in self.sources]
        choices = rr.ChildSpec(Choices, id="choices", args=(alternatives,), kwargs=options)
        self.system = start(rr.Supervisor([choices], max_restarts=1000))
        self.app, self.sensors = self.system.open_registrar("app"), self.system.open_registrar("sensors")
        self.answers: dict[str, Any] = {name: {"address": one.address} for name, one in self.sources.items()}
        self.served = {name: self._serve(name) for name in self.sources}

    def _serve(self, name: str) -> Served:
        return serve(self.sensors, name, lambda request: self.answers[name])

    def choose(self, request: Choose = BOUND) -> Any:
        return self.app.load("choices/choice", request, timeout_s=LIMIT_S)

    def fail(self, name: str) -> None:
        (found,) = [info for info in self.sensors.resources() if info.server == name]
        self.sensors.send_status(found, rr.Status("FATAL", "unplugged"))


@contextlib.contextmanager
def running(world: World) -> Iterator[World]:
    with contextlib.ExitStack() as sources:
        for one in world.sources.values():
            sources.enter_context(one)
        yield world


def close_all(world: World) -> None:
    for one in world.sources.values():
        one.close()


@pytest.mark.parametrize("kinds", ["unix unix", "tcp tcp", "unix tcp", "tcp unix"])
def test_a_connection_stays_open_when_the_source_changes(start: Start, tmp_path: Path, kinds: str) -> None:
    with running(World(start, tmp_path, kinds)) as world:
        choice = world.choose()
        address = choice.response.address
        assert address.startswith(kinds.split()[0] + ":")
        program = Program(address)
        assert program.hears() == "hello camera"
        assert program.asks("how far") == "camera: how far"
        world.fail("camera")
        assert program.hears() == "hello lidar"
        assert program.asks("how far") == "lidar: how far"
        eventually(lambda: (choice.response.server, choice.response.address) == ("sensors/lidar", address))
        assert Program(address).hears() == "hello lidar"


def test_a_source_that_ends_without_a_word_is_connected_to_again(start: Start, tmp_path: Path) -> None:
    with running(World(start, tmp_path)) as world:
        program = Program(world.choose().response.address)
        assert program.hears() == "hello camera"
        for one in list(world.sources["camera"].accepted):
            one.shutdown(socket.SHUT_RDWR)
        assert program.hears() == "hello camera"


def test_what_a_program_sends_without_a_source_is_kept_for_the_next(start: Start, tmp_path: Path) -> None:
    world = World(start, tmp_path)
    with world.sources["lidar"]:
        program = Program(world.choose().response.address)
        with world.sources["camera"]:
            assert program.hears() == "hello camera"
        late = Program(world.choose().response.address)
        late.says("early")
        world.fail("camera")
        assert {late.hears(), late.hears()} == {"hello lidar", "lidar: early"}
        assert program.hears() == "hello lidar"


def test_an_update_of_the_address_is_followed(start: Start, tmp_path: Path) -> None:
    with running(World(start, tmp_path)) as world:
        program = Program(world.choose().response.address)
        assert program.hears() == "hello camera"
        world.sensors.update_response(world.sensors.resources()[0], {"address": world.sources["lidar"].address})
        assert program.hears() == "hello lidar"
        world.sensors.update_response(world.sensors.resources()[0], {"address": "nowhere"})
        eventually(lambda: world.served["lidar"].loads, LIMIT_S, "the lidar in the place of what has no address")


def test_a_source_waits_for_a_program_that_does_not_read_and_nothing_is_lost(start: Start, tmp_path: Path) -> None:
    with running(World(start, tmp_path)) as world:
        program, camera = Program(world.choose().response.address), world.sources["camera"]
        assert program.hears() == "hello camera"
        program.says("zeros")
        assert camera.is_stuck.wait(LIMIT_S)
        assert camera.sent < 3_000_000
        assert program.reads(camera.sent) == bytes(camera.sent)
        assert program.hears() == "camera: zeros"


def test_a_program_waits_for_a_source_that_is_not_there(start: Start, tmp_path: Path) -> None:
    with running(World(start, tmp_path)) as world:
        world.answers["camera"] = f"unix:{tmp_path}/nobody"
        program = Program(world.choose().response.address)
        program.socket.settimeout(1)
        sent = 0
        with contextlib.suppress(TimeoutError):
            while sent < 10_000_000:
                sent += program.socket.send(bytes(10_000))
        assert sent < 3_000_000


def test_one_program_too_many_is_refused_and_the_others_stay(start: Start, tmp_path: Path) -> None:
    with running(World(start, tmp_path)) as world:
        address = world.choose().response.address
        programs = [Program(address) for _ in range(64)]
        assert [one.hears() for one in programs] == ["hello camera"] * 64
        assert Program(address).hears() == ""
        programs.pop().socket.shutdown(socket.SHUT_RDWR)
        eventually(lambda: Program(address).hears() == "hello camera", LIMIT_S, "room for one more")


class Ranges(rr.Manager):
    """Serves a source in its own process."""

    def __init__(self, folder: str) -> None:
        self._folder = folder

    @rr.server("range", recovery="lost")
    def open_range(self) -> str:
        (Path(self._folder) / "own").unlink(missing_ok=True)
        return Source("own", Path(self._folder) / "own").__enter__().address


def test_a_connection_survives_a_kill_of_its_source_and_an_address_one_of_choices(start: Start, tmp_path: Path) -> None:
    alternatives = [Alternative("range", f"{id}/range") for id in ("first", "second")]
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder in folders:
        folder.mkdir()
    managers = [
        rr.ChildSpec(Ranges, id=id, args=(str(folder),))
        for id, folder in zip(("first", "second"), folders, strict=True)
    ]
    choices = rr.ChildSpec(Choices, id="choices", args=(alternatives, 600))
    system = start(rr.Supervisor([*managers, choices], max_restarts=1000))
    choice = system.open_registrar("app").load("choices/choice", BOUND, timeout_s=LIMIT_S)
    address = choice.response.address
    program = Program(address)
    assert program.hears() == "hello own"
    kill(system, "first")
    assert program.hears() == "hello own"
    eventually(lambda: choice.response.server == "second/range", LIMIT_S, "the second in use")
    wait_respawned(system, "choices", kill(system, "choices"))
    assert program.hears() == "", "its connection was the killed process's"
    eventually(lambda: os.path.exists(address.removeprefix("unix:")), LIMIT_S, "the address")

    def again() -> bool:
        with contextlib.suppress(OSError):
            return Program(address).hears() == "hello own"
        return False

    eventually(again, LIMIT_S, "the relay at its address")
    assert choice.response.address == address
    system.stop()
    for folder in folders:
        (folder / "own").unlink(missing_ok=True)


def threads() -> list[str]:
    return [one.name for one in threading.enumerate() if one.name == "choices-relays"]


def test_a_release_and_a_stop_leave_no_thread_and_no_socket(start: Start, tmp_path: Path) -> None:
    """In this process. After each test, a fixture looks for sockets and threads that it has left."""
    with running(World(start, tmp_path)) as world:
        choices = rr.ChildSpec(Choices, id="here", args=([Alternative("range", "sensors/camera")],), placement="thread")
        world.system.start_child(choices)
        choice = world.app.load("here/choice", BOUND, timeout_s=LIMIT_S)
        path = choice.response.address.removeprefix("unix:")
        program = Program(choice.response.address)
        assert program.hears() == "hello camera"
        assert threads() == ["choices-relays"]
        choice.unload()
        assert program.hears() == ""
        assert not os.path.exists(path)
        world.system.supervisor().terminate_child("here")
        assert threads() == []


WRONG: list[tuple[Any, str]] = [
    ("/dev/camera", "'unix:/path' or 'tcp:host:port', got '/dev/camera'"),
    ({"topic": "/camera"}, "'unix:/path' or 'tcp:host:port', got None"),
    ({"address": 5}, "'unix:/path' or 'tcp:host:port', got 5"),
    ("unix:camera", "'unix:/path' or"),
    ("unix:/" + "x" * 200, "a path of at most 107 bytes"),
    ("tcp:127.0.0.1", "'unix:/path' or"),
    ("tcp:127.0.0.1:0", "'unix:/path' or"),
    ("tcp:127.0.0.1:65536", "'unix:/path' or"),
    ("tcp:10.0.0.1:80", "an address of this machine, or of one of relay_hosts"),
    ("tcp:example.org:80", "an address of this machine, or of one of relay_hosts"),
]


def test_an_alternative_without_an_address_is_passed_over_and_named(start: Start, tmp_path: Path) -> None:
    world = World(start, tmp_path, relay_hosts=("10.0.0.2",))
    close_all(world)
    world.answers["lidar"] = "nothing"
    for answer, says in WRONG:
        world.answers["camera"] = answer
        with pytest.raises(rr.LoadFailed, match=r"(?s)nothing is left for 'range'.*relay: address: expected") as raised:
            world.choose()
        assert says in str(raised.value)
    eventually(lambda: not world.sensors.resources(), LIMIT_S, "all released")
    assert not list(world.system.registrar("choices").resources())
    world.answers["camera"] = "tcp:10.0.0.2:80"
    assert world.choose().response.address.startswith("tcp:127.0.0.1:")


def test_another_word_for_bind_and_a_host_that_is_none_are_refused_by_name(start: Start, tmp_path: Path) -> None:
    world = World(start, tmp_path)
    close_all(world)
    with pytest.raises(rr.InvalidRequest, match="bind"):
        world.app.load("choices/choice", {"kind": "range", "bind": "mux"})
    with pytest.raises(rr.StartFailed, match=r"relay_hosts\[0\]: expected the name or number of a host, got 5"):
        world.system.start_child(rr.ChildSpec(Choices, id="more", args=([],), kwargs={"relay_hosts": [5]}))
