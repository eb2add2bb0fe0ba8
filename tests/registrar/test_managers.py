"""Managers: declared servers, the order of starting, both placements with the same code, registration at run time."""

from __future__ import annotations

import asyncio
import functools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import pytest

import rr_actors as rr
from rr_actors.registrar.links import remote_calls
from rr_actors.registrar.model.messages import Described, Loaded
from support import LIMIT_S, REPOSITORY, Calls, Gate, Workshop, child, eventually, hang, kill, pid_of, wait_respawned
from support_inside import HeldBack, actor_of, node_of
from support_managers import Made, Order, Shop

Start = Callable[..., rr.System]
Placement = Literal["process", "thread"]
both_placements = pytest.mark.parametrize("placement", ["process", "thread"])


@dataclass(frozen=True)
class OpenCamera:
    device: str
    fps: int = 30


@dataclass(frozen=True)
class Feed:
    topic: str
    pid: int


class Cameras(rr.Manager):
    """Every kind of callback; "grid" is made of two cameras of its own."""

    def __init__(self, root: str, quality: str = "high") -> None:
        self.work = Workshop(root)
        self.quality = quality

    def on_start(self) -> None:
        self.work.step(f"start {self.registrar.name}", *sorted(self.registrar.servers()))

    def on_stop(self) -> None:
        self.work.note(f"stop {self.registrar.name}")

    @rr.server("camera", linger_s=0.0, load_timeout_s=None, recovery="keep")
    def load_camera(self, request: OpenCamera) -> Feed:
        self.work.step(f"load {request.device}", request.fps, type(request).__name__)
        return Feed(f"/{self.quality}/{request.device}", os.getpid())

    @load_camera.unload
    def close_camera(self, request: OpenCamera, response: Feed) -> None:
        self.work.step(f"unload {request.device}", response.topic)

    @load_camera.status
    def camera_status(self, request: OpenCamera, status: rr.Status) -> None:
        self.work.step(f"status {request.device} {status.state}")

    @load_camera.recover
    def recover_camera(self, request: OpenCamera, response: Feed) -> Feed:
        self.work.step(f"recover {request.device}", response.topic)
        return response

    @rr.server("grid")
    async def load_grid(self, request: list[str]) -> list[str]:
        name = f"{self.registrar.name}/camera"
        feeds = await asyncio.gather(*(self.registrar.load_async(name, OpenCamera(device)) for device in request))
        return [feed.response.topic for feed in feeds]

    @load_grid.unload
    async def close_grid(self, request: list[str], response: list[str]) -> None:
        await asyncio.sleep(0)
        self.work.step("unload grid")

    @load_grid.status
    async def grid_status(self, request: list[str], status: rr.Status) -> None:
        await asyncio.sleep(0)
        self.work.step(f"status grid {status.state}")


def cameras(workshop: Workshop, placement: Placement, id: str = "cameras", **kwargs: Any) -> rr.ChildSpec:
    return rr.ChildSpec(Cameras, id=id, args=(str(workshop.root),), kwargs=kwargs, placement=placement)


# -- declared servers ----------------------------------------------------------------------------------------------


@both_placements
def test_a_manager_serves_what_it_declares_wherever_it_is_placed(
    start: Start, workshop: Workshop, placement: Placement
) -> None:
    system = start(cameras(workshop, placement, quality="low"))
    app = system.open_registrar("app")
    with app.load("cameras/camera", OpenCamera("front")) as camera:
        assert isinstance(camera.response, Feed)
        assert camera.response.topic == "/low/front"
        assert (camera.response.pid == os.getpid()) == (placement == "thread")
        assert workshop.lines("load") == ["load front 30 OpenCamera"]
    assert workshop.lines("unload") == ["unload front /low/front"]


@both_placements
def test_declared_callbacks_may_be_coroutines_and_load_from_their_own_manager(
    start: Start, workshop: Workshop, placement: Placement
) -> None:
    system = start(cameras(workshop, placement))
    app = system.open_registrar("app")
    heard = Calls()
    grid = app.load("cameras/grid", ["front", "rear"], on_status=heard)
    assert grid.response == ["/high/front", "/high/rear"]
    handle = system.registrar("cameras")
    parts = handle.children(grid)
    assert sorted(part.request.device for part in parts) == ["front", "rear"]
    handle.send_status(parts[0].resource_id, rr.Status(rr.State.WARNING, "dark"))
    assert heard.wait()[0].state is rr.State.WARNING
    device = parts[0].request.device
    assert workshop.lines("status") == [f"status {device} WARNING", "status grid WARNING"]
    grid.unload()
    workshop.wait("unload", 3)
    assert workshop.lines("unload")[0] == "unload grid"
    eventually(lambda: not handle.resources() and not handle.queries())


@both_placements
def test_a_manager_is_asked_as_what_its_annotations_say(start: Start, workshop: Workshop, placement: Placement) -> None:
    system = start(cameras(workshop, placement))
    app = system.open_registrar("app")
    with pytest.raises(rr.InvalidRequest, match=r"cameras/camera.*fps.*int"):
        app.load("cameras/camera", {"device": "front", "fps": "fast"})
    plain = app.load("cameras/camera", {"device": "front"})
    typed = app.load("cameras/camera", OpenCamera("front"))
    assert plain.resource_id == typed.resource_id
    assert plain.response == typed.response


