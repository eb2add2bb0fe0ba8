"""tell() to an actor that is known to have ended for good raises, in whatever process the actor was."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable
from typing import Any

import pykka
import pytest

import rr_actors as rr
from support import eventually, wait_gone


class Worker(rr.Actor):
    def on_receive(self, message: Any) -> Any:
        return message


class Maker(rr.Actor):
    """Starts actors that no supervisor watches."""

    def make(self) -> rr.ActorRef:
        return Worker.start()

    def end(self, ref: rr.ActorRef) -> None:
        ref.stop()

    def leave(self) -> None:
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.fixture
def maker(start: Callable[..., rr.System]) -> Any:
    return start(rr.ChildSpec(Maker, id="maker")).ref("maker").proxy()


def test_after_stop_tell_raises(maker: Any) -> None:
    ref = maker.make().get(timeout=5)
    assert ref.ask("hello") == "hello"
    assert ref.stop() is True
    with pytest.raises(rr.ActorDeadError):
        ref.tell("more")
    with pytest.raises(rr.ActorDeadError):
        ref.ask("more")


def test_after_an_ask_found_it_dead_tell_raises(maker: Any) -> None:
    ref = maker.make().get(timeout=5)
    maker.end(ref).get(timeout=5)
    with pytest.raises(rr.ActorDeadError):
        ref.ask("more")
    with pytest.raises(rr.ActorDeadError):
        ref.tell("more")
    assert ref.stop() is False


@pytest.mark.parametrize("asked", [False, True])
def test_after_the_death_of_the_process_of_an_actor_that_nobody_supervises_tell_raises(maker: Any, asked: bool) -> None:
    ref = maker.make().get(timeout=5)
    if asked:
        assert ref.ask("hello") == "hello"
    pid = ref.pid
    with contextlib.suppress(rr.ActorUnavailable):
        maker.leave().get(timeout=5)
    wait_gone(pid)
    eventually(lambda: tell_raises(ref))  # when the loop has seen that the connection to the process is lost
    for _ in range(3):
        assert tell_raises(ref)
    with pytest.raises(rr.ActorDeadError):
        ref.ask("more")


def tell_raises(ref: rr.ActorRef) -> bool:
    try:
        ref.tell("more")
    except rr.ActorDeadError:
        return True
    return False


@pytest.mark.parametrize("restart", ["temporary", "transient"])
def test_after_the_end_of_a_child_that_shares_a_process_with_its_supervisor_tell_raises(
    start: Callable[..., rr.System], restart: Any
) -> None:
    worker = rr.ChildSpec(Worker, id="worker", restart=restart, placement="thread")
    ref = start(rr.Supervisor([worker], id="inner", placement="process")).ref("worker")
    assert ref.ask("hello") == "hello"
    assert ref.stop() is True
    with pytest.raises((rr.ActorDeadError, rr.ActorUnavailable)):
        ref.tell("more")


@pytest.mark.parametrize("restart", ["temporary", "transient"])
def test_after_stop_of_a_child_that_is_not_started_again_tell_raises(
    start: Callable[..., rr.System], restart: Any
) -> None:
    ref = start(rr.ChildSpec(Worker, id="worker", restart=restart)).ref("worker")
    ref.tell("a")
    assert ref.stop() is True
    with pytest.raises((rr.ActorDeadError, rr.ActorUnavailable)):
        ref.tell("more")
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        try:
            ref.tell("more")
        except pykka.ActorDeadError:
            return
        except rr.ActorUnavailable:
            time.sleep(0.01)
    raise AssertionError("tell() never raises ActorDeadError")
