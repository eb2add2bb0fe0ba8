"""rr.connect(): another process of the user loads, asks and releases; when it is gone, so is what it held."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.base.errors import (
    ConfigError,
    InvalidName,
    InvalidSpec,
    LoadFailed,
    NameTaken,
    NotFound,
    NotSerializable,
    RrError,
    Unavailable,
    UnknownQuery,
    UsageError,
)
from rr_actors.base.values.canonical import encode
from rr_actors.system.console import connection as the_connection
from rr_actors.system.console import console_connection, console_server, console_view
from rr_actors.system.console.connected_queries import ConnectedViews, SystemConnections
from rr_actors.system.console.console_commands import Hold
from rr_actors.system.console.console_connection import ConsoleConnection, NotRunning
from rr_actors.system.console.console_questions import Find
from rr_actors.wire.unix_sockets import SocketPeer
from support import LIMIT_S, TESTS, Calls, Gate, Served, Workshop, eventually, serve, wait_gone
from support_interrupts import interrupted
from support_managers import Made, Order, Shop

pytestmark = pytest.mark.usefixtures("runtime_dir")

Start = Callable[..., rr.System]


@pytest.fixture
def camera(provider: rr.Registrar) -> Served:
    """A server of this process."""
    return serve(provider, "camera")


class NotedConnections(SystemConnections):
    """`opened`: all that were opened."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self.opened: list[ConsoleConnection] = []

    def open(self, greeting_s: float = console_connection.GREETING_S) -> ConsoleConnection:
        self.opened.append(super().open(greeting_s))
        return self.opened[-1]


@pytest.fixture
def sockets(monkeypatch: pytest.MonkeyPatch) -> list[NotedConnections]:
    """The sockets of each connection that is made."""
    made: list[NotedConnections] = []

    def noted(*args: Any, **options: Any) -> NotedConnections:
        made.append(NotedConnections(*args, **options))
        return made[-1]

    monkeypatch.setattr(the_connection, "SystemConnections", noted)
    return made


@pytest.fixture
def connection(sockets: list[NotedConnections], camera: Served, state_dir: Path) -> Iterator[rr.Connection]:
    """A connection of the running system."""
    with rr.connect(state_dir) as connection:
        yield connection


Program = Callable[..., "subprocess.Popen[str]"]


@pytest.fixture
def program(state_dir: Path) -> Iterator[Program]:
    """Start a process that connects and holds something; it is killed after the test."""
    running: list[subprocess.Popen[str]] = []

    def begin(name: str, server: str, request: str) -> subprocess.Popen[str]:
        command = [sys.executable, str(TESTS / "support_connections.py"), str(state_dir), name, server, request]
        running.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        return running[-1]

    yield begin
    for process in running:
        process.kill()
        process.communicate()


def holders(provider: rr.Registrar) -> list[str]:
    return [name for resource in provider.resources() for name in resource.holders]


def test_a_connection_loads_shares_and_releases(
    connection: rr.Connection, camera: Served, provider: rr.Registrar
) -> None:
    worker = connection.open_registrar("worker")
    first = worker.load("provider/camera", "front")
    again = connection.open_registrar("other").load("provider/camera", "front")

    assert first.response == again.response
    assert first.resource_id == again.resource_id
    assert camera.loads.items == ["front"]
    assert sorted(holders(provider)) == ["connection.other", "connection.worker"]
    assert [row.id for row in worker.queries()] == [first.id]
    first.unload()
    assert holders(provider) == ["connection.other"]
    again.unload()
    assert provider.resources() == []
    with pytest.raises(UnknownQuery):
        again.unload()


def test_what_a_connection_holds_is_released_when_it_is_killed(
    camera: Served, system: rr.System, provider: rr.Registrar, program: Program
) -> None:
    process = program("worker", "provider/camera", "front")
    assert process.stdout is not None
    assert process.stdout.readline()
    assert holders(provider) == ["connection.worker"]

    process.send_signal(signal.SIGKILL)
    wait_gone(process.pid)

    eventually(lambda: provider.resources() == [])
    assert len(camera.unloads) == 1
    eventually(lambda: "connection.worker" not in system.snapshot()["registrars"])
    replaced = program("worker", "provider/camera", "front")  # the name is free again
    assert replaced.stdout is not None
    assert replaced.stdout.readline()


