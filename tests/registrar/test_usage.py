"""What a registrar promises about the usage of resources (docs/planning.md, "What resources use")."""

from __future__ import annotations

import asyncio
import math
import threading
from collections.abc import Callable
from typing import Any

import pytest

import rr_actors as rr
from support import Calls, Gate, eventually, serve

Start = Callable[..., rr.System]


class Lamps(rr.Manager):
    """Says what its lamps use, from the request and the response."""

    @rr.server("lamp", recovery="keep")
    def light(self, request: str) -> int:
        return len(request)

    @light.usage
    def usage_of_lamp(self, request: str, response: int) -> dict[str, float]:
        if request == "broken":
            raise OSError("no meter")
        return {"watts": 2.5 * response, "attempt": rr.current().attempt}


def test_the_usage_of_each_loaded_resource_is_what_its_callback_returns(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    serve(provider, "lamp", usage=lambda request, response: {"watts": request})
    serve(provider, "silent")
    two, three = app.load("provider/lamp", 2), app.load("provider/lamp", 3)
    app.load("provider/silent", 1)
    assert provider.usage() == {two.resource_id: {"watts": 2}, three.resource_id: {"watts": 3}}
    assert provider.usage().failures == {}
    assert provider.usage(of=[two.resource_id, "unknown"]) == {two.resource_id: {"watts": 2}}
    two.unload()
    assert list(provider.usage()) == [three.resource_id]


def test_a_manager_declares_a_usage_callback_and_a_handle_asks_it(start: Start) -> None:
    system = start(rr.ChildSpec(Lamps, id="lamps"))
    app = system.open_registrar("app")
    hall, broken = app.load(Lamps.light, "hall"), app.load(Lamps.light, "broken")
    found = system.registrar("lamps").usage()
    assert found == {hall.resource_id: {"watts": 10.0, "attempt": 1}}
    assert list(found.failures) == [broken.resource_id]
    assert found.failures[broken.resource_id] == "lamps/lamp: usage: OSError: no meter"


def test_an_async_callback_is_asked_as_well(app: rr.Registrar, provider: rr.Registrar) -> None:
    async def usage(request: Any, response: Any) -> dict[str, float]:
        await asyncio.sleep(0)
        return {"watts": 1}

    serve(provider, "lamp", usage=usage)
    lamp = app.load("provider/lamp", 1)
    assert provider.usage() == {lamp.resource_id: {"watts": 1}}


def test_one_that_hangs_is_named_holds_up_no_other_and_does_not_begin_again(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    gate, begun = Gate(), Calls()

    def usage(request: int, response: Any) -> dict[str, float]:
        begun(request)
        if request < 70:  # more than begin together
            gate(request)
        return {"watts": request}

    serve(provider, "lamp", usage=usage)
    lamps = [app.load("provider/lamp", number) for number in range(72)]
    for _ in range(2):
        found = provider.usage(timeout_s=2.0)
        assert found == {lamp.resource_id: {"watts": lamp.request} for lamp in lamps[70:]}
        assert list(found.failures) == [lamp.resource_id for lamp in lamps[:70]]
        assert set(found.failures.values()) == {"provider/lamp: usage: not returned within 2 s"}
    assert sorted(begun) == sorted([*range(70), 70, 71, 70, 71])
    gate.open()
    assert eventually(lambda: len(provider.usage()) == 72)


def test_one_that_is_unloaded_meanwhile_is_left_out(app: rr.Registrar, provider: rr.Registrar) -> None:
    gate = Gate()

    def usage(request: Any, response: Any) -> dict[str, float]:
        gate()
        raise OSError("it is gone")

    serve(provider, "lamp", usage=usage)
    lamp = app.load("provider/lamp", 1)
    found: list[Any] = []
    asking = threading.Thread(target=lambda: found.append(provider.usage(timeout_s=30)))
    asking.start()
    gate.wait_arrived()
    lamp.unload()
    gate.open()
    asking.join()
    assert (found[0], found[0].failures) == ({}, {})


@pytest.mark.parametrize(
    ("answer", "got"),
    [
        (None, "got None (NoneType)"),
        ([1], "got [1] (list)"),
        ({"watts": math.nan}, "got nan (float) as 'watts'"),
        ({"watts": math.inf}, "got inf (float) as 'watts'"),
        ({"watts": 10**400}, "as 'watts'"),
        ({"watts": True}, "got True (bool) as 'watts'"),
        ({"watts": "3"}, "got '3' (str) as 'watts'"),
        ({3: 3}, "got 3 (int) as 3"),
        (dict.fromkeys(map(str, range(51)), 1), "(dict)"),
    ],
)
def test_what_is_no_dict_of_finite_numbers_is_named(
    app: rr.Registrar, provider: rr.Registrar, answer: Any, got: str
) -> None:
    serve(provider, "lamp", usage=lambda request, response: answer)
    lamp = app.load("provider/lamp", 1)
    found = provider.usage()
    assert found == {}
    why = found.failures[lamp.resource_id]
    assert why.startswith("provider/lamp: usage: InvalidResponse: expected a dict of at most 50 finite numbers by name")
    assert got in why


def test_wrong_arguments_and_wrong_places_are_refused(app: rr.Registrar, provider: rr.Registrar) -> None:
    refused = Calls()

    def usage(request: Any, response: Any) -> dict[str, float]:
        with pytest.raises(rr.UsageError, match=r"usage\(\) in its usage callback") as caught:
            provider.usage()
        refused(caught.value.details["registrar"])
        return {}

    serve(provider, "lamp", usage=usage)
    app.load("provider/lamp", 1)
    assert list(provider.usage().values()) == [{}]
    assert list(refused) == ["provider"]
    for wrong in ("an id", 3, [3]):
        with pytest.raises(rr.UsageError, match="usage: of: expected"):
            provider.usage(of=wrong)  # type: ignore[arg-type]
    for seconds in (-1, math.nan, None, "1"):
        with pytest.raises(rr.UsageError, match="timeout_s: expected seconds"):
            provider.usage(timeout_s=seconds)  # type: ignore[arg-type]
    with pytest.raises(rr.InvalidSpec, match="usage"):
        provider.register_server("other", lambda request: None, usage=lambda request: {})
    with pytest.raises(rr.InvalidSpec, match="usage"):
        provider.register_server("other", lambda request: None, usage=3)  # type: ignore[arg-type]
