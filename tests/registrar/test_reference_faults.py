"""What the reference implementation of resource registrars gets wrong, one test each."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from support import Calls, Gate, Workshop, catalog_path, eventually, loaded_with_parts, messages, read_catalog, serve
from support_managers import Order, Shop


def test_the_first_of_two_holders_leaving_does_not_take_their_shared_dependency_away(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    part = serve(parts, "part")
    serve(provider, "bike", load=loaded_with_parts(provider, ("parts/part", "wheel")))
    first, second = app.load("provider/bike", None), system.open_registrar("other").load("provider/bike", None)
    first.unload()
    assert len(part.unloads) == 0
    assert [query.request for query in provider.children(second)] == ["wheel"]
    assert [resource.request for resource in parts.resources()] == ["wheel"]


def test_every_level_of_a_chain_is_unloaded(system: rr.System, app: rr.Registrar) -> None:
    members = [system.open_registrar(f"r{n}") for n in range(4)]
    served = [serve(members[0], "x")]
    for below, member in itertools.pairwise(members):
        served.append(serve(member, "x", load=loaded_with_parts(member, (f"{below.name}/x", None))))
    app.load("r3/x", None).unload()
    for each in served:
        assert each.unloads.wait()
        assert len(each.unloads) == 1
    eventually(lambda: not any(member.resources() for member in members))


def test_two_servers_with_the_same_request_bytes_do_not_overwrite_each_other(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "camera", load=lambda request: "camera")
    serve(provider, "lidar", load=lambda request: "lidar")
    camera, lidar = app.load("provider/camera", "front"), app.load("provider/lidar", "front")
    assert (camera.response, lidar.response) == ("camera", "lidar")
    assert camera.resource_id != lidar.resource_id
    camera.unload()
    assert app.load("provider/lidar", "front").resource_id == lidar.resource_id


def test_two_concurrent_identical_loads_run_the_callback_once(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    served = serve(provider, "camera", load=lambda request: gate(request))
    serve(provider, "fence")
    other = system.open_registrar("other")
    futures = [registrar.load("provider/camera", "front", block=False) for registrar in (app, other)]
    gate.wait_arrived()
    app.load("provider/fence", None)
    other.load("provider/fence", None)
    gate.open()
    assert len({future.get(timeout=5).resource_id for future in futures}) == 1
    assert len(served.loads) == 1


def test_a_callback_that_calls_its_own_registrar_keeps_all_its_dependencies(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(parts, "part")
    serve(provider, "motor")
    load = loaded_with_parts(provider, ("parts/part", "frame"), ("provider/motor", 1), ("parts/part", "wheel"))
    serve(provider, "car", load=load)
    car = app.load("provider/car", None)
    assert sorted(query.server for query in provider.children(car)) == ["motor", "part", "part"]
    car.unload()
    eventually(lambda: not provider.resources() and not parts.resources() and not provider.queries())


def test_a_callback_that_raises_after_a_sub_load_leaks_nothing(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    part = serve(parts, "part")

    def load(request: Any) -> Any:
        provider.load("parts/part", "wheel")
        raise ValueError("broken")

    serve(provider, "bike", load=load)
    with pytest.raises(rr.LoadFailed, match="broken"):
        app.load("provider/bike", None)
    part.unloads.wait()
    eventually(lambda: not parts.resources() and not provider.queries() and not provider.resources())


def test_a_callback_that_falls_back_after_a_failed_sub_load_loses_no_unrelated_part(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    def make(request: str) -> str:
        if request == "lidar1":
            raise ValueError("dark")
        return request

    part = serve(parts, "part", load=make)

    def load(request: Any) -> Any:
        used = [provider.load("parts/part", "frame").response]
        try:
            used.append(provider.load("parts/part", "lidar1").response)
        except rr.LoadFailed:
            used.append(provider.load("parts/part", "lidar2").response)
        return used

    serve(provider, "robot", load=load)
    robot = app.load("provider/robot", None)
    assert robot.response == ["frame", "lidar2"]
    assert {query.request for query in provider.children(robot)} == {"frame", "lidar2"}
    assert {resource.request for resource in parts.resources()} == {"frame", "lidar2"}
    assert len(part.unloads) == 0


def test_not_only_the_first_consumer_hears_a_status(system: rr.System, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    heard = [Calls() for _ in range(3)]
    for n, calls in enumerate(heard):
        system.open_registrar(f"c{n}").load("provider/camera", "front", on_status=calls)
    (camera,) = provider.resources()
    provider.send_status(camera.id, rr.Status(rr.State.WARNING, "dark"))
    for calls in heard:
        calls.wait()
        assert messages(calls) == ["dark"]


def test_a_status_under_a_departed_consumers_id_is_not_silently_lost(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "camera")
    heard = Calls()
    first = app.load("provider/camera", "front")
    second = system.open_registrar("other").load("provider/camera", "front", on_status=heard)
    first.unload()
    try:
        provider.send_status(first.id, rr.Status(rr.State.WARNING, "dark"))
    except rr.UnknownQuery:
        pass  # said aloud; else whoever still holds the resource hears of it
    else:
        assert heard.wait()[0].message == "dark"
    provider.send_status(first.resource_id, rr.Status(rr.State.ERROR, "darker"))
    eventually(lambda: "darker" in messages(heard))
    assert {status.query_id for status in heard} == {second.id}


def test_a_fatal_resource_is_not_handed_out_again(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    heard = Calls()
    dead = app.load("provider/camera", "front", on_status=heard)
    provider.send_status(dead.resource_id, rr.Status(rr.State.FATAL, "unplugged"))
    heard.wait()
    assert app.load("provider/camera", "front").resource_id != dead.resource_id


def test_a_dead_server_does_not_look_like_success(start: Callable[..., rr.System], workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),), placement="thread"))
    app = system.open_registrar("app")
    system.supervisor().terminate_child("shop")
    begun = time.monotonic()
    with pytest.raises((rr.Unavailable, rr.LoadTimeout), match="shop"):
        app.load("shop/thing", Order("wheel"), timeout_s=0.3)
    assert time.monotonic() - begun < 2.0
    assert list(app.queries()) == []


def test_the_ids_of_released_queries_do_not_pile_up(app: rr.Registrar, provider: rr.Registrar, state_dir: Path) -> None:
    serve(provider, "camera")

    def rows() -> int:
        tables = ("resources", "queries", "held", "notices", "peers")
        names = ("app", "provider")
        return sum(len(read_catalog(catalog_path(state_dir, name), table)) for name in names for table in tables)

    app.load("provider/camera", 0).unload()
    app.save_catalog()
    provider.save_catalog()
    before = rows()
    for n in range(100):
        app.load("provider/camera", n).unload()
    app.save_catalog()
    eventually(lambda: rows() == before)


def test_a_ring_does_not_overflow_the_stack(app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar) -> None:
    serve(provider, "chicken", load=lambda request: provider.load("parts/egg", request).response)
    serve(parts, "egg", load=lambda request: parts.load("provider/chicken", request).response)
    with pytest.raises(rr.CircularDependency) as caught:
        app.load("provider/chicken", "x", timeout_s=5.0)
    assert set(caught.value.ring) == {"provider/chicken", "parts/egg"}
    eventually(lambda: not provider.resources() and not parts.resources())
