"""What tells a load callback that nobody needs its result any more, and its thread that the load is over."""

from __future__ import annotations

import asyncio
import functools
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


def test_a_thread_of_an_async_load_may_wait_for_it(app: rr.Registrar, provider: rr.Registrar) -> None:
    ended = Calls()

    def wait() -> None:
        rr.current().stopping.wait()
        ended(1)

    async def load(request: Any) -> None:
        await asyncio.to_thread(wait)

    provider.register_server("cam", load)
    with pytest.raises(rr.LoadTimeout):
        app.load("provider/cam", 1, timeout_s=0.05)
    assert ended.wait(timeout=LONG_S) == [1]


class AsyncLoad:
    """An `async def` load callback that waits until it is cancelled, or the test lets it end."""

    def __init__(self) -> None:
        self.began = Calls()
        self.cancelled = Calls()
        self.clean = threading.Event()
        self.clean.set()
        self.may_end = False
        self._go: Callable[[], object]

    def go(self) -> None:
        """Let the present run end, and those after it."""
        self.may_end = True
        self._go()

    async def __call__(self, request: Any) -> str:
        loop, going = asyncio.get_running_loop(), asyncio.Event()
        self._go = functools.partial(loop.call_soon_threadsafe, going.set)
        self.began(request)
        try:
            if not self.may_end:
                await going.wait()
        except asyncio.CancelledError:
            self.cancelled(request)
            await asyncio.to_thread(self.clean.wait)
            raise
        async with asyncio.timeout(LONG_S):  # which an old cancellation would disturb
            await asyncio.sleep(0)
        return "loaded"


def wrapped(load: AsyncLoad) -> Callable[[Any], Any]:
    return lambda request: load(request)


@pytest.mark.parametrize("form", [lambda load: load, wrapped], ids=["async def", "a lambda around it"])
def test_an_async_load_is_cancelled_when_all_who_waited_have_withdrawn_it(
    form: Callable[[AsyncLoad], Any], app: rr.Registrar, provider: rr.Registrar
) -> None:
    load = AsyncLoad()
    provider.register_server("cam", form(load))
    with pytest.raises(rr.LoadTimeout):
        app.load("provider/cam", 1, timeout_s=0.05)
    assert load.cancelled.wait(timeout=LONG_S) == [1]
    eventually(lambda: provider.resources() == [])


def test_an_async_load_is_not_cancelled_while_somebody_still_waits(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar
) -> None:
    load = AsyncLoad()
    provider.register_server("cam", load)
    second = system.open_registrar("second").load("provider/cam", 1, block=False, timeout_s=None)
    load.began.wait()
    with pytest.raises(rr.LoadTimeout):
        app.load("provider/cam", 1, timeout_s=0.05)
    eventually(lambda: provider.resources()[0].holders == ("second",))
    load.go()
    assert second.get(timeout=LONG_S).response == "loaded"
    assert load.cancelled.items == []


def test_an_async_load_is_cancelled_when_it_is_overdue(app: rr.Registrar, provider: rr.Registrar) -> None:
    load = AsyncLoad()
    provider.register_server("cam", load, load_timeout_s=0.05)
    with pytest.raises(rr.LoadFailed):
        app.load("provider/cam", 1)
    assert load.cancelled.wait(timeout=LONG_S) == [1]


def test_an_async_load_is_cancelled_when_the_registrar_is_closed(app: rr.Registrar, provider: rr.Registrar) -> None:
    load = AsyncLoad()
    provider.register_server("cam", load)
    loading = app.load("provider/cam", 1, block=False, timeout_s=None)
    load.began.wait()
    provider.close(timeout_s=LONG_S)
    assert load.cancelled.wait(timeout=LONG_S) == [1]
    with pytest.raises(rr.RrError):
        loading.get(timeout=LONG_S)


def test_an_async_unload_is_not_cancelled(app: rr.Registrar, provider: rr.Registrar) -> None:
    unloaded = Calls()

    async def load(request: Any) -> str:
        return "loaded"

    async def unload(request: Any, response: Any) -> None:
        await asyncio.sleep(0.05)
        unloaded(request)

    provider.register_server("cam", load, unload)
    app.load("provider/cam", 1).unload()
    assert unloaded.items == [1]


def test_a_cancelled_load_that_is_asked_for_again_runs_once_more(app: rr.Registrar, provider: rr.Registrar) -> None:
    load = AsyncLoad()
    load.clean.clear()
    provider.register_server("cam", load)
    with pytest.raises(rr.LoadTimeout):
        app.load("provider/cam", 1, timeout_s=0.05)
    load.cancelled.wait(timeout=LONG_S)
    again = app.load("provider/cam", 1, block=False, timeout_s=None)
    eventually(lambda: provider.resources()[0].holders == ("app",))
    load.go()
    load.clean.set()
    assert again.get(timeout=LONG_S).response == "loaded"
    assert load.began.items == [1, 1]
    assert load.cancelled.items == [1]


