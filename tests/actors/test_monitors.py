"""Monitors: an actor hears, exactly once, of the end of any other, in this process or another."""

from __future__ import annotations

import asyncio
import errno
import gc
import itertools
import os
import signal
import threading
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pykka
import pytest

import rr_actors as rr
from rr_actors.actors.messaging import death_watch
from rr_actors.actors.remote import hub
from rr_actors.runtime import event_loop, user_loop
from rr_actors.runtime.processes import lifeline
from rr_actors.wire.name_service import actor_key
from support import Calls, Gate, eventually, hang, serve, wait_gone
from support_inside import node_of

Start = Callable[..., rr.System]


class Worker(rr.Actor):
    """Does what it is told."""

    def on_receive(self, message: Any) -> Any:
        match message:
            case "pid":
                return os.getpid()
            case "fail":
                raise ValueError("as it was told")
            case "end" | "shutdown":
                self.stop("normal" if message == "end" else "shutdown")
            case "leave":
                os._exit(3)
            case "start another":
                return Worker.start()
            case _:
                return message
        return None


class Watcher(rr.Actor):
    """Keeps what it hears."""

    def __init__(self) -> None:
        self.downs: list[rr.Down] = []
        self.monitors: list[rr.Monitor] = []
        self.heard: list[Any] = []

    def on_receive(self, message: Any) -> Any:
        match message:
            case rr.Down():
                self.downs.append(message)
            case ("watch", ref):
                self.monitors.append(self.monitor(ref))
            case "downs":
                return [(str(down.ref), down.reason) for down in self.downs]
            case "demonitor":
                return [monitor.demonitor() for monitor in self.monitors]
            case ("ask", ref, what):
                return ref.ask(what)
            case _:
                self.heard.append(message)
        return None


class Plain(pykka.ThreadingActor):
    use_daemon_thread = True

    def on_receive(self, message: Any) -> Any:
        if message == "fail":
            raise ValueError("as it was told")
        return message


@pytest.fixture
def watcher() -> Iterator[rr.ActorRef[Any]]:
    ref = Watcher.start()
    yield ref
    ref.stop()


def downs_of(ref: rr.ActorRef[Any], count: int = 1) -> list[tuple[str, str]]:
    """What a Watcher has heard, once it is `count`; and no more a moment later."""
    eventually(lambda: len(ref.ask("downs")) >= count)
    settle()
    return ref.ask("downs")


def settle() -> None:
    """What was called on the loop and in the workers before has been done."""
    process = event_loop.acquire()
    for _ in range(3):
        process.run(asyncio.sleep(0))
    event_loop.release()


# -- in one process --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("how", "reason"), [("end", "normal"), ("shutdown", "shutdown"), ("fail", "abnormal"), ("stop", "normal")]
)
def test_an_actor_hears_once_of_the_end_of_another(watcher: rr.ActorRef[Any], how: str, reason: str) -> None:
    watched = Worker.start()
    watcher.ask(("watch", watched))

    if how == "stop":
        watched.stop()
    else:
        watched.tell(how)

    assert downs_of(watcher) == [(str(watched), reason)]


def test_the_detail_of_an_abnormal_end_names_the_exception(watcher: rr.ActorRef[Any]) -> None:
    watched = Worker.start()
    monitor = rr.monitor(watched)

    watched.tell("fail")

    down = monitor.wait(10)
    assert down is not None
    assert (down.reason, down.detail) == ("abnormal", "ValueError: as it was told")
    assert down.monitor == monitor.number
    assert down.ref == watched
    assert str(down) == f"{watched} is down: abnormal (ValueError: as it was told)"


def test_one_that_is_dead_already_is_down_at_once(watcher: rr.ActorRef[Any]) -> None:
    watched = Worker.start()
    watched.stop()

    watcher.ask(("watch", watched))

    assert downs_of(watcher) == [(str(watched), "noproc")]


