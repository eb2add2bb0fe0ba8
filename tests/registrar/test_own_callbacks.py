"""A callback that would wait for itself hears so at once; what nothing waits for may close, stop and unload."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from typing import Any

import pytest

import rr_actors as rr
from support import LIMIT_S, Calls, Gate, eventually, kill, serve

Act = Callable[[rr.System, rr.Registrar, str], None]


def close(_system: rr.System, provider: rr.Registrar, _resource_id: str) -> None:
    provider.close()


def unregister(_system: rr.System, provider: rr.Registrar, _resource_id: str) -> None:
    provider.unregister_server("thing")


def stop(system: rr.System, _provider: rr.Registrar, _resource_id: str) -> None:
    system.stop()


def force(_system: rr.System, provider: rr.Registrar, resource_id: str) -> None:
    provider.unload(resource_id, force=True)


@pytest.mark.parametrize("role", ["load", "unload"])
@pytest.mark.parametrize(
    ("act", "what", "instead"),
    [
        (close, "registrar 'provider': close()", "start a thread for it"),
        (unregister, "registrar 'provider': unregister_server('thing')", "start a thread for it"),
        (stop, "system 'system': stop()", "start a thread for it"),
        (force, "registrar 'provider': the forced unload of", "with block=False it does not wait"),
    ],
)
@pytest.mark.timeout(LIMIT_S)
def test_a_callback_that_would_wait_for_itself_hears_what_waits_for_what_and_what_to_do_instead(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, role: str, act: Act, what: str, instead: str
) -> None:
    errors = Calls()

    def callback(*_: Any) -> None:
        with pytest.raises(rr.UsageError) as caught:
            act(system, provider, rr.current().resource_id)
        errors(caught.value)

    callbacks: dict[str, Any] = {"load": lambda _request: None, role: callback}
    provider.register_server("thing", **callbacks)
    query = app.load("provider/thing", "x")
    resource = query.resource_id
    query.unload()
    (error,) = errors
    assert str(error).startswith(what)
    assert f"the callback that {role}s resource {resource} of provider/thing" in str(error)
    assert instead in str(error)
    assert error.details == {"registrar": "provider", "server": "provider/thing", "resource_id": resource}
    assert app.queries() == provider.resources() == []  # both went on
    assert provider.servers() == ["provider/thing"]


@pytest.mark.timeout(LIMIT_S)
def test_so_does_a_coroutine_callback_that_waits_in_a_thread(app: rr.Registrar, provider: rr.Registrar) -> None:
    async def load(_request: Any) -> None:
        await asyncio.to_thread(provider.close)

    provider.register_server("thing", load)
    with pytest.raises(rr.LoadFailed, match=r"close\(\) waits for the callback that loads resource"):
        app.load("provider/thing", "x")


class Recovered(rr.Manager):
    @rr.server("thing")
    def load_thing(self, request: str) -> str:
        return request

    @load_thing.recover
    def recover_thing(self, request: str, response: str) -> str:
        try:
            self.registrar.unregister_server("thing")
        except rr.UsageError as error:
            return str(error)
        return "not refused"


@pytest.mark.timeout(2 * LIMIT_S)
def test_so_does_a_recover_callback(start: Callable[..., rr.System]) -> None:
    system = start(rr.ChildSpec(Recovered, id="things"))
    query = system.open_registrar("app").load("things/thing", "x")
    kill(system, "things")
    eventually(lambda: query.response != "x")
    assert f"the callback that recovers resource {query.resource_id} of things/thing" in query.response


@pytest.mark.parametrize("act", [close, unregister, stop, force])
def test_a_thread_that_a_callback_starts_for_it_waits_until_the_callback_has_returned(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, gate: Gate, act: Act
) -> None:
    threads: list[threading.Thread] = []

    def load(_request: Any) -> None:
        threads.append(threading.Thread(target=act, args=(system, provider, rr.current().resource_id)))
        threads[0].start()
        gate()

    served = serve(provider, "thing", load)
    with pytest.raises(rr.RrError):  # taken away while it was loading
        app.load("provider/thing", "x")
    assert threads[0].is_alive()
    gate.open()
    threads[0].join(LIMIT_S)
    assert not threads[0].is_alive()
    assert len(served.unloads) == 1


def test_a_callback_knows_the_name_of_its_resource(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "thing", lambda _request: rr.current().name)
    assert app.load("provider/thing", {"device": "front"}).response == 'provider/thing {"device":"front"}'
    assert app.load("provider/thing", "x" * 100).response == f'provider/thing "{"x" * 100}"'
    long = app.load("provider/thing", "x" * 1000).response
    assert len(long) <= 500


@pytest.mark.parametrize("act", [close, unregister, stop, force])
@pytest.mark.timeout(LIMIT_S)
def test_a_status_callback_may_do_all_of_it(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar, act: Act
) -> None:
    ended = Calls()

    def on_status(_request: Any, _status: rr.Status) -> None:
        act(system, provider, rr.current().resource_id)
        ended("well")

    serve(parts, "part")
    served = serve(provider, "thing", lambda part: provider.load("parts/part", part).id, status=on_status)
    app.load("provider/thing", "x")
    parts.send_status(parts.resources()[0].id, rr.Status(rr.State.WARNING, "worn"))
    ended.wait()
    assert len(served.unloads) == 1


@pytest.mark.timeout(LIMIT_S)
def test_a_task_that_a_callback_has_left_behind_may_do_all_of_it(app: rr.Registrar, provider: rr.Registrar) -> None:
    unplugged, ended = threading.Event(), Calls()
    tasks: list[asyncio.Task[None]] = []

    async def watch() -> None:
        await asyncio.to_thread(unplugged.wait)
        await asyncio.to_thread(provider.unload, rr.current().resource_id, force=True)
        ended("well")

    async def load(_request: Any) -> None:
        tasks.append(asyncio.ensure_future(watch()))

    provider.register_server("thing", load)
    app.load("provider/thing", "x")
    unplugged.set()
    ended.wait()
    assert provider.resources() == []
