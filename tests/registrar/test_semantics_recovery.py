"""What a registrar promises about crashes and recovery (docs/semantics.md, "Crash and recovery").

Real processes, really killed.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.registrar.model import digests
from rr_actors.registrar.model.rows import Held, Peer
from rr_actors.storage.opening import read_rows
from rr_actors.wire.name_service import Directory, Presence, registrar_key
from rr_actors.wire.unix_transport import UnixTransport
from support import (
    LIMIT_S,
    TEST_PATHS,
    Calls,
    Workshop,
    child,
    eventually,
    kill,
    messages,
    pid_of,
    serve,
    wait_respawned,
)
from support_managers import Made, Order, Shop

Start = Callable[..., rr.System]
WARNING = rr.Status(rr.State.WARNING, "low light")


class Customer(rr.Manager):
    """Wants some things from "shop/thing"; notes "hears STATE MESSAGE" for each status of them."""

    def __init__(self, root: str, *wants: str) -> None:
        self.work = Workshop(root)
        self.wants = wants

    def on_start(self) -> None:
        self.registrar.on_status("shop/thing", self.hear)
        held = {query.request.name for query in self.registrar.queries()}
        for name in self.wants:
            if name not in held:
                self.registrar.load("shop/thing", Order(name))
        self.work.step(f"start {self.registrar.name}", *sorted(held))
        self.work.note(f"started {self.registrar.name}")

    def hear(self, status: rr.Status) -> None:
        self.work.note(f"hears {status.state} {status.message}")


class Depot(rr.Manager):
    """Registers its server in on_start; what happens to its resources after a crash is up to the test."""

    def __init__(self, root: str, recovery: str = "keep", recover: bool = False, linger_s: float = 0.0) -> None:
        self.work = Workshop(root)
        self.options: dict[str, Any] = {"recovery": recovery, "linger_s": linger_s}
        if recover:
            self.options["recover"] = self.recover

    def on_start(self) -> None:
        self.work.step(f"start {self.registrar.name}")
        if self.work.lines("please hurry"):
            self.options["linger_s"] = 0.05
        self.registrar.register_server(
            "thing", self.load, self.unload, request_type=Order, response_type=Made, **self.options
        )

    def load(self, request: Order) -> Made:
        self.work.step(f"load {request.name}")
        return Made(request.name, "depot", os.getpid())

    def unload(self, request: Order, response: Made) -> None:
        self.work.step(f"unload {request.name}")

    def recover(self, request: Order, response: Made) -> Made:
        self.work.step(f"recover {request.name}", response.pid)
        if self.work.lines(f"please change {request.name}"):
            return Made("changed", response.shop, response.pid)
        return response


class Fickle(rr.Manager):
    """Takes another part at each attempt."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    @rr.server("bike")
    def load_bike(self, request: str) -> str:
        attempt = rr.current().attempt
        self.registrar.load("parts/thing", Order(f"part{attempt}"))
        self.work.step(f"made {request}", f"attempt={attempt}")
        return request


def shop(workshop: Workshop, id: str = "shop", **options: Any) -> rr.ChildSpec:
    return rr.ChildSpec(Shop, id=id, args=(str(workshop.root),), **options)


def customer(workshop: Workshop, *wants: str, **options: Any) -> rr.ChildSpec:
    return rr.ChildSpec(Customer, id="customer", args=(str(workshop.root), *wants), **options)


def holders(system: rr.System, registrar: str = "shop") -> dict[str, list[str]]:
    return {r.request.name: sorted(r.holders) for r in system.registrar(registrar).resources()}


# -- the provider is killed ----------------------------------------------------------------------------------------


def test_an_acknowledged_load_survives_the_death_of_its_provider(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop))
    app = system.open_registrar("app")
    query = app.load("shop/thing", Order("wheel"))
    new_pid = wait_respawned(system, "shop", kill(system, "shop"))
    (resource,) = system.registrar("shop").resources()
    assert (resource.id, resource.request, resource.response) == (query.resource_id, Order("wheel"), query.response)
    assert list(resource.holders) == ["app"]
    again = app.load("shop/thing", Order("wheel"))
    assert (again.resource_id, again.response) == (query.resource_id, query.response)
    assert again.response.pid != new_pid
    query.unload()
    again.unload()
    assert workshop.lines("load wheel") == ["load wheel attempt=1"]
    assert workshop.lines("unload wheel") == ["unload wheel"]


def test_a_respawned_provider_serves_again_and_keeps_its_place_in_the_tree(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop))
    app = system.open_registrar("app")
    for n in range(3):
        old = kill(system, "shop")
        assert app.load("shop/thing", Order(f"wheel{n}")).response.pid != old
    assert [entry.id for entry in system.supervisor().which_children()] == ["shop"]
    assert len(system.registrar("shop").resources()) == 3


def test_a_load_interrupted_by_the_crash_is_run_again_and_is_one_query(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop))
    app = system.open_registrar("app")
    workshop.shut("load wheel")
    future = app.load("shop/thing", Order("wheel"), block=False)
    workshop.wait("load wheel")
    old = kill(system, "shop")
    workshop.wait("load wheel", 2)
    workshop.open("load wheel")
    query = future.get(timeout=LIMIT_S)
    assert query.response.pid != old
    assert workshop.lines("load wheel") == ["load wheel attempt=1", "load wheel attempt=2"]
    assert [known.id for known in app.queries()] == [query.id]
    assert [known.id for known in app.fetch_queries("shop")] == [query.id]
    assert holders(system) == {"wheel": ["app"]}