def test_a_subclass_inherits_and_overrides_declared_servers(start: Start) -> None:
    class Base(rr.Manager):
        @rr.server("one")
        def load_one(self, request: str) -> str:
            return self.word(request)

        @rr.server("two")
        def load_two(self, request: str) -> str:
            return f"base two {request}"

        def word(self, request: str) -> str:
            return f"base {request}"

    class Special(Base):
        def word(self, request: str) -> str:
            return f"special {request}"

        @rr.server("three")
        def load_three(self, request: str) -> str:
            return f"three {request}"

    system = start(rr.ChildSpec(Special, id="s", placement="thread"), rr.ChildSpec(Base, id="b", placement="thread"))
    app = system.open_registrar("app")
    assert app.load("s/one", "x").response == "special x"
    assert app.load("s/two", "x").response == "base two x"
    assert app.load("s/three", "x").response == "three x"
    assert app.load("b/one", "x").response == "base x"
    assert sorted(system.registrar("s").servers()) == ["s/one", "s/three", "s/two"]
    with pytest.raises(rr.UnknownServer):
        app.load("b/three", "x")


# -- order ---------------------------------------------------------------------------------------------------------


@both_placements
def test_declared_servers_are_there_before_on_start(start: Start, workshop: Workshop, placement: Placement) -> None:
    start(cameras(workshop, placement))
    assert workshop.lines("start") == ["start cameras cameras/camera cameras/grid"]


def test_children_start_in_order_and_stop_in_reverse_order(start: Start, workshop: Workshop) -> None:
    placements: list[Placement] = ["process", "thread", "process"]
    system = start(*(cameras(workshop, placement, id=f"c{n}") for n, placement in enumerate(placements)))
    assert [line.split()[1] for line in workshop.lines("start")] == ["c0", "c1", "c2"]
    system.stop()
    assert workshop.lines("stop") == ["stop c2", "stop c1", "stop c0"]


def test_a_respawned_manager_is_asked_to_recover_before_its_on_start(start: Start, workshop: Workshop) -> None:
    system = start(cameras(workshop, "process"))
    app = system.open_registrar("app")
    app.load("cameras/camera", OpenCamera("front"))
    wait_respawned(system, "cameras", kill(system, "cameras"))
    lines = [line.split()[0] for line in workshop.lines()]
    assert lines == ["start", "load", "recover", "start"]


@both_placements
def test_a_manager_may_load_in_on_start_from_those_before_it(
    start: Start, workshop: Workshop, placement: Placement
) -> None:
    class Robot(rr.Manager):
        def __init__(self) -> None:
            self.topic = ""

        def on_start(self) -> None:
            self.topic = self.registrar.load("cameras/camera", OpenCamera("front")).response.topic
            self.registrar.register_server("where", lambda request: self.topic)

    system = start(cameras(workshop, placement), rr.ChildSpec(Robot, id="robot", placement=placement))
    assert system.open_registrar("app").load("robot/where", None).response == "/high/front"
    (resource,) = system.registrar("cameras").resources()
    assert list(resource.holders) == ["robot"]


@both_placements
def test_a_start_that_fails_says_whose_and_why_and_stops_what_had_started(
    tmp_path: Path, state_dir: Path, workshop: Workshop, placement: Placement
) -> None:
    class Broken(rr.Manager):
        def on_start(self) -> None:
            raise ConnectionError("no arm attached")

    children = [cameras(workshop, placement), rr.ChildSpec(Broken, id="arm", placement=placement)]
    system = rr.System(children, state_dir=state_dir)
    with pytest.raises(rr.StartFailed, match="arm") as caught:
        system.start()
    assert caught.value.id == "arm"
    assert "no arm attached" in str(caught.value)
    assert workshop.lines("st") == ["start cameras cameras/camera cameras/grid", "stop cameras"]


@both_placements
def test_a_manager_that_uses_its_registrar_too_early_is_told_when_it_is_there(
    state_dir: Path, placement: Placement
) -> None:
    class Hasty(rr.Manager):
        def __init__(self) -> None:
            self.registrar.register_server("where", str)

    system = rr.System([rr.ChildSpec(Hasty, id="arm", placement=placement)], state_dir=state_dir)
    with pytest.raises(
        rr.StartFailed, match=r"Hasty: self\.registrar does not exist in __init__.*use it in on_start"
    ) as caught:
        system.start()
    assert "because its catalog is not open yet" in str(caught.value)


@both_placements
def test_a_load_from_a_manager_that_is_not_up_yet_waits_for_it(
    start: Start, workshop: Workshop, placement: Placement
) -> None:
    system = start()
    app = system.open_registrar("app")
    workshop.shut("start cameras")
    starter = threading.Thread(target=lambda: system.start_child(cameras(workshop, placement)))
    starter.start()
    try:
        workshop.wait("start cameras")
        future = app.load("cameras/camera", OpenCamera("front"), block=False)
        with pytest.raises(rr.LoadTimeout):
            app.load("cameras/camera", OpenCamera("rear"), timeout_s=0.05)
    finally:
        workshop.open("start cameras")
        starter.join(LIMIT_S)
    assert future.get(timeout=LIMIT_S).response.topic == "/high/front"


@both_placements
def test_the_arguments_of_the_child_spec_reach_the_manager(start: Start, placement: Placement) -> None:
    class Echo(rr.Manager):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            self.given = [list(args), kwargs]

        @rr.server("given")
        def load_given(self, request: None) -> Any:
            return self.given

    spec = rr.ChildSpec(Echo, id="echo", args=(1, "two"), kwargs={"three": [3]}, placement=placement)
    assert start(spec).open_registrar("app").load("echo/given", None).response == [[1, "two"], {"three": [3]}]


