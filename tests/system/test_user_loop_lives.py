"""Whatever a user's coroutines do to the loop on which they run, later coroutines run: the user loop does not end."""

from __future__ import annotations

import asyncio
import logging
import sys
import threading
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any, NoReturn

import pytest

import rr_actors as rr
from rr_actors.runtime import user_loop
from support import LIMIT_S, child, eventually


async def _exit() -> NoReturn:
    sys.exit("a background task")


async def exit_in_a_task() -> None:
    asyncio.ensure_future(_exit())  # noqa: RUF006 - it ends at once
    await asyncio.sleep(0.01)


async def exit_in_a_call() -> None:
    asyncio.get_running_loop().call_soon(sys.exit, 3)
    await asyncio.sleep(0.01)


async def interrupt_in_a_task() -> None:
    async def interrupt() -> None:
        raise KeyboardInterrupt

    asyncio.ensure_future(interrupt())  # noqa: RUF006
    await asyncio.sleep(0.01)


async def cancel_all_tasks() -> None:
    for task in asyncio.all_tasks():
        task.cancel()


async def stop_the_loop() -> None:
    asyncio.get_running_loop().stop()
    await asyncio.sleep(0.01)


async def raise_in_the_task_factory() -> None:
    def factory(*_: Any, **__: Any) -> Any:
        raise SystemExit("no task")

    asyncio.get_running_loop().set_task_factory(factory)


async def raise_in_the_exception_handler() -> None:
    loop = asyncio.get_running_loop()
    loop.set_exception_handler(lambda *_: sys.exit("no handler"))
    loop.call_soon(lambda: 1 // 0)
    await asyncio.sleep(0.01)


HARMS = (
    exit_in_a_task,
    exit_in_a_call,
    interrupt_in_a_task,
    cancel_all_tasks,
    stop_the_loop,
    raise_in_the_task_factory,
    raise_in_the_exception_handler,
)
_BY_NAME = {harm.__name__: harm for harm in HARMS}


class Host(rr.Manager):
    """Serves "echo" by a coroutine, and "harm", whose callback does one of HARMS."""

    @rr.server("echo")
    async def echo(self, request: int) -> int:
        await asyncio.sleep(0)
        return request

    @rr.server("harm")
    async def harm(self, request: str) -> str:
        await _BY_NAME[request]()
        return request


class Greeter(rr.Actor):
    """Answers by a coroutine."""

    async def on_receive(self, message: Any) -> Any:
        await asyncio.sleep(0)
        return message


@pytest.mark.parametrize("placement", ["process", "thread"])
@pytest.mark.parametrize("harm", [harm.__name__ for harm in HARMS])
def test_a_coroutine_that_breaks_into_the_user_loop_stops_no_later_coroutine(
    start: Callable[..., rr.System], placement: Any, harm: str
) -> None:
    system = start(
        rr.ChildSpec(Host, id="host", placement=placement), rr.ChildSpec(Greeter, id="greeter", placement="thread")
    )
    app = system.open_registrar("app")
    before = child(system, "host").pid
    with pytest.raises(rr.LoadFailed, match="CancelledError") if harm == "cancel_all_tasks" else nullcontext():
        app.load("host/harm", harm, timeout_s=10.0)
    for number in range(3):
        assert app.load("host/echo", number, timeout_s=10.0).response == number
        assert system.ref("greeter").ask(number, timeout=10.0) == number
    assert child(system, "host").pid == before
    eventually(lambda: child(system, "host").state == "running")


blocked, go_on = threading.Event(), threading.Event()


async def block(_request: str) -> str:
    blocked.set()
    _wait_in_vain()
    return "back"


def _wait_in_vain() -> None:
    assert go_on.wait(LIMIT_S)


async def echo(request: str) -> str:
    await asyncio.sleep(0)
    return request


def test_a_coroutine_that_blocks_is_named_once_and_the_others_go_on_after_it(
    start: Callable[..., rr.System], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(user_loop, "BLOCKED_S", 0.1)
    caplog.set_level(logging.WARNING, "rr_actors")
    app = start().open_registrar("app")
    app.register_server("block", block)
    app.register_server("echo", echo)

    def named() -> list[str]:
        return [text for text in caplog.messages if "blocks all others" in text]

    assert app.load("app/echo", "before").response == "before"
    for _ in range(2):
        caplog.clear()
        blocked.clear()
        go_on.clear()
        blocking = app.load("app/block", "", timeout_s=LIMIT_S, block=False)
        assert blocked.wait(LIMIT_S)
        waiting = app.load("app/echo", "meanwhile", timeout_s=LIMIT_S, block=False)
        eventually(lambda: bool(named()))
        go_on.set()
        for future in (blocking, waiting):
            future.get().unload()
        assert len(named()) == 1
        assert "block (" in named()[0]
        assert "now in Condition.wait (" in named()[0]
        assert __file__ in named()[0]
