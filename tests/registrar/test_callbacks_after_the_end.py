"""After an end has returned, no callback of what has ended begins any more; a loss is the last that is heard."""

from __future__ import annotations

import asyncio
import concurrent.futures
import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest

import rr_actors as rr
from support import LIMIT_S, Calls, Gate, eventually, serve

Start = Callable[..., rr.System]
Heard = Callable[[rr.Status], Any]

COUNT = 20
"""How many statuses are sent while the callback runs for the first."""
NOTHING_S = 0.25
"""For so long nothing may begin; a callback that was not dropped begins at once."""

WARNING = rr.Status(rr.State.WARNING, "low light")
FATAL = rr.Status(rr.State.FATAL, "unplugged")


class Slow:
    """A callback that waits at a gate. Attributes: `begun`, `ended`: what it has begun, and ended, to hear."""

    def __init__(self) -> None:
        self.begun, self.ended = Calls(), Calls()
        self.gate = Gate()

    def __call__(self, *args: Any) -> None:
        self.begun(args[-1])
        self.gate()
        self.ended(args[-1])

    async def awaited(self, *args: Any) -> None:
        """Do the same as an `async def` callback, which a stop cancels."""
        self.begun(args[-1])
        try:
            await asyncio.to_thread(self.gate)
        finally:
            self.ended(args[-1])

    def check_nothing_more(self) -> None:
        """Let the one that runs end, and see that it was the last."""
        assert len(self.begun) == 1
        self.gate.open()
        self.ended.wait()
        with pytest.raises(AssertionError, match="expected 2 calls"):
            self.begun.wait(2, NOTHING_S)


@pytest.fixture
def slow() -> Iterator[Slow]:
    """A slow callback, whose gate is opened at the latest when the test ends."""
    slow = Slow()
    yield slow
    slow.gate.open()


def queue(provider: rr.Registrar, query: rr.Query, slow: Slow, *more: rr.Status) -> None:
    """Send more statuses than the callback can hear, and wait until all have arrived at its query."""
    for number in range(COUNT):
        provider.send_status(query.resource_id, rr.Status(rr.State.WARNING, str(number)))
    for status in (*more, rr.Status(rr.State.ERROR, "last")):
        provider.send_status(query.resource_id, status)
    slow.begun.wait()
    eventually(lambda: query.state is rr.State.ERROR)


End = Callable[[rr.System, rr.Registrar, rr.Query], object]

ENDS: dict[str, End] = {
    "query.unload": lambda system, app, query: query.unload(),
    "query.unload in the loop": lambda system, app, query: app.unload(query, block=False).get(timeout=LIMIT_S),
    "a block": lambda system, app, query: query.__exit__(None, None, None),
    "unload": lambda system, app, query: app.unload(query.id),
    "unload_client": lambda system, app, query: app.unload_client("provider/camera"),
    "unload_all": lambda system, app, query: app.unload_all(),
    "close": lambda system, app, query: app.close(),
    "stop": lambda system, app, query: system.stop(),
}


@pytest.mark.parametrize("end", ENDS.values(), ids=ENDS.keys())
@pytest.mark.parametrize("listens", ["the query", "the query, async", "the server, async"])
def test_no_status_callback_begins_after_an_end_has_returned(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, slow: Slow, listens: str, end: End
) -> None:
    serve(provider, "camera")
    callback: Heard = slow.awaited if "async" in listens else slow
    if "server" in listens:
        app.on_status("provider/camera", callback)
        query = app.load("provider/camera", "front")
    else:
        query = app.load("provider/camera", "front", on_status=callback)
    queue(provider, query, slow)

    end(system, app, query)

    slow.check_nothing_more()


def test_no_status_callback_of_a_group_begins_after_its_block(
    app: rr.Registrar, provider: rr.Registrar, slow: Slow
) -> None:
    serve(provider, "camera")
    with app.load_all([("provider/camera", "front"), ("provider/camera", "back")], on_status=slow) as queries:
        queue(provider, queries[0], slow)

    slow.check_nothing_more()


