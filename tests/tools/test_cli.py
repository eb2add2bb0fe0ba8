"""The command line: what it shows of a state directory, what it finds wrong, and how it says what went wrong itself."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import msgspec
import pytest

from rr_actors.registrar.model.rows import Held, Hold, Notice, Peer, Phase, Put, Resource, Row, ServedQuery, State
from rr_actors.storage.opening import open_store
from rr_actors.tools.cli_commands import say_json
from rr_actors.tools.inspection import check, read_state
from support_cli import run_cli

REQUEST = msgspec.msgpack.encode({"device": "/dev/video0"})
RESPONSE = msgspec.msgpack.encode({"topic": "/images"})


def resource(id: str, *, phase: Phase = Phase.LOADED, request: bytes = REQUEST) -> Resource:
    return Resource(id, "camera", request, RESPONSE, phase, State.OK, "", 1)


def query(id: str, resource_id: str, origin: str = "app") -> ServedQuery:
    return ServedQuery(id, resource_id, origin, "", 1, 1)


def held(id: str, resource_id: str, *, parent: str = "", hold: Hold = Hold.HELD) -> Held:
    return Held(id, "cameras", "camera", REQUEST, RESPONSE, resource_id, parent, 1, 1, hold, State.OK)


def notice(id: str, query_id: str, *, released: bool) -> Notice:
    return Notice(id, query_id, "app", "r1", "e1", State.FATAL, "gone", "r1", released)


def write(state_dir: Path, registrar: str, *rows: Row) -> None:
    store = open_store(state_dir / registrar / "catalog.sqlite3", durability="process", on_damage="refuse")
    store.load()
    store.commit([Put(row) for row in rows])
    store.close()


@pytest.fixture
def state(tmp_path: Path) -> Path:
    """A state directory whose two catalogs agree: app holds one camera."""
    write(tmp_path, "cameras", resource("r1"), query("q1", "r1"))
    write(tmp_path, "app", held("q1", "r1"), Peer("cameras"))
    return tmp_path


def run(*arguments: object, env: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    return run_cli(*arguments, **{"COLUMNS": "200"} | (env or {}))


def assert_one_line_error(ran: subprocess.CompletedProcess[str], *words: str) -> None:
    assert ran.returncode == 2, ran.stdout + ran.stderr
    assert len(ran.stderr.splitlines()) == 1, ran.stderr
    assert "Traceback" not in ran.stdout + ran.stderr
    for word in words:
        assert word in ran.stderr


def test_version_is_that_of_the_package() -> None:
    assert run("version").stdout.strip() == metadata.version("rr-actors")
    assert run("--version").stdout == run("version").stdout
    assert "--version" in run("--help").stdout


def test_inspect_shows_resources_and_who_holds_them(state: Path) -> None:
    shown = run("inspect", state)

    assert shown.returncode == 0, shown.stderr
    for word in ("cameras", "r1", "camera", "/dev/video0", "/images", "loaded", "OK", "app", "q1", "held"):
        assert word in shown.stdout


def test_inspect_as_json_is_for_programs(state: Path) -> None:
    shown = json.loads(run("inspect", state, "--json").stdout)

    query = {"id": "q1", "origin": "app", "parent": "", "priority": 0}
    assert shown["cameras"]["resources"][0]["queries"] == [query]
    assert (shown["app"]["held"][0]["registrar"], shown["app"]["held"][0]["priority"]) == ("cameras", 0)


def test_json_has_null_for_a_number_that_json_has_not(capsys: pytest.CaptureFixture[str]) -> None:
    say_json({"row": [float("nan"), float("inf"), 1.5, "NaN ä"]})
    assert capsys.readouterr().out == '{"row": [null, null, 1.5, "NaN ä"]}\n'


def test_tree_shows_dependencies_below_what_depends_on_them(state: Path) -> None:
    write(state, "maps", resource("r2"), query("q2", "r2", "app"), held("q3", "r1", parent="r2"), Peer("cameras"))
    write(state, "cameras", query("q3", "r1", "maps"))
    map_ = Held("q2", "maps", "map", REQUEST, RESPONSE, "r2", "", 1, 2, Hold.HELD, State.OK)
    write(state, "app", map_, Peer("maps"))

    lines = run("tree", state).stdout.splitlines()

    depth = {word: line.index(word) for line in lines for word in ("maps/map", "cameras/camera") if word in line}
    assert depth["cameras/camera"] > depth["maps/map"]


def test_tree_draws_one_line_for_each_query_with_its_request_as_it_is(tmp_path: Path) -> None:
    asked = msgspec.msgpack.encode("[bold]:smile:\x1b[2J")
    two = Held("q1", "maps", "map", asked, None, "r1", "", 1, 1, Hold.HELD, State.OK)
    ring = Held("q3", "maps", "map", REQUEST, None, "r1", "r1", 1, 3, Hold.HELD, State.OK)
    write(tmp_path, "app", two, held("q2", "r2", hold=Hold.OWED))
    write(tmp_path, "maps", query("q1", "r1"), query("q3", "r1", "maps"), ring)

    assert run("tree", tmp_path).stdout.splitlines() == [
        "app",
        r"├── maps/map  '[bold]:smile:\x1b[2J'  held OK",
        "│   └── maps/map  {'device': '/dev/video0'}  held OK",
        "│       └── maps/map  {'device': '/dev/video0'}  held OK",
        "└── cameras/camera  {'device': '/dev/video0'}  owed OK",
    ]


def test_tree_draws_its_lines_of_what_the_output_can_show(state: Path) -> None:
    environment = os.environ | {"PYTHONIOENCODING": "latin-1"}
    command = [sys.executable, "-m", "rr_actors", "tree", str(state)]
    ran = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert ran.stdout.splitlines() == ["app", "`-- cameras/camera  {'device': '/dev/video0'}  held OK"], ran.stderr


def test_a_catalog_is_read_while_it_is_open(state: Path) -> None:
    store = open_store(state / "cameras" / "catalog.sqlite3", durability="process", on_damage="refuse")
    store.load()
    store.commit([Put(resource("r7", request=b"\x01"))])
    try:
        assert "r7" in run("inspect", state).stdout
    finally:
        store.close()


def test_reading_leaves_no_file_behind(state: Path) -> None:
    before = sorted(path for path in state.rglob("*"))

    assert run("inspect", state).returncode == 0
    assert run("check", state).returncode == 0

    assert sorted(path for path in state.rglob("*")) == before


def test_check_is_content_when_catalogs_agree(state: Path) -> None:
    checked = run("check", state)

    assert (checked.returncode, checked.stdout) == (0, "2 catalogs, 1 query: no contradiction\n")


def test_check_prints_each_violation_and_fails(state: Path) -> None:
    write(state, "app", held("q9", "r1"))

    checked = run("check", state)

    assert checked.returncode == 1
    assert checked.stdout == "app: held query q9 is unknown to its provider cameras/camera\n"


def test_check_finds_a_query_on_a_resource_that_does_not_exist(state: Path) -> None:
    write(state, "cameras", query("q2", "nowhere"))
    write(state, "app", held("q2", "nowhere"))

    assert check(read_state(state)) == ["cameras: query q2 of app points to resource nowhere, which does not exist"]


def test_check_finds_a_query_that_its_origin_can_never_hear_of(state: Path) -> None:
    write(state, "other")
    write(state, "cameras", query("q2", "r1", "other"))

    assert check(read_state(state)) == [
        "cameras: query q2 of other is unknown there, and other does not know that it asked cameras"
    ]


def test_check_finds_a_part_of_a_resource_that_does_not_exist(state: Path) -> None:
    write(state, "cameras", query("q2", "r1"))
    write(state, "app", held("q2", "r1", parent="nowhere"))

    assert check(read_state(state)) == ["app: held query q2 belongs to resource nowhere, which does not exist"]


@pytest.mark.parametrize("phase", [Phase.LOADED, Phase.PAUSED])
def test_check_finds_one_request_loaded_twice(state: Path, phase: Phase) -> None:
    write(state, "cameras", resource("r2", phase=phase))

    (violation,) = check(read_state(state))

    assert "is loaded for the same request as" in violation


def test_check_finds_a_notice_about_nothing(state: Path) -> None:
    write(state, "cameras", notice("n1", "q9", released=False))

    assert check(read_state(state)) == ["cameras: notice n1 is about query q9, which does not exist"]


def test_check_bears_with_what_the_next_start_settles(state: Path) -> None:
    write(state, "cameras", query("q2", "r1"), notice("n1", "q4", released=True))
    write(state, "app", held("q3", "", hold=Hold.PENDING), held("q4", "r1"), held("q5", "r1", hold=Hold.OWED))

    assert check(read_state(state)) == []


def test_a_damaged_catalog_is_named_and_the_others_are_shown(state: Path) -> None:
    (state / "app" / "catalog.sqlite3").write_bytes(b"not a catalog" * 500)

    checked, shown = run("check", state), run("inspect", state)

    assert checked.returncode == 1
    assert "app/catalog.sqlite3" in checked.stdout
    assert "r1" in shown.stdout


def test_a_directory_that_is_not_there_is_an_error_of_one_line(tmp_path: Path) -> None:
    assert_one_line_error(run("inspect", tmp_path / "nowhere"), "nowhere", "expected a state directory", "nothing of")


def test_a_file_in_place_of_a_directory_is_an_error_of_one_line(tmp_path: Path) -> None:
    (tmp_path / "notes").write_text("no state\n")

    assert_one_line_error(run("check", tmp_path / "notes"), "notes", "expected a state directory", "got a file")


def test_a_tree_of_nothing_is_told_in_words(tmp_path: Path) -> None:
    write(tmp_path, "app", Peer("cameras"))

    shown = run("tree", tmp_path)

    assert (shown.returncode, shown.stdout) == (0, "nobody holds anything\n")

    write(tmp_path, "cameras", resource("r1"), query("q1", "r1"))  # whose consumer's row was not written before a crash

    assert "nobody" not in run("tree", tmp_path).stdout


@pytest.mark.parametrize("before", [(), ("check",), ("sequence",)], ids=" ".join)
def test_h_is_short_for_help(before: tuple[str, ...]) -> None:
    short, long = run(*before, "-h"), run(*before, "--help")
    assert (short.returncode, short.stdout) == (0, long.stdout)
    assert "Usage: rr-actors" in short.stdout


def test_a_directory_without_catalogs_is_an_error_of_one_line(tmp_path: Path) -> None:
    assert_one_line_error(run("check", tmp_path), str(tmp_path), "state_dir")


@pytest.mark.parametrize("library", ["typer", "rich"])
def test_a_missing_extra_is_an_error_of_one_line_that_says_what_to_install(tmp_path: Path, library: str) -> None:
    (tmp_path / f"{library}.py").write_text(f"raise ModuleNotFoundError('not installed', name={library!r})")

    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    ran = subprocess.run([sys.executable, "-m", "rr_actors", "tree"], capture_output=True, text=True, env=environment)
    assert_one_line_error(ran, "pip install '.[cli]'")


def test_an_unknown_command_is_refused() -> None:
    ran = run("dance")

    assert ran.returncode == 2
    assert "dance" in ran.stderr


@pytest.mark.parametrize("command", ["tree", "inspect"])
def test_a_damaged_catalog_is_named_and_the_exit_code_says_so(tmp_path: Path, command: str) -> None:
    catalog = tmp_path / "app" / "catalog.sqlite3"
    catalog.parent.mkdir()
    catalog.write_bytes(b"garbage")
    done = run(command, tmp_path)
    assert done.returncode == 1
    assert "app: cannot be read" in done.stderr
    assert "Traceback" not in done.stderr
