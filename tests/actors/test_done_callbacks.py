"""Done callbacks of futures are a user's code: they run off the loop, after the waiters, and harm nobody."""

from __future__ import annotations

import asyncio
import concurrent.futures
import sys
import threading
from collections.abc import Callable
from typing import Any, NoReturn

import pytest

import rr_actors as rr
from support import LIMIT_S, Calls, Gate, serve


class _Base(BaseException):
    """Neither an Exception nor one of Python's own."""


def _read_a_cancelled_task(_: object) -> None:
    async def read() -> None:
        task = asyncio.ensure_future(asyncio.sleep(60))
        task.cancel()
        await asyncio.wait([task])
        task.result()

    asyncio.run(read())


def _exit(_: object) -> NoReturn:
    sys.exit("a done callback")


def _generator_exit(_: object) -> NoReturn:
    raise GeneratorExit


def _interrupt(_: object) -> NoReturn:
    raise KeyboardInterrupt


def _base(_: object) -> NoReturn:
    raise _Base


def _error(_: object) -> NoReturn:
    raise ValueError("no")


BAD = (_read_a_cancelled_task, _exit, _generator_exit, _interrupt, _base, _error)


class Answerer(rr.Actor):
    """Answers when it is let: first it tells the gate that it handles the message."""

    def __init__(self, gate: Gate) -> None:
        self.gate = gate

    def on_receive(self, message: Any) -> Any:
        if message == "wait":
            self.gate()
        return message


class Remote(rr.Actor):
    """Answers from another process."""

    def on_receive(self, message: Any) -> Any:
        return message


@pytest.mark.parametrize("bad", BAD, ids=lambda bad: bad.__name__)
def test_whatever_a_done_callback_of_a_load_raises_its_waiters_get_the_query_and_the_link_lives(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate, bad: Callable[..., Any]
) -> None:
    serve(provider, "slow", load=gate)
    heard = Calls()
    future: Any = app.load("provider/slow", "x", block=False)
    future.add_done_callback(bad)
    future.add_done_callback(heard)
    gate.wait_arrived()
    gate.open()
    assert future.get(timeout=LIMIT_S).request == "x"
    assert heard.wait() == [future]
    if bad is not _interrupt:  # the main thread calls it at once, so that it would be Ctrl-C
        future.add_done_callback(bad)
    assert app.load("provider/slow", "y", timeout_s=LIMIT_S).request == "y"


@pytest.mark.parametrize("bad", BAD, ids=lambda bad: bad.__name__)
def test_whatever_a_done_callback_of_an_ask_raises_the_answering_actor_goes_on(
    start: Callable[..., rr.System], bad: Callable[..., Any]
) -> None:
    gate = Gate()
    system = start(rr.ChildSpec(Remote, id="remote"))
    answerer = Answerer.start(gate)
    asked: Any = answerer.ask("wait", block=False)
    asked.add_done_callback(bad)
    gate.wait_arrived()
    gate.open()
    assert asked.get(timeout=LIMIT_S) == "wait"
    assert answerer.ask("again", timeout=LIMIT_S) == "again"
    far: Any = system.ref("remote").ask(1, block=False)
    far.add_done_callback(bad)
    assert far.get(timeout=LIMIT_S) == 1
    assert system.ref("remote").ask(2, timeout=LIMIT_S) == 2
    answerer.stop()


def test_a_done_callback_that_waits_holds_up_no_load_no_waiter_and_no_actor(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "slow", load=gate)
    serve(provider, "quick")
    stuck = Gate()
    loading: Any = app.load("provider/slow", "x", block=False)
    loading.add_done_callback(stuck)
    answerer = Answerer.start(gate)
    asked: Any = answerer.ask("wait", block=False)
    asked.add_done_callback(stuck)
    gate.wait_arrived(2)
    gate.open()
    assert concurrent.futures.wait([loading, asked], LIMIT_S).not_done == set()
    stuck.wait_arrived(2)
    assert app.load("provider/quick", 1, timeout_s=LIMIT_S).request == 1
    assert answerer.ask("again", timeout=LIMIT_S) == "again"
    stuck.open()
    answerer.stop()


def test_done_callbacks_run_in_their_order_and_on_no_loop(
    app: rr.Registrar, provider: rr.Registrar, gate: Gate
) -> None:
    serve(provider, "slow", load=gate)
    seen = Calls()
    loading: Any = app.load("provider/slow", "x", block=False)
    for number in range(5):
        loading.add_done_callback(lambda _, number=number: seen(number, threading.current_thread().name))
    gate.wait_arrived()
    gate.open()
    assert [number for number, _ in seen.wait(5)] == list(range(5))
    assert not {name for _, name in seen} & {"rr-loop", "rr-user-loop"}
