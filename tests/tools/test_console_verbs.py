"""The command line at a running system: what each verb shows and does, and what it says when it cannot."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any
from xml.etree import ElementTree

import pytest

import rr_actors as rr
from rr_actors.registrar.pages import ResourceRow
from rr_actors.system.console import console_feed
from rr_actors.system.console.console_messages import Children, ChildRow, Missed
from rr_actors.tools import console_verbs, graphs
from rr_actors.tools.explanations import ago
from support import REPOSITORY, Calls, Gate, Workshop, eventually, kill, pid_of, serve, wait_gone, wait_respawned
from support_cli import run_cli
from support_managers import Order, Shop

pytestmark = pytest.mark.usefixtures("runtime_dir")

Start = Callable[..., rr.System]


def command(*arguments: object) -> list[str]:
    return [sys.executable, "-m", "rr_actors", *map(str, arguments)]


def rr_actors(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run the command line."""
    return run_cli(*arguments, **environment)


def said(*arguments: object) -> str:
    """What a command prints that succeeds."""
    ran = rr_actors(*arguments)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


def refused(code: int, *arguments: object) -> str:
    """What a command says in one line that fails with this exit code."""
    ran = rr_actors(*arguments)
    assert ran.returncode == code, ran.stdout + ran.stderr
    assert ran.stdout == ""
    (line,) = ran.stderr.splitlines()
    assert "Traceback" not in line
    return line


@pytest.fixture
def shop(start: Start, workshop: Workshop) -> rr.System:
    """A system with a manager, `shop`, in a process of its own."""
    return start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))


@pytest.fixture
def app(shop: rr.System) -> rr.Registrar:
    """A consumer in this process."""
    return shop.open_registrar("app")


# -- finding it ------------------------------------------------------------------------------------------------------


def test_a_file_in_place_of_a_state_directory_is_refused_as_by_the_commands_that_read_one(tmp_path: Path) -> None:
    file = tmp_path / "afile"
    file.touch()
    told = f"rr-actors: {file}: expected a state directory of a system, got a file"
    assert [refused(2, "ps", "--state", file), refused(2, "inspect", file)] == [told, told]


def test_a_system_is_found_by_option_environment_or_as_the_one_that_runs(
    shop: rr.System, state_dir: Path, start: Start, tmp_path: Path
) -> None:
    assert "shop" in said("ps")
    start(rr.Supervisor([], id="second"), state_dir=tmp_path / "second")

    assert "shop" in said("ps", "--state", state_dir)
    assert "second" in rr_actors("ps", RR_STATE=str(tmp_path / "second")).stdout
    line = refused(2, "ps")
    assert str(state_dir) in line
    assert str(tmp_path / "second") in line
    assert "--state" in line


@pytest.mark.parametrize("verb", ["inspect", "tree", "check"])
def test_the_commands_that_read_a_state_directory_find_it_as_the_others_do(
    verb: str, shop: rr.System, state_dir: Path, start: Start, tmp_path: Path
) -> None:
    shop.open_registrar("first").load("shop/thing", Order("lamp"))
    eventually(lambda: "held" in said("tree", state_dir))
    of_shop = said(verb, state_dir)
    assert said(verb) == of_shop

    other = start(rr.Supervisor([], id="second"), state_dir=tmp_path / "second")
    other.open_registrar("app")
    assert said(verb, "--state", state_dir) == of_shop
    of_other = said(verb, tmp_path / "second")
    assert of_other != of_shop
    assert rr_actors(verb, RR_STATE=str(tmp_path / "second")).stdout == of_other
    assert rr_actors(verb, state_dir, RR_STATE=str(tmp_path / "second")).stdout == of_shop
    assert str(state_dir) in refused(2, verb)


@pytest.mark.parametrize("option", [("--state", "rr_state"), ("--json",)])
def test_an_option_before_its_command_is_refused_with_the_right_order(option: tuple[str, ...]) -> None:
    line = refused(2, *option, "ps")
    assert f"No such option: {option[0]}; a command's options stand after it: rr-actors ps --state DIR" in line


def test_where_nothing_runs_the_error_says_what_to_do(tmp_path: Path) -> None:
    assert "rr-actors run" in refused(3, "ps")
    assert "rr-actors inspect" in refused(3, "ps", "--state", tmp_path)


