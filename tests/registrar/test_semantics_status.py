"""What a registrar promises about statuses (docs/semantics.md, "Status")."""

from __future__ import annotations

import logging
import pickle
import threading
from collections.abc import Callable
from typing import Any

import pytest

import rr_actors as rr
from support import LIMIT_S, Calls, Gate, Served, eventually, loaded_with_parts, serve

WARNING = rr.Status(rr.State.WARNING, "low light")
ERROR = rr.Status(rr.State.ERROR, "no picture")
FATAL = rr.Status(rr.State.FATAL, "unplugged")
LAST = rr.Status(rr.State.OK, "last")
"""Sent after what a test is about: when it has been heard, nothing sent before is still on its way."""


def test_the_states_are_those_five() -> None:
    assert [state.value for state in rr.State] == ["OK", "UPDATE", "WARNING", "ERROR", "FATAL"]


# -- every holder, once --------------------------------------------------------------------------------------------


def test_every_current_holder_hears_exactly_once(system: rr.System, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    heard = [Calls() for _ in range(4)]
    queries = [
        system.open_registrar(f"holder{n}").load("provider/camera", "front", on_status=calls)
        for n, calls in enumerate(heard)
    ]
    provider.send_status(queries[0].resource_id, WARNING)
    provider.send_status(queries[0].resource_id, LAST)
    for query, calls in zip(queries, heard, strict=True):
        first, last = calls.wait(2)
        assert (first.state, first.message) == (rr.State.WARNING, "low light")
        assert (first.resource_id, first.query_id) == (query.resource_id, query.id)
        assert first.source == "provider/camera"
        assert last.message == "last"
    assert [len(calls) for calls in heard] == [2, 2, 2, 2]


@pytest.mark.parametrize("leaver", [0, 1, 2])
def test_the_remaining_holders_hear_whoever_loaded_first_and_whoever_has_left(
    system: rr.System, provider: rr.Registrar, leaver: int
) -> None:
    serve(provider, "camera")
    heard = [Calls() for _ in range(3)]
    queries = [
        system.open_registrar(f"holder{n}").load("provider/camera", "front", on_status=calls)
        for n, calls in enumerate(heard)
    ]
    queries[leaver].unload()
    provider.send_status(queries[0].resource_id, WARNING)
    provider.send_status(queries[0].resource_id, LAST)
    for n, calls in enumerate(heard):
        if n != leaver:
            assert messages_of(calls.wait(2)) == ["low light", "last"]
    assert len(heard[leaver]) == 0


def messages_of(statuses: list[rr.Status]) -> list[str]:
    return [status.message for status in statuses]


def test_a_registrar_that_holds_twice_hears_for_each_query(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    one, two = Calls(), Calls()
    first = app.load("provider/camera", "front", on_status=one)
    second = app.load("provider/camera", "front", on_status=two)
    provider.send_status(first.resource_id, WARNING)
    provider.send_status(first.resource_id, LAST)
    assert [status.query_id for status in one.wait(2)] == [first.id, first.id]
    assert [status.query_id for status in two.wait(2)] == [second.id, second.id]
    assert (len(one), len(two)) == (2, 2)


def test_only_the_holders_of_that_resource_hear(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    serve(provider, "lidar")
    heard, elsewhere = Calls(), Calls()
    front = app.load("provider/camera", "front", on_status=heard)
    rear = app.load("provider/camera", "rear", on_status=elsewhere)
    lidar = app.load("provider/lidar", "front", on_status=elsewhere)
    provider.send_status(front.resource_id, WARNING)
    for query in (rear, lidar):
        provider.send_status(query.resource_id, LAST)
    assert messages_of(elsewhere.wait(2)) == ["last", "last"]
    assert messages_of(heard.wait(1)) == ["low light"]


def test_statuses_arrive_in_the_order_they_were_sent(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    heard = Calls()
    query = app.load("provider/camera", "front", on_status=heard)
    for n in range(50):
        provider.send_status(query.resource_id, rr.Status(rr.State.WARNING, str(n)))
    assert messages_of(heard.wait(50)) == [str(n) for n in range(50)]


def test_a_status_can_be_sent_for_a_query_of_the_resource(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    heard = Calls()
    query = app.load("provider/camera", "front", on_status=heard)
    provider.send_status(query.id, WARNING)
    provider.send_status(query, ERROR)
    assert messages_of(heard.wait(2)) == ["low light", "no picture"]


def test_a_status_for_what_is_not_there_is_an_error(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    query = app.load("provider/camera", "front")
    query.unload()
    for gone in (query.resource_id, "nonsense"):
        with pytest.raises(rr.UnknownQuery, match=gone):
            provider.send_status(gone, WARNING)


def test_a_status_that_a_holder_sends_is_refused_and_the_error_names_the_owner(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "camera")
    query = app.load("provider/camera", "front")
    refused = "'app' holds it, and does not serve it: call 'provider', which serves it as provider/camera"
    for target in (query, query.id, query.resource_id):
        with pytest.raises(rr.UnknownQuery, match=refused):
            app.send_status(target, WARNING)
    with pytest.raises(rr.UnknownQuery, match=refused):
        app.update_response(query, "late")
    with pytest.raises(rr.UnknownQuery, match=refused):
        app.unload(query.id, force=True)


def test_a_server_callback_may_send_a_status_of_the_resource_it_has_loaded(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    """The owner need not wait for load to return before its monitor begins."""
    threads: list[threading.Thread] = []

    def load(request: Any) -> Any:
        resource_id = rr.current().resource_id

        def monitor() -> None:
            eventually(lambda: any(r.id == resource_id and r.phase == "loaded" for r in provider.resources()))
            provider.send_status(resource_id, WARNING)

        threads.append(threading.Thread(target=monitor))
        threads[0].start()

    serve(provider, "camera", load=load)
    heard = Calls()
    app.load("provider/camera", "front", on_status=heard)
    assert messages_of(heard.wait()) == ["low light"]
    threads[0].join(5)


# -- up the graph --------------------------------------------------------------------------------------------------


class Chain:
    """app -> r2/x -> r1/x -> r0/x: what each hears of a status of r0's resource."""

    def __init__(self, system: rr.System, app: rr.Registrar, levels: int = 3) -> None:
        self.members = [system.open_registrar(f"r{n}") for n in range(levels)]
        self.servers: list[Served] = []
        for n, member in enumerate(self.members):
            below = [(f"r{n - 1}/x", "req")] if n else []
            self.servers.append(serve(member, "x", load=loaded_with_parts(member, *below)))
        self.heard = Calls()
        self.query = app.load(f"r{levels - 1}/x", "req", on_status=self.heard)
        (self.bottom,) = self.members[0].resources()

    def send(self, status: rr.Status) -> None:
        self.members[0].send_status(self.bottom.id, status)


def test_a_status_goes_up_through_the_status_callbacks_to_the_first_consumer(
    system: rr.System, app: rr.Registrar
) -> None:
    chain = Chain(system, app)
    chain.send(WARNING)
    chain.send(LAST)
    first, _ = chain.heard.wait(2)
    assert (first.state, first.message) == (rr.State.WARNING, "low light")
    assert (first.resource_id, first.query_id) == (chain.query.resource_id, chain.query.id)
    assert first.source == "r0/x"
    for server in chain.servers:
        assert [(request, status.message) for request, status in server.statuses] == [
            ("req", "low light"),
            ("req", "last"),
        ]
    assert len(chain.heard) == 2


def test_in_a_diamond_everybody_hears_once(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, system: rr.System
) -> None:
    serve(parts, "axle")
    sides = [
        serve(provider, name, load=loaded_with_parts(provider, ("parts/axle", "front"))) for name in ("left", "right")
    ]
    top_registrar = system.open_registrar("top")
    top = serve(
        top_registrar, "car", load=loaded_with_parts(top_registrar, ("provider/left", 1), ("provider/right", 1))
    )
    heard = Calls()
    app.load("top/car", None, on_status=heard)
    (axle,) = parts.resources()
    parts.send_status(axle.id, WARNING)
    assert messages_of(heard.wait()) == ["low light"]
    parts.send_status(axle.id, LAST)
    assert messages_of(heard.wait(2)) == ["low light", "last"]
    for server in (*sides, top):
        eventually(lambda server=server: len(server.statuses) == 2)
        assert [status.message for _, status in server.statuses] == ["low light", "last"]
    assert len(heard) == 2


def test_a_registrar_with_two_resources_on_the_same_part_hears_for_each_of_them(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(parts, "axle")
    cars = serve(provider, "car", load=loaded_with_parts(provider, ("parts/axle", "front")))
    heard = Calls()
    queries = [app.load("provider/car", n, on_status=heard) for n in range(2)]
    (axle,) = parts.resources()
    parts.send_status(axle.id, WARNING)
    assert {status.query_id for status in heard.wait(2)} == {query.id for query in queries}
    assert sorted(request for request, _ in cars.statuses) == [0, 1]


def test_the_holder_that_has_dealt_with_a_status_may_stop_it(system: rr.System, app: rr.Registrar) -> None:
    chain = Chain(system, app)

    def deal(request: Any, status: rr.Status) -> None:
        if status.state is rr.State.ERROR:
            status.handled()

    chain.servers[1].do_status = deal
    chain.send(ERROR)
    chain.send(LAST)
    assert messages_of(chain.heard.wait()) == ["last"]
    assert [status.message for _, status in chain.servers[1].statuses] == ["no picture", "last"]
    assert [status.message for _, status in chain.servers[2].statuses] == ["last"]


@pytest.mark.parametrize("with_callback", [True, False], ids=["callback of the server too", "none"])
@pytest.mark.parametrize("whose", ["query", "registrar"])
def test_who_listens_to_a_part_may_stop_it_too(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, with_callback: bool, whose: str
) -> None:
    dealing = threading.Event()

    def deal(status: rr.Status) -> None:
        if status.state is rr.State.ERROR:
            dealing.wait(LIMIT_S)  # what goes up has time to do so
            status.handled()

    def load(request: Any) -> Any:
        return provider.load("parts/lidar", request, on_status=deal if whose == "query" else None).response

    serve(parts, "lidar")
    above = Calls()
    status_callback = (lambda request, status: above(status)) if with_callback else None
    provider.register_server("robot", load, status=status_callback)
    if whose == "registrar":
        provider.on_status("parts/lidar", deal)
    heard = Calls()
    query = app.load("provider/robot", "r", on_status=heard)
    (lidar,) = parts.resources()
    parts.send_status(lidar.id, ERROR)
    parts.send_status(lidar.id, LAST)
    dealing.set()
    assert messages_of(heard.wait()) == ["last"]
    assert messages_of(above.items) == (["last"] if with_callback else [])
    assert provider.resources()[0].status is query.state is LAST.state
    eventually(lambda: parts.stats()["notices"] == 0)


def test_who_listens_to_a_part_and_raises_or_says_nothing_passes_it_on(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    def angry(status: rr.Status) -> None:
        raise RuntimeError("angry listener")

    serve(parts, "lidar")
    provider.register_server("robot", lambda request: provider.load("parts/lidar", request, on_status=angry).response)
    provider.on_status("parts/lidar", lambda status: None)
    heard = Calls()
    app.load("provider/robot", "r", on_status=heard)
    (lidar,) = parts.resources()
    parts.send_status(lidar.id, ERROR)
    assert messages_of(heard.wait()) == ["no picture"]


def test_a_server_without_status_callback_passes_it_on(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(parts, "axle")
    provider.register_server("car", loaded_with_parts(provider, ("parts/axle", "front")))
    heard = Calls()
    app.load("provider/car", None, on_status=heard)
    (axle,) = parts.resources()
    parts.send_status(axle.id, WARNING)
    assert messages_of(heard.wait()) == ["low light"]


def test_a_status_callback_may_load(app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar) -> None:
    serve(parts, "lidar")
    replaced = Calls()

    def replace(request: Any, status: rr.Status) -> None:
        replaced(provider.load("parts/lidar", "second").response["of"])
        status.handled()

    serve(provider, "robot", load=loaded_with_parts(provider, ("parts/lidar", "first")), status=replace)
    app.load("provider/robot", None)
    (first,) = parts.resources()
    parts.send_status(first.id, FATAL)
    assert replaced.wait() == ["second"]


# -- callbacks that raise ------------------------------------------------------------------------------------------


def test_a_status_callback_of_a_holder_that_raises_harms_no_one_else(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, caplog: pytest.LogCaptureFixture
) -> None:
    serve(provider, "camera")

    def angry(status: rr.Status) -> None:
        raise RuntimeError("angry holder")

    heard = Calls()
    with caplog.at_level(logging.ERROR):
        query = app.load("provider/camera", "front", on_status=angry)
        system.open_registrar("other").load("provider/camera", "front", on_status=heard)
        provider.send_status(query.resource_id, WARNING)
        provider.send_status(query.resource_id, LAST)
        assert messages_of(heard.wait(2)) == ["low light", "last"]
        eventually(lambda: "angry holder" in caplog.text)
    assert app.load("provider/camera", "front").resource_id == query.resource_id


def test_a_status_callback_of_a_server_that_raises_does_not_stop_the_status(
    system: rr.System, app: rr.Registrar, caplog: pytest.LogCaptureFixture
) -> None:
    chain = Chain(system, app)

    def angry(request: Any, status: rr.Status) -> None:
        raise RuntimeError("angry server")

    chain.servers[1].do_status = angry
    with caplog.at_level(logging.ERROR):
        chain.send(WARNING)
        assert messages_of(chain.heard.wait()) == ["low light"]
        eventually(lambda: "angry server" in caplog.text)


# -- FATAL ---------------------------------------------------------------------------------------------------------


def test_a_fatal_resource_is_never_handed_out_again_while_its_holders_keep_it(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    served = serve(provider, "camera")
    heard = Calls()
    dead = app.load("provider/camera", "front", on_status=heard)
    provider.send_status(dead.resource_id, FATAL)
    heard.wait()
    other = system.open_registrar("other")
    fresh = other.load("provider/camera", "front")
    assert fresh.resource_id != dead.resource_id
    assert fresh.response == {"of": "front", "number": 2}
    assert app.load("provider/camera", "front").resource_id == fresh.resource_id
    assert {resource.id for resource in provider.resources()} == {dead.resource_id, fresh.resource_id}
    assert dead.id in {query.id for query in app.queries()}
    assert len(served.unloads) == 0
    dead.unload()
    assert served.unloads.items == [("front", {"of": "front", "number": 1})]
    assert [resource.id for resource in provider.resources()] == [fresh.resource_id]


@pytest.mark.parametrize("status", [WARNING, ERROR, rr.Status(rr.State.UPDATE, "moved")])
def test_a_resource_that_is_not_fatal_is_handed_out_further(
    app: rr.Registrar, provider: rr.Registrar, status: rr.Status
) -> None:
    served = serve(provider, "camera")
    heard = Calls()
    query = app.load("provider/camera", "front", on_status=heard)
    provider.send_status(query.resource_id, status)
    heard.wait()
    assert app.load("provider/camera", "front").resource_id == query.resource_id
    assert len(served.loads) == 1


def test_statuses_of_a_dead_resource_do_not_reach_the_holders_of_the_fresh_one(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "camera")
    heard_dead, heard_fresh = Calls(), Calls()
    dead = app.load("provider/camera", "front", on_status=heard_dead)
    provider.send_status(dead.resource_id, FATAL)
    heard_dead.wait()
    fresh = app.load("provider/camera", "front", on_status=heard_fresh)
    provider.send_status(dead.resource_id, rr.Status(rr.State.FATAL, "still"))
    provider.send_status(fresh.resource_id, LAST)
    assert messages_of(heard_fresh.wait()) == ["last"]
    assert messages_of(heard_dead.wait(2)) == ["unplugged", "still"]


# -- late response -------------------------------------------------------------------------------------------------


def test_update_response_replaces_the_stored_response_and_sends_update_to_the_holders(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    served = serve(provider, "camera")
    heard = Calls()
    query = app.load("provider/camera", "front", on_status=heard)
    provider.update_response(query.resource_id, {"of": "front", "number": 99})
    (status,) = heard.wait()
    assert (status.state, status.query_id) == (rr.State.UPDATE, query.id)
    eventually(lambda: app.queries()[0].response == {"of": "front", "number": 99})
    later = system.open_registrar("other").load("provider/camera", "front")
    assert later.response == {"of": "front", "number": 99}
    assert len(served.loads) == 1


def test_the_unload_callback_gets_the_updated_response(app: rr.Registrar, provider: rr.Registrar) -> None:
    served = serve(provider, "camera")
    query = app.load("provider/camera", "front")
    provider.update_response(query, "late")
    query.unload()
    assert served.unloads.items == [("front", "late")]


def test_an_updated_response_goes_up_as_update(system: rr.System, app: rr.Registrar) -> None:
    chain = Chain(system, app)
    chain.members[0].update_response(chain.bottom.id, "late")
    (status,) = chain.heard.wait()
    assert status.state is rr.State.UPDATE
    assert status.source == "r0/x"


# -- listening -----------------------------------------------------------------------------------------------------


def test_a_query_knows_the_last_state_it_heard(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    query = app.load("provider/camera", "front")
    assert query.state is rr.State.OK
    provider.send_status(query.resource_id, ERROR)
    eventually(lambda: query.state is rr.State.ERROR)
    provider.send_status(query.resource_id, LAST)
    eventually(lambda: query.state is rr.State.OK)


def test_wait_status_returns_the_status_it_waited_for(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    query = app.load("provider/camera", "front")
    sender = threading.Thread(
        target=lambda: [provider.send_status(query.resource_id, status) for status in (WARNING, ERROR)]
    )
    sender.start()
    status = query.wait_status(rr.State.ERROR, timeout_s=5.0)
    assert (status.state, status.message) == (rr.State.ERROR, "no picture")
    sender.join(5)


@pytest.mark.parametrize("way", ["unload", "force", "unregister", "close"])
def test_wait_status_ends_with_the_query(app: rr.Registrar, provider: rr.Registrar, way: str) -> None:
    serve(provider, "camera")
    query = app.load("provider/camera", "front")
    ends: dict[str, Callable[[], object]] = {
        "unload": query.unload,
        "force": lambda: provider.unload(query.resource_id, force=True),
        "unregister": lambda: provider.unregister_server("camera"),
        "close": app.close,
    }
    ending = threading.Thread(target=ends[way])
    ending.start()
    for _ in range(2):  # the second time nobody has to be woken
        with pytest.raises(rr.UnknownQuery, match="no status of query"):
            query.wait_status(rr.State.WARNING, timeout_s=10.0)
    ending.join()


def test_wait_status_says_what_it_misses_and_never_misses_a_fatal(
    app: rr.Registrar, provider: rr.Registrar, caplog: pytest.LogCaptureFixture
) -> None:
    serve(provider, "camera")
    heard = Calls()
    query = app.load("provider/camera", "front", on_status=heard)
    provider.send_status(query.resource_id, rr.Status(rr.State.FATAL))
    for number in range(300):
        provider.update_response(query.resource_id, str(number))
    heard.wait(301)
    with caplog.at_level(logging.WARNING):
        assert query.wait_status(timeout_s=LIMIT_S).state is rr.State.FATAL
        assert query.wait_status(timeout_s=LIMIT_S).state is rr.State.UPDATE
    said = f"provider/camera: wait_status() misses 45 statuses of query {query.id}: the newest 256 are kept"
    eventually(lambda: [text for text in caplog.messages if "misses" in text] == [said])


def test_wait_status_gives_up_after_its_time_limit(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")
    query = app.load("provider/camera", "front")
    with pytest.raises(TimeoutError):
        query.wait_status(rr.State.FATAL, timeout_s=0.05)


def test_on_status_hears_for_every_query_at_that_server_besides_their_own_callbacks(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "camera")
    serve(provider, "lidar")
    overall, own = Calls(), Calls()
    first = app.load("provider/camera", "front")
    app.on_status("provider/camera", overall)
    second = app.load("provider/camera", "rear", on_status=own)
    lidar_heard = Calls()
    lidar = app.load("provider/lidar", "front", on_status=lidar_heard)
    for query in (lidar, first, second):
        provider.send_status(query.resource_id, WARNING)
    assert {status.query_id for status in overall.wait(2)} == {first.id, second.id}
    assert [status.query_id for status in own.wait()] == [second.id]
    assert messages_of(lidar_heard.wait()) == ["low light"]
    assert len(overall) == 2


def test_a_slow_status_callback_delays_no_other_holder(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "camera")
    heard = Calls()
    query = app.load("provider/camera", "front", on_status=gate)
    system.open_registrar("other").load("provider/camera", "front", on_status=heard)
    provider.send_status(query.resource_id, WARNING)
    gate.wait_arrived()
    assert messages_of(heard.wait()) == ["low light"]
    assert app.load("provider/camera", "rear").response["of"] == "rear"


def test_a_status_callback_that_raises_is_counted(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    def refuse(*_: Any) -> None:
        raise ValueError("cannot hear this")

    serve(parts, "part")
    serve(provider, "whole", load=loaded_with_parts(provider, ("parts/part", 1)), status=refuse)
    whole = app.load("provider/whole", 1, on_status=refuse)
    (part,) = provider.children(whole)
    parts.send_status(part.resource_id, rr.Status(rr.State.WARNING, "dark"))
    eventually(lambda: provider.stats()["callback_failures"] == 1 and app.stats()["callback_failures"] == 1)
    assert app.stats()["queries"] == provider.stats()["resources"] == 1


def test_a_status_travels_with_all_that_it_says() -> None:
    said = {"resource_id": "r", "query_id": "q", "source": "a/b", "repeated": True}
    status = pickle.loads(pickle.dumps(rr.Status(rr.State.WARNING, "hot", **said)))
    assert status == rr.Status(rr.State.WARNING, "hot", **said)
    assert {name: getattr(status, name) for name in said} == said


# -- the server's own status callback ------------------------------------------------------------------------------


def test_the_status_callback_runs_for_its_own_resource_before_the_holders_hear(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    order = Calls()

    def first(request: Any, status: rr.Status) -> None:
        own = status.resource_id == rr.current().resource_id
        order(("server", request, status.message, own, status.query_id, status.source))

    serve(provider, "camera", status=first)
    query = app.load("provider/camera", "front", on_status=lambda status: order(("holder", status.message)))
    provider.send_status(query.resource_id, WARNING)
    assert order.wait(2) == [("server", "front", "low light", True, "", "provider/camera"), ("holder", "low light")]


def test_the_status_callback_may_deal_with_what_is_said_of_its_own_resource(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    def deal(request: Any, status: rr.Status) -> None:
        if status.state is rr.State.ERROR:
            status.handled()

    served = serve(provider, "camera", status=deal)
    heard = Calls()
    query = app.load("provider/camera", "front", on_status=heard)
    provider.send_status(query.resource_id, ERROR)
    provider.send_status(query.resource_id, LAST)
    assert messages_of(heard.wait()) == ["last"]
    assert [status.message for _, status in served.statuses] == ["no picture", "last"]


def test_what_a_status_callback_sends_for_its_own_resource_does_not_come_back_to_it(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    def repair(request: Any, status: rr.Status) -> None:
        if status.state is rr.State.ERROR:
            provider.send_status(status.resource_id, rr.Status(rr.State.OK, "repaired"))
            provider.update_response(status.resource_id, "new")
            status.handled()

    served = serve(provider, "camera", status=repair)
    heard = Calls()
    query = app.load("provider/camera", "front", on_status=heard)
    provider.send_status(query.resource_id, ERROR)
    assert messages_of(heard.wait(2)) == ["repaired", "late response"]
    assert query.response == "new"
    provider.send_status(query.resource_id, LAST)
    assert messages_of(heard.wait(3)) == ["repaired", "late response", "last"]
    assert [status.message for _, status in served.statuses] == ["no picture", "last"]


def test_a_late_response_goes_by_the_status_callback_and_reaches_the_holders_in_any_case(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    served = serve(provider, "camera", status=lambda request, status: status.handled())
    heard = Calls()
    query = app.load("provider/camera", "front", on_status=heard)
    provider.update_response(query.resource_id, "late")
    assert states_of(heard.wait()) == [rr.State.UPDATE]
    assert query.response == "late"
    assert [status.state for _, status in served.statuses] == [rr.State.UPDATE]


def states_of(statuses: list[rr.Status]) -> list[rr.State]:
    return [status.state for status in statuses]


def test_a_fatal_resource_is_not_handed_out_while_its_status_callback_still_runs(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "camera", status=lambda request, status: gate())
    dead = app.load("provider/camera", "front")
    provider.send_status(dead.resource_id, FATAL)
    gate.wait_arrived()
    assert app.load("provider/camera", "front").resource_id != dead.resource_id
    gate.open()
    dead.wait_status(rr.State.FATAL, timeout_s=LIMIT_S)


def test_a_status_callback_of_its_own_resource_that_raises_lets_the_status_go_on(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    def angry(request: Any, status: rr.Status) -> None:
        raise RuntimeError("angry server")

    serve(provider, "camera", status=angry)
    query = app.load("provider/camera", "front")
    provider.send_status(query.resource_id, WARNING)
    assert query.wait_status(timeout_s=LIMIT_S).message == "low light"
    eventually(lambda: provider.stats()["callback_failures"] == 1)


# -- while the whole is loading ------------------------------------------------------------------------------------


def test_a_part_that_fails_while_the_whole_loads_is_replaced_when_the_load_has_returned(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, gate: Gate
) -> None:
    """The natural code: the status callback loads another part, and the response of the whole is replaced."""

    def load(request: Any) -> Any:
        response = provider.load("parts/lidar", "first").response["of"]
        gate()
        return response

    def replace(request: Any, status: rr.Status) -> None:
        own = rr.current().resource_id
        if status.resource_id != own and status.state is rr.State.FATAL:
            provider.update_response(own, provider.load("parts/lidar", "second").response["of"])
            status.handled()

    serve(parts, "lidar")
    served = serve(provider, "robot", load=load, status=replace)
    future = app.load("provider/robot", None, block=False)
    gate.wait_arrived()
    (lidar,) = parts.resources()
    parts.send_status(lidar.id, FATAL)
    eventually(lambda: [query.state for query in provider.queries()] == [rr.State.FATAL])
    assert len(served.statuses) == 0
    gate.open()
    query = future.get(timeout=LIMIT_S)
    assert query.wait_status(timeout_s=LIMIT_S).state is rr.State.UPDATE
    assert query.response == "second"
    assert [status.message for _, status in served.statuses] == ["unplugged"]
    assert provider.resources()[0].response == "second"


def test_a_load_callback_may_wait_for_a_status_of_its_own_part(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    ready = threading.Event()

    def load(request: Any) -> Any:
        part = provider.load("parts/lidar", "first", on_status=lambda status: ready.set())
        parts.send_status(part.resource_id, rr.Status(rr.State.OK, "warm"))
        assert ready.wait(LIMIT_S)
        return part.wait_status(timeout_s=LIMIT_S).message

    serve(parts, "lidar")
    served = serve(provider, "robot", load=load)
    assert app.load("provider/robot", None).response == "warm"
    assert [status.message for _, status in served.statuses.wait()] == ["warm"]


def test_what_was_said_of_a_resource_while_it_loads_its_server_hears_when_it_is_loaded(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    def load(request: Any) -> Any:
        provider.send_status(rr.current().resource_id, WARNING)
        return "feed"

    phases = Calls()
    serve(provider, "camera", load=load, status=lambda *_: phases(provider.resources()[0].phase))
    query = app.load("provider/camera", "front")
    assert query.wait_status(timeout_s=LIMIT_S).message == "low light"
    assert phases.items == ["loaded"]
