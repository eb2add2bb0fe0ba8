"""Children start one after another, so on_start cannot wait for one that starts later (docs/semantics.md)."""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
import time
from pathlib import Path
from typing import Any

import pykka
import pytest

import rr_actors as rr
from rr_actors.managers import Budgets, Pool
from support import eventually

both = pytest.mark.parametrize("placement", ["process", "thread"])
SOON_S = 8.0  # far less than the 30 s of a load that waits


class Cameras(rr.Manager):
    @rr.server("camera")
    def load(self, request: str) -> str:
        return f"{request} by {os.getpid()}"


class Echo(rr.Actor):
    def on_receive(self, message: Any) -> Any:
        return message


class Loads(rr.Manager):
    def on_start(self) -> None:
        self.camera = self.registrar.load("cameras/camera", "front")

    def on_receive(self, message: Any) -> Any:
        return self.camera.response


class LoadsAll(rr.Manager):
    def on_start(self) -> None:
        self.registrar.load_all([("cameras/camera", "front"), ("cameras/camera", "back")])


class AwaitsLoad(rr.Manager):
    async def on_start(self) -> None:
        await self.registrar.load_async("cameras/camera", "front")


class GetsLater(rr.Manager):
    def on_start(self) -> None:
        self.registrar.load("cameras/camera", "front", block=False).get()


class AwaitsLater(rr.Manager):
    async def on_start(self) -> None:
        await self.registrar.load("cameras/camera", "front", block=False)


class LoadsWithoutWaiting(rr.Manager):
    def on_start(self) -> None:
        self.camera = self.registrar.load("cameras/camera", "front", block=False)

    def on_receive(self, message: Any) -> Any:
        return [self.camera.get().response]


class Costs(rr.Manager):
    @rr.server("map", cost={"watts": 4})
    def load(self, request: str) -> str:
        return request

    def on_start(self) -> None:
        self.registrar.load("maps/map", "hall")


class CostsInPart(rr.Manager):
    """What its on_start loads has a part with a cost."""

    @rr.server("map")
    async def load(self, request: str) -> str:
        await self.registrar.load("maps/tile", request, block=False)
        return request

    @rr.server("tile", cost={"watts": 4})
    async def load_tile(self, request: str) -> str:
        return request

    async def on_start(self) -> None:
        await self.registrar.load_async("maps/map", "hall")


class Unloads(rr.Manager):
    """Loads when it is asked to, and unloads in on_start of its next life."""

    said = ""

    def on_start(self) -> None:
        for query in self.registrar.queries():
            try:
                self.unload(query)
            except rr.UsageError as error:
                self.said = str(error)

    def unload(self, query: rr.Query[Any]) -> None:
        query.unload()

    def on_receive(self, message: Any) -> Any:
        if message == "load":
            self.registrar.load("cameras/camera", "front")
            self.registrar.save_catalog()  # the next life finds the query
        return self.said


class UnloadsLater(Unloads):
    def unload(self, query: rr.Query[Any]) -> None:
        self.registrar.unload(query, block=False).get()


class UnloadsAll(Unloads):
    def unload(self, query: rr.Query[Any]) -> None:
        self.registrar.unload_all()


class Asks(rr.Manager):
    def on_start(self) -> None:
        self.ref("echo").ask("hello")


def _tree(children: Any, strategy: Any) -> rr.Supervisor:
    return rr.Supervisor(children, id="root", strategy=strategy)


def refused(tmp_path: Path, *children: Any, strategy: Any = "one_for_one") -> str:
    """Return the error of a start that fails at once."""
    began = time.monotonic()
    with pytest.raises(rr.StartFailed) as failed, rr.System(_tree(children, strategy), state_dir=tmp_path):
        pass
    assert time.monotonic() - began < SOON_S
    return str(failed.value)


@both
@pytest.mark.parametrize("cls", [Loads, LoadsAll, AwaitsLoad, GetsLater, AwaitsLater])
@pytest.mark.parametrize("strategy", ["one_for_one", "rest_for_one", "one_for_all"])
def test_a_load_in_on_start_from_a_later_sibling_is_refused_at_once(
    tmp_path: Path, cls: Any, placement: Any, strategy: Any
) -> None:
    maps = rr.ChildSpec(cls, id="maps", placement=placement)
    text = refused(tmp_path, maps, rr.ChildSpec(Cameras, id="cameras", placement=placement), strategy=strategy)
    assert "root/cameras starts after root/maps" in text
    assert "put 'cameras' before 'maps' in the list of root, or load after on_start, in a thread" in text