# -- looking ---------------------------------------------------------------------------------------------------------


def test_ps_shows_each_child_with_its_process(shop: rr.System) -> None:
    pid = shop.ref("shop").pid

    lines = said("ps").splitlines()
    rows = json.loads(said("ps", "--json"))

    assert lines[0].split() == ["child", "state", "pid", "up", "restarts", "cpu", "memory"]
    assert lines[2].startswith("  shop")
    assert str(pid) in lines[2]
    assert [row["path"] for row in rows] == ["root", "root/shop"]
    assert rows[1]["pid"] == pid
    assert rows[1]["memory_bytes"] > 2**20
    assert rows[1]["restarts"] == 0


def test_resources_are_listed_and_chosen(app: rr.Registrar) -> None:
    query = app.load("shop/thing", Order("lamp"))
    app.load("shop/thing", Order("chair"))

    assert said("resources", "lamp").splitlines()[1].split()[:2] == [query.resource_id, "shop/thing"]
    (row,) = json.loads(said("resources", "lamp", "--json"))
    assert row["holders"] == [{"query_id": query.id, "origin": "app", "parent": ""}]
    assert "1 more" in rr_actors("resources", "--limit", "1").stderr


def test_events_are_followed_with_filters_as_lines_of_json(app: rr.Registrar, shop: rr.System) -> None:
    node = shop._node
    assert node is not None
    following = subprocess.Popen(
        command("events", "--follow", "--json", "--event", "loaded", "--about", "shop/thing", "--count", "2"),
        stdout=subprocess.PIPE,
        text=True,
    )
    eventually(lambda: bool(node.watched), timeout=20.0)
    for name in ("a", "b"):
        app.load("shop/thing", Order(name)).unload()

    out, _ = following.communicate(timeout=20)

    assert following.returncode == 0
    assert [json.loads(line)["event"] for line in out.splitlines()] == ["loaded", "loaded"]


def test_following_ends_with_the_system_and_with_ctrl_c(shop: rr.System) -> None:
    node = shop._node
    assert node is not None
    both = [subprocess.Popen(command("events", "-f"), stdout=subprocess.PIPE, stderr=subprocess.PIPE) for _ in range(2)]
    console = shop._console
    assert console is not None
    eventually(lambda: len(console.feed._readers) == 2, timeout=30.0)

    both[0].send_signal(signal.SIGINT)
    _, interrupted = both[0].communicate(timeout=10)
    shop.stop()
    _, ended = both[1].communicate(timeout=10)

    assert b"Traceback" not in interrupted
    assert b"the system has ended" in ended
    assert both[1].returncode == 0


def test_history_tells_why_a_child_ended(shop: rr.System) -> None:
    wait_respawned(shop, "shop", kill(shop, "shop"))

    assert "SIGKILL" in said("history", "shop")
    lines = [json.loads(line) for line in said("history", "--json").splitlines()]
    assert [line["event"] for line in lines] == ["started", "exited", "restarted"]
    assert "exited" in said("events", "--event", "exited")


class Loud(rr.Actor):
    """Ends with a long text."""

    def on_receive(self, message: str) -> None:
        """Raise it."""
        raise ValueError(message)


def test_of_records_that_are_too_long_for_one_answer_the_newest_are_shown(start: Start) -> None:
    loud = rr.ChildSpec(Loud, id="loud", placement="thread")
    system = start(rr.Supervisor([loud], id="root", max_restarts=1000))
    supervisor, ref, ends = system.supervisor(), system.ref("loud"), 130
    for number in range(1, ends + 1):
        eventually(ref.is_alive)
        ref.tell(f"{number} " + "\N{BELL}" * 10_000)
        eventually(lambda number=number: len(supervisor.history()) == 2 * number + 1)

    for shown in (rr_actors("history", "--limit", 500, "--json"), rr_actors("events", "--json", "--count", 500)):
        assert shown.returncode == 0, shown.stderr
        lines = [json.loads(line) for line in shown.stdout.splitlines()]
        assert lines[-2]["detail"].startswith(f"ValueError: {ends} ")
        left_out = 2 * ends + 1 - len(lines)
        assert 0 < left_out < ends
        (note,) = shown.stderr.splitlines()
        assert note.startswith(f"{left_out} older records are not shown: they are too long for one answer")


