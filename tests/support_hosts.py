"""What the tests of hosts share: a manager with cameras, one that needs them, and systems that find each other."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path

import rr_actors as rr
from support_transports import free_port


class Cameras(rr.Manager):
    """Serves cameras: the response counts the loads, and names the process."""

    @rr.server("camera")
    def load_camera(self, request: str) -> dict[str, str]:
        if request == "broken":
            raise ValueError("no such device")
        return {"device": request}

    @rr.server("scope", exclusive=True)
    def load_scope(self, request: str) -> str:
        return request

    @load_camera.recover
    def again(self, request: str, response: dict[str, str]) -> dict[str, str]:
        return response


class Maps(rr.Manager):
    """Serves maps, each made from a camera of hostc."""

    @rr.server("map")
    def load_map(self, request: str) -> dict[str, str]:
        camera = self.registrar.load("cameras/camera", request)
        return {"map": camera.response["device"]}


class Warmed(rr.Manager):
    """Serves what says how far its load has come."""

    @rr.server("lamp")
    def load_lamp(self, request: str) -> str:
        rr.current().progress(0.5, "warm")
        return request


class Loops(rr.Manager):
    """Serves what needs the same of the other host, which needs it of this one: a ring."""

    @rr.server("loop")
    def load_loop(self, request: str) -> str:
        return self.registrar.load("other/loop", request).response


def endpoint() -> str:
    """Return an endpoint on loopback that nothing uses now."""
    return f"tcp/127.0.0.1:{free_port()}"


def cameras_at(state_dir: Path, listen: str, name: str = "hostb", to: tuple[str, ...] | None = None) -> rr.System:
    """Return a system that exports cameras, not started."""
    hosts = rr.Hosts(name, listen=[listen], exports={"cameras": rr.Export(to=to)})
    return rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir=state_dir, hosts=hosts)


class Proxy:
    """A network between two hosts that can be held up: connect to `endpoint` to reach `target`."""

    def __init__(self, target: str) -> None:
        self._target = int(target.rpartition(":")[2])
        self._flows = threading.Event()
        self._flows.set()
        self._closed = False
        self._threads: list[threading.Thread] = []
        self._sockets: list[socket.socket] = []
        self._server = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._server.getsockname()[1]}"
        self._begin(self._accept)

    def _begin(self, run: Callable[..., None], *arguments: object) -> None:
        self._threads.append(threading.Thread(target=run, args=arguments))
        self._threads[-1].start()

    def _accept(self) -> None:
        while not self._closed:
            try:
                near, _ = self._server.accept()
                self._sockets.append(near)
                far = socket.create_connection(("127.0.0.1", self._target))
            except OSError:
                if self._sockets:
                    self._sockets[-1].close()
                continue
            self._sockets.append(far)
            self._begin(self._pass_on, near, far)
            self._begin(self._pass_on, far, near)

    def _pass_on(self, near: socket.socket, far: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := near.recv(65536):
                self._flows.wait()
                far.sendall(data)
        for one in (near, far):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def hold(self) -> None:
        """Bring nothing on, in both directions, until go(); nothing is lost."""
        self._flows.clear()

    def go(self) -> None:
        """Bring on what was held up, and what comes."""
        self._flows.set()

    def __enter__(self) -> Proxy:
        return self

    def __exit__(self, *_raised: object) -> None:
        self._closed = True
        self.go()
        with contextlib.suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        for one in self._sockets:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        for thread in self._threads:
            thread.join()


def until(condition: Callable[[], bool], what: str, limit_s: float = 30.0) -> None:
    """Wait until a condition holds; fail after `limit_s` seconds."""
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline, f"not within {limit_s:g} s: {what}"
        time.sleep(0.01)
