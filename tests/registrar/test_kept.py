"""What a respawned manager keeps without a word of its author: one line of its log says what that means."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import pytest

import rr_actors as rr
from support import eventually, kill, wait_respawned

Start = Callable[..., rr.System]


class Lamps(rr.Manager):
    @rr.server("unsaid")
    def switch_on(self, room: str) -> str:
        return room

    @rr.server("kept", recovery="keep")
    def switch_on_outside(self, room: str) -> str:
        return room

    @rr.server("recovered")
    def switch_on_again(self, room: str) -> str:
        return room

    @switch_on_again.recover
    def is_on(self, room: str, response: str) -> str:
        return response


class LampsByHand(rr.Manager):
    def on_start(self) -> None:
        self.registrar.register_server("unsaid", str.upper)
        self.registrar.register_server("kept", str.upper, recovery="keep")
        self.registrar.register_server("recovered", str.upper, recover=lambda _, response: response)


def lines(text: str) -> list[str]:
    return [line for line in text.splitlines() if "a process that has ended had loaded" in line]


@pytest.mark.parametrize("cls", [Lamps, LampsByHand])
def test_a_respawned_manager_says_what_it_keeps_and_what_to_write(
    start: Start, caplog: pytest.LogCaptureFixture, cls: Any
) -> None:
    system = start(rr.ChildSpec(cls, id="lamps"))
    app = system.open_registrar("app")
    for server in ("unsaid", "kept", "recovered"):
        app.load(f"lamps/{server}", "hall")
        app.load(f"lamps/{server}", "attic")
    assert lines(caplog.text) == []

    wait_respawned(system, "lamps", kill(system, "lamps"))
    app.load("lamps/unsaid", "hall")

    (line,) = eventually(lambda: lines(caplog.text))
    assert re.search(
        r"lamps/unsaid: .* loaded 2 of its resources.* recover callback.*recovery='reload' or 'lost'", line
    )


def test_nothing_is_said_where_nothing_was_held(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    system = start(rr.ChildSpec(Lamps, id="lamps"))
    app = system.open_registrar("app")
    app.load("lamps/unsaid", "hall").unload()

    wait_respawned(system, "lamps", kill(system, "lamps"))
    app.load("lamps/unsaid", "hall")

    assert lines(caplog.text) == []