def test_dead_letters_are_shown(shop: rr.System) -> None:
    ref = rr.Actor.start()
    ref.stop()
    with pytest.raises(rr.ActorDeadError):
        ref.tell("too late")

    assert eventually(lambda: "too late" in said("dead-letters"))
    assert json.loads(said("dead-letters", "--json"))["count"] == 1


def test_why_says_who_holds_it_for_whom_and_since_when(app: rr.Registrar, shop: rr.System) -> None:
    query = app.load("shop/thing", Order("whole", ("shop/thing:part",)))
    (part,) = shop.registrar("shop").children(query)

    whole, below = said("why", query.id), said("why", part.id)

    assert "app holds shop/thing" in whole
    assert "app holds it since" in whole
    assert "It depends on shop/thing" in whole
    assert "shop holds it since" in below
    assert "for shop/thing" in below
    assert "\n  app holds it since" in below
    assert said("why", query.id[:-1]).split(" since ")[0] == whole.split(" since ")[0]


def test_why_prints_what_its_page_shows(system: rr.System) -> None:
    app, maps, cameras = map(system.open_registrar, ("app", "maps", "cameras"))
    serve(cameras, "camera")
    serve(maps, "map", load=lambda request: maps.load("cameras/camera", f"/dev/{request}").id)
    camera = app.load("maps/map", "kitchen").response
    page = (REPOSITORY / "docs" / "console.md").read_text()
    _, shown, _ = re.split(r"^\$ rr-actors why \w+\n|```\n(?=\n## Live in)", page, flags=re.MULTILINE)

    assert _without_ids_and_times(said("why", camera)) == _without_ids_and_times(shown)


def _without_ids_and_times(text: str) -> str:
    return re.sub(r"[0-9a-f]{32}", "ID", re.sub(r"since [\d:]+ \(\d+ s\)", "since TIME", text))


def test_why_says_what_a_load_waits_for(system: rr.System, gate: Gate) -> None:
    app, provider = system.open_registrar("app"), system.open_registrar("provider")
    serve(provider, "part", load=lambda request: gate(request))
    serve(provider, "whole", load=lambda request: provider.load("provider/part", request).response)
    load = app.load("provider/whole", "x", block=False)
    gate.wait_arrived()
    (held,) = json.loads(said("resources", "whole", "--json"))

    text = said("why", held["id"])

    assert "app has waited for provider/whole" in text
    assert "is being loaded" in text
    assert 'It waits for provider/part "x"' in text
    gate.open()
    load.get(timeout=10)


def test_why_of_what_nobody_knows_is_an_error(shop: rr.System) -> None:
    assert "no query and no resource" in refused(2, "why", "0123456789")


@pytest.mark.parametrize("of", ["tree", "dependencies", "both"])
def test_a_graph_is_drawn_for_mermaid_and_graphviz(app: rr.Registrar, of: str) -> None:
    app.load("shop/thing", Order('with "quotes"', ("shop/thing:part",)))

    mermaid, dot = said("graph", "--of", of), said("graph", "--of", of, "--format", "dot")

    assert mermaid.startswith("graph TD\n")
    assert ("n0 --> n1" in mermaid) == (of != "dependencies")
    assert ("h0 --> r" in mermaid) == (of != "tree")
    assert dot.startswith("digraph system {\n")
    assert dot.rstrip().endswith("}")
    assert dot.count("{") == dot.count("}") or of != "tree"
    assert ('"root" -> "root/shop"' in dot) == (of != "dependencies")
    assert ('"holder app" -> ' in dot) == (of != "tree")


def test_registrars_with_names_alike_have_boxes_of_their_own() -> None:
    rows = [ResourceRow(f"{number}", f"{name}/thing", "1", "", "loaded", "OK", "", 1, [], 0, [], 0)
            for number, name in enumerate(("arm.left", "arm-left", "arm_left"))]  # fmt: skip

    boxes = [
        line.partition("[")[0] for line in graphs.mermaid([], rows, "dependencies").splitlines() if "subgraph" in line
    ]

    assert len(set(boxes)) == 3


