"""What a registrar does takes for each of many as much as for each of few. Bytecodes and bytes are counted."""

from __future__ import annotations

import itertools
import tracemalloc
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.actors.turns import has_a_turn
from rr_actors.registrar.core.decide import decide
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.catalog import Catalog, Server
from rr_actors.registrar.model.effects import SendRequest
from rr_actors.registrar.model.messages import Unload, Unloaded
from rr_actors.registrar.model.rows import Held, Hold, Peer, Phase, Resource, Row, ServedQuery, State, content_of
from rr_actors.runtime import event_loop
from support import LIMIT_S, serve
from support_inside import actor_of
from support_steps import steps_of, steps_on_loop


def whole_of(parts: int) -> tuple[Catalog, list[Any]]:
    """Return a catalog whose resource with so many parts has just been unloaded, and the effects of that."""
    rows: list[Row] = [
        Peer("parts"),
        Resource("r", "car", b"", b"", Phase.UNLOADING, State.OK, "", 1),
        ServedQuery("q", "r", "app", "", 1, 1),
    ]
    rows += [Held(f"p{n}", "parts", "wheel", b"", b"", f"w{n}", "r", 1, n, Hold.HELD, State.OK) for n in range(parts)]
    catalog = Catalog("shop", content_of(rows))
    catalog.up["parts"] = 1
    decide(catalog, [(c.Register(Server("car"), "event"), None)])
    return catalog, decide(catalog, [(c.CallbackEnded("unload", "r", 1), None)]).effects


def release_next(catalog: Catalog, effects: list[Any]) -> list[Any]:
    """Answer the release that was sent, and return the effects of that."""
    sent = [e.message.query_id for e in effects if isinstance(e, SendRequest) and isinstance(e.message, Unload)]
    return decide(catalog, [(Unloaded(id), "parts") for id in sent]).effects


def test_the_release_of_one_of_many_parts_takes_as_much_as_of_one_of_few() -> None:
    def cost(parts: int) -> tuple[int, int]:
        catalog, effects = whole_of(parts)
        steps, effects = steps_of(lambda: release_next(catalog, effects))
        tracemalloc.start()
        try:
            release_next(catalog, effects)
            return steps, tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    (few, few_bytes), (many, many_bytes) = cost(10), cost(2_000)
    assert many <= few * 1.1
    assert many_bytes <= few_bytes + 4_000, "it copies the ids of the parts"


@pytest.mark.parametrize("look", ["stats", "owed", "fetch_state"])
def test_a_look_at_one_of_many_queries_takes_as_many_steps_as_at_one_of_few(
    app: rr.Registrar, provider: rr.Registrar, look: str
) -> None:
    serve(provider, "thing")
    newest = app.load_all([("provider/thing", n) for n in range(10)])[-1].id

    async def look_now() -> int:  # on the loop, where the look is
        arguments = (newest,) if look == "fetch_state" else ()
        return steps_of(lambda: getattr(app, look)(*arguments))[0]

    def steps() -> int:
        dispatcher = event_loop.acquire()
        try:
            return dispatcher.run(look_now(), LIMIT_S)
        finally:
            event_loop.release()

    few = steps()
    newest = app.load_all([("provider/thing", n) for n in range(10, 1_000)])[-1].id
    assert steps() <= few * 1.1


def test_to_open_and_close_one_of_many_registrars_takes_as_many_steps_as_one_of_few(system: rr.System) -> None:
    config = rr.RegistrarConfig(durability="none")

    def session() -> None:
        system.open_registrar("session", config).close()

    def steps() -> tuple[int, int]:
        return min(steps_on_loop(session) for _ in range(5)), steps_of(has_a_turn)[0]

    for number in range(20):
        system.open_registrar(f"few-{number}", config)
    few = steps()
    for number in range(500):
        system.open_registrar(f"many-{number}", config)
    many = steps()
    assert many[0] <= few[0] * 1.1
    assert many[1] == few[1], "each load and unload asks whether this thread is deciding"


def test_a_load_through_a_long_chain_takes_the_loop_as_many_steps_for_each_link_as_through_a_short_one(
    system: rr.System, app: rr.Registrar
) -> None:
    config = rr.RegistrarConfig(durability="none")
    links = [system.open_registrar(f"link{number}", config) for number in range(60)]
    for registrar, below in zip(links, [*links[1:], None], strict=True):

        def load(request: int, registrar: rr.Registrar = registrar, below: rr.Registrar | None = below) -> None:
            if below is not None:
                registrar.load(f"{below.name}/link", request)

        serve(registrar, "link", load)
    app.load("link0/link", 0).unload()  # connects

    def steps(first: int) -> float:
        def load() -> None:
            app.load(f"link{first}/link", next(requests))

        return min(steps_on_loop(load) for _ in range(3)) / (len(links) - first)

    requests = itertools.count(1)
    assert steps(0) <= steps(50) * 1.3  # what waits for 50 ms is written meanwhile, too


def test_of_many_registrars_that_share_locks_each_says_that_its_thread_has_a_turn(system: rr.System) -> None:
    registrars = [system.open_registrar(f"r{number}", rr.RegistrarConfig(durability="none")) for number in range(100)]
    for registrar in registrars:
        assert not has_a_turn()
        with actor_of(registrar).lock:
            assert has_a_turn()
    for registrar in registrars[:-1]:
        registrar.close()
    with actor_of(registrars[-1]).lock:
        assert has_a_turn(), "the lock of an open registrar counts, also if a closed one shared it"