def test_a_revocation_goes_on_when_the_provider_has_been_killed(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop, "parts"), shop(workshop))
    app = system.open_registrar("app")
    heard, goes_on = threading.Event(), threading.Event()

    def on_status(status: rr.Status) -> None:
        heard.set()
        goes_on.wait(LIMIT_S)

    app.load("shop/thing", Order("bike", ("parts/thing:wheel",)), on_status=on_status)
    (wheel,) = system.registrar("parts").resources()
    with ThreadPoolExecutor(1) as thread:
        revoked = thread.submit(system.registrar("parts").revoke, wheel.id, "worn", grace_s=600)
        assert heard.wait(LIMIT_S), revoked.exception()
        wait_respawned(system, "parts", kill(system, "parts"))
        assert isinstance(revoked.exception(LIMIT_S), rr.RrError)
    assert holders(system, "parts") == {"wheel": ["shop"]}
    goes_on.set()
    assert eventually(lambda: not system.registrar("parts").resources())
    assert not holders(system)
    assert eventually(lambda: not app.queries())
    assert workshop.lines("unload") == ["unload bike", "unload wheel"]


def test_an_interrupted_load_holds_each_part_once(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop, "parts"), shop(workshop))
    app = system.open_registrar("app")
    workshop.shut("made bike")
    future = app.load("shop/thing", Order("bike", ("parts/thing:wheel",)), block=False)
    workshop.wait("made bike")
    kill(system, "shop")
    workshop.wait("made bike", 2)
    workshop.open("made bike")
    bike = future.get(timeout=LIMIT_S)
    eventually(lambda: holders(system, "parts") == {"wheel": ["shop"]})
    assert [part.request.name for part in system.registrar("shop").children(bike)] == ["wheel"]
    bike.unload()
    eventually(lambda: not system.registrar("parts").resources() and not system.registrar("shop").queries())
    assert len(workshop.lines("unload wheel")) == len(workshop.lines("made wheel"))


def test_what_only_the_interrupted_run_had_loaded_is_released(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop, "parts"), rr.ChildSpec(Fickle, id="fickle", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    workshop.shut("made bike")
    future = app.load("fickle/bike", "bike", block=False)
    workshop.wait("made bike attempt=1")
    kill(system, "fickle")
    workshop.wait("made bike attempt=2")
    workshop.open("made bike")
    bike = future.get(timeout=LIMIT_S)
    workshop.wait("unload part1")
    eventually(lambda: holders(system, "parts") == {"part2": ["fickle"]})
    assert [part.request.name for part in system.registrar("fickle").children(bike)] == ["part2"]


def test_an_interrupted_unload_is_run_again(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop, "parts"), shop(workshop))
    app = system.open_registrar("app")
    query = app.load("shop/thing", Order("bike", ("parts/thing:wheel",)))
    workshop.shut("unload bike")
    future = app.unload(query, block=False)
    workshop.wait("unload bike")
    kill(system, "shop")
    workshop.wait("unload bike", 2)
    assert workshop.lines("unload wheel") == []
    workshop.open("unload bike")
    future.get(timeout=LIMIT_S)
    workshop.wait("unload wheel")
    eventually(lambda: holders(system) == {} and holders(system, "parts") == {})
    assert list(app.queries()) == []


class Counting(rr.Manager):
    """Notes which attempt each callback is."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    @rr.server("thing")
    def load_thing(self, request: str) -> str:
        return request

    @load_thing.unload
    def unload_thing(self, request: str, response: str) -> None:
        self.work.step(f"unload {request}", f"attempt={rr.current().attempt}")


def test_an_unload_that_is_run_again_is_told_so(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Counting, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    query = app.load("shop/thing", "wheel")
    workshop.shut("unload wheel")
    future = app.unload(query, block=False)
    workshop.wait("unload wheel")
    kill(system, "shop")
    workshop.wait("unload wheel", 2)
    workshop.open("unload wheel")
    future.get(timeout=LIMIT_S)
    assert workshop.lines("unload wheel") == ["unload wheel attempt=1", "unload wheel attempt=2"]


class Cleaning(rr.Manager):
    """Notes what its unload callback is given."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    @rr.server("thing")
    def load_thing(self, request: str) -> str:
        self.work.step(f"load {request}", f"attempt={rr.current().attempt}")
        return request

    @load_thing.unload
    def unload_thing(self, request: str, response: str | None) -> None:
        current = rr.current()
        self.work.note(f"unload {request}", f"{response} interrupted={current.interrupted} attempt={current.attempt}")


def given_up(app: rr.Registrar, workshop: Workshop) -> None:
    """Withdraw a load of "wheel" whose callback has begun."""
    workshop.shut("load wheel")
    with pytest.raises(rr.LoadTimeout):
        app.load("shop/thing", "wheel", timeout_s=1.0)
    workshop.wait("load wheel")


