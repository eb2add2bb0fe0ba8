"""A load callback with several parameters takes the fields of the request; one with none takes no request."""

from __future__ import annotations

import asyncio
import functools
from collections.abc import Callable
from typing import Any

import pytest

import rr_actors as rr


class Sensors(rr.Manager):
    """Its callbacks take the fields of their requests, and say what they got."""

    def __init__(self) -> None:
        self.seen: list[Any] = []

    @rr.server("range")
    def open_range(self, name: str, rate: float = 10.0) -> str:
        self.seen.append(("load", name, rate))
        return f"/{name}/{rate}"

    @open_range.unload
    def close_range(self, name: str, rate: float, response: str) -> None:
        self.seen.append(("unload", name, rate, response))

    @open_range.status
    def range_status(self, name: str, status: rr.Status) -> None:
        self.seen.append(("status", name, status.message))

    @open_range.recover
    def recover_range(self, name: str, rate: float, topic: str) -> str:
        return f"{topic} again at {rate}"

    @rr.server("all")
    async def open_all(self) -> list[str]:
        self.seen.append(("load all",))
        return ["lidar", "sonar"]

    @open_all.unload
    async def close_all(self) -> None:
        self.seen.append(("unload all",))

    @open_all.recover
    def recover_all(self, response: list[str]) -> list[str]:
        return [*response, "again"]


@pytest.fixture
def sensors(system: rr.System) -> rr.ActorRef:
    system.start_child(rr.ChildSpec(Sensors, id="sensors"))
    return system.ref("sensors")


def seen(sensors: rr.ActorRef) -> list[Any]:
    return sensors.proxy().seen.get(timeout=5)


def test_several_parameters_take_the_fields_and_the_response(
    app: rr.Registrar, system: rr.System, sensors: rr.ActorRef
) -> None:
    query = app.load("sensors/range", {"name": "lidar", "rate": 5})
    assert query.response == "/lidar/5.0"
    system.registrar("sensors").send_status(query.resource_id, rr.Status(rr.State.WARNING, "dusty"))
    query.wait_status(rr.State.WARNING, timeout_s=5)
    query.unload()
    assert seen(sensors) == [
        ("load", "lidar", 5.0),
        ("status", "lidar", "dusty"),
        ("unload", "lidar", 5.0, "/lidar/5.0"),
    ]


def test_defaults_are_filled_in_before_requests_are_compared(app: rr.Registrar, sensors: rr.ActorRef) -> None:
    first = app.load("sensors/range", {"name": "lidar"})
    same = app.load(Sensors.open_range, {"rate": 10, "name": "lidar"})
    other = app.load("sensors/range", {"name": "lidar", "rate": 11})
    assert first.resource_id == same.resource_id != other.resource_id
    assert (first.request.name, first.request.rate) == ("lidar", 10.0)


def test_no_parameters_take_no_request(app: rr.Registrar, sensors: rr.ActorRef) -> None:
    query = app.load("sensors/all")
    assert query.response == ["lidar", "sonar"]
    assert app.load(Sensors.open_all).resource_id == app.load("sensors/all", {}).resource_id == query.resource_id
    app.unload_all()
    assert seen(sensors) == [("load all",), ("unload all",)]


def test_no_parameters_take_no_request_awaited(app: rr.Registrar, sensors: rr.ActorRef) -> None:
    async def use() -> None:
        async with await app.load_async("sensors/all") as query:
            assert query.response == ["lidar", "sonar"]

    asyncio.run(use())


def test_a_connection_loads_by_fields_and_without_a_request(
    app: rr.Registrar, system: rr.System, sensors: rr.ActorRef
) -> None:
    with rr.connect(system.state_dir) as connection:
        registrar = connection.open_registrar("desk")
        assert registrar.load("sensors/all").response == ["lidar", "sonar"]
        assert registrar.load("sensors/range", {"name": "sonar"}).response == "/sonar/10.0"


def test_what_takes_fields_is_recovered_after_a_respawn(
    app: rr.Registrar, system: rr.System, sensors: rr.ActorRef
) -> None:
    ranged, everything = app.load("sensors/range", {"name": "lidar"}), app.load("sensors/all")
    sensors.kill()
    ranged.wait_status(rr.State.UPDATE, timeout_s=30)
    everything.wait_status(rr.State.UPDATE, timeout_s=30)
    assert ranged.response == "/lidar/10.0 again at 10.0"
    assert everything.response == ["lidar", "sonar", "again"]
    ranged.unload()