@both
def test_a_load_in_on_start_below_an_earlier_supervisor_is_refused_too(tmp_path: Path, placement: Any) -> None:
    inner = rr.Supervisor([rr.ChildSpec(Loads, id="maps")], id="inner", placement=placement)
    later = rr.Supervisor([rr.ChildSpec(Cameras, id="cameras")], id="later", placement=placement)
    text = refused(tmp_path, inner, later)
    assert "root/later/cameras starts after root/inner/maps" in text
    assert "put 'later' before 'inner' in the list of root" in text


@both
def test_a_future_in_on_start_for_which_that_does_not_wait_is_no_fault(tmp_path: Path, placement: Any) -> None:
    maps = rr.ChildSpec(LoadsWithoutWaiting, id="maps", placement=placement)
    with rr.System([maps, rr.ChildSpec(Cameras, id="cameras", placement=placement)], state_dir=tmp_path) as system:
        assert len(system.ref("maps").ask("?")) == 1


@both
@pytest.mark.parametrize("cls", [Costs, CostsInPart])
def test_a_cost_of_what_on_start_loads_is_refused_at_once_if_budgets_starts_later(
    tmp_path: Path, cls: Any, placement: Any
) -> None:
    maps = rr.ChildSpec(cls, id="maps", placement=placement)
    text = refused(
        tmp_path, maps, rr.ChildSpec(Budgets, id="budgets", args=([Pool("watts", 10)],), placement=placement)
    )
    assert "root/budgets starts after root/maps" in text
    assert "put 'budgets' before 'maps' in the list of root" in text


@both
@pytest.mark.parametrize("cls", [Unloads, UnloadsLater, UnloadsAll])
def test_an_unload_in_on_start_at_a_later_sibling_is_refused_at_once(tmp_path: Path, cls: Any, placement: Any) -> None:
    """Both are killed: under one_for_all the manager is started again before the one at which it holds a query."""
    maps = rr.ChildSpec(cls, id="maps", placement="process")
    cameras = rr.ChildSpec(Cameras, id="cameras", placement=placement)
    with rr.System(_tree([maps, cameras], "one_for_all"), state_dir=tmp_path) as system:
        system.ref("maps").ask("load")
        began = time.monotonic()
        system.ref("maps").kill()
        text = eventually(lambda: _camera(system), SOON_S)
        assert time.monotonic() - began < SOON_S
    assert "unloading cameras/camera: root/cameras starts after root/maps" in text
    assert "put 'cameras' before 'maps' in the list of root, or unload after on_start, in a thread" in text


@both
def test_an_ask_in_on_start_of_a_later_sibling_names_the_order(tmp_path: Path, placement: Any) -> None:
    asks = rr.ChildSpec(Asks, id="asks", placement=placement)
    text = refused(tmp_path, asks, rr.ChildSpec(Echo, id="echo", placement=placement))
    assert "root/echo starts after root/asks" in text
    assert "put 'echo' before 'asks' in the list of root, or ask after on_start, in a thread" in text


@both
def test_a_child_that_comes_earlier_or_below_an_earlier_supervisor_is_waited_for(
    tmp_path: Path, placement: Any
) -> None:
    first = rr.Supervisor([rr.ChildSpec(Cameras, id="cameras", placement=placement)], id="first")
    with rr.System([first, rr.ChildSpec(Loads, id="maps", placement=placement)], state_dir=tmp_path) as system:
        assert system.ref("maps").ask("?").startswith("front by ")


class LoadsInThread(rr.Manager):
    """Begins a thread and, in on_start, waits only until that has begun."""

    def on_start(self) -> None:
        self.got: list[str] = []
        begun = threading.Event()
        threading.Thread(target=self.work, args=(begun,), daemon=True).start()
        begun.wait()

    def work(self, begun: threading.Event) -> None:
        begun.set()
        self.got.append(self.registrar.load("cameras/camera", "front").response)

    def on_receive(self, message: Any) -> Any:
        return self.got


