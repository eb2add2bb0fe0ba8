"""Titles: what people read in the place of a request, wherever it is listed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

import rr_actors as rr
from rr_actors.base.errors import InvalidSpec
from rr_actors.managers.actions.action_manager import RunAction, RunGraph
from rr_actors.managers.budgets.requests import Share, Supply
from rr_actors.managers.choices.chosen import Choose
from rr_actors.managers.keeper.desired import Replica
from rr_actors.managers.pipes.pipe_manager import Pipe
from rr_actors.managers.programs import RunProgram
from rr_actors.system.console.console_commands import SendStatus
from rr_actors.system.console.console_connection import ConsoleConnection, find_console
from rr_actors.system.console.console_questions import Find, ListEvents, ListQueries, ListResources
from rr_actors.system.recording.event_texts import event_text
from support import eventually

pytestmark = pytest.mark.usefixtures("runtime_dir")

Start = Callable[..., rr.System]


class Scan(msgspec.Struct, frozen=True):
    """A request with a title of its own."""

    room: str
    options: dict[str, int] = {}

    def __rr_title__(self) -> str:
        return f"of the\n{self.room}"


def _wrong(request: Any) -> str:
    raise ValueError(request)


class Scanners(rr.Manager):
    """Its servers have titles in all three ways; the last title raises."""

    @rr.server("scan", recovery="keep")
    def load_scan(self, request: Scan) -> str:
        if request.room == "attic":
            self.registrar.load("scanners/range", {"name": rr.current().name, "rate": 2.0})
        return request.room

    @rr.server("range", recovery="keep", title=lambda name, rate: f"{name} at {rate:g} Hz")
    def load_range(self, name: str, rate: float) -> str:
        return name

    @rr.server("wrong", recovery="keep", title=_wrong)
    def load_wrong(self, request: str) -> str:
        return request


@pytest.fixture
def app(start: Start) -> rr.Registrar:
    """The application's registrar, beside a child `scanners`."""
    return start(rr.ChildSpec(Scanners, id="scanners")).open_registrar("app")


@pytest.fixture
def console(app: rr.Registrar, state_dir: Path) -> Iterator[ConsoleConnection]:
    """A connection of the system."""
    with ConsoleConnection(find_console(state_dir)) as connection:
        yield connection


def test_a_title_takes_the_place_of_a_request_at_its_provider_and_at_its_holders(
    app: rr.Registrar, console: ConsoleConnection
) -> None:
    app.load("scanners/scan", Scan("attic", {"a": 1}))

    names = {row.name for row in console.ask(ListResources()).rows}
    assert names == {"scanners/scan of the attic", "scanners/range scanners/scan of the attic at 2 Hz"}
    (held,) = console.ask(ListQueries(registrar="app")).rows
    assert held.name == "scanners/scan of the attic"
    assert held.request == '{"options":{"a":1},"room":"attic"}'  # for programs


def test_a_resource_is_found_by_its_title_and_by_its_request(app: rr.Registrar, console: ConsoleConnection) -> None:
    id = app.load("scanners/scan", Scan("cellar")).resource_id

    for name in ("scanners/scan of the cellar", 'scanners/scan {"options":{},"room":"cellar"}'):
        assert [row.id for row in console.ask(Find(name)).resources] == [id]
    assert [row.id for row in console.ask(ListResources("of the cellar")).rows] == [id]


def test_a_status_names_the_resource_by_its_title(app: rr.Registrar, console: ConsoleConnection) -> None:
    query = app.load("scanners/scan", Scan("hall"))
    console.ask(SendStatus(query.resource_id, "ERROR", "dust"))

    def told() -> bool:
        events = console.ask(ListEvents(query.resource_id)).events
        return any("scanners/scan of the hall" in event_text(one.at, one.event, one.facts) for one in events)

    assert eventually(told)


def test_a_title_that_raises_leaves_the_request(app: rr.Registrar, console: ConsoleConnection) -> None:
    app.load("scanners/wrong", "x")

    assert [row.name for row in console.ask(ListResources()).rows] == ['scanners/wrong "x"']


def test_a_title_that_is_no_function_is_refused(app: rr.Registrar) -> None:
    title: Any = "a text"
    with pytest.raises(InvalidSpec, match="server 'thing': title: expected a function that takes a request"):
        app.register_server("thing", str.upper, title=title)


@pytest.mark.parametrize(
    ("request_", "title"),
    [
        (Share("watts", 20.0, whose='devices/device "arm"'), '20 of watts for devices/device "arm"'),
        (Supply("watts", 50.0), "50 to watts"),
        (Replica("radio", 2, "programs/program"), "radio 2"),
        (RunProgram("/usr/bin/sleep", ("100",), instance="radio1"), "sleep 100 (radio1)"),
        (RunAction("Look"), "Look, attempt 1"),
        (RunGraph("fetch_cup"), "fetch_cup"),
        (RunGraph({"graph_name": "fetch_cup"}), "fetch_cup"),
        (Choose("range", {"rate_hz": ">=5"}, ["-cost"]), "range (rate_hz >=5; best -cost)"),
        (Pipe("depth", {"device": "front"}, "left"), "depth (device=front; left)"),
    ],
)
def test_the_requests_of_ready_made_managers_have_titles(request_: Any, title: str) -> None:
    assert request_.__rr_title__() == title
