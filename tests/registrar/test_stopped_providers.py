"""A load in flight by the event loop ends when its provider is stopped: its caller does not wait for the time limit.

It goes on if the provider is stopped to be started again.
"""

from __future__ import annotations

import asyncio
import threading
import time
from pathlib import Path

import pytest

import rr_actors as rr
from support import eventually, kill

LOADS_S = 45.0
"""How long a callback takes that nobody ends, and the limit of its load."""
ENDS_S = 20.0
"""How long after the stop of its provider a load may go on, on a busy machine."""


class Shop(rr.Manager):
    def __init__(self, began: str) -> None:
        self._began = Path(began)

    @rr.server("thing")
    def make(self, name: str) -> str:
        if name != "first":
            self._began.touch()
            time.sleep(LOADS_S)
        return name


@pytest.mark.parametrize("way", ["without waiting", "a task", "a thread", "a second load of a task"])
def test_a_load_ends_when_its_provider_is_stopped(way: str, state_dir: Path, tmp_path: Path) -> None:
    began = tmp_path / "began"
    shop = rr.ChildSpec(Shop, id="shop", args=(str(began),), shutdown_s=0)
    with rr.System([shop], state_dir=state_dir) as system:
        app, stopped_at = system.open_registrar("app"), list[float]()

        def stop() -> None:
            eventually(began.exists, LOADS_S)
            stopped_at.append(time.monotonic())
            system.supervisor().terminate_child("shop")

        async def load() -> None:
            loading = asyncio.create_task(app.load_async("shop/thing", "a", timeout_s=LOADS_S))
            await asyncio.to_thread(stop)
            await loading

        def load_by_future() -> None:
            loading = app.load("shop/thing", "a", block=False, timeout_s=LOADS_S)
            stop()
            loading.get(timeout=LOADS_S)

        def load_by_a_thread() -> None:
            stopping = threading.Thread(target=stop)
            stopping.start()
            try:
                app.load("shop/thing", "a", timeout_s=LOADS_S)
            finally:
                stopping.join()

        ways = {"without waiting": load_by_future, "a thread": load_by_a_thread}
        if way in ("a thread", "a second load of a task"):  # by a connection of their own, beside the link
            for _ in range(2):
                app.load("shop/thing", "first").unload()
        with pytest.raises(rr.RegistrarDown, match="'shop': stopped; start it again, or take another"):
            ways.get(way, lambda: asyncio.run(load()))()
        assert time.monotonic() - stopped_at[0] < ENDS_S


class Trigger(rr.Manager):
    pass


class SlowToStop(rr.Manager):
    def on_stop(self) -> None:
        time.sleep(1.5)


class SecondTime(rr.Manager):
    def __init__(self, began: str) -> None:
        self._began = Path(began)

    @rr.server("thing")
    def make(self, name: str) -> str:
        if not self._began.exists():
            self._began.touch()
            time.sleep(LOADS_S)
        return name


def test_a_load_goes_on_when_the_supervisor_of_its_provider_is_started_again(state_dir: Path, tmp_path: Path) -> None:
    began = tmp_path / "began"
    slow = rr.ChildSpec(SlowToStop, id="slow")
    shop = rr.ChildSpec(SecondTime, id="shop", args=(str(began),), shutdown_s=0)  # says that it is stopped, 1.5 s long
    group = rr.Supervisor([slow, shop], id="group")
    tree = rr.Supervisor([rr.ChildSpec(Trigger, id="trigger"), group], id="root", strategy="rest_for_one")
    with rr.System(tree, state_dir=state_dir) as system:
        app = system.open_registrar("app")
        loading = app.load("shop/thing", "a", block=False, timeout_s=LOADS_S)
        eventually(began.exists, LOADS_S)
        kill(system, "trigger")
        assert loading.get(timeout=LOADS_S).response == "a"
