"""Client: what a registrar says over its link to a provider, and when."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import effects as e
from rr_actors.registrar.model.messages import Unload
from support import eventually, serve


def test_what_was_decided_for_a_link_does_not_go_over_the_next(
    app: rr.Registrar, provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The provider runs on, and the next link is there before its consumer has taken up that the first was lost."""
    serve(provider, "thing")
    query = app.load("provider/thing", "x")
    actor = app._actor
    post, waiting = actor.post, list[Any]()

    def hold_back(command: Any, **_more: bool) -> None:
        (waiting.append if isinstance(command, (c.LinkLost, c.Reconcile)) else post)(command)

    async def lose_the_link() -> None:
        link = actor.client("provider").link
        assert link is not None
        link.close()

    async def act_and_go_on() -> None:
        actor.monitor._runner.do([e.Request("provider", Unload(query.id, "app"))])
        for command in waiting:
            post(command)

    monkeypatch.setattr(actor, "post", hold_back)
    actor.node.dispatcher.run(lose_the_link(), timeout_s=10)
    eventually(lambda: [type(command) for command in waiting] == [c.LinkLost, c.Reconcile])
    actor.node.dispatcher.run(act_and_go_on(), timeout_s=10)
    monkeypatch.undo()

    asyncio.run(app.load_async("provider/thing", "x"))  # by the same link
    assert [list(resource.holders) for resource in provider.resources()] == [["app", "app"]]
