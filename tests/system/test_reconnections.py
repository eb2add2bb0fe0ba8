"""A connection that reconnects holds after a restart of the system what it held, or hears by name what is gone."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import rr_actors as rr
from support import LIMIT_S, Calls, eventually

pytestmark = pytest.mark.usefixtures("runtime_dir")


class Cameras(rr.Manager):
    opened = 0

    @rr.server("camera")
    def open_camera(self, name: str) -> str:
        Cameras.opened += 1
        rr.current().open_stream("images").publish(name)
        return f"{name}, number {Cameras.opened}"

    def on_receive(self, message: object) -> str:
        return rr.current().origin


class Lamps(rr.Manager):
    @rr.server("lamp")
    def switch_on(self, name: str) -> str:
        return name


class Place:
    """A state directory, and the system that runs there."""

    def __init__(self, state_dir: Path) -> None:
        self.state_dir = state_dir
        self.system: rr.System | None = None

    def start(self, *managers: type[rr.Manager]) -> rr.System:
        children = [rr.ChildSpec(one, id=one.__name__.lower(), placement="thread") for one in managers]
        self.system = rr.System(children, state_dir=self.state_dir).start()
        return self.system

    def stop(self) -> None:
        if self.system is not None:
            self.system.stop()


@pytest.fixture
def place(state_dir: Path) -> Iterator[Place]:
    place = Place(state_dir)
    yield place
    place.stop()


@pytest.fixture
def connection(place: Place) -> Iterator[rr.Connection]:
    place.start(Cameras, Lamps)
    with rr.connect(place.state_dir, reconnect=True) as connection:
        yield connection


def told(calls: Calls, count: int) -> list[tuple[str, str]]:
    eventually(lambda: len(calls) == count)
    return [(str(one.state), one.reason) for one in calls]


def test_a_query_is_held_again_after_a_restart_with_its_callback_and_its_priority(
    place: Place, connection: rr.Connection
) -> None:
    heard = Calls()
    worker = connection.open_registrar("w")
    query = worker.load("cameras/camera", "front", on_status=heard)
    query.priority = 5
    id, before = query.id, query.response

    place.stop()

    assert told(heard, 1) == [("ERROR", "ended")]
    assert (query.state, query.released) == (rr.State.ERROR, False)
    for call in (
        lambda: worker.load("lamps/lamp", "a"),
        lambda: query.fetch_state(),
        lambda: connection.ask("cameras", 1),
    ):
        with pytest.raises(rr.NotRunning, match="has ended: this connection waits for its next run"):
            call()
    assert isinstance(connection.ended, rr.NotRunning)
    with pytest.raises(rr.NotRunning):
        next(query.stream("images"))

    system = place.start(Cameras, Lamps)

    assert told(heard, 2)[1] == ("OK", "reconnected")
    assert (query.id, query.state, query.released, connection.ended) == (id, rr.State.OK, False, None)
    assert query.response != before
    assert list(heard)[1].query is query
    assert query.fetch_state() == "OK"
    assert query.priority == 5
    assert worker.ask("cameras", 1) == "connection.w"
    (info,) = system.registrar("cameras").resources()
    assert (info.id, info.holders) == (query.resource_id, ("connection.w",))

    system.registrar("cameras").send_status(info.id, rr.Status("WARNING", "dirty"))
    assert query.wait_status("WARNING", timeout_s=LIMIT_S).query_id == id
    query.unload()
    assert system.registrar("cameras").resources() == []


def test_callbacks_of_queries_that_come_back_together_run_one_after_the_other(
    place: Place, connection: rr.Connection
) -> None:
    runs, overlaps, heard = threading.Lock(), Calls(), Calls()

    def on_status(status: rr.Status) -> None:
        if runs.acquire(blocking=False):
            time.sleep(0.02)  # so long another one could begin
            runs.release()
        else:
            overlaps(status)
        heard(status)

    worker = connection.open_registrar("w")
    for name in ("a", "b", "c", "d"):
        worker.load("lamps/lamp", name, on_status=on_status)
    place.stop()
    place.start(Lamps)

    assert told(heard, 8) == [("ERROR", "ended")] * 4 + [("OK", "reconnected")] * 4
    assert not overlaps


def test_what_the_next_run_does_not_have_is_lost_by_name(place: Place, connection: rr.Connection) -> None:
    worker = connection.open_registrar("w")
    gone, stays = Calls(), Calls()
    lamp = worker.load("lamps/lamp", "red", on_status=gone, timeout_s=0.5)
    camera = worker.load("cameras/camera", "front", on_status=stays)

    place.stop()
    place.start(Cameras)

    assert told(gone, 2) == [("ERROR", "ended"), ("FATAL", "ended")]
    assert "lamps/lamp: it cannot be loaded again after a restart" in list(gone)[1].message
    assert lamp.released
    assert told(stays, 2)[1] == ("OK", "reconnected")
    assert [row.server for row in worker.queries()] == ["cameras/camera"]
    lamp.unload_if_held()
    camera.unload()


def test_what_is_released_while_no_system_runs_is_not_loaded_again(place: Place, connection: rr.Connection) -> None:
    worker = connection.open_registrar("w")
    lamp = worker.load("lamps/lamp", "red")
    camera = worker.load("cameras/camera", "front")

    place.stop()
    eventually(lambda: lamp.state is rr.State.ERROR)
    lamp.unload()
    system = place.start(Cameras, Lamps)

    eventually(lambda: camera.state is rr.State.OK)
    assert system.registrar("lamps").resources() == []


def test_a_second_restart_is_like_the_first(place: Place, connection: rr.Connection) -> None:
    camera = connection.open_registrar("w").load("cameras/camera", "front")
    for _ in range(2):
        place.stop()
        eventually(lambda: camera.state is rr.State.ERROR)
        place.start(Cameras)
        eventually(lambda: camera.state is rr.State.OK)
    system = place.system
    assert system is not None
    assert [info.holders for info in system.registrar("cameras").resources()] == [("connection.w",)]


def test_a_connection_that_is_closed_while_no_system_runs_waits_for_none(
    place: Place, connection: rr.Connection
) -> None:
    worker = connection.open_registrar("w")
    camera = worker.load("cameras/camera", "front")
    place.stop()
    eventually(lambda: camera.state is rr.State.ERROR)

    connection.close()
    system = place.start(Cameras)

    with pytest.raises(rr.NotRunning):
        worker.load("cameras/camera", "front")
    assert system.registrar("cameras").resources() == []


PROGRAM = """
import sys
import rr_actors as rr
class Gate(rr.Actor):
    def on_start(self):
        sys.stdin.readline()
