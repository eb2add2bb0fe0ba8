"""What a registrar promises about load (docs/semantics.md, "Load")."""

from __future__ import annotations

import asyncio
import gc
import itertools
import os
import pickle
import signal
import threading
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import msgspec
import pytest

import rr_actors as rr
from support import LIMIT_S, Calls, Gate, Workshop, eventually, hang, messages, pid_of, serve
from support_managers import Order, Shop
from support_slow import few_now


@dataclass(frozen=True)
class Camera:
    device: str
    fps: float = 30.0


class CameraStruct(msgspec.Struct, frozen=True):
    device: str
    fps: float = 30.0


class CameraTuple(NamedTuple):
    device: str
    fps: float = 30.0


class CameraDict(TypedDict):
    device: str
    fps: float


def in_thread(work: Callable[[], Any]) -> threading.Thread:
    thread = threading.Thread(target=work)
    thread.start()
    return thread


# -- a request's identity ------------------------------------------------------------------------------------------


def test_a_request_is_the_same_whatever_the_order_of_its_dicts(app: rr.Registrar, provider: rr.Registrar) -> None:
    served = serve(provider, "thing")
    first = app.load("provider/thing", {"a": 1, "b": {"x": [1, 2], "y": None}})
    second = app.load("provider/thing", {"b": {"y": None, "x": [1, 2]}, "a": 1})
    assert second.resource_id == first.resource_id
    assert len(served.loads) == 1


def test_a_request_is_the_same_whatever_object_it_is(app: rr.Registrar, provider: rr.Registrar) -> None:
    served = serve(provider, "camera", request_type=Camera, response_type=dict[str, Camera | int])
    word = "front"
    first = app.load("provider/camera", Camera(word))
    second = app.load("provider/camera", Camera("".join(["fr", "ont"])))
    assert second.resource_id == first.resource_id
    assert list(served.loads) == [Camera("front")]