# -- across processes ----------------------------------------------------------------------------------------------


def test_managers_of_both_placements_share_resources(start: Start, workshop: Workshop) -> None:
    root = str(workshop.root)
    system = start(
        rr.ChildSpec(Shop, id="inside", args=(root,), placement="thread"),
        rr.ChildSpec(Shop, id="outside", args=(root,), placement="process"),
        rr.ChildSpec(Shop, id="far", args=(root,), placement="process"),
    )
    app = system.open_registrar("app")
    car = app.load("inside/thing", Order("car", ("outside/thing:engine", "far/thing:engine")))
    van = app.load("far/thing", Order("van", ("outside/thing:engine", "inside/thing:seat")))
    assert len(workshop.lines("load engine")) == 2
    (engine,) = system.registrar("outside").resources()
    assert sorted(engine.holders) == ["far", "inside"]
    car.unload()
    van.unload()
    for id in ("inside", "outside", "far"):
        eventually(lambda id=id: not system.registrar(id).resources() and not system.registrar(id).queries())


def test_the_same_request_of_two_processes_is_one_resource(start: Start, workshop: Workshop) -> None:
    root = str(workshop.root)
    system = start(
        rr.ChildSpec(Shop, id="store", args=(root,)),
        rr.ChildSpec(Shop, id="one", args=(root,)),
        rr.ChildSpec(Shop, id="two", args=(root,)),
    )
    app = system.open_registrar("app")
    workshop.shut("load wheel")
    futures = [app.load(f"{id}/thing", Order("bike", ("store/thing:wheel",)), block=False) for id in ("one", "two")]
    workshop.wait("load bike", 2)
    workshop.wait("load wheel")
    workshop.open("load wheel")
    for future in futures:
        future.get(timeout=LIMIT_S)
    assert len(workshop.lines("load wheel")) == 1
    (wheel,) = system.registrar("store").resources()
    assert sorted(wheel.holders) == ["one", "two"]


class Ring(rr.Manager):
    """Each thing needs the same of the next registrar; waits at the workshop's step first."""

    def __init__(self, root: str, following: str) -> None:
        self.work = Workshop(root)
        self.following = following

    @rr.server("thing")
    def load_thing(self, request: str) -> str:
        self.work.step(f"at {self.registrar.name}")
        return self.registrar.load(f"{self.following}/thing", request).response


@pytest.mark.parametrize("entrances", [1, 3])
def test_a_ring_around_processes_fails_naming_it(start: Start, workshop: Workshop, entrances: int) -> None:
    size, root = 3, str(workshop.root)
    system = start(*(rr.ChildSpec(Ring, id=f"r{n}", args=(root, f"r{(n + 1) % size}")) for n in range(size)))
    app = system.open_registrar("app")
    for n in range(size):
        workshop.shut(f"at r{n}")
    futures = [app.load(f"r{n}/thing", "same", block=False) for n in range(entrances)]
    workshop.wait("at", entrances)
    for n in range(size):
        workshop.open(f"at r{n}")
    for future in futures:
        with pytest.raises(rr.LoadFailed, match="r0/thing") as caught:
            future.get(timeout=LIMIT_S)
        for n in range(size):
            assert f"r{n}/thing" in str(caught.value)
    for n in range(size):
        eventually(lambda n=n: not system.registrar(f"r{n}").resources() and not system.registrar(f"r{n}").queries())


def test_the_error_of_a_callback_two_processes_away_arrives_with_its_trace(start: Start, workshop: Workshop) -> None:
    root = str(workshop.root)
    system = start(rr.ChildSpec(Shop, id="parts", args=(root,)), rr.ChildSpec(Shop, id="shop", args=(root,)))
    app = system.open_registrar("app")
    workshop.spoil("load wheel")
    with pytest.raises(rr.LoadFailed, match="load wheel is spoilt") as caught:
        app.load("shop/thing", Order("bike", ("parts/thing:seat", "parts/thing:wheel")))
    assert [frame.origin for frame in caught.value.trace] == ["parts/thing", "shop/thing"]
    assert caught.value.trace[0].message == "ValueError: load wheel is spoilt"
    workshop.wait("unload seat")
    for id in ("parts", "shop"):
        eventually(lambda id=id: not system.registrar(id).resources() and not system.registrar(id).queries())


def test_the_error_of_an_unload_callback_in_another_process_arrives_and_can_be_made_good(
    start: Start, workshop: Workshop
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    query = app.load("shop/thing", Order("wheel"))
    workshop.spoil("unload wheel")
    with pytest.raises(rr.UnloadFailed, match="unload wheel is spoilt") as caught:
        query.unload()
    assert [frame.origin for frame in caught.value.trace] == ["shop/thing"]
    wait_respawned(system, "shop", kill(system, "shop"))
    assert [resource.state for resource in system.registrar("shop").resources()] == ["unload_failed"]
    workshop.mend("unload wheel")
    app.unload(query.id)
    assert list(system.registrar("shop").resources()) == []


# -- registration at run time --------------------------------------------------------------------------------------


class Adder:
    """A callable object."""

    def __init__(self, much: int) -> None:
        self.much = much

    def __call__(self, request: int) -> int:
        return request + self.much

    def add(self, request: int) -> int:
        return request + self.much


def add(much: int, request: int) -> int:
    return request + much


async def add_later(request: int) -> int:
    await asyncio.sleep(0)
    return request + 4


def local_adders() -> dict[str, Callable[..., Any]]:
    much = 4

    def nested(request: int) -> int:
        return request + much

    return {
        "lambda": lambda request: request + much,
        "nested": nested,
        "partial": functools.partial(add, 4),
        "object": Adder(4),
        "bound": Adder(4).add,
        "coroutine": add_later,
    }


@both_placements
def test_callables_of_any_kind_can_be_registered_at_run_time(
    start: Start, workshop: Workshop, placement: Placement
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),), placement=placement))
    app = system.open_registrar("app")
    for kind, adder in local_adders().items():
        system.registrar("shop").register_server(kind, adder)
        assert app.load(f"shop/{kind}", 38).response == 42, kind