def test_every_monitor_tells(watcher: rr.ActorRef[Any]) -> None:
    watched, calls = Worker.start(), Calls()
    for _ in range(3):
        watcher.ask(("watch", watched))
    monitor = rr.monitor(watched, calls)

    watched.stop()

    assert downs_of(watcher, 3) == [(str(watched), "normal")] * 3
    assert [down.reason for down in calls.wait()] == ["normal"]
    assert monitor.wait(10) == monitor.down == calls.items[0]


def test_after_demonitor_nothing_is_heard_even_if_it_was_on_its_way(watcher: rr.ActorRef[Any]) -> None:
    gate = Gate()

    class Busy(Watcher):
        def on_receive(self, message: Any) -> Any:
            if message == "wait and demonitor":
                gate()
                return [monitor.demonitor() for monitor in self.monitors]
            return super().on_receive(message)

    watched, busy = Worker.start(), Busy.start()
    busy.ask(("watch", watched))
    waiting = busy.ask("wait and demonitor", block=False)
    gate.wait_arrived()
    monitor = rr.monitor(watched)
    watched.stop()
    assert monitor.wait(10) is not None  # the other's Down is in the mailbox by now, or never comes
    settle()
    gate.open()

    assert waiting.get(timeout=10) == [True]
    settle()
    assert busy.ask("downs") == []
    assert busy.ask("demonitor") == [False]
    busy.stop()