def test_a_connection_killed_in_the_middle_of_a_load_leaves_nothing(
    provider: rr.Registrar, gate: Gate, program: Program
) -> None:
    serve(provider, "slow", load=gate)
    process = program("worker", "provider/slow", "front")
    gate.wait_arrived()
    process.kill()
    wait_gone(process.pid)
    gate.open()

    eventually(lambda: provider.resources() == [])


def test_what_is_closed_is_released(connection: rr.Connection, provider: rr.Registrar) -> None:
    with connection.open_registrar("worker") as worker:
        worker.load("provider/camera", "front")
    eventually(lambda: provider.resources() == [])
    connection.open_registrar("worker").load("provider/camera", "front")
    connection.close()
    eventually(lambda: provider.resources() == [])

    with pytest.raises(NotRunning, match="the connection is closed"):
        connection.open_registrar("worker")


def test_connections_are_counted_and_not_their_sockets(start: Start, state_dir: Path) -> None:
    system = start(config=rr.SystemConfig(connections_limit=3))
    serve(system.open_registrar("provider"), "camera")
    with contextlib.ExitStack() as stack:
        connections = [stack.enter_context(rr.connect(state_dir)) for _ in range(3)]
        for number, connection in enumerate(connections):
            for name in ("a", "b"):  # each has a socket of its own
                connection.open_registrar(f"{name}{number}").load("provider/camera", "front")
        with pytest.raises(Unavailable, match=r"3 programs are connected already: .* connections_limit"):
            rr.connect(state_dir)
        connections.pop().close()
        connections[0].open_registrar("another").load("provider/camera", "front")
        eventually(lambda: connects(state_dir))


def connects(state_dir: Path) -> bool:
    """Return whether there is room for one more connection now."""
    try:
        rr.connect(state_dir).close()
    except Unavailable:
        return False
    return True


