"""What programs written for Pykka, and for multiprocessing, find when their actors are children in other processes."""

from __future__ import annotations

import copy
import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pykka
import pytest

import rr_actors as rr
from rr_actors.actors.refs import ref_to
from rr_actors.runtime import event_loop
from support import eventually
from support_pykka import (
    Carrier,
    Eager,
    Plain,
    PlainShelf,
    Shelf,
    Worker,
    put_late,
    registered,
    start_another,
    write_at_exit,
)
from support_steps import steps_of

Start = Callable[..., rr.System]

# -- what cannot leave its process -------------------------------------------------------------------------------------


def test_a_pipes_end_among_a_childs_arguments_is_refused_by_name(start: Start) -> None:
    here, there = multiprocessing.Pipe()
    with here, there:
        with pytest.raises(
            rr.StartFailed, match=r"args.*item 0: cannot pickle 'multiprocessing.connection.Connection'"
        ):
            start(rr.ChildSpec(Worker, "worker", args=(there,)))
        here.send("open")
        assert there.recv() == "open"


# -- pykka.ActorRegistry -----------------------------------------------------------------------------------------------


def test_the_registry_holds_what_was_started_by_hand_and_stop_all_leaves_the_system_alone(start: Start) -> None:
    children = [rr.ChildSpec(Worker, f"w{n}", placement="thread") for n in range(4)]
    system = start(*children, rr.ChildSpec(Plain, "plain", placement="thread"), rr.ChildSpec(Worker, "far"))
    own, plain = Worker.start(), Plain.start()
    assert pykka.ActorRegistry.get_all() == [own, plain]
    assert pykka.ActorRegistry.get_by_class(Worker) == [own]
    pykka.ActorRegistry.broadcast("to those only")
    restarts = system.supervisor().history()
    assert pykka.ActorRegistry.stop_all() == [True, True]
    assert not own.is_alive()
    assert pykka.ActorRegistry.get_all() == []
    for child in ("w0", "plain", "far"):
        assert system.ref(child).ask("alive") == "alive"
    assert system.supervisor().history() == restarts


def test_an_actor_that_ends_is_compared_with_none_of_the_others() -> None:
    def steps(others: int) -> int:
        refs = [Worker.start() for _ in range(others + 1)]
        try:
            taken, _ = steps_of(lambda: pykka.ActorRegistry.unregister(refs[-1]))
            assert pykka.ActorRegistry.get_all() == refs[:-1]
        finally:
            pykka.ActorRegistry.stop_all()
            refs[-1].stop()
        return taken

    assert steps(200) == steps(1)


def test_in_a_childs_process_the_registry_holds_what_the_child_has_started(start: Start) -> None:
    system = start(rr.ChildSpec(Worker, "far"))
    far = system.ref("far")
    assert far.ask(registered) == []
    urn = far.ask(start_another)
    assert far.ask(registered) == [urn]
    assert far.ask(lambda _: pykka.ActorRegistry.stop_all()) == [True]
    assert far.ask("alive") == "alive"


# -- a temporary actor that was stopped --------------------------------------------------------------------------------


@pytest.mark.parametrize("cls", [Worker, Plain])
@pytest.mark.parametrize("placement", ["process", "thread"])
def test_a_temporary_actor_that_was_stopped_is_dead_at_once(start: Start, cls: Any, placement: Any) -> None:
    system = start()
    for number in range(5):
        ref = system.start_child(rr.ChildSpec(cls, f"a{number}", restart="temporary", placement=placement))
        assert ref is not None
        assert ref.ask("alive") == "alive"
        assert ref.stop()
        with pytest.raises(rr.ActorDeadError):
            ref.ask("anybody?")
        assert not ref.is_alive()


@pytest.mark.parametrize("placement", ["process", "thread"])
def test_what_waits_for_a_temporary_actor_that_is_stopped_fails_with_actor_dead_error(
    start: Start, tmp_path: Path, placement: Any
) -> None:
    ref = start().start_child(rr.ChildSpec(Worker, "a", restart="temporary", placement=placement))
    assert ref is not None
    works = ref.proxy().work_until(str(tmp_path / "go"))
    stopped = ref.stop(block=False)
    waits = [ref.ask("late", block=False) for _ in range(3)]
    (tmp_path / "go").touch()
    for future in waits:
        with pytest.raises(rr.ActorDeadError):
            future.get(timeout=10)
    assert works.get(timeout=10) is None
    assert stopped.get(timeout=10) is True