class Watches:
    """Counts the watches of this process's actors that death_watch keeps."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._fires: list[weakref.ref[death_watch.Fire]] = []
        watch = death_watch.watch

        def note(ref: pykka.ActorRef[Any], fire: death_watch.Fire) -> Callable[[], None] | None:
            self._fires.append(weakref.ref(fire))
            return watch(ref, fire)

        monkeypatch.setattr(death_watch, "watch", note)

    def begun(self) -> int:
        """How many were ever begun."""
        return len(self._fires)

    def kept(self) -> int:
        """How many have not been forgotten."""
        gc.collect()
        return sum(fire() is not None for fire in self._fires)


@pytest.fixture
def watches(monkeypatch: pytest.MonkeyPatch) -> Watches:
    return Watches(monkeypatch)


def test_demonitor_leaves_nothing_behind(watches: Watches) -> None:
    watched = Worker.start()
    for _ in range(100):
        assert rr.monitor(watched, print).demonitor()
    assert (watches.begun(), watches.kept()) == (100, 0)

    watched.stop()

    eventually(lambda: event_loop.current() is None)  # no monitor holds the loop


def test_an_actor_that_ends_calls_its_monitors_off(watches: Watches) -> None:
    watched, watcher = Worker.start(), Watcher.start()
    watcher.ask(("watch", watched))
    assert watches.kept() == 1

    watcher.stop()

    assert watches.kept() == 0
    watched.stop()


def test_a_down_does_not_wait_behind_a_full_mailbox() -> None:
    gate, handled = Gate(), Calls()

    class Full(Watcher):
        mailbox_limit = 5

        def on_receive(self, message: Any) -> Any:
            if message == "wait":
                gate()
            handled("down" if isinstance(message, rr.Down) else message)
            return super().on_receive(message)

    watched, full = Worker.start(), Full.start()
    full.ask(("watch", watched))
    full.tell("wait")
    gate.wait_arrived()
    for number in range(5):
        full.tell(number)
    with pytest.raises(rr.MailboxFull):
        full.tell(5)
    monitor = rr.monitor(watched)
    watched.stop()
    assert monitor.wait(10) is not None
    settle()
    gate.open()

    assert handled.wait(8)[1:] == ["wait", "down", 0, 1, 2, 3, 4]
    full.stop()


@pytest.mark.parametrize(("how", "reason"), [("stop", "normal"), ("fail", "abnormal")])
def test_a_plain_pykka_actor_can_be_watched(watcher: rr.ActorRef[Any], how: str, reason: str) -> None:
    watched = Plain.start()
    watcher.ask(("watch", watched))

    if how == "stop":
        watched.stop()
    else:
        watched.tell(how)

    assert downs_of(watcher) == [(str(watched), reason)]
    watcher.ask(("watch", watched))
    assert downs_of(watcher, 2)[1] == (str(watched), "noproc")


def test_a_callback_may_be_a_coroutine_and_may_raise(caplog: pytest.LogCaptureFixture) -> None:
    calls = Calls()

    async def later(down: rr.Down) -> None:
        await asyncio.sleep(0)
        calls(down.reason)
        raise LookupError("not found")

    def broken(down: rr.Down) -> None:
        calls(down.reason)
        raise ArithmeticError("does not add up")

    watched = Worker.start()
    rr.monitor(watched, later)
    rr.monitor(watched, broken)
    watched.stop()

    assert calls.wait(2) == ["normal", "normal"]
    eventually(lambda: event_loop.current() is None)
    assert {record.exc_info[0] for record in caplog.records if record.exc_info} == {LookupError, ArithmeticError}


@pytest.fixture
def dead() -> Iterator[rr.ActorRef[Any]]:
    """An actor that has ended; the loop runs, and has no workers yet."""
    ref = Worker.start()
    ref.stop()
    eventually(lambda: event_loop.current() is None)
    event_loop.acquire()
    yield ref
    event_loop.release()
    eventually(lambda: event_loop.current() is None)  # no monitor holds it any more


def no_thread(_thread: threading.Thread) -> None:
    raise RuntimeError("can't start new thread")


def test_a_callback_for_which_there_is_no_thread_is_logged_and_holds_nothing(
    dead: rr.ActorRef[Any], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    calls = Calls()
    with monkeypatch.context() as scarce:
        scarce.setattr(threading.Thread, "start", no_thread)
        monitor = rr.monitor(dead, calls)
    assert not monitor.demonitor()
    assert not calls.items
    [line] = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    assert f"{dead} is down" in line
    assert "can't start new thread" in line


def test_a_coroutine_for_which_there_is_no_loop_is_logged_and_holds_nothing(
    dead: rr.ActorRef[Any], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def none_left() -> asyncio.AbstractEventLoop:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    async def never(_down: rr.Down) -> None: ...

    with monkeypatch.context() as scarce:
        scarce.setattr(user_loop, "new_loop", none_left)
        rr.monitor(dead, never)
        eventually(lambda: "the callback of <Monitor" in caplog.text)
    assert "EMFILE" in caplog.text
    settle()


def test_waiting_has_a_limit() -> None:
    watched = Worker.start()
    with rr.monitor(watched) as monitor:
        assert monitor.wait(0.01) is None
        assert monitor.down is None
    watched.stop()


def test_what_is_no_reference_cannot_be_watched() -> None:
    with pytest.raises(rr.UsageError, match="expected a reference to an actor, got str"):
        rr.monitor("root/a")
    with pytest.raises(rr.UsageError, match="expected a callable, got int"):
        rr.monitor(Worker, 1)  # type: ignore[arg-type]


def test_of_many_monitors_and_ends_at_once_none_is_lost_and_none_told_twice() -> None:
    watched = [Worker.start() for _ in range(20)]
    calls = Calls()
    begin = threading.Barrier(3)

    def watch() -> None:
        begin.wait()
        for ref in watched:
            rr.monitor(ref, calls)

    def stop() -> None:
        begin.wait()
        for ref in watched:
            ref.stop()

    threads = [threading.Thread(target=work) for work in (watch, watch, stop)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    calls.wait(40)
    eventually(lambda: event_loop.current() is None)
    assert len(calls) == 40
    assert {down.reason for down in calls} <= {"normal", "noproc"}


# -- across processes ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("how", "reason"),
    [("end", "normal"), ("shutdown", "shutdown"), ("fail", "abnormal"), ("leave", "killed"), ("kill", "killed")],
)
def test_an_end_is_heard_of_in_another_process(start: Start, how: str, reason: str) -> None:
    system = start(rr.ChildSpec(Worker, id="a", restart="temporary"), rr.ChildSpec(Watcher, id="watcher"))
    watched, watcher = system.ref("a"), system.ref("watcher")
    watcher.ask(("watch", watched))
    calls = Calls()
    monitor = rr.monitor(watched, calls)

    if how == "kill":
        os.kill(watched.ask("pid"), signal.SIGKILL)
    else:
        watched.tell(how)

    assert downs_of(watcher) == [("root/a", reason)]
    assert [down.reason for down in calls.wait()] == [reason]
    if how == "fail":
        assert monitor.down is not None
        assert monitor.down.detail == "ValueError: as it was told"


def test_the_monitor_of_a_life_tells_once_however_often_the_child_is_restarted(start: Start) -> None:
    system = start(rr.Supervisor([rr.ChildSpec(Worker, id="a")], max_restarts=10))
    watched, calls = system.ref("a"), Calls()
    rr.monitor(watched, calls)

    for kills in range(1, 4):
        pid = watched.ask("pid")
        os.kill(pid, signal.SIGKILL)
        calls.wait(kills)
        eventually(lambda pid=pid: running_pid(system, "a") not in (None, pid))
        rr.monitor(watched, calls)

    settle()
    assert [down.reason for down in calls] == ["killed"] * 3


def running_pid(system: rr.System, id: str) -> int | None:
    return next(child.pid for child in system.supervisor().which_children() if child.id == id)


@pytest.mark.parametrize("placement", ["process", "thread"])
def test_a_child_that_is_not_running_is_down_at_once(start: Start, placement: Any) -> None:
    system = start(rr.ChildSpec(Worker, id="a", placement=placement))
    watched, calls = system.ref("a"), Calls()
    system.supervisor().terminate_child("a")

    rr.monitor(watched, calls)

    assert calls.wait()[0].reason == "noproc"


@pytest.mark.parametrize("placement", ["process", "thread"])
def test_a_child_stopped_by_its_supervisor_ends_with_shutdown(start: Start, placement: Any) -> None:
    system = start(rr.ChildSpec(Worker, id="a", placement=placement))
    calls = Calls()
    rr.monitor(system.ref("a"), calls)

    system.supervisor().terminate_child("a")

    assert [down.reason for down in calls.wait()] == ["shutdown"]


@pytest.mark.parametrize(("base", "end"), [(rr.Actor, "shutdown"), (pykka.ThreadingActor, "normal")])
def test_a_child_in_a_thread_that_is_abandoned_was_killed(start: Start, base: Any, end: str) -> None:
    gate = Gate()

    class Stuck(base):
        def on_receive(self, message: Any) -> None:
            gate()

    system = start(rr.ChildSpec(Stuck, id="a", placement="thread", shutdown_s=0.05))
    watched, calls = system.ref("a"), Calls()
    rr.monitor(watched, calls)
    watched.tell("wait")
    gate.wait_arrived()
    system.supervisor().terminate_child("a")
    assert [down.reason for down in calls.wait()] == ["killed"]
    system.supervisor().restart_child("a")
    rr.monitor(watched, calls)
    gate.open()  # the old one ends now: that is not the end of the new one

    settle()
    assert len(calls) == 1
    system.supervisor().terminate_child("a")
    assert [down.reason for down in calls.wait(2)] == ["killed", end]


def test_an_actor_that_nobody_supervises_is_watched_from_another_process(start: Start) -> None:
    system = start(rr.ChildSpec(Worker, id="a"), rr.ChildSpec(Watcher, id="watcher"))
    another = system.ref("a").ask("start another")
    watcher = system.ref("watcher")
    watcher.ask(("watch", another))
    another.tell("fail")
    assert downs_of(watcher) == [(str(another), "abnormal")]

    watcher.ask(("watch", another))
    assert downs_of(watcher, 2)[1] == (str(another), "noproc")


def test_an_actor_of_this_process_is_watched_from_another(start: Start, watcher: rr.ActorRef[Any]) -> None:
    system = start(rr.ChildSpec(Watcher, id="watcher"))
    mine = Worker.start()
    system.ref("watcher").ask(("watch", mine))
    mine.stop()

    assert downs_of(system.ref("watcher")) == [(str(mine), "normal")]


def test_a_monitor_called_off_is_forgotten_in_the_other_process(start: Start, watches: Watches) -> None:
    system = start(rr.ChildSpec(Watcher, id="watcher"))
    mine = Worker.start()
    watcher = system.ref("watcher")
    watcher.ask(("watch", mine))
    eventually(lambda: watches.kept() == 1)

    assert watcher.ask("demonitor") == [True]
    eventually(lambda: watches.kept() == 0)

    watcher.ask(("watch", mine))
    eventually(lambda: watches.kept() == 1)
    assert system.supervisor().which_child("watcher").kill()  # a watcher that dies leaves none behind either
    eventually(lambda: watches.kept() == 0)
    mine.stop()


def test_the_end_of_a_supervisor_is_heard_of(start: Start) -> None:
    inner = rr.Supervisor(
        [rr.ChildSpec(Worker, id="a")], id="inner", max_restarts=0, restart="temporary", placement="process"
    )
    system = start(inner, rr.ChildSpec(Worker, id="other"))
    calls = Calls()
    rr.monitor(system.supervisor("root/inner"), calls)
    rr.monitor(system.ref("root/inner/a"), calls)

    system.ref("root/inner/a").tell("fail")

    assert sorted((str(down.ref), down.reason) for down in calls.wait(2)) == [
        ("root/inner", "shutdown"),
        ("root/inner/a", "abnormal"),
    ]


def test_all_below_a_killed_supervisor_are_heard_of(start: Start) -> None:
    below = [rr.ChildSpec(Worker, id=f"w{number}") for number in range(3)]
    inner = rr.Supervisor(below, id="inner", placement="process", restart="temporary")
    system = start(inner, rr.ChildSpec(Worker, id="other"))
    calls = Calls()
    for child in below:
        rr.monitor(system.ref(f"root/inner/{child.id}"), calls)

    assert system.supervisor().which_child("inner").kill()

    assert {down.reason for down in calls.wait(3)} == {"killed"}


def test_a_process_that_lives_but_cannot_be_reached_is_told_from_a_dead_one(start: Start) -> None:
    system = start(rr.ChildSpec(Worker, id="a"))
    watched, calls = system.ref("a"), Calls()
    rr.monitor(watched, calls)
    watched.ask("pid")
    node = node_of(system)
    (line,) = node.hub.lines()

    node.dispatcher.call(line.close)

    assert [down.reason for down in calls.wait()] == ["noconnection"]


def test_a_death_that_no_worker_can_wait_for_is_heard_of_as_a_lost_connection(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = start(rr.ChildSpec(Worker, id="a", restart="temporary"))
    calls = Calls()
    rr.monitor(system.ref("a"), calls)
    node = node_of(system)
    submit = node.dispatcher.workers.submit

    def refuse(fn: Any, *args: Any, **options: Any) -> None:
        if fn is lifeline.wait_gone:
            raise rr.MailboxFull("no thread is left")
        submit(fn, *args, **options)

    monkeypatch.setattr(node.dispatcher.workers, "submit", refuse)
    system.ref("a").kill()

    assert [down.reason for down in calls.wait()] == ["noconnection"]


def test_stopping_the_system_ends_every_monitor(state_dir: Path) -> None:
    calls = Calls()
    with rr.System([rr.ChildSpec(Worker, id="a")], state_dir=state_dir) as system:
        rr.monitor(system.ref("a"), calls)
        rr.monitor(system.supervisor(), calls)

    calls.wait(2)
    assert {(str(down.ref), down.reason) for down in calls} == {("root/a", "shutdown"), ("root", "shutdown")}


def test_an_actor_whose_start_fails_is_down() -> None:
    monitors: list[rr.Monitor] = []

    class Broken(rr.Actor):
        def on_start(self) -> None:
            monitors.append(rr.monitor(self.actor_ref))
            raise ValueError("no such device")

    with pytest.raises(ValueError, match="no such device"):
        Broken.start()

    down = monitors[0].wait(10)
    assert down is not None
    assert (down.reason, down.detail) == ("abnormal", "ValueError: no such device")


def test_a_process_that_was_stopped_before_it_could_answer_is_told_of_when_it_dies(start: Start) -> None:
    system = start(rr.ChildSpec(Worker, id="a", restart="temporary"))
    watched, calls = system.ref("a"), Calls()
    pid = running_pid(system, "a")
    assert pid is not None
    hang(pid)
    rr.monitor(watched, calls)

    os.kill(pid, signal.SIGKILL)

    assert [down.reason for down in calls.wait()] == ["killed"]


def hold_connections(system: rr.System, monkeypatch: pytest.MonkeyPatch) -> tuple[threading.Event, threading.Event]:
    """Return an event for the next connection of this process that is to be made, and one that lets it be made."""
    transport, asked, may_connect = node_of(system).transport, threading.Event(), threading.Event()
    connect = transport.connect

    async def late(*args: Any) -> Any:
        asked.set()
        await asyncio.to_thread(may_connect.wait)
        return await connect(*args)

    monkeypatch.setattr(transport, "connect", late)
    return asked, may_connect


@pytest.mark.parametrize(("how", "reason"), [("in order", "noproc"), ("killed", "killed")])
@pytest.mark.parametrize("restart", ["temporary", "transient"])
def test_only_a_process_that_was_killed_before_it_got_the_watch_was_killed(
    start: Start, monkeypatch: pytest.MonkeyPatch, how: str, reason: str, restart: Any
) -> None:
    system = start(rr.ChildSpec(Worker, id="a", restart=restart))
    calls = Calls()
    pid = running_pid(system, "a")
    assert pid is not None
    asked, may_connect = hold_connections(system, monkeypatch)
    watching = threading.Thread(target=rr.monitor, args=(system.ref("a"), calls))
    watching.start()
    assert asked.wait(10)
    if how == "killed":
        os.kill(pid, signal.SIGKILL)
    else:
        system.supervisor().terminate_child("a")
    wait_gone(pid)
    may_connect.set()

    assert [down.reason for down in calls.wait()] == [reason]
    watching.join()


def test_a_supervisor_that_is_late_to_say_how_a_process_ended_is_waited_for(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = start(rr.ChildSpec(Worker, id="a", restart="temporary"))
    directory, calls = node_of(system).directory, Calls()
    pid = running_pid(system, "a")
    assert pid is not None
    up = directory.lookup(actor_key("root/a"))
    asked, may_connect = hold_connections(system, monkeypatch)
    lookup, looks, said = directory.lookup, itertools.count(), threading.Event()

    def as_before(name: str) -> Any:
        if name != actor_key("root/a") or said.is_set():
            return lookup(name)
        if next(looks) > 2 * hub.CUT_S / 0.01:  # far more often than in the time in which a link's end is looked into
            said.set()
        return up

    watching = threading.Thread(target=rr.monitor, args=(system.ref("a"), calls))
    watching.start()
    assert asked.wait(10)
    system.supervisor().terminate_child("a")
    wait_gone(pid)
    monkeypatch.setattr(directory, "lookup", as_before)
    may_connect.set()

    assert [down.reason for down in calls.wait()] == ["noproc"]
    assert said.is_set()
    watching.join()


def test_a_monitor_is_there_when_monitor_returns_however_long_the_connection_takes(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = start(rr.ChildSpec(Worker, id="a", restart="temporary"))
    asked, may_connect = hold_connections(system, monkeypatch)
    looks, looked = itertools.count(), threading.Event()

    def running(_address: str) -> str:
        if next(looks) == 2:
            looked.set()
        return ""

    monkeypatch.setattr(hub, "paused", running)
    monkeypatch.setattr(hub, "WATCH_S", 0.01)
    watching: list[rr.Monitor] = []
    thread = threading.Thread(target=lambda: watching.append(rr.monitor(system.ref("a"))))
    thread.start()
    assert asked.wait(10)
    assert looked.wait(10)
    assert not watching
    may_connect.set()
    thread.join()
    system.supervisor().terminate_child("a")

    down = watching[0].wait(10)
    assert down is not None
    assert down.reason == "shutdown"


def test_a_death_is_heard_of_also_when_all_workers_are_busy(start: Start) -> None:
    system = start(rr.ChildSpec(Worker, id="a", restart="temporary"), config=rr.SystemConfig(workers_limit=2))
    provider, app, gate = system.open_registrar("provider"), system.open_registrar("app"), Gate()
    serve(provider, "slow", load=gate)
    watched, calls = system.ref("a"), Calls()
    rr.monitor(watched, calls)
    pid = running_pid(system, "a")
    assert pid is not None
    waiting = [app.load("provider/slow", number, block=False) for number in range(2)]
    gate.wait_arrived(2)

    os.kill(pid, signal.SIGKILL)
    eventually(lambda: not watched.is_alive())
    gate.open()

    assert [down.reason for down in calls.wait()] == ["killed"]
    for reply in waiting:
        reply.get(timeout=30)


class AsyncWatcher(Watcher):
    async def on_receive(self, message: Any) -> Any:  # type: ignore[override]
        await asyncio.sleep(0)
        return super().on_receive(message)


def test_an_async_handler_may_monitor_without_waiting(start: Start) -> None:
    system = start(rr.ChildSpec(Worker, id="a"), rr.ChildSpec(AsyncWatcher, id="watcher"))
    watched, watcher = system.ref("a"), system.ref("watcher")
    pid = watched.ask("pid")

    watcher.ask(("watch", watched))
    os.kill(pid, signal.SIGKILL)

    assert downs_of(watcher) == [("root/a", "killed")]


@pytest.mark.parametrize("placement", ["process", "thread"])
def test_a_plain_pykka_actor_that_is_supervised_can_be_watched(start: Start, placement: Any) -> None:
    system = start(rr.ChildSpec(Plain, id="a", placement=placement, restart="temporary"))
    watched, calls = system.ref("a"), Calls()
    rr.monitor(watched, calls)

    watched.tell("fail")

    assert [(str(down.ref), down.reason) for down in calls.wait()] == [("root/a", "abnormal")]
    assert calls.items[0].detail == "ValueError: as it was told"


class Mute(Exception):
    """An error that cannot say what it is."""

    def __str__(self) -> str:
        raise RuntimeError("no words")


class Striker(rr.Actor):
    def on_receive(self, message: Any) -> Any:
        if message == "strike":
            raise Mute
        return os.getpid()


class ThreadedStriker(pykka.ThreadingActor):
    def on_receive(self, message: Any) -> Any:
        if message == "strike":
            raise Mute
        return os.getpid()


@pytest.mark.parametrize("placement", ["process", "thread"])
@pytest.mark.parametrize("kind", [Striker, ThreadedStriker])
def test_a_child_whose_error_cannot_say_what_it_is_is_restarted_like_any_other(
    start: Start, kind: type[Any], placement: Any
) -> None:
    striker = start(rr.ChildSpec(kind, id="striker", placement=placement)).ref("striker")
    with pytest.raises(Exception) as caught:
        striker.ask("strike", timeout=5)
    assert type(caught.value).__name__ == "Mute"
    watch = rr.monitor(striker)
    striker.tell("strike")
    down = watch.wait(10)
    assert down is not None
    assert "Mute" in down.detail
    eventually(striker.is_alive)
    striker.ask("anything")