def test_a_load_withdrawn_before_a_crash_is_cleaned_up_by_its_server_and_not_run_again(
    start: Start, workshop: Workshop
) -> None:
    system = start(rr.ChildSpec(Cleaning, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    given_up(app, workshop)
    eventually(lambda: [resource.holders for resource in system.registrar("shop").resources()] == [()])
    kill(system, "shop")
    workshop.wait("unload wheel")
    pid_of(system, "shop")  # up again, and can be asked
    eventually(lambda: system.registrar("shop").resources() == [])
    workshop.open("load wheel")
    assert app.load("shop/thing", "wheel").response == "wheel"
    assert workshop.lines() == [
        "load wheel attempt=1",
        "unload wheel None interrupted=True attempt=1",
        "load wheel attempt=1",
    ]


def test_a_load_withdrawn_while_its_process_lives_is_finished_and_then_unloaded(
    start: Start, workshop: Workshop
) -> None:
    system = start(rr.ChildSpec(Cleaning, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    given_up(app, workshop)
    workshop.open("load wheel")
    workshop.wait("unload wheel")
    assert workshop.lines() == ["load wheel attempt=1", "unload wheel wheel interrupted=False attempt=1"]


def test_a_load_given_up_while_its_provider_was_down_leaves_nothing(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop))
    app = system.open_registrar("app")
    workshop.shut("start shop")
    kill(system, "shop")
    with pytest.raises(rr.LoadTimeout):
        app.load("shop/thing", Order("wheel"), timeout_s=0.1)
    workshop.open("start shop")
    app.load("shop/thing", Order("fence"))
    eventually(lambda: holders(system) == {"fence": ["app"]})
    assert len(workshop.lines("made wheel")) == len(workshop.lines("unload wheel"))


def test_what_is_held_is_gone_through_when_the_provider_has_a_process_again(
    start: Start, state_dir: Path, workshop: Workshop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its supervisor may live on the loop that does that: the process would be made later."""
    system = start(shop(workshop))
    app = system.open_registrar("app")
    app.load("shop/thing", Order("wheel"))
    (run_dir,) = (state_dir / "run").iterdir()
    begun = Calls()

    def cut(rows: list[Held]) -> Iterator[tuple[int, bytes]]:
        begun(Directory(run_dir).lookup(registrar_key("shop")))
        return spans_of(rows)

    spans_of = digests.cut
    monkeypatch.setattr(digests, "cut", cut)
    workshop.shut("start shop")
    kill(system, "shop")
    (entry,) = begun.wait()
    workshop.open("start shop")
    app.load("shop/thing", Order("wheel"))
    assert entry.status is Presence.STARTING
    assert entry.address.startswith(f"{pid_of(system, 'shop')}-")


# -- the consumer is killed ----------------------------------------------------------------------------------------


def test_a_respawned_consumer_finds_its_queries_in_on_start(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop), customer(workshop, "wheel", "seat"))
    before = {query.id for query in system.registrar("customer").queries()}
    wait_respawned(system, "customer", kill(system, "customer"))
    assert workshop.lines("start customer") == ["start customer", "start customer seat wheel"]
    assert {query.id for query in system.registrar("customer").queries()} == before
    assert holders(system) == {"wheel": ["customer"], "seat": ["customer"]}
    assert len(workshop.lines("load wheel")) == 1


def test_a_status_for_a_respawned_holder_waits_until_its_on_start_has_returned(
    start: Start, workshop: Workshop
) -> None:
    system = start(shop(workshop), customer(workshop, "wheel"))
    workshop.shut("start customer")
    kill(system, "customer")
    workshop.wait("start customer", 2)
    (wheel,) = system.registrar("shop").resources()
    system.registrar("shop").send_status(wheel.id, WARNING)
    assert workshop.lines("hears") == []
    workshop.open("start customer")
    workshop.wait("hears WARNING low light")
    lines = workshop.lines()
    assert lines.index("hears WARNING low light") > max(n for n, x in enumerate(lines) if x == "started customer")
    assert len(workshop.lines("hears")) == 1


def test_no_acknowledged_status_is_lost_when_both_sides_die(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop), customer(workshop, "wheel"))
    (wheel,) = system.registrar("shop").resources()
    workshop.shut("start customer")
    kill(system, "customer")
    workshop.wait("start customer", 2)
    system.registrar("shop").send_status(wheel.id, WARNING)
    wait_respawned(system, "shop", kill(system, "shop"))
    workshop.open("start customer")
    workshop.wait("hears WARNING low light")
    system.registrar("shop").send_status(wheel.id, rr.Status(rr.State.OK, "last"))
    workshop.wait("hears OK last")
    assert workshop.lines("hears") == ["hears WARNING low light", "hears OK last"]


def test_the_status_callback_of_the_own_resource_runs_again_after_a_crash_and_then_the_holders_hear_once(
    start: Start, workshop: Workshop
) -> None:
    system = start(shop(workshop))
    app = system.open_registrar("app")
    heard = Calls()
    query = app.load("shop/thing", Order("wheel"), on_status=heard)
    workshop.shut("status wheel WARNING low light")
    system.registrar("shop").send_status(query.resource_id, WARNING)
    workshop.wait("status wheel")
    assert len(heard) == 0
    wait_respawned(system, "shop", kill(system, "shop"))
    workshop.wait("status wheel", 2)
    assert len(heard) == 0
    workshop.open("status wheel WARNING low light")
    (status,) = heard.wait()
    assert (status.message, status.repeated) == ("low light", False)
    eventually(lambda: system.registrar("shop").stats()["notices"] == 0)
    wait_respawned(system, "shop", kill(system, "shop"))
    assert app.load("shop/thing", Order("wheel")).resource_id == query.resource_id
    assert (len(heard), len(workshop.lines("status wheel"))) == (1, 2)


def test_a_status_of_a_part_that_waits_for_the_whole_to_be_loaded_survives_the_death_of_its_provider(
    start: Start, workshop: Workshop
) -> None:
    system = start(shop(workshop), shop(workshop, "factory"))
    app = system.open_registrar("app")
    workshop.shut("made bike")
    bike = app.load("factory/thing", Order("bike", ("shop/thing:wheel",)), block=False)
    workshop.wait("made bike")
    (wheel,) = system.registrar("shop").resources()
    system.registrar("shop").send_status(wheel.id, WARNING)
    workshop.wait("status wheel WARNING")
    wait_respawned(system, "shop", kill(system, "shop"))
    assert workshop.lines("status bike") == []
    workshop.open("made bike")
    query = bike.get(timeout=LIMIT_S)
    workshop.wait("status bike WARNING low light")
    assert query.wait_status(timeout_s=LIMIT_S).message == "low light"
    eventually(lambda: system.registrar("shop").stats()["notices"] == 0)
    assert len(workshop.lines("status bike")) == 1


def test_a_status_of_a_part_that_the_whole_has_not_dealt_with_when_it_dies_is_told_again(
    start: Start, workshop: Workshop
) -> None:
    system = start(shop(workshop), shop(workshop, "factory"))
    app = system.open_registrar("app")
    workshop.shut("made bike")
    workshop.shut("status bike WARNING low light")
    bike = app.load("factory/thing", Order("bike", ("shop/thing:wheel",)), block=False)
    workshop.wait("made bike")
    (wheel,) = system.registrar("shop").resources()
    system.registrar("shop").send_status(wheel.id, WARNING)
    workshop.open("made bike")
    query = bike.get(timeout=LIMIT_S)
    workshop.wait("status bike")
    kill(system, "factory")
    workshop.wait("status bike", 2)
    workshop.open("status bike WARNING low light")
    assert query.wait_status(timeout_s=LIMIT_S).message == "low light"


def test_a_consumer_killed_while_it_waits_for_a_load_holds_it_once(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop, "parts"), shop(workshop))
    app = system.open_registrar("app")
    workshop.shut("load wheel")
    future = app.load("shop/thing", Order("bike", ("parts/thing:wheel",)), block=False)
    workshop.wait("load wheel")
    kill(system, "shop")
    workshop.wait("load bike", 2)
    workshop.open("load wheel")
    future.get(timeout=LIMIT_S)
    eventually(lambda: holders(system, "parts") == {"wheel": ["shop"]})
    assert len(workshop.lines("made wheel")) - len(workshop.lines("unload wheel")) == 1


# -- recover callbacks and policies --------------------------------------------------------------------------------


def depot(workshop: Workshop, **kwargs: Any) -> rr.ChildSpec:
    return rr.ChildSpec(Depot, id="depot", args=(str(workshop.root),), kwargs=kwargs)


def test_recover_is_asked_for_each_live_resource_and_may_say_that_it_lives(start: Start, workshop: Workshop) -> None:
    system = start(depot(workshop, recover=True))
    app = system.open_registrar("app")
    heard = Calls()
    queries = [app.load("depot/thing", Order(name), on_status=heard) for name in ("wheel", "seat")]
    app.load("depot/thing", Order("gone")).unload()
    old = kill(system, "depot")
    wait_respawned(system, "depot", old)
    assert sorted(workshop.wait("recover", 2)) == [f"recover seat {old}", f"recover wheel {old}"]
    again = app.load("depot/thing", Order("wheel"))
    assert (again.resource_id, again.response.pid) == (queries[0].resource_id, old)
    assert len(heard) == 0


def test_recover_may_return_a_changed_response_which_is_an_update(start: Start, workshop: Workshop) -> None:
    system = start(depot(workshop, recover=True))
    app = system.open_registrar("app")
    heard = Calls()
    query = app.load("depot/thing", Order("wheel"), on_status=heard)
    workshop.note("please change wheel")
    kill(system, "depot")
    (status,) = heard.wait()
    assert (status.state, status.query_id) == (rr.State.UPDATE, query.id)
    again = app.load("depot/thing", Order("wheel"))
    assert (again.resource_id, again.response.name) == (query.resource_id, "changed")
    assert len(workshop.lines("load wheel")) == 1


def test_recover_may_raise_and_the_resource_is_lost(start: Start, workshop: Workshop) -> None:
    system = start(depot(workshop, recover=True))
    app = system.open_registrar("app")
    heard, unconcerned = Calls(), Calls()
    lost = app.load("depot/thing", Order("wheel"), on_status=heard)
    app.load("depot/thing", Order("seat"), on_status=unconcerned)
    workshop.spoil("recover wheel")
    kill(system, "depot")
    (status,) = heard.wait()
    assert (status.state, status.query_id) == (rr.State.FATAL, lost.id)
    fresh = app.load("depot/thing", Order("wheel"))
    assert fresh.resource_id != lost.resource_id
    assert len(workshop.lines("load wheel")) == 2
    lost.unload()
    assert len(unconcerned) == 0


def test_the_policy_keep_takes_it_that_the_resource_lives(start: Start, workshop: Workshop) -> None:
    system = start(depot(workshop, recovery="keep"))
    app = system.open_registrar("app")
    query = app.load("depot/thing", Order("wheel"))
    wait_respawned(system, "depot", kill(system, "depot"))
    again = app.load("depot/thing", Order("wheel"))
    assert (again.resource_id, again.response) == (query.resource_id, query.response)
    assert len(workshop.lines("load wheel")) == 1


def test_the_policy_reload_loads_it_again_for_the_same_holders(start: Start, workshop: Workshop) -> None:
    system = start(depot(workshop, recovery="reload"))
    app = system.open_registrar("app")
    query = app.load("depot/thing", Order("wheel"))
    new = wait_respawned(system, "depot", kill(system, "depot"))
    workshop.wait("load wheel", 2)
    again = app.load("depot/thing", Order("wheel"))
    assert (again.resource_id, again.response.pid) == (query.resource_id, new)
    assert len(workshop.lines("load wheel")) == 2
    assert holders(system, "depot") == {"wheel": ["app", "app"]}


def test_a_reload_that_raises_is_a_loss(start: Start, workshop: Workshop) -> None:
    system = start(depot(workshop, recovery="reload"))
    app = system.open_registrar("app")
    heard = Calls()
    query = app.load("depot/thing", Order("wheel"), on_status=heard)
    workshop.spoil("load wheel")
    kill(system, "depot")
    (status,) = heard.wait()
    assert (status.state, status.query_id) == (rr.State.FATAL, query.id)
    workshop.mend("load wheel")
    assert app.load("depot/thing", Order("wheel")).resource_id != query.resource_id


def test_the_policy_lost_tells_the_holders_fatal(start: Start, workshop: Workshop) -> None:
    system = start(depot(workshop, recovery="lost"))
    app = system.open_registrar("app")
    heard = Calls()
    query = app.load("depot/thing", Order("wheel"), on_status=heard)
    kill(system, "depot")
    (status,) = heard.wait()
    assert (status.state, status.query_id) == (rr.State.FATAL, query.id)
    assert app.load("depot/thing", Order("wheel")).resource_id != query.resource_id


def test_what_lingered_when_its_provider_died_is_unloaded_all_the_same(start: Start, workshop: Workshop) -> None:
    system = start(depot(workshop, linger_s=3600.0))
    app = system.open_registrar("app")
    app.load("depot/thing", Order("wheel")).unload()
    app.load("depot/thing", Order("seat"))
    assert set(holders(system, "depot")) == {"wheel", "seat"}
    workshop.note("please hurry")
    kill(system, "depot")
    workshop.wait("unload wheel")
    eventually(lambda: holders(system, "depot") == {"seat": ["app"]})


# -- servers registered at run time --------------------------------------------------------------------------------


def test_a_server_registered_through_a_handle_is_there_again_after_a_respawn(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop))
    app = system.open_registrar("app")
    word = "made"
    system.registrar("shop").register_server("late", lambda request: [word, request, os.getpid()])
    query = app.load("shop/late", "x")
    old = pid_of(system, "shop")
    assert query.response == ["made", "x", old]
    kill(system, "shop")
    assert app.load("shop/late", "x").resource_id == query.resource_id
    new = pid_of(system, "shop")
    assert new != old
    assert app.load("shop/late", "y").response == ["made", "y", new]
    assert "shop/late" in system.registrar("shop").servers()


def test_a_server_unregistered_through_a_handle_stays_away_after_a_respawn(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop))
    app = system.open_registrar("app")
    handle = system.registrar("shop")
    handle.register_server("late", lambda request: request)
    handle.unregister_server("late")
    wait_respawned(system, "shop", kill(system, "shop"))
    with pytest.raises(rr.UnknownServer, match="shop/late"):
        app.load("shop/late", "x")


def test_resources_wait_for_the_server_that_the_processs_own_code_registers(start: Start, workshop: Workshop) -> None:
    system = start(depot(workshop))
    app = system.open_registrar("app")
    query = app.load("depot/thing", Order("wheel"))
    workshop.shut("start depot")
    kill(system, "depot")
    workshop.wait("start depot", 2)
    future = app.load("depot/thing", Order("wheel"), block=False)
    unload = app.unload(query, block=False)
    workshop.open("start depot")
    assert future.get(timeout=LIMIT_S).resource_id == query.resource_id
    unload.get(timeout=LIMIT_S)
    assert holders(system, "depot") == {"wheel": ["app"]}
    assert len(workshop.lines("load wheel")) == 1


# -- consumers that are gone ---------------------------------------------------------------------------------------


def test_a_consumer_that_is_not_restarted_has_its_queries_released(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop), customer(workshop, "wheel", restart="temporary"))
    assert holders(system) == {"wheel": ["customer"]}
    kill(system, "customer")
    workshop.wait("unload wheel")
    eventually(lambda: holders(system) == {})


def test_a_consumer_whose_supervisor_gave_up_on_it_has_its_queries_released(start: Start, workshop: Workshop) -> None:
    inner = rr.Supervisor([customer(workshop, "wheel")], id="inner", max_restarts=0, restart="temporary")
    system = start(rr.Supervisor([shop(workshop), inner], id="root"))
    assert holders(system) == {"wheel": ["customer"]}
    (found,) = system.supervisor("root/inner").which_children()
    assert found.pid
    os.kill(found.pid, signal.SIGKILL)
    workshop.wait("unload wheel")
    eventually(lambda: holders(system) == {})


def test_a_terminated_consumer_keeps_its_queries_until_it_is_deleted(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop), customer(workshop, "wheel"))
    supervisor = system.supervisor()
    supervisor.terminate_child("customer")
    assert holders(system) == {"wheel": ["customer"]}
    supervisor.restart_child("customer")
    assert workshop.lines("start customer") == ["start customer", "start customer wheel"]
    assert holders(system) == {"wheel": ["customer"]}
    assert workshop.lines("unload") == []
    supervisor.terminate_child("customer")
    supervisor.delete_child("customer")
    workshop.wait("unload wheel")
    eventually(lambda: holders(system) == {})


def test_a_terminated_consumer_hears_what_it_missed_when_it_is_restarted(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop), customer(workshop, "wheel", "seat"))
    provider = system.registrar("shop")
    ids = {resource.request.name: resource.id for resource in provider.resources()}
    system.supervisor().terminate_child("customer")
    provider.send_status(ids["seat"], WARNING)
    provider.unload(ids["wheel"], force=True)
    assert workshop.lines("hears") == []
    system.supervisor().restart_child("customer")
    assert sorted(workshop.wait("hears", 2)) == ["hears FATAL unloaded by its owner", "hears WARNING low light"]
    eventually(lambda: holders(system) == {"seat": ["customer"]})
    eventually(lambda: len(system.registrar("customer").queries()) == 1)


def test_a_system_that_stops_releases_everything(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop), customer(workshop, "wheel"))
    app = system.open_registrar("app")
    app.load("shop/thing", Order("seat"))
    system.stop()
    assert sorted(workshop.lines("unload")) == ["unload seat", "unload wheel"]


def run_and_be_killed(workshop: Workshop, state_dir: Path, body: str) -> None:
    """Run a program with a System of a shop on `state_dir` and a registrar "app"; SIGKILL it when it is through."""
    program = f"""
import signal, os
import rr_actors as rr
from support import Workshop
from support_managers import Order, Shop
from test_semantics_recovery import Customer
workshop = Workshop({str(workshop.root)!r})
if __name__ == "__main__":
    children = [rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),))]
    with rr.System(children, state_dir={str(state_dir)!r}) as system:
        app = system.open_registrar("app")
{textwrap.indent(textwrap.dedent(body), " " * 8)}
        os.kill(os.getpid(), signal.SIGKILL)
"""
    environment = dict(os.environ, PYTHONPATH=TEST_PATHS)
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=30, check=False
    )
    assert done.returncode == -signal.SIGKILL, done.stderr


def test_the_queries_of_a_registrar_whose_process_died_stay_until_it_is_opened_again(
    start: Start, workshop: Workshop, state_dir: Path
) -> None:
    run_and_be_killed(workshop, state_dir, "app.load('shop/thing', Order('wheel'))")
    system = start(shop(workshop))
    assert list(system.dormant()) == ["app"]
    assert holders(system) == {"wheel": ["app"]}
    app = system.open_registrar("app")
    assert list(system.dormant()) == []
    (query,) = app.queries()
    assert (query.request, query.response.name, query.server) == (Order("wheel"), "wheel", "thing")
    assert workshop.lines("unload") == []
    query.unload()
    assert workshop.lines("unload") == ["unload wheel"]
    assert len(workshop.lines("load wheel")) == 1


def test_a_registrar_called_as_the_directory_of_what_lives_keeps_what_it_holds(
    start: Start, workshop: Workshop, state_dir: Path
) -> None:
    run_and_be_killed(workshop, state_dir, "system.open_registrar('run').load('shop/thing', Order('wheel'))")
    system = start(shop(workshop))
    assert list(system.dormant()) == ["run"]
    (query,) = system.open_registrar("run").queries()
    assert query.request == Order("wheel")


def test_release_gives_up_what_a_dormant_registrar_holds(start: Start, workshop: Workshop, state_dir: Path) -> None:
    run_and_be_killed(workshop, state_dir, "app.load('shop/thing', Order('wheel'))")
    system = start(shop(workshop))
    assert list(system.dormant()) == ["app"]
    system.release("app")
    workshop.wait("unload wheel")
    eventually(lambda: holders(system) == {})
    assert list(system.dormant()) == []


@pytest.mark.parametrize("location", ["disk2", "deep/down", "{outside}"])
def test_a_dormant_registrar_has_its_own_name_wherever_its_catalog_is(
    start: Start, workshop: Workshop, state_dir: Path, location: str
) -> None:
    location = location.format(outside=workshop.root)
    opened = f"system.open_registrar('other', rr.RegistrarConfig(location={location!r}))"
    run_and_be_killed(workshop, state_dir, f"{opened}.load('shop/thing', Order('wheel'))")
    (state_dir / "shop").rename(state_dir / "disk1")
    places = {"other": rr.RegistrarConfig(location=location), "shop": rr.RegistrarConfig(location="disk1")}
    system = start(shop(workshop), config=rr.SystemConfig(registrars=places))
    assert holders(system) == {"wheel": ["other"]}
    assert system.dormant() == ["other"]

    system.release("other")

    workshop.wait("unload wheel")
    eventually(lambda: holders(system) == {})
    assert system.dormant() == []


def test_a_release_that_a_kill_interrupts_can_be_made_again(start: Start, workshop: Workshop, state_dir: Path) -> None:
    run_and_be_killed(workshop, state_dir, "system.open_registrar('other').load('shop/thing', Order('wheel'))")
    body = """
    from rr_actors.registrar.engine.node import Node
    Node.retire = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
    system.release('other')
    """
    run_and_be_killed(workshop, state_dir, body)
    system = start(shop(workshop))
    assert holders(system) == {"wheel": ["other"]}
    assert system.dormant() == ["other"]

    system.release("other")

    workshop.wait("unload wheel")
    eventually(lambda: holders(system) == {})
    assert system.dormant() == []
    left = read_rows(state_dir / "other" / "catalog.sqlite3")
    assert not any(isinstance(row, Held | Peer) for row in left)


HOLDS = """
other = system.open_registrar('other')
other.load('shop/thing', Order('wheel'))
other.save_catalog()
"""


@pytest.mark.parametrize(
    ("down", "end", "again"),
    [("stopped", "stop", "opened"), ("starting", "kill", "opened"), ("starting", "stop", "released")],
)
def test_a_release_while_its_provider_is_down_is_owed_when_the_application_is_started_again(
    start: Start, workshop: Workshop, state_dir: Path, down: str, end: str, again: str
) -> None:
    run_and_be_killed(workshop, state_dir, HOLDS)
    body = f"""
    if {down == "stopped"}:
        system.supervisor().terminate_child('shop')
    else:
        workshop.shut('start shop')
        os.kill(system.supervisor().which_children()[0].pid, signal.SIGKILL)
        workshop.wait('start shop', 3)
    system.release('other')
    assert system.dormant() == []
    if {end == "stop"}:
        system.stop(0.5)
    """
    run_and_be_killed(workshop, state_dir, body)
    workshop.open("start shop")
    system = start(shop(workshop))
    assert system.dormant() == ["other"]

    if again == "opened":
        assert list(system.open_registrar("other").queries()) == []
    else:
        system.release("other")

    workshop.wait("unload wheel")
    eventually(lambda: holders(system) == {})
    assert system.dormant() == []


def test_a_release_of_which_a_provider_that_seems_to_be_up_cannot_be_told_is_owed(
    start: Start, workshop: Workshop, state_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_and_be_killed(workshop, state_dir, HOLDS)
    system = start(shop(workshop))

    async def dead(*_: Any) -> Any:
        raise rr.RegistrarDown("its process has died just now", registrar="shop", status="")

    with monkeypatch.context() as patch:
        patch.setattr(UnixTransport, "connect", dead)
        system.release("other")
    system.stop()
    system = start(shop(workshop))
    assert system.dormant() == ["other"]
    system.release("other")
    workshop.wait("unload wheel")


def test_what_was_released_while_its_provider_was_down_is_not_held_again_by_who_opens_it_meanwhile(
    start: Start, workshop: Workshop, state_dir: Path
) -> None:
    run_and_be_killed(workshop, state_dir, HOLDS)
    system = start(shop(workshop))
    system.supervisor().terminate_child("shop")
    system.release("other")
    other = system.open_registrar("other")
    system.supervisor().restart_child("shop")
    workshop.wait("unload wheel")
    eventually(lambda: holders(system) == {})
    assert list(other.queries()) == []


def test_what_a_dormant_registrar_holds_at_itself_is_released_when_it_is_opened(
    start: Start, workshop: Workshop, state_dir: Path
) -> None:
    body = """
    other = system.open_registrar('other')
    other.register_server('own', lambda request: request, lambda *_: None)
    other.load('other/own', 'x')
    other.save_catalog()
    """
    run_and_be_killed(workshop, state_dir, body)
    system = start()
    system.release("other")
    other = system.open_registrar("other")
    served = serve(other, "own")
    assert served.unloads.wait() == [("x", "x")]
    eventually(lambda: not other.resources())


def test_a_provider_hears_of_a_registrar_that_is_released_while_it_is_about_to_serve(
    start: Start, workshop: Workshop, state_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = """
    provider = system.open_registrar('provider')
    provider.register_server('thing', lambda request: request, lambda *_: None)
    app.load('provider/thing', 'x')
    """
    run_and_be_killed(workshop, state_dir, body)
    system = start()
    publish = Directory.publish

    def publish_late(directory: Directory, name: str, address: str, **options: Any) -> None:
        if name == registrar_key("provider"):
            directory.mark(registrar_key("app"), Presence.GONE)  # System.release() does so, then looks for addresses
        publish(directory, name, address, **options)

    monkeypatch.setattr(Directory, "publish", publish_late)
    served = serve(system.open_registrar("provider"), "thing")
    assert served.unloads.wait() == [("x", "x")]


def test_a_whole_system_that_was_killed_comes_back_with_everything(
    start: Start, workshop: Workshop, state_dir: Path
) -> None:
    spec = "rr.ChildSpec(Customer, id='customer', args=(str(workshop.root), 'wheel'))"
    run_and_be_killed(workshop, state_dir, f"system.start_child({spec})")
    system = start(shop(workshop), customer(workshop, "wheel"))
    assert workshop.lines("start customer") == ["start customer", "start customer wheel"]
    assert holders(system) == {"wheel": ["customer"]}
    assert len(workshop.lines("load wheel")) == 1
    assert child(system, "customer").state == "running"


def test_an_unload_owed_by_a_process_that_died_is_delivered_by_its_next_life(
    start: Start, workshop: Workshop, state_dir: Path
) -> None:
    body = """
    query = app.load('shop/thing', Order('wheel'))
    system.supervisor().terminate_child('shop')
    try:
        app.unload(query, timeout_s=0.05)
    except rr.Unavailable:
        pass
    """
    run_and_be_killed(workshop, state_dir, body)
    assert workshop.lines("unload") == []
    system = start(shop(workshop))
    app = system.open_registrar("app")
    assert list(app.queries()) == []
    workshop.wait("unload wheel")
    eventually(lambda: holders(system) == {})


def test_what_a_whole_system_acknowledged_before_it_was_killed_at_a_random_moment_is_so(
    start: Start, workshop: Workshop, state_dir: Path
) -> None:
    body = """
    import threading, random
    def use(name):
        held = []
        for n in range(10_000):
            held.append(app.load('shop/thing', Order(f'{name}-{n}')))
            workshop.note('told held', held[-1].id)
            if n % 2:
                query = held.pop(0)
                workshop.note('asks release', query.id)
                query.unload()
                workshop.note('told released', query.id)
    for n in range(3):
        threading.Thread(target=use, args=(f'w{n}',), daemon=True).start()
    workshop.wait('told released', random.Random(5).randrange(5, 40))
    """
    run_and_be_killed(workshop, state_dir, body)

    def told(what: str) -> set[str]:
        return {line.split()[2] for line in workshop.lines(what)}

    system = start(shop(workshop))
    app = system.open_registrar("app")
    known = {query.id for query in app.queries()}
    assert told("told held") - told("asks release") <= known
    assert not told("told released") & known
    eventually(lambda: {query.id for query in app.fetch_queries("shop")} == known)
    resources = system.registrar("shop").resources()
    assert sorted(id for resource in resources for id in resource.queries) == sorted(known)
    app.unload_all()
    eventually(lambda: holders(system) == {})


# -- data fetch ----------------------------------------------------------------------------------------------------


def test_fetch_queries_returns_the_full_queries_this_registrar_holds_there(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop))
    app, other = system.open_registrar("app"), system.open_registrar("other")
    loaded = [app.load("shop/thing", Order(name)) for name in ("wheel", "seat")]
    other.load("shop/thing", Order("wheel"))
    for _ in range(2):
        fetched = {query.id: query for query in app.fetch_queries("shop")}
        assert set(fetched) == {query.id for query in loaded}
        for query in loaded:
            known = fetched[query.id]
            assert (known.origin, known.registrar, known.server) == ("app", "shop", "thing")
            assert (known.request, known.response) == (query.request, query.response)
            assert known.resource_id == query.resource_id
        wait_respawned(system, "shop", kill(system, "shop"))


class Curious(rr.Manager):
    """Looks what it has at "shop" before it ever asks for anything there, and dies when it has been given something."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    def on_start(self) -> None:
        held = self.registrar.queries()
        self.registrar.on_status("shop/thing", lambda status: self.work.note(f"hears {status.message}"))
        self.work.note(f"start {self.registrar.name}", [query.request.name for query in held])
        if not held:
            threading.Thread(target=self.look, daemon=True).start()

    def look(self) -> None:
        self.work.step("look")
        for _ in range(2):  # with the second, the link is agreed on
            self.registrar.fetch_queries("shop")
        self.registrar.load("shop/thing", Order("wheel"))
        os.kill(os.getpid(), signal.SIGKILL)


def test_what_was_loaded_from_where_one_had_only_looked_survives_sigkill(start: Start, workshop: Workshop) -> None:
    workshop.shut("look")
    system = start(shop(workshop), rr.ChildSpec(Curious, id="curious", args=(str(workshop.root),)))
    workshop.open("look")
    assert workshop.wait("start curious", 2) == ["start curious []", "start curious ['wheel']"]
    (wheel,) = system.registrar("shop").resources()
    system.registrar("shop").send_status(wheel.id, WARNING)
    workshop.wait("hears low light")
    assert workshop.lines("load wheel") == ["load wheel attempt=1"]


# -- everything at once --------------------------------------------------------------------------------------------


def test_a_chain_of_managers_survives_the_death_of_each_of_them(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop, "r0"), shop(workshop, "r1"), shop(workshop, "r2"), shop(workshop, "r3"))
    app = system.open_registrar("app")
    heard = Calls()
    system.registrar("r1").load("r0/thing", Order("spare"))
    query = app.load("r2/thing", Order("car", ("r1/thing:engine", "r0/thing:wheel")), on_status=heard)
    for id in ("r0", "r1", "r2"):
        wait_respawned(system, id, kill(system, id))
    assert holders(system, "r2") == {"car": ["app"]}
    assert holders(system, "r1") == {"engine": ["r2"]}
    assert holders(system, "r0") == {"wheel": ["r2"], "spare": ["r1"]}
    (engine,) = system.registrar("r1").resources()
    system.registrar("r1").send_status(engine.id, WARNING)
    heard.wait()
    assert messages(heard) == ["low light"]
    assert workshop.lines("status car") == ["status car WARNING low light"]
    query.unload()
    workshop.wait("unload engine")
    workshop.wait("unload wheel")
    eventually(lambda: holders(system, "r1") == {} and holders(system, "r0") == {"spare": ["r1"]})
    assert workshop.lines("unload") == ["unload car", "unload wheel", "unload engine"]