# -- driving ---------------------------------------------------------------------------------------------------------


def test_a_load_shows_its_response_and_is_held_if_it_is_to_be(app: rr.Registrar, shop: rr.System) -> None:
    tried = said("load", "shop/thing", '{"name": "a"}').splitlines()
    held = json.loads(said("load", "shop/thing", '{"name": "b"}', "--hold", "--json"))
    said("load", "shop/thing", '{"name": "c"}', "--as", "app")

    assert tried[0] == "loaded shop/thing and released it again"
    assert json.loads(tried[1])["name"] == "a"
    assert held["holder"] == "console"
    assert [query.request.name for query in app.queries()] == ["c"]
    assert "released query" in said("unload", held["query_id"])
    assert shop.registrar("console").queries() == []


def test_errors_of_the_system_are_one_line_and_their_exit_codes_say_whose_fault_it_is(
    app: rr.Registrar, workshop: Workshop, shop: rr.System
) -> None:
    serve(app, "broken", load=lambda request: 1 / 0)

    assert "expected JSON" in refused(2, "load", "shop/thing", "front")
    assert "no such server" in refused(2, "load", "shop/nothing", "1")
    assert "ZeroDivisionError" in refused(4, "load", "app/broken", "1")
    assert "nobody holds" in refused(2, "unload", "0123456789")
    assert "expected OK, UPDATE" in refused(2, "status", "shop/x", "BAD")
    assert "SIGTERM" in refused(2, "kill", "shop", "--signal", "NOTHING")
    assert "cannot be read" in refused(2, "start", "nowhere.toml")
    assert "shop" in refused(2, "terminate", "nobody")


def test_a_status_is_sent_to_a_resource(app: rr.Registrar) -> None:
    heard = Calls()
    query = app.load("shop/thing", Order("a"), on_status=heard)

    assert "told 1 holder" in said("status", f"shop/thing/{query.resource_id}", "warning", "it is hot")

    (status,) = heard.wait()
    assert (status.state, status.message) == (rr.State.WARNING, "it is hot")


def test_children_are_killed_stopped_restarted_and_added(shop: rr.System, workshop: Workshop, tmp_path: Path) -> None:
    pid = shop.ref("shop").pid
    assert pid is not None
    spec = tmp_path / "second.toml"
    spec.write_text(f'actor = "support_managers:Shop"\nid = "second"\nargs = ["{workshop.root}"]\n')

    assert said("kill", "shop").strip() == f"sent SIGKILL to root/shop (pid {pid})"
    wait_gone(pid)
    eventually(lambda: shop.ref("shop").pid)
    assert said("terminate", "root/shop").strip() == "stopped root/shop"
    assert said("restart", "shop").strip() == "started root/shop again"
    assert said("start", spec).strip() == "started the worker root/second"
    assert "second/thing" in shop.registrar("second").servers()


def test_a_dry_run_says_what_would_be_done_and_changes_nothing(shop: rr.System, app: rr.Registrar) -> None:
    pid = shop.ref("shop").pid

    assert said("kill", "shop", "--dry-run").startswith("would send SIGKILL")
    assert said("load", "shop/thing", '{"name": "a"}', "--dry-run").startswith("would load")
    assert said("shutdown", "--dry-run").startswith("would stop")

    assert shop.ref("shop").pid == pid
    assert shop.registrar("shop").resources() == []


def test_each_command_has_an_example_in_its_help() -> None:
    script = (
        "from rr_actors.tools.console_verbs import app\n"
        "import typer\n"
        "for name, each in typer.main.get_command(app).commands.items(): print(name, '|', each.epilog or '')\n"
    )
    shown = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    examples = dict(line.split(" | ", 1) for line in shown.splitlines())

    older = {"version", "inspect", "tree", "check", "chaos"}
    for name, example in examples.items():
        assert name in older or example.startswith(f"Example: rr-actors {name}"), name
    assert "Example: rr-actors kill" in said("kill", "--help")


def test_a_shell_completes_what_the_running_system_has(app: rr.Registrar) -> None:
    query = app.load("shop/thing", Order("a"))

    assert completing("kill", "sh") == ["shop"]
    assert completing("kill", "root/") == ["root/shop"]
    assert completing("load", "sh") == ["shop/thing"]
    assert completing("why", query.id[:8]) == [query.id]


