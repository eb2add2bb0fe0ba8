"""What a registrar promises about unload (docs/semantics.md, "Unload")."""

from __future__ import annotations

import asyncio
import contextlib
import pickle
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.registrar.model.catalog import Catalog
from support import LIMIT_S, Calls, Gate, Workshop, eventually, kill, loaded_with_parts, serve, wait_respawned
from support_inside import actor_of
from support_managers import Order, Shop


def requests(registrar: rr.Registrar) -> list[Any]:
    return [resource.request for resource in registrar.resources()]


# -- while others hold it ------------------------------------------------------------------------------------------


def test_while_others_hold_the_resource_nothing_else_happens(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    part = serve(parts, "part")
    served = serve(provider, "bike", load=loaded_with_parts(provider, ("parts/part", "wheel")))
    other = system.open_registrar("other")
    first, second = app.load("provider/bike", None), other.load("provider/bike", None)
    first.unload()
    assert (len(served.unloads), len(part.unloads)) == (0, 0)
    assert list(app.queries()) == []
    assert [list(resource.holders) for resource in provider.resources()] == [["other"]]
    assert [child.request for child in provider.children(second)] == ["wheel"]
    second.unload()
    assert len(served.unloads) == 1
    part.unloads.wait()


def test_unload_drops_one_query_of_several_of_the_same_registrar(app: rr.Registrar, provider: rr.Registrar) -> None:
    served = serve(provider, "thing")
    queries = [app.load("provider/thing", "x") for _ in range(3)]
    app.unload(queries[1])
    assert [query.id for query in app.queries()] == [queries[0].id, queries[2].id]
    assert len(served.unloads) == 0


def test_a_forced_unload_waits_for_a_decision_that_is_being_made(app: rr.Registrar, provider: rr.Registrar) -> None:
    served = serve(provider, "thing")
    query = app.load("provider/thing", "x")
    actor = actor_of(provider)
    removed, forced = threading.Event(), threading.Event()

    def decide() -> None:
        with actor.lock:
            resource = actor.catalog.resources.pop(query.resource_id)  # half of a decision: the query is still there
            removed.set()
            forced.wait(0.1)
            actor.catalog.resources[query.resource_id] = resource

    with ThreadPoolExecutor(1) as other:
        deciding = other.submit(decide)
        assert removed.wait(LIMIT_S)
        try:
            provider.unload(query.id, force=True)
        finally:
            forced.set()
        deciding.result(LIMIT_S)
    assert (len(served.unloads), provider.resources()) == (1, [])


def test_a_signal_handler_may_call_the_registrar_while_a_forced_unload_looks_for_the_resource(
    app: rr.Registrar, provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    served = serve(provider, "thing")
    query = app.load("provider/thing", "x")
    find = Catalog.find

    def find_and_raise_signal(catalog: Catalog, target: str) -> Any:
        if threading.current_thread() is threading.main_thread():  # only it runs handlers
            signal.raise_signal(signal.SIGUSR1)
        return find(catalog, target)

    before = signal.signal(signal.SIGUSR1, lambda *_: provider.resources())
    monkeypatch.setattr(Catalog, "find", find_and_raise_signal)
    try:
        provider.unload(query.id, force=True)
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert len(served.unloads) == 1


# -- the last query ------------------------------------------------------------------------------------------------


def test_with_the_last_query_gone_the_unload_callback_gets_request_and_response(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    served = serve(provider, "thing")
    query = app.load("provider/thing", "x")
    app.unload(query)
    assert served.unloads.items == [("x", {"of": "x", "number": 1})]
    assert list(provider.resources()) == []
    assert list(app.queries()) == []


def test_a_server_without_unload_callback_just_forgets(app: rr.Registrar, provider: rr.Registrar) -> None:
    provider.register_server("thing", lambda request: request)
    app.load("provider/thing", "x").unload()
    assert list(provider.resources()) == []


def test_dependencies_are_unloaded_after_their_holder_newest_first(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    order = Calls()
    serve(parts, "part", unload=lambda request, response: order(request))
    serve(
        provider,
        "bike",
        load=loaded_with_parts(provider, *(("parts/part", n) for n in range(5))),
        unload=lambda request, response: order("bike"),
    )
    app.load("provider/bike", None).unload()
    assert order.wait(6) == ["bike", 4, 3, 2, 1, 0]


def test_unloading_goes_down_the_whole_graph_across_registrars(system: rr.System, app: rr.Registrar) -> None:
    depth = 5
    order = Calls()
    members = [system.open_registrar(f"r{n}") for n in range(depth)]
    for n, member in enumerate(members):
        below = [(f"r{n + 1}/x", None)] if n + 1 < depth else []
        serve(member, "x", load=loaded_with_parts(member, *below), unload=lambda request, response, n=n: order(n))
    app.load("r0/x", None).unload()
    assert order.wait(depth) == list(range(depth))
    eventually(lambda: not any(member.resources() or member.queries() for member in members))


def test_a_resource_can_be_loaded_again_after_it_was_unloaded(app: rr.Registrar, provider: rr.Registrar) -> None:
    served = serve(provider, "thing")
    for number in range(1, 4):
        with app.load("provider/thing", "x") as query:
            assert query.response["number"] == number
    assert (len(served.loads), len(served.unloads)) == (3, 3)


def test_a_request_that_comes_while_the_resource_is_being_unloaded_gets_a_fresh_one(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    order = Calls()

    def load(request: Any) -> Any:
        order("load")
        return "made"

    def unload(request: Any, response: Any) -> None:
        if not gate_passed:
            gate_passed.append(True)
            gate()
        order("unload")

    gate_passed: list[bool] = []
    serve(provider, "thing", load=load, unload=unload)
    first = app.load("provider/thing", "x")
    unloading = app.unload(first, block=False)
    gate.wait_arrived()
    second = app.load("provider/thing", "x", block=False)
    gate.open()
    unloading.get(timeout=5)
    assert second.get(timeout=5).resource_id != first.resource_id
    assert order.items == ["load", "unload", "load"]


# -- when unload returns -------------------------------------------------------------------------------------------


def test_unload_returns_when_the_callback_has_run(app: rr.Registrar, provider: rr.Registrar, gate: Gate) -> None:
    done = Calls()

    def unload(request: Any, response: Any) -> None:
        gate()
        done("unloaded")

    serve(provider, "thing", unload=unload)
    future = app.unload(app.load("provider/thing", "x"), block=False)
    gate.wait_arrived()
    with pytest.raises(Exception):  # noqa: B017 - Pykka's Timeout; not done yet is all that is asked
        future.get(timeout=0.05)
    gate.open()
    future.get(timeout=5)
    assert done.items == ["unloaded"]


def test_unload_returns_while_others_still_hold_the_resource(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    served = serve(provider, "thing")
    other = system.open_registrar("other").load("provider/thing", "x")
    app.load("provider/thing", "x").unload()
    assert len(served.unloads) == 0
    assert [resource.id for resource in provider.resources()] == [other.resource_id]


def test_a_query_can_be_unloaded_by_its_id_or_by_itself(app: rr.Registrar, provider: rr.Registrar) -> None:
    served = serve(provider, "thing")
    app.unload(app.load("provider/thing", 1).id)
    app.load("provider/thing", 2).unload()
    assert [request for request, _ in served.unloads] == [1, 2]


def test_unload_works_from_a_coroutine(app: rr.Registrar, provider: rr.Registrar) -> None:
    served = serve(provider, "thing")

    async def main() -> None:
        query = await app.load_async("provider/thing", "x")
        await app.unload(query, block=False)

    asyncio.run(main())
    assert len(served.unloads) == 1


# -- the provider is down ------------------------------------------------------------------------------------------


def test_a_provider_that_is_down_delays_the_release_which_is_not_forgotten(
    start: Callable[..., rr.System], workshop: Workshop
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),), placement="thread"))
    app = system.open_registrar("app")
    query = app.load("shop/thing", Order("wheel"))
    system.supervisor().terminate_child("shop")
    with pytest.raises(rr.Unavailable, match="shop"):
        app.unload(query, timeout_s=0.1)
    assert list(app.queries()) == []
    assert workshop.lines("unload") == []
    system.supervisor().restart_child("shop")
    workshop.wait("unload wheel")
    eventually(lambda: not system.registrar("shop").resources())


@pytest.mark.parametrize("way", ["one", "all", "close"])
def test_an_unload_says_at_once_and_at_its_end_that_the_provider_is_stopped(
    start: Callable[..., rr.System], workshop: Workshop, caplog: pytest.LogCaptureFixture, way: str
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    query = app.load("shop/thing", Order("wheel"))
    system.supervisor().terminate_child("shop")
    unload = {"one": query.unload, "all": app.unload_all, "close": app.close}[way]
    failed: list[rr.Unavailable] = []

    def unload_late() -> None:
        try:
            unload(timeout_s=1.0)
        except rr.Unavailable as error:
            failed.append(error)

    thread = threading.Thread(target=unload_late)
    thread.start()
    eventually(lambda: "app: a release waits for registrar 'shop', which is stopped" in caplog.text)
    assert thread.is_alive()
    thread.join()
    if way == "close":
        assert "app: closed with 1 query" in caplog.text
        return
    (error,) = failed
    assert "'shop' did not answer within 1 s; the release is owed" in str(error)
    assert "'shop' is stopped" in str(error)
    assert error.details["status"] == "stopped"


def test_an_unload_from_a_stopped_provider_is_done_when_that_is_started_again_in_time(
    start: Callable[..., rr.System], workshop: Workshop
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    query = app.load("shop/thing", Order("wheel"))
    system.supervisor().terminate_child("shop")
    future = app.unload(query, block=False)
    system.supervisor().restart_child("shop")
    future.get()
    assert workshop.lines("unload") == ["unload wheel"]


def test_unload_waits_for_a_provider_that_is_respawned(start: Callable[..., rr.System], workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    query = app.load("shop/thing", Order("wheel"))
    old = kill(system, "shop")
    app.unload(query)
    assert workshop.lines("unload") == ["unload wheel"]
    wait_respawned(system, "shop", old)
    assert list(system.registrar("shop").resources()) == []


def test_the_provider_of_a_dependency_being_down_delays_its_release(
    start: Callable[..., rr.System], workshop: Workshop
) -> None:
    spec = {"args": (str(workshop.root),), "placement": "thread"}
    system = start(rr.ChildSpec(Shop, id="parts", **spec), rr.ChildSpec(Shop, id="shop", **spec))
    app = system.open_registrar("app")
    query = app.load("shop/thing", Order("bike", ("parts/thing:wheel",)))
    system.supervisor().terminate_child("parts")
    app.unload(query, block=False)
    workshop.wait("unload bike")
    assert workshop.lines("unload wheel") == []
    system.supervisor().restart_child("parts")
    workshop.wait("unload wheel")
    eventually(lambda: not system.registrar("parts").resources() and not system.registrar("shop").queries())


# -- misuse --------------------------------------------------------------------------------------------------------


def test_unloading_twice_is_a_clear_error_and_changes_nothing(app: rr.Registrar, provider: rr.Registrar) -> None:
    served = serve(provider, "thing")
    first, second = app.load("provider/thing", "x"), app.load("provider/thing", "x")
    app.unload(first)
    with pytest.raises(rr.UnknownQuery, match=first.id) as caught:
        app.unload(first)
    assert caught.value.query_id == first.id
    with pytest.raises(rr.UnknownQuery):
        first.unload()
    assert [query.id for query in app.queries()] == [second.id]
    assert len(served.unloads) == 0


@pytest.mark.parametrize("way", ["by itself", "by its id", "with all", "late"])
def test_a_with_block_ends_well_if_its_query_was_let_go_inside_and_hides_no_error(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate, way: str
) -> None:
    served = serve(provider, "thing", unload=(lambda request, response: gate()) if way == "late" else None)
    with app.load("provider/thing", "x") as query:
        match way:
            case "by itself":
                query.unload()
            case "by its id":
                app.unload(query.id)
            case "with all":
                app.unload_all()
            case _:
                with pytest.raises(rr.Unavailable, match="the release is owed"):
                    query.unload(timeout_s=0.05)
    gate.open()
    served.unloads.wait()
    with pytest.raises(rr.UnknownQuery, match="unload it there"), pickle.loads(pickle.dumps(query)):
        pass


@pytest.mark.parametrize("way", ["with", "with a group", "async with"])
def test_an_unload_that_fails_at_the_end_of_a_block_is_a_note_on_the_blocks_own_exception(
    app: rr.Registrar, provider: rr.Registrar, way: str
) -> None:
    def jams(_request: str, _response: Any) -> None:
        raise ValueError("it jams")

    serve(provider, "thing", unload=jams)

    async def wait_and_raise() -> None:
        async with await app.load_async("provider/thing", "x"):
            raise KeyError("the block's own")

    def load_and_raise() -> None:
        if way == "async with":
            asyncio.run(wait_and_raise())
        requests = [("provider/thing", "x")]
        with app.load("provider/thing", "x") if way == "with" else app.load_all(requests):
            raise KeyError("the block's own")

    with pytest.raises(KeyError, match="the block's own") as raised:
        load_and_raise()
    assert len(raised.value.__notes__) == 1
    assert "UnloadFailed" in raised.value.__notes__[0]
    assert "it jams" in raised.value.__notes__[0]
    with pytest.raises(rr.UnloadFailed), app.load("provider/thing", "x"):
        pass


def test_unloading_another_consumers_query_is_a_clear_error_and_changes_nothing(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    served = serve(provider, "thing")
    query = app.load("provider/thing", "x")
    thief = system.open_registrar("thief")
    with pytest.raises(rr.NotHolder) as caught:
        thief.unload(query)
    assert (caught.value.query_id, caught.value.origin, caught.value.caller) == (query.id, "app", "thief")
    with pytest.raises(rr.UsageError):
        thief.unload(query.id)
    assert [held.id for held in app.queries()] == [query.id]
    assert len(served.unloads) == 0


def test_unloading_what_never_was_is_a_clear_error(app: rr.Registrar) -> None:
    with pytest.raises(rr.UnknownQuery, match="nonsense"):
        app.unload("nonsense")


# -- callbacks that raise ------------------------------------------------------------------------------------------


def failing_once(breaks: list[str]) -> Callable[[Any, Any], None]:
    def unload(request: Any, response: Any) -> None:
        if breaks:
            raise OSError(breaks.pop())

    return unload


def test_the_error_of_an_unload_callback_reaches_who_unloaded_last(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "thing", unload=failing_once(["device busy"]))
    first = app.load("provider/thing", "x")
    last = system.open_registrar("other").load("provider/thing", "x")
    first.unload()
    with pytest.raises(rr.UnloadFailed, match="device busy") as caught:
        last.unload()
    assert caught.value.resource_id == last.resource_id
    assert [frame.origin for frame in caught.value.trace] == ["provider/thing"]
    assert "device busy" in caught.value.trace[0].message


def test_what_could_not_be_unloaded_stays_with_its_dependencies_and_can_be_unloaded_again(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    part = serve(parts, "part")
    served = serve(
        provider,
        "bike",
        load=loaded_with_parts(provider, ("parts/part", "wheel")),
        unload=failing_once(["busy", "busy"]),
    )
    bike = app.load("provider/bike", None)
    for _ in range(2):
        with pytest.raises(rr.UnloadFailed, match="busy"):
            app.unload(bike)
        (resource,) = provider.resources()
        assert resource.id == bike.resource_id
        assert resource.state == "unload_failed"
        assert requests(parts) == ["wheel"]
        assert len(part.unloads) == 0
    app.unload(bike)
    assert len(served.unloads) == 3
    part.unloads.wait()
    eventually(lambda: not provider.resources() and not parts.resources() and not app.queries())


def test_a_dependency_that_could_not_be_unloaded_is_not_forgotten(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    part = serve(parts, "part", unload=failing_once(["busy"]))
    serve(provider, "bike", load=loaded_with_parts(provider, ("parts/part", "wheel")))
    bike = app.load("provider/bike", None)
    with contextlib.suppress(rr.UnloadFailed):  # whether the first consumer hears of it is not promised
        bike.unload()
    part.unloads.wait()
    (wheel,) = eventually(lambda: [r for r in parts.resources() if r.state == "unload_failed"])
    assert wheel.request == "wheel"
    parts.unload(wheel.id, force=True)
    assert len(part.unloads) == 2
    eventually(lambda: not parts.resources() and not provider.queries())


def test_two_holders_who_leave_at_the_same_moment_unload_it_once(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    served = serve(provider, "thing")
    other = system.open_registrar("other")
    for n in range(30):
        queries = [app.load("provider/thing", n), other.load("provider/thing", n)]
        for future in [
            query_of.unload(query, block=False) for query_of, query in zip((app, other), queries, strict=True)
        ]:
            future.get(timeout=5)
    assert [request for request, _ in served.unloads] == list(range(30))


# -- many at once --------------------------------------------------------------------------------------------------


def test_unload_client_where_nothing_is_held_nor_ever_was_names_the_clients_there_are(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "one")
    serve(provider, "two")
    with pytest.raises(rr.UnknownServer, match="never did; it holds nothing at any server") as raised:
        app.unload_client("provider/one")
    assert raised.value.known == ()
    app.load("provider/two", 0)
    for server in ("provider/one", "nowhere/x"):
        with pytest.raises(rr.UnknownServer, match=f"'{server}'.*never did; it holds something at provider/two"):
            app.unload_client(server)
        with pytest.raises(rr.UnknownServer) as raised:
            app.unload_client(server, block=False)
        assert (raised.value.server, raised.value.known) == (server, ("provider/two",))


def test_unload_client_where_all_was_let_go_already_does_nothing(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "one")
    app.load("provider/one", 0).unload()
    app.unload_client("provider/one")
    app.load("provider/one", 0)
    for _ in range(2):
        app.unload_client("provider/one")
    assert app.queries() == []


def test_unload_client_releases_all_this_registrar_holds_at_that_server_and_nothing_else(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    one, two = serve(provider, "one"), serve(provider, "two")
    other = system.open_registrar("other")
    for n in range(3):
        app.load("provider/one", n)
    app.load("provider/one", 0)
    app.load("provider/two", 0)
    other.load("provider/one", 2)
    app.unload_client("provider/one")
    assert sorted(request for request, _ in one.unloads) == [0, 1]
    assert len(two.unloads) == 0
    assert [(query.server, query.request) for query in app.queries()] == [("two", 0)]
    assert [query.request for query in other.queries()] == [2]


def test_unload_all_releases_all_that_the_registrar_holds(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    served = [serve(provider, "one"), serve(provider, "two"), serve(parts, "one")]
    for server in ("provider/one", "provider/two", "parts/one"):
        app.load(server, None)
    app.unload_all()
    assert [len(each.unloads) for each in served] == [1, 1, 1]
    assert list(app.queries()) == []


def test_closing_a_registrar_releases_all_that_it_holds(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    one, two = serve(provider, "one"), serve(parts, "two")
    other = system.open_registrar("other")
    app.load("provider/one", "mine")
    app.load("provider/one", "ours")
    other.load("provider/one", "ours")
    app.load("parts/two", "mine")
    app.close()
    one.unloads.wait()
    two.unloads.wait()
    eventually(lambda: [list(resource.holders) for resource in provider.resources()] == [["other"]])
    assert [request for request, _ in one.unloads] == ["mine"]
    assert list(parts.resources()) == []


def test_what_threads_load_while_their_registrar_is_closing_is_released(
    start: Callable[..., rr.System], workshop: Workshop
) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    app.load("shop/thing", Order("wheel"))
    for step in ("unload wheel", "load seat"):
        workshop.shut(step)
    closing = threading.Thread(target=app.close)
    closing.start()
    workshop.wait("unload wheel")
    app.load("shop/thing", Order("door"))
    with ThreadPoolExecutor(1) as pool:
        loading = pool.submit(app.load, "shop/thing", Order("seat"))
        workshop.wait("load seat")
        workshop.open("unload wheel")
        closing.join()
        assert isinstance(loading.exception(LIMIT_S), rr.RegistrarDown)
    workshop.wait("unload door")
    workshop.open("load seat")
    workshop.wait("unload seat")
    eventually(lambda: not system.registrar("shop").resources())


def test_unregister_server_releases_all_queries_on_it_and_tells_their_holders(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    served, kept = serve(provider, "thing"), serve(provider, "kept")
    other = system.open_registrar("other")
    heard, heard_by_other, heard_of_kept = Calls(), Calls(), Calls()
    first = app.load("provider/thing", 1, on_status=heard)
    second = other.load("provider/thing", 2, on_status=heard_by_other)
    keep = app.load("provider/kept", 1, on_status=heard_of_kept)
    provider.unregister_server("thing")
    assert heard.wait()[0].query_id == first.id
    assert heard_by_other.wait()[0].query_id == second.id
    eventually(lambda: [query.id for query in app.queries()] == [keep.id] and not other.queries())
    eventually(lambda: sorted(request for request, _ in served.unloads) == [1, 2])
    assert [resource.server for resource in provider.resources()] == ["kept"]
    assert (len(kept.unloads), len(heard_of_kept)) == (0, 0)
    with pytest.raises(rr.UnknownServer, match="provider/thing"):
        app.load("provider/thing", 1)
    with pytest.raises(rr.UnknownQuery):
        first.unload()


def test_an_unregistered_server_can_be_registered_again(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing", load=lambda request: "old")
    app.load("provider/thing", 1)
    provider.unregister_server("thing")
    serve(provider, "thing", load=lambda request: "new")
    assert app.load("provider/thing", 1).response == "new"


def test_forced_unload_releases_all_queries_on_one_resource_and_tells_their_holders(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    served = serve(provider, "thing")
    other = system.open_registrar("other")
    heard, heard_by_other, heard_elsewhere = Calls(), Calls(), Calls()
    first = app.load("provider/thing", "x", on_status=heard)
    second = other.load("provider/thing", "x", on_status=heard_by_other)
    app.load("provider/thing", "y", on_status=heard_elsewhere)
    provider.unload(first.resource_id, force=True)
    assert [request for request, _ in served.unloads] == ["x"]
    assert heard.wait()[0].query_id == first.id
    assert heard_by_other.wait()[0].query_id == second.id
    eventually(lambda: [query.request for query in app.queries()] == ["y"] and not other.queries())
    assert requests(provider) == ["y"]
    assert len(heard_elsewhere) == 0


# -- linger --------------------------------------------------------------------------------------------------------


def test_what_is_unloaded_by_force_while_its_server_is_away_waits_for_it_and_the_owner_hears_so(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    stuck = [True]

    def unload(_request: Any, _response: Any) -> None:
        if stuck:
            raise ValueError("it does not let go")

    provider.register_server("thing", lambda request: request, unload)
    query = app.load("provider/thing", "x")
    with pytest.raises(rr.UnloadFailed, match="it does not let go"):
        provider.unregister_server("thing")
    with pytest.raises(rr.Unavailable, match=r"waits for its server 'provider/thing' to be registered again"):
        provider.unload(query.resource_id, force=True, timeout_s=0.1)
    assert [resource.id for resource in provider.resources()] == [query.resource_id]
    stuck.clear()
    served = serve(provider, "thing")
    served.unloads.wait()
    eventually(lambda: not provider.resources())


def test_linger_s_keeps_an_unheld_resource_warm_for_the_next_request(app: rr.Registrar, provider: rr.Registrar) -> None:
    served = serve(provider, "thing", linger_s=60.0)
    first = app.load("provider/thing", "x")
    first.unload()
    assert len(served.unloads) == 0
    (resource,) = provider.resources()
    assert list(resource.holders) == []
    second = app.load("provider/thing", "x")
    assert (second.resource_id, second.response) == (first.resource_id, first.response)
    assert len(served.loads) == 1


def test_after_linger_s_an_unheld_resource_is_unloaded_with_its_dependencies(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    part = serve(parts, "part")
    load = loaded_with_parts(provider, ("parts/part", "wheel"))
    served = serve(provider, "bike", load=load, linger_s=0.5)
    app.load("provider/bike", None).unload()
    assert len(part.unloads) == 0
    served.unloads.wait()
    part.unloads.wait()
    eventually(lambda: not provider.resources() and not parts.resources())


def test_a_request_within_linger_s_stops_the_clock(app: rr.Registrar, provider: rr.Registrar) -> None:
    served = serve(provider, "thing", linger_s=0.5)
    serve(provider, "clock", linger_s=0.5)
    app.load("provider/thing", "x").unload()
    held = app.load("provider/thing", "x")
    clock = app.load("provider/clock", "x")
    clock.unload()
    eventually(lambda: [resource.server for resource in provider.resources()] == ["thing"])  # its 0.5 s are over
    assert len(served.unloads) == 0
    held.unload()
    served.unloads.wait()


def test_closing_a_registrar_that_holds_what_it_serves_itself_is_no_error(
    system: rr.System, caplog: pytest.LogCaptureFixture
) -> None:
    both = system.open_registrar("both")
    served = serve(both, "thing")
    for number in range(20):
        both.load("both/thing", number % 10)
    both.close()
    assert len(served.unloads) == 10
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == []


@pytest.mark.parametrize("how", ["by force", "with its server"])
def test_an_owners_unload_that_its_callback_holds_up_ends_when_the_registrar_is_closed(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate, how: str
) -> None:
    serve(provider, "thing", unload=lambda _request, _response: gate())
    query = app.load("provider/thing", "x")
    ended = Calls()

    def unload() -> None:
        try:
            if how == "by force":
                provider.unload(query.resource_id, force=True, timeout_s=None)
            else:
                provider.unregister_server("thing", timeout_s=None)
        except rr.RrError as error:
            ended(error)

    threading.Thread(target=unload, daemon=True).start()
    gate.wait_arrived()
    provider.close(timeout_s=0.1)
    (error,) = ended.wait()
    gate.open()
    assert type(error) is rr.RegistrarDown
    assert "registrar 'provider': closed" in str(error)
