"""Progress of a long load: reported by its callback, heard by those who wait (docs/semantics.md, "Load")."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import pty
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.registrar.engine import progress as engine
from rr_actors.registrar.model.messages import Progressed
from rr_actors.registrar.model.rows import Phase
from rr_actors.registrar.pages import Wanted
from rr_actors.registrar.progress_hearers import HearsHere
from rr_actors.registrar.registrar import page
from support import LIMIT_S, REPOSITORY, Calls, Gate, Workshop, eventually, kill, serve, wait_respawned
from support_inside import actor_of

Start = Callable[..., rr.System]


def reporting(gate: Gate, *reports: tuple[float, str]) -> Callable[[Any], Any]:
    """A load callback that makes its reports, and then waits at the gate."""

    def load(request: Any) -> Any:
        for report in reports:
            rr.current().progress(*report)
        gate(request)
        return request

    return load


def in_thread(fn: Callable[[], Any]) -> threading.Thread:
    thread = threading.Thread(target=fn)
    thread.start()
    return thread


def heard(calls: Calls) -> list[tuple[float, str]]:
    return [(progress.fraction, progress.text) for progress in calls]


# -- who hears -----------------------------------------------------------------------------------------------------


def test_all_who_wait_for_a_load_hear_how_far_it_has_come(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    both, more = Calls(), Gate()

    def load(request: str) -> str:
        gate(request)
        rr.current().progress(0.5, "opening")
        more(request)
        return "done"

    serve(provider, "camera", load)
    others = [system.open_registrar(name) for name in ("first", "second")]
    threads = [in_thread(lambda r=r: r.load("provider/camera", "front", progress=both)) for r in others]
    gate.wait_arrived()
    eventually(lambda: provider.resources() and len(provider.resources()[0].queries) == 2)
    gate.open()
    one, two = both.wait(2)
    more.open()
    for thread in threads:
        thread.join(LIMIT_S)
    (resource,) = provider.resources()
    assert one == two == rr.Progress(0.5, "opening", "provider/camera", resource.id)
    assert str(one) == "50% opening"
    assert len(both) == 2


def test_the_calling_thread_of_load_hears_in_order_and_nothing_after_the_load(
    app: rr.Registrar, provider: rr.Registrar
) -> None:
    calls = Calls()

    def load(_: str) -> str:
        for n in range(4):
            rr.current().progress(n / 3)
            calls.wait(n + 1)
        return "done"

    serve(provider, "camera", load)
    app.load("provider/camera", "front", progress=lambda p: calls(p.fraction, threading.get_ident()))
    me = threading.get_ident()
    assert calls.items == [(0, me), (1 / 3, me), (2 / 3, me), (1, me)]


def test_an_awaited_load_has_it_heard_on_its_own_event_loop(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera", lambda _: rr.current().progress(1, "warm"))
    calls: list[tuple[rr.Progress, bool]] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()

        def hear(progress: rr.Progress) -> None:
            calls.append((progress, asyncio.get_running_loop() is loop))

        await app.load_async("provider/camera", "front", progress=hear)
        assert len(calls) == 1

    asyncio.run(main())
    ((progress, on_loop),) = calls
    assert (progress.fraction, progress.text, on_loop) == (1.0, "warm", True)


def test_an_async_load_callback_reports_like_any_other(app: rr.Registrar, provider: rr.Registrar) -> None:
    async def load(_: str) -> str:
        rr.current().progress(0.25)
        await asyncio.sleep(0)
        rr.current().progress(0.75)
        return "done"

    serve(provider, "camera", load)
    calls = Calls()
    app.load("provider/camera", "front", progress=calls)
    assert [progress.fraction for progress in calls][-1] == 0.75


def test_a_future_of_a_load_has_it_heard_by_a_worker(app: rr.Registrar, provider: rr.Registrar, gate: Gate) -> None:
    serve(provider, "camera", reporting(gate, (0.5, "half")))
    calls = Calls()
    threads: list[int] = []
    future = app.load(
        "provider/camera", "front", block=False, progress=lambda p: (threads.append(threading.get_ident()), calls(p))
    )
    calls.wait(1)
    assert heard(calls) == [(0.5, "half")]
    gate.open()
    assert future.get().response == "front"
    assert threading.get_ident() not in threads


class Slow(rr.Manager):
    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    @rr.server("thing")
    def load_thing(self, request: str) -> str:
        rr.current().progress(0.1, f"attempt {rr.current().attempt}")
        self.work.step(f"load {request}")
        return request


def test_it_is_heard_from_another_process_and_after_a_respawn(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Slow, id="slow", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    workshop.shut("load x")
    calls = Calls()
    thread = in_thread(lambda: app.load("slow/thing", "x", progress=calls))
    calls.wait(1)
    pid = kill(system, "slow")
    wait_respawned(system, "slow", pid)
    calls.wait(2)
    workshop.open("load x")
    thread.join(LIMIT_S)
    assert heard(calls) == [(0.1, "attempt 1"), (0.1, "attempt 2")]


def test_a_load_callback_may_pass_on_what_it_hears_of_its_parts(
    app: rr.Registrar, provider: rr.Registrar, parts: rr.Registrar
) -> None:
    serve(parts, "lens", lambda _: rr.current().progress(0.5, "lens"))

    def load(_: str) -> None:
        provider.load("parts/lens", "x", progress=lambda part: rr.current().progress(part.fraction / 2, part.text))

    serve(provider, "camera", load)
    calls = Calls()
    app.load("provider/camera", "front", progress=calls)
    assert heard(calls) == [(0.25, "lens")]


def test_one_that_joins_a_load_later_hears_its_newest_report_at_once(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "camera", reporting(gate, (0.1, "cold"), (0.5, "opening")))
    first, second = Calls(), Calls()
    other = system.open_registrar("other")
    threads = [in_thread(lambda: app.load("provider/camera", "front", progress=first))]
    eventually(lambda: heard(first)[-1:] == [(0.5, "opening")])
    threads.append(in_thread(lambda: other.load("provider/camera", "front", progress=second)))
    second.wait(1)
    gate.open()
    for thread in threads:
        thread.join(LIMIT_S)
    assert heard(second) == [(0.5, "opening")]


class Late(rr.Manager):
    """Registers its server when a message says so, as one that has to find its device first."""

    def __init__(self, root: str) -> None:
        self.work = Workshop(root)

    def on_start(self) -> None:
        threading.Thread(target=self.register, daemon=True).start()

    def register(self) -> None:
        self.work.wait("register", len(self.work.lines("registered")) + 1)
        self.registrar.register_server("thing", lambda request: request, recover=self.recover)
        self.work.note("registered")

    def recover(self, request: str, response: str) -> str:
        self.work.note("recover")
        while not self.work.lines("found"):
            rr.current().progress(0.5, "looking")
            time.sleep(0.02)
        return response


def test_those_who_wait_for_a_recovery_hear_of_it(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Late, id="late", args=(str(workshop.root),)))
    app = system.open_registrar("app")
    workshop.note("register")
    workshop.wait("registered")
    app.load("late/thing", "x")
    pid = kill(system, "late")
    wait_respawned(system, "late", pid)
    workshop.note("register")
    workshop.wait("recover")
    calls = Calls()
    thread = in_thread(lambda: app.load("late/thing", "x", progress=calls))
    assert calls.wait(1)[0].text == "looking"
    workshop.note("found")
    thread.join(LIMIT_S)


def test_a_report_that_comes_twice_is_heard_once() -> None:
    calls, listeners = Calls(), engine.ProgressListeners()
    listeners.add("q", calls)
    for text in ("cold", "cold", "warm", "cold"):
        listeners.hear("provider", Progressed(["q", "other"], "r", "camera", 0.5, text))
    assert heard(calls) == [(0.5, "cold"), (0.5, "warm"), (0.5, "cold")]


# -- how often -----------------------------------------------------------------------------------------------------


def test_of_many_reports_a_few_are_heard_and_the_last_one_always(app: rr.Registrar, provider: rr.Registrar) -> None:
    def load(_: str) -> float:
        began = time.monotonic()
        for n in range(30_000):
            rr.current().progress(n / 30_000)
        rr.current().progress(1, "last")
        return time.monotonic() - began

    serve(provider, "camera", load)
    calls = Calls()
    query = app.load("provider/camera", "front", progress=calls)
    assert heard(calls)[0] < (1, "")
    assert heard(calls)[-1] == (1.0, "last")
    assert len(calls) <= 3 + query.response / engine.INTERVAL_S
    fractions = [progress.fraction for progress in calls]
    assert fractions == sorted(fractions)


def test_the_last_report_is_sent_though_the_callback_returns_while_the_loop_waits_for_the_lock() -> None:
    resource = SimpleNamespace(id="r", server="camera", phase=Phase.LOADING)
    catalog = SimpleNamespace(resources={"r": resource}, recovering={}, holders={"r": ["q"]}, waiting={"q": "r"})
    catalog.queries = {"q": SimpleNamespace(origin="app")}
    planned, sent = Calls(), Calls()
    dispatcher = SimpleNamespace(call=planned, loop=SimpleNamespace(call_later=planned))
    consumers = SimpleNamespace(hint=lambda _origin, progressed: sent(progressed), flush=lambda: None)
    registrar: Any = SimpleNamespace(closed=False, whole=lambda: catalog, consumers=consumers)
    registrar.node = SimpleNamespace(dispatcher=dispatcher, watched=False)
    reports = engine.ProgressReports(registrar)

    @contextlib.contextmanager
    def lock() -> Iterator[None]:
        assert not reports.forget_sent("r")  # a callback's thread asks: the loop ends this load, after the report
        yield

    registrar.lock = lock()
    reports.report("r", 1.0, "last")
    turn, *arguments = planned.items[0]
    turn(*arguments)
    assert [(progressed.fraction, progressed.text) for progressed in sent] == [(1.0, "last")]
    assert reports.forget_sent("r")


def test_one_that_listens_slowly_hears_the_newest_report(app: rr.Registrar, provider: rr.Registrar) -> None:
    calls, listening = Calls(), Gate()

    def load(_: str) -> None:
        for n in range(5):
            rr.current().progress(n / 10)
            calls.wait(1)
            time.sleep(engine.INTERVAL_S)  # so that more than the last one arrives meanwhile
        listening.open()

    def hear(progress: rr.Progress) -> None:
        calls(progress)
        listening()

    serve(provider, "camera", load)
    app.load("provider/camera", "front", progress=hear)
    assert heard(calls) == [(0.0, ""), (0.4, "")]


def test_an_event_loop_that_is_busy_hears_the_newest_report_alone(app: rr.Registrar, provider: rr.Registrar) -> None:
    calls, reported = Calls(), threading.Event()

    def load(_: str) -> None:
        for n in range(5):
            rr.current().progress(n / 10)
            calls.wait(1)
            time.sleep(engine.INTERVAL_S)  # so that more than the last one arrives meanwhile
        reported.set()

    async def busy() -> None:
        loading = asyncio.create_task(app.load_async("provider/camera", "front", progress=calls))
        await asyncio.to_thread(calls.wait)
        assert reported.wait(LIMIT_S)  # the event loop runs nothing else meanwhile
        await loading

    serve(provider, "camera", load)
    asyncio.run(busy())
    assert heard(calls) == [(0.0, ""), (0.4, "")]


def test_nothing_is_kept_of_loads_that_have_ended(app: rr.Registrar, provider: rr.Registrar) -> None:
    served: list[rr.Current] = []

    def load(request: int) -> int:
        served.append(rr.current())
        rr.current().progress(0.5)
        if request % 2:
            raise ValueError("no such camera")
        return request

    serve(provider, "camera", load)
    for n in range(20):
        try:
            app.load("provider/camera", n, progress=lambda _: None)
        except rr.LoadFailed:
            assert n % 2
    for current in served:
        current.progress(0.9)  # a thread that the callback has left behind
    reports, listeners = actor_of(provider).progress, actor_of(app).listeners
    eventually(lambda: not any(reports.newest(current.resource_id) for current in served) and not listeners.queries())


# -- what goes wrong -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fraction", [float("nan"), -0.1, 1.1, float("inf"), "half", None, True, 10**400])
def test_a_fraction_that_is_none_is_an_error_that_shows_it(
    app: rr.Registrar, provider: rr.Registrar, fraction: Any
) -> None:
    serve(provider, "camera", lambda _: rr.current().progress(fraction))
    with pytest.raises(rr.LoadFailed, match="fraction: expected a number from 0 to 1, got"):
        app.load("provider/camera", "front")


@pytest.mark.parametrize(("text", "said"), [("x" * 501, "at most 500 characters, got 501"), (b"x", "expected a str")])
def test_a_text_that_is_none_or_too_long_is_an_error(
    app: rr.Registrar, provider: rr.Registrar, text: Any, said: str
) -> None:
    serve(provider, "camera", lambda _: rr.current().progress(0.5, text))
    with pytest.raises(rr.LoadFailed, match=said):
        app.load("provider/camera", "front")


def test_an_unload_callback_has_no_load_to_report_of(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera", unload=lambda *_: rr.current().progress(0.5))
    query = app.load("provider/camera", "front")
    with pytest.raises(rr.UnloadFailed, match=r"provider/camera: progress\(\) in its unload callback"):
        query.unload()


def test_a_callable_that_raises_is_logged_once_and_harms_nothing(
    app: rr.Registrar, provider: rr.Registrar, caplog: pytest.LogCaptureFixture
) -> None:
    def load(_: str) -> str:
        for n in range(3):
            rr.current().progress(n / 3)
            time.sleep(engine.INTERVAL_S)
        return "done"

    def hear(_: rr.Progress) -> None:
        raise ValueError("no terminal")

    serve(provider, "camera", load)
    with caplog.at_level(logging.ERROR):
        assert app.load("provider/camera", "front", progress=hear).response == "done"
    assert len(caplog.records) == 1
    assert "the progress callable of a load of provider/camera raised" in caplog.text
    assert app.stats()["callback_failures"] == 1


def test_a_thread_that_is_woken_by_the_end_of_its_load_finds_how_it_has_ended(
    app: rr.Registrar, provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    wake = HearsHere.ended

    def wake_and_pause(self: HearsHere) -> None:
        wake(self)
        time.sleep(0.1)  # the thread goes on before the loop does

    monkeypatch.setattr(HearsHere, "ended", wake_and_pause)
    serve(provider, "camera")
    assert app.load("provider/camera", "front", progress=lambda _: None).request == "front"


def test_an_interrupt_in_the_callable_interrupts_the_load(app: rr.Registrar, provider: rr.Registrar) -> None:
    unloaded = serve(provider, "camera", lambda _: rr.current().progress(0.5))

    def hear(_: rr.Progress) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        app.load("provider/camera", "front", progress=hear)
    unloaded.unloads.wait(1)
    assert app.queries() == []


@pytest.mark.parametrize("progress", [1, "yes", object()])
def test_what_cannot_hear_is_refused(app: rr.Registrar, provider: rr.Registrar, progress: Any) -> None:
    serve(provider, "camera")
    with pytest.raises(rr.UsageError, match="progress: expected a callable or a bool, got"):
        app.load("provider/camera", "front", progress=progress)
    assert app.queries() == []


def test_an_async_callable_is_refused(app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera")

    async def hear(_: rr.Progress) -> None: ...

    with pytest.raises(rr.UsageError, match="expected a plain function, got an async one"):
        app.load("provider/camera", "front", progress=hear)


def test_a_handle_refuses_it_and_says_who_can_hear(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Slow, id="slow", args=(str(workshop.root),)))
    with pytest.raises(rr.UsageError, match="load by a registrar of this process"):
        system.registrar("slow").load("slow/thing", "x", progress=print)


def test_a_load_that_takes_too_long_ends_in_time_although_it_is_heard(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "camera", reporting(gate, (0.5, "")))
    calls = Calls()
    with pytest.raises(rr.LoadTimeout):
        app.load("provider/camera", "front", progress=calls, timeout_s=0.3)
    assert heard(calls) == [(0.5, "")]


# -- where it is seen ----------------------------------------------------------------------------------------------


def test_who_looks_at_a_resource_that_loads_sees_it(app: rr.Registrar, provider: rr.Registrar, gate: Gate) -> None:
    serve(provider, "camera", reporting(gate, (0.5, "opening")))
    thread = in_thread(lambda: app.load("provider/camera", "front"))
    gate.wait_arrived()
    (row,) = page(provider, Wanted("resources")).resources
    assert (row.phase, row.message) == ("loading", "50% opening")
    gate.open()
    thread.join(LIMIT_S)
    (row,) = page(provider, Wanted("resources")).resources
    assert (row.phase, row.message) == ("loaded", "")


def test_subscribers_hear_of_it(system: rr.System, app: rr.Registrar, provider: rr.Registrar) -> None:
    serve(provider, "camera", lambda _: rr.current().progress(0.5, "opening"))
    events = Calls()
    system.subscribe(lambda event: events(event) if event["event"] == "progress" else None)
    query = app.load("provider/camera", "front")
    (event,) = events.wait(1)
    assert abs(event.pop("at") - time.time()) < LIMIT_S
    assert event == {
        "event": "progress",
        "registrar": "provider",
        "server": "provider/camera",
        "resource_id": query.resource_id,
        "request": '"front"',
        "fraction": 0.5,
        "text": "opening",
    }


PROGRAM = """
import sys, threading, time
import rr_actors as rr