def test_a_server_registered_through_a_handle_runs_over_there(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app, handle = system.open_registrar("app"), system.registrar("shop")
    root, heard = str(workshop.root), Calls()
    handle.register_server(
        "late",
        lambda request: os.getpid(),
        lambda request, response: Workshop(root).note("unload late", request, response),
    )
    assert sorted(handle.servers()) == ["shop/late", "shop/thing"]
    pid = pid_of(system, "shop")
    query = app.load("shop/late", "x", on_status=heard)
    assert query.response == pid
    handle.send_status(query.resource_id, rr.Status(rr.State.WARNING, "hot"))
    assert heard.wait()[0].message == "hot"
    query.unload()
    assert workshop.lines("unload late") == [f"unload late x {pid}"]
    handle.unregister_server("late")
    assert list(handle.servers()) == ["shop/thing"]
    with pytest.raises(rr.UnknownServer, match="shop/late"):
        app.load("shop/late", "x")


def test_requests_of_a_class_made_in_a_function_reach_another_process(start: Start, workshop: Workshop) -> None:
    @dataclass(frozen=True)
    class Ask:
        words: tuple[str, ...]

    @dataclass(frozen=True)
    class Answer:
        words: tuple[str, ...]

    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    system.registrar("shop").register_server(
        "echo", lambda request: Answer(request.words[::-1]), request_type=Ask, response_type=Answer
    )
    assert app.load("shop/echo", Ask(("a", "b"))).response == Answer(("b", "a"))
    kill(system, "shop")
    assert app.load("shop/echo", Ask(("c",))).response == Answer(("c",))


def test_what_stands_for_a_query_or_a_resource_is_named_so_in_each_call(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app, handle = system.open_registrar("app"), system.registrar("shop")
    query = app.load("shop/thing", Order("chair"))
    handle.send_status(query_or_resource_id=query.resource_id, status=rr.Status(rr.State.WARNING, "worn"))
    assert query.wait_status(rr.State.WARNING, timeout_s=10.0).message == "worn"
    handle.update_response(query_or_resource_id=query, response=query.response)
    assert handle.children(query=query) == app.children(query=query) == []
    app.unload(query_or_id=query.id)
    with pytest.raises(rr.UnknownQuery):
        handle.unload(query_or_id=query.resource_id, force=True)


def test_a_handle_sees_what_the_registrar_over_there_sees(start: Start, workshop: Workshop) -> None:
    root = str(workshop.root)
    system = start(rr.ChildSpec(Shop, id="parts", args=(root,)), rr.ChildSpec(Shop, id="shop", args=(root,)))
    app, handle = system.open_registrar("app"), system.registrar("shop")
    assert handle.name == "shop"
    bike = app.load("shop/thing", Order("bike", ("parts/thing:wheel",)))
    (wheel,) = handle.queries()
    assert (wheel.registrar, wheel.request) == ("parts", Order("wheel"))
    assert [part.id for part in handle.children(bike)] == [wheel.id]
    assert list(handle.clients()) == ["parts/thing"]
    (resource,) = handle.resources()
    assert (resource.id, resource.server, resource.phase) == (bike.resource_id, "thing", "loaded")
    assert isinstance(resource.response, Made)


def test_a_handle_can_load_and_unload_for_the_registrar_over_there(start: Start, workshop: Workshop) -> None:
    root = str(workshop.root)
    system = start(rr.ChildSpec(Shop, id="parts", args=(root,)), rr.ChildSpec(Shop, id="shop", args=(root,)))
    handle = system.registrar("shop")
    query = handle.load("parts/thing", Order("spare"))
    assert query.origin == "shop"
    assert [list(resource.holders) for resource in system.registrar("parts").resources()] == [["shop"]]
    handle.unload(query)
    assert workshop.lines("unload") == ["unload spare"]


def shops(workshop: Workshop, *ids: str) -> list[rr.ChildSpec]:
    return [rr.ChildSpec(Shop, id=id, args=(str(workshop.root),)) for id in ids]


def test_what_a_handle_loads_without_waiting_can_be_unloaded(start: Start, workshop: Workshop) -> None:
    system = start(*shops(workshop, "a", "b"))
    handle = system.registrar("a")
    query = handle.load("b/thing", Order("one"), block=False).get(timeout=10)
    assert [held.id for held in handle.queries()] == [query.id]
    query.unload()
    assert handle.queries() == []

    async def awaited() -> rr.Query:
        return await handle.load("b/thing", Order("two"), block=False)

    asyncio.run(awaited()).unload()
    assert handle.queries() == []


def test_a_cancelled_load_through_a_handle_is_withdrawn(start: Start, workshop: Workshop) -> None:
    system = start(*shops(workshop, "a", "b"))
    handle = system.registrar("a")
    workshop.shut("load one")

    async def give_up() -> None:
        loading = asyncio.create_task(handle.load_async("b/thing", Order("one")))
        await asyncio.to_thread(workshop.wait, "load one")
        loading.cancel()
        with pytest.raises(asyncio.CancelledError):
            await loading

    asyncio.run(give_up())
    workshop.open("load one")
    workshop.wait("unload one")
    eventually(lambda: handle.queries() == [])


def test_a_cancelled_load_through_a_handle_is_withdrawn_in_a_callback_too(start: Start, workshop: Workshop) -> None:
    system = start(*shops(workshop, "a", "b"))
    handle = system.registrar("a")
    workshop.shut("load one")
    provider = system.open_registrar("provider")

    async def without_part(name: str) -> str:
        loading = asyncio.create_task(handle.load_async("b/thing", Order(name)))
        await asyncio.to_thread(workshop.wait, f"load {name}")
        loading.cancel()
        with pytest.raises(asyncio.CancelledError):
            await loading
        return name

    provider.register_server("set", without_part)
    app = system.open_registrar("app")
    query = app.load("provider/set", "one")
    assert app.children(query) == []
    workshop.open("load one")
    workshop.wait("unload one")
    eventually(lambda: provider.queries() == [])
    assert handle.queries() == []


def test_what_a_callback_loads_through_a_handle_is_its_dependency_too(start: Start, workshop: Workshop) -> None:
    system = start(*shops(workshop, "a", "b"))
    handle = system.registrar("a")
    provider = system.open_registrar("provider")
    provider.register_server("set", lambda name: handle.load("b/thing", Order(name)).response, response_type=Made)
    app = system.open_registrar("app")
    query = app.load("provider/set", "one")
    assert [part.request for part in app.children(query)] == [Order("one")]
    query.unload()
    assert workshop.wait("unload one")
    assert handle.queries() == []


def test_a_callback_loads_from_another_system_too(start: Start, workshop: Workshop, tmp_path: Path) -> None:
    here = start(*shops(workshop, "shop"))
    with rr.System(shops(workshop, "shop"), state_dir=tmp_path / "elsewhere") as elsewhere:
        there = elsewhere.open_registrar("there")
        provider = here.open_registrar("provider")
        provider.register_server("set", lambda name: there.load("shop/thing", Order(name)).response, response_type=Made)
        handle = elsewhere.registrar("shop")
        provider.register_server(
            "far", lambda name: handle.load("shop/thing", Order(name)).response, response_type=Made
        )
        app = here.open_registrar("app")
        for server, holder in (("set", there), ("far", handle)):
            query = app.load(f"provider/{server}", server)
            assert app.children(query) == []
            assert [held.request for held in holder.queries()] == [Order(server)]
            assert [resource.request for resource in handle.resources()] == [Order(server)]
            holder.unload_all()


def test_a_handle_waits_for_a_registrar_that_is_being_respawned(start: Start, workshop: Workshop) -> None:
    system = start(*shops(workshop, "parts", "shop"))
    handle = system.registrar("shop")
    spare = handle.load("parts/thing", Order("spare"))
    workshop.shut("start shop")
    workshop.shut("load late")
    kill(system, "shop")
    workshop.wait("start shop", 2)
    with ThreadPoolExecutor() as threads:
        asked = threads.submit(handle.queries)
        loading = handle.load("parts/thing", Order("wheel"), block=False)
        late = threads.submit(handle.load, "parts/thing", Order("late"), timeout_s=5.0)
        with pytest.raises(rr.RegistrarDown, match="starting"):
            handle.load("parts/thing", Order("nothing"), timeout_s=0.05)
        with pytest.raises(rr.RegistrarDown, match="starting"):
            handle.unload_client("parts/thing", timeout_s=0.05)
        assert system.snapshot()["registrars"]["shop"] == {"state": "starting"}
        assert not asked.done()
        workshop.open("start shop")
        assert asked.result(LIMIT_S)[:1] == [spare]  # and "wheel", if that was faster
        assert loading.get(timeout=LIMIT_S).response.name == "wheel"
        with pytest.raises(rr.LoadTimeout) as caught:
            late.result(LIMIT_S)
    assert 0.0 < caught.value.timeout_s < 5.0  # what was left of it
    workshop.open("load late")
    assert workshop.lines("load nothing") == []


def test_what_a_handle_only_asks_is_asked_again_if_the_process_dies_meanwhile(start: Start, workshop: Workshop) -> None:
    system = start(*shops(workshop, "parts", "shop"))
    handle = system.registrar("shop")
    spare = handle.load("parts/thing", Order("spare"))
    workshop.shut("load slow")
    with ThreadPoolExecutor() as threads:
        load = threads.submit(handle.load, "parts/thing", Order("slow"))
        workshop.wait("load slow")
        pid = pid_of(system, "shop")
        hang(pid)
        asked = [threads.submit(ask) for ask in (handle.queries, handle.servers, handle.clients) for _ in range(3)]
        os.kill(pid, signal.SIGKILL)
        with pytest.raises(rr.RegistrarDown, match="went away during the call"):
            load.result(LIMIT_S)
        workshop.open("load slow")
        answers = [answer.result(LIMIT_S) for answer in asked]
    assert spare in answers[0]
    assert answers[3:] == [["shop/thing"]] * 3 + [["parts/thing"]] * 3


def test_who_waits_by_a_handle_hears_of_the_systems_end(start: Start, workshop: Workshop) -> None:
    spec = rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),), shutdown_s="brutal_kill")
    system = start(spec)
    handle = system.registrar("shop")
    workshop.shut("start shop")
    kill(system, "shop")
    workshop.wait("start shop", 2)
    with ThreadPoolExecutor() as threads:
        asked = threads.submit(handle.queries)
        with pytest.raises(rr.RegistrarDown, match="starting"):
            handle.fetch_queries("shop", timeout_s=0.05)
        system.stop()
        with pytest.raises(rr.RegistrarDown, match=r"gone|stopped"):
            asked.result(LIMIT_S)
        with pytest.raises(rr.Unavailable):
            handle.queries()


