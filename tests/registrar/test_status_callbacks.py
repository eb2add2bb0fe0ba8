"""What status callbacks know, and how one is stopped or replaced (docs/semantics.md, "Status callbacks")."""

from __future__ import annotations

import asyncio
import gc
import pickle
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from support import LIMIT_S, Calls, Gate, Workshop, eventually, kill, loaded_with_parts, pid_of, serve, wait_respawned
from support_managers import Order, Shop

Start = Callable[..., rr.System]
Consumer = rr.Registrar | rr.ConnectedRegistrar

WARNING = rr.Status(rr.State.WARNING, "low light")


def said(number: int) -> rr.Status:
    return rr.Status(rr.State.WARNING, str(number))


def messages(calls: Calls) -> list[str]:
    return [status.message for status in calls]


@pytest.fixture(params=["registrar", "connection"])
def consumer(request: pytest.FixtureRequest, app: rr.Registrar, state_dir: Path) -> Iterator[Consumer]:
    """What loads, in the application or in a connection of it."""
    if request.param == "registrar":
        yield app
        return
    request.getfixturevalue("runtime_dir")
    with rr.connect(state_dir) as connection:
        yield connection.open_registrar("worker")


# -- the query of a status -----------------------------------------------------------------------------------------


def test_a_status_knows_its_query(consumer: Consumer, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    queries = Calls()

    def heard(status: rr.Status) -> None:
        queries(status.query)

    consumer.on_status("provider/camera", heard)
    query = consumer.load("provider/camera", "front", on_status=heard)
    provider.send_status(query.resource_id, WARNING)

    assert all(one is query for one in queries.wait(2))
    assert query.wait_status(timeout_s=LIMIT_S).query is query


def test_the_query_of_a_status_is_known_as_long_as_it_is_held(consumer: Consumer, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    query = consumer.load("provider/camera", "front")
    provider.send_status(query.resource_id, WARNING)
    status = query.wait_status(timeout_s=LIMIT_S)
    assert status.query is query
    query.unload()
    assert status.query is None


def test_the_last_status_of_what_is_taken_away_knows_its_query(consumer: Consumer, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    heard = Calls()
    query = consumer.load("provider/camera", "front", on_status=lambda status: heard(status.state, status.query))
    provider.unload(query.resource_id, force=True)
    assert heard.wait() == [(rr.State.FATAL, query)]


def test_a_server_hears_statuses_of_parts_with_their_queries_and_its_own_without(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(parts, "lidar")
    heard = Calls()

    def status_of_robot(request: Any, status: rr.Status) -> None:
        found = status.query
        heard(status.message, None if found is None else (found.server_id, found.request, found.released))

    serve(provider, "robot", load=loaded_with_parts(provider, ("parts/lidar", "left")), status=status_of_robot)
    query = app.load("provider/robot", "r")
    (lidar,) = parts.resources()
    parts.send_status(lidar.id, WARNING)
    heard.wait(1)
    provider.send_status(query.resource_id, rr.Status(rr.State.WARNING, "its own"))
    heard.wait(2)
    parts.unload(lidar.id, force=True)
    known = ("parts/lidar", "left")
    lost = heard.wait(3)[-1]
    assert heard.items[:2] == [("low light", (*known, False)), ("its own", None)]
    assert lost[1] == (*known, True)
    eventually(lambda: not provider.queries())


def test_a_status_is_a_value_that_travels_without_its_query(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    query = app.load("provider/camera", "front")
    provider.send_status(query.resource_id, WARNING)
    status = query.wait_status(timeout_s=LIMIT_S)
    copy = pickle.loads(pickle.dumps(status))
    assert status == copy
    assert copy.query_id == query.id
    assert repr(status) == repr(copy) == "<Status WARNING from provider/camera: low light>"
    assert status.query is query
    assert copy.query is None
    assert WARNING.query is None


def test_the_callbacks_of_a_query_run_one_after_another_its_own_first(
    consumer: Consumer, provider: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "camera")
    heard = Calls()

    def own(_status: rr.Status) -> None:
        heard("own begins")
        gate()
        heard("own ends")

    for name in ("first", "second"):
        consumer.on_status("provider/camera", lambda _status, name=name: heard(name))
    query = consumer.load("provider/camera", "front", on_status=own)
    provider.send_status(query.resource_id, WARNING)
    gate.wait_arrived()
    gate.open()
    assert heard.wait(4) == ["own begins", "own ends", "first", "second"]


# -- a callback of on_status() is stopped --------------------------------------------------------------------------


def test_a_callback_is_stopped_alone(consumer: Consumer, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    stopped, blocked, left = Calls(), Calls(), Calls()
    subscription = consumer.on_status("provider/camera", stopped)
    consumer.on_status("provider/camera", left)
    query = consumer.load("provider/camera", "front")
    with consumer.on_status("provider/camera", blocked):
        provider.send_status(query.resource_id, said(0))
        for calls in (stopped, blocked, left):
            calls.wait()
    subscription.stop()
    subscription.stop()
    provider.send_status(query.resource_id, said(1))
    left.wait(2)
    assert [messages(calls) for calls in (stopped, blocked, left)] == [["0"], ["0"], ["0", "1"]]


def test_the_same_callback_given_twice_is_called_twice_until_each_is_stopped(
    consumer: Consumer, provider: rr.Registrar
) -> None:
    serve(provider, "camera")
    heard = Calls()
    query = consumer.load("provider/camera", "front")
    with consumer.on_status("provider/camera", heard), consumer.on_status("provider/camera", heard):
        provider.send_status(query.resource_id, said(0))
        heard.wait(2)
    consumer.on_status("provider/camera", heard)
    provider.send_status(query.resource_id, said(1))
    heard.wait(3)
    assert messages(heard) == ["0", "0", "1"]


def test_what_waits_for_a_stopped_callback_goes_its_way_without_it(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, gate: Gate
) -> None:
    serve(parts, "lidar")
    begun, heard = Calls(), Calls()

    def slow(status: rr.Status) -> None:
        begun(status.message)
        gate()

    serve(provider, "robot", load=loaded_with_parts(provider, ("parts/lidar", "left")))
    subscription = provider.on_status("parts/lidar", slow)
    app.load("provider/robot", "r", on_status=heard)
    (lidar,) = parts.resources()
    for number in range(3):
        parts.send_status(lidar.id, said(number))
    begun.wait()
    (part,) = provider.queries()
    for number in range(3):
        assert part.wait_status(timeout_s=LIMIT_S).message == str(number)
    subscription.stop()
    gate.open()
    heard.wait(3)
    assert messages(heard) == ["0", "1", "2"]
    assert begun.items == ["0"]


def test_a_callback_may_stop_itself(consumer: Consumer, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    once, always = Calls(), Calls()

    def heard(status: rr.Status) -> None:
        once(status)
        subscription.stop()

    subscription = consumer.on_status("provider/camera", heard)
    query = consumer.load("provider/camera", "front", on_status=always)
    for number in range(2):
        provider.send_status(query.resource_id, said(number))
    always.wait(2)
    provider.send_status(query.resource_id, said(2))
    always.wait(3)
    assert messages(once) == ["0"]


def test_a_thousand_callbacks_that_are_stopped_leave_nothing(consumer: Consumer, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    query = consumer.load("provider/camera", "front")

    def stopped() -> weakref.ref[Calls]:
        heard = Calls()
        consumer.on_status("provider/camera", heard).stop()
        return weakref.ref(heard)

    alive = [stopped() for _ in range(1000)]
    provider.send_status(query.resource_id, WARNING)
    query.wait_status(timeout_s=LIMIT_S)
    gc.collect()
    assert [one for one in alive if one() is not None] == []


def test_a_stop_after_the_end_of_the_registrar_does_nothing(
    system: rr.System, consumer: Consumer, provider: rr.Registrar
) -> None:
    serve(provider, "camera")
    subscriptions = [consumer.on_status("provider/camera", Calls()) for _ in range(2)]
    consumer.close()
    subscriptions[0].stop()
    system.stop()
    subscriptions[1].stop()


def test_what_cannot_be_called_with_a_status_is_refused(consumer: Consumer, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    query = consumer.load("provider/camera", "front")
    for wrong in (3, lambda: None):
        with pytest.raises(rr.UsageError, match="on_status: callback"):
            consumer.on_status("provider/camera", wrong)  # type: ignore[arg-type]
        with pytest.raises(rr.UsageError, match="on_status: callback"):
            query.on_status(wrong)  # type: ignore[arg-type]
    with pytest.raises(rr.UsageError, match="expected a callable, got None"):
        consumer.on_status("provider/camera", None)  # type: ignore[arg-type]


# -- the callback of a query is replaced ---------------------------------------------------------------------------


def test_the_callback_of_a_query_is_replaced_and_taken_away(consumer: Consumer, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    first, second, all_of_server = Calls(), Calls(), Calls()
    consumer.on_status("provider/camera", all_of_server)
    query = consumer.load("provider/camera", "front", on_status=first)

    def say(number: int) -> None:
        provider.send_status(query.resource_id, said(number))
        all_of_server.wait(number + 1)

    say(0)
    query.on_status(second)
    say(1)
    query.on_status(None)
    say(2)
    query.on_status(first)
    say(3)
    assert messages(first) == ["0", "3"]
    assert messages(second) == ["1"]


def test_a_query_that_was_loaded_without_a_callback_gets_one(consumer: Consumer, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    query, heard = consumer.load("provider/camera", "front"), Calls()
    provider.send_status(query.resource_id, said(0))
    query.wait_status(timeout_s=LIMIT_S)
    query.on_status(heard)
    provider.send_status(query.resource_id, said(1))
    assert [(status.message, status.query) for status in heard.wait()] == [("1", query)]


def test_a_callback_is_set_by_the_id_of_the_query(consumer: Consumer, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    query, heard = consumer.load("provider/camera", "front"), Calls()
    consumer.set_on_status(query.id, heard)
    provider.send_status(query.resource_id, WARNING)
    heard.wait()


class Kinds:
    """A slow callback, and another one, each as a function or as an `async def`."""

    def __init__(self, gate: Gate) -> None:
        self.begun, self.heard = Calls(), Calls()
        self._gate = gate

    def slow(self, status: rr.Status) -> None:
        self.begun(status.message)
        self._gate()

    async def slow_async(self, status: rr.Status) -> None:
        self.begun(status.message)
        await asyncio.to_thread(self._gate)

    def other(self, status: rr.Status) -> None:
        self.heard(status.message)

    async def other_async(self, status: rr.Status) -> None:
        await asyncio.sleep(0)
        self.heard(status.message)


@pytest.mark.parametrize("new", ["other", "other_async"])
@pytest.mark.parametrize("old", ["slow", "slow_async"])
@pytest.mark.parametrize("in_loop", [False, True], ids=["in a thread", "in an event loop"])
def test_what_waits_for_the_callback_before_is_heard_by_the_new_one_in_order(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate, old: str, new: str, in_loop: bool
) -> None:
    serve(provider, "camera")
    kinds = Kinds(gate)

    async def load() -> rr.Query:
        return await app.load_async("provider/camera", "front", on_status=getattr(kinds, old))

    async def replace(query: rr.Query) -> None:
        query.on_status(getattr(kinds, new))
        gate.open()
        await asyncio.to_thread(kinds.heard.wait, 4)

    def wait(query: rr.Query) -> None:
        for number in range(5):
            provider.send_status(query.resource_id, said(number))
        kinds.begun.wait()
        while query.wait_status(timeout_s=LIMIT_S).message != "4":
            pass

    async def program() -> None:
        query = await load()
        await asyncio.to_thread(wait, query)
        await replace(query)

    if in_loop:
        asyncio.run(program())
    else:
        query = app.load("provider/camera", "front", on_status=getattr(kinds, old))
        wait(query)
        query.on_status(getattr(kinds, new))
        gate.open()
    assert kinds.heard.wait(4) == ["1", "2", "3", "4"]
    assert kinds.begun.items == ["0"]


@pytest.mark.parametrize("kind", ["registrar", "connection"])
def test_an_async_callback_runs_on_the_event_loop_that_has_set_it(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, runtime_dir: Path, state_dir: Path, kind: str
) -> None:
    serve(provider, "camera")

    async def program(registrar: Consumer) -> None:
        woken = asyncio.Event()

        async def heard(status: rr.Status) -> None:
            loops.append(asyncio.get_running_loop())
            woken.set()

        loops: list[asyncio.AbstractEventLoop] = []
        query = await registrar.load_async("provider/camera", "front")
        query.on_status(heard)
        provider.send_status(query.resource_id, WARNING)
        await asyncio.wait_for(woken.wait(), LIMIT_S)
        assert loops == [asyncio.get_running_loop()]
        await query.unload_async()

    with rr.connect(state_dir) as connection:
        asyncio.run(program(connection.open_registrar() if kind == "connection" else app))


@pytest.mark.parametrize("new", ["other", "other_async"])
def test_what_waits_for_a_busy_event_loop_is_heard_by_the_new_callback(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate, new: str
) -> None:
    serve(provider, "camera")
    kinds = Kinds(gate)

    async def program() -> None:
        query = await app.load_async("provider/camera", "front", on_status=kinds.slow_async)
        provider.send_status(query.resource_id, said(0))
        query.wait_status(timeout_s=LIMIT_S)  # so the event loop is busy
        query.on_status(getattr(kinds, new))
        await asyncio.to_thread(kinds.heard.wait)

    asyncio.run(program())
    assert kinds.begun.items == []


def test_the_new_callback_of_a_part_may_stop_a_status(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(parts, "lidar")
    heard = Calls()
    serve(provider, "robot", load=loaded_with_parts(provider, ("parts/lidar", "left")))
    app.load("provider/robot", "r", on_status=heard)
    (part,) = provider.queries()
    stopped = Calls()

    def stop(status: rr.Status) -> None:
        status.handled()
        stopped(status.message)

    part.on_status(stop)
    parts.send_status(part.resource_id, said(0))
    assert stopped.wait() == ["0"]  # what still waited would be the next callback's, or go up
    part.on_status(None)
    parts.send_status(part.resource_id, said(1))
    heard.wait()
    assert messages(heard) == ["1"]


def test_only_a_query_that_is_held_gets_a_callback(consumer: Consumer, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    query = consumer.load("provider/camera", "front")
    copy = pickle.loads(pickle.dumps(query))
    with pytest.raises(rr.UnknownQuery, match="another process holds it"):
        copy.on_status(Calls())
    query.unload()
    for callback in (Calls(), None):
        with pytest.raises(rr.UnknownQuery, match=query.id):
            query.on_status(callback)


# -- over processes, and over restarts -----------------------------------------------------------------------------


class Customer(rr.Manager):
    """Holds a thing of the shop, and notes each status of it: by a callback that it sets whenever it starts."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    def on_start(self) -> None:
        self.work.step("starts")
        if not self.registrar.queries():
            self.registrar.load("shop/thing", Order("lamp"))
        (query,) = self.registrar.queries()
        query.on_status(self.hear)
        self.work.note("listens")

    def hear(self, status: rr.Status) -> None:
        name = None if status.query is None else status.query.request.name
        self.work.note("hears", status.message, name)


@pytest.fixture
def shop(start: Start, workshop: Workshop) -> rr.System:
    """A shop and a customer, each in a process of its own."""
    root = str(workshop.root)
    return start(rr.ChildSpec(Shop, args=(root,), id="shop"), rr.ChildSpec(Customer, args=(root,), id="customer"))


def test_a_query_that_a_restart_has_restored_gets_a_callback_in_on_start_which_misses_nothing(
    shop: rr.System, workshop: Workshop
) -> None:
    workshop.wait("listens")
    provider = shop.registrar("shop")
    (resource,) = provider.resources()
    workshop.shut("starts")
    pid = kill(shop, "customer")
    provider.send_status(resource, said(0))
    workshop.wait("starts", 2)
    provider.send_status(resource, said(1))
    workshop.open("starts")
    wait_respawned(shop, "customer", pid)
    provider.send_status(resource, said(2))
    assert workshop.wait("hears", 3) == [f"hears {number} lamp" for number in range(3)]


def note_in(root: str, word: str) -> Callable[[rr.Status], None]:
    def note(status: rr.Status) -> None:
        Workshop(root).note(word, status.message, None if status.query is None else status.query.request.name)

    return note


def test_a_handle_stops_and_replaces_callbacks_in_the_registrars_process(shop: rr.System, workshop: Workshop) -> None:
    workshop.wait("listens")
    provider, handle = shop.registrar("shop"), shop.registrar("customer")
    (resource,), (query,) = provider.resources(), handle.queries()
    root = str(workshop.root)
    with handle.on_status(Shop.load_thing, note_in(root, "blocked")):
        provider.send_status(resource, said(0))
        assert workshop.wait("blocked") == ["blocked 0 lamp"]
    query.on_status(note_in(root, "replaced"))
    provider.send_status(resource, said(1))
    assert workshop.wait("replaced") == ["replaced 1 lamp"]
    query.on_status(None)
    provider.send_status(resource, said(2))
    handle.set_on_status(query.id, note_in(root, "again"))
    eventually(lambda: handle.fetch_state(query) == "WARNING")
    provider.send_status(resource, said(3))
    assert workshop.wait("again")[-1] == "again 3 lamp"
    assert workshop.lines("hears") == ["hears 0 lamp"]
    assert workshop.lines("blocked") == ["blocked 0 lamp"]
    assert workshop.lines("replaced") == ["replaced 1 lamp"]


def test_the_callback_of_a_handle_ends_with_its_process_and_a_stop_does_nothing_then(
    shop: rr.System, workshop: Workshop
) -> None:
    workshop.wait("listens")
    handle = shop.registrar("customer")
    subscription = handle.on_status("shop/thing", note_in(str(workshop.root), "over"))
    pid = pid_of(shop, "customer")
    kill(shop, "customer")
    subscription.stop()
    wait_respawned(shop, "customer", pid)
    subscription.stop()
    shop.supervisor().terminate_child("customer")
    subscription.stop()
    shop.stop()
    subscription.stop()
    assert workshop.lines("over") == []