def test_the_supervisor_ends_nobody_else_when_one_child_is_killed(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop, "one"), shop(workshop, "two"))
    other = pid_of(system, "two")
    wait_respawned(system, "one", kill(system, "one"))
    assert pid_of(system, "two") == other


class Poisonable(rr.Manager):
    """Its process dies of one request."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    @rr.server("thing")
    def load_thing(self, request: str) -> str:
        self.work.note(f"load {request}", rr.current().attempt)
        if request == "poison":
            os.kill(os.getpid(), signal.SIGKILL)
        return request

    @load_thing.unload
    def unload_thing(self, request: str, response: str | None) -> None:
        self.work.note(f"unload {request}", response)


def test_a_load_whose_process_dies_each_time_is_given_up_and_the_tree_lives_on(
    start: Start, workshop: Workshop
) -> None:
    system = start(rr.ChildSpec(Poisonable, id="shop", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    kept = app.load("shop/thing", "wheel")
    with pytest.raises(rr.LoadFailed, match=r"shop/thing: the process died in each of 3 attempts"):
        app.load("shop/thing", "poison")
    assert workshop.lines("load poison") == ["load poison 1", "load poison 2", "load poison 3"]
    workshop.wait("unload poison")
    assert app.load("shop/thing", "wheel").resource_id == kept.resource_id
    eventually(lambda: [info.request for info in system.registrar("shop").resources()] == ["wheel"])
    assert system.ended is None