def completing(name: str, incomplete: str) -> list[str]:
    """What is offered for the first argument of a command."""
    script = (
        "import sys, typer, click\n"
        "from rr_actors.tools.console_verbs import app\n"
        "group = typer.main.get_command(app)\n"
        "each = group.commands[sys.argv[1]]\n"
        "context = each.make_context(sys.argv[1], [], resilient_parsing=True)\n"
        "first = next(one for one in each.params if one.param_type_name == 'argument')\n"
        "print(*(item.value for item in first.shell_complete(context, sys.argv[2])))\n"
    )
    ran = subprocess.run([sys.executable, "-c", script, name, incomplete], capture_output=True, text=True, check=True)
    return ran.stdout.split()


# -- run -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def running(tmp_path: Path, workshop: Workshop, state_dir: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start `rr-actors run` with a tree of one Shop, and wait until it is ready."""
    processes: list[subprocess.Popen[str]] = []

    def run(more: str = "") -> subprocess.Popen[str]:
        tree = tmp_path / "tree.toml"
        tree.write_text(
            f'{more}\n[[children]]\nactor = "support_managers:Shop"\nid = "shop"\nargs = ["{workshop.root}"]\n'
        )
        process = subprocess.Popen(
            command("run", tree, "--state", state_dir), stderr=subprocess.PIPE, text=True, cwd=tmp_path
        )
        processes.append(process)
        eventually(lambda: workshop.lines("started shop"), timeout=30.0)
        eventually(lambda: rr_actors("ps", "--state", state_dir).returncode == 0, timeout=30.0)
        return process

    yield run
    for process in processes:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_system_from_files_ends_in_order_with_a_signal(
    running: Callable[..., subprocess.Popen[str]], workshop: Workshop, number: signal.Signals, state_dir: Path
) -> None:
    process = running()
    said("load", "shop/thing", '{"name": "a"}', "--hold", "--state", state_dir)

    process.send_signal(number)
    _, log = process.communicate(timeout=20)

    assert process.returncode == 0, log
    assert "Traceback" not in log
    assert workshop.lines("unload a")
    assert workshop.lines("stop shop")
    assert not (state_dir / "run").exists()


def test_a_system_from_files_is_shut_down_from_outside(
    running: Callable[..., subprocess.Popen[str]], state_dir: Path
) -> None:
    process = running()

    assert said("shutdown", "--state", state_dir).strip() == "system system is stopping"

    _, log = process.communicate(timeout=20)
    assert process.returncode == 0, log


WATCHED = """
import rr_actors as rr

class Clock(rr.Manager):
    @rr.server("time")
    def tell(self, request: str) -> str:
        return "{answer}"
"""


@pytest.mark.parametrize("restart", ["permanent", "temporary"])
def test_a_child_whose_module_changes_is_restarted_and_one_that_is_no_python_runs_on(
    tmp_path: Path, state_dir: Path, restart: str
) -> None:
    module, tree = tmp_path / "watched_clock.py", tmp_path / "tree.toml"
    module.write_text(WATCHED.format(answer="one"))
    tree.write_text(f'[[children]]\nactor = "watched_clock:Clock"\nid = "clock"\nrestart = "{restart}"\n')
    run = command("run", tree, "--state", state_dir, "--watch", "--json")
    with subprocess.Popen(run, stderr=subprocess.PIPE, text=True, cwd=tmp_path) as process:
        try:
            log = process.stderr
            assert log is not None
            _await(log, "runs in")
            assert "one" in said("load", "clock/time", '"x"', "--state", state_dir)
            module.write_text("def broken(:\n")
            assert "cannot be loaded" in _await(log, "watched_clock.py")["message"]
            assert "one" in said("load", "clock/time", '"y"', "--state", state_dir)
            module.write_text("raise RuntimeError('the clock is broken')\n")
            assert "it does not start" in _await(log, "watched_clock.py")["message"]
            module.write_text(WATCHED.format(answer="two, and longer"))
            assert "root/clock: restarted" in _await(log, "watched_clock.py")["message"]
            assert "two" in said("load", "clock/time", '"z"', "--state", state_dir)
        finally:
            process.terminate()
            process.communicate(timeout=20)
    assert process.returncode == 0