def test_none_begins_while_the_system_runs_again(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, slow: Slow
) -> None:
    serve(provider, "camera")
    query = app.load("provider/camera", "front", on_status=slow)
    queue(provider, query, slow)
    system.stop()
    system.start()
    provider, heard = system.open_registrar("provider"), Calls()
    serve(provider, "camera")
    again = system.open_registrar("app").load("provider/camera", "front", on_status=heard)
    provider.send_status(again.resource_id, WARNING)
    heard.wait()

    slow.check_nothing_more()


def test_another_query_on_the_same_resource_goes_on_hearing(
    app: rr.Registrar, provider: rr.Registrar, slow: Slow
) -> None:
    serve(provider, "camera")
    query = app.load("provider/camera", "front", on_status=slow)
    other = Calls()
    app.load("provider/camera", "front", on_status=other)
    queue(provider, query, slow)

    query.unload()

    provider.send_status(query.resource_id, WARNING)
    other.wait(COUNT + 2)
    slow.check_nothing_more()


def test_who_tries_to_unload_in_vain_goes_on_hearing(app: rr.Registrar, provider: rr.Registrar, slow: Slow) -> None:
    def unload(request: Any, response: Any) -> None:
        raise RuntimeError("stuck")

    serve(provider, "camera", unload=unload)
    query = app.load("provider/camera", "front", on_status=slow)
    queue(provider, query, slow)
    with pytest.raises(rr.UnloadFailed):
        query.unload()

    slow.gate.open()

    assert len(slow.ended.wait(COUNT + 1)) == COUNT + 1


# -- a loss is heard last -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("listens", ["the query", "the server"])
@pytest.mark.parametrize("how", ["unload", "unregister_server", "close"])
def test_a_resource_that_is_taken_away_is_heard_of_to_the_end_and_last_of_that(
    app: rr.Registrar, provider: rr.Registrar, slow: Slow, how: str, listens: str
) -> None:
    serve(provider, "camera")
    own = slow if listens == "the query" else None
    if own is None:
        app.on_status("provider/camera", slow)
    query = app.load("provider/camera", "front", on_status=own)
    queue(provider, query, slow)

    if how == "unload":
        provider.unload(query.resource_id, force=True)
    elif how == "unregister_server":
        provider.unregister_server("camera")
    else:
        provider.close()
    eventually(lambda: query.released)
    slow.gate.open()

    heard = slow.ended.wait(COUNT + 2)
    assert [status.message for status in heard[: COUNT + 1]] == [*map(str, range(COUNT)), "last"]
    assert heard[-1].state is rr.State.FATAL
    eventually(lambda: app.queries() == [])


@pytest.mark.parametrize("end", ["query.unload", "unload_all", "unload_client", "close", "stop"])
def test_of_what_was_taken_away_nothing_is_heard_after_such_an_end(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, slow: Slow, end: str
) -> None:
    serve(provider, "camera")
    query = app.load("provider/camera", "front", on_status=slow)
    queue(provider, query, slow)
    provider.unload(query.resource_id, force=True)
    eventually(lambda: query.released)

    ENDS[end](system, app, query)

    slow.check_nothing_more()