def test_what_waits_for_a_temporary_actor_that_is_killed_fails_with_actor_dead_error(start: Start) -> None:
    system = start()
    ref = system.start_child(rr.ChildSpec(Worker, "a", restart="temporary"))
    assert ref is not None
    with pytest.raises(rr.ActorDeadError):
        ref.ask(lambda _: os.kill(os.getpid(), signal.SIGKILL))
    with pytest.raises(rr.ActorDeadError):
        ref.ask("anybody?")


def test_a_permanent_actor_that_was_stopped_comes_back(start: Start) -> None:
    ref = start(rr.ChildSpec(Worker, "a")).ref("a")
    pid = ref.ask(lambda _: os.getpid())
    assert ref.stop()

    def asked() -> Any:
        try:
            return ref.ask(lambda _: os.getpid())
        except rr.ActorUnavailable:
            return None

    assert eventually(asked) != pid


# -- proxies -----------------------------------------------------------------------------------------------------------


@pytest.fixture(params=["ours, here", "ours, elsewhere", "Pykka's, elsewhere"])
def shelf(request: pytest.FixtureRequest, start: Start) -> Iterator[Any]:
    """A proxy of a Shelf."""
    if request.param == "ours, here":
        system = start()
        ref: Any = Shelf.start()
        yield ref.proxy()
        ref.stop()
        del system
    else:
        cls = Shelf if request.param.startswith("ours") else PlainShelf
        yield start(rr.ChildSpec(cls, "shelf")).ref("shelf").proxy()


def test_a_proxy_has_the_operators_that_the_actor_has(shelf: Any) -> None:
    shelf["cup"] = "blue"
    shelf["pot"] = "red"
    assert len(shelf) == 2
    assert shelf["cup"] == "blue"
    assert "cup" in shelf
    assert list(shelf) == ["cup", "pot"]
    del shelf["cup"]
    assert "cup" not in shelf
    with pytest.raises(KeyError, match="cup"):
        shelf["cup"]
    assert len(shelf.drawer) == 2


def test_a_proxy_is_a_context_manager_if_the_actor_is(shelf: Any) -> None:
    with shelf as entered:
        assert entered == shelf
        assert entered.opened.get() == 1
        raise KeyError("forgiven")
    assert shelf.opened.get() == 0
    with pytest.raises(KeyError, match="not forgiven"), shelf:
        raise KeyError("not forgiven")


def test_a_proxy_has_no_operators_that_the_actor_has_not(start: Start) -> None:
    system = start(rr.ChildSpec(Worker, "worker"))
    for ref in (system.ref("worker"), Worker.start()):
        proxy: Any = ref.proxy()
        assert proxy
        for use in (len, iter, lambda proxy: proxy[0], lambda proxy: proxy()):
            with pytest.raises(TypeError):
                use(proxy)
    pykka.ActorRegistry.stop_all()


def test_proxies_travel_and_are_equal_where_they_arrive(shelf: Any, start: Start) -> None:
    for made in (
        shelf,
        copy.copy(shelf),
        pickle.loads(pickle.dumps(shelf)),
        pykka.ActorProxy(actor_ref=shelf.actor_ref),
    ):
        twin = pickle.loads(pickle.dumps(made))
        assert twin == shelf
        assert twin.actor_ref == shelf.actor_ref
        assert twin.put("cup", 1).get(timeout=10) == 1
        assert len(twin) == 1
        assert len(twin.drawer) == 2
    assert len({shelf, copy.copy(shelf)}) == 1
    assert pickle.loads(pickle.dumps(shelf.put))("cup", 2).get(timeout=10) == 1


def test_a_proxy_in_a_message_an_argument_and_an_attribute_works_there(system: rr.System) -> None:
    first, second = (system.start_child(rr.ChildSpec(Shelf, name)) for name in ("first", "second"))
    assert first is not None
    assert second is not None
    proxy: Any = second.proxy()
    assert proxy.ask_through(first.proxy()).get(timeout=10) == (1, "shelf", 1)
    here = Shelf.start()
    assert proxy.ask_through(here.proxy()).get(timeout=10) == (1, "shelf", 1)
    here.stop()
    carrier = system.start_child(rr.ChildSpec(Carrier, "carrier", args=(first.proxy(),)))
    assert carrier is not None
    carries: Any = carrier.proxy()
    assert carries.put().get(timeout=10) == 2
    assert carries.shelf.get(timeout=10) == first.proxy()
    system.supervisor().terminate_child("first")
    assert "shelf" in dir(carrier.proxy())  # though nobody can be asked about it


