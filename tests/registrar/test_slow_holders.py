"""Statuses wait in bounded numbers at a holder that is slow with them (docs/semantics.md, "Status")."""

from __future__ import annotations

import logging
from collections.abc import Callable

import pytest

import rr_actors as rr
from rr_actors.registrar.model.catalog import Catalog
from support import Calls, Gate, Workshop, eventually, kill, serve, wait_respawned
from support_managers import Order, Shop

Start = Callable[..., rr.System]

SENT = 3_000
WINDOW = 1_000
"""How many statuses of one query a holder has at a time, at most."""


def send(provider: rr.Registrar, query: rr.Query, count: int = SENT) -> list[str]:
    for number in range(count):
        provider.send_status(query.resource_id, rr.Status(rr.State.WARNING, str(number)))
    return [str(number) for number in range(count)]


def test_a_thousand_statuses_wait_at_a_slow_holder_and_the_rest_at_the_provider_and_all_are_heard_in_order(
    app: rr.Registrar, provider: rr.Registrar, caplog: pytest.LogCaptureFixture
) -> None:
    serve(provider, "camera")
    gate, heard = Gate(), Calls()

    def hear(status: rr.Status) -> None:
        gate()
        heard(status)

    query = app.load("provider/camera", "front", on_status=hear)
    with caplog.at_level(logging.WARNING):
        sent = send(provider, query)
        eventually(lambda: app.stats()["unheard"] == WINDOW)
        assert provider.stats()["notices"] == SENT
    behind = [record.getMessage() for record in caplog.records if "is behind with its statuses" in record.getMessage()]
    assert len(behind) == 1
    assert "app" in behind[0]
    assert query.id in behind[0]
    gate.open()
    assert [status.message for status in heard.wait(SENT)] == sent
    eventually(lambda: (app.stats()["unheard"], provider.stats()["notices"]) == (0, 0))


def test_beyond_its_bound_the_provider_drops_the_oldest_statuses_that_wait_and_says_so(
    app: rr.Registrar, provider: rr.Registrar, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Catalog, "backlog", 2 * WINDOW)
    serve(provider, "camera")
    gate, heard = Gate(), Calls()

    def hear(status: rr.Status) -> None:
        gate()
        heard(status)

    query = app.load("provider/camera", "front", on_status=hear)
    with caplog.at_level(logging.ERROR):
        sent = send(provider, query)
    assert provider.stats()["notices"] == 2 * WINDOW
    gate.open()
    assert [status.message for status in heard.wait(2 * WINDOW)] == sent[:WINDOW] + sent[2 * WINDOW :]
    who = f"app (query {query.id})"
    eventually(lambda: [who in text for text in caplog.messages if "are dropped" in text] == [True])


def test_a_slow_status_callback_hears_all_statuses_of_its_own_resource_in_order(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    gate, own, heard = Gate(), Calls(), Calls()

    def hear(_request: str, status: rr.Status) -> None:
        gate()
        own(status.message)

    provider.register_server("camera", lambda _: None, status=hear)
    query = app.load("provider/camera", "front", on_status=lambda status: heard(status.message))
    sent = send(provider, query)
    gate.open()
    assert heard.wait(SENT) == sent
    assert own.items == sent
    eventually(lambda: provider.stats()["notices"] == 0)


def test_a_holder_that_is_slow_with_one_query_hears_of_others_at_once(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "camera")
    gate, heard = Gate(), Calls()
    slow = app.load("provider/camera", "front", on_status=lambda _: gate())
    quick = app.load("provider/camera", "rear", on_status=heard)
    send(provider, slow, WINDOW + 1)
    provider.send_status(quick.resource_id, rr.Status(rr.State.WARNING, "low light"))
    (status,) = heard.wait()
    assert status.message == "low light"
    gate.open()


def test_a_query_that_is_released_while_its_statuses_wait_leaves_none_of_them(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "camera")
    gate = Gate()
    query = app.load("provider/camera", "front", on_status=lambda _: gate())
    send(provider, query)
    query.unload()
    assert provider.stats()["notices"] == 0
    gate.open()
    eventually(lambda: app.stats()["unheard"] == 0)


def test_statuses_that_wait_at_a_provider_survive_its_death(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    gate, heard = Gate(), Calls()

    def hear(status: rr.Status) -> None:
        gate()
        heard(status.message)

    query = system.open_registrar("app").load("shop/thing", Order("wheel"), on_status=hear)
    sent = send(system.registrar("shop"), query, WINDOW + 200)
    wait_respawned(system, "shop", kill(system, "shop"))
    gate.open()
    assert heard.wait(len(sent)) == sent
    eventually(lambda: system.registrar("shop").stats()["notices"] == 0)
