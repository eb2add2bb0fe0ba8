"""What is over the limit of a frame is refused, or told as far as it fits, and the link stays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import pytest

import rr_actors as rr
from rr_actors.registrar.servers.server_actor import ServerActor
from support import Workshop, eventually, serve
from support_inside import actor_of, on_loop
from support_managers import Shop

Start = Callable[..., rr.System]

LIMIT = 100_000
BIG = "x" * 2 * LIMIT


class Pair:
    """A provider of this process, and a consumer of another, which holds one thing of it."""

    def __init__(self, start: Start, workshop: Workshop, limit: int = LIMIT) -> None:
        shop = rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),))
        self.system = start(shop, config=rr.SystemConfig(frame_limit_bytes=limit))
        self.provider = self.system.open_registrar("provider")
        serve(self.provider, "thing", lambda request: request)
        self.shop = self.system.registrar("shop")
        self.held = self.shop.load("provider/thing", "held")
        self._link = self.link

    @property
    def link(self) -> Any:
        return on_loop(self.provider, lambda: actor_of(self.provider).consumers.link_of("shop"))

    def lives(self) -> bool:
        """Whether the link is the one there was, and others are served by it."""
        return self.shop.load("provider/thing", "another").response == "another" and self.link is self._link


@pytest.fixture
def pair(start: Start, workshop: Workshop) -> Pair:
    return Pair(start, workshop)


@pytest.fixture
def higher_limit(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """Responses are taken as they were before the limit was lowered."""
    monkeypatch.setattr(ServerActor, "too_long", lambda *_: None)
    return monkeypatch


def test_a_response_that_is_longer_than_a_frame_may_be_by_now_is_refused_to_who_would_hold_it(
    pair: Pair, higher_limit: pytest.MonkeyPatch
) -> None:
    serve(pair.provider, "big", lambda _request: BIG)
    here = pair.system.open_registrar("app").load("provider/big", "x")
    error = rf"provider/big: NotSerializable: Loaded of \d+ bytes is over the limit of {LIMIT} \(frame_limit_bytes\)"
    for _ in "by a line", "by the link":
        with pytest.raises(rr.LoadFailed, match=error) as caught:
            pair.shop.load("provider/big", "x", timeout_s=5.0)
        assert [frame.origin for frame in caught.value.trace] == ["provider/big"]
    with pytest.raises(rr.LoadFailed, match=error):
        pair.shop.load("provider/big", "x", timeout_s=5.0, block=False).get(timeout=10.0)
    assert pair.lives()
    (holders,) = [info.holders for info in pair.provider.resources() if info.id == here.resource_id]
    assert holders == ("app",)
    assert [query.request for query in pair.shop.queries()] == ["held", "another"]


def test_the_error_for_a_picture_in_a_request_or_a_response_says_that_it_goes_by_a_stream(pair: Pair) -> None:
    serve(pair.provider, "picture", lambda _request: BIG)
    for request in (BIG, "x"):
        with pytest.raises(rr.RrError, match=r"pictures and scans by a stream.* it is a row on disk"):
            pair.shop.load("provider/picture", request, timeout_s=5.0)
    assert pair.lives()


def test_an_update_that_is_too_long_is_heard_without_its_response(pair: Pair, higher_limit: pytest.MonkeyPatch) -> None:
    pair.provider.update_response(pair.held.resource_id, BIG, "grown")
    eventually(lambda: [query.state for query in pair.shop.queries()] == [rr.State.UPDATE])
    assert [query.response for query in pair.shop.queries()] == ["held"]
    assert pair.lives()


def test_a_list_of_what_is_held_that_has_one_too_long_has_that_without_its_response(
    pair: Pair, higher_limit: pytest.MonkeyPatch
) -> None:
    second = pair.shop.load("provider/thing", "second")
    pair.provider.update_response(pair.held.resource_id, BIG)
    assert [(query.id, query.response) for query in pair.shop.fetch_queries("provider", timeout_s=5.0)] == [
        (pair.held.id, None),
        (second.id, "second"),
    ]
    assert pair.lives()
    assert [query.response for query in pair.shop.queries()] == ["held", "second", "another"]


def test_a_list_of_many_is_cut_until_it_fits(start: Start, workshop: Workshop) -> None:
    pair = Pair(start, workshop, 20_000)
    app = pair.system.open_registrar("app")
    pair.shop.register_server("echo", lambda request: request)
    held = [app.load("shop/echo", f"{number:0100}").id for number in range(100)]
    link = actor_of(app).clients["shop"].link
    assert [query.id for query in app.fetch_queries("shop", timeout_s=5.0)] == held
    assert actor_of(app).clients["shop"].link is link


def test_a_failure_that_has_come_by_very_many_registrars_is_told_with_those_that_fit(pair: Pair) -> None:
    def load(depth: int) -> Any:
        if not depth:
            raise ValueError("v" * 5_000)
        return pair.provider.load("provider/deep", depth - 1).response

    pair.provider.register_server("deep", load)
    with pytest.raises(rr.LoadFailed, match="provider/deep: ValueError: vvv") as caught:
        pair.shop.load("provider/deep", 30, timeout_s=5.0)
    assert 1 <= len(caught.value.trace) < 30
    assert caught.value.trace[0].message.startswith("ValueError: vvv")
    assert pair.lives()


def test_types_that_are_too_long_to_be_told_are_refused_at_registration(pair: Pair) -> None:
    @dataclass
    class Heavy:  # it travels by value, and its text with it
        name: str

        weight: ClassVar[str] = BIG

    with pytest.raises(rr.NotSerializable, match=rf"provider/heavy: types: \d+ bytes are over the limit of {LIMIT}"):
        pair.provider.register_server("heavy", lambda heavy: heavy.name, request_type=Heavy)
    assert pair.provider.servers() == ["provider/thing"]
    assert pair.lives()
