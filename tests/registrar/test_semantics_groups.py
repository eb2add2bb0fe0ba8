"""What a registrar promises about many loads at once (docs/semantics.md, "Load"): all of them are held, or none."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from support import LIMIT_S, Calls, Gate, Workshop, eventually, kill, serve, wait_respawned
from support_managers import Order, Shop

Start = Callable[..., rr.System]
Way = Callable[..., rr.Queries]


def awaited(app: rr.Registrar, requests: Any, **options: Any) -> rr.Queries:
    return asyncio.run(app.load_all_async(requests, **options))


def waited(app: rr.Registrar, requests: Any, **options: Any) -> rr.Queries:
    return app.load_all(requests, **options)


@pytest.fixture(params=[waited, awaited], ids=["waited", "awaited"])
def load_all(request: pytest.FixtureRequest) -> Way:
    return request.param


def picky(request: Any) -> Any:
    if request == "bad":
        raise ValueError("no such camera")
    return {"of": request}


def test_all_are_held_in_the_order_of_the_requests(load_all: Way, app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    serve(provider, "map")
    heard = Calls()
    camera, hall, rear = load_all(
        app, [("provider/camera", "front"), ("provider/map", "hall"), ["provider/camera", "rear"]], on_status=heard
    )
    assert [query.response["of"] for query in (camera, hall, rear)] == ["front", "hall", "rear"]
    assert {query.id for query in app.queries()} == {camera.id, hall.id, rear.id}
    provider.send_status(hall.resource_id, rr.Status(rr.State.WARNING, "old"))
    assert [status.query_id for status in heard.wait()] == [hall.id]


def test_none_is_nothing(load_all: Way, app: rr.Registrar) -> None:
    assert load_all(app, []) == ()


def test_they_run_at_the_same_time(load_all: Way, app: rr.Registrar, provider: rr.Registrar) -> None:
    meeting = threading.Barrier(3, timeout=LIMIT_S)
    serve(provider, "camera", load=lambda request: meeting.wait() >= 0)
    assert len(load_all(app, [("provider/camera", n) for n in range(3)])) == 3


def test_when_one_fails_what_was_held_is_released_and_the_first_error_raised_and_named(
    load_all: Way, app: rr.Registrar, provider: rr.Registrar
) -> None:
    served = serve(provider, "camera")
    rest_is_held = threading.Event()

    def fails_last(request: str) -> Any:
        assert rest_is_held.wait(LIMIT_S)
        raise ValueError("no such camera")

    serve(provider, "bad", load=fails_last)
    watching = threading.Thread(target=lambda: [eventually(lambda: len(app.queries()) == 2), rest_is_held.set()])
    watching.start()
    with pytest.raises(rr.LoadFailed, match="no such camera") as raised:
        load_all(app, [("provider/camera", "front"), ("provider/bad", "x"), ("provider/camera", "rear")])
    watching.join(LIMIT_S)
    assert raised.value.__notes__[1:] == ["load_all: request 2 of 3, provider/bad with 'x'"]  # behind the traceback
    assert app.queries() == []
    assert sorted(request for request, _ in served.unloads) == ["front", "rear"]
    eventually(lambda: provider.resources() == [])


def test_when_one_fails_it_is_said_at_once_and_what_still_loads_is_withdrawn(
    load_all: Way, app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    def slow(request: Any) -> Any:
        gate(request)
        return request

    served = serve(provider, "slow", load=slow)
    serve(provider, "camera", load=picky)
    with pytest.raises(rr.LoadFailed, match="no such camera"):
        load_all(app, [("provider/slow", 1), ("provider/camera", "bad")])
    assert app.queries() == []
    gate.open()
    eventually(lambda: app.owed() == [] and provider.resources() == [])
    assert len(served.loads) == len(served.unloads)


@pytest.mark.parametrize(
    ("requests", "error", "said"),
    [
        (None, rr.UsageError, "expected a list of pairs"),
        (["provider/camera"], rr.UsageError, "request 1: expected a pair"),
        ([("provider/camera", "front"), ("provider/camera",)], rr.UsageError, "request 2: expected a pair"),
        ([("provider/camera", "front"), ("camera", "x")], rr.InvalidName, "camera"),
        ([("provider/camera", "front"), ("provider/camera", object())], rr.NotSerializable, "request"),
        ([("provider/camera", "front"), ("provider/nothing", "x")], rr.UnknownServer, "no such server"),
    ],
)
def test_a_bad_request_is_an_error_and_nothing_is_held(
    load_all: Way, app: rr.Registrar, provider: rr.Registrar, requests: Any, error: type[Exception], said: str
) -> None:
    serve(provider, "camera")
    with pytest.raises(error, match=said):
        load_all(app, requests)
    assert app.queries() == []
    eventually(lambda: provider.resources() == [])


def test_a_load_that_takes_too_long_ends_all_of_them(
    load_all: Way, app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "camera")
    serve(provider, "slow", load=gate)
    with pytest.raises(rr.LoadTimeout):
        load_all(app, [("provider/camera", "front"), ("provider/slow", 1)], timeout_s=0.2)
    assert app.queries() == []
    gate.open()
    eventually(lambda: provider.resources() == [])


def test_as_a_context_manager_they_are_unloaded_newest_first_also_if_one_is_gone(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    served = serve(provider, "camera")
    with app.load_all([("provider/camera", n) for n in range(4)]) as queries:
        queries[1].unload()
        provider.unload(queries[2].resource_id, force=True)
        queries[2].wait_status(rr.State.FATAL, timeout_s=LIMIT_S)
        served.unloads.wait(2)
    assert [request for request, _ in served.unloads][2:] == [3, 0]
    assert app.queries() == []


def test_an_async_context_manager_does_the_same(app: rr.Registrar, provider: rr.Registrar) -> None:
    served = serve(provider, "camera")

    async def use() -> int:
        async with await app.load_all_async([("provider/camera", n) for n in range(3)]) as queries:
            return len(queries)

    assert asyncio.run(use()) == 3
    assert [request for request, _ in served.unloads] == [2, 1, 0]


def test_an_unload_that_fails_is_told_after_all_have_been_tried(app: rr.Registrar, provider: rr.Registrar) -> None:
    def stuck(request: Any, response: Any) -> None:
        raise OSError(f"camera {request} is busy")

    serve(provider, "camera", unload=stuck)
    queries = app.load_all([("provider/camera", n) for n in range(2)])
    with pytest.raises(rr.UnloadFailed, match="camera 1 is busy") as raised:
        queries.unload()
    assert "camera 0 is busy" in raised.value.__notes__[0]


def test_cancelled_they_are_released_and_withdrawn(app: rr.Registrar, provider: rr.Registrar, gate: Gate) -> None:
    serve(provider, "camera")
    serve(provider, "slow", load=gate)

    async def cancel() -> None:
        task = asyncio.create_task(app.load_all_async([("provider/camera", 1), ("provider/slow", 2)]))
        await asyncio.to_thread(gate.wait_arrived)
        await asyncio.to_thread(eventually, lambda: len(app.queries()) == 1)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(cancel())
    eventually(lambda: app.queries() == [])
    gate.open()
    eventually(lambda: provider.resources() == [])


def test_those_whose_loop_is_closed_are_released_and_withdrawn(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "camera")
    served = serve(provider, "slow", load=gate)
    loop = asyncio.new_event_loop()
    loop.set_exception_handler(lambda *_: None)  # a closed loop never ends its task, and asyncio complains
    task = loop.create_task(app.load_all_async([("provider/camera", 1), ("provider/slow", 2)]))
    loop.run_until_complete(asyncio.sleep(0))
    gate.wait_arrived()
    loop.close()
    gate.open()
    served.unloads.wait()
    eventually(lambda: app.queries() == [] and provider.resources() == [])
    assert not task.done()


@pytest.mark.parametrize("fails", [True, False])
def test_in_a_callback_they_become_parts_of_its_resource(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, fails: bool
) -> None:
    def load(request: Any) -> Any:
        wheels: list[tuple[str, Any]] = [("parts/wheel", n) for n in range(2)]
        try:
            return [query.response["of"] for query in provider.load_all([*wheels, *([("parts/bad", 0)] * fails)])]
        except rr.LoadFailed:
            return "none"

    def bad(request: Any) -> Any:
        raise ValueError("no such part")

    serve(parts, "wheel")
    serve(parts, "bad", load=bad)
    serve(provider, "car", load=load)
    car = app.load("provider/car", None)
    assert car.response == ("none" if fails else [0, 1])
    assert [part.request for part in provider.children(car)] == ([] if fails else [0, 1])
    car.unload()
    eventually(lambda: parts.resources() == [])


@pytest.mark.parametrize("requests", [None, 7, Order("wheel")])
def test_a_handle_refuses_what_is_no_list_of_pairs(
    load_all: Way, start: Start, workshop: Workshop, requests: Any
) -> None:
    buyer = start(rr.ChildSpec(Shop, id="buyer", args=(str(workshop.root),))).registrar("buyer")
    with pytest.raises(rr.UsageError, match="load_all: expected a list of pairs"):
        load_all(buyer, requests)


def test_a_manager_loads_all_through_its_handle(start: Start, workshop: Workshop) -> None:
    system = start(
        rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)),
        rr.ChildSpec(Shop, id="buyer", args=(str(workshop.root),)),
    )
    buyer = system.registrar("buyer")
    with buyer.load_all([("shop/thing", Order("wheel")), ("shop/thing", Order("bell"))]) as queries:
        assert [query.response.name for query in queries] == ["wheel", "bell"]
        assert len(buyer.queries()) == 2
    assert buyer.queries() == []
    with buyer.load("shop/thing", Order("lamp")) as lamp:
        assert [query.id for query in buyer.queries()] == [lamp.id]
    assert buyer.queries() == []
    with buyer.load("shop/thing", Order("lamp")) as lamp:
        system.registrar("shop").unload(lamp.resource_id, force=True)
        eventually(lambda: buyer.queries() == [])
    with buyer.load("shop/thing", Order("lamp")) as lamp:
        lamp.unload()
    workshop.spoil("load bad")
    with pytest.raises(rr.LoadFailed, match="spoilt"):
        asyncio.run(buyer.load_all_async([("shop/thing", Order("wheel")), ("shop/thing", Order("bad"))]))
    eventually(lambda: system.registrar("shop").resources() == [])


def test_when_the_provider_dies_meanwhile_all_are_held_or_none(
    start: Start, workshop: Workshop, state_dir: Path
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    workshop.shut("load bell")
    workshop.spoil("load bell")
    ended = Calls()

    def load() -> None:
        try:
            ended(app.load_all([("shop/thing", Order("wheel")), ("shop/thing", Order("bell"))]))
        except rr.LoadFailed as error:
            ended(error)

    thread = threading.Thread(target=load)
    thread.start()
    workshop.wait("made wheel")
    workshop.wait("load bell")
    wait_respawned(system, "shop", kill(system, "shop"))
    workshop.open("load bell")
    (error,) = ended.wait()
    thread.join(LIMIT_S)
    assert isinstance(error, rr.LoadFailed)
    assert app.queries() == []
    eventually(lambda: system.registrar("shop").resources() == [])
    assert len(workshop.lines("unload wheel")) == 1
