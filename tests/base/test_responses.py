"""A response is of its server's type: checked where the callback returned it, not where somebody reads it first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest

import rr_actors as rr
from support import Calls, eventually, kill, serve, wait_respawned

Start = Callable[..., rr.System]


@dataclass(frozen=True)
class Lens:
    width: int


@dataclass(frozen=True)
class Feed:
    topic: str
    rate: float = 30.0
    mode: Literal["mono", "rgb"] = "rgb"
    lenses: tuple[Lens, ...] = ()


WRONG = [
    (None, "response: expected Feed, got None"),
    ("/images", "response: expected Feed, got str"),
    ([], "response: expected Feed, got a list"),
    ({}, "response.topic: expected str, got nothing"),
    (Feed(7), "response.topic: expected str, got int"),  # type: ignore[arg-type]
    (Feed("/images", mode="red"), "response.mode: expected one of 'mono', 'rgb', got"),  # type: ignore[arg-type]
    ({"topic": "/images", "lenses": [{"width": 1}, {"width": "wide"}]}, "response.lenses[1].width: expected int"),
]


@pytest.mark.parametrize(("response", "told"), WRONG)
def test_a_response_of_the_wrong_type_fails_the_load_naming_field_expected_and_got(
    app: rr.Registrar, provider: rr.Registrar, response: Any, told: str
) -> None:
    serve(provider, "camera", load=lambda request: response, response_type=Feed)

    with pytest.raises(rr.LoadFailed) as caught:
        app.load("provider/camera", "front")

    assert f"provider/camera: InvalidResponse: {told}" in str(caught.value)
    assert caught.value.trace[0].origin == "provider/camera"
    eventually(lambda: not provider.resources())
    assert list(app.queries()) == []


def test_a_type_read_from_the_callbacks_annotation_counts_as_well(app: rr.Registrar, provider: rr.Registrar) -> None:
    async def load(request: str) -> Feed:
        return Feed(request, rate="fast")  # type: ignore[arg-type]

    provider.register_server("camera", load)

    with pytest.raises(rr.LoadFailed, match=r"response\.rate: expected float, got str"):
        app.load("provider/camera", "front")


@pytest.mark.parametrize("response", [Feed("/a"), {"topic": "/a"}, Feed("/a", rate=30)])
def test_a_response_that_means_the_right_type_is_taken(
    app: rr.Registrar, provider: rr.Registrar, response: Any
) -> None:
    serve(provider, "camera", load=lambda request: response, response_type=Feed)

    assert app.load("provider/camera", "front").response == Feed("/a")


def test_what_the_callback_had_loaded_is_released_when_its_response_is_of_the_wrong_type(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    part = serve(provider, "part")

    def load(request: str) -> Feed:
        provider.load("provider/part", request)
        return request  # type: ignore[return-value]

    provider.register_server("camera", load)

    with pytest.raises(rr.LoadFailed, match="InvalidResponse"):
        app.load("provider/camera", "front")
    eventually(lambda: len(part.unloads) == 1)


def test_an_updated_response_of_the_wrong_type_is_told_at_the_sender_and_changes_nothing(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "camera", load=lambda request: Feed(request), response_type=Feed)
    query = app.load("provider/camera", "front")

    for target in (query, query.id, query.resource_id):
        with pytest.raises(rr.InvalidResponse, match=r"provider/camera: response\.topic: expected str, got int"):
            provider.update_response(target, {"topic": 7})

    assert [resource.response for resource in provider.resources()] == [Feed("front")]


@dataclass(frozen=True)
class Echo:
    of: int


def echo(request: int) -> Any:
    return {"of": request}


def without_return(request: int, response: Echo) -> None:
    """A recover callback that should have returned the response."""


class Changing(rr.Manager):
    """Its servers are declared otherwise once `changed` is there: a program that was edited between two starts."""

    def __init__(self, changed: Path) -> None:
        self.changed = changed

    def on_start(self) -> None:
        later = self.changed.exists()
        self.registrar.register_server("plain", echo)
        self.registrar.register_server("feed", echo, response_type=Feed if later else Echo)
        self.registrar.register_server("asked", echo, recover=without_return if later else None, response_type=Echo)


def test_a_stored_response_that_no_longer_fits_is_listed_as_plain_data_beside_the_others(
    start: Start, tmp_path: Path
) -> None:
    changed = tmp_path / "changed"
    system = start(rr.ChildSpec(Changing, id="shop", args=(changed,)))
    app = system.open_registrar("app")
    app.load("shop/plain", 1)
    app.load("shop/feed", 2)
    changed.touch()
    wait_respawned(system, "shop", kill(system, "shop"))

    listed = system.registrar("shop").resources()

    assert [resource.response for resource in listed] == [{"of": 1}, {"of": 2}]


def test_a_recover_callback_that_returns_the_wrong_type_has_lost_the_resource(start: Start, tmp_path: Path) -> None:
    changed = tmp_path / "changed"
    system = start(rr.ChildSpec(Changing, id="shop", args=(changed,)))
    app = system.open_registrar("app")
    heard = Calls()
    app.load("shop/asked", 1, on_status=heard)
    changed.touch()
    kill(system, "shop")

    (status,) = heard.wait()
    assert status.state is rr.State.FATAL
    assert status.message == "lost: shop/asked: InvalidResponse: response: expected Echo, got None"
