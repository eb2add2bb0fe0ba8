"""Told: a thread that ran a callback writes how it has ended, and answers who waits; the loop hears of it later."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import msgspec
import pytest

import rr_actors as rr
from rr_actors.actors import inbox
from rr_actors.actors.short_cuts import ShortCuts
from support import Calls, eventually


class Order(msgspec.Struct):
    """A request that can be written in two ways."""

    name: str
    number: int = 3


@pytest.fixture
def shy(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop does not look at what is noted until something else wakes it."""
    monkeypatch.setattr(inbox, "_LOOK_SOON_S", 3600.0)


@pytest.fixture
def told(monkeypatch: pytest.MonkeyPatch) -> Calls:
    """Whether the threads that ran callbacks told it themselves, one after another."""
    calls = Calls()
    tell: Callable[[ShortCuts, Any], bool] = ShortCuts.tell

    def noted(short_cuts: ShortCuts, done: Any) -> bool:
        outcome = tell(short_cuts, done)
        calls(outcome)
        return outcome

    monkeypatch.setattr(ShortCuts, "tell", noted)
    return calls


def test_who_asks_the_same_in_other_words_meanwhile_is_answered_too(
    app: rr.Registrar, provider: rr.Registrar, shy: None, told: Calls
) -> None:
    loads = Calls()

    def load(request: Order) -> str:
        loads(request.name)
        return threading.current_thread().name

    provider.register_server("thing", load)
    app.load("provider/thing", Order("before"))
    eventually(lambda: provider._actor.inbox.is_quiet)

    first = app.load("provider/thing", {"name": "x", "number": 3})
    assert told.wait(2) == [False, True]
    second: Calls = Calls()
    thread = threading.Thread(target=lambda: second(app.load("provider/thing", {"name": "x"}, timeout_s=10.0)))
    thread.start()
    eventually(lambda: len(provider._actor.catalog.holders.get(first.resource_id, ())) == 2)
    provider.resources()  # which takes up what is noted
    thread.join()

    (query,) = second
    assert (query.resource_id, query.response) == (first.resource_id, first.response)
    assert loads.items == ["before", "x"]
    assert sorted(len(resource.queries) for resource in provider.resources()) == [1, 2]