def _await(log: IO[str], text: str) -> dict[str, Any]:
    """The first record of a log in JSON that has the text in its message."""
    for line in log:
        record: dict[str, Any] = json.loads(line)
        if text in record["message"]:
            return record
    raise AssertionError(f"the log ended without {text!r}")


def test_a_tree_that_gives_up_ends_with_exit_code_1(
    running: Callable[..., subprocess.Popen[str]], state_dir: Path
) -> None:
    process = running("max_restarts = 0")

    said("kill", "shop", "--state", state_dir)

    _, log = process.communicate(timeout=20)
    assert process.returncode == 1, log


def test_a_tree_that_cannot_be_read_is_one_line(tmp_path: Path) -> None:
    tree = tmp_path / "tree.toml"
    tree.write_text("children = 3")

    line = refused(2, "run", tree, "--state", tmp_path / "state")

    assert "tree.toml" in line
    assert "children" in line


def test_time_spans_are_readable() -> None:
    assert [ago(seconds) for seconds in (0.2, 59, 61, 3700, 200_000)] == ["0 s", "59 s", "1 min", "1 h 2 min", "2 days"]
    rounded = [ago(seconds) for seconds in (59.7, 3590, 7190, 172_790)]
    assert rounded == ["1 min", "1 h 0 min", "2 h 0 min", "2 days"]


def test_events_about_something_are_those_that_mention_it_with_and_without_follow(
    shop: rr.System, app: rr.Registrar
) -> None:
    wait_respawned(shop, "shop", kill(shop, "shop"))

    assert "exited" in said("events", "--about", "root/sh")
    assert "exited" in said("events", "--about", "SIGKILL", "--json")
    assert said("events", "--about", "shop/thing") == ""
    assert said("events", "--about", "root/nobody") == ""
    asked = command("events", "--follow", "--about", "shop/thi", "--count", 1)
    with subprocess.Popen(asked, stdout=subprocess.PIPE, text=True) as following:
        assert shop._node is not None
        watched = shop._node.watched
        eventually(lambda: bool(watched))
        app.load("shop/thing", Order("lamp"))
        line, _ = following.communicate(timeout=30)
    assert "loaded" in line


# -- recording -------------------------------------------------------------------------------------------------------


def test_record_writes_a_file_that_sequence_draws(shop: rr.System, app: rr.Registrar, tmp_path: Path) -> None:
    file = tmp_path / "one.jsonl"
    assert shop._node is not None
    watched = shop._node.watched
    with subprocess.Popen(command("record", file), stdout=subprocess.PIPE, text=True) as recording:
        eventually(lambda: watched.recording)
        query = app.load("shop/thing", Order("r2"))
        eventually(lambda: "Loaded" in file.read_text())
        recording.send_signal(signal.SIGINT)
        told, _ = recording.communicate(timeout=20)
    lines = said("sequence", query.id[:30], "--file", file).splitlines()

    assert recording.returncode == 0
    assert told.startswith("recorded ")
    assert told.endswith(f" entries in {file}\n")
    assert lines[0] == "sequenceDiagram"
    assert any("p0->>p1" in line and "Load shop/thing" in line for line in lines)
    assert any("load shop/thing returned" in line for line in lines)
    entries = [json.loads(line) for line in said("sequence", query.id, "--file", file, "--json").splitlines()]
    assert entries[0]["name"] == "Load"
    assert "no query or resource" in refused(2, "sequence", "ffffffff", "--file", file)
    assert "there is a file already" in refused(2, "record", file)


def test_a_line_about_missed_events_says_how_many_rows_the_tree_has(capsys: pytest.CaptureFixture[str]) -> None:
    page = Children(501, [ChildRow("root", 0, "supervisor", "running")])
    console_verbs._say_missed(Missed(3, 9, page), True)
    said = json.loads(capsys.readouterr().out)
    assert (said["missed"], said["seq"], said["total"], len(said["tree"])) == (3, 9, 501, 1)