def test_a_request_is_the_same_whoever_asks_and_with_whatever_options(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    served = serve(provider, "thing")
    first = app.load("provider/thing", "x")
    second = app.load("provider/thing", "x", on_status=Calls(), timeout_s=5.0)
    third = system.open_registrar("other").load("provider/thing", "x", block=False).get(timeout=5)
    assert {first.resource_id, second.resource_id, third.resource_id} == {first.resource_id}
    assert len(served.loads) == 1


def test_different_requests_are_different_resources(app: rr.Registrar, provider: rr.Registrar) -> None:
    served = serve(provider, "thing")
    requests: list[Any] = ["x", "y", 1, True, None, "1", [1], {"x": 1}, {"x": 2}, {"y": 1}, [], "", {}]
    queries = [app.load("provider/thing", request) for request in requests]
    assert len({query.resource_id for query in queries}) == len(requests)
    assert list(served.loads) == requests


def test_the_same_request_at_another_server_or_registrar_is_another_resource(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(provider, "one", load=lambda request: "provider/one")
    serve(provider, "two", load=lambda request: "provider/two")
    serve(parts, "one", load=lambda request: "parts/one")
    servers = ["provider/one", "provider/two", "parts/one"]
    queries = [app.load(server, "x") for server in servers]
    assert [query.response for query in queries] == servers
    assert len({query.resource_id for query in queries}) == 3


@pytest.mark.parametrize(
    ("kind", "request_"),
    [
        (Camera, Camera("front", 10.0)),
        (CameraStruct, CameraStruct("front", 10.0)),
        (CameraTuple, CameraTuple("front", 10.0)),
        (CameraDict, CameraDict(device="front", fps=10.0)),
        (dict[str, float], {"front": 10.0}),
        (tuple[int, str], (1, "front")),
        (str, "front"),
        (None, {"device": "front", "fps": [10, 12.5, None, True, b"raw"]}),
    ],
)
def test_requests_and_responses_arrive_as_the_types_the_server_says(
    app: rr.Registrar, provider: rr.Registrar, kind: Any, request_: Any
) -> None:
    served = serve(provider, "thing", load=lambda request: request, request_type=kind, response_type=kind)
    query = app.load("provider/thing", request_)
    assert list(served.loads) == [request_]
    assert type(served.loads.items[0]) is type(request_)
    assert query.response == request_
    assert type(query.response) is type(request_)
    assert query.request == request_


# -- once for all --------------------------------------------------------------------------------------------------


def test_the_load_callback_runs_once_however_many_identical_requests_arrive_while_it_runs(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    def load(request: Any) -> Any:
        gate()
        return "made"

    served = serve(provider, "thing", load=load)
    serve(provider, "fence")
    other = system.open_registrar("other")
    futures = [registrar.load("provider/thing", "x", block=False) for registrar in (app, other) for _ in range(10)]
    gate.wait_arrived()
    for registrar in (app, other):
        registrar.load("provider/fence", None)  # what was sent before it has arrived
    gate.open()
    queries = [future.get(timeout=5) for future in futures]
    assert len(served.loads) == 1
    assert [query.response for query in queries] == ["made"] * 20
    assert len({query.id for query in queries}) == 20
    assert len({query.resource_id for query in queries}) == 1


def test_all_who_wait_for_a_load_that_fails_get_its_error(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    def load(request: Any) -> Any:
        gate()
        raise ValueError("no such device")

    served = serve(provider, "thing", load=load)
    futures = [app.load("provider/thing", "x", block=False) for _ in range(5)]
    gate.wait_arrived()
    eventually(lambda: [len(resource.queries) for resource in provider.resources()] == [5])
    gate.open()
    for future in futures:
        with pytest.raises(rr.LoadFailed, match="no such device"):
            future.get(timeout=5)
    assert len(served.loads) == 1


def test_a_later_identical_request_gets_the_stored_response_and_a_query_of_its_own(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    served = serve(provider, "thing")
    first = app.load("provider/thing", "x")
    second = app.load("provider/thing", "x")
    assert list(served.loads) == ["x"]
    assert second.response == first.response == {"of": "x", "number": 1}
    assert second.id != first.id
    assert second.resource_id == first.resource_id
    assert {query.id for query in app.queries()} == {first.id, second.id}


def test_a_query_tells_who_asked_whom_for_what(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing")
    query = app.load("provider/thing", "x")
    assert (query.origin, query.registrar, query.server) == ("app", "provider", "thing")
    assert (query.request, query.response) == ("x", {"of": "x", "number": 1})
    assert query.state is rr.State.OK
    (resource,) = provider.resources()
    assert resource.id == query.resource_id
    assert (resource.server, resource.phase) == ("thing", "loaded")
    assert (resource.request, resource.response) == (query.request, query.response)
    assert list(resource.holders) == ["app"]


def test_the_query_id_is_a_uuid7_made_by_the_consumer_and_known_to_both_sides(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "thing")
    query = app.load("provider/thing", "x")
    assert uuid.UUID(query.id).version == 7
    assert [known.id for known in app.queries()] == [query.id]
    assert [known.id for known in app.fetch_queries("provider")] == [query.id]


def test_loads_of_many_threads_at_once_all_succeed(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing")
    results = Calls()
    threads = [
        in_thread(lambda n=n: [results(app.load("provider/thing", [n, m]).request) for m in range(10)])
        for n in range(8)
    ]
    for thread in threads:
        thread.join(10)
    assert sorted(results) == [[n, m] for n in range(8) for m in range(10)]
    assert len(provider.resources()) == 80


# -- ways to call --------------------------------------------------------------------------------------------------


def test_a_load_can_be_awaited(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing")

    async def main() -> list[rr.Query]:
        return await asyncio.gather(*(app.load_async("provider/thing", n) for n in range(5)))

    assert [query.response["of"] for query in asyncio.run(main())] == list(range(5))


def test_an_awaited_load_that_fails_raises_its_error(app: rr.Registrar, provider: rr.Registrar) -> None:
    async def main() -> None:
        await app.load_async("provider/nothing", 1)

    with pytest.raises(rr.UnknownServer, match="nothing"):
        asyncio.run(main())


def test_load_callbacks_may_be_coroutine_functions(app: rr.Registrar, provider: rr.Registrar) -> None:
    async def load(request: Any) -> Any:
        await asyncio.sleep(0)
        return f"made {request}"

    unloaded = Calls()

    async def unload(request: Any, response: Any) -> None:
        await asyncio.sleep(0)
        unloaded(request, response)

    provider.register_server("thing", load, unload)
    query = app.load("provider/thing", "x")
    assert query.response == "made x"
    query.unload()
    assert unloaded.items == [("x", "made x")]


def test_a_load_callback_that_gives_a_coroutine_after_the_systems_end_leaves_no_warning(
    start: Callable[..., rr.System], recwarn: pytest.WarningsRecorder
) -> None:
    threads, gate = Calls(), Gate()

    async def too_late() -> None: ...

    def load(_request: Any) -> Any:
        threads(threading.current_thread())
        gate()
        return too_late()

    system = start(config=rr.SystemConfig(stop_timeout_s=0.1))
    provider = system.open_registrar("provider")
    provider.register_server("thing", load)
    provider.load("provider/thing", "x", block=False)
    gate.wait_arrived()
    system.stop()
    gate.open()
    (thread,) = threads
    thread.join(LIMIT_S)
    gc.collect()
    assert [str(warning.message) for warning in recwarn] == []


def test_a_query_is_the_same_wherever_it_is_seen(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    first, second = app.load("provider/camera", "front"), app.load("provider/camera", "front")
    assert first != second
    assert first in app.fetch_queries("provider")
    assert set(app.queries()) == set(app.fetch_queries("provider")) == {first, second}
    assert pickle.loads(pickle.dumps(first)) == first
    assert first != first.id


def test_a_query_is_a_context_manager_that_unloads(app: rr.Registrar, provider: rr.Registrar) -> None:
    served = serve(provider, "thing")
    with app.load("provider/thing", "x") as query:
        assert query.response["of"] == "x"
        assert len(served.unloads) == 0
    assert len(served.unloads) == 1
    assert list(app.queries()) == []


def test_a_registrar_lists_its_servers_and_those_it_is_a_client_of(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(provider, "one")
    serve(provider, "two")
    serve(parts, "one")
    app.load("provider/two", 1)
    app.load("parts/one", 1)
    assert sorted(provider.servers()) == ["provider/one", "provider/two"]
    assert sorted(app.clients()) == ["parts/one", "provider/two"]
    assert list(app.servers()) == []


def test_a_callback_knows_what_it_is_called_for(app: rr.Registrar, provider: rr.Registrar) -> None:
    seen = Calls()

    def load(request: Any) -> Any:
        call = rr.current()
        seen(call.resource_id, call.attempt, call.origin, call.server)
        return None

    serve(provider, "thing", load=load)
    query = app.load("provider/thing", "x")
    (resource_id, attempt, origin, server) = seen.items[0]
    assert resource_id == query.resource_id
    assert attempt == 1
    assert (origin, server) == ("app", "thing")


# -- time limits ---------------------------------------------------------------------------------------------------


def test_timeout_s_bounds_the_whole_load_and_names_server_and_limit(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "slow", load=gate)
    begun = time.monotonic()
    with pytest.raises(rr.LoadTimeout, match="provider/slow") as caught:
        app.load("provider/slow", "x", timeout_s=0.1)
    assert 0.09 < time.monotonic() - begun < 2.0
    assert caught.value.server == "provider/slow"
    assert caught.value.timeout_s == 0.1
    assert isinstance(caught.value, TimeoutError)


def test_timeout_s_bounds_a_load_that_does_not_block(app: rr.Registrar, provider: rr.Registrar, gate: Gate) -> None:
    serve(provider, "slow", load=gate)
    future = app.load("provider/slow", "x", timeout_s=0.1, block=False)
    with pytest.raises(rr.LoadTimeout):
        future.get(timeout=5)


def test_timeout_s_bounds_an_awaited_load(app: rr.Registrar, provider: rr.Registrar, gate: Gate) -> None:
    serve(provider, "slow", load=gate)

    async def main() -> None:
        await app.load_async("provider/slow", "x", timeout_s=0.1)

    with pytest.raises(rr.LoadTimeout):
        asyncio.run(main())


def test_a_load_given_up_is_released_if_it_still_succeeds_later(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, gate: Gate
) -> None:
    part = serve(parts, "part")

    def load(request: Any) -> Any:
        provider.load("parts/part", "p")
        gate()
        return "made"

    served = serve(provider, "slow", load=load)
    with pytest.raises(rr.LoadTimeout):
        app.load("provider/slow", "x", timeout_s=0.5)
    assert list(app.queries()) == []
    assert len(served.unloads) == 0
    gate.open()
    assert served.unloads.wait() == [("x", "made")]
    part.unloads.wait()
    eventually(lambda: not provider.resources() and not parts.resources() and not provider.queries())


def test_a_load_whose_loop_is_closed_is_withdrawn_and_fells_nobody(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    served = serve(provider, "thing", load=gate)
    loop = asyncio.new_event_loop()
    loop.set_exception_handler(lambda *_: None)  # a closed loop never ends its task, and asyncio complains
    task = loop.create_task(app.load_async("provider/thing", 1))
    loop.run_until_complete(asyncio.sleep(0))
    gate.wait_arrived()
    loop.close()
    gate.open()
    served.unloads.wait()
    eventually(lambda: app.queries() == [])
    assert not task.done()


def test_a_load_given_up_when_its_system_has_stopped_raises_nothing_of_its_own(tmp_path: Path) -> None:
    """What awaited it is collected after the loop of rr_actors has ended: Python calls close() then."""
    system = rr.System((), state_dir=tmp_path).start()
    gate = Gate()
    app = system.open_registrar("app")
    app.register_server("thing", gate, lambda *_: None)
    waiting = app.load_async("app/thing", 1)
    loop = asyncio.new_event_loop()
    loop.set_exception_handler(lambda *_: None)  # a closed loop never ends its task, and asyncio complains
    task = loop.create_task(waiting)
    loop.run_until_complete(asyncio.sleep(0))
    gate.wait_arrived()
    gate.open()
    loop.close()
    system.stop()
    assert not task.done()
    waiting.close()


def test_an_awaited_load_that_is_interrupted_leaves_no_error_to_be_logged(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "slow", load=gate)
    logged: list[Any] = []

    async def interrupt() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: logged.append(context["message"]))
        load = app.load_async("provider/slow", "x")
        load.send(None)
        with pytest.raises(KeyboardInterrupt):
            load.throw(KeyboardInterrupt)
        eventually(lambda: app.stats()["loading"] == 0)
        await asyncio.sleep(0.05)

    asyncio.run(interrupt())
    gc.collect()
    assert logged == []


def test_a_load_cancelled_at_the_moment_it_succeeds_is_withdrawn(app: rr.Registrar, provider: rr.Registrar) -> None:
    served = serve(provider, "thing")

    async def give_up() -> None:
        task = asyncio.create_task(app.load_async("provider/thing", 1))
        await asyncio.sleep(0)
        eventually(app.queries)  # blocks the loop, so that the task has not heard
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(give_up())
    served.unloads.wait()
    assert app.queries() == []


def test_a_load_given_up_that_fails_later_leaves_nothing(app: rr.Registrar, provider: rr.Registrar, gate: Gate) -> None:
    def load(request: Any) -> Any:
        gate()
        raise ValueError("late")

    served = serve(provider, "slow", load=load)
    with pytest.raises(rr.LoadTimeout):
        app.load("provider/slow", "x", timeout_s=0.05)
    gate.open()
    eventually(lambda: not provider.resources())
    assert len(served.unloads) == 0


def test_a_load_given_up_stays_with_those_who_still_wait(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    def load(request: Any) -> Any:
        gate()
        return "made"

    served = serve(provider, "slow", load=load)
    patient = system.open_registrar("patient").load("provider/slow", "x", block=False)
    with pytest.raises(rr.LoadTimeout):
        app.load("provider/slow", "x", timeout_s=0.05)
    gate.open()
    query = patient.get(timeout=5)
    assert query.response == "made"
    assert [list(resource.holders) for resource in provider.resources()] == [["patient"]]
    assert (len(served.loads), len(served.unloads)) == (1, 0)


def test_timeout_s_holds_when_the_peer_hangs_and_the_load_is_withdrawn_when_it_wakes(
    start: Callable[..., rr.System], workshop: Workshop
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    app.load("shop/thing", Order("warm"))
    pid = pid_of(system, "shop")
    hang(pid)
    try:
        begun = time.monotonic()
        with pytest.raises(rr.LoadTimeout):
            app.load("shop/thing", Order("cold"), timeout_s=0.2)
        assert time.monotonic() - begun < 2.0
    finally:
        os.kill(pid, signal.SIGCONT)
    assert app.load("shop/thing", Order("warm"), timeout_s=5.0).response.pid == pid
    eventually(lambda: [resource.request for resource in system.registrar("shop").resources()] == [Order("warm")])
    assert len(workshop.lines("made cold")) == len(workshop.lines("unload cold"))


def test_a_server_may_bound_the_time_of_its_load_callback(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "slow", load=gate, load_timeout_s=0.05)
    with pytest.raises(rr.LoadFailed, match="slow") as caught:
        app.load("provider/slow", "x", timeout_s=10.0)
    why = "provider/slow: the load callback took longer than load_timeout_s=0.05 s"
    assert [str(frame) for frame in caught.value.trace] == [why]
    gate.open()
    eventually(lambda: not provider.resources())


# -- nobody there --------------------------------------------------------------------------------------------------


def test_a_server_that_does_not_exist_is_an_error_that_names_it_at_once(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "thing")
    begun = time.monotonic()
    with pytest.raises(rr.UnknownServer, match="provider/nothing") as caught:
        app.load("provider/nothing", "x")
    assert time.monotonic() - begun < 2.0
    assert caught.value.server == "provider/nothing"
    assert "thing" in " ".join(caught.value.known)
    assert list(app.queries()) == []


def test_a_registrar_that_does_not_exist_is_an_error_that_names_it_at_once(app: rr.Registrar) -> None:
    begun = time.monotonic()
    with pytest.raises(rr.UnknownRegistrar, match="nobody") as caught:
        app.load("nobody/thing", "x")
    assert time.monotonic() - begun < 2.0
    assert caught.value.registrar == "nobody"
    assert list(app.queries()) == []


def test_a_request_of_the_wrong_type_is_an_error_that_names_server_field_and_type_at_once(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    served = serve(provider, "camera", request_type=Camera)
    with pytest.raises(rr.InvalidRequest, match=r"provider/camera.*fps.*float") as caught:
        app.load("provider/camera", {"device": "front", "fps": "fast"})
    assert caught.value.server == "provider/camera"
    assert "fps" in caught.value.path
    assert "float" in caught.value.expected
    assert len(served.loads) == 0
    assert list(app.queries()) == []
    assert list(provider.resources()) == []


def test_a_manager_that_is_gone_for_good_is_an_error_that_names_it_at_once(
    start: Callable[..., rr.System], workshop: Workshop
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),), placement="thread"))
    app = system.open_registrar("app")
    with app.load("shop/thing", Order("wheel")):
        pass
    system.supervisor().terminate_child("shop")
    system.supervisor().delete_child("shop")
    begun = time.monotonic()
    with pytest.raises((rr.RegistrarDown, rr.UnknownRegistrar), match="shop"):
        app.load("shop/thing", Order("wheel"))
    assert time.monotonic() - begun < 2.0
    assert list(app.queries()) == []


def test_a_load_from_a_manager_that_is_restarting_waits_for_it(
    start: Callable[..., rr.System], workshop: Workshop
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    pid = pid_of(system, "shop")
    workshop.shut("start shop")
    os.kill(pid, signal.SIGKILL)
    workshop.wait("start shop", 2)
    future = app.load("shop/thing", Order("wheel"), block=False)
    with pytest.raises(rr.LoadTimeout):
        app.load("shop/thing", Order("hub"), timeout_s=0.1)
    workshop.open("start shop")
    assert future.get(timeout=10).response.pid != pid


# -- statuses of a fresh load --------------------------------------------------------------------------------------


def test_a_status_sent_the_moment_a_load_is_done_is_heard(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing")
    for round in range(20):
        heard = Calls()

        def send(round: int = round) -> None:
            def resource_id() -> str:
                found = [r for r in provider.resources() if r.request == round and r.phase == "loaded"]
                return found[0].id if found else ""

            provider.send_status(eventually(resource_id), rr.Status(rr.State.WARNING, f"round {round}"))

        sender = in_thread(send)
        app.load("provider/thing", round, on_status=heard)
        sender.join(10)
        heard.wait()
        assert messages(heard) == [f"round {round}"]


def waiting_calls(
    system: rr.System, registrar: rr.Registrar, query: rr.Query, timeout_s: Any
) -> list[Callable[[], object]]:
    """Everything that takes a time limit, each of which ends at once if that is one."""
    system.registrar("provider").send_status(query, rr.Status(rr.State.WARNING, "warm"))
    return [
        lambda: registrar.load("provider/thing", 1, timeout_s=timeout_s).unload(timeout_s=timeout_s),
        lambda: registrar.load("provider/thing", 1, timeout_s=timeout_s, block=False).get(),
        lambda: registrar.unload(registrar.load("provider/thing", 2), timeout_s=timeout_s),
        lambda: registrar.fetch_queries("provider", timeout_s=timeout_s),
        lambda: query.wait_status(rr.State.WARNING, timeout_s=timeout_s),
        lambda: registrar.unload_client("provider/thing", timeout_s=timeout_s),
        lambda: registrar.unload_all(timeout_s=timeout_s),
        lambda: registrar.unregister_server("own", timeout_s=timeout_s),
    ]


class Consumer(rr.Manager):
    """Only holds."""


@pytest.fixture
def consumer(start: Any, request: pytest.FixtureRequest) -> tuple[rr.System, rr.Registrar, rr.Query]:
    """A registrar of this process, or a handle on one of another, with a server "own" and a query that `app` holds."""
    system = start(rr.ChildSpec(Consumer, id="consumer"))
    serve(system.open_registrar("provider"), "thing")
    app = system.open_registrar("app")
    registrar = app if request.param == "local" else system.registrar("consumer")
    registrar.register_server("own", lambda request: request)
    return system, registrar, app.load("provider/thing", 0)


@pytest.mark.parametrize("consumer", ["local", "handle"], indirect=True)
@pytest.mark.parametrize("timeout_s", few_now([1e300, None], [1e7, float("inf")]))
def test_a_time_limit_longer_than_any_clock_counts_is_none(
    consumer: tuple[rr.System, rr.Registrar, rr.Query], timeout_s: float | None
) -> None:
    system, registrar, _ = consumer
    for call in waiting_calls(*consumer, timeout_s):
        call()
    assert registrar.queries() == []
    assert registrar.servers() == []
    ended = rr.monitor(system.ref("consumer"))
    system.supervisor().terminate_child("consumer")
    assert ended.wait(timeout_s) is not None
    system.registrar("app").close(timeout_s=timeout_s)


@pytest.mark.parametrize("consumer", ["local", "handle"], indirect=True)
def test_what_is_no_time_is_refused(consumer: tuple[rr.System, rr.Registrar, rr.Query]) -> None:
    system, registrar, query = consumer

    def calls(timeout_s: Any) -> list[Callable[[], object]]:
        return [
            *waiting_calls(*consumer, timeout_s),
            lambda: query.unload(timeout_s=timeout_s),
            lambda: system.wait(timeout_s),
            lambda: rr.monitor(system.ref("consumer")).wait(timeout_s),
            lambda: system.registrar("app").close(timeout_s=timeout_s),
        ]

    for call in itertools.chain.from_iterable(map(calls, (-1, float("nan"), True, "soon"))):
        with pytest.raises(rr.UsageError, match="expected seconds"):
            call()
    assert query.id in [held.id for held in system.registrar("app").queries()]
    assert registrar.servers() == [f"{registrar.name}/own"]