def test_pykkas_own_class_makes_a_proxy_of_an_actor_elsewhere(shelf: Any) -> None:
    proxy: Any = pykka.ActorProxy(actor_ref=shelf.actor_ref)
    assert proxy.put("cup", 1).get(timeout=10) == 1
    assert proxy.label.get(timeout=10) == "shelf"
    assert proxy.drawer.socks.get(timeout=10) == 2
    proxy.label = "other"
    assert shelf.label.get(timeout=10) == "other"
    setattr(proxy, "added", "later")  # noqa: B010 - a type checker takes what is set for what is read
    assert proxy.added.get(timeout=10) == "later"
    with pytest.raises(AttributeError, match="nonsense"):
        _ = proxy.nonsense
    assert proxy == pykka.ActorProxy(actor_ref=shelf.actor_ref)
    assert proxy == shelf
    assert proxy != proxy.drawer
    assert {"put", "label", "drawer", "__class__", "__getattr__"} <= set(dir(proxy))
    assert {"put", "label", "drawer", "__class__", "__getattr__", "__dict__", "__setattr__"} <= set(dir(shelf))


def test_an_attribute_that_is_the_actors_own_proxy_is_hidden(shelf: Any) -> None:
    assert shelf.label.get(timeout=10) == "shelf"
    for proxy in (shelf, shelf.actor_ref.proxy(), pykka.ActorProxy(actor_ref=shelf.actor_ref)):
        assert "own_proxy" not in dir(proxy)
        with pytest.raises(AttributeError, match="own_proxy"):
            _ = proxy.own_proxy


def test_a_proxy_of_a_dead_actor_is_refused(system: rr.System) -> None:
    ref = system.start_child(rr.ChildSpec(Shelf, "shelf", restart="temporary"))
    assert ref is not None
    ref.stop()
    for make in (ref.proxy, lambda: pykka.ActorProxy(actor_ref=ref)):
        with pytest.raises(rr.ActorDeadError):
            make()


# -- what OTP, Elixir and multiprocessing have -------------------------------------------------------------------------


def test_atexit_handlers_of_a_child_run_when_it_is_stopped(start: Start, tmp_path: Path) -> None:
    system = start(rr.ChildSpec(Worker, "stopped"), rr.ChildSpec(Worker, "ended", restart="temporary"))
    for name in ("stopped", "ended"):
        system.ref(name).ask(write_at_exit(str(tmp_path / name)))
    system.ref("ended").stop()
    eventually((tmp_path / "ended").exists)
    assert not (tmp_path / "stopped").exists()
    system.supervisor().terminate_child("stopped")
    assert (tmp_path / "stopped").read_text() == "written"


def test_a_reference_tells_the_process_and_kills_it(start: Start) -> None:
    system = start(rr.ChildSpec(Worker, "far"), rr.ChildSpec(Worker, "near", placement="thread"))
    far, near, own = system.ref("far"), system.ref("near"), Worker.start()
    assert far.pid == far.ask(lambda _: os.getpid()) == far.ask(lambda actor: actor.actor_ref.pid)
    assert near.pid == own.pid == os.getpid()
    killed = far.pid
    for ref in (near, own, system.supervisor().actor_ref):
        with pytest.raises(rr.UsageError, match="no process of its own"):
            ref.kill()
    assert far.kill()
    eventually(lambda: far.pid not in (None, killed))
    assert far.ask("alive") == "alive"
    assert near.ask("alive") == "alive"
    assert [record.signal for record in system.supervisor().history() if record.event == "exited"] == ["SIGKILL"]
    system.supervisor().terminate_child("far")
    assert far.pid is None
    assert not far.kill()
    own.stop()
    assert own.pid is None


