"""A connection hears at once that a query of it is released, revoked, or gone with its system."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import asdict

import rr_actors as rr
from rr_actors.base.errors import UnknownQuery, UnknownRegistrar
from rr_actors.base.values.failure import Failure, error_of, failure_of
from rr_actors.registrar.pages import QueryRow
from rr_actors.registrar.queries import Status
from rr_actors.streams.stream import ReaderRow, StreamInfo, StreamRow
from rr_actors.system.console.connected_queries import status_heard
from rr_actors.system.console.console_messages import ANSWER_LIMIT_BYTES, Heard, Message, QueryPage, Refused, Streams
from rr_actors.system.console.console_protocol import ANSWERS, decoder_of
from rr_actors.wire.frames import FrameReader, framed
from support import LIMIT_S, Calls, eventually, kill, wait_respawned

pytestmark = pytest.mark.usefixtures("runtime_dir")


class Cameras(rr.Manager):
    @rr.server("camera")
    def open_camera(self, name: str) -> str:
        self.stream = rr.current().open_stream("images")
        return name


class Unused(rr.Manager):
    @rr.server("thing")
    def make(self, name: str) -> str:
        return name


@pytest.fixture
def system(state_dir: Path) -> Iterator[rr.System]:
    with rr.System([rr.ChildSpec(Cameras, id="cameras", placement="thread")], state_dir=state_dir) as system:
        yield system


@pytest.fixture
def connection(system: rr.System, state_dir: Path) -> Iterator[rr.Connection]:
    with rr.connect(state_dir) as connection:
        yield connection


class InThread:
    """A call in a thread of its own: its result or its error."""

    def __init__(self, call: Callable[[], Any]) -> None:
        self.result: Any = None
        self.error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, args=(call,), daemon=True)
        self._thread.start()

    def _run(self, call: Callable[[], Any]) -> None:
        try:
            self.result = call()
        except BaseException as error:
            self.error = error

    def ended(self) -> InThread:
        self._thread.join(LIMIT_S)
        assert not self._thread.is_alive(), "the call still waits"
        return self


def frames(query: rr.Query[Any]) -> list[Any]:
    return list(query.stream("images"))


async def frames_async(query: rr.Query[Any]) -> list[Any]:
    return [frame async for frame in query.stream("images")]


def release_from_outside(system: rr.System, query: rr.Query[Any]) -> None:
    system.registrar(query.origin).unload(query.id)


@pytest.mark.parametrize("read", [frames, lambda query: asyncio.run(frames_async(query))], ids=["for", "async for"])
def test_a_stream_ends_when_the_query_is_released_from_outside(
    system: rr.System, connection: rr.Connection, read: Callable[[rr.Query[Any]], Any]
) -> None:
    query = connection.open_registrar("w").load("cameras/camera", "front")
    reading = InThread(lambda: read(query))

    release_from_outside(system, query)

    assert reading.ended().error is None


@pytest.mark.parametrize("read", [frames, lambda query: asyncio.run(frames_async(query))], ids=["for", "async for"])
def test_a_resource_without_a_stream_says_so_to_a_connection_at_once(
    system: rr.System, connection: rr.Connection, read: Callable[[rr.Query[Any]], Any]
) -> None:
    system.start_child(rr.ChildSpec(Unused, id="things"))
    query = connection.open_registrar("w").load("things/thing", "one")
    began = time.monotonic()

    with pytest.raises(rr.NotFound, match=r"has no stream 'images'; there are: none"):
        read(query)

    assert time.monotonic() - began < 15


def test_a_stream_of_a_manager_that_has_crashed_since_a_connections_load_is_waited_for(
    system: rr.System, connection: rr.Connection
) -> None:
    system.start_child(rr.ChildSpec(Unused, id="things"))
    worker = connection.open_registrar("w")
    before = worker.load("things/thing", "one")
    wait_respawned(system, "things", kill(system, "things"))
    later = worker.load("things/thing", "one")

    assert later.resource_id == before.resource_id
    with pytest.raises(rr.NotFound):  # this load began after the crash
        frames(later)
    with before.stream("images", timeout_s=1.0) as reader, pytest.raises(TimeoutError):
        next(reader)


def test_a_wait_for_a_status_ends_when_the_query_is_released_from_outside(
    system: rr.System, connection: rr.Connection
) -> None:
    query = connection.open_registrar("w").load("cameras/camera", "front")
    waiting = InThread(lambda: query.wait_status("FATAL", timeout_s=None))

    release_from_outside(system, query)

    assert isinstance(waiting.ended().error, UnknownQuery)


def test_a_query_that_is_released_from_outside_can_be_left_like_any_other(
    system: rr.System, connection: rr.Connection
) -> None:
    with connection.open_registrar("w").load("cameras/camera", "front") as query:
        release_from_outside(system, query)
        with pytest.raises(UnknownQuery):
            query.wait_status(timeout_s=LIMIT_S)


def test_all_queries_end_when_the_registrar_of_a_connection_is_emptied_from_outside(
    system: rr.System, connection: rr.Connection
) -> None:
    worker = connection.open_registrar("w")
    queries = [worker.load("cameras/camera", name) for name in "abc"]
    waiting = [InThread(lambda one=one: one.wait_status(timeout_s=None)) for one in queries]

    system.registrar(worker.name).unload_all()

    assert all(isinstance(one.ended().error, UnknownQuery) for one in waiting)


def test_a_revocation_has_its_reason_and_its_deadline(system: rr.System, connection: rr.Connection) -> None:
    heard = Calls()
    query = connection.open_registrar("w").load("cameras/camera", "front", on_status=heard)
    app: rr.Registrar = system.registrar("cameras")

    revoking = InThread(lambda: app.revoke(query.resource_id, "no power", grace_s=5))
    (status,) = eventually(lambda: list(heard))

    assert (status.state, status.reason, status.deadline_s, status.message) == ("FATAL", "revoked", 5.0, "no power")
    query.unload_if_held()
    revoking.ended()


def test_each_field_of_a_status_reaches_a_connection() -> None:
    slots = {name for cls in Status.__mro__ for name in getattr(cls, "__slots__", ())}
    of_status = {name for name in slots if not name.startswith("_")}
    values = {
        "state": "ERROR", "message": "m", "resource_id": "r", "query_id": "q", "source": "a/b",
        "repeated": True, "reason": "revoked", "deadline_s": 2.5,
    }  # fmt: skip

    assert of_status == set(values), "a new field of Status: does Heard have it, and status_heard() set it?"
    assert of_status | {"response", "released"} == set(Heard.__struct_fields__)
    status = status_heard(Heard(**values))
    assert {name: getattr(status, name) for name in of_status} == values


def across(message: Message) -> Any:
    """What a connected program reads of an answer of the system."""
    (read,) = FrameReader(decoder_of(ANSWERS), ANSWER_LIMIT_BYTES).feed(bytes(framed(message, ANSWER_LIMIT_BYTES)))
    return read


def test_each_field_of_a_query_row_reaches_a_connection(system: rr.System, connection: rr.Connection) -> None:
    worker = connection.open_registrar("w")
    query = worker.load("cameras/camera", "front", priority=5)
    system.registrar("cameras").send_status(query.resource_id, rr.Status("WARNING", "dirty"))
    eventually(lambda: query.state == "WARNING")
    heard: dict[str, Any] = {
        "id": query.id, "origin": worker.name, "server": "cameras/camera", "resource_id": query.resource_id,
        "parent": "", "request": '"front"', "hold": "held", "state": "WARNING", "priority": 5, "said": "", "title": "",
    }  # fmt: skip

    (row,) = worker.queries()

    assert asdict(row) == heard, "a new field of QueryRow: what does a connection hear of it?"
    heard |= {"parent": "abcd", "said": "50% opening", "title": "the front camera"}
    whole = QueryRow(**heard)
    assert across(QueryPage(1, [whole])).rows == [whole]


def test_each_field_of_a_stream_row_reaches_a_connection() -> None:
    info = {
        "id": "r/images", "name": "images", "server": "cameras/camera", "resource_id": "r", "rate_hz": 29.5,
        "bytes_per_s": 1e6, "consumers": 2, "missed": 3, "age_s": 0.25, "best_hz": 30.0,
    }  # fmt: skip
    reader = {"registrar": "app", "pid": 7, "keep": "all", "missed": 4}
    row = {"info": StreamInfo(**info), "request": "1", "frames": 8, "readers": [ReaderRow(**reader)], "title": "front"}

    for cls, values in ((StreamInfo, info), (ReaderRow, reader), (StreamRow, row)):
        assert set(cls.__struct_fields__) == set(values), f"a new field of {cls.__name__}: does it reach a connection?"
    (read,) = across(Streams(1, [StreamRow(**row)])).rows
    assert asdict(read) == row
    assert asdict(read.info) == info
    assert asdict(read.readers[0]) == reader


def test_each_field_of_a_failure_reaches_a_connection() -> None:
    frames = (rr.Frame("arms/arm", "OSError: stuck"), rr.Frame("cameras/camera", "LoadFailed: no arm"))
    details = {"server": "cameras/camera", "traceback": "Traceback: in arm.py", "known": ("a", "b"), "since": 2.5}
    error = rr.LoadFailed("no arm", trace=frames, **details)

    assert set(Failure.__struct_fields__) == {"kind", "message", "details", "trace"}
    read = error_of(across(Refused(failure_of(error))).failure)
    assert isinstance(read, rr.LoadFailed)

    assert (str(read), read.details, read.trace) == ("no arm", error.details, frames)
    assert {name: getattr(read, name) for name in details} == details
    assert read.__notes__ == ["raised in arms/arm:\nTraceback: in arm.py"]


# -- the end of the system ---------------------------------------------------------------------------------------------


@pytest.fixture
def ending(state_dir: Path) -> Iterator[rr.System]:
    system = rr.System([rr.ChildSpec(Cameras, id="cameras", placement="thread")], state_dir=state_dir).start()
    yield system
    system.stop()


def test_the_end_of_the_system_is_a_status_of_each_query(ending: rr.System, state_dir: Path) -> None:
    heard = Calls()
    with rr.connect(state_dir) as connection:
        worker = connection.open_registrar("w")
        query = worker.load("cameras/camera", "front", on_status=heard)
        worker.on_status("cameras/camera", heard)
        assert connection.ended is None

        ending.stop()

        eventually(lambda: len(heard) == 2)
        assert {(one.state, one.reason, one.query_id) for one in heard} == {("FATAL", "ended", query.id)}
        assert all(str(state_dir) in one.message for one in heard)
        assert query.state is rr.State.FATAL
        assert isinstance(connection.ended, rr.NotRunning)


def test_the_end_is_heard_also_if_statuses_come_while_the_system_stops(ending: rr.System, state_dir: Path) -> None:
    heard = Calls()
    with rr.connect(state_dir) as connection:
        query = connection.open_registrar("w").load("cameras/camera", "front", on_status=heard)
        cameras = ending.registrar("cameras")

        def say() -> None:
            with contextlib.suppress(rr.RrError):  # it has stopped
                while True:
                    cameras.send_status(query.resource_id, rr.Status("WARNING", "dirty"))

        saying = [InThread(say) for _ in range(2)]
        eventually(lambda: heard)

        ending.stop()

        eventually(lambda: list(heard)[-1].reason == "ended")
        assert all(one.ended().error is None for one in saying)


@pytest.mark.parametrize(
    "wait",
    [
        lambda query: query.wait_status("WARNING", timeout_s=None),
        frames,
        lambda query: asyncio.run(frames_async(query)),
    ],
    ids=["wait_status", "for", "async for"],
)
def test_whatever_waits_raises_that_the_system_has_ended(
    ending: rr.System, state_dir: Path, wait: Callable[[rr.Query[Any]], Any]
) -> None:
    with rr.connect(state_dir) as connection:
        query = connection.open_registrar("w").load("cameras/camera", "front")
        waiting = InThread(lambda: wait(query))

        ending.stop()

        error = waiting.ended().error
        assert isinstance(error, rr.NotRunning)
        assert "has ended" in str(error)


def test_every_call_says_in_the_same_words_that_the_system_has_ended(ending: rr.System, state_dir: Path) -> None:
    with rr.connect(state_dir) as connection:
        worker = connection.open_registrar("w")
        query = worker.load("cameras/camera", "front")
        ending.stop()
        eventually(lambda: query.state is rr.State.FATAL)

        texts = set()
        for call in (
            lambda: connection.ask("cameras", 1),
            lambda: worker.load("cameras/camera", "back"),
            lambda: worker.queries(),
            lambda: connection.open_registrar("x"),
            lambda: query.fetch_state(),
        ):
            with pytest.raises(rr.NotRunning) as caught:
                call()
            texts.add(str(caught.value))
        assert len(texts) == 1


def test_a_query_is_left_without_an_error_when_the_system_has_ended(ending: rr.System, state_dir: Path) -> None:
    with rr.connect(state_dir) as connection, connection.open_registrar("w").load("cameras/camera", "front") as query:
        ending.stop()
        eventually(lambda: query.state is rr.State.FATAL)


def test_a_connection_that_is_closed_first_hears_of_no_end(ending: rr.System, state_dir: Path) -> None:
    heard = Calls()
    connection = rr.connect(state_dir)
    query = connection.open_registrar("w").load("cameras/camera", "front", on_status=heard)
    connection.close()
    with pytest.raises(UnknownQuery):
        query.wait_status(timeout_s=LIMIT_S)

    ending.stop()

    assert connection.ended is None
    assert not heard


def test_a_connection_waits_for_a_system_that_is_being_started(state_dir: Path) -> None:
    with pytest.raises(rr.NotRunning):
        rr.connect(state_dir, wait_s=0.1)
    connecting = InThread(lambda: rr.connect(state_dir, wait_s=LIMIT_S))

    with rr.System([], state_dir=state_dir) as system, connecting.ended().result as connection:
        assert connection.pid
        assert connection.system == system.name


# -- servers by the methods that declare them --------------------------------------------------------------------------


def test_a_connection_loads_by_the_method_that_declares_the_server(
    system: rr.System, connection: rr.Connection
) -> None:
    with connection.open_registrar("w").load(Cameras.open_camera, "front") as query:
        assert query.server_id == "cameras/camera"
        assert query.response == "front"


def test_a_connection_hears_that_no_child_has_the_class(connection: rr.Connection) -> None:
    with pytest.raises(UnknownRegistrar, match="no child of this system is a"):
        connection.open_registrar("w").load(Unused.make, "lamp")
