"""What a registrar promises about priorities and standby (docs/semantics.md, "Priority")."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from support import Gate, Workshop, eventually, kill, loaded_with_parts, serve, wait_respawned
from support_managers import Made, Order, Shop

Start = Callable[..., rr.System]

DEEP = 50


def priorities(registrar: rr.Registrar) -> dict[Any, int | None]:
    """The priority of each resource that a registrar serves, by its request."""
    return {info.request: info.priority for info in registrar.resources()}


def names(registrar: rr.Registrar) -> dict[str, int | None]:
    """The same, of a Shop."""
    return {info.request.name: info.priority for info in registrar.resources()}


@pytest.fixture
def whole(provider: rr.Registrar, parts: rr.Registrar) -> str:
    """A server whose resources need a part of another registrar."""
    serve(parts, "part")
    serve(provider, "whole", load=loaded_with_parts(provider, ("parts/part", "bolt")))
    return "provider/whole"


# -- the highest of the holders --------------------------------------------------------------------------------------


def test_a_resource_has_the_highest_priority_of_its_holders(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing")
    first = app.load("provider/thing", "x")
    assert (first.priority, priorities(provider)) == (0, {"x": 0})
    second = app.load("provider/thing", "x", priority=7)
    assert eventually(lambda: priorities(provider) == {"x": 7})
    first.priority = -3
    second.priority = 2
    assert (first.priority, second.priority) == (-3, 2)
    assert eventually(lambda: priorities(provider) == {"x": 2})
    second.unload()
    assert eventually(lambda: priorities(provider) == {"x": -3})


def test_a_resource_that_all_have_on_standby_has_no_priority(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing")
    first = app.load("provider/thing", "x", priority=None)
    assert (first.priority, priorities(provider)) == (None, {"x": None})
    second = app.load("provider/thing", "x", priority=-1000)
    assert eventually(lambda: priorities(provider) == {"x": -1000})
    second.standby()
    assert second.priority is None
    assert eventually(lambda: priorities(provider) == {"x": None})
    first.priority = 0
    assert eventually(lambda: priorities(provider) == {"x": 0})


@pytest.mark.parametrize("how", ["a thread", "a future", "a group"])
def test_each_way_to_load_takes_a_priority(app: rr.Registrar, provider: rr.Registrar, how: str) -> None:
    serve(provider, "thing")
    match how:
        case "a thread":
            query = app.load("provider/thing", "x", priority=4)
        case "a future":
            query = app.load("provider/thing", "x", priority=4, block=False).get(timeout=30)
        case _:
            (query,) = app.load_all([("provider/thing", "x")], priority=4)
    assert query.priority == 4
    assert priorities(provider) == {"x": 4}


def test_an_awaited_load_takes_a_priority(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing")

    async def main() -> None:
        async with await app.load_async("provider/thing", "x", priority=None):
            assert priorities(provider) == {"x": None}

    asyncio.run(main())


# -- parts -----------------------------------------------------------------------------------------------------------


def test_a_part_inherits_the_priority_of_its_whole(app: rr.Registrar, parts: rr.Registrar, whole: str) -> None:
    first = app.load(whole, "a", priority=5)
    assert priorities(parts) == {"bolt": 5}
    second = app.load(whole, "b", priority=9)  # the bolt is a part of both
    assert eventually(lambda: priorities(parts) == {"bolt": 9})
    second.priority = 1
    assert eventually(lambda: priorities(parts) == {"bolt": 5})
    first.standby()
    assert eventually(lambda: priorities(parts) == {"bolt": 1})
    second.unload()
    assert eventually(lambda: priorities(parts) == {"bolt": None})


def test_a_whole_that_changes_while_it_loads_gives_its_parts_the_newest(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, gate: Gate
) -> None:
    serve(parts, "part", load=lambda request: gate(request))
    serve(provider, "whole", load=loaded_with_parts(provider, ("parts/part", "bolt")))
    first = app.load("provider/whole", "a", priority=1, block=False)
    gate.wait_arrived()
    second = app.load("provider/whole", "a", priority=6, block=False)
    assert eventually(lambda: priorities(provider) == {"a": 6})
    gate.open()
    assert {first.get(timeout=30).priority, second.get(timeout=30).priority} == {1, 6}
    assert eventually(lambda: priorities(parts) == {"bolt": 6})


def test_a_part_that_is_given_a_priority_keeps_it(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(parts, "part")

    def load(request: str) -> None:
        provider.load("parts/part", "own", priority=0)
        provider.load("parts/part", "inherited")

    serve(provider, "whole", load=load)
    query = app.load("provider/whole", "a", priority=5)
    assert priorities(parts) == {"own": 0, "inherited": 5}
    query.priority = 8
    assert eventually(lambda: priorities(parts) == {"own": 0, "inherited": 8})
    inherited = next(part for part in provider.children(query.resource_id) if part.request == "inherited")
    inherited.priority = 2
    query.priority = 9
    assert eventually(lambda: priorities(provider) == {"a": 9})
    assert priorities(parts) == {"own": 0, "inherited": 2}


def test_the_parts_of_what_lingers_are_on_standby(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(parts, "part")
    serve(provider, "whole", load=loaded_with_parts(provider, ("parts/part", "bolt")), linger_s=60.0)
    app.load("provider/whole", "a", priority=3).unload()
    assert priorities(provider) == {"a": None}
    assert eventually(lambda: priorities(parts) == {"bolt": None})
    app.load("provider/whole", "a")
    assert eventually(lambda: (priorities(provider), priorities(parts)) == ({"a": 0}, {"bolt": 0}))


def test_a_spare_has_the_priority_of_the_part_that_it_replaces(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(parts, "part")

    def status(request: str, said: rr.Status) -> None:
        if said.query_id:
            provider.replace_part(said, "spare")

    serve(provider, "whole", load=lambda _: provider.load("parts/part", "bolt", priority=4).id, status=status)
    app.load("provider/whole", "a")
    bolt = next(info for info in parts.resources() if info.request == "bolt")
    parts.send_status(bolt, rr.Status(rr.State.FATAL, "broken"))
    assert eventually(lambda: priorities(parts) == {"spare": 4})


# -- across processes, crashes and lost links --------------------------------------------------------------------------


def shops(workshop: Workshop, *ids: str) -> list[rr.ChildSpec]:
    return [rr.ChildSpec(Shop, id=id, args=(str(workshop.root),)) for id in ids]


CHAIN = Order("top", ("middle/thing:m",))


@pytest.fixture
def chain(start: Start, workshop: Workshop) -> rr.System:
    """Three shops in processes of their own. What the first makes needs a part of the second, and so on."""

    class Middle(Shop):
        @rr.server("thing")
        def load_thing(self, request: Order) -> Made:
            self.registrar.load("bottom/thing", Order("b"))
            return Made(request.name, self.registrar.name, 0)

    specs = shops(workshop, "top", "bottom")
    return start(*specs, rr.ChildSpec(Middle, id="middle", args=(str(workshop.root),)))


def test_a_change_goes_down_through_the_processes_of_a_graph(chain: rr.System) -> None:
    query = chain.open_registrar("app").load("top/thing", CHAIN, priority=3)
    assert names(chain.registrar("bottom")) == {"b": 3}
    query.priority = 12
    assert eventually(lambda: names(chain.registrar("bottom")) == {"b": 12})
    query.standby()
    assert eventually(lambda: names(chain.registrar("bottom")) == {"b": None})


def test_a_handle_gives_and_fetches_priorities(chain: rr.System) -> None:
    app = chain.open_registrar("app")
    app.load("top/thing", CHAIN, priority=3)
    (part,) = chain.registrar("top").queries()
    assert part.priority == 3
    part.priority = 11
    assert part.priority == 11
    assert eventually(lambda: names(chain.registrar("bottom")) == {"b": 11})


@pytest.mark.parametrize("killed", ["top", "middle", "bottom"])
def test_a_change_while_a_process_of_the_graph_is_killed_arrives_all_the_same(chain: rr.System, killed: str) -> None:
    query = chain.open_registrar("app").load("top/thing", CHAIN, priority=3)
    for priority in (8, None, 0):
        pid = kill(chain, killed)
        query.priority = priority
        wait_respawned(chain, killed, pid)
        assert eventually(lambda: names(chain.registrar("bottom")) == {"b": priority}), priority  # noqa: B023
    assert query.priority == 0


def test_a_change_for_a_provider_that_is_stopped_reaches_it_when_it_is_started_again(
    start: Start, workshop: Workshop
) -> None:
    system = start(*shops(workshop, "shop"))
    query = system.open_registrar("app").load("shop/thing", Order("x"))
    system.supervisor().terminate_child("shop")
    query.priority = 6
    assert query.priority == 6
    system.supervisor().restart_child("shop")
    assert eventually(lambda: names(system.registrar("shop")) == {"x": 6})


def test_a_priority_outlives_the_crash_of_its_holder(start: Start, workshop: Workshop) -> None:
    class Holder(rr.Manager):
        def on_start(self) -> None:
            if not self.registrar.queries():
                self.registrar.load("shop/thing", Order("x"), priority=5).priority = 7

    system = start(*shops(workshop, "shop"), rr.ChildSpec(Holder, id="holder"))
    assert eventually(lambda: names(system.registrar("shop")) == {"x": 7})
    wait_respawned(system, "holder", kill(system, "holder"))
    (query,) = system.registrar("holder").queries()
    assert query.priority == 7
    query.standby()
    assert eventually(lambda: names(system.registrar("shop")) == {"x": None})


# -- seen --------------------------------------------------------------------------------------------------------------


def test_a_change_of_a_resources_priority_is_an_event(system: rr.System, app: rr.Registrar, whole: str) -> None:
    heard: list[tuple[str, str]] = []

    def hear(event: Any) -> None:
        if event["event"] == "priority":
            heard.append((event["server"], event["detail"]))

    query = app.load(whole, "a", priority=1)
    system.subscribe(hear)
    query.priority = 4
    assert eventually(lambda: heard == [("provider/whole", "priority 4"), ("parts/part", "priority 4")])
    query.standby()
    assert eventually(lambda: heard[2:] == [("provider/whole", "standby"), ("parts/part", "standby")])


# -- bad input ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrong", [True, 1.0, "5", float("nan"), [], -1001, 1001, 10**30, pytest.param(object(), id="an object")], ids=repr
)
def test_a_priority_that_is_none_is_refused_at_once_and_nothing_changes(
    app: rr.Registrar, provider: rr.Registrar, wrong: Any
) -> None:
    serve(provider, "thing")
    expected = r"priority: expected a whole number from -1000 to 1000, or None for standby, got "
    with pytest.raises(rr.UsageError, match=expected):
        app.load("provider/thing", "x", priority=wrong)
    with pytest.raises(rr.UsageError, match=expected):
        app.load_all([("provider/thing", "x")], priority=wrong)
    assert (provider.resources(), app.stats()["loading"]) == ([], 0)
    query = app.load("provider/thing", "x", priority=5)
    with pytest.raises(rr.UsageError, match=expected):
        query.priority = wrong
    assert (query.priority, priorities(provider)) == (5, {"x": 5})


def test_the_priority_of_a_query_that_is_not_held_is_an_error(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing")
    query = app.load("provider/thing", "x")
    query.unload()
    with pytest.raises(rr.UnknownQuery, match=query.id):
        query.priority = 5
    with pytest.raises(rr.UnknownQuery, match=query.id):
        query.standby()
    with pytest.raises(rr.UnknownQuery, match=query.id):
        _ = query.priority


def test_a_registrar_gives_no_higher_priority_than_its_limit(start: Start) -> None:
    system = start(config=rr.SystemConfig(registrars={"guest": rr.RegistrarConfig(max_priority=2)}))
    guest, shop, bolts = map(system.open_registrar, ("guest", "shop", "bolts"))
    serve(bolts, "bolt")
    serve(shop, "thing")
    expected = r"priority: expected 2 at most, as the max_priority of registrar 'guest' says, got 3"
    with pytest.raises(rr.UsageError, match=expected):
        guest.load("shop/thing", "x", priority=3)
    with pytest.raises(rr.UsageError, match=expected):
        guest.load_all([("shop/thing", "x")], priority=3)
    assert (shop.resources(), guest.stats()["loading"]) == ([], 0)
    query = guest.load("shop/thing", "x", priority=2)
    with pytest.raises(rr.UsageError, match=expected):
        query.priority = 3
    assert priorities(shop) == {"x": 2}
    serve(guest, "whole", load=loaded_with_parts(guest, ("bolts/bolt", "b")))
    system.open_registrar("app").load("guest/whole", "w", priority=900)
    assert (priorities(guest), priorities(bolts)) == ({"w": 900}, {"b": 2})


@pytest.mark.parametrize("wrong", [-1, 1001, True, 5.0, "5"], ids=repr)
def test_a_limit_that_is_none_is_refused(wrong: Any, tmp_path: Path) -> None:
    with pytest.raises(rr.ConfigError, match="max_priority: expected a whole number from 0 to 1000, got"):
        rr.RegistrarConfig(max_priority=wrong)
    file = tmp_path / "system.toml"
    file.write_text("[registrars.guest]\nmax_priority = -1\n")
    with pytest.raises(rr.ConfigError, match=r"registrars\.guest\.max_priority"):
        rr.SystemConfig.from_toml(file)


# -- how long ----------------------------------------------------------------------------------------------------------


def test_a_change_passes_a_graph_that_is_fifty_deep(app: rr.Registrar, provider: rr.Registrar) -> None:
    def load(request: int) -> int:
        if request:
            provider.load("provider/link", request - 1)
        return request

    serve(provider, "link", load=load)
    query = app.load("provider/link", DEEP, timeout_s=60.0)
    began = time.monotonic()
    query.priority = 7
    assert eventually(lambda: set(priorities(provider).values()) == {7})
    assert time.monotonic() - began < 10.0
    assert len(priorities(provider)) == DEEP + 1