def test_a_python_without_pidfds_kills_by_a_reference_all_the_same(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    far = start(rr.ChildSpec(Worker, "far")).ref("far")
    killed = far.pid
    monkeypatch.delattr(os, "pidfd_open", raising=False)
    assert far.kill()
    eventually(lambda: far.pid not in (None, killed))


def test_a_timer_sends_its_message_once_unless_it_is_cancelled(start: Start) -> None:
    shelf: Any = start(rr.ChildSpec(Shelf, "shelf")).ref("shelf").proxy()
    never = rr.send_after(3600, shelf, put_late("never"))
    timer = rr.send_after(0.05, shelf.actor_ref, put_late("cup"))
    eventually(lambda: "cup" in shelf)
    eventually(lambda: timer.left_s is None)
    assert timer.cancel() is None
    assert 3000 < (never.left_s or 0) <= 3600
    assert 3000 < (never.cancel() or 0) <= 3600
    assert never.cancel() is None
    assert never.left_s is None
    assert list(shelf) == ["cup"]


class Hostile:
    @property
    def actor_ref(self) -> Any:
        raise RuntimeError("not for you")


def test_a_timer_for_an_actor_that_has_ended_harms_nobody(caplog: pytest.LogCaptureFixture) -> None:
    ref = Worker.start()
    ref.stop()
    timer = rr.send_after(0, ref, "late")
    eventually(lambda: "the message of a timer was not sent" in caplog.text)
    assert timer.left_s is None
    wrong = (-1, ref), ("soon", ref), (1, "somebody"), (1, Hostile()), (None, ref), (float("nan"), ref)
    for delay, whom in wrong:
        with pytest.raises(rr.UsageError, match="send_after"):
            rr.send_after(delay, whom, "x")  # type: ignore[arg-type]


def test_a_timer_for_which_there_is_no_thread_logs_that_its_message_is_lost(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def no_thread(_thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    eventually(lambda: event_loop.current() is None)
    event_loop.acquire()
    ref = ref_to("root/nobody")
    with monkeypatch.context() as scarce:
        scarce.setattr(threading.Thread, "start", no_thread)
        rr.send_after(0, ref, "late")
        eventually(lambda: "was not sent to root/nobody" in caplog.text)
    assert "can't start new thread" in caplog.text
    event_loop.release()
    eventually(lambda: event_loop.current() is None)


def test_which_child_tells_of_one_child(start: Start) -> None:
    supervisor = start(rr.ChildSpec(Worker, "a"), rr.ChildSpec(Worker, "b")).supervisor()
    found = supervisor.which_child("b")
    assert found in supervisor.which_children()
    assert (found.id, found.state, found.pid) == ("b", "running", found.ref.pid)
    assert supervisor.which_child(found.ref) == found
    with pytest.raises(rr.NotFound, match="'c'"):
        supervisor.which_child("c")


def test_a_dynamic_supervisor_has_max_children_at_most(start: Start) -> None:
    pool = rr.Supervisor([rr.ChildSpec(Worker)], "pool", strategy="simple_one_for_one", max_children=2)
    system = start(rr.Supervisor([pool]))
    supervisor = system.supervisor("pool")
    first = supervisor.start_child([])
    assert first is not None
    supervisor.start_child([])
    with pytest.raises(rr.TooManyChildren, match="max_children is 2") as refused:
        supervisor.start_child([])
    assert (refused.value.id, refused.value.limit) == ("root/pool", 2)
    supervisor.terminate_child(first)
    assert supervisor.start_child([]) is not None
    assert supervisor.describe()["max_children"] == 2
    assert "at most 2" in str(system.tree())


@pytest.mark.parametrize(("strategy", "limit"), [("one_for_one", 2), ("", -1), ("", 1.5), ("", True)])
def test_max_children_is_checked(strategy: Any, limit: Any) -> None:
    with pytest.raises(rr.InvalidSpec, match="max_children"):
        rr.Supervisor([rr.ChildSpec(Worker)], strategy=strategy or "simple_one_for_one", max_children=limit)


@pytest.mark.parametrize("inner", ["thread", "process"])
@pytest.mark.parametrize("placement", ["thread", "process"])
def test_a_child_that_asks_its_supervisor_in_its_first_on_start_hears_when_to_ask(
    start: Start, placement: Any, inner: Any
) -> None:
    eager = rr.ChildSpec(Eager, "eager", placement=placement)
    system = start(rr.Supervisor([eager, rr.Supervisor([eager], "inner", placement=inner)]))
    for path in ("eager", "inner/eager"):
        heard: Any = system.ref(path).proxy().heard.get(timeout=10)
        above = f"root/{path}".rpartition("/")[0]
        assert heard == {asked: f"supervisor {asked!r} is starting root/{path}" for asked in {above, "root"}}
        assert [child.id for child in system.ref(path).ask("later")][-1] == "eager"