def test_the_error_of_a_handles_call_reaches_a_caller_that_reads_late() -> None:
    class FullAtFirst:
        def __init__(self, sent: asyncio.Future[Any]) -> None:
            self.full = True
            self.sent = sent

        def send(self, message: Any) -> None:
            if self.full:
                self.full = False
                raise rr.MailboxFull("it does not read", name="app", limit=1)
            self.sent.set_result(message)

        def flush(self) -> None: ...

    def refuse(*_call: Any, **_options: Any) -> None:
        raise rr.Unavailable("no worker")

    async def answer() -> Any:
        loop = asyncio.get_running_loop()
        dispatcher = SimpleNamespace(loop=loop, workers=SimpleNamespace(submit=refuse))
        link: Any = FullAtFirst(loop.create_future())
        place: Any = SimpleNamespace(dispatcher=dispatcher)
        remote_calls.Door(place, None, link).received(link, remote_calls.CallMethod(7, "x", b""))
        async with asyncio.timeout(5):
            return await link.sent

    raised = asyncio.run(answer())

    assert raised.number == 7
    assert raised.failure.message == "no worker"


def test_threads_that_ask_at_once_for_a_handle_share_its_line(
    system: rr.System, monkeypatch: pytest.MonkeyPatch
) -> None:
    together = threading.Barrier(2)

    class Slow(remote_calls.HandleLine):
        def __init__(self, *args: Any) -> None:
            together.wait(LIMIT_S)
            super().__init__(*args)

    monkeypatch.setattr("rr_actors.registrar.engine.node.HandleLine", Slow)
    node = node_of(system)
    with ThreadPoolExecutor() as threads:
        one, other = threads.map(node.handle, ["far", "far"])
    assert one is other


