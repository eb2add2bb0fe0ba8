"""rr.current().stopping: what tells a load callback that nobody needs its result any more."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from support import Calls, eventually, serve

Start = Callable[..., rr.System]
LONG_S = 30.0


class Load:
    """A load callback that waits until its event `stopping` is set, or the test lets it end."""

    def __init__(self) -> None:
        self.began = Calls()
        self.ended = Calls()
        self.go = threading.Event()

    def __call__(self, request: Any) -> str:
        stopping = rr.current().stopping
        assert rr.current().stopping is stopping
        self.began(stopping)
        while not self.go.is_set():
            if stopping.wait(0.01):
                self.ended(request)
                raise RuntimeError("stopped")
        return "loaded"


def test_it_is_set_when_all_who_waited_have_withdrawn_the_load(app: rr.Registrar, provider: rr.Registrar) -> None:
    load = Load()
    serve(provider, "cam", load)
    with pytest.raises(rr.LoadTimeout):
        app.load("provider/cam", 1, timeout_s=0.05)
    assert load.ended.wait(timeout=LONG_S) == [1]
    eventually(lambda: provider.resources() == [])


def test_it_is_not_set_while_somebody_still_waits(system: rr.System, app: rr.Registrar, provider: rr.Registrar) -> None:
    load = Load()
    serve(provider, "cam", load)
    second = system.open_registrar("second").load("provider/cam", 1, block=False, timeout_s=None)
    load.began.wait()
    with pytest.raises(rr.LoadTimeout):
        app.load("provider/cam", 1, timeout_s=0.05)
    eventually(lambda: provider.resources()[0].holders == ("second",))
    assert not load.began.items[0].is_set()
    load.go.set()
    assert second.get(timeout=LONG_S).response == "loaded"
    assert load.ended.items == []


def test_it_is_not_set_by_a_load_that_succeeds_nor_by_its_unload(app: rr.Registrar, provider: rr.Registrar) -> None:
    load = Load()
    load.go.set()
    serve(provider, "cam", load)
    app.load("provider/cam", 1).unload()
    assert [event.is_set() for event in load.began.items] == [False]


def test_it_is_set_when_the_load_is_overdue(app: rr.Registrar, provider: rr.Registrar) -> None:
    load = Load()
    serve(provider, "cam", load, load_timeout_s=0.05)
    with pytest.raises(rr.LoadFailed):
        app.load("provider/cam", 1)
    assert load.ended.wait(timeout=LONG_S) == [1]


def test_it_is_set_when_the_registrar_is_closed(app: rr.Registrar, provider: rr.Registrar) -> None:
    load = Load()
    serve(provider, "cam", load)
    loading = app.load("provider/cam", 1, block=False, timeout_s=None)
    load.began.wait()
    provider.close(timeout_s=LONG_S)
    assert load.ended.items == [1]
    with pytest.raises(rr.RrError):
        loading.get(timeout=LONG_S)


def test_an_async_load_may_wait_for_it(app: rr.Registrar, provider: rr.Registrar) -> None:
    ended = Calls()

    async def load(request: Any) -> None:
        await asyncio.to_thread(rr.current().stopping.wait)
        ended(request)

    provider.register_server("cam", load)
    with pytest.raises(rr.LoadTimeout):
        app.load("provider/cam", 1, timeout_s=0.05)
    assert ended.wait(timeout=LONG_S) == [1]


def test_other_callbacks_do_not_have_it(app: rr.Registrar, provider: rr.Registrar) -> None:
    refused = Calls()

    def unload(request: Any, response: Any) -> None:
        try:
            rr.current().stopping.wait(0)
        except rr.UsageError as error:
            refused(str(error))

    serve(provider, "cam", unload=unload)
    app.load("provider/cam", 1).unload()
    text = "provider/cam: stopping in its unload callback: only load and recover callbacks have it"
    assert refused.items == [text]


class Cameras(rr.Manager):
    """Notes in a file that its load has begun, and that it was told to stop."""

    def __init__(self, folder: str) -> None:
        super().__init__()
        self.folder = Path(folder)

    @rr.server("cam")
    def open_camera(self, request: str) -> str:
        (self.folder / "began").touch()
        rr.current().stopping.wait()
        (self.folder / "stopped").touch()
        raise RuntimeError("stopped")


def test_a_stop_of_the_system_does_not_wait_for_a_load_that_heeds_it(start: Start, tmp_path: Path) -> None:
    system = start(rr.ChildSpec(Cameras, id="cameras", kwargs={"folder": str(tmp_path)}, shutdown_s=LONG_S))
    system.open_registrar("app").load(Cameras.open_camera, "front", block=False, timeout_s=None)
    eventually((tmp_path / "began").exists, timeout=LONG_S)
    system.stop(timeout_s=2 * LONG_S)
    assert (tmp_path / "stopped").exists()