@pytest.mark.parametrize(
    ("server", "request_", "error"),
    [
        ("range", "lidar", r"expected open_range\(name, rate\), got str"),
        ("range", {}, "request.name: expected str, got nothing"),
        ("range", {"name": "a", "rat": 3}, "unknown field 'rat'; did you mean 'rate'"),
        ("range", {"name": "a", "rate": "fast"}, "request.rate: expected float"),
        ("all", {"name": "a"}, "unknown field 'name'"),
    ],
)
def test_fields_that_do_not_fit_are_named(
    app: rr.Registrar, sensors: rr.ActorRef, server: str, request_: Any, error: str
) -> None:
    with pytest.raises(rr.InvalidRequest, match=error):
        app.load(f"sensors/{server}", request_)


def whole(request: Any, rate: float = 10.0) -> Any:
    return request


def by_name(name: str, *, rate: float = 10.0, tags: list[str] = ["a"], near: float = None) -> Any:  # type: ignore[assignment]  # noqa: B006, RUF013
    return [name, rate, tags, near]


def with_driver(driver: str, name: str, rate: float) -> Any:
    return [driver, name, rate]


def positional(name: str, rate: float = 10.0, /) -> Any:
    return name


def wrapped(function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def wrapper(*given: Any, **keywords: Any) -> Any:
        return function(*given, **keywords)

    return wrapper


@pytest.mark.parametrize(
    ("load", "request_", "response"),
    [
        (whole, {"x": 1}, {"x": 1}),
        (positional, "x", "x"),
        (lambda name, number=7: [name, number], "x", ["x", 7]),  # the default captures a variable
        (lambda name, rate: [name, rate], {"rate": 1, "name": "x"}, ["x", 1]),
        (by_name, {"name": "x"}, ["x", 10.0, ["a"], None]),
        (by_name, {"name": "x", "near": 3}, ["x", 10.0, ["a"], 3.0]),
        (wrapped(by_name), {"name": "x", "rate": 2}, ["x", 2.0, ["a"], None]),
        (functools.partial(with_driver, "usb"), {"name": "x", "rate": 2}, ["usb", "x", 2.0]),
        (functools.partial(with_driver, rate=3), {"driver": "a", "name": "x"}, ["a", "x", 3]),
    ],
)
@pytest.mark.parametrize("unload", [None, lambda request, response: None, lambda response: None, lambda: None])
def test_a_callback_gets_the_fields_or_the_whole_request_as_its_parameters_say(
    app: rr.Registrar,
    provider: rr.Registrar,
    load: Callable[..., Any],
    request_: Any,
    response: Any,
    unload: Callable[..., Any] | None,
) -> None:
    if unload is not None and unload.__code__.co_argcount < 2 and request_ in ("x", {"x": 1}):
        with pytest.raises(rr.InvalidSpec, match="unload: expected a callable that takes"):
            provider.register_server("thing", load, unload)
        return
    provider.register_server("thing", load, unload)
    query = app.load("provider/thing", request_)
    assert query.response == response
    query.unload()


def test_a_server_that_is_registered_at_a_handle_takes_fields(
    app: rr.Registrar, system: rr.System, sensors: rr.ActorRef
) -> None:
    def open_it(name: str, rate: float = 10.0) -> str:
        return f"{name} {rate}"

    system.registrar("sensors").register_server("sent", open_it, lambda name, response: None)
    query = app.load("sensors/sent", {"name": "x"})
    assert query.response == "x 10.0"
    query.unload()


def test_what_the_fields_do_not_give_is_refused_when_it_is_registered(provider: rr.Registrar) -> None:
    def other(name: str, speed: float, response: Any) -> None: ...

    with pytest.raises(rr.InvalidSpec, match=r"unload: .*takes \(name, rate, response\), got other\(name"):
        provider.register_server("thing", with_two, other)

    def captures(name: str, driver: Any = object()) -> None: ...  # noqa: B008

    with pytest.raises(rr.InvalidSpec, match="parameter driver: expected a default that a request can have"):
        provider.register_server("thing", captures)
    assert provider.servers() == []


def with_two(name: str, rate: float) -> Any:
    return [name, rate]