def test_a_handle_on_an_unknown_registrar_is_an_error(system: rr.System) -> None:
    with pytest.raises(rr.UnknownRegistrar, match="nobody"):
        system.registrar("nobody").resources()


# -- classes made anywhere -----------------------------------------------------------------------------------------


@both_placements
def test_a_manager_class_made_in_a_function_can_be_placed_anywhere(start: Start, placement: Placement) -> None:
    @dataclass(frozen=True)
    class Ask:
        number: int

    factor = 6

    class Local(rr.Manager):
        @rr.server("times")
        def load_times(self, request: Ask) -> int:
            return request.number * factor

    system = start(rr.ChildSpec(Local, id="local", placement=placement))
    assert system.open_registrar("app").load("local/times", Ask(7)).response == 42


PROGRAM = """
from dataclasses import dataclass
import os, sys
import rr_actors as rr

@dataclass(frozen=True)
class Ask:
    number: int
    tags: tuple[str, ...] = ()

@dataclass(frozen=True)
class Answer:
    number: int
    pid: int

class Main(rr.Manager):
    def __init__(self, factor):
        self.factor = factor

    @rr.server("times")
    def load_times(self, request: Ask) -> Answer:
        return Answer(request.number * self.factor, os.getpid())

{guard}
    with rr.System([rr.ChildSpec(Main, id="main", args=(6,))], state_dir=sys.argv[1]) as system:
        app = system.open_registrar("app")
        answer = app.load("main/times", Ask(7, ("a",))).response
        assert type(answer) is Answer and answer.pid != os.getpid()
        system.registrar("main").register_server("late", lambda request: [request, os.getpid()])
        number, pid = app.load("main/late", answer.number).response
        assert pid == answer.pid
        print("answer", number)
"""


@pytest.mark.parametrize("way", ["file", "file without guard", "command", "standard input"])
def test_classes_and_lambdas_of_main_work(tmp_path: Path, way: str) -> None:
    guard = "if True:" if way == "file without guard" else 'if __name__ == "__main__":'
    program, state = PROGRAM.format(guard=guard), str(tmp_path / "state")
    script = tmp_path / "script.py"
    script.write_text(program)
    arguments = {"command": ["-c", program, state], "standard input": ["-", state]}.get(way, [str(script), state])
    done = subprocess.run(
        [sys.executable, *arguments],
        input=program if way == "standard input" else "",
        env=dict(os.environ, PYTHONPATH=str(REPOSITORY)),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "answer 42\n", "")


