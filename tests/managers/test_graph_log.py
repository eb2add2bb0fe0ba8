"""The log of a large graph: what changed is written, and not the whole graph; and nothing of it is lost in silence."""

from __future__ import annotations

import datetime
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.managers import Actions, RunGraph, run_graph
from rr_actors.managers.actions.graph_log import GraphLog, logged
from rr_actors.managers.actions.graph_runs import NodeEnded
from support import eventually, kill, wait_respawned

Start = Callable[..., rr.System]
LIMIT_S = 60.0


class Step(rr.Action):
    """Notes its number; the one in the middle waits for the file `go`."""

    def run(self, given: dict[str, Any]) -> None:
        if "place" not in given:
            return
        place = Path(given["place"])
        with (place / "lines").open("a") as lines:
            lines.write(f"{given['number']}\n")
        while given["number"] == given["waits"] and not self.stopping.wait(0.01) and not (place / "go").exists():
            pass


def chain(count: int, **inputs: Any) -> dict[str, Any]:
    """A graph of so many actions, one after the other."""
    actions: list[dict[str, Any]] = []
    for i in range(count):
        given = {"number": i, **inputs} if inputs else {}
        table = {key: {"pvf_type": "any", "pvf_value": value} for key, value in given.items()}
        parents = [{"name": "Step", "instance_id": i - 1}] if i else []
        children = [{"name": "Step", "instance_id": i + 1}] if i + 1 < count else []
        more = {"input_parameters": table, "parents": parents, "children": children}
        actions.append({"name": "Step", "instance_id": i, **more})
    return {"graph_name": "chain", "actions": actions}


@pytest.fixture
def system(start: Start) -> rr.System:
    actions = rr.ChildSpec(Actions, id="actions", kwargs={"actions": [Step]})
    return start(rr.Supervisor([actions], max_restarts=1000))


def written(system: rr.System) -> int:
    """Return the bytes that the manager and this process have written, also to sockets."""
    pids = [os.getpid(), *(child.pid for child in system.supervisor().which_children())]
    texts = [Path(f"/proc/{pid}/io").read_text() for pid in pids]
    return sum(int(line.split()[1]) for text in texts for line in text.splitlines() if line.startswith("wchar"))


def test_a_large_graph_writes_what_has_changed(system: rr.System) -> None:
    app = system.open_registrar("app")
    before = written(system)
    assert run_graph(app, chain(200), timeout_s=LIMIT_S).result == "on_true"
    assert written(system) - before < 5_000_000  # with the whole graph for each end it is more than 20 million


def test_the_holder_of_a_large_graph_hears_of_each_end_and_sees_the_last(system: rr.System, tmp_path: Path) -> None:
    app = system.open_registrar("app")
    said: list[str] = []
    graph = chain(40, place=str(tmp_path), waits=30)
    with app.load("actions/graph", RunGraph(graph), on_status=lambda status: said.append(status.message)) as query:
        eventually(lambda: query.response["actions"][30]["state"] == "RUNNING", LIMIT_S, "the response")
        (tmp_path / "go").touch()
        eventually(lambda: query.response["graph_state"] == "FINISHED", LIMIT_S, "the end")
        eventually(lambda: "Step_39: on_true" in said[-1], LIMIT_S, "the last status")


def test_a_large_graph_goes_on_after_a_crash_from_its_last_end(system: rr.System, tmp_path: Path) -> None:
    app = system.open_registrar("app")
    graph = chain(300, place=str(tmp_path), waits=-1)
    lines = tmp_path / "lines"

    def numbers() -> list[int]:
        return [int(line) for line in lines.read_text().split()] if lines.exists() else []

    with app.load("actions/graph", RunGraph(graph)) as query:
        for count in (30, 90, 200):
            eventually(lambda count=count: len(numbers()) >= count, LIMIT_S, "some ends")
            wait_respawned(system, "actions", kill(system, "actions"))
        eventually(lambda: query.response["graph_state"] == "FINISHED", LIMIT_S, "the end")
    begun = numbers()
    assert begun == sorted(begun)
    assert set(begun) == set(range(300))
    assert len(begun) <= 300 + 3  # the one that ran at each kill


