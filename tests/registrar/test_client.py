"""Client: what a registrar says over its link to a provider, and when."""

from __future__ import annotations

import asyncio
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.registrar.engine.effect_runner import EffectRunner
from rr_actors.registrar.links.provider_link import FetchQueries
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import effects as e
from rr_actors.registrar.model.messages import Fetched, Unload
from support import LIMIT_S, eventually, serve
from support_inside import HeldBack, actor_of


def test_what_was_decided_for_a_link_does_not_go_over_the_next(
    app: rr.Registrar, provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The provider runs on, and the next link is there before its consumer has taken up that the first was lost."""
    serve(provider, "thing")
    query = app.load("provider/thing", "x")
    actor = actor_of(app)
    post, waiting = actor.post, list[Any]()

    def hold_back(command: Any, **_more: bool) -> None:
        (waiting.append if isinstance(command, (c.LinkLost, c.Reconcile)) else post)(command)

    async def lose_the_link() -> None:
        link = actor.client("provider").link
        assert link is not None
        link.close()

    async def act_and_go_on() -> None:
        EffectRunner(actor, actor.consumers, actor.servers, actor.clients).do(
            [e.SendRequest("provider", Unload(query.id, "app"))]
        )
        for command in waiting:
            post(command)

    monkeypatch.setattr(actor, "post", hold_back)
    actor.node.dispatcher.run(lose_the_link(), timeout_s=10)
    eventually(lambda: [type(command) for command in waiting] == [c.LinkLost, c.Reconcile])
    actor.node.dispatcher.run(act_and_go_on(), timeout_s=10)
    monkeypatch.undo()

    asyncio.run(app.load_async("provider/thing", "x"))  # by the same link
    assert [list(resource.holders) for resource in provider.resources()] == [["app", "app"]]


def test_a_fetch_behind_another_returns_also_what_was_loaded_since_that_was_answered(
    app: rr.Registrar, provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    held_back = HeldBack(monkeypatch, Fetched)
    serve(provider, "thing")
    first = app.load("provider/thing", "first")
    actor = actor_of(app)
    client, call = actor.client("provider"), actor.node.dispatcher.call
    heard = list[list[str]]()

    def hear(queries: Any, _error: Any) -> None:
        heard.append(sorted(query.query_id for query in queries))

    held_back.on = True
    call(client.deliver, FetchQueries(hear))
    eventually(lambda: held_back.messages)
    second = app.load("provider/thing", "second")
    held_back.on = False
    for _ in range(2):
        call(client.deliver, FetchQueries(hear))
    call(held_back.messages[0])

    eventually(lambda: len(heard) == 3)
    assert heard == [[first.id], *[sorted((first.id, second.id))] * 2]
    assert not client._asked  # a stopped provider is no error, as nobody asks for anything there


def test_a_fetch_ends_when_its_registrar_is_closed(
    app: rr.Registrar, provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    held_back = HeldBack(monkeypatch, Fetched)
    serve(provider, "thing")
    app.load("provider/thing", "x")
    client = actor_of(app).client("provider")
    held_back.on = True
    with ThreadPoolExecutor(1) as thread:
        fetching = thread.submit(app.fetch_queries, "provider", timeout_s=None)
        eventually(lambda: held_back.messages)
        app.close()
        try:
            with pytest.raises(rr.RegistrarDown, match="'app': closed"):
                fetching.result(LIMIT_S)
        finally:
            for read in held_back.messages:
                actor_of(app).node.dispatcher.call(read)
    heard: list[Any] = []

    async def fetch() -> None:
        client.deliver(FetchQueries(lambda *answer: heard.append(answer)))  # one that the loop takes after the close

    actor_of(app).node.dispatcher.run(fetch(), timeout_s=LIMIT_S)
    assert [type(error) for _, error in heard] == [rr.RegistrarDown]