AGAIN = """
from dataclasses import dataclass
import enum, os, signal, sys
import rr_actors as rr

class Unit(enum.Enum):
    ONE = 1

@dataclass(frozen=True)
class Ask:
    number: int
    unit: Unit = Unit.ONE

@dataclass(frozen=True)
class Answer:
    number: int

class Main(rr.Manager):
    @rr.server("same", recovery="keep")
    def load_same(self, request: Ask) -> Answer:
        return Answer(request.number)

system = rr.System([rr.ChildSpec(Main, id="main")], state_dir=sys.argv[1]).start()
app = system.open_registrar("app")
restored = app.queries()
assert [(query.request, query.response) for query in restored] == [(Ask(1), Answer(1))] * len(restored)

def load(request: Ask) -> Answer:
    return Answer(request.number)

system.registrar("main").register_server("late", load)
for server in ("late", "same"):
    query = app.load(f"main/{server}", Ask(1))
    assert (query.request, query.response) == (Ask(1), Answer(1)), query
    assert app.fetch_queries("main")[0].request == Ask(1)
assert {resource.response for resource in system.registrar("main").resources()} == {Answer(1)}
print(len(restored), flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_an_earlier_run_of_a_script_holds_is_of_the_scripts_own_types(tmp_path: Path) -> None:
    for held in (0, 2, 4):
        done = subprocess.run(
            [sys.executable, "-c", AGAIN, str(tmp_path / "state")],
            env=dict(os.environ, PYTHONPATH=str(REPOSITORY)),
            capture_output=True,
            text=True,
            timeout=30,
            check=False,
        )
        assert (done.stdout, done.stderr) == (f"{held}\n", "")
    rr.System([], state_dir=tmp_path / "state").start().stop()  # removes what the killed ones left


@pytest.mark.parametrize("where", ["here", "there"])
def test_a_server_that_is_registered_again_may_have_other_types(start: Start, workshop: Workshop, where: str) -> None:
    system = start(*shops(workshop, "there"))
    app = system.open_registrar("app")
    provider = system.open_registrar("here") if where == "here" else system.registrar("there")
    for request, response in ((OpenCamera("a"), Feed("b", 1)), (Order("c"), Made("d", "e", 2)), ([1], {"f": 2})):
        types = {"request_type": type(request), "response_type": type(response)}
        provider.register_server("again", lambda _, response=response: response, **types)
        query = app.load(f"{where}/again", request)
        assert (query.request, query.response) == (request, response)
        provider.unregister_server("again")


@pytest.mark.parametrize("where", ["here", "there"])
def test_a_response_is_read_with_its_own_types_though_a_thread_has_it_before_these_types(
    start: Start, workshop: Workshop, where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    types = HeldBack(monkeypatch, Described)
    system = start(*shops(workshop, "there"))
    app = system.open_registrar("app")
    provider = system.open_registrar("here") if where == "here" else system.registrar("there")
    provider.register_server("again", lambda _: Feed("b", 1), request_type=OpenCamera, response_type=Feed)
    first = app.load(f"{where}/again", OpenCamera("a"))
    assert (first.request, first.response) == (OpenCamera("a"), Feed("b", 1))
    provider.unregister_server("again")
    actor = actor_of(app)
    receive = actor.receive

    def receive_behind_types(message: Any, sender: str, *, more: bool = False) -> None:
        if type(message) is Loaded:
            types.on = False
            for read in types.messages:
                read()
        receive(message, sender, more=more)

    types.on = True
    monkeypatch.setattr(actor, "receive", receive_behind_types)
    provider.register_server("again", lambda _: Made("d", "e", 2), request_type=Order, response_type=Made)
    query = app.load(f"{where}/again", Order("c"))
    assert (query.request, query.response) == (Order("c"), Made("d", "e", 2))


# -- the whole system as data --------------------------------------------------------------------------------------


def test_a_snapshot_shows_tree_and_resources_as_plain_data(start: Start, workshop: Workshop) -> None:
    root = str(workshop.root)
    system = start(
        rr.ChildSpec(Shop, id="parts", args=(root,), placement="thread"), rr.ChildSpec(Shop, id="shop", args=(root,))
    )
    app = system.open_registrar("app")
    bike = app.load("shop/thing", Order("bike", ("parts/thing:wheel",)))
    text = json.dumps(system.snapshot(), default=str)
    for word in ("parts", "shop", "app", bike.resource_id, bike.id):
        assert word in text, word


@pytest.mark.slow
def test_a_snapshot_waits_once_for_all_managers_that_do_not_answer(start: Start, workshop: Workshop) -> None:
    names = [f"shop{number}" for number in range(5)]
    system = start(*shops(workshop, *names))
    pids = [pid_of(system, name) for name in names[1:]]
    for pid in pids:
        hang(pid)
    begun = time.monotonic()
    described = system.snapshot()["registrars"]
    took = time.monotonic() - begun
    for pid in pids:
        os.kill(pid, signal.SIGCONT)
    assert described["shop0"]["servers"] == ["shop0/thing"]
    assert all("within 5 s" in described[name]["error"] for name in names[1:])
    assert took < 10.0  # each of the four would wait for 5 s after the one before


def test_subscribers_hear_of_what_happens(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    heard = Calls()
    system.subscribe(heard)
    app = system.open_registrar("app")
    app.load("shop/thing", Order("wheel")).unload()
    wait_respawned(system, "shop", kill(system, "shop"))
    for word in ("loaded", "unloaded", "exited", "restarted"):  # told before the answer: the kill comes too late
        eventually(lambda word=word: any(word in str(event).lower() for event in heard), what=word)


def test_what_happens_is_told_from_the_first_subscription_to_the_end_of_the_last(
    start: Start, workshop: Workshop
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")

    def resources_of(heard: Calls) -> list[str]:
        return [event["resource_id"] for event in heard if event["event"] == "loaded"]

    first, second = Calls(), Calls()
    unheard = app.load("shop/thing", Order("unheard"))
    unsubscribe = system.subscribe(first)
    one = app.load("shop/thing", Order("one"))
    eventually(lambda: resources_of(first) == [one.resource_id])
    unsubscribe_second = system.subscribe(second)
    unsubscribe()
    two = app.load("shop/thing", Order("two"))
    eventually(lambda: resources_of(second) == [two.resource_id])
    unsubscribe_second()
    app.load("shop/thing", Order("unheard too"))
    system.subscribe(second)
    three = app.load("shop/thing", Order("three"))
    eventually(lambda: resources_of(second) == [two.resource_id, three.resource_id])
    assert resources_of(first) == [one.resource_id]
    assert unheard.resource_id


def test_a_subscriber_that_raises_is_named_in_the_log_with_the_event_and_harms_nobody(
    system: rr.System, caplog: pytest.LogCaptureFixture
) -> None:
    def careless(event: dict[str, Any]) -> None:
        raise ValueError("my mistake")

    heard = Calls()
    system.subscribe(careless)
    system.subscribe(heard)
    app = system.open_registrar("app")
    app.register_server("thing", lambda request: request)
    app.load("app/thing", 1)
    expected = f"subscriber {careless.__qualname__} raised at the event 'loaded'"
    eventually(lambda: expected in caplog.text, what=expected)
    assert "my mistake" in caplog.text
    eventually(lambda: any(event["event"] == "loaded" for event in heard))


def test_a_registrar_that_is_closed_while_its_system_stops_does_not_harm_the_stop(
    start: Start, workshop: Workshop
) -> None:
    gate = Gate()
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    first, last = system.open_registrar("first"), system.open_registrar("last")
    last.register_server("thing", lambda request: request, lambda request, response: gate(request))
    last.load("last/thing", 1)
    with ThreadPoolExecutor(1) as threads:
        stopping = threads.submit(system.stop)  # the last comes first
        gate.wait_arrived()
        first.close()
        gate.open()
        stopping.result(LIMIT_S)
    assert workshop.lines("stop") != []


def test_what_fails_alike_for_everything_at_a_close_is_logged_once_with_how_often(
    system: rr.System, caplog: pytest.LogCaptureFixture
) -> None:
    def busy(request: int, response: int) -> None:
        raise OSError("busy")

    shop = system.open_registrar("shop")
    shop.register_server("thing", lambda request: request, busy)
    for number in range(20):
        shop.load("shop/thing", number)
    shop.close()
    told = [record.getMessage() for record in caplog.records if record.name == "rr_actors"]
    why = "shop/thing: OSError: busy; the resource is kept as unload_failed, and may be unloaded again"
    assert told[:2] == [f"shop: {why}", f"shop: 20 times: {why}"]


def test_systems_one_after_another_in_one_process_keep_no_files_open(start: Start) -> None:
    def descriptors() -> int:
        return len(os.listdir("/proc/self/fd"))

    before = descriptors()
    for _ in range(60):
        system = start()
        system.open_registrar("app")
        system.stop()
    assert descriptors() < before + 60  # what is left is collected later on


def test_children_are_told_with_id_state_and_pid(start: Start, workshop: Workshop) -> None:
    root = str(workshop.root)
    system = start(
        rr.ChildSpec(Shop, id="first", args=(root,)), rr.ChildSpec(Shop, id="second", args=(root,), placement="thread")
    )
    assert [entry.id for entry in system.supervisor().which_children()] == ["second", "first"]  # newest first, as OTP
    first = child(system, "first")
    assert first.state == "running"
    assert first.pid
    assert first.pid != os.getpid()
    counts = system.supervisor().count_children()
    assert (counts.specs, counts.active, counts.supervisors, counts.workers) == (2, 2, 0, 2)


def test_callbacks_of_different_requests_run_at_the_same_time(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    provider.register_server("thing", lambda request: gate(request))
    futures = [app.load("provider/thing", n, block=False) for n in range(8)]
    gate.wait_arrived(8)
    gate.open()
    for future in futures:
        future.get(timeout=5)


def test_two_systems_of_one_process_keep_to_themselves(start: Start, tmp_path: Path) -> None:
    first = start(rr.ChildSpec(Echo, id="echo"), state_dir=tmp_path / "one")
    second = start(rr.ChildSpec(Echo, id="echo"), rr.ChildSpec(Echo, id="more"), state_dir=tmp_path / "two")
    assert [child.id for child in first.supervisor().which_children()] == ["echo"]
    assert [child.id for child in second.supervisor("root").which_children()] == ["more", "echo"]
    pids = {first.ref("echo").ask("pid"), second.ref("root/echo").ask("pid")}
    assert len(pids) == 2
    apps = first.open_registrar("app"), second.open_registrar("app")
    assert {app.load("echo/pid", "x").response for app in apps} == pids
    first.stop()
    assert second.ref("echo").ask("pid") in pids
    assert second.supervisor().count_children().active == 2


class Echo(rr.Manager):
    """Says which process it is."""

    def on_receive(self, message: Any) -> int:
        return os.getpid()

    @rr.server("pid")
    def load_pid(self, request: str) -> int:
        return os.getpid()