class Slow(rr.Manager):
    @rr.server("thing")
    def load_thing(self, request: str) -> str:
        for n in range(1, 5):
            rr.current().progress(n / 4, f"step [{n}] \\x1b[31m of {request}")
            time.sleep(0.15)
        return request

if __name__ == "__main__":
    with rr.System([rr.ChildSpec(Slow, id="slow")], state_dir=sys.argv[1]) as system:
        app = system.open_registrar("app")
        futures = [app.load("slow/thing", name, progress=True, block=False) for name in ("left", "right")]
        print([future.get().response for future in futures])
        print(app.load("slow/thing", "front", progress=True).response)
        print(app.load("slow/thing", "front", progress=True).response, threading.active_count() > 0)
"""


def test_a_bar_is_drawn_on_a_terminal_and_wiped_at_the_end(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    ours, theirs = pty.openpty()
    environment = {**os.environ, "TERM": "xterm", "COLUMNS": "120", "PYTHONPATH": str(REPOSITORY)}
    ran = subprocess.Popen(
        [sys.executable, program, tmp_path / "state"], stdout=subprocess.PIPE, stderr=theirs, env=environment
    )
    os.close(theirs)
    drawn = b""
    while True:
        try:
            read = os.read(ours, 65536)
        except OSError:  # how a terminal ends
            break
        if not read:
            break
        drawn += read
    os.close(ours)
    out = ran.communicate(timeout=LIMIT_S)[0].decode()
    assert ran.returncode == 0
    assert out == "['left', 'right']\nfront\nfront True\n"
    text = drawn.decode()
    for words in ("slow/thing step [2]  [31m of left", "[31m of right", "[31m of front", "75%"):
        assert words in text
    assert "\x1b[31m of" not in text
    assert "left" not in text.rpartition("\x1b[2K")[2]  # the lines are wiped


def test_without_a_terminal_nothing_is_drawn(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    ran = subprocess.run(
        [sys.executable, program, tmp_path / "state"], capture_output=True, text=True, env=environment, timeout=30
    )
    assert (ran.stdout, ran.stderr) == ("['left', 'right']\nfront\nfront True\n", "")


def test_without_rich_the_error_says_what_to_install(
    app: rr.Registrar, provider: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    serve(provider, "camera")
    monkeypatch.setitem(sys.modules, "rich.console", None)
    monkeypatch.delitem(sys.modules, "rr_actors.registrar.progress_bar", raising=False)
    with pytest.raises(
        rr.UsageError, match=r"pip install 'rich>=[\d.]+' \(in a checkout of rr_actors: pip install '\.\[progress\]'\)"
    ):
        app.load("provider/camera", "front", progress=True)


def test_reports_that_come_faster_than_they_are_heard_hold_up_no_time_limit() -> None:
    class Slow:
        """Each report that it hears brings the next."""

        heard = 0

        def hear(self, report: engine.Progress) -> None:
            self.heard += 1
            assert self.heard < 1_000_000, "it does not end"
            wait.progressed(report)

    hearer: Any = Slow()
    wait = HearsHere(hearer)
    wait.progressed(engine.Progress(0.5, "half", "provider/thing", "r"))

    assert not wait.hear_within(0.05)
    assert hearer.heard > 1
    wait.ended()
    assert wait.hear_within(LIMIT_S)
