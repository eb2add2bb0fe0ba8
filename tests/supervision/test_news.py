"""News of a child's process: with many, its supervisor's process reads a few times a second, and misses none."""

from __future__ import annotations

import asyncio
import logging
import os
import re
import signal
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import pytest

import rr_actors as rr
from rr_actors.supervision.control_channel import Channel, News
from support import Calls, Workshop, eventually
from support_managers import Order, Shop

Start = Callable[..., rr.System]


class Talkative(rr.Manager):
    """Logs ten megabytes, and then cannot start."""

    def on_start(self) -> None:
        for _ in range(100):
            logging.getLogger("talkative").warning("x" * 100_000)
        raise ValueError("no such device")


class Lingering(rr.Actor):
    """Makes a file when it flushes its log, as its process leaves, and goes on when there is another."""

    handlers: ClassVar[list[logging.Handler]] = []

    def on_receive(self, message: Path) -> int:
        def linger() -> None:
            message.touch()
            eventually(message.with_suffix(".go").exists)

        handler = logging.Handler()
        handler.flush = linger
        self.handlers.append(handler)
        return os.getpid()


def test_a_process_that_leaves_and_gets_a_sigterm_leaves_in_order(start: Start, tmp_path: Path) -> None:
    system = start(rr.ChildSpec(Lingering, id="a", restart="temporary"))
    leaves = tmp_path / "leaves"
    pid = system.ref("a").ask(leaves)
    system.ref("a").stop(block=False)
    eventually(leaves.exists)
    os.kill(pid, signal.SIGTERM)
    leaves.with_suffix(".go").touch()
    eventually(lambda: system.supervisor().history()[-1].event == "exited")
    assert system.supervisor().history()[-1].code == 0


def test_while_it_rests_nothing_is_read_and_afterwards_everything_in_its_order() -> None:
    sizes: list[int] = []
    heard: list[Any] = []

    class Counting(Channel):
        def data_received(self, data: bytes) -> None:
            sizes.append(len(data))
            super().data_received(data)

    async def both() -> None:
        here, there = socket.socketpair()
        lost = asyncio.Event()
        parent: Channel

        def received(message: Any) -> None:
            heard.append(message.event["number"])
            parent.rest()

        parent = await Counting.open(there, "root/a", received, lost.set)
        child = await Channel.open(here, "root/a", lambda message: None, lambda: None)
        for number in range(1000):
            child.send(News({"number": number}))
            await asyncio.sleep(0)
        assert len(sizes) < 200
        child.close()
        async with asyncio.timeout(5):
            await lost.wait()
        parent.close()

    asyncio.run(both())

    assert heard == list(range(1000))


def test_a_damaged_channel_is_closed_with_the_name_of_its_child(caplog: pytest.LogCaptureFixture) -> None:
    async def damage() -> None:
        here, there = socket.socketpair()
        lost = asyncio.Event()
        await Channel.open(there, "root/cameras", lambda message: None, lost.set)
        here.sendall(b"no frame of ours")
        async with asyncio.timeout(5):
            await lost.wait()
        here.close()

    asyncio.run(damage())
    assert re.search("root/cameras: control channel closed: ", caplog.text)


def test_a_child_that_cannot_start_sends_its_error_after_all_that_it_had_logged(
    start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    with pytest.raises(rr.StartFailed, match="no such device"):
        start(rr.ChildSpec(Talkative, id="talkative"))
    assert len([record for record in caplog.records if record.name == "talkative"]) == 100


def test_a_channel_whose_other_end_reads_nothing_is_given_up() -> None:
    async def finish() -> None:
        here, there = socket.socketpair()
        channel = await Channel.open(here, "root/a", lambda message: None, lambda: None)
        channel.send(News({"text": "x" * 10_000_000}))
        async with asyncio.timeout(5):
            await channel.finish(0.1)
        there.close()

    asyncio.run(finish())


def test_what_a_killed_process_had_told_is_heard_before_its_end(start: Start, workshop: Workshop) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    heard = Calls()
    system.subscribe(heard)
    app = system.open_registrar("app")
    names = [f"thing {number}" for number in range(50)]
    for name in names:
        app.load("shop/thing", Order(name))
    assert system.ref("shop").kill()

    eventually(lambda: any(event["event"] == "exited" for event in heard))
    before = [event["event"] for event in heard]
    assert before[: before.index("exited")].count("loaded") == len(names)
