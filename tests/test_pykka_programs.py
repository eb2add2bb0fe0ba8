"""What programs written for Pykka, and for multiprocessing, find when their actors are children in other processes."""

from __future__ import annotations

import multiprocessing
import os
import signal
from pathlib import Path
from typing import Any

import pykka
import pytest

import rr_actors as rr
from conftest import Start
from support import eventually
from support_pykka import Plain, Worker, registered, start_another

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