class Lamps(rr.Manager):
    @rr.server("lamp", recovery="keep")
    def switch_on(self, name: str) -> str:
        return name
    @rr.server("key", recovery="keep", exclusive=True)
    def turn(self, name: str) -> str:
        return name
children = [rr.ChildSpec(one, id=one.__name__.lower(), placement="thread") for one in (Gate, Lamps)]
with rr.System(children, state_dir=sys.argv[1]) as system:
    print("runs", flush=True)
    system.run()
"""


@pytest.fixture
def run(state_dir: Path) -> Iterator[Callable[..., int]]:
    started: list[subprocess.Popen[str]] = []

    def run(before: Callable[[], object] = lambda: None) -> int:
        """Start the system; its manager when `before` has returned."""
        command = [sys.executable, "-c", PROGRAM, str(state_dir)]
        started.append(subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
        stdin, stdout = started[-1].stdin, started[-1].stdout
        assert stdin is not None
        assert stdout is not None
        before()
        stdin.write("\n")
        stdin.flush()
        assert stdout.readline() == "runs\n"
        return started[-1].pid

    yield run
    for process in started:
        process.terminate()
        process.communicate()


def test_a_system_that_was_killed_is_waited_for_too(run: Callable[[], int], state_dir: Path) -> None:
    heard = Calls()
    killed = run()
    with rr.connect(state_dir, reconnect=True) as connection, connection.open_registrar("w") as worker:
        assert connection.pid == killed
        lamp = worker.load("lamps/lamp", "red", on_status=heard)

        os.kill(killed, signal.SIGKILL)
        assert told(heard, 1) == [("ERROR", "ended")]
        again = run()

        assert told(heard, 2)[1] == ("OK", "reconnected")
        assert connection.pid == again
        assert lamp.fetch_state() == "OK"


def test_what_a_killed_system_held_for_a_connection_is_not_held_twice(run: Callable[..., int], state_dir: Path) -> None:
    """The program is back before the managers that have the queries of its time before."""
    killed = run()
    with rr.connect(state_dir, reconnect=True) as client, client.open_registrar("w") as worker:
        red, blue = (worker.load("lamps/lamp", name) for name in ("red", "blue"))
        key = worker.load("lamps/key", "door")
        os.kill(killed, signal.SIGKILL)
        eventually(lambda: key.state is rr.State.ERROR)
        blue.unload()

        def is_back() -> bool:
            try:
                return len(worker.queries()) == 2
            except rr.NotRunning:
                return False

        def held() -> list[tuple[str, str]]:
            return sorted((row.request, row.hold) for row in worker.queries())

        def when_back() -> None:
            eventually(is_back)
            for query in (red, key):
                with pytest.raises(rr.Unavailable, match="it is being loaded again"):
                    query.fetch_state()

        run(when_back)
        eventually(lambda: (red.state, key.state) == (rr.State.OK, rr.State.OK))
        eventually(lambda: held() == [('"door"', "held"), ('"red"', "held")])
        red.unload()
        key.unload()
        eventually(lambda: held() == [])
