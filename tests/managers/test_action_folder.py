"""Actions in the files of a folder: what changes there while the manager runs, and what is wrong there."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import pytest

import rr_actors as rr
from rr_actors.managers import Actions, RunAction, RunGraph, run_graph
from rr_actors.managers.actions.action_folder import ActionFolder
from rr_actors.managers.actions.graph_documents import read_graph
from rr_actors.managers.actions.graph_library import Shelf
from support import eventually, kill, pid_of, wait_respawned
from support_cli import run_cli

Start = Callable[..., rr.System]
HEAD = "from __future__ import annotations\nimport msgspec\nimport rr_actors as rr\n"
TELL = HEAD + (
    "class Words(msgspec.Struct):\n"
    "    words: list[Word]\n"
    "class Word(msgspec.Struct):\n"
    "    text: str\n"
    "class {name}(rr.Action):\n"
    "    isolate = {isolate}\n"
    "    class Output(msgspec.Struct):\n"
    "        said: str\n"
    "    def run(self, given):\n"
    "        return self.Output(msgspec.convert({{'words': [{{'text': '{text}'}}]}}, Words).words[0].text)\n"
)
WAIT = HEAD + (
    "from pathlib import Path\n"
    "class Wait(rr.Action):\n"
    "    def run(self, given):\n"
    "        (Path({place!r}) / 'began').touch()\n"
    "        while not (Path({place!r}) / 'go').exists() and not self.stopping.wait(0.01):\n"
    "            pass\n"
)
THEN = {
    "graph_entry": [{"name": "Wait"}],
    "graph_exit": [{"name": "Tell"}],
    "actions": [{"name": "Wait", "children": [{"name": "Tell"}]}, {"name": "Tell", "parents": [{"name": "Wait"}]}],
}


def tell(text: str, name: str = "Tell", isolate: bool = False) -> str:
    return TELL.format(text=text, name=name, isolate=isolate)


class Given(rr.Action):
    def run(self, given: Any) -> None: ...


class Place:
    """A system with Actions, whose classes are in `folder`."""

    def __init__(self, start: Start, tmp_path: Path, **more: Any) -> None:
        self.folder = tmp_path / "actions"
        kwargs = {"actions": [Given], "action_folder": self.folder, **more}
        self.system = start(rr.ChildSpec(Actions, id="actions", kwargs=kwargs))
        self.app = self.system.open_registrar("app")

    def said(self, name: str = "Tell") -> Any:
        return run_graph(self.app, {"actions": [{"name": name}]}, timeout_s=60).outputs.get("said")


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "actions"
    folder.mkdir()
    (folder / "tell.py").write_text(tell("one"))
    (folder / "_draft.py").write_text("what is this")
    yield folder
    (tmp_path / "go").touch()


def test_the_next_graph_runs_what_the_files_say_now(start: Start, tmp_path: Path, folder: Path) -> None:
    place = Place(start, tmp_path)
    assert place.said() == "one"
    for isolate in (True, False):  # the process of an isolated one gets the code, too
        (folder / "tell.py").write_text(tell(f"{isolate} two", isolate=isolate))
        assert place.said() == f"{isolate} two"
    (folder / "more.py").write_text(tell("three", "More"))
    assert place.said("More") == "three"
    assert place.app.load("actions/action", RunAction("More")).response.outputs == {"said": "three"}
    (folder / "more.py").unlink()
    with pytest.raises(rr.GraphError, match=r"expected an action or a graph: one of Given, Tell, got 'More'"):
        place.said("More")
    (folder / "tell.py").unlink()
    (folder / "other.py").write_text(tell("four"))  # the class has moved
    assert place.said() == "four"


def test_a_graph_that_runs_goes_on_with_the_classes_it_began_with_also_after_a_crash(
    start: Start, tmp_path: Path, folder: Path
) -> None:
    (folder / "wait.py").write_text(WAIT.format(place=str(tmp_path)))
    place = Place(start, tmp_path)
    running = place.app.load("actions/graph", RunGraph({**THEN, "graph_name": "g"}))
    assert eventually((tmp_path / "began").exists)
    (folder / "tell.py").write_text(tell("two"))
    assert place.said() == "two"
    (folder / "tell.py").write_text(tell("three, which is broken")[:-9])
    assert place.said() == "two"
    (tmp_path / "began").unlink()
    wait_respawned(place.system, "actions", kill(place.system, "actions"))
    assert eventually((tmp_path / "began").exists)  # the manager starts, and Wait runs again
    assert place.said() == "two"
    (tmp_path / "go").touch()
    assert eventually(lambda: running.response["graph_state"] == "FINISHED", what=str(running.response))


def test_a_crash_goes_on_also_where_no_file_was_right_yet(start: Start, tmp_path: Path, folder: Path) -> None:
    (folder / "tell.py").unlink()
    place = Place(start, tmp_path)
    (folder / "tell.py").write_text("1 / 0")
    wait_respawned(place.system, "actions", kill(place.system, "actions"))
    (folder / "tell.py").write_text(tell("one"))
    assert place.said() == "one"


def test_an_action_that_begins_later_in_a_graph_is_that_of_its_begin(
    start: Start, tmp_path: Path, folder: Path
) -> None:
    (folder / "wait.py").write_text(WAIT.format(place=str(tmp_path)))
    place = Place(start, tmp_path)
    with ThreadPoolExecutor() as pool:
        running = pool.submit(run_graph, place.app, THEN, timeout_s=60)
        assert eventually((tmp_path / "began").exists)
        (folder / "tell.py").write_text(tell("two"))
        assert place.said() == "two"
        (tmp_path / "go").touch()
        assert running.result(60).outputs == {"said": "one"}


def test_a_graph_that_cannot_be_changed_goes_on_with_the_classes_it_began_with(
    start: Start, tmp_path: Path, folder: Path
) -> None:
    (folder / "wait.py").write_text(WAIT.format(place=str(tmp_path)))
    (tmp_path / "graphs").mkdir()
    long = {**THEN, "graph_name": "long", "graph_description": "x" * 2**24}
    (tmp_path / "graphs" / "long.json").write_text(json.dumps(long))
    place = Place(start, tmp_path, graphs=tmp_path / "graphs")
    running = place.app.load("actions/graph", RunGraph({**THEN, "graph_name": "g"}))
    assert eventually((tmp_path / "began").exists)
    (folder / "tell.py").write_text(tell("two"))
    with pytest.raises(rr.RrError) as caught:
        place.system.ref("actions").proxy().change_graph(running.resource_id, "long").get()
    assert not isinstance(caught.value, rr.GraphError)
    (tmp_path / "go").touch()
    assert eventually(lambda: running.response["graph_state"] == "FINISHED", what=str(running.response))
    assert "'said': 'one'" in str(running.response)


WRONG: list[tuple[str, str]] = [
    (f"{HEAD}class Tell(rr.Action:\n", "line 4: expected a Python file with a class of actions, got SyntaxError: "),
    (f"{HEAD}\n1 / 0\n", "line 5: expected a Python file with a class of actions, got ZeroDivisionError: "),
    ("import no_such_module\n", "line 1: expected a Python file with a class of actions, got ModuleNotFoundError: "),
    ("raise SystemExit(3)\n", "line 1: expected a Python file with a class of actions, got SystemExit: 3"),
    ("raise KeyboardInterrupt\n", "line 1: expected a Python file with a class of actions, got KeyboardInterrupt: "),
    ("", "expected a Python file with a class of actions, got none"),
    (f"{HEAD}class Base(rr.Action):\n    pass\n", "expected a Python file with a class of actions, got none"),
    (tell("x", isolate=False).replace("isolate = False", "timeout_s = 3"), "line 8: expected a class of actions that"),
    (tell("x").replace("said: str", "said: Str"), "line 8: expected a class of actions that can run, got NameError: "),
    (tell("x", "Given"), "line 8: expected actions with different names, got 'Given' again"),
    (tell("x", "Other"), "line 8: expected actions with different names, got 'Other' again, as in "),
    ("\0", "expected a Python file with a class of actions, got "),
]


def test_a_file_that_is_wrong_is_named_with_its_line_and_ends_nothing(
    start: Start, tmp_path: Path, folder: Path
) -> None:
    (folder / "other.py").write_text(tell("other", "Other"))
    place = Place(start, tmp_path)
    for i, (text, said) in enumerate(WRONG):
        (folder / "tell.py").write_text(text)
        (folder / "new.py").write_text(tell(f"new {i}", "New"))
        assert (place.said(), place.said("New")) == ("one", f"new {i}")
        with pytest.raises(rr.GraphError) as caught:
            place.said("Missing")
        assert f"got 'Missing' (str); {folder / 'tell.py'}: {said}" in str(caught.value)
    (folder / "tell.py").write_text(tell("two"))
    assert place.said() == "two"
    with pytest.raises(rr.GraphError, match=r"got 'Missing' \(str\)$"):
        place.said("Missing")


def test_a_file_that_ends_the_process_is_named_and_runs_again_when_it_has_changed(
    start: Start, tmp_path: Path, folder: Path
) -> None:
    place = Place(start, tmp_path)
    assert place.said() == "one"
    (folder / "tell.py").write_text("import os\nos._exit(3)")
    (folder / "new.py").write_text(tell("new", "New"))
    with pytest.raises(rr.GraphError, match=r"tell\.py: expected a Python file .* with which the manager's process"):
        place.said("Missing")
    pid = pid_of(place.system, "actions")
    assert (place.said(), place.said("New")) == ("one", "new")
    assert pid_of(place.system, "actions") == pid
    (folder / "tell.py").write_text(tell("two"))
    assert place.said() == "two"


def test_a_file_that_runs_when_the_process_is_killed_from_outside_is_not_blamed(
    start: Start, tmp_path: Path, folder: Path
) -> None:
    place = Place(start, tmp_path)
    assert place.said() == "one"
    once = f"{HEAD}import time\nfrom pathlib import Path\nruns = Path({str(tmp_path)!r}) / 'runs'\n"
    slow = "if not runs.exists():\n    runs.touch()\n    time.sleep(60)\n"
    (folder / "tell.py").write_text(once + slow + tell("two")[len(HEAD) :])
    with ThreadPoolExecutor() as pool:
        saying = pool.submit(place.said)
        assert eventually((tmp_path / "runs").exists)
        kill(place.system, "actions")
        assert saying.result(60) == "two"


def test_a_file_that_has_not_ended_holds_up_nobody_and_holds_when_it_has(tmp_path: Path, folder: Path) -> None:
    actions = ActionFolder(folder, None, {}, within_s=0.05)
    head = f"{HEAD}import time\nfrom pathlib import Path\n"
    waits = f"{head}while not Path({str(tmp_path / 'go')!r}).exists():\n    time.sleep(0.01)\n"
    (folder / "tell.py").write_text(waits + tell("two", "Two")[len(HEAD) :])
    (folder / "other.py").write_text(tell("other", "Other"))
    assert actions.look()
    assert sorted(actions.kinds) == ["Other", "Tell"]
    (fault,) = actions.faults.values()
    assert str(fault).endswith(
        "tell.py: expected a Python file with a class of actions, got one that has not ended within 0.05 s"
    )
    assert not actions.look()
    (tmp_path / "go").touch()
    assert eventually(actions.look)
    assert (sorted(actions.kinds), actions.faults) == (["Other", "Two"], {})


def test_a_file_that_is_wrong_fails_the_start(tmp_path: Path, folder: Path) -> None:
    (folder / "tell.py").write_text("1 / 0")
    with pytest.raises(rr.ConfigError, match=r"tell\.py: line 1: expected a Python file .*ZeroDivisionError") as caught:
        Actions(action_folder=folder)
    assert (caught.value.file, caught.value.key) == (str(folder / "tell.py"), "line 1")
    with pytest.raises(rr.ConfigError, match=r"none: expected a folder with Python files of actions, got none"):
        Actions(action_folder=tmp_path / "none")
    with pytest.raises(rr.ConfigError, match="action_folder: expected the path of a file, got 3"):
        cast(Any, Actions)(action_folder=3)


def test_graphs_of_a_folder_follow_the_classes_of_the_other(
    start: Start, tmp_path: Path, folder: Path, runtime_dir: object
) -> None:
    graphs = tmp_path / "graphs"
    graphs.mkdir()
    (graphs / "g.json").write_text('{"graph_name": "g", "actions": [{"name": "Tell"}]}')
    place = Place(start, tmp_path, graphs=graphs)
    (folder / "tell.py").rename(tmp_path / "tell.py")
    for _ in range(2):
        with pytest.raises(rr.GraphError, match=r"g\.json: actions\[0\]\.name: .*one of Given, got 'Tell'"):
            run_graph(place.app, "g", timeout_s=60)
    (folder / "tell.py").write_text("1 / 0")
    with pytest.raises(rr.GraphError, match="ZeroDivisionError"):
        run_graph(place.app, "g", timeout_s=60)
    assert "tell.py: line 1" in run_cli("ps").stdout
    (tmp_path / "tell.py").rename(folder / "tell.py")
    assert run_graph(place.app, "g", timeout_s=60).outputs == {"said": "one"}
    assert "tell.py" not in run_cli("ps").stdout


def test_who_asks_for_a_graph_that_cannot_run_gets_an_error_of_its_own() -> None:
    shelf = Shelf({}, {"g": read_graph({"graph_name": "g", "actions": [{"name": "Tell"}]})})
    errors: list[rr.GraphError] = []
    for _ in range(2):
        with pytest.raises(rr.GraphError, match=r"actions\[0\]\.name") as caught:
            shelf.find("g")
        errors.append(caught.value)
    assert errors[0] is not errors[1]
    assert (errors[0].path, str(errors[0])) == (errors[1].path, str(errors[1]))
