"""The engine of one graph, with a manager that is none: what the disk refuses, and what comes in between."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.managers.actions.graph_documents import read_graph
from rr_actors.managers.actions.graph_engine import GraphEngine
from rr_actors.managers.actions.graph_library import Shelf
from rr_actors.managers.actions.graph_runs import Begin, Event, Halt, NodeEnded, Pause, first_run
from support import Calls, eventually

GRAPH = read_graph(
    {
        "actions": [
            {"name": "First", "children": [{"name": "Second"}]},
            {"name": "Second", "parents": [{"name": "First"}]},
        ]
    }
)


class FakeManager:
    """Runs actions that end when `goes_on` is set, or raise. `begun` has their names, `written` the graph's states.

    `then` is called once, right after the next commit.
    """

    def __init__(self, errors: dict[str, Exception] | None = None) -> None:
        self.begun, self.written, self.told = Calls(), Calls(), Calls()
        self.goes_on = threading.Event()
        self.goes_on.set()
        self.refusals = 0
        self.then: Callable[[], object] = lambda: None
        self._errors = errors or {}
        self.registrar: Any = SimpleNamespace(update_response=self._write, send_status=lambda id, status: None)
        self.engine = GraphEngine(self, "g", GRAPH, first_run(GRAPH), Shelf({}, {}))

    def _write(self, id: str, response: dict[str, Any], text: str) -> None:
        if self.refusals:
            self.refusals -= 1
            raise rr.CatalogError("no room")
        self.written(response["graph_state"])
        then, self.then = self.then, lambda: None
        then()

    def is_closing(self) -> bool:
        return False

    def begin_run(self, graph_id: str, graph: Any, node: str, run: Any, key: str) -> Any:
        self.begun(node)
        if node in self._errors:
            raise self._errors[node]
        return SimpleNamespace(unload=lambda: None)

    def tell_run(self, actor: str, key: str, word: Any, step: int) -> Callable[[float], str]:
        self.told((key.partition("/")[2], word))
        return lambda within_s: ""

    def wait_over(self, actor: str, key: str) -> None: ...

    def end_of(self, query: Any, node: str, run: Any) -> NodeEnded:
        self.goes_on.wait(60)
        return NodeEnded(node, run.number, "on_true")


def has_ended(manager: FakeManager) -> Callable[[], bool]:
    return lambda: manager.engine.run.state in ("FINISHED", "ERROR")


def test_what_a_full_disk_refuses_is_written_when_there_is_room() -> None:
    manager = FakeManager()
    manager.refusals = 2
    manager.engine.begin(Begin())
    eventually(has_ended(manager))

    assert [*manager.begun] == ["First_0", "Second_0"]
    assert manager.engine.run.state == "FINISHED"


def test_the_end_of_an_action_that_a_full_disk_refuses_is_not_lost() -> None:
    manager = FakeManager()
    manager.then = lambda: setattr(manager, "refusals", 2)
    manager.engine.begin(Begin())
    eventually(has_ended(manager))

    assert [*manager.begun] == ["First_0", "Second_0"]
    assert manager.engine.run.state == "FINISHED"


@pytest.mark.parametrize(
    ("events", "word", "end"),
    [
        ([Halt()], "stop", "STOPPED"),
        ([Pause()], "pause", "PAUSED"),
        ([Pause(), Halt()], "stop", "STOPPED"),
        ([Halt(), Pause()], "stop", "STOPPED"),
    ],
)
def test_a_stop_or_a_pause_reaches_what_runs_also_if_the_disk_is_full(events: list[Event], word: str, end: str) -> None:
    manager = FakeManager()
    manager.goes_on.clear()
    manager.engine.begin(Begin())
    assert eventually(lambda: [*manager.begun] == ["First_0"])
    manager.refusals = 1000
    for event in events:
        with pytest.raises(rr.CatalogError, match=r"no room; its actions (stop|pause) all the same"):
            manager.engine.tell(event)
    assert manager.told.items[-1] == ("First_0/1", word)
    assert manager.engine.said("g/First_0/1")[0] == word
    manager.goes_on.set()  # the action ends before there is room: its child does not begin
    manager.refusals = 0
    assert eventually(lambda: manager.engine.run.state == end)
    manager.engine.close(30)
    assert [*manager.begun] == ["First_0"]


@pytest.mark.parametrize("error", [rr.UnknownRegistrar("nobody"), rr.RegistrarDown("gone"), rr.CatalogError("no room")])
def test_an_action_that_cannot_begin_for_any_reason_ends_with_on_error(error: rr.RrError) -> None:
    manager = FakeManager({"Second_0": error})
    manager.engine.begin(Begin())
    eventually(has_ended(manager))

    assert (manager.engine.run.state, manager.engine.run.why) == ("ERROR", str(error))


def test_no_action_begins_when_the_graph_is_closed_behind_the_commit() -> None:
    manager = FakeManager()
    manager.then = lambda: manager.engine.close(0.0)
    manager.engine.begin(Begin())
    manager.engine.close(5.0)  # waits for each thread that has begun

    assert [*manager.begun] == []
    assert [*manager.written] == ["RUNNING"]