def test_a_connection_has_a_limited_number_of_sockets_and_the_others_go_on(
    connection: rr.Connection, state_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = connection.open_registrar("first")
    monkeypatch.setattr(console_server, "SOCKETS_LIMIT", 1)
    with pytest.raises(Unavailable, match="this connection has 1 sockets already"):
        connection.open_registrar("more")
    first.load("provider/camera", "front")
    eventually(lambda: connects(state_dir))  # the refused one counts until the console has closed it


def test_a_response_has_the_type_that_the_connection_asks_for(
    start: Start, workshop: Workshop, state_dir: Path
) -> None:
    start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    with rr.connect(state_dir) as connection:
        worker = connection.open_registrar()
        typed = worker.load("shop/thing", Order("r2"), response_type=Made)
        plain = worker.load("shop/thing", {"name": "r2", "parts": []})

        assert worker.name == f"connection.pid-{os.getpid()}"
        assert typed.response.name == "r2"
        assert plain.response == {"name": "r2", "shop": "shop", "pid": typed.response.pid}
        assert plain.resource_id == typed.resource_id


def test_a_query_has_the_state_of_its_last_status(connection: rr.Connection, provider: rr.Registrar) -> None:
    query = connection.open_registrar("worker").load("provider/camera", "front")
    provider.send_status(query.id, rr.Status("WARNING", "dirty"))

    eventually(lambda: query.fetch_state() == "WARNING")


def test_a_query_begins_with_the_state_that_the_resource_has_already(
    connection: rr.Connection, provider: rr.Registrar
) -> None:
    first = connection.open_registrar("worker").load("provider/camera", "front")
    provider.send_status(first.id, rr.Status("WARNING", "dirty"))
    assert first.wait_status(timeout_s=LIMIT_S).state == "WARNING"

    assert connection.open_registrar("other").load("provider/camera", "front").state == "WARNING"


def test_statuses_reach_a_connection_as_they_reach_the_application(
    connection: rr.Connection, provider: rr.Registrar
) -> None:
    worker, own, of_server = connection.open_registrar("worker"), Calls(), Calls()
    worker.on_status("provider/camera", of_server)

    async def on_status(status: rr.Status) -> None:
        await asyncio.sleep(0)
        own(status)

    query = worker.load("provider/camera", "front", on_status=on_status)
    provider.send_status(query.id, rr.Status("WARNING", "dirty"))
    provider.update_response(query.id, "a new response", "cleaned")

    heard = [query.wait_status(timeout_s=LIMIT_S) for _ in range(2)]
    assert [(status.state, status.message) for status in heard] == [("WARNING", "dirty"), ("UPDATE", "cleaned")]
    assert {(status.query_id, status.resource_id) for status in heard} == {(query.id, query.resource_id)}
    assert (query.response, query.state) == ("a new response", rr.State.UPDATE)
    eventually(lambda: list(own) == list(of_server) == heard)


def test_a_connection_that_is_slow_hears_all_statuses_in_their_order(
    connection: rr.Connection, provider: rr.Registrar
) -> None:
    gate, heard = Gate(), Calls()

    def on_status(status: rr.Status) -> None:
        gate()
        heard(status.message)

    query = connection.open_registrar("worker").load("provider/camera", "front", on_status=on_status)
    sent = [str(number) for number in range(2500)]
    for message in sent:
        provider.send_status(query.id, rr.Status("WARNING", message))
    gate.open()
    assert heard.wait(len(sent)) == sent
    eventually(lambda: provider.stats()["notices"] == 0)


def test_a_connection_hears_all_statuses_that_come_before_the_answer_to_its_load(
    connection: rr.Connection, provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = [str(number) for number in range(200)]
    heard = Calls()
    views = ConnectedViews
    add = views.add

    def add_late(self: Any, query: Any, options: Any) -> None:
        for message in sent:
            provider.send_status(query.id, rr.Status("WARNING", message))
        eventually(lambda: provider.stats()["notices"] == 0)
        add(self, query, options)

    monkeypatch.setattr(views, "add", add_late)
    connection.open_registrar("worker").load("provider/camera", "front", on_status=lambda status: heard(status.message))
    assert heard.wait(len(sent)) == sent


def test_a_status_callback_that_raises_is_logged_and_the_next_status_is_heard(
    connection: rr.Connection, provider: rr.Registrar, caplog: pytest.LogCaptureFixture
) -> None:
    heard = Calls()

    def on_status(status: rr.Status) -> None:
        heard(status.message)
        raise ValueError("the callback's own")

    query = connection.open_registrar("worker").load("provider/camera", "front", on_status=on_status)
    for message in ("one", "two"):
        provider.send_status(query.id, rr.Status("WARNING", message))

    eventually(lambda: list(heard) == ["one", "two"])
    eventually(lambda: caplog.text.count("the callback's own") >= 2)


def test_a_connection_loads_and_unloads_by_every_form_that_the_application_has(
    connection: rr.Connection, provider: rr.Registrar
) -> None:
    worker = connection.open_registrar("worker")
    later = worker.load("provider/camera", "a", block=False)
    assert later.get(timeout=LIMIT_S).request == "a"
    with worker.load_all([("provider/camera", "b"), ("provider/camera", "c")]) as (b, c):
        assert (b.request, c.request) == ("b", "c")
        assert len(worker.queries()) == 3
    assert len(worker.queries()) == 1
    worker.unload_client("provider/camera")
    assert worker.queries() == []

    async def use() -> None:
        async with await worker.load_async("provider/camera", "d") as query:
            assert query.request == "d"
        query = await worker.load_async("provider/camera", "e")
        await query.unload_async()
        async with await worker.load_all_async([("provider/camera", "f")]):
            assert len(worker.queries()) == 1
        await worker.unload_async(await worker.load_async("provider/camera", "g"))

    asyncio.run(use())
    assert worker.queries() == []
    worker.load("provider/camera", "h")
    worker.unload_all()
    assert provider.resources() == []


def test_of_a_connections_group_all_are_held_or_none(
    connection: rr.Connection, camera: Served, provider: rr.Registrar
) -> None:
    worker = connection.open_registrar("worker")

    with pytest.raises(rr.UnknownServer) as raised:
        worker.load_all([("provider/camera", "front"), ("provider/none", "back")])

    assert raised.value.__notes__[0].startswith("load_all: request 2 of 2, provider/none")
    eventually(lambda: worker.queries() == [])
    eventually(lambda: provider.resources() == [])


def test_a_block_with_a_connections_query_ends_well_if_its_provider_took_the_resource_away(
    connection: rr.Connection, provider: rr.Registrar
) -> None:
    worker = connection.open_registrar("worker")
    with worker.load("provider/camera", "front") as query:
        provider.unload(query.resource_id, force=True)


def test_a_block_with_a_connections_query_hides_no_error_of_its_own(
    connection: rr.Connection, provider: rr.Registrar
) -> None:
    def block() -> None:
        with connection.open_registrar("worker").load("provider/camera", "back") as query:
            provider.unload(query.resource_id, force=True)
            raise KeyError("the block's own")

    with pytest.raises(KeyError, match="the block's own"):
        block()


def test_a_connection_gives_and_fetches_priorities(connection: rr.Connection, provider: rr.Registrar) -> None:
    def served() -> list[int | None]:
        return [info.priority for info in provider.resources()]

    with connection.open_registrar("worker") as worker:
        query = worker.load("provider/camera", "front", priority=5)
        assert (query.priority, served()) == (5, [5])
        query.priority = 8
        assert query.priority == 8
        assert eventually(lambda: served() == [8])
        query.standby()
        assert [row.priority for row in worker.queries()] == [None]
        assert eventually(lambda: served() == [None])
        with pytest.raises(rr.UsageError, match="priority: expected a whole number from -1000 to 1000"):
            query.priority = 1001
        with pytest.raises(rr.UsageError, match="priority: expected a whole number from -1000 to 1000"):
            worker.load("provider/camera", "rear", priority=True)
        (other,) = worker.load_all([("provider/camera", "front")], priority=3)
        assert eventually(lambda: served() == [3])
        other.unload()
        query.unload()
        with pytest.raises(rr.UnknownQuery, match=query.id):
            query.priority = 1


def test_what_a_connection_may_not_do_says_why(connection: rr.Connection, provider: rr.Registrar) -> None:
    worker = connection.open_registrar("worker")
    query = worker.load("provider/camera", "front")
    with pytest.raises(UsageError, match="only the application takes a resource away"):
        worker.unload(query.resource_id, force=True)
    with pytest.raises(UsageError, match="a connection serves nothing"):
        worker.load("provider/camera", "back", parent=query)
    with pytest.raises(UsageError, match="progress is heard only in the process that holds the query"):
        worker.load("provider/camera", "back", progress=print)
    assert [row.id for row in worker.queries()] == [query.id]


def test_a_connections_query_of_which_no_one_has_the_registrar_is_released(
    connection: rr.Connection, provider: rr.Registrar
) -> None:
    connection.open_registrar("worker").load("provider/camera", "front")
    gc.collect()

    eventually(lambda: provider.resources() == [])


def test_errors_are_those_of_the_system(connection: rr.Connection, provider: rr.Registrar) -> None:
    def fail(_request: str) -> None:
        raise ValueError("no such device")

    serve(provider, "broken", load=fail)
    worker = connection.open_registrar("worker")
    with pytest.raises(LoadFailed, match="no such device") as raised:
        worker.load("provider/broken", "x")
    assert raised.value.trace[0].origin == "provider/broken"
    with pytest.raises(RrError, match="has no such server"):
        worker.load("provider/none", "x")
    with pytest.raises(NotSerializable):
        worker.load("provider/camera", object())
    with pytest.raises(NameTaken):
        connection.open_registrar("worker")
    with pytest.raises(RrError, match="expected 1 to 64"):
        connection.open_registrar("no name")
    with pytest.raises(InvalidName, match="expected 1 to 64"):
        connection.open_registrar("n" * 60)  # too long with "connection." before it
    assert worker.load("provider/camera", "x").response


def test_a_connection_that_comes_again_has_its_name_when_what_it_held_is_released(
    state_dir: Path, provider: rr.Registrar
) -> None:
    gate, camera = Gate(), serve(provider, "camera")
    camera.do_unload = lambda request, response: gate()
    for _ in range(30):
        with rr.connect(state_dir) as connection:
            connection.open_registrar("worker")
    first = rr.connect(state_dir)
    first.open_registrar("worker").load("provider/camera", "x")
    first.close()
    with rr.connect(state_dir) as second:
        threading.Timer(0.5, gate.open).start()
        assert second.open_registrar("worker").name == "connection.worker"
        with rr.connect(state_dir) as third, pytest.raises(NameTaken):
            third.open_registrar("worker")


def test_what_is_too_long_is_refused_and_the_next_call_finds_the_system(
    connection: rr.Connection, provider: rr.Registrar
) -> None:
    worker = connection.open_registrar("worker")
    with pytest.raises(NotSerializable, match="950005 bytes is over a connection's limit of 900000"):
        worker.load("provider/camera", b"x" * 950_000)
    with pytest.raises(NotSerializable, match="over a connection's limit"):
        connection.ask("planner", b"x" * 950_000)
    with pytest.raises(RrError, match="length <= 1000"):
        connection.ask("a" * 2000, 1)
    assert worker.load("provider/camera", "x").response


class Echo(rr.Actor):
    """Answers with what it is asked; to "slow" when the test lets it."""

    def __init__(self, root: str = "") -> None:
        super().__init__()
        self.root = root

    def on_receive(self, message: Any) -> Any:
        if message == "raise":
            raise ValueError("no")
        if message == "odd":
            return object()
        if message == "slow":
            Workshop(self.root).step("slow")
        return {"got": message}


def test_an_actor_is_asked_by_its_name(start: Start, state_dir: Path, workshop: Workshop) -> None:
    start(rr.ChildSpec(Echo, id="echo", args=(str(workshop.root),)))
    workshop.shut("slow")
    with rr.connect(state_dir) as connection:
        assert connection.ask("echo", [1, "two", (3, b"4")]) == {"got": [1, "two", (3, b"4")]}
        assert connection.ask("root/echo", None) == {"got": None}
        with pytest.raises(RrError, match="echo: ValueError: no") as raised:
            connection.ask("echo", "raise")
        assert not isinstance(raised.value, UsageError)
        with pytest.raises(Unavailable, match=r"echo: it has not answered within 0\.1 s"):
            connection.ask("echo", "slow", timeout_s=0.1)
        workshop.open("slow")
        with pytest.raises(NotSerializable, match="answer of echo"):
            connection.ask("echo", "odd")
        with pytest.raises(NotFound):
            connection.ask("nobody", 1)


def test_threads_and_tasks_load_at_once(connection: rr.Connection, provider: rr.Registrar, gate: Gate) -> None:
    serve(provider, "slow", load=gate)
    worker = connection.open_registrar("worker")
    threads = [threading.Thread(target=worker.load, args=("provider/slow", number)) for number in range(5)]
    for thread in threads:
        thread.start()
    gate.wait_arrived(5)
    assert worker.load("provider/camera", "quick").response
    gate.open()
    for thread in threads:
        thread.join()

    async def both() -> list[str]:
        queries = await asyncio.gather(*(worker.load_async("provider/camera", name) for name in ("a", "b")))
        return [query.request for query in queries]

    assert asyncio.run(both()) == ["a", "b"]
    assert len(worker.queries()) == 8


@pytest.mark.parametrize("loop_ends", [True, False])
def test_a_load_that_is_cancelled_is_released_when_it_has_ended_also_after_its_loop(
    connection: rr.Connection, provider: rr.Registrar, loop_ends: bool
) -> None:
    gate = Gate()
    serve(provider, "slow", load=gate)
    worker = connection.open_registrar("worker")

    async def leave() -> None:
        loading = asyncio.create_task(worker.load_async("provider/slow", "front"))
        await asyncio.to_thread(gate.wait_arrived)
        if loop_ends:
            threading.Timer(0.3, gate.open).start()
            return
        loading.cancel()
        with pytest.raises(asyncio.CancelledError):
            await loading
        gate.open()

    asyncio.run(leave())

    eventually(lambda: provider.resources() == [])
    eventually(lambda: worker.queries() == [])


def test_a_load_whose_connection_leaves_as_it_is_answered_is_released(
    connection: rr.Connection, sockets: list[NotedConnections], provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, worker = Gate(), connection.open_registrar("worker")
    hold = Hold.carry_out

    def held(*command: Any) -> Any:
        answer = hold(*command)
        gate()
        return answer

    monkeypatch.setattr(Hold, "carry_out", held)
    far = sockets[0].open()

    def load() -> None:
        with pytest.raises(NotRunning):
            far.ask(Hold("connection.worker", "provider/camera", encode("front")))

    loading = threading.Thread(target=load)
    loading.start()
    gate.wait_arrived()
    far.close()
    loading.join()
    worker.queries()  # the console reads this after the end of the other socket
    gate.open()

    eventually(lambda: provider.resources() == [])
    eventually(lambda: worker.queries() == [])


def test_a_load_that_is_interrupted_when_its_answer_is_there_is_released(
    connection: rr.Connection, sockets: list[NotedConnections], provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    worker, copies = connection.open_registrar("worker"), list[socket.socket]()

    class Clock:
        """Is read when a request has been sent, to know until when its answer is waited for."""

        @staticmethod
        def monotonic() -> float:
            if threading.current_thread() is not threading.main_thread():
                return time.monotonic()
            (made,) = select.select(sockets[0].opened, [], [], LIMIT_S)[0]
            # as a child has one that was forked while the connection was made
            copies.append(socket.socket(fileno=os.dup(made.fileno())))
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(console_connection, "time", Clock)
        with pytest.raises(KeyboardInterrupt):
            worker.load("provider/camera", "front")

    eventually(lambda: provider.resources() == [])
    eventually(lambda: worker.queries() == [])
    copies[0].close()


def test_a_load_that_is_interrupted_at_any_point_is_released(
    connection: rr.Connection, provider: rr.Registrar, caplog: pytest.LogCaptureFixture
) -> None:
    worker, requests, where = connection.open_registrar("worker"), ["first"], "at first"
    worker.load("provider/camera", requests[0]).unload()  # which fills caches
    while where:
        requests.append(str(len(requests)))
        worker.queries()  # so that the load finds a socket
        where = interrupted(lambda: worker.load("provider/camera", requests[-1]), len(requests) - 1).where
    assert len(requests) > 50

    eventually(lambda: [row.request for row in worker.queries()] == [f'"{requests[-1]}"'])
    eventually(lambda: len(provider.resources()) == 1)
    assert "is not released" not in caplog.text


def test_a_load_whose_answer_was_read_stays_when_its_connection_is_closed(
    connection: rr.Connection, sockets: list[NotedConnections], provider: rr.Registrar
) -> None:
    worker, far = connection.open_registrar("worker"), sockets[0].open()
    held = far.ask(Hold("connection.worker", "provider/camera", encode("front")))
    far.keep()
    far.close()

    worker.queries()  # the console reads this after the end of the other socket
    worker.load("provider/camera", "rear").unload()  # and a worker does this after it had released the query
    assert [row.id for row in worker.queries()] == [held.query_id]


def test_a_load_whose_connection_asks_for_something_else_before_its_keep_is_released(
    connection: rr.Connection, sockets: list[NotedConnections], provider: rr.Registrar
) -> None:
    worker, far = connection.open_registrar("worker"), sockets[0].open()
    for request in ("front", "rear"):
        held = far.ask(Hold("connection.worker", "provider/camera", encode(request)))
    far.keep()
    far.close()

    eventually(lambda: [row.id for row in worker.queries()] == [held.query_id])
    eventually(lambda: [resource.request for resource in provider.resources()] == ["rear"])


def test_a_registrar_that_is_being_opened_while_the_connection_closes_is_closed_too(
    connection: rr.Connection, system: rr.System, monkeypatch: pytest.MonkeyPatch
) -> None:
    gate, raised = Gate(), Calls()

    class Slow(ConsoleConnection):
        def __init__(self, *args: Any, **options: Any) -> None:
            super().__init__(*args, **options)
            gate()

    def open_it() -> None:
        try:
            connection.open_registrar("late")
        except NotRunning as error:
            raised(str(error))

    monkeypatch.setattr(console_connection, "ConsoleConnection", Slow)
    opening = threading.Thread(target=open_it)
    opening.start()
    gate.wait_arrived()
    connection.close()
    gate.open()
    opening.join()

    assert list(raised) == ["the connection is closed"]
    eventually(lambda: "connection.late" not in system.snapshot()["registrars"])


def test_a_forked_child_does_not_keep_the_connections_registrar(
    connection: rr.Connection, provider: rr.Registrar
) -> None:
    worker = connection.open_registrar("worker")
    worker.load("provider/camera", "front")
    assert worker.queries()  # by a socket that is kept
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            connection.ask("echo", 1)
        except NotRunning as error:
            os.write(write, str(error).encode())
        finally:
            signal.pause()
    try:
        assert os.read(read, 100) == b"this process was forked from the one that connected: call rr.connect() here"
        connection.close()
        eventually(lambda: provider.resources() == [])
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        os.close(read)
        os.close(write)


def test_where_no_system_or_several_run_connect_says_so(start: Start, tmp_path: Path) -> None:
    with pytest.raises(NotRunning, match="no running system"):
        rr.connect()
    with pytest.raises(NotRunning, match="no system with a console runs in this state directory"):
        rr.connect(tmp_path / "nowhere")
    one = start(state_dir=tmp_path / "one")
    with rr.connect() as connection:
        assert connection.state_dir == tmp_path / "one"
        assert connection.pid == os.getpid()
        start(state_dir=tmp_path / "two")
        with pytest.raises(UsageError, match="several systems run"):
            rr.connect()
        one.stop()
        with pytest.raises(NotRunning):
            connection.open_registrar("late")
    with pytest.raises(ConfigError):
        rr.connect(3)  # type: ignore[arg-type]


def test_a_system_of_another_user_is_refused(
    system: rr.System, state_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console_connection, "peer_at", lambda _socket: SocketPeer(1, 4711))

    with pytest.raises(Unavailable, match=r"expected a system of user .*, got one of user 4711"):
        rr.connect(state_dir)


def test_what_a_killed_application_held_for_its_connections_is_released_at_its_next_start(
    start: Start, state_dir: Path, workshop: Workshop
) -> None:
    code = (
        "import sys, time, rr_actors as rr\n"
        "from support_managers import Shop\n"
        "if __name__ == '__main__':\n"
        "    with rr.System([rr.ChildSpec(Shop, id='shop', args=(sys.argv[2],))], state_dir=sys.argv[1]):\n"
        "        print('up', flush=True); time.sleep(60)\n"
    )
    file = workshop.root / "application.py"
    file.write_text(code)
    command = [sys.executable, str(file), str(state_dir), str(workshop.root)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as application:
        assert application.stdout is not None
        assert application.stdout.readline() == "up\n"
        with rr.connect(state_dir) as connection:
            worker = connection.open_registrar("worker")
            worker.load("shop/thing", Order("r2"))
            connection.open_registrar("idle")
            assert len(list(state_dir.glob("connection.*"))) == 2
            application.kill()
            application.wait()
            with pytest.raises(NotRunning):
                worker.load("shop/thing", Order("r3"))
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))

    workshop.wait("unload r2")
    eventually(lambda: system.registrar("shop").resources() == [])
    assert system.dormant() == []
    assert list(state_dir.glob("connection.*")) == []


def test_what_a_connection_held_is_released_by_a_provider_that_is_opened_after_the_next_start(
    start: Start, state_dir: Path
) -> None:
    code = (
        "import os, signal, sys, rr_actors as rr\n"
        "system = rr.System(state_dir=sys.argv[1]).start()\n"
        "system.open_registrar('provider').register_server('camera', lambda request: request, lambda *_: None)\n"
        "rr.connect(sys.argv[1]).open_registrar('worker').load('provider/camera', 'front')\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    killed = subprocess.run([sys.executable, "-c", code, str(state_dir)], timeout=30, check=False)
    assert killed.returncode == -signal.SIGKILL
    start().stop()  # it gives up the connection, but its provider is not there
    provider = start().open_registrar("provider")
    camera = serve(provider, "camera")

    eventually(lambda: provider.resources() == [])
    assert len(camera.unloads) == 1


def test_a_name_of_connections_is_refused_to_the_application(system: rr.System) -> None:
    with pytest.raises(InvalidName, match=r"registrar name .connection.mine.: .*\(rr.connect\(\)\)") as raised:
        system.open_registrar("connection.mine")

    assert raised.value.name == "connection.mine"
    assert system.open_registrar("connections").name == "connections"
    manager = rr.ChildSpec(Shop, id="connection.mine")
    with pytest.raises(InvalidSpec, match=r"Supervisor root/inner: id: .* got 'connection.mine'"):
        rr.System([rr.Supervisor([manager], id="inner")])
    with pytest.raises(InvalidSpec, match=r"start_child: root/connection.mine: id: .* got 'connection.mine'"):
        system.start_child(manager)
    system.start_child(rr.ChildSpec(rr.Actor, id="connection.actor"))  # it has no registrar


def test_a_connections_catalog_that_is_damaged_is_left_dormant_and_the_system_starts(
    start: Start, state_dir: Path, caplog: pytest.LogCaptureFixture
) -> None:
    place = state_dir / "connection.worker"
    place.mkdir(parents=True, mode=0o700)
    (place / "catalog.sqlite3").write_bytes(b"garbage" * 1000)

    system = start()

    assert system.dormant() == ["connection.worker"]
    assert "connection.worker: what it holds is not released, and it stays dormant" in caplog.text
    assert (place / "catalog.sqlite3").read_bytes() == b"garbage" * 1000


def test_the_state_of_one_query_is_asked_for_and_no_other_row(
    connection: rr.Connection, camera: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    worker = connection.open_registrar("worker")
    first, second = worker.load("provider/camera", "front"), worker.load("provider/camera", "back")
    asked, ask = Calls(), ConsoleConnection.ask

    def noted(self: ConsoleConnection, request: Any, *rest: Any) -> Any:
        asked(request)
        return ask(self, request, *rest)

    monkeypatch.setattr(ConsoleConnection, "ask", noted)
    assert first.fetch_state() is rr.State.OK
    assert list(asked) == [Find(first.id, "connection.worker")]
    first.unload()
    with pytest.raises(UnknownQuery, match="does not hold it any more"):
        worker.fetch_state(first.id)
    assert worker.fetch_state(second) is rr.State.OK


def test_queries_that_are_not_known_are_no_empty_list(
    connection: rr.Connection, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_question: Any) -> Any:
        raise Unavailable("it does not answer")

    worker = connection.open_registrar("worker")
    query = worker.load("provider/camera", "front")
    assert [row.id for row in worker.queries()] == [query.id]
    monkeypatch.setattr(console_view, "page", refuse)
    with pytest.raises(Unavailable, match=r"connection.worker: its queries are not known: .*does not answer"):
        worker.queries()