def test_a_load_that_heeds_the_event_and_is_asked_for_again_runs_once_more(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    stopped, go, runs = Calls(), threading.Event(), Calls()

    def load(request: Any) -> str:
        runs(rr.current().attempt)
        if len(runs.items) == 1:
            rr.current().stopping.wait()
            stopped(request)
            go.wait()
            raise RuntimeError("stopped")
        assert not rr.current().stopping.is_set()
        return "loaded"

    serve(provider, "cam", load)
    with pytest.raises(rr.LoadTimeout):
        app.load("provider/cam", 1, timeout_s=0.05)
    stopped.wait(timeout=LONG_S)
    again = app.load("provider/cam", 1, block=False, timeout_s=None)
    eventually(lambda: provider.resources()[0].holders == ("app",))
    go.set()
    assert again.get(timeout=LONG_S).response == "loaded"
    assert runs.items == [1, 1]


@pytest.mark.parametrize("asynchronous", [False, True])
def test_a_stopped_load_that_is_asked_for_again_when_it_has_just_raised_runs_once_more(
    app: rr.Registrar, provider: rr.Registrar, asynchronous: bool
) -> None:
    raised, go, runs = Calls(), threading.Event(), Calls()

    class Stopped(Exception):
        def __str__(self) -> str:  # the error is described when the callback has ended
            raised(True)
            go.wait(LONG_S)
            return "stopped"

    def load(request: Any) -> str:
        runs(rr.current().attempt)
        if len(runs.items) == 1:
            rr.current().stopping.wait()
            raise Stopped
        return "loaded"

    async def load_async(request: Any) -> str:
        runs(rr.current().attempt)
        if len(runs.items) == 1:
            try:
                await asyncio.sleep(LONG_S)
            except asyncio.CancelledError:
                raise Stopped from None
        return "loaded"

    serve(provider, "cam", load_async if asynchronous else load)
    with pytest.raises(rr.LoadTimeout):
        app.load("provider/cam", 1, timeout_s=0.05)
    raised.wait(timeout=LONG_S)
    again = app.load("provider/cam", 1, block=False, timeout_s=None)
    eventually(lambda: provider.resources()[0].holders == ("app",))
    go.set()
    assert again.get(timeout=LONG_S).response == "loaded"
    assert runs.items == [1, 1]


def test_a_load_that_sets_it_itself_and_raises_does_not_run_again(app: rr.Registrar, provider: rr.Registrar) -> None:
    runs = Calls()

    def load(request: Any) -> str:
        runs(request)
        rr.current().stopping.set()
        raise RuntimeError("a part is lost")

    serve(provider, "cam", load)
    with pytest.raises(rr.LoadFailed, match="a part is lost"):
        app.load("provider/cam", 1)
    assert runs.items == [1]


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


# -- rr.current().loaded -------------------------------------------------------------------------------------------


class Told:
    """A load callback whose thread waits for the end of the load, and replaces the response."""

    def __init__(self, provider: rr.Registrar) -> None:
        self.provider, self.go, self.began, self.ended = provider, threading.Event(), Calls(), Calls()

    def __call__(self, request: Any) -> str:
        now = rr.current()
        threading.Thread(target=self.follow, args=[now.resource_id, now.loaded], daemon=True).start()
        self.began(now.loaded)
        self.go.wait(LONG_S)
        if request == "fails":
            raise OSError("it failed")
        return "loaded"

    def follow(self, resource_id: str, loaded: threading.Event) -> None:
        assert loaded.wait(LONG_S)
        try:
            self.provider.update_response(resource_id, "followed")
            self.ended("followed")
        except rr.RrError as error:
            self.ended(type(error))


def test_a_thread_of_a_load_callback_is_told_when_the_response_is_on_disk(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    load = Told(provider)
    serve(provider, "cam", load)
    loading = app.load("provider/cam", 1, block=False, timeout_s=None)
    load.began.wait()
    assert not load.began.items[0].is_set()
    load.go.set()
    assert load.ended.wait(timeout=LONG_S) == ["followed"]
    assert eventually(lambda: loading.get(timeout=LONG_S).response == "followed")


def test_a_thread_of_a_load_callback_is_told_when_the_load_has_failed(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    load = Told(provider)
    load.go.set()
    serve(provider, "cam", load)
    with pytest.raises(rr.LoadFailed):
        app.load("provider/cam", "fails")
    assert load.ended.wait(timeout=LONG_S) == [rr.UnknownQuery]


def test_a_thread_of_a_load_callback_is_told_when_the_registrar_is_closed(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    load = Told(provider)
    serve(provider, "cam", load)
    app.load("provider/cam", 1, block=False, timeout_s=None)
    load.began.wait()
    provider.close(timeout_s=0.1)
    assert load.ended.wait(timeout=LONG_S) == [rr.RegistrarDown]  # the callback has not returned
    load.go.set()


def test_it_is_set_at_once_when_the_load_is_over_and_other_callbacks_do_not_have_it(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    contexts, refused = Calls(), Calls()

    def unload(request: Any, response: Any) -> None:
        try:
            refused(rr.current().loaded)
        except rr.UsageError as error:
            refused(str(error))

    provider.register_server("cam", lambda request: contexts(rr.current()), unload)
    query = app.load("provider/cam", 1)
    assert contexts.items[0].loaded.is_set()
    query.unload()
    text = "provider/cam: loaded in its unload callback: only load and recover callbacks have it"
    assert refused.wait(timeout=LONG_S) == [text]
