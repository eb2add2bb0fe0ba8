"""The command line at a running system: what each verb shows and does, and what it says when it cannot."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import struct
import subprocess
import sys
import termios
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any
from xml.etree import ElementTree

import pytest

import rr_actors as rr
from rr_actors.registrar.pages import HOLDERS_SHOWN, ResourceRow
from rr_actors.system.console import console_feed
from rr_actors.system.console.console_connection import ConsoleConnection
from rr_actors.system.console.console_messages import Children, ChildRow, Missed
from rr_actors.system.recording.event_texts import ago
from rr_actors.tools import graphs
from rr_actors.tools.verbs import console_verbs
from rr_actors.tools.verbs.verb_group import VERBS, whole
from support import (
    LIMIT_S,
    REPOSITORY,
    Calls,
    Gate,
    Workshop,
    eventually,
    kill,
    pid_of,
    serve,
    wait_gone,
    wait_respawned,
)
from support_cli import run_cli
from support_inside import console_of, node_of
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


# -- waiting, and one child ------------------------------------------------------------------------------------------


def waiting(*arguments: object) -> subprocess.Popen[str]:
    """A command that waits."""
    return subprocess.Popen(command("wait", *arguments), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def test_a_script_waits_for_a_system_that_does_not_run_yet_and_then_for_its_child(
    start: Start, workshop: Workshop, tmp_path: Path
) -> None:
    with waiting("shop", "--state", tmp_path / "later", "--timeout", "60") as waits:
        start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)), state_dir=tmp_path / "later")
        out, _ = waits.communicate(timeout=LIMIT_S)
    assert waits.returncode == 0
    assert out.startswith("shop: running after ")
    assert "no system with a console" in refused(3, "wait", "shop", "--timeout", "0", "--state", tmp_path / "never")


def test_a_script_waits_for_a_resource_its_state_and_its_end(app: rr.Registrar) -> None:
    name = 'shop/thing {"name":"lamp","parts":[]}'
    with waiting(name) as waits:
        query = app.load("shop/thing", Order("lamp"))
        assert waits.wait(LIMIT_S) == 0
    with waiting(query.id, "--for", "warning", "--json") as waits:
        said("status", name, "WARNING", "hot")
        facts = json.loads(waits.communicate(timeout=LIMIT_S)[0])
    assert (waits.returncode, facts["target"], facts["state"], facts["done"]) == (0, query.id, "WARNING", True)
    with waiting(name, "--for", "gone") as waits:
        query.unload()
        assert waits.wait(LIMIT_S) == 0


def test_a_script_waits_for_the_end_of_a_system(shop: rr.System, state_dir: Path) -> None:
    ended, other = (waiting("shop", "--for", wanted, "--state", state_dir) for wanted in ("gone", "stopped"))
    with ended, other:
        eventually(lambda: console_of(shop).programs.total() == 4)
        shop.stop()
        assert ended.wait(LIMIT_S) == 0
        assert other.wait(LIMIT_S) in (0, 3)  # it may have seen the child stopped before the console ended


def test_what_a_script_waits_for_in_vain_is_told_and_nonsense_is_refused(app: rr.Registrar) -> None:
    for number in range(2):
        app.load("shop/thing", Order(f"lamp {number}"))
    ran = rr_actors("wait", "shop", "--for", "stopped", "--timeout", "0.2")
    assert ran.returncode == 1
    assert re.fullmatch(r"shop: still running after [\d.]+ s\n", ran.stderr)
    assert "nothing: still gone after" in rr_actors("wait", "nothing", "--timeout", "0").stderr
    told = "--for: expected running, starting, restarting, stopped, OK, UPDATE, WARNING, ERROR, FATAL, loaded, loading"
    assert told in refused(2, "wait", "shop", "--for", "happy")


def test_the_status_of_a_child_is_on_one_screen(app: rr.Registrar, shop: rr.System) -> None:
    app.load("shop/thing", Order("lamp"))
    kill(shop, "shop")
    said("wait", "shop")
    shown = said("status", "shop").splitlines()
    assert shown[0] == "root/shop: running"
    assert re.fullmatch(rf"    process {pid_of(shop, 'shop')}, up for .*, 1 restart", shown[1])
    assert re.fullmatch(r"    [\d.]+ % of a core, \d+ MiB", shown[2])
    assert shown[3].startswith("    registrar shop: up, serves shop/thing")
    assert [word for line in shown for word in ("started", "exited") if word in line] == [
        "started",
        "exited",
        "started",
    ]
    facts = json.loads(said("status", "root/shop", "--json"))
    assert (facts["restarts"], len(facts["history"]), facts["registrars"][0]["name"]) == (1, 3, "shop")

    said("terminate", "shop")
    ran = rr_actors("status", "shop")
    assert (ran.returncode, ran.stdout.splitlines()[0]) == (1, "root/shop: stopped")


def test_the_status_of_a_resource_is_explained_and_of_nothing_refused(app: rr.Registrar) -> None:
    query = app.load("shop/thing", Order("lamp"))
    assert _without_ids_and_times(said("status", query.id)) == _without_ids_and_times(said("why", query.id))
    assert "no query and no resource" in refused(2, "status", "nothing")


def test_a_resource_is_revoked_from_outside(app: rr.Registrar) -> None:
    heard: list[rr.Status] = []
    query = app.load("shop/thing", Order("lamp"), on_status=heard.append)
    name = 'shop/thing {"name":"lamp","parts":[]}'
    assert said("revoke", name, "low battery", "--dry-run").startswith(f"would revoke {name} (")
    assert said("revoke", name, "low battery", "--grace", "20").endswith(" from 1 holder\n")
    assert [(str(status.state), status.message, status.reason) for status in heard] == [
        ("FATAL", "low battery", "revoked")
    ]
    assert app.queries() == []
    assert "no registrar serves a resource" in refused(2, "revoke", query.id, "again")


def test_a_resource_is_reloaded_from_outside(app: rr.Registrar) -> None:
    heard = Calls()
    query = app.load("shop/thing", Order("lamp"), on_status=heard)
    name = 'shop/thing {"name":"lamp","parts":[]}'
    assert re.fullmatch(rf"would reload {re.escape(name)} \(\w+\), held by app\n", said("reload", name, "--dry-run"))
    assert len(heard) == 0
    assert "; `rr-actors reload" in refused(2, "restart", query.resource_id)
    assert f"got a resource, {name}; `rr-actors reload {query.resource_id}`" in refused(2, "restart", name)
    done = json.loads(said("reload", query.resource_id, "--json"))
    assert (done["resource_id"], done["server"], done["holders"]) == (query.resource_id, "shop/thing", 1)
    assert heard.wait()[0].message == "reloaded"
    assert "no registrar serves a resource" in refused(2, "reload", "0000000000")
    assert "no child 'nobody' (it has: shop)" in refused(2, "restart", "nobody")


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


class Gated(rr.Manager):
    """Opens doors one at a time, and each when the test says so."""

    gate = Gate()

    @rr.server("door", at_once=1)
    def open_door(self, door: str) -> str:
        self.gate(door)
        return door

    @rr.server("lamp")
    def switch_on(self, lamp: str) -> str:
        return lamp


def test_ps_shows_the_parts_of_a_manager_and_what_they_do(start: Start) -> None:
    Gated.gate = Gate()
    system = start(
        rr.ChildSpec(Gated, id="house", placement="thread"), rr.ChildSpec(Quiet, id="quiet", placement="thread")
    )
    app = system.open_registrar("app")
    app.load("house/lamp", "hall")
    loads = [app.load("house/door", number, block=False) for number in ("1", "2", "3")]
    Gated.gate.wait_arrived()
    assert "registrar" not in said("ps")
    eventually(lambda: "2 wait" in said("ps", "--parts"))
    rows = {row["path"]: row for row in json.loads(said("ps", "--parts", "--json"))}
    place = "root/house/registrar"
    assert list(rows) == ["root", "root/house", place, f"{place}/servers/door", f"{place}/servers/lamp", "root/quiet"]
    assert [
        (rows[f"{place}/servers/{name}"]["type"], rows[f"{place}/servers/{name}"]["note"]) for name in ("door", "lamp")
    ] == [("server", "runs 1 load; 2 wait; 3 resources"), ("server", "1 resource")]
    assert f"{place}/servers/door" in said("ps", "house", "--parts")
    Gated.gate.open()
    for load in loads:
        load.get(timeout=LIMIT_S)
    eventually(lambda: "runs" not in said("ps", "--parts"))


class Quiet(rr.Actor):
    """Has no registrar."""


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


def test_usage_shows_the_numbers_of_resources_and_why_others_are_not_known(app: rr.Registrar) -> None:
    def usage(request: str, response: Any) -> dict[str, float]:
        if request == "broken":
            raise OSError("no meter")
        return {"watts": len(request) / 2, "memory_bytes": 3 * 2**20}

    assert rr_actors("usage").stderr == "no resource says what it uses\n"
    serve(app, "lamp", usage=usage)
    app.load("shop/thing", Order("chair"))  # its server does not say what it uses
    broken, hall, attic = (app.load("app/lamp", request).resource_id for request in ("broken", "hall", "attic"))
    ran = rr_actors("usage")
    heads, *rows = ran.stdout.splitlines()
    assert heads.split() == ["resource", "watts", "memory", "id"]
    assert [row.split()[:-1] for row in rows] == [
        ["app/lamp", '"hall"', "2", "3", "MiB"],
        ["app/lamp", '"attic"', "2.5", "3", "MiB"],
    ]
    assert ran.stderr.startswith('not known: app/lamp "broken" (')
    assert ran.stderr.endswith("): app/lamp: usage: OSError: no meter\n")
    found = json.loads(said("usage", "-o", "json", "--sort-by", "watts"))
    assert [row["id"] for row in found] == [attic, hall, broken]
    assert found[0]["usage"] == {"watts": 2.5, "memory_bytes": 3 * 2**20}
    assert (found[2]["usage"], found[2]["failure"]) == ({}, "app/lamp: usage: OSError: no meter")
    assert said("usage", "attic", "-o", "name", "--registrar", "app") == 'app/lamp "attic"\n'
    assert "1 more" in rr_actors("usage", "--limit", "2").stderr
    told = "rr-actors: --sort-by: expected one of watts, memory_bytes, got 'volts'"
    assert refused(2, "usage", "--sort-by", "volts") == told


def test_resources_are_listed_and_chosen(app: rr.Registrar) -> None:
    query = app.load("shop/thing", Order("lamp"))
    app.load("shop/thing", Order("chair"))

    assert said("resources", "lamp").splitlines()[1].split()[:2] == ["shop/thing", '{"name":"lamp","parts":[]}']
    (row,) = json.loads(said("resources", "lamp", "--json"))
    assert row["holders"] == [{"query_id": query.id, "origin": "app", "parent": ""}]
    assert row["request"] == {"name": "lamp", "parts": []}
    assert "1 more" in rr_actors("resources", "--limit", "1").stderr


def test_a_list_for_programs_has_all_rows_and_says_what_a_limit_leaves_out(app: rr.Registrar) -> None:
    for number in range(230):
        app.load("shop/thing", Order(f"lamp {number}"))

    assert len(json.loads(said("resources", "--json"))) == 230
    assert len(json.loads(said("resources", "-o", "json"))) == 230
    assert len(said("resources", "-o", "name").splitlines()) == 230
    assert "30 more: choose with MATCH, or raise --limit" in rr_actors("resources").stderr
    for form in (("--json",), ("-o", "name"), ("-o", "json")):
        assert "225 more" in rr_actors("resources", "--limit", "5", *form).stderr


def test_a_resource_is_named_and_every_command_takes_its_name_and_its_short_id(app: rr.Registrar) -> None:
    heard = Calls()
    queries = [app.load("shop/thing", Order(f"lamp {number}"), on_status=heard) for number in range(3)]
    lines = said("resources").splitlines()[1:]
    ids = [line.split()[-1] for line in lines]
    name = 'shop/thing {"name":"lamp 1","parts":[]}'

    assert [line.startswith(f'shop/thing {{"name":"lamp {number}"') for number, line in enumerate(lines)] == [True] * 3
    assert all(len(id) == 8 and query.resource_id.endswith(id) for id, query in zip(ids, queries, strict=True))
    assert _without_ids_and_times(said("why", ids[1])).endswith(_without_ids_and_times(said("why", name)))
    assert f"{name} ({ids[1]}) has been loaded" in said("why", ids[1])
    assert not re.search(r"[0-9a-f]{32}", said("why", name))
    assert "told 1 holder" in said("status", name, "WARNING", "hot")
    assert "told 1 holder" in said("status", f"shop/thing/{ids[1]}", "OK")
    assert said("unload", name).startswith("released query")
    assert said("unload", ids[0]).startswith("released query")
    assert said("unload", "--force", ids[2]).startswith('took shop/thing {"name":"lamp 2"')
    assert "no query and no resource" in refused(2, "why", name)


def test_lists_are_chosen_sorted_and_printed_as_names_for_other_commands(app: rr.Registrar, shop: rr.System) -> None:
    other = shop.open_registrar("other")
    first, second = (app.load("shop/thing", Order(name)) for name in "ab")
    other.load("shop/thing", Order("b"))
    said("status", f"shop/thing/{second.resource_id}", "WARNING", "hot")

    names = said("resources", "-o", "name", "--sort-by", "holders").splitlines()
    assert names == ['shop/thing {"name":"b","parts":[]}', 'shop/thing {"name":"a","parts":[]}']
    assert said("resources", "-o", "name", "--holder", "other").splitlines() == names[:1]
    assert said("resources", "-o", "name", "--status", "warning").splitlines() == names[:1]
    assert said("resources", "-o", "name", "--status", "OK").splitlines() == names[1:]
    assert [row["id"] for row in json.loads(said("resources", "-o", "json", "--status", "OK"))] == [first.resource_id]
    assert rr_actors("resources", "--holder", "nobody").stderr == "no resource matches\n"
    told = refused(2, "resources", "--status", "nonsense")
    assert "--status: expected one of OK, UPDATE," in told
    assert "got 'nonsense'" in told
    for name in names:
        assert name in said("why", name)
    assert set(said("ps", "-o", "name").splitlines()) == {"root", "root/shop"}
    assert said("ps", "--sort-by", "memory").splitlines()[1].split()[0] in {"root", "root/shop"}
    assert said("history", said("ps", "-o", "name").splitlines()[1])


def test_a_long_name_is_shortened_in_the_middle_and_taken_back_so(app: rr.Registrar) -> None:
    app.load("shop/thing", Order("begin" + "-" * 190 + "end"))
    (name,) = re.findall(
        r"^(shop/thing .*) \(\w+\) has been loaded", said("why", said("resources").split()[-1]), re.MULTILINE
    )

    assert len(name) == 60
    assert name.startswith('shop/thing {"name":"begin')
    assert "…" in name
    assert name.endswith('end","parts":[]}')
    assert name in said("why", name)


def test_events_are_followed_with_filters_as_lines_of_json(app: rr.Registrar, shop: rr.System) -> None:
    node = node_of(shop)
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


def following(system: rr.System, *arguments: object) -> subprocess.Popen[str]:
    """Follow the events by the command line; it has begun to listen."""
    node = node_of(system)
    process = subprocess.Popen(command("events", "--follow", *arguments), stdout=subprocess.PIPE, text=True)
    eventually(lambda: bool(node.watched), timeout=30.0)
    return process


@contextlib.contextmanager
def held_up(process: subprocess.Popen[str]) -> Iterator[None]:
    """What happens meanwhile reaches the process at once, however busy the machine is."""
    process.send_signal(signal.SIGSTOP)
    yield
    process.send_signal(signal.SIGCONT)


@pytest.mark.parametrize("wanted", [(), ("--about", "front"), ("--server", "maps"), ("--event", "status")])
def test_a_status_that_spreads_is_one_line_with_its_source_its_reach_and_who_heard_it(
    system: rr.System, wanted: tuple[str, ...]
) -> None:
    app, maps, cameras = map(system.open_registrar, ("app", "maps", "cameras"))
    serve(cameras, "camera")
    serve(maps, "map", load=lambda request: maps.load("cameras/camera", "front").id)
    heard: list[rr.Status] = []
    for name in ("kitchen", "hall", "stairs"):
        app.load("maps/map", name, on_status=heard.append)
    (camera,) = cameras.resources()

    follows = following(system, "--count", 1, *wanted)
    with held_up(follows):
        cameras.send_status(camera.id, rr.Status("WARNING", "blurred"))
        eventually(lambda: len(heard) == 3)
    out, _ = follows.communicate(timeout=30)

    (line,) = out.splitlines()
    told = 'status cameras/camera "front" WARNING blurred → 3 resources in 2 managers, heard by app'
    assert " ".join(line.split()[1:]) == told


def test_events_that_say_the_same_are_one_line_with_their_number(system: rr.System) -> None:
    app, provider = system.open_registrar("app"), system.open_registrar("provider")
    serve(provider, "lens")
    heard: list[rr.Status] = []
    query = app.load("provider/lens", "x", on_status=heard.append)

    follows = following(system, "--count", 1)
    with held_up(follows):
        for _ in range(3):
            provider.send_status(query.resource_id, rr.Status("WARNING", "dirty"))
        eventually(lambda: len(heard) == 3)
    out, _ = follows.communicate(timeout=30)

    assert out.rstrip().endswith('provider/lens "x"  WARNING dirty → heard by app (3 times)')


def test_events_of_a_child_are_those_of_all_below_it(start: Start) -> None:
    loud = [rr.ChildSpec(Loud, id=id, placement="thread") for id in ("one", "two")]
    system = start(rr.Supervisor([rr.Supervisor(loud, id="inner")], id="root"))
    for id in ("one", "two"):
        system.ref(id).tell("enough")
    eventually(lambda: len(system.supervisor("root/inner").history()) == 6)

    assert "two" not in said("events", "--child", "one")
    for name in ("inner", "root/inner"):
        assert {"one", "two"} <= set(re.findall("one|two", said("events", "--child", name)))
    assert said("events", "--event", "exited", "--child", "one", "--about", "nothing like it") == ""


def test_following_ends_with_the_system_and_with_ctrl_c(shop: rr.System) -> None:
    both = [subprocess.Popen(command("events", "-f"), stdout=subprocess.PIPE, stderr=subprocess.PIPE) for _ in range(2)]
    console = console_of(shop)
    eventually(lambda: len(console.feed.readers) == 2, timeout=30.0)

    both[0].send_signal(signal.SIGINT)
    _, interrupted = both[0].communicate(timeout=10)
    shop.stop()
    _, ended = both[1].communicate(timeout=10)

    assert b"Traceback" not in interrupted
    assert b"the system has ended" in ended
    assert both[1].returncode == 0


def test_following_into_a_reader_that_has_enough_ends_with_0(shop: rr.System) -> None:
    following = subprocess.Popen(command("events", "-f"), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    node = node_of(shop)
    eventually(lambda: bool(node.watched), timeout=30.0)
    assert following.stdout is not None
    following.stdout.close()
    wait_respawned(shop, "shop", kill(shop, "shop"))

    assert following.wait(timeout=30) == 0
    assert following.stderr is not None
    assert following.stderr.read() == b""
    following.stderr.close()


def test_history_tells_why_a_child_ended(shop: rr.System) -> None:
    wait_respawned(shop, "shop", kill(shop, "shop"))

    assert "SIGKILL" in said("history", "shop")
    lines = [json.loads(line) for line in said("history", "--json").splitlines()]
    assert [line["event"] for line in lines] == ["started", "exited", "restarted"]
    assert "exited" in said("events", "--event", "exited")


def test_the_history_of_the_root_is_that_of_all_below_it(shop: rr.System, state_dir: Path) -> None:
    assert "root/shop" in said("history", "root")
    assert said("status", "root").startswith("root: running\n")
    assert rr_actors("logs", "root").stderr == "no log lines of root\n"

    shop.stop()
    assert "root/shop" in said("history", "root", "--state", state_dir)


def test_after_a_tree_has_given_up_its_exits_are_still_shown_and_looking_counts_nothing(
    start: Start, state_dir: Path
) -> None:
    inner = rr.Supervisor([rr.ChildSpec(Loud, id="loud", placement="thread")], id="inner", max_restarts=0)
    system = start(rr.Supervisor([inner], id="root", max_restarts=0))
    system.ref("loud").tell("enough")
    assert system.wait(LIMIT_S)
    before = system.dead_letters().count

    for looks in range(3):
        history = said("history", "loud")
        assert "ValueError: enough" in history
        assert "Traceback" in history
        assert "gave_up" in said("events")
        rows = json.loads(said("ps", "--json"))
        assert [(row["path"], row["state"]) for row in rows[:1]] == [("root", "stopped")], looks
        system.figures()
    assert system.dead_letters().count == before

    system.stop()
    assert "ValueError: enough" in said("history", "loud", "--state", state_dir)
    told = "'nobody': there is no child of this path or id; there are: inner, loud, root"
    assert told in refused(2, "history", "nobody", "--state", state_dir)


def test_what_a_killed_system_has_done_is_read_from_its_state_directory(
    running: Callable[..., subprocess.Popen[str]], state_dir: Path
) -> None:
    application = running()
    said("kill", "shop", "--state", state_dir)
    eventually(lambda: "restarted" in said("history", "shop", "--state", state_dir))
    application.kill()
    application.wait(LIMIT_S)
    eventually(lambda: rr_actors("ps", "--state", state_dir).returncode == 3)

    ran = rr_actors("history", "shop", "--state", state_dir)
    assert (ran.returncode, ran.stderr) == (0, f"no system runs in {state_dir}: this is what it has left\n")
    assert "SIGKILL" in ran.stdout
    assert "SIGKILL" in rr_actors("events", "--event", "exited", "--state", state_dir).stdout

    again = running()
    assert "SIGKILL" in said("history", "shop", "--state", state_dir)
    again.terminate()
    again.wait(LIMIT_S)


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
        assert note.startswith(f"not shown: {left_out} older events, too long for one answer")


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

    assert "app has held shop/thing" in whole
    assert "app has held it since" in whole
    assert "It depends on shop/thing" in whole
    assert "shop has held it since" in below
    assert "for shop/thing" in below
    assert "\n  app has held it since" in below
    assert said("why", query.id[:-1]).split(" since ")[0] == whole.split(" since ")[0]


def test_why_says_below_a_resource_that_is_not_well_where_that_began(app: rr.Registrar, shop: rr.System) -> None:
    query = app.load("shop/thing", Order("whole", ("shop/thing:middle",)))
    (middle,) = shop.registrar("shop").children(query)
    low = app.load("shop/thing", Order("low"))
    shop.registrar("shop").send_status(middle, rr.Status("ERROR", "no frame for 2 s"))
    query.wait_status("ERROR")

    lines = said("why", query.id).splitlines()

    at = next(i for i, line in enumerate(lines) if line.startswith("It depends on"))
    assert lines[at].endswith(", which is ERROR.")
    assert lines[at + 1] == "  Its last status was ERROR: no frame for 2 s"
    assert "which is" not in said("why", low.id)


def test_priorities_are_given_and_explained(app: rr.Registrar, shop: rr.System) -> None:
    query = app.load("shop/thing", Order("whole", ("shop/thing:part",)), priority=5)
    (part,) = shop.registrar("shop").children(query)
    assert "Its priority is 5, the highest of its holders." in said("why", query.resource_id)
    assert "for itself, with priority 5." in said("why", query.id)

    assert said("priority", query.id, "-7", "--dry-run").startswith(f"would give priority -7 to query {query.id[-8:]}")
    assert query.priority == 5
    assert said("priority", query.id[-8:], "9").startswith(f"gave priority 9 to query {query.id[-8:]} of app")
    assert eventually(lambda: f"{query.resource_id[-8:]}), with priority 9." in said("why", part.resource_id))
    assert json.loads(said("priority", query.id, "standby", "--json"))["priority"] is None
    assert query.priority is None
    assert eventually(lambda: "all its holders have it on standby" in said("why", part.resource_id))


def test_a_pause_is_shown_and_explained(app: rr.Registrar, shop: rr.System) -> None:
    events: list[str] = []
    shop.subscribe(lambda event: events.append(event["event"]))
    provider = shop.open_registrar("provider")
    provider.register_server(
        "thing", lambda request: request, idle="pause", pause=lambda *_: None, resume=lambda *_: None
    )
    query = app.load("provider/thing", "x", priority=None)
    assert ": paused" in said("wait", query.resource_id, "--for", "paused")
    assert "is paused, as nobody needs it now. A load resumes it." in said("why", query.resource_id)
    assert "paused" in said("resources")
    query.priority = 0
    said("wait", query.resource_id, "--for", "loaded")
    assert eventually(lambda: [event for event in events if event in ("paused", "resumed")] == ["paused", "resumed"])


def test_a_revocation_is_explained(app: rr.Registrar, shop: rr.System) -> None:
    heard, goes_on = threading.Event(), threading.Event()

    def on_status(_status: rr.Status) -> None:
        heard.set()
        goes_on.wait(60)

    provider = shop.open_registrar("provider")
    provider.register_server("thing", lambda request: request)
    query = app.load("provider/thing", "x", on_status=on_status)
    revoking = threading.Thread(target=provider.revoke, args=(query.resource_id, "too hot"), kwargs={"grace_s": 60})
    revoking.start()
    assert heard.wait(60)
    assert "It is revoked (too hot): it is unloaded when its holders have released it" in said("why", query.resource_id)
    (row,) = said("resources", "--status", "revoked").splitlines()[1:]
    assert row.split()[:3] == ["provider/thing", '"x"', "revoked"]
    assert said("resources", "--status", "fatal").splitlines()[1:] == [row]
    assert all(": revoked" in said("wait", query.resource_id, "--for", word) for word in ("revoked", "FATAL"))
    goes_on.set()
    revoking.join()


def test_a_load_takes_a_priority(app: rr.Registrar, shop: rr.System) -> None:
    said("load", "shop/thing", '{"name": "x"}', "--as", "app", "--priority", "4")
    assert [info.priority for info in shop.registrar("shop").resources()] == [4]
    (row,) = json.loads(said("resources", "--json"))
    assert row["priority"] == 4
    app.queries()[0].standby()
    assert eventually(lambda: "standby" in said("resources"))


@pytest.mark.parametrize("wrong", ["1001", "-1001", "high", "1.0", ""])
def test_a_priority_that_is_none_is_refused(app: rr.Registrar, wrong: str) -> None:
    query = app.load("shop/thing", Order("x"))
    expected = f"expected a whole number from -1000 to 1000, or standby, got {wrong!r}"
    assert f"PRIORITY: {expected}" in refused(2, "priority", query.id, wrong)
    assert f"--priority: {expected}" in refused(2, "load", "shop/thing", '{"name": "y"}', f"--priority={wrong}")
    assert query.priority == 0
    assert "nobody holds a query of this id" in refused(2, "priority", "0000000000", "5")


def test_why_names_a_holder_that_is_slow_with_its_statuses(app: rr.Registrar, shop: rr.System) -> None:
    gate = Gate()
    query = app.load("shop/thing", Order("wheel"), on_status=lambda _: gate())
    for number in range(3):
        shop.registrar("shop").send_status(query.id, rr.Status(rr.State.WARNING, str(number)))

    assert "app has not dealt with 3 of its statuses." in said("why", query.id)
    gate.open()


def test_why_says_why_a_resource_could_not_be_unloaded_and_what_to_do(system: rr.System) -> None:
    app, provider = system.open_registrar("app"), system.open_registrar("provider")
    jams = [True, False]

    def unload(_request: str, _response: None) -> None:
        if jams.pop(0):
            raise OSError("the door jams")

    provider.register_server("box", lambda _: None, unload=unload)
    query = app.load("provider/box", "x")
    with pytest.raises(rr.UnloadFailed):
        query.unload()

    text = said("why", query.resource_id)

    assert "could not be unloaded: " in text
    assert "the door jams" in text
    assert "last status" not in text
    assert f"rr-actors unload --force {query.resource_id[-8:]}" in text
    said("unload", "--force", query.resource_id)
    assert provider.resources() == []


def test_why_prints_what_its_page_shows(system: rr.System) -> None:
    app, maps, cameras = map(system.open_registrar, ("app", "maps", "cameras"))
    serve(cameras, "camera")
    serve(maps, "map", load=lambda request: maps.load("cameras/camera", f"/dev/{request}").id)
    camera = app.load("maps/map", "kitchen").response
    hall = app.load("maps/map", "hall")
    cameras.send_status(hall.response, rr.Status("ERROR", "no frame for 2 s"))
    hall.wait_status("ERROR")
    page = (REPOSITORY / "docs" / "console.md").read_text()
    _, well, ill, *_ = re.split(
        r"^\$ rr-actors why .+\n|^```\n", page[page.index("$ rr-actors why ") :], flags=re.MULTILINE
    )

    assert _without_ids_and_times(said("why", camera)) == _without_ids_and_times(well).rstrip("\n") + "\n"
    assert _without_ids_and_times(said("why", 'maps/map "hall"')) == _without_ids_and_times(ill)


def _without_ids_and_times(text: str) -> str:
    return re.sub(r"\b[0-9a-f]{8}\b", "ID", re.sub(r"since [\d:]+ \(\d+ s\)", "since TIME", text))


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
    assert 'It has waited for provider/part "x"' in text
    gate.open()
    load.get(timeout=10)


def test_why_of_what_nobody_knows_is_an_error(shop: rr.System) -> None:
    assert "no query and no resource" in refused(2, "why", "0123456789")


def test_an_id_that_many_begin_with_is_refused_with_five_of_them(app: rr.Registrar) -> None:
    queries = [app.load("shop/thing", Order(f"r{number}")) for number in range(8)]
    start = queries[0].id[:4]

    for verb in ("why", "unload"):
        told = refused(2, verb, start)
        assert len(re.findall(r"\b[0-9a-f]{8}\b", told)) == 5, told
        assert "more; give more of the id" in told


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


def test_a_graph_has_all_resources_that_hold_one_also_if_they_are_many(app: rr.Registrar) -> None:
    for number in range(HOLDERS_SHOWN + 5):
        app.load("shop/thing", Order(f"room {number}", ("shop/thing:lamp",)))

    (lamp,) = [row["id"] for row in json.loads(said("resources", "lamp", "--json")) if row["holder_count"] > 1]

    assert said("graph", "--of", "dependencies", "--format", "dot").count(f'-> "{lamp}"') == HOLDERS_SHOWN + 5


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


@pytest.mark.parametrize("name", ["app", "shop"])
def test_what_waits_for_a_server_that_is_gone_is_cleared_by_the_servers_name(
    app: rr.Registrar, shop: rr.System, name: str
) -> None:
    def fail(_request: object, _response: object) -> None:
        raise ValueError("stuck")

    registrar = shop.registrar(name)
    before = len(registrar.resources())
    registrar.register_server("lens", lambda request: request, fail)
    app.load(f"{name}/lens", "x")
    assert "the server is registered" in refused(2, "unload", "--force", f"{name}/lens")
    with pytest.raises(rr.UnloadFailed):
        registrar.unregister_server("lens")

    (waiting,) = [found for found in registrar.resources() if found.server == "lens"]
    assert f"waits for its server '{name}/lens', which is not registered" in said("why", waiting.id)
    assert f"would remove all resources of {name}/lens" in said("unload", "--force", "--dry-run", f"{name}/lens")
    assert len(registrar.resources()) == before + 1
    assert (
        said("unload", "--force", f"{name}/lens") == f"removed all resources of {name}/lens, which is not registered\n"
    )

    assert len(registrar.resources()) == before
    assert "no such server" in refused(2, "unload", "--force", f"{name}/lens")


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


def test_a_child_of_a_dynamic_supervisor_is_added_shown_and_stopped(start: Start, workshop: Workshop) -> None:
    pool = rr.Supervisor([rr.ChildSpec(Shop, id="shop")], id="pool", strategy="simple_one_for_one")
    system = start(rr.Supervisor([pool]))
    args = json.dumps([str(workshop.root)])
    ttys0 = ("start", args, "--under", "pool", "--id", "ttyS0")
    assert "would start the worker root/pool/ttyS0" in said(*ttys0, "--dry-run")
    assert said(*ttys0).strip() == "started the worker root/pool/ttyS0"
    assert "ttyS0" in said("ps")
    assert "is running" in refused(2, *ttys0)
    assert "expected a JSON list" in refused(2, "start", "{}", "--under", "pool", "--id", "ttyS1")
    assert said("terminate", "ttyS0").strip() == "stopped root/pool/ttyS0"
    assert system.supervisor("pool").which_children() == []


def test_a_shutdown_that_waits_returns_when_no_child_runs(shop: rr.System) -> None:
    pid = pid_of(shop, "shop")
    assert "would stop" in said("shutdown", "--wait", "--dry-run")
    assert "is stopping" in said("shutdown", "--wait")

    assert not Path(f"/proc/{pid}").exists()


def test_a_dry_run_says_what_would_be_done_and_changes_nothing(shop: rr.System, app: rr.Registrar) -> None:
    pid = shop.ref("shop").pid

    assert said("kill", "shop", "--dry-run").startswith("would send SIGKILL")
    assert said("load", "shop/thing", '{"name": "a"}', "--dry-run").startswith("would load")
    assert said("shutdown", "--dry-run").startswith("would stop")

    assert shop.ref("shop").pid == pid
    assert shop.registrar("shop").resources() == []


NAMES = [name for modules in VERBS.values() for verbs in modules.values() for name in verbs]


def test_each_command_has_an_example_in_its_help() -> None:
    older = {"version", "inspect", "tree", "check"}
    for name in NAMES:
        assert name in older or (whole(name).epilog or "").startswith(f"Example: rr-actors {name}"), name
    assert "Example: rr-actors kill" in said("kill", "--help")


def test_each_verb_is_in_the_list_of_the_verbs_with_the_first_sentence_of_its_help() -> None:
    for modules in VERBS.values():
        for module, verbs in modules.items():
            for name, says in verbs.items():
                assert (whole(name).help or "").partition("\n\n")[0].partition(". ")[0].rstrip(".") == says
            declared: list[Any] = module().app.registered_commands
            assert {info.name or info.callback.__name__.replace("_", "-") for info in declared} <= {*NAMES}


def test_the_help_has_each_command_once_in_a_group_with_its_whole_first_sentence() -> None:
    shown = said("--help")
    commands = shown.partition("running system:\n")[2]
    assert "…" not in commands
    assert "..." not in commands
    listed = re.findall(r"^  ([a-z-]+)  ", commands, flags=re.MULTILINE)
    assert listed == NAMES
    groups = re.findall(r"^(\w.*):$", shown, flags=re.MULTILINE)
    assert groups[:4] == ["Options", "Look at a running system", "Change its resources", "Run, change and stop it"]


def test_a_shell_completes_what_the_running_system_has(app: rr.Registrar) -> None:
    query = app.load("shop/thing", Order("a"))

    assert completing("kill", "sh") == ["shop"]
    assert completing("kill", "root/") == ["root/shop"]
    assert completing("load", "sh") == ["shop/thing"]
    assert completing("why", query.id[:8]) == [query.id]
    assert completing("why", "sh") == ["shop"]


def test_a_shell_completes_verbs_options_and_their_values() -> None:
    assert completing("p") == ["ps", "plans", "priority", "pause"]
    assert completing("--v") == ["--version"]
    assert completing("resources", "--st") == ["--status", "--state"]
    assert completing("resources", "--status", "OK", "--st") == ["--status", "--state"]  # it may be repeated
    assert completing("graph", "--state", "/nowhere", "--st") == []
    assert completing("ps", "--sort-by", "m") == ["memory"]
    assert completing("nothing", "p") == ["ps", "plans", "priority", "pause"]  # as if it were not there


def completing(*words: str) -> list[str]:
    """What a TAB after these words offers."""
    tab = {"_RR_ACTORS_COMPLETE": "complete_bash", "COMP_WORDS": " ".join(("rr-actors", *words))}
    command = Path(sys.executable).with_name("rr-actors")
    ran = subprocess.run(
        [command], env=os.environ | tab | {"COMP_CWORD": str(len(words))}, capture_output=True, text=True, check=True
    )
    assert ran.stderr == ""
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
        watched = node_of(shop).watched
        eventually(lambda: bool(watched))
        app.load("shop/thing", Order("lamp"))
        line, _ = following.communicate(timeout=30)
    assert "loaded" in line


# -- recording -------------------------------------------------------------------------------------------------------


def test_record_writes_a_file_that_sequence_draws(shop: rr.System, app: rr.Registrar, tmp_path: Path) -> None:
    file = tmp_path / "one.jsonl"
    watched = node_of(shop).watched
    with subprocess.Popen(command("record", file), stdout=subprocess.PIPE, text=True) as recording:
        eventually(lambda: watched.level[0] > 1)
        query = app.load("shop/thing", Order("r2"))
        eventually(lambda: "Loaded" in file.read_text())
        recording.send_signal(signal.SIGINT)
        told, _ = recording.communicate(timeout=20)
    lines = said("sequence", file, query.id[:30]).splitlines()

    assert recording.returncode == 0
    assert told.startswith("recorded ")
    assert told.endswith(f" entries in {file}\n")
    assert lines[0] == "sequenceDiagram"
    assert any("p0->>p1" in line and "Load shop/thing" in line for line in lines)
    assert any("load shop/thing returned" in line for line in lines)
    entries = [json.loads(line) for line in said("trace", file, query.id, "--json").splitlines()]
    assert entries[0]["name"] == "Load"
    assert "no query, resource or message" in refused(2, "sequence", file, "ffffffff")
    assert "Load shop/thing" in said("sequence", file)
    assert "Load shop/thing" in said("sequence", file, "app", "shop")
    assert "'nobody': the recording has no message of an actor" in refused(2, "sequence", file, "nobody")
    picture = said("timeline", file)
    assert picture.startswith("<svg")
    assert "loaded  shop/thing {" in picture
    assert str(tmp_path / "none") in refused(2, "timeline", tmp_path / "none")
    assert "there is a file already" in refused(2, "record", file)


def test_trace_lists_what_a_recording_has_and_takes_the_names_that_it_lists(
    shop: rr.System, app: rr.Registrar, tmp_path: Path
) -> None:
    file = tmp_path / "one.jsonl"
    with shop.record(file):
        for name in ("r1", "r2", "r2"):
            app.load("shop/thing", Order(name)).unload()
        with pytest.raises(rr.UnknownServer):
            app.load("shop/nothing", Order("none"))
    head, *rows = said("trace", file).splitlines()
    name = 'shop/thing {"name":"r2","parts":[]}'
    drawn, lines = said("sequence", file, name), said("trace", file, name)

    assert head.split() == ["time", "id", "by", "took", "what"]
    whats = [row[head.index("what") :] for row in rows]
    assert whats[:3] == [f"load {name.replace('r2', 'r1')}", f"load {name}", f"load {name}"]
    assert whats[3].startswith("load shop/nothing")
    assert "no such server" in whats[3]
    assert [row[head.index("by") :].split()[0] for row in rows] == ["app"] * 4
    assert drawn.count("Load shop/thing") == 2
    assert "r1" not in lines
    assert lines.count("app -> shop: Load") == 2
    assert said("trace", file, "shop/thing").count("app -> shop: Load") == 3
    assert [one["by"] for one in json.loads(said("trace", file, "--json"))] == ["app"] * 4
    assert "did you mean 'shop/thing" in refused(2, "trace", file, name.replace("r2", "r22"))
    missing = tmp_path / "two.jsonl"
    assert str(missing) in refused(2, "trace", missing)


def test_a_line_about_missed_events_says_how_many_rows_the_tree_has(
    start: Start, state_dir: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    page = Children(501, [ChildRow("root", 0, "supervisor", "running")])
    monkeypatch.setattr(ConsoleConnection, "follow", lambda *_: iter([Missed(3, 9, page)]))
    start()
    console_verbs.events(follow=True, state=state_dir, as_json=True)
    said = json.loads(capsys.readouterr().out)
    assert (said["missed"], said["seq"], said["total"], len(said["tree"])) == (3, 9, 501, 1)


def test_sequence_says_how_many_entries_it_was_too_slow_for(
    shop: rr.System, app: rr.Registrar, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console_feed, "KEPT_OF_RECORDING", 100)
    query = app.load("shop/thing", Order("chair"))
    watched, feed = node_of(shop).watched, console_of(shop).feed
    asked = command("sequence", query.id, "--seconds", 4)
    with subprocess.Popen(asked, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as drawing:
        eventually(lambda: watched.level[0] > 1)
        (reader,) = feed.readers
        while not reader.missed:
            app.load_all([("shop/thing", Order("lamp"))] * 100)
        eventually(lambda: not reader.is_behind)
        query.unload()
        diagram, said_of_it = drawing.communicate(timeout=30)

    assert drawing.returncode == 0
    assert "Unload" in diagram
    assert int(said_of_it.removeprefix("the recording lacks ").partition(" entries")[0].replace(",", "")) > 100


def test_record_writes_how_many_entries_it_was_too_slow_for_and_sequence_says_so(
    shop: rr.System, app: rr.Registrar, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console_feed, "KEPT_OF_RECORDING", 100)
    file = tmp_path / "slow.jsonl"
    query = app.load("shop/thing", Order("chair"))
    watched, feed = node_of(shop).watched, console_of(shop).feed
    with subprocess.Popen(command("record", file), stdout=subprocess.PIPE, text=True) as recording:
        eventually(lambda: watched.level[0] > 1)
        (reader,) = feed.readers
        while not reader.missed:
            app.load_all([("shop/thing", Order("lamp"))] * 100)
        eventually(lambda: not reader.is_behind)
        query.unload()
        eventually(lambda: "Unload" in file.read_text())
        recording.send_signal(signal.SIGINT)
        told, _ = recording.communicate(timeout=20)
    read = rr_actors("sequence", file, query.id)

    missed = rr.read_recording(file).missed
    assert missed > 100
    assert told.endswith(f", {missed} missed\n")
    assert read.stderr == f"the recording lacks {missed:,} entries: its reader was too slow\n"


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


def on_a_terminal(columns: int, *arguments: object) -> list[str]:
    """Return the lines that a command prints on a terminal of so many columns, without the bold of the heading."""
    ours, terminal = os.openpty()
    try:
        termios.tcsetwinsize(terminal, (24, columns))
        subprocess.run(command(*arguments), stdin=terminal, stdout=terminal, stderr=subprocess.PIPE, check=True)
        shown = os.read(ours, 65536).decode()
    finally:
        os.close(ours)
        os.close(terminal)
    return shown.replace("\x1b[1m", "").replace("\x1b[0m", "").splitlines()


def test_a_long_request_gives_way_on_a_terminal_and_a_pipe_has_whole_columns(app: rr.Registrar) -> None:
    app.load("shop/thing", Order("x"))
    query = app.load("shop/thing", Order("begin" + "-" * 190 + "end"))

    narrow = on_a_terminal(120, "resources")
    assert all(len(line) <= 120 for line in narrow)
    (line,) = [line for line in narrow if line.endswith(query.resource_id[-8:])]
    assert "begin" in line
    assert 'end"' in line
    assert any("-" * 190 in line for line in on_a_terminal(120, "resources", "--wide"))
    for piped in (said("resources"), said("resources", "--wide")):
        head, *rows = piped.splitlines()
        assert [row[head.index("state") :].split()[0] for row in rows] == ["OK", "OK"]
        assert sum("-" * 190 in row for row in rows) == 1


def test_inspect_shows_each_row_on_one_line_with_its_whole_id(app: rr.Registrar, shop: rr.System) -> None:
    query = app.load("shop/thing", Order("begin" + "-" * 190 + "end"))
    shop.registrar("shop").save_catalog()
    app.save_catalog()

    shown = on_a_terminal(160, "inspect", shop.state_dir)
    held, resource = (line for line in shown if line.startswith((query.id, query.resource_id)))
    assert "begin" in held
    assert held.endswith("  held  OK            0")
    assert "begin" in resource
    assert resource.endswith("  loaded  OK     app")


def test_where_no_resource_matches_the_command_says_so(app: rr.Registrar) -> None:
    ran = rr_actors("resources", "nowhere")
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "", "no resource matches\n")


HOSTILE = "\x1b[2J\x07\x9b1m\u202e\nlast"


def test_nothing_that_users_write_controls_the_terminal(app: rr.Registrar, shop: rr.System, tmp_path: Path) -> None:
    registrar = shop.open_registrar("evil")

    def fail(request: str) -> str:
        if request == "fails":
            raise ValueError(HOSTILE)
        return request

    serve(registrar, "thing", fail)
    query = app.load("evil/thing", HOSTILE)
    ran = [
        rr_actors("resources"),
        rr_actors("resources", "--json"),
        rr_actors("why", query.id),
        rr_actors("graph", "--format", "dot"),
        rr_actors("graph", "--format", "mermaid"),
        rr_actors("load", "evil/thing", json.dumps(HOSTILE)),
        rr_actors("load", "evil/thing", '"fails"'),
        rr_actors("check", tmp_path / HOSTILE),
        rr_actors("start", tmp_path / HOSTILE),
        rr_actors("sequence", tmp_path / HOSTILE, query.id, "--seconds", "0.2"),
        rr_actors("inspect", shop.state_dir),
        rr_actors("tree", shop.state_dir),
    ]
    for one in ran:
        for line in (one.stdout + one.stderr).split("\n"):
            assert line.isprintable(), (one.args, line)
    assert json.loads(ran[5].stdout.splitlines()[-1]) == HOSTILE
    assert [one.returncode for one in ran] == [0, 0, 0, 0, 0, 0, 4, 2, 2, 2, 0, 0]


def test_record_ends_after_its_seconds_and_with_the_system(shop: rr.System, tmp_path: Path) -> None:
    assert "recorded" in said("record", tmp_path / "one", "--seconds", "0.2")
    watched = node_of(shop).watched
    eventually(lambda: watched.level[0] <= 1)
    with subprocess.Popen(command("record", tmp_path / "two"), stdout=subprocess.PIPE, text=True) as recording:
        eventually(lambda: watched.level[0] > 1)
        shop.stop()
        told, _ = recording.communicate(timeout=20)

    assert recording.returncode == 0
    assert "recorded" in told


def test_sequence_without_a_file_draws_what_happens_now(shop: rr.System, app: rr.Registrar) -> None:
    watched = node_of(shop).watched
    query = app.load("shop/thing", Order("r2"))
    with subprocess.Popen(
        command("sequence", query.id, "--seconds", "3"), stdout=subprocess.PIPE, text=True
    ) as drawing:
        eventually(lambda: watched.level[0] > 1)
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


# -- what was before -------------------------------------------------------------------------------------------------


def test_events_show_what_happened_to_resources_before_they_were_asked_for(app: rr.Registrar, shop: rr.System) -> None:
    query = app.load("shop/thing", Order("lamp"))
    shop.registrar("shop").send_status(query, rr.Status("ERROR", "no frame"))
    query.wait_status("ERROR")

    (line,) = said("events", "--event", "status").splitlines()
    assert "lamp" in line
    assert "ERROR no frame" in line
    assert "heard by app" in line
    assert said("events", "--server", "shop/thing") == said("events", "--server", "shop") == f"{line}\n"
    (event,) = map(json.loads, said("events", "--event", "status", "--json").splitlines())
    assert (event["resource_id"], event["detail"]) == (query.resource_id, "ERROR no frame")
    assert "status" not in said("history")


def test_why_says_since_when_a_resource_is_as_it_is_and_what_came_before(app: rr.Registrar, shop: rr.System) -> None:
    query = app.load("shop/thing", Order("lamp"))
    registrar = shop.registrar("shop")
    assert "It has been" not in said("why", query.resource_id)
    registrar.send_status(query, rr.Status("WARNING", "dusty"))
    old = kill(shop, "shop")
    wait_respawned(shop, "shop", old)
    for state, message in (("ERROR", "no frame"), ("ERROR", "no light")):
        eventually(lambda: registrar.stats())
        registrar.send_status(query, rr.Status(state, message))
    query.wait_status("ERROR")

    lines = said("why", query.resource_id).splitlines()

    at = next(i for i, line in enumerate(lines) if line.startswith("It has been ERROR since "))
    assert lines[at + 1] == "Before that:"
    before = lines[at + 2 : at + 6]
    assert [line.split()[1] for line in before] == ["started", "status", "exited", "restarted"]
    assert "WARNING dusty" in before[1]
    assert "SIGKILL" in before[2]
    assert "no frame" not in "".join(before)


def test_why_says_since_when_a_child_runs_and_how_it_ended_before(shop: rr.System) -> None:
    old = kill(shop, "shop")
    wait_respawned(shop, "shop", old)

    lines = said("why", "shop").splitlines()

    at = next(i for i, line in enumerate(lines) if line.startswith("root/shop has been running since "))
    assert lines[at + 1] == "Before that:"
    assert [line.split()[1] for line in lines[at + 2 :]] == ["started", "exited"]
    assert "SIGKILL" in lines[-1]
