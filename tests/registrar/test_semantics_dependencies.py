"""What a registrar promises about dependencies (docs/semantics.md, "Dependencies")."""

from __future__ import annotations

import asyncio
import contextvars
import threading
from collections.abc import Callable
from typing import Any

import pytest

import rr_actors as rr
from support import Calls, Gate, eventually, loaded_with_parts, serve


def nothing_is_held(*registrars: rr.Registrar) -> bool:
    return not any(registrar.queries() or registrar.resources() for registrar in registrars)


# -- what becomes a dependency -------------------------------------------------------------------------------------


def test_whatever_a_load_callback_loads_becomes_a_dependency_of_the_resource_being_loaded(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(parts, "part")
    serve(provider, "local")
    load = loaded_with_parts(provider, ("parts/part", "wheel"), ("provider/local", "bell"), ("parts/part", "seat"))
    serve(provider, "bike", load=load)
    bike = app.load("provider/bike", None)
    children = provider.children(bike)
    assert {(child.registrar, child.server, child.request) for child in children} == {
        ("parts", "part", "wheel"),
        ("provider", "local", "bell"),
        ("parts", "part", "seat"),
    }
    assert {child.origin for child in children} == {"provider"}
    assert [query.id for query in app.queries()] == [bike.id]


def test_what_a_coroutine_callback_loads_in_its_task_is_a_dependency(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(parts, "part")

    async def load(request: Any) -> Any:
        first, second = await asyncio.gather(
            provider.load_async("parts/part", "wheel"), provider.load_async("parts/part", "seat")
        )
        return [first.response["of"], second.response["of"]]

    provider.register_server("bike", load)
    bike = app.load("provider/bike", None)
    assert bike.response == ["wheel", "seat"]
    assert {child.request for child in provider.children(bike)} == {"wheel", "seat"}
    bike.unload()
    eventually(lambda: nothing_is_held(provider, parts))


def test_dependencies_follow_the_context_into_other_threads(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(parts, "part")

    def load(request: Any) -> Any:
        context = contextvars.copy_context()
        thread = threading.Thread(target=context.run, args=(provider.load, "parts/part", "wheel"))
        thread.start()
        thread.join(5)

    serve(provider, "bike", load=load)
    bike = app.load("provider/bike", None)
    assert [child.request for child in provider.children(bike)] == ["wheel"]


def test_loads_at_the_same_time_each_keep_their_own_dependencies(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, gate: Gate
) -> None:
    serve(parts, "part")

    def load(request: Any) -> Any:
        provider.load("parts/part", f"first of {request}")
        gate()
        provider.load("parts/part", f"second of {request}")

    serve(provider, "bike", load=load)
    futures = [app.load("provider/bike", n, block=False) for n in range(4)]
    gate.wait_arrived(4)
    gate.open()
    for n, future in enumerate(futures):
        bike = future.get(timeout=5)
        assert {child.request for child in provider.children(bike)} == {f"first of {n}", f"second of {n}"}


def test_a_thread_of_its_own_context_passes_parent_explicitly(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(parts, "part")

    def load(request: Any) -> Any:
        parent = rr.current()

        def work() -> None:
            provider.load("parts/part", "wheel", parent=parent)
            provider.load("parts/part", "unrelated")

        thread = threading.Thread(target=work)
        thread.start()
        thread.join(5)

    serve(provider, "bike", load=load)
    bike = app.load("provider/bike", None)
    assert [child.request for child in provider.children(bike)] == ["wheel"]
    bike.unload()
    eventually(lambda: [query.request for query in provider.queries()] == ["unrelated"])


def test_what_is_loaded_outside_callbacks_is_nobodys_dependency(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(parts, "part")
    provider.load("parts/part", "spare")
    serve(provider, "bike", load=loaded_with_parts(provider, ("parts/part", "wheel")))
    bike = app.load("provider/bike", None)
    bike.unload()
    eventually(lambda: [query.request for query in provider.queries()] == ["spare"])
    assert [resource.request for resource in parts.resources()] == ["spare"]


# -- callbacks that raise ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("loaded_before", [0, 1, 2, 3])
def test_a_callback_that_raises_at_any_point_releases_exactly_what_it_had_loaded(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, loaded_before: int
) -> None:
    part = serve(parts, "part")
    provider.load("parts/part", "unrelated")
    provider.load("parts/part", 0)  # held for itself, too

    def load(request: Any) -> Any:
        for n in range(loaded_before):
            provider.load("parts/part", n)
        raise ValueError("broken")

    serve(provider, "bike", load=load)
    with pytest.raises(rr.LoadFailed, match="broken"):
        app.load("provider/bike", None)
    eventually(lambda: len(part.unloads) == max(0, loaded_before - 1))
    eventually(lambda: len(provider.queries()) == 2)
    assert {query.request for query in provider.queries()} == {"unrelated", 0}
    assert {resource.request for resource in parts.resources()} == {"unrelated", 0}
    assert [list(resource.holders) for resource in parts.resources()] == [["provider"], ["provider"]]
    assert list(provider.resources()) == []


def test_a_callback_that_raises_releases_nothing_of_a_load_beside_it(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, gate: Gate
) -> None:
    serve(parts, "part")

    def load(request: Any) -> Any:
        provider.load("parts/part", "shared")
        provider.load("parts/part", request)
        if request == "bad":
            raise ValueError("broken")
        gate()

    serve(provider, "bike", load=load)
    good = app.load("provider/bike", "good", block=False)
    gate.wait_arrived()
    with pytest.raises(rr.LoadFailed, match="broken"):
        app.load("provider/bike", "bad")
    gate.open()
    bike = good.get(timeout=5)
    assert {child.request for child in provider.children(bike)} == {"shared", "good"}
    eventually(lambda: {resource.request for resource in parts.resources()} == {"shared", "good"})


def test_a_callback_that_catches_a_failed_sub_load_and_takes_another_keeps_the_others(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    def make(request: Any) -> Any:
        if request == "bad":
            raise ValueError("bad part")
        return request

    part = serve(parts, "part", load=make)

    def load(request: Any) -> Any:
        first = provider.load("parts/part", "frame").response
        try:
            wheel = provider.load("parts/part", "bad").response
        except rr.LoadFailed:
            wheel = provider.load("parts/part", "good").response
        return [first, wheel]

    serve(provider, "bike", load=load)
    bike = app.load("provider/bike", None)
    assert bike.response == ["frame", "good"]
    assert {child.request for child in provider.children(bike)} == {"frame", "good"}
    assert len(part.unloads) == 0
    bike.unload()
    eventually(lambda: nothing_is_held(provider, parts))
    assert {request for request, _ in part.unloads} == {"frame", "good"}


def test_a_callback_may_give_back_what_it_loaded(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    part = serve(parts, "part")

    def load(request: Any) -> Any:
        tool = provider.load("parts/part", "tool")
        provider.load("parts/part", "wheel")
        tool.unload()

    serve(provider, "bike", load=load)
    bike = app.load("provider/bike", None)
    assert [child.request for child in provider.children(bike)] == ["wheel"]
    assert [request for request, _ in part.unloads] == ["tool"]


# -- rings ---------------------------------------------------------------------------------------------------------


def ring_names(error: rr.CircularDependency) -> set[str]:
    return set(error.ring)


def test_a_request_that_waits_for_itself_directly_fails_naming_the_ring(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    def load(request: Any) -> Any:
        return provider.load("provider/snake", request).response

    serve(provider, "snake", load=load)
    with pytest.raises(rr.CircularDependency, match="provider/snake") as caught:
        app.load("provider/snake", "tail", timeout_s=5.0)
    assert ring_names(caught.value) == {"provider/snake"}
    eventually(lambda: nothing_is_held(app, provider))


def test_the_error_of_a_ring_names_the_request_that_closes_it(app: rr.Registrar, provider: rr.Registrar) -> None:
    def load(number: int) -> None:
        provider.load("provider/half", max(number // 2, 7))

    serve(provider, "half", load=load)
    with pytest.raises(rr.CircularDependency) as caught:
        app.load("provider/half", 28)
    ring = "provider/half -> provider/half"
    assert f"a load would wait for itself: {ring}; refused is the load of provider/half with 7" in str(caught.value)
    assert caught.value.ring == ("provider/half",)
    eventually(lambda: nothing_is_held(app, provider))


@pytest.mark.parametrize("size", [2, 3, 5])
def test_a_request_that_waits_for_itself_around_a_ring_of_registrars_fails_naming_the_ring(
    system: rr.System, app: rr.Registrar, size: int
) -> None:
    members = [system.open_registrar(f"r{n}") for n in range(size)]
    for n, member in enumerate(members):
        serve(member, "x", load=loaded_with_parts(member, (f"r{(n + 1) % size}/x", "same")))
    with pytest.raises(rr.CircularDependency) as caught:
        app.load("r0/x", "same", timeout_s=5.0)
    assert ring_names(caught.value) == {f"r{n}/x" for n in range(size)}
    for name in ring_names(caught.value):
        assert name in str(caught.value)
    eventually(lambda: nothing_is_held(app, *members))


@pytest.mark.parametrize("size", [2, 3])
def test_a_ring_of_concurrent_loads_fails_without_deadlock(
    system: rr.System, app: rr.Registrar, gate: Gate, size: int
) -> None:
    """Each load was begun by a consumer of its own, so none is an ancestor of another."""
    members = [system.open_registrar(f"r{n}") for n in range(size)]
    caught_inside = Calls()

    def make(n: int, member: rr.Registrar) -> Callable[[Any], Any]:
        def load(request: Any) -> Any:
            gate(n)
            try:
                return member.load(f"r{(n + 1) % size}/x", "same").response
            except rr.CircularDependency as error:
                caught_inside(error)
                raise

        return load

    for n, member in enumerate(members):
        serve(member, "x", load=make(n, member))
    futures = [app.load(f"r{n}/x", "same", timeout_s=10.0, block=False) for n in range(size)]
    gate.wait_arrived(size)
    gate.open()
    errors = Calls()
    for future in futures:
        with pytest.raises(rr.LoadFailed) as caught:
            future.get(timeout=5)
        errors(caught.value)
    assert len(caught_inside) >= 1
    assert ring_names(caught_inside.items[0]) == {f"r{n}/x" for n in range(size)}
    eventually(lambda: nothing_is_held(app, *members))


def test_a_ring_may_be_survived_by_taking_another_part(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "spare", load=lambda request: "spare")

    def load(request: Any) -> Any:
        try:
            return provider.load("provider/snake", request).response
        except rr.CircularDependency:
            return provider.load("provider/spare", request).response

    serve(provider, "snake", load=load)
    assert app.load("provider/snake", "tail", timeout_s=5.0).response == "spare"


def test_recursion_that_does_not_close_a_ring_works_deep(app: rr.Registrar, provider: rr.Registrar) -> None:
    depth = 100

    def load(request: int) -> Any:
        return request if request == depth else provider.load("provider/deeper", request + 1).response

    served = serve(provider, "deeper", load=load)
    query = app.load("provider/deeper", 0)
    assert query.response == depth
    assert len(provider.resources()) == depth + 1
    query.unload()
    eventually(lambda: nothing_is_held(app, provider))
    assert [request for request, _ in served.unloads] == list(range(depth + 1))


def test_recursion_back_and_forth_between_registrars_works_deep(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    depth = 40

    def deeper(me: rr.Registrar, other: str) -> Callable[[int], Any]:
        return lambda n: n if n == depth else me.load(f"{other}/deeper", n + 1).response

    serve(provider, "deeper", load=deeper(provider, "parts"))
    serve(parts, "deeper", load=deeper(parts, "provider"))
    assert app.load("provider/deeper", 0).response == depth


def test_waiting_for_what_another_consumer_loads_is_no_ring(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, gate: Gate
) -> None:
    serve(parts, "part", load=lambda request: gate(request))
    load = loaded_with_parts(provider, ("parts/part", "wheel"))
    serve(provider, "bike", load=load)
    serve(provider, "car", load=load)
    futures = [app.load(server, None, block=False) for server in ("provider/bike", "provider/car", "parts/part")]
    futures.append(app.load("parts/part", "wheel", block=False))
    gate.wait_arrived()
    gate.open()
    assert [future.get(timeout=5).server for future in futures] == ["bike", "car", "part", "part"]


# -- the graph -----------------------------------------------------------------------------------------------------


def test_shared_sub_resources_are_held_once_per_holder(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    part = serve(parts, "part")
    serve(provider, "left", load=loaded_with_parts(provider, ("parts/part", "axle")))
    serve(provider, "right", load=loaded_with_parts(provider, ("parts/part", "axle")))
    serve(provider, "top", load=loaded_with_parts(provider, ("provider/left", 1), ("provider/right", 1)))
    top = app.load("provider/top", None)
    assert len(part.loads) == 1
    (axle,) = parts.resources()
    assert list(axle.holders) == ["provider", "provider"]
    holding = [query for query in provider.queries() if query.registrar == "parts"]
    assert len({query.id for query in holding}) == 2
    assert {query.resource_id for query in holding} == {axle.id}
    top.unload()
    assert len(part.unloads.wait()) == 1
    eventually(lambda: nothing_is_held(app, provider, parts))


def test_the_same_consumer_asking_twice_holds_twice_and_releases_twice(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    served = serve(provider, "thing")
    first, second = app.load("provider/thing", "x"), app.load("provider/thing", "x")
    assert [list(resource.holders) for resource in provider.resources()] == [["app", "app"]]
    first.unload()
    assert len(served.unloads) == 0
    assert [list(resource.holders) for resource in provider.resources()] == [["app"]]
    second.unload()
    assert len(served.unloads) == 1
