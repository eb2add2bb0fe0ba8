"""A child that a signal has stopped is named as that in whatever waits for it."""

from __future__ import annotations

import asyncio
import os
import re
import signal
from collections.abc import Callable, Iterator
from typing import Any

import pykka
import pytest

import rr_actors as rr
from support import LIMIT_S, eventually, hang, pid_of

STOPPED = r"is stopped by a signal, .*kill -CONT"


class Asked(rr.Manager):
    @rr.server("thing")
    def load_thing(self, request: str) -> str:
        return request

    def on_receive(self, message: Any) -> Any:
        return message


@pytest.fixture
def system(start: Callable[..., rr.System]) -> Iterator[rr.System]:
    system = start(rr.ChildSpec(Asked, id="asked", heartbeat_s=None))
    assert system.ref("asked").ask("hello") == "hello"
    pid = pid_of(system, "asked")
    hang(pid)
    yield system
    os.kill(pid, signal.SIGCONT)


def test_an_ask_says_so(system: rr.System) -> None:
    ref = system.ref("asked")
    with pytest.raises(pykka.Timeout, match=f"no reply after 0.3 seconds: the reply of root/asked; it {STOPPED}"):
        ref.ask("hello", timeout=0.3)
    with pytest.raises(pykka.Timeout, match=f"the reply of root/asked; it {STOPPED}"):
        ref.ask("hello", block=False).get(timeout=0.3)


def test_the_first_ask_of_a_process_that_is_stopped_waits_as_every_ask(
    start: Callable[..., rr.System], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rr_actors.wire.unix_transport.HANDSHAKE_TIMEOUT_S", 0.1)
    system = start(rr.ChildSpec(Asked, id="asked", heartbeat_s=None))
    ref = system.ref("asked")
    pid = pid_of(system, "asked")
    hang(pid)
    try:
        with pytest.raises(pykka.Timeout, match=f"the reply of root/asked; it {STOPPED}"):
            ref.ask("hello", timeout=0.5)
        later = ref.ask("hello again", block=False)
    finally:
        os.kill(pid, signal.SIGCONT)
    assert later.get(timeout=LIMIT_S) == "hello again"


def test_the_first_ask_of_a_process_that_is_stopped_hears_that_it_is_killed(
    start: Callable[..., rr.System], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rr_actors.wire.unix_transport.HANDSHAKE_TIMEOUT_S", 0.1)
    system = start(rr.ChildSpec(Asked, id="asked", heartbeat_s=None))
    ref = system.ref("asked")
    hang(pid_of(system, "asked"))
    asked = ref.ask("hello", block=False)
    with pytest.raises(pykka.Timeout):
        asked.get(timeout=0.5)
    ref.kill()
    with pytest.raises(rr.Unavailable, match="root/asked is being started again"):
        asked.get(timeout=LIMIT_S)


def test_a_call_of_a_handle_says_so(system: rr.System, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rr_actors.registrar.remote_registrar.GRACE_S", 0.1)
    handle = system.registrar("asked")
    with pytest.raises(rr.Unavailable, match=rf"registrar 'asked': no answer within 0.3 s; it {STOPPED}"):
        handle.load("asked/thing", "x", timeout_s=0.3)


def test_the_first_call_of_a_handle_says_so(start: Callable[..., rr.System], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rr_actors.wire.unix_transport.HANDSHAKE_TIMEOUT_S", 0.1)
    monkeypatch.setattr("rr_actors.registrar.remote_registrar.GRACE_S", 0.1)
    monkeypatch.setattr("rr_actors.registrar.links.remote_calls.GRACE_S", 0.1)
    system = start(rr.ChildSpec(Asked, id="asked", heartbeat_s=None))
    pid = pid_of(system, "asked")
    hang(pid)
    try:
        with pytest.raises(rr.Unavailable, match=rf"registrar 'asked': its process does not answer; it {STOPPED}"):
            system.registrar("asked").load("asked/thing", "x", timeout_s=0.3)
    finally:
        os.kill(pid, signal.SIGCONT)


def test_what_is_awaited_of_a_handle_says_so(start: Callable[..., rr.System], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rr_actors.registrar.remote_registrar.GRACE_S", 0.1)
    monkeypatch.setattr("rr_actors.registrar.links.remote_calls.GRACE_S", 0.1)
    system = start(rr.ChildSpec(Asked, id="asked", heartbeat_s=None))
    handle = system.registrar("asked")
    held = handle.load("asked/thing", "held")
    pid = pid_of(system, "asked")
    hang(pid)

    async def awaited() -> None:
        calls = handle.load_async("asked/thing", "x", timeout_s=0.3), held.unload_async(timeout_s=0.3)
        for error in await asyncio.gather(*calls, return_exceptions=True):
            assert isinstance(error, rr.Unavailable)
            assert re.fullmatch(rf"registrar 'asked': no answer within 0.3 s; it {STOPPED}.*", str(error))

    try:
        asyncio.run(asyncio.wait_for(awaited(), LIMIT_S))
    finally:
        os.kill(pid, signal.SIGCONT)
    eventually(lambda: not handle.resources())