class LoadsInTask(LoadsInThread):
    """Begins a task, which has the contextvars of on_start, and returns."""

    async def on_start(self) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        self.got = []
        self.task = asyncio.create_task(self.load_later())
        await asyncio.sleep(0)

    async def load_later(self) -> None:
        self.got.append((await self.registrar.load_async("cameras/camera", "front")).response)


@both
@pytest.mark.parametrize("cls", [LoadsInThread, LoadsInTask])
def test_a_load_in_a_thread_or_task_that_on_start_began_waits_for_the_later_sibling(
    tmp_path: Path, cls: Any, placement: Any
) -> None:
    children = [rr.ChildSpec(cls, id="maps", placement=placement), rr.ChildSpec(Cameras, id="cameras")]
    with rr.System(children, state_dir=tmp_path) as system:
        eventually(lambda: len(system.ref("maps").ask("?")) == 1)


class LoadsAfterCrash(rr.Manager):
    """Loads in on_start of each run but the first. Adds a line to the file `runs` in each on_start."""

    def __init__(self, folder: Path) -> None:
        self.runs, self.camera = folder / "runs", ""

    def on_start(self) -> None:
        with self.runs.open("a") as runs:
            runs.write("run\n")
        if _count(self.runs) > 1:
            self.camera = self.registrar.load("cameras/camera", "front").response

    def on_receive(self, message: Any) -> Any:
        return str(self.runs) if message == "runs" else self.camera


def _count(runs: Path) -> int:
    return len(runs.read_text().splitlines())


@pytest.mark.parametrize("both_die", [False, True])
def test_a_child_that_is_restarted_alone_may_load_from_a_later_one_also_while_that_restarts(
    tmp_path: Path, both_die: bool
) -> None:
    maps = rr.ChildSpec(LoadsAfterCrash, id="maps", args=(tmp_path,))
    with rr.System([maps, rr.ChildSpec(Cameras, id="cameras")], state_dir=tmp_path / "state") as system:
        if both_die:
            system.ref("cameras").kill()
        system.ref("maps").kill()
        eventually(lambda: _camera(system).startswith("front by "), 20)
        assert _count(tmp_path / "runs") == 2


class KillsMaps(rr.Manager):
    """Kills an earlier sibling in on_start, and returns when that one is in its own on_start again."""

    def on_start(self) -> None:
        ref = self.ref("maps")
        runs = Path(ref.ask("runs"))
        ref.kill()
        eventually(lambda: _count(runs) == 2, 20)


def test_a_child_that_is_restarted_during_the_first_start_may_wait_for_what_does_not_wait_for_it(
    tmp_path: Path,
) -> None:
    """Under one_for_one the start of the tree goes on while a child that was up is restarted."""
    children = [
        rr.ChildSpec(LoadsAfterCrash, id="maps", args=(tmp_path,)),
        rr.ChildSpec(KillsMaps, id="kills"),
        rr.ChildSpec(Cameras, id="cameras"),
    ]
    with rr.System(children, state_dir=tmp_path / "state") as system:
        eventually(lambda: _camera(system).startswith("front by "), 20)
        assert _count(tmp_path / "runs") == 2


@both
def test_a_child_that_is_added_at_run_time_may_load_from_any(tmp_path: Path, placement: Any) -> None:
    with rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir=tmp_path) as system:
        system.start_child(rr.ChildSpec(Loads, id="maps", placement=placement))
        assert system.ref("maps").ask("?").startswith("front by ")


@pytest.mark.parametrize("strategy", ["rest_for_one", "one_for_all"])
def test_a_later_child_may_load_from_an_earlier_one_in_a_group_restart(tmp_path: Path, strategy: Any) -> None:
    children = [rr.ChildSpec(Cameras, id="cameras"), rr.ChildSpec(Loads, id="maps")]
    with rr.System(_tree(children, strategy), state_dir=tmp_path) as system:
        system.ref("cameras").kill()
        eventually(lambda: _camera(system).startswith("front by "), 20)


def test_a_load_from_what_is_not_in_the_tree_says_so(tmp_path: Path) -> None:
    assert "cameras" in refused(tmp_path, rr.ChildSpec(Loads, id="maps"))


def _camera(system: rr.System) -> str:
    with contextlib.suppress(rr.RrError, pykka.ActorDeadError):
        return system.ref("maps").ask("?")
    return ""