def test_a_graph_with_a_damaged_log_is_lost_by_name_and_one_without_leaves_none(
    system: rr.System, tmp_path: Path
) -> None:
    app = system.open_registrar("app")
    (directory,) = [path.parent for path in Path(system.state_dir).rglob("actions/*.lock")]
    graph = chain(25, place=str(tmp_path), waits=20)
    with app.load("actions/graph", RunGraph(graph)) as query:
        eventually(lambda: query.response["actions"][20]["state"] == "RUNNING", LIMIT_S, "the response")
        eventually(lambda: logged(directory) == set(), LIMIT_S, "no log: the response has all")
        (directory / f"graph-{query.resource_id}.log").write_bytes(b"x" * 100)
        (directory / "graph-gone.log").write_bytes(b"x" * 100)
        wait_respawned(system, "actions", kill(system, "actions"))
        status = query.wait_status(rr.State.FATAL, timeout_s=LIMIT_S)
    assert status.message.startswith("the graph cannot go on: ")
    assert "damaged from byte 0 on" in status.message
    eventually(lambda: logged(directory) == set(), LIMIT_S, "no log")


ENDS = [
    NodeEnded("A_0", 1, "on_true", {"path": Path("/a"), "raw": b"abc", "many": {1, 2}}),
    NodeEnded("B_0", 3, "on_false", {"when": datetime.date(2026, 11, 28)}),
    NodeEnded("C_0", 2, "on_error", {}, "it broke"),
]


def log_of(directory: Path, ends: list[NodeEnded] = ENDS, first: int = 5) -> GraphLog:
    log = GraphLog(directory, "g")
    for step, end in enumerate(ends, first):
        assert log.append(step, end)
    return log


def test_what_was_written_is_read_with_its_types_and_what_the_response_has_is_left_out(tmp_path: Path) -> None:
    log_of(tmp_path).close()
    assert GraphLog(tmp_path, "g").since(4) == ENDS
    assert GraphLog(tmp_path, "g").since(6) == ENDS[2:]
    assert GraphLog(tmp_path, "g").since(9) == []
    assert GraphLog(tmp_path, "other").since(4) == []


def test_a_cleared_log_begins_anew(tmp_path: Path) -> None:
    log = log_of(tmp_path)
    log.clear()
    assert GraphLog(tmp_path, "g").since(4) == []
    assert log.append(8, ENDS[0])
    assert GraphLog(tmp_path, "g").since(7) == ENDS[:1]


def test_a_long_end_is_for_the_response(tmp_path: Path) -> None:
    assert not GraphLog(tmp_path, "g").append(1, NodeEnded("A_0", 1, "on_true", {"x": b"x" * 20_000}))
    with pytest.raises(rr.NotSerializable):
        GraphLog(tmp_path, "g").append(1, NodeEnded("A_0", 1, "on_true", {"x": object()}))
    assert logged(tmp_path) == set()


def test_what_a_kill_has_cut_off_is_left_out_and_all_else_that_is_wrong_is_named(tmp_path: Path) -> None:
    log_of(tmp_path).close()
    file = tmp_path / "graph-g.log"
    whole = file.read_bytes()
    for size in range(len(whole)):
        file.write_bytes(whole[:size])
        found = GraphLog(tmp_path, "g").since(4)
        assert found == ENDS[: len(found)]
    for at in range(len(whole)):
        file.write_bytes(bytes([*whole[:at], whole[at] ^ 1, *whole[at + 1 :]]))
        with pytest.raises(rr.CatalogError, match=r"graph-g\.log"):
            GraphLog(tmp_path, "g").since(4)
    file.write_bytes(whole)
    with pytest.raises(rr.CatalogError, match="no record of step 3"):
        GraphLog(tmp_path, "g").since(2)