def test_after_fatal_only_an_update_or_a_loss_is_heard(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    heard = Calls()
    query = app.load("provider/camera", "front", on_status=heard)
    provider.send_status(query.resource_id, FATAL)
    for state in (rr.State.OK, rr.State.WARNING, rr.State.ERROR):
        provider.send_status(query.resource_id, rr.Status(state, "late"))
    provider.update_response(query.resource_id, "its last picture")
    heard.wait(2)
    provider.send_status(query.resource_id, rr.Status(rr.State.OK, "later"))
    provider.unload(query.resource_id, force=True)
    eventually(lambda: query.released)

    assert [status.state for status in heard.wait(3)] == [rr.State.FATAL, rr.State.UPDATE, rr.State.FATAL]
    assert query.state is rr.State.FATAL
    assert query.response == "its last picture"


def test_the_state_of_a_query_stays_fatal(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    query = app.load("provider/camera", "front")
    provider.send_status(query.resource_id, FATAL)
    provider.send_status(query.resource_id, rr.Status(rr.State.OK, "well again"))
    provider.update_response(query.resource_id, "its last picture")
    query.wait_status(rr.State.UPDATE, timeout_s=LIMIT_S)

    assert query.state is rr.State.FATAL
    assert query.fetch_state() == "FATAL"


def test_a_status_that_waits_for_its_server_is_not_heard_after_the_fatal_that_the_server_has_sent(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    def status(request: Any, status: rr.Status) -> None:
        gate(status.message)
        if status.message == "first":
            provider.send_status(status.resource_id, FATAL)

    served = serve(provider, "camera", status=status)
    heard = Calls()
    query = app.load("provider/camera", "front", on_status=heard)
    for message in ("first", "second", "third"):
        provider.send_status(query.resource_id, rr.Status(rr.State.WARNING, message))
    gate.open()
    served.statuses.wait(3)
    provider.unload(query.resource_id, force=True)

    assert heard.wait(2)[0].message == "unplugged"
    eventually(lambda: query.released)
    assert [status.state for status in heard] == [rr.State.FATAL, rr.State.FATAL]


# -- at the owner ---------------------------------------------------------------------------------------------------


def queue_own(provider: rr.Registrar, query: rr.Query, slow: Slow) -> None:
    for number in range(COUNT):
        provider.send_status(query.resource_id, rr.Status(rr.State.WARNING, str(number)))
    slow.begun.wait()


@pytest.mark.parametrize("end", ["query.unload", "unload_all", "close", "stop"])
@pytest.mark.parametrize("is_async", [False, True])
def test_the_status_callback_of_a_server_does_not_begin_for_what_is_unloaded(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, slow: Slow, end: str, is_async: bool
) -> None:
    provider.register_server("camera", str.upper, status=slow.awaited if is_async else slow)
    query = app.load("provider/camera", "front")
    queue_own(provider, query, slow)

    ENDS[end](system, app, query)

    slow.check_nothing_more()


def test_the_status_callback_of_a_server_does_not_begin_after_its_registrar_is_closed(
    app: rr.Registrar, provider: rr.Registrar, slow: Slow
) -> None:
    provider.register_server("camera", str.upper, status=slow)
    queue_own(provider, app.load("provider/camera", "front"), slow)

    provider.close()

    slow.check_nothing_more()


def test_a_status_that_an_unload_callback_sends_runs_no_status_callback_beside_it(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    running, statuses = threading.Event(), Calls()

    def unload(request: Any, response: Any) -> None:
        running.set()
        provider.send_status(rr.current().resource_id, WARNING)
        with pytest.raises(AssertionError, match="expected 2 calls"):
            statuses.wait(2, NOTHING_S)
        running.clear()

    served = serve(provider, "camera", unload=unload, status=lambda request, status: statuses(running.is_set()))
    query = app.load("provider/camera", "front")
    provider.send_status(query.resource_id, WARNING)
    assert statuses.wait() == [False]

    query.unload()

    served.unloads.wait()
    assert list(statuses) == [False]


# -- progress -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("end", ["cancel", "close", "stop"])
def test_no_progress_callback_begins_after_an_end_has_returned(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, slow: Slow, gate: Gate, end: str
) -> None:
    sent = Calls()

    def load(request: str) -> str:
        for number in range(1, 4):
            rr.current().progress(number / 10)
            sent(number)
            slow.begun.wait()
        gate()
        return request

    provider.register_server("camera", load)
    future = app.load("provider/camera", "front", block=False, progress=slow)
    sent.wait(3)
    slow.begun.wait()
    other = Calls()  # hears of the same load, so the reports have arrived when it has heard the last
    app.load("provider/camera", "front", block=False, progress=other)
    eventually(lambda: any(progress.fraction >= 0.3 for progress in other))
    try:
        if end == "cancel":
            cast("concurrent.futures.Future[Any]", future).cancel()
        elif end == "close":
            threading.Timer(0.1, gate.open).start()
            app.close()
        else:
            threading.Timer(0.1, gate.open).start()
            system.stop()
    finally:
        gate.open()

    slow.check_nothing_more()


# -- events ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("end", ["unsubscribe", "stop"])
@pytest.mark.parametrize("is_async", [False, True])
def test_no_subscriber_is_called_after_its_end_has_returned(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, slow: Slow, end: str, is_async: bool
) -> None:
    serve(provider, "camera")
    unsubscribe = system.subscribe(slow.awaited if is_async else slow)
    app.load_all([("provider/camera", number) for number in range(COUNT)])
    slow.begun.wait()

    unsubscribe() if end == "unsubscribe" else system.stop()

    slow.check_nothing_more()


def test_a_quick_subscriber_has_heard_the_last_event_when_the_system_has_stopped(start: Start) -> None:
    heard = Calls()
    system = start()
    system.subscribe(heard)
    provider = system.open_registrar("provider")
    serve(provider, "camera")
    system.open_registrar("app").load_all([("provider/camera", number) for number in range(COUNT)])

    system.stop()

    assert [event["event"] for event in heard].count("unloaded") == COUNT


# -- connections, handles, thread placement --------------------------------------------------------------------------


CONNECTION_ENDS: dict[str, Callable[[rr.System, Any, Any, Any], object]] = {
    "query.unload": lambda system, connection, registrar, query: query.unload(),
    "unload_client": lambda system, connection, registrar, query: registrar.unload_client("provider/camera"),
    "unload_all": lambda system, connection, registrar, query: registrar.unload_all(),
    "registrar.close": lambda system, connection, registrar, query: registrar.close(),
    "connection.close": lambda system, connection, registrar, query: connection.close(),
}


@pytest.mark.usefixtures("runtime_dir")
@pytest.mark.parametrize("end", CONNECTION_ENDS.values(), ids=CONNECTION_ENDS.keys())
@pytest.mark.parametrize("listens", ["the query", "the query, async", "the server"])
def test_no_status_callback_of_a_connection_begins_after_an_end_has_returned(
    system: rr.System,
    provider: rr.Registrar,
    state_dir: Path,
    slow: Slow,
    listens: str,
    end: Callable[[rr.System, Any, Any, Any], object],
) -> None:
    with begun(provider, state_dir, slow, listens) as (connection, registrar, query):
        end(system, connection, registrar, query)

        slow.check_nothing_more()


@pytest.mark.usefixtures("runtime_dir")
@pytest.mark.parametrize("listens", ["the query", "the query, async", "the server"])
def test_the_one_status_that_a_connection_hears_after_a_stop_is_that_the_system_has_ended(
    system: rr.System, provider: rr.Registrar, state_dir: Path, slow: Slow, listens: str
) -> None:
    with begun(provider, state_dir, slow, listens):
        system.stop()
        slow.gate.open()

        _, last = slow.begun.wait(2)
        assert (last.state, last.reason) == ("FATAL", "ended")
        with pytest.raises(AssertionError, match="expected 3 calls"):
            slow.begun.wait(3, NOTHING_S)


@contextlib.contextmanager
def begun(
    provider: rr.Registrar, state_dir: Path, slow: Slow, listens: str
) -> Iterator[tuple[rr.Connection, Any, rr.Query[Any]]]:
    """A connection whose callback has begun to hear the first of many statuses."""
    serve(provider, "camera")
    serve(provider, "door")
    with rr.connect(state_dir) as connection:
        registrar = connection.open_registrar("worker")
        busy = Gate()  # the thread of the callbacks waits there until all statuses have arrived
        other = registrar.load("provider/door", "north", on_status=busy)
        callback: Heard = slow.awaited if "async" in listens else slow
        if "server" in listens:
            registrar.on_status("provider/camera", callback)
            query = registrar.load("provider/camera", "front")
        else:
            query = registrar.load("provider/camera", "front", on_status=callback)
        provider.send_status(other.resource_id, WARNING)
        busy.wait_arrived()
        for number in range(COUNT):
            provider.send_status(query.resource_id, rr.Status(rr.State.WARNING, str(number)))
        eventually(lambda: query.fetch_state() == "WARNING")
        busy.open()
        slow.begun.wait()
        yield connection, registrar, query