def test_sequence_says_how_many_entries_it_was_too_slow_for(
    shop: rr.System, app: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console_feed, "KEPT_OF_RECORDING", 100)
    query = app.load("shop/thing", Order("chair"))
    assert shop._node is not None
    assert shop._console is not None
    watched, feed = shop._node.watched, shop._console.feed
    asked = command("sequence", query.id, "--seconds", 4)
    with subprocess.Popen(asked, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as drawing:
        eventually(lambda: watched.recording)
        (reader,) = feed._readers
        while not reader.missed:
            app.load_all([("shop/thing", Order("lamp"))] * 100)
        eventually(lambda: not reader._waiting)
        query.unload()
        diagram, said_of_it = drawing.communicate(timeout=30)

    assert drawing.returncode == 0
    assert "Unload" in diagram
    assert int(said_of_it.partition(" entries were missed")[0]) > 100


def test_record_writes_how_many_entries_it_was_too_slow_for_and_sequence_says_so(
    shop: rr.System, app: rr.Registrar, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console_feed, "KEPT_OF_RECORDING", 100)
    file = tmp_path / "slow.jsonl"
    query = app.load("shop/thing", Order("chair"))
    assert shop._node is not None
    assert shop._console is not None
    watched, feed = shop._node.watched, shop._console.feed
    with subprocess.Popen(command("record", file), stdout=subprocess.PIPE, text=True) as recording:
        eventually(lambda: watched.recording)
        (reader,) = feed._readers
        while not reader.missed:
            app.load_all([("shop/thing", Order("lamp"))] * 100)
        eventually(lambda: not reader._waiting)
        query.unload()
        eventually(lambda: "Unload" in file.read_text())
        recording.send_signal(signal.SIGINT)
        told, _ = recording.communicate(timeout=20)
    read = rr_actors("sequence", query.id, "--file", file)

    missed = rr.read_recording(file).missed
    assert missed > 100
    assert told.endswith(f", {missed} missed\n")
    assert read.stderr == f"{missed} entries were missed, and are not in it\n"


def test_events_of_a_kind_that_there_is_not_are_refused_with_those_that_there_are(shop: rr.System) -> None:
    line = refused(2, "events", "--event", "start")
    assert "--event: expected one of started, restarted," in line
    assert "got 'start'" in line
    assert "started" in said("events", "--event", "started")


@pytest.mark.parametrize("seconds", ["-1", "nan", "1e9"])
def test_a_time_limit_that_is_none_is_refused_by_its_option(shop: rr.System, seconds: str) -> None:
    ran = rr_actors("load", "shop/thing", '{"name": "x"}', "--timeout", seconds)
    assert ran.returncode == 2
    assert "--timeout" in ran.stderr


@pytest.mark.parametrize("number", ["²", "9" * 5000], ids=["a superscript", "a long number"])
def test_a_signal_that_is_no_number_of_one_is_refused(shop: rr.System, number: str) -> None:
    assert "expected a signal's name or number" in refused(2, "kill", "shop", "--signal", number)


def test_a_recording_without_an_end_is_refused(shop: rr.System, tmp_path: Path) -> None:
    ran = rr_actors("record", tmp_path / "new.jsonl", "--seconds", "inf")

    assert ran.returncode == 2
    assert "'--seconds'" in ran.stderr
    assert not (tmp_path / "new.jsonl").exists()


def test_a_closed_standard_output_is_said_in_one_line(shop: rr.System) -> None:
    shell = f"exec {sys.executable} -m rr_actors ps >&-"
    ran = subprocess.run(["sh", "-c", shell], stderr=subprocess.PIPE, text=True)
    assert (ran.returncode, ran.stderr) == (2, "rr-actors: expected a standard output, got a closed one\n")


def test_a_narrow_terminal_wraps_a_table_rather_than_leaving_out_its_columns(shop: rr.System) -> None:
    ours, terminal = os.openpty()
    try:
        termios.tcsetwinsize(terminal, (24, 40))
        environment = {name: value for name, value in os.environ.items() if name != "COLUMNS"} | {"TERM": "xterm"}
        ran = subprocess.run(command("ps"), env=environment, stdin=terminal, stdout=terminal, stderr=subprocess.PIPE)
        shown = os.read(ours, 65536).decode()
    finally:
        os.close(ours)
        os.close(terminal)

    assert ran.returncode == 0
    assert f" {pid_of(shop, 'shop')} " in shown
    assert "…" not in shown


def test_record_ends_after_its_seconds_and_with_the_system(shop: rr.System, tmp_path: Path) -> None:
    assert "recorded" in said("record", tmp_path / "one", "--seconds", "0.2")
    assert shop._node is not None
    watched = shop._node.watched
    eventually(lambda: not watched.recording)
    with subprocess.Popen(command("record", tmp_path / "two"), stdout=subprocess.PIPE, text=True) as recording:
        eventually(lambda: watched.recording)
        shop.stop()
        told, _ = recording.communicate(timeout=20)

    assert recording.returncode == 0
    assert "recorded" in told


def test_sequence_without_a_file_draws_what_happens_now(shop: rr.System, app: rr.Registrar) -> None:
    assert shop._node is not None
    watched = shop._node.watched
    query = app.load("shop/thing", Order("r2"))
    with subprocess.Popen(
        command("sequence", query.id, "--seconds", "3"), stdout=subprocess.PIPE, text=True
    ) as drawing:
        eventually(lambda: watched.recording)
        query.unload()
        told, _ = drawing.communicate(timeout=20)

    assert "Unload" in told
    assert "unload shop/thing returned" in told


def test_graph_draws_svg_itself(shop: rr.System, app: rr.Registrar) -> None:
    app.load("shop/thing", Order("<r2>"))
    drawn = ElementTree.fromstring(said("graph", "--format", "svg"))
    shown = {element.text for element in drawn.iter("{http://www.w3.org/2000/svg}text")}

    assert {"root", "shop", "shop/thing", "app"} <= shown


# What rsvg-convert does, as far as graph needs it: a PNG's first bytes, of the size that the SVG says.
STAND_IN = f"""#!{sys.executable}
import struct, sys
from xml.etree import ElementTree
assert sys.argv[1:] == ["--format", "png"], sys.argv
picture = ElementTree.fromstring(sys.stdin.buffer.read())
size = struct.pack(">II", int(picture.get("width")), int(picture.get("height")))
sys.stdout.buffer.write(b"\\x89PNG\\r\\n\\x1a\\n\\0\\0\\0\\rIHDR" + size)
"""


def stand_in(folder: Path, program: str) -> dict[str, str]:
    """Have an rsvg-convert of the test's own found before all others; returns the environment for that."""
    place = folder / "rsvg-convert"
    place.write_text(program)
    place.chmod(0o755)
    return {"PATH": f"{folder}:{os.environ['PATH']}"}


def test_graph_draws_a_png_of_the_size_of_its_svg(shop: rr.System, app: rr.Registrar, tmp_path: Path) -> None:
    app.load("shop/thing", Order("<r2>"))
    environment = {} if shutil.which("rsvg-convert") else stand_in(tmp_path, STAND_IN)
    svg = ElementTree.fromstring(said("graph", "--format", "svg"))
    png = subprocess.run(command("graph", "--format", "png"), env=os.environ | environment, capture_output=True)

    assert png.returncode == 0, png.stderr
    assert png.stdout[:16] == b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR"
    assert struct.unpack(">II", png.stdout[16:24]) == (int(svg.attrib["width"]), int(svg.attrib["height"]))


def test_graph_says_why_there_is_no_png(shop: rr.System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", stand_in(tmp_path, "#!/bin/sh\necho 'too large' >&2; exit 3\n")["PATH"])
    assert "rsvg-convert ended with 3: too large" in refused(4, "graph", "--format", "png")
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))
    assert "apt-get install librsvg2-bin" in refused(2, "graph", "--format", "png")


def test_graph_writes_no_png_to_a_terminal(shop: rr.System) -> None:
    ours, terminal = os.openpty()
    try:
        drawing = command("graph", "--format", "png")
        ran = subprocess.run(drawing, stdout=terminal, stderr=subprocess.PIPE, text=True)
    finally:
        os.close(ours)
        os.close(terminal)

    assert ran.returncode == 2
    assert "got a terminal: rr-actors graph --format png > graph.png" in ran.stderr
