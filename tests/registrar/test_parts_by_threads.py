"""What a callback's thread loads by a connection of its own is a dependency like any other, whatever goes wrong."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.registrar.engine.commit_log import CommitLog
from rr_actors.registrar.model.messages import Load
from rr_actors.registrar.model.rows import Held, Hold
from rr_actors.registrar.pages import Wanted, page_of
from rr_actors.storage.opening import read_rows
from rr_actors.wire import thread_connections
from support import (
    LIMIT_S,
    Calls,
    Workshop,
    break_exchanges,
    catalog_path,
    connect_threads,
    eventually,
    hang,
    kill,
    serve,
    wait_respawned,
)
from support_inside import actor_of
from support_managers import Order, Shop

Start = Callable[..., rr.System]


def shop(workshop: Workshop, id: str) -> rr.ChildSpec:
    return rr.ChildSpec(Shop, id=id, args=(str(workshop.root),))


@pytest.fixture
def parts(start: Start, workshop: Workshop) -> rr.System:
    """A system with a provider of parts in another process."""
    return start(shop(workshop, "parts"))


@pytest.fixture
def builder(parts: rr.System) -> rr.Registrar:
    """A registrar of this process that has a link to the parts: threads have connections of their own beside it."""
    builder = parts.open_registrar("builder")
    connect_threads(builder, "parts/thing", Order("keeps the link"))
    return builder


def builds(builder: rr.Registrar, *names: str, more: Callable[[rr.Query], object] = lambda query: None) -> None:
    """Serve "bike", made of these parts; `more` is called with each."""

    def load(_request: Any) -> str:
        for name in names:
            more(builder.load("parts/thing", Order(name)))
        return "bike"

    serve(builder, "bike", load=load)


def connect_shop(app: rr.Registrar) -> None:
    """Have the shop hold a bell. Its threads have connections to the parts from now on."""
    app.load("shop/thing", Order("first", ("parts/thing:bell",)))
    app.load("shop/thing", Order("second", ("parts/thing:bell",))).unload()


def in_flight(builder: rr.Registrar) -> list[Held]:
    """What threads have asked for, and nobody else knows of."""
    return list(actor_of(builder).catalog.in_flight.values())


def held_of(system: rr.System, registrar: str = "builder") -> list[str]:
    """What it holds, as the provider of the parts has it."""
    resources = system.registrar("parts").resources()
    return sorted(r.request.name for r in resources if registrar in r.holders and r.request.name != "keeps the link")


# -- it is a dependency ----------------------------------------------------------------------------------------------


def test_the_loop_has_no_part_in_what_a_callbacks_thread_loads_and_gives_back(
    parts: rr.System, builder: rr.Registrar, workshop: Workshop, monkeypatch: pytest.MonkeyPatch
) -> None:
    builds(builder, "wheel", "bell", more=lambda query: query.unload() if query.request.name == "bell" else None)
    app = parts.open_registrar("app")
    with monkeypatch.context() as patch:
        for method in ("ask", "release", "go_on_loading", "go_on_unloading"):
            patch.setattr(actor_of(builder), method, None)
        bike = app.load("builder/bike", None)
    assert [part.request.name for part in builder.children(bike)] == ["wheel"]
    assert workshop.lines("unload") == ["unload bell"]
    bike.unload()
    assert workshop.lines("unload") == ["unload bell", "unload wheel"]


def test_its_row_has_its_parent_and_attempt_in_memory_and_on_disk(
    builder: rr.Registrar, state_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CommitLog, "save_soon", lambda _log: None)
    builds(builder, "wheel")
    bike = builder.load("builder/bike", None)
    builder.save_catalog()
    rows = [row for row in read_rows(catalog_path(state_dir, "builder")) if isinstance(row, Held) and row.parent]
    assert [(row.parent, row.attempt, row.hold) for row in rows] == [(bike.resource_id, 1, Hold.HELD)]
    assert rows == [actor_of(builder).catalog.held[row.id] for row in rows]


def test_that_a_part_is_given_back_is_on_disk_before_its_provider_hears_of_it(
    builder: rr.Registrar, workshop: Workshop, state_dir: Path
) -> None:
    def give_back(query: rr.Query) -> None:
        builder.save_catalog()
        workshop.shut("unload wheel")
        query.unload()

    builds(builder, "wheel", more=give_back)
    future = builder.load("builder/bike", None, block=False)
    workshop.wait("unload wheel")
    rows = [row for row in read_rows(catalog_path(state_dir, "builder")) if isinstance(row, Held) and row.parent]
    workshop.open("unload wheel")
    assert [row.hold for row in rows] == [Hold.OWED]
    assert builder.children(future.get(timeout=LIMIT_S)) == []


def test_who_looks_while_it_is_in_flight_sees_what_the_resource_waits_for(
    builder: rr.Registrar, workshop: Workshop
) -> None:
    builds(builder, "wheel")
    workshop.shut("load wheel")
    future = builder.load("builder/bike", None, block=False)
    workshop.wait("load wheel")
    assert [row.request for row in in_flight(builder)] != []
    (bike,) = page_of(actor_of(builder), Wanted("resources")).resources
    (part,) = page_of(actor_of(builder), Wanted("id", bike.parts[0])).queries
    assert (part.parent, part.server, part.hold) == (bike.id, "parts/thing", "pending")
    assert in_flight(builder) == []
    workshop.open("load wheel")
    assert [child.id for child in builder.children(future.get(timeout=LIMIT_S))] == [part.id]


def test_a_status_that_overtakes_the_answer_reaches_the_resource_that_depends_on_it(
    parts: rr.System, builder: rr.Registrar, workshop: Workshop
) -> None:
    heard = Calls()

    def load(_request: Any) -> None:
        builder.load("parts/thing", Order("wheel"))

    builder.register_server("bike", load, status=lambda _request, status: heard(str(status)))
    workshop.shut("made wheel")
    future = builder.load("builder/bike", None, block=False)
    workshop.wait("made wheel")
    owner = parts.registrar("parts")
    (wheel,) = [r for r in owner.resources() if r.request.name == "wheel"]
    owner.send_status(wheel.id, rr.Status(rr.State.WARNING, "flat"))
    workshop.open("made wheel")
    future.get(timeout=LIMIT_S)
    assert heard.wait(1) == ["WARNING: flat"]


# -- it ends otherwise -----------------------------------------------------------------------------------------------


def test_a_callback_that_raises_ends_what_a_thread_of_it_still_loads_at_once(
    parts: rr.System, builder: rr.Registrar, workshop: Workshop
) -> None:
    ended = Calls()
    workshop.shut("load wheel")

    def load(_request: Any) -> None:
        parent = rr.current()

        def work() -> None:
            try:
                ended(builder.load("parts/thing", Order("wheel"), parent=parent))
            except rr.RrError as error:
                ended(error)

        threading.Thread(target=work).start()
        workshop.wait("load wheel")
        raise ValueError("no frame")

    serve(builder, "bike", load=load)
    with pytest.raises(rr.LoadFailed, match="no frame"):
        builder.load("builder/bike", None)
    (error,) = ended.wait(1)
    assert isinstance(error, rr.LoadError)
    assert "what asked for it is gone" in str(error)
    workshop.open("load wheel")
    eventually(lambda: held_of(parts) == [] and not actor_of(builder).busy())
    eventually(lambda: workshop.lines("unload wheel") == ["unload wheel"])


def test_a_registrar_that_is_closed_meanwhile_lets_its_threads_go_on_at_once(
    parts: rr.System, builder: rr.Registrar, workshop: Workshop
) -> None:
    ended = Calls()
    workshop.shut("load wheel")

    def work() -> None:
        try:
            ended(builder.load("parts/thing", Order("wheel")))
        except rr.RrError as error:
            ended(error)

    thread = threading.Thread(target=work)
    thread.start()
    workshop.wait("load wheel")
    closing = threading.Thread(target=builder.close)
    closing.start()
    (error,) = ended.wait(1)
    assert isinstance(error, rr.RrError)
    workshop.open("load wheel")
    closing.join(LIMIT_S)
    thread.join(LIMIT_S)
    assert not closing.is_alive()
    eventually(lambda: held_of(parts) == [])


def test_a_part_that_is_not_loaded_in_time_is_withdrawn(
    parts: rr.System, builder: rr.Registrar, workshop: Workshop
) -> None:
    workshop.shut("load wheel")
    timeouts = Calls()

    def load(_request: Any) -> str:
        try:
            builder.load("parts/thing", Order("wheel"), timeout_s=0.2)
        except rr.LoadTimeout as error:
            timeouts(error)
        return builder.load("parts/thing", Order("other wheel")).response.name

    serve(builder, "bike", load=load)
    bike = builder.load("builder/bike", None)
    assert bike.response == "other wheel"
    assert len(timeouts) == 1
    workshop.open("load wheel")
    workshop.wait("unload wheel")
    eventually(lambda: held_of(parts) == ["other wheel"])
    assert [part.request.name for part in builder.children(bike)] == ["other wheel"]


@pytest.mark.parametrize("sends", [False, True], ids=["question lost", "answer lost"])
def test_a_connection_that_breaks_hands_the_part_over_to_the_link(
    parts: rr.System, builder: rr.Registrar, workshop: Workshop, monkeypatch: pytest.MonkeyPatch, sends: bool
) -> None:
    builds(builder, "wheel")
    with monkeypatch.context() as patch:
        break_exchanges(patch, ConnectionResetError("lost"), sends=sends, kind=Load)
        bike = builder.load("builder/bike", None)
    assert [part.request.name for part in builder.children(bike)] == ["wheel"]
    assert workshop.lines("load wheel") == ["load wheel attempt=1"]
    assert held_of(parts) == ["wheel"]
    assert not actor_of(builder).busy()


def test_a_callbacks_thread_that_is_interrupted_holds_nothing(
    parts: rr.System, builder: rr.Registrar, workshop: Workshop, monkeypatch: pytest.MonkeyPatch
) -> None:
    builds(builder, "wheel")
    with monkeypatch.context() as patch:
        break_exchanges(patch, KeyboardInterrupt(), sends=True, kind=Load)
        with pytest.raises(rr.LoadFailed):
            builder.load("builder/bike", None)
    eventually(lambda: held_of(parts) == [] and not actor_of(builder).busy())


def test_more_threads_of_callbacks_than_there_are_connections_all_get_their_parts(
    parts: rr.System, builder: rr.Registrar, workshop: Workshop, monkeypatch: pytest.MonkeyPatch
) -> None:
    def load(request: Any) -> str:
        return builder.load("parts/thing", Order(f"wheel {request}")).response.name

    monkeypatch.setattr(thread_connections, "_DIAL_S", LIMIT_S)  # on a busy machine a thread soon takes the link
    serve(builder, "bike", load=load)
    workshop.shut("load wheel 0")
    before = len(os.listdir("/proc/self/fd"))
    for number in range(40):
        workshop.shut(f"load wheel {number}")
    futures = [builder.load("builder/bike", number, block=False) for number in range(40)]
    workshop.wait("load wheel", 40)
    assert len(in_flight(builder)) == 16
    assert len(os.listdir("/proc/self/fd")) <= before + 16 + 16  # and some for workers
    for number in range(40):
        workshop.open(f"load wheel {number}")
    assert [future.get(timeout=20).response for future in futures] == [f"wheel {number}" for number in range(40)]
    assert len(held_of(parts)) == 40


# -- processes that are killed, or hang ------------------------------------------------------------------------------


def test_a_provider_killed_while_it_loads_a_part_loads_it_when_it_is_back_and_it_is_held_once(
    parts: rr.System, builder: rr.Registrar, workshop: Workshop
) -> None:
    builds(builder, "wheel")
    workshop.shut("load wheel")
    future = builder.load("builder/bike", None, block=False)
    workshop.wait("load wheel")
    old = kill(parts, "parts")
    workshop.wait("load wheel", 2)
    workshop.open("load wheel")
    bike = future.get(timeout=LIMIT_S)
    wait_respawned(parts, "parts", old)
    assert workshop.lines("load wheel") == ["load wheel attempt=1", "load wheel attempt=2"]
    assert [part.request.name for part in builder.children(bike)] == ["wheel"]
    assert held_of(parts) == ["wheel"]


def test_a_holder_killed_while_its_callback_waits_for_a_part_holds_it_once_when_it_is_back(
    start: Start, workshop: Workshop
) -> None:
    system = start(shop(workshop, "parts"), shop(workshop, "shop"))
    app = system.open_registrar("app")
    connect_shop(app)
    workshop.shut("load wheel")
    future = app.load("shop/thing", Order("bike", ("parts/thing:wheel",)), block=False)
    workshop.wait("load wheel")
    old = kill(system, "shop")
    workshop.wait("load bike", 2)
    workshop.open("load wheel")
    bike = future.get(timeout=LIMIT_S)
    wait_respawned(system, "shop", old)
    eventually(lambda: held_of(system, "shop") == ["bell", "wheel"])
    assert [part.request.name for part in system.registrar("shop").children(bike)] == ["wheel"]
    eventually(lambda: len(system.registrar("shop").queries()) == 2)
    bike.unload()
    eventually(lambda: held_of(system, "shop") == ["bell"])


def test_a_holder_killed_when_its_callback_has_its_part_holds_each_part_once_when_it_is_back(
    start: Start, workshop: Workshop
) -> None:
    system = start(shop(workshop, "parts"), shop(workshop, "shop"))
    app = system.open_registrar("app")
    connect_shop(app)
    workshop.shut("made bike")
    future = app.load("shop/thing", Order("bike", ("parts/thing:wheel",)), block=False)
    workshop.wait("made bike")
    kill(system, "shop")
    workshop.wait("made bike", 2)
    workshop.open("made bike")
    bike = future.get(timeout=LIMIT_S)
    eventually(lambda: held_of(system, "shop") == ["bell", "wheel"])
    assert len(system.registrar("shop").children(bike)) == 1
    bike.unload()
    eventually(lambda: held_of(system, "shop") == ["bell"])


def test_a_provider_that_hangs_is_given_up_in_time_and_nothing_is_held_when_it_goes_on(
    parts: rr.System, builder: rr.Registrar, workshop: Workshop
) -> None:
    pid = builder.load("parts/thing", Order("keeps the link")).response.pid

    def load(_request: Any) -> None:
        builder.load("parts/thing", Order("wheel"), timeout_s=0.3)

    serve(builder, "bike", load=load)
    hang(pid)
    try:
        with pytest.raises(rr.LoadFailed, match="not loaded within"):
            builder.load("builder/bike", None, timeout_s=LIMIT_S)
    finally:
        os.kill(pid, signal.SIGCONT)
    eventually(lambda: held_of(parts) == [] and not actor_of(builder).busy())


# -- rings between processes -----------------------------------------------------------------------------------------


class Member(rr.Manager):
    """One of a ring: loads the same from the next, when the test lets it."""

    def __init__(self, root: str, next_one: str) -> None:
        self.work = Workshop(root)
        self.next_one = next_one

    @rr.server("link")
    def load_link(self, request: str) -> str:
        self.work.step(f"load {request} {self.registrar.name}")
        if request.startswith("end"):
            return request
        return self.registrar.load(f"{self.next_one}/link", request.removeprefix("via ")).response


def ring(start: Start, workshop: Workshop, size: int) -> rr.System:
    """Members in processes of their own, whose threads have connections to the next."""
    specs = [rr.ChildSpec(Member, id=f"m{n}", args=(str(workshop.root), f"m{(n + 1) % size}")) for n in range(size)]
    system = start(*specs)
    for n in range(size):
        system.registrar(f"m{n}").load(f"m{(n + 1) % size}/link", "end")
        system.registrar(f"m{n}").load(f"m{n}/link", "via end").unload()  # the first call of a thread takes the link
    return system


def is_at_rest(system: rr.System, size: int) -> bool:
    return all(
        [r.request for r in system.registrar(f"m{n}").resources()] == ["end"]
        and len(system.registrar(f"m{n}").queries()) == 1
        for n in range(size)
    )


@pytest.mark.parametrize("size", [2, 3])
def test_a_ring_of_processes_is_found(start: Start, workshop: Workshop, size: int) -> None:
    system = ring(start, workshop, size)
    app = system.open_registrar("app")
    for number in range(10):
        with pytest.raises(rr.CircularDependency) as caught:
            app.load("m0/link", f"ring {number}", timeout_s=LIMIT_S)
        assert set(caught.value.ring) == {f"m{n}/link" for n in range(size)}
    eventually(lambda: is_at_rest(system, size))


def test_a_ring_that_closes_at_several_places_at_once_is_found(start: Start, workshop: Workshop) -> None:
    size = 3
    system = ring(start, workshop, size)
    app = system.open_registrar("app")
    for number in range(10):
        for n in range(size):
            workshop.shut(f"load ring {number} m{n}")
        futures = [app.load(f"m{n}/link", f"ring {number}", timeout_s=LIMIT_S, block=False) for n in range(size)]
        workshop.wait(f"load ring {number} ", size)
        for n in range(size):
            workshop.open(f"load ring {number} m{n}")
        for future in futures:
            with pytest.raises(rr.CircularDependency):
                future.get(timeout=LIMIT_S)
    eventually(lambda: is_at_rest(system, size))
