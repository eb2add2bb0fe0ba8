"""Errors at the far end say why: what ended a registrar that is gone, what stops a load, what was not to be had."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.runtime.event_loop import Dispatcher
from support import Calls, Gate, NoDescriptors, Workshop, eventually, kill, serve
from support_managers import Order, Shop

Start = Callable[..., rr.System]


def shop(workshop: Workshop, id: str, **options: Any) -> rr.ChildSpec:
    return rr.ChildSpec(Shop, id=id, args=(str(workshop.root),), **options)


# -- gone for good ---------------------------------------------------------------------------------------------------


def says_why_it_is_gone(system: rr.System, app: rr.Registrar, *words: str) -> None:
    """Each way to ask for the registrar "one" and its supervisor."""
    with pytest.raises(rr.RegistrarDown, match="gone for good: ") as load:
        app.load("one/thing", Order("lamp"))
    assert load.value.status == "gone"
    with pytest.raises(rr.UnknownRegistrar, match="gone for good: ") as handle:
        system.registrar("one")
    for word in words:
        assert word in str(load.value)
        assert word in str(handle.value)


def test_a_registrar_whose_tree_gave_up_says_which_exits_and_which_limit_ended_it(
    start: Start, workshop: Workshop
) -> None:
    system = start(rr.Supervisor([shop(workshop, "one")], max_restarts=0, max_seconds=7))
    app = system.open_registrar("app")
    kill(system, "one")
    assert system.wait(10)
    says_why_it_is_gone(system, app, "supervisor root", "1 restart", "within 7 s", "0 allowed", "killed (SIGKILL)")


@pytest.mark.parametrize("placement", ["thread", "process"])
def test_a_registrar_whose_inner_supervisor_gave_up_says_so(start: Start, workshop: Workshop, placement: Any) -> None:
    inner = rr.Supervisor([shop(workshop, "one")], id="inner", max_restarts=0, restart="temporary", placement=placement)
    system = start(inner, shop(workshop, "other"))
    app = system.open_registrar("app")
    one = system.ref("one")
    (found,) = [child for child in system.supervisor("inner").which_children() if child.id == "one"]
    assert found.pid is not None
    os.kill(found.pid, signal.SIGKILL)
    eventually(lambda: not system.supervisor().which_children()[1:])
    says_why_it_is_gone(system, app, "supervisor root/inner", "0 allowed", "killed (SIGKILL)")
    with pytest.raises(rr.NotFound, match=r"root/inner': it is gone: .*0 allowed.*SIGKILL"):
        system.supervisor("inner")
    with pytest.raises(rr.ActorDeadError, match="0 allowed"):
        one.ask("hello")


def test_a_registrar_whose_manager_is_not_restarted_says_how_it_ended(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop, "one", restart="temporary"))
    app = system.open_registrar("app")
    kill(system, "one")
    eventually(lambda: not system.supervisor().which_children())
    says_why_it_is_gone(system, app, "killed (SIGKILL)")


def test_a_registrar_that_was_taken_out_by_hand_says_nothing_of_an_exit(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop, "one"))
    app = system.open_registrar("app")
    system.supervisor().terminate_child("one")
    with pytest.raises(rr.RegistrarDown, match="'one': stopped; start it again"):
        app.load("one/thing", Order("lamp"))
    system.supervisor().delete_child("one")
    with pytest.raises(rr.RegistrarDown, match=r"'one': gone for good$"):
        app.load("one/thing", Order("lamp"))


def test_a_reason_that_is_too_long_for_the_directory_is_cut(start: Start, workshop: Workshop) -> None:
    class Wordy(Shop):
        def on_start(self) -> None:
            if self.work.lines("once"):
                raise ValueError("ä" * 5000)
            self.work.note("once")

    system = start(rr.Supervisor([rr.ChildSpec(Wordy, id="one", args=(str(workshop.root),))], max_restarts=1))
    app = system.open_registrar("app")
    kill(system, "one")
    assert system.wait(10)
    says_why_it_is_gone(system, app, "1 allowed", "…")


# -- a system that stops ---------------------------------------------------------------------------------------------


def test_a_load_that_waits_when_its_system_stops_is_told_that(state_dir: Path, workshop: Workshop) -> None:
    config = rr.SystemConfig(stop_timeout_s=0.5)
    specs = [
        shop(workshop, "one", shutdown_s="brutal_kill"),
        shop(workshop, "near", placement="thread", shutdown_s=0.1),
    ]
    gate = Gate()
    with ThreadPoolExecutor(4) as threads:
        with rr.System(specs, name="robot", state_dir=state_dir, config=config) as system:
            app = system.open_registrar("app")
            serve(app, "own", gate)
            workshop.shut("load lamp")
            waiting: list[Future[Any]] = [
                threads.submit(app.load, "one/thing", Order("lamp")),
                threads.submit(app.load, "near/thing", Order("lamp")),
                threads.submit(app.load, "app/own", 1),
                threads.submit(system.registrar("near").load, "one/thing", Order("lamp")),
            ]
            future = app.load("one/thing", Order("lamp"), block=False)
            gate.wait_arrived()
            workshop.wait("load lamp", 2)
            eventually(lambda: app.stats()["loading"] == 4)
        for load, server in zip(waiting, ("one/thing", "near/thing", "app/own", "one/thing"), strict=True):
            with pytest.raises(
                rr.RegistrarDown, match=f"{server}: the load is withdrawn, as system 'robot' is being stopped"
            ):
                load.result(10)
        with pytest.raises(
            rr.RegistrarDown, match="one/thing: the load is withdrawn, as system 'robot' is being stopped"
        ):
            future.get(timeout=10)
        told = "'app': closed, as system 'robot' has been stopped: start it, and open the registrar again"
        with pytest.raises(rr.RegistrarDown, match=told):
            app.load("one/thing", Order("lamp"))
        gate.open()
        workshop.open("load lamp")


def test_a_load_that_waits_when_its_registrar_is_closed_is_told_that(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "slow", gate)
    future = app.load("provider/slow", 1, block=False)
    gate.wait_arrived()
    app.close(timeout_s=0.1)
    with pytest.raises(rr.RegistrarDown, match="provider/slow: the load is withdrawn, as registrar 'app' is being"):
        future.get(timeout=10)
    with pytest.raises(rr.RegistrarDown, match=r"'app': closed$"):
        app.load("provider/slow", 1)


# -- died in each attempt --------------------------------------------------------------------------------------------


class Deadly(rr.Manager):
    """Ends its process in each load, as the request says."""

    @rr.server("thing")
    def load_thing(self, request: str) -> str:
        match request:
            case "exit":
                os._exit(3)
            case "signal":
                os.kill(os.getpid(), signal.SIGSEGV)
                threading.Event().wait()  # it goes to another thread
            case _:
                pass
        return request


@pytest.mark.parametrize(("request_", "how"), [("exit", "exit code 3"), ("signal", "SIGSEGV")])
def test_a_load_that_kills_its_process_each_time_says_by_which_signal_or_exit_code(
    start: Start, request_: str, how: str
) -> None:
    system = start(rr.ChildSpec(Deadly, id="one"))
    app = system.open_registrar("app")
    with pytest.raises(rr.LoadFailed, match=rf"3 attempts of this load \(it died of: {how}; {how}; {how}\)"):
        app.load("one/thing", request_)
    assert app.load("one/thing", "harmless").response == "harmless"


# -- without descriptors or threads ------------------------------------------------------------------------------


EMFILE = "EMFILE: the process has as many descriptors open as it may"
EAGAIN = "EAGAIN: no more processes or threads can be made"


def test_a_load_that_cannot_connect_for_want_of_descriptors_says_so_at_once(start: Start, workshop: Workshop) -> None:
    system = start(shop(workshop, "one"), shop(workshop, "other"))
    app = system.open_registrar("app")
    app.load("one/thing", Order("lamp"))  # its journal is open
    with NoDescriptors(), pytest.raises(rr.RrError, match=f"cannot connect to other: {EMFILE}"):
        app.load("other/thing", Order("lamp"))
    app.load("other/thing", Order("lamp"))


def test_a_registrar_that_cannot_be_opened_for_want_of_descriptors_says_so(system: rr.System) -> None:
    refusals: list[str] = []
    refused: list[int] = []
    for spare in range(12):
        with NoDescriptors(spare):
            try:
                system.open_registrar(f"app{spare}")
            except rr.CatalogError as error:
                refusals.append(str(error))
                refused.append(spare)
    assert refused == list(range(len(refused)))  # with enough descriptors it opens
    assert len(refused) > 1
    assert all(EMFILE in refusal for refusal in refusals)


def _descriptors() -> set[str]:
    found: set[str] = set()
    for entry in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):  # it was the listing's own
            found.add(f"{entry} {os.readlink(f'/proc/self/fd/{entry}')}")
    return found


@pytest.mark.slow
def test_a_system_that_cannot_start_for_want_of_descriptors_says_so_and_leaves_none(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.CRITICAL + 1, "rr_actors")  # pytest keeps logged errors, and they what their frames knew
    with rr.System([], state_dir=tmp_path / "warm"):
        pass  # what a process opens once is open now
    before = _descriptors()
    refusals: list[str] = []
    for spare in range(24):
        system = rr.System([], state_dir=tmp_path / str(spare))
        with NoDescriptors(spare):
            try:
                system.start()
            except rr.RrError as error:
                refusals.append(str(error))
            else:
                system.stop()
        gc.collect()
        eventually(lambda: _descriptors() <= before, what=f"no descriptor left of {spare}: {_descriptors() - before}")
    assert len(refusals) > 5
    assert all(EMFILE in refusal for refusal in refusals)


def test_without_a_thread_a_system_and_a_registrar_say_so(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_thread(_thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", no_thread)
    with pytest.raises(rr.StartFailed, match=EAGAIN) as failed:
        rr.System([], state_dir=tmp_path / "other").start()
    assert failed.value.wanted.startswith("EAGAIN")
    monkeypatch.undo()
    system = start()
    gate = Gate()
    provider, app = system.open_registrar("provider"), system.open_registrar("app")
    serve(provider, "thing", load=gate)
    monkeypatch.setattr(threading.Thread, "start", no_thread)
    loads = [app.load("provider/thing", number, block=False) for number in range(30)]  # there are some idle threads
    with pytest.raises(rr.RrError, match=EAGAIN):
        loads[-1].get(timeout=10)
    gate.open()
    loads[0].get(timeout=10)


def test_an_async_callback_without_descriptors_for_its_loop_says_so() -> None:
    async def answer() -> str:
        return "answered"

    dispatcher = Dispatcher()
    try:
        done = Calls()
        with NoDescriptors(), pytest.raises(rr.Unavailable, match=EMFILE):
            dispatcher.workers.submit(answer, done=done)
        dispatcher.workers.submit(answer, done=done)
        assert done.wait(1) == [("answered", None)]
    finally:
        dispatcher.close()
