"""Asker: a thread of another process that asks, as the process sees it that has the actor."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from rr_actors.actors.remote.inbound import Asker
from rr_actors.actors.remote.protocol import ASKS, Answered, Ask, Dead, Halt, Inquire, Tell, Watch
from rr_actors.runtime.event_loop import Dispatcher
from rr_actors.wire.segments import Segments
from rr_actors.wire.transport import Hello
from support import Calls, eventually
from support_refs import open_home

URN = "urn:rr-actor:root/nobody"


class OutletLink:
    """A link whose outlet takes what the test lets it take."""

    peer = "app (pid 1)"

    def __init__(self, *, takes: bool = True) -> None:
        self.takes = takes
        self.outlets = 0
        self.by_outlet: list[Any] = []
        self.by_loop: list[Any] = []
        self.closed = False

    def open_outlet(self) -> None:
        self.outlets += 1

    def answering(self, message: Any) -> Callable[[], None] | None:
        return (lambda: self.by_outlet.append(message)) if self.takes else None

    def send(self, message: Any) -> None:
        self.by_loop.append(message)

    def flush(self) -> None: ...

    def close(self) -> None:
        self.closed = True


def asker_on(link: Any, dispatcher: Any = None) -> Asker:
    return Asker(lambda _: None, dispatcher, link, lambda _: None, Segments(0).parcels(0))


def test_whoever_has_the_answer_writes_it() -> None:
    link = OutletLink()
    asker = asker_on(link)  # there is no loop: nothing is left to it
    assert link.outlets == 1
    asker.answer(1, "value", "root/a")
    asker.raised(2, ValueError("no"), "root/a")
    any_link: Any = link
    asker.received(any_link, Ask(3, URN, b"", ()))
    assert [type(letter).__name__ for letter in link.by_outlet] == ["Answered", "HandlerRaised", "Dead"]
    assert link.by_outlet[2] == Dead(3)


def test_what_an_outlet_cannot_take_the_loop_writes() -> None:
    link = OutletLink(takes=False)
    dispatcher = Dispatcher()
    asker_on(link, dispatcher).post(Answered(1, b""))
    eventually(lambda: link.by_loop == [Answered(1, b"")])
    dispatcher.close()


@pytest.mark.parametrize(
    "letter", [Tell(URN, b""), Halt(1, URN, "normal", False), Inquire(1, URN, "class"), Watch(1, URN), Dead(1)]
)
def test_nothing_but_questions_is_taken(letter: Any, caplog: pytest.LogCaptureFixture) -> None:
    link = OutletLink()
    any_link: Any = link
    with caplog.at_level(logging.ERROR, "rr_actors"):
        asker_on(link).received(any_link, letter)
    assert link.closed
    assert not link.by_outlet
    assert f"app (pid 1) sent {type(letter).__name__} on a link for asking" in caplog.text


def test_an_intruder_that_tells_on_such_a_link_loses_it(tmp_path: Path) -> None:
    class Bystander:
        def received(self, link: Any, message: Any) -> None:
            heard(message)

        def lost(self, link: Any, reason: Exception | None) -> None:
            heard("lost")

    heard = Calls()
    home, state = open_home(tmp_path / "state")

    async def intrude() -> None:
        hello = Hello(ASKS, "x", "intruder", 0)
        link = await home.transport.connect(home.hub.address, hello, lambda _: Bystander())
        link.send(Ask(7, URN, b"", ()))
        link.send(Tell(URN, b""))
        link.flush()

    try:
        home.dispatcher.run(intrude())
        assert heard.wait(2) == [Dead(7), "lost"]
    finally:
        home.close()
        state.close()
