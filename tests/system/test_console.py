"""The console of a running system: what another process of the user sees of it, hears from it, and does with it."""

from __future__ import annotations

import json
import os
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.base.errors import ConfigError, NotFound, NotRunning, RrError, Unavailable, UnknownQuery, UsageError
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.pages import ResourceRow, RowPage, Wanted
from rr_actors.system.console import console_feed, console_view
from rr_actors.system.console.console_commands import (
    Kill,
    Load,
    Restart,
    SendStatus,
    ShutDown,
    StartChild,
    Terminate,
    Unload,
)
from rr_actors.system.console.console_connection import ConsoleConnection, find_console
from rr_actors.system.console.console_messages import Entries, Events, Follow, Letters, Missed, Resources
from rr_actors.system.console.console_questions import Find, ListDeadLetters, ListHistory, ListResources
from rr_actors.system.console.running_systems import running_systems
from support import Calls, Gate, Served, Workshop, eventually, hang, lives, pid_of, serve, wait_gone
from support_asks import Background
from support_inside import console_of, node_of
from support_managers import Order, Shop

pytestmark = pytest.mark.usefixtures("runtime_dir")

Start = Callable[..., rr.System]


@pytest.fixture
def shop(start: Start, workshop: Workshop) -> rr.System:
    """A system with a manager, `shop`, in a process of its own, below a supervisor `inner`."""
    child = rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),))
    return start(rr.Supervisor([child], id="inner"))


@pytest.fixture
def console(request: pytest.FixtureRequest, state_dir: Path) -> Iterator[ConsoleConnection]:
    """A connection of the system that the test has started before: ask for `shop` or `system` first."""
    with ConsoleConnection(find_console(state_dir)) as connection:
        yield connection


@pytest.fixture
def follow(state_dir: Path) -> Iterator[Callable[[Follow], Calls]]:
    """Follow the events: what comes is in the Calls that is returned."""
    connections: list[ConsoleConnection] = []
    threads: list[threading.Thread] = []

    def begin(wanted: Follow) -> Calls:
        heard, connection = Calls(), ConsoleConnection(find_console(state_dir))
        feed = connection.follow(wanted)
        connections.append(connection)

        def read() -> None:
            for part in feed:
                for event in part.events if isinstance(part, Events) else [part]:
                    heard(event)

        threads.append(thread := threading.Thread(target=read))
        thread.start()
        return heard

    yield begin
    for connection in connections:
        connection.close()
    for thread in threads:
        thread.join(5.0)


# -- where it is -----------------------------------------------------------------------------------------------------


def test_the_socket_is_private_and_gone_when_the_system_is(start: Start, state_dir: Path, runtime_dir: Path) -> None:
    system = start()
    (run_dir,) = (state_dir / "run").iterdir()
    found = (run_dir / "console.sock").stat()

    assert stat.S_IMODE(found.st_mode) == 0o600
    assert stat.S_IMODE(run_dir.stat().st_mode) == 0o700
    assert stat.S_IMODE((runtime_dir / "rr_actors").stat().st_mode) == 0o700
    system.stop()

    assert not run_dir.exists()
    assert os.listdir(runtime_dir / "rr_actors") == []


def test_without_the_console_there_is_no_socket_and_no_entry(start: Start, state_dir: Path, runtime_dir: Path) -> None:
    start(config=rr.SystemConfig(console=False))
    (run_dir,) = (state_dir / "run").iterdir()

    assert not (run_dir / "console.sock").exists()
    assert os.listdir(runtime_dir) == []
    with pytest.raises(Unavailable, match="no system with a console"):
        find_console(state_dir)


def test_the_one_running_system_is_found_without_its_directory(system: rr.System, state_dir: Path) -> None:
    with ConsoleConnection(find_console()) as connection:
        assert connection.welcome.pid == os.getpid()
        assert connection.welcome.state_dir == str(state_dir)


def test_of_several_running_systems_each_is_named(start: Start, tmp_path: Path) -> None:
    start(state_dir=tmp_path / "one")
    start(state_dir=tmp_path / "two")

    with pytest.raises(UsageError, match=r"several systems run: .*one, .*two; choose one with --state"):
        find_console()
    with ConsoleConnection(find_console(tmp_path / "two")) as connection:
        assert connection.welcome.state_dir.endswith("two")


def test_what_a_killed_system_left_in_the_list_is_not_found_and_the_next_one_removes_it(
    start: Start, runtime_dir: Path, tmp_path: Path
) -> None:
    (runtime_dir / "rr_actors").mkdir(mode=0o700)
    left = runtime_dir / "rr_actors" / "999999999-0123abcd"
    left.symlink_to(tmp_path / "gone")

    assert running_systems() == []
    with pytest.raises(Unavailable, match="no running system"):
        find_console()
    start()

    assert not left.is_symlink()
    assert len(running_systems()) == 1


_START_AND_STOP = """
import sys
import rr_actors as rr
with rr.System([], state_dir=sys.argv[1]):
    pass
"""


@pytest.mark.parametrize("sees_its_files", [True, False])
def test_a_system_in_another_pid_namespace_leaves_the_entries_of_living_ones(
    start: Start, runtime_dir: Path, tmp_path: Path, sees_its_files: bool
) -> None:
    apart = ["unshare", "--pid", "--fork", "--mount-proc", "--kill-child"]
    if shutil.which("unshare") is None or subprocess.run([*apart, "true"], capture_output=True).returncode:
        pytest.skip("this user may make no PID namespace")
    start()
    (entry,) = [path for path in (runtime_dir / "rr_actors").iterdir() if path.is_symlink()]
    where = entry.readlink()
    if not sees_its_files:  # as in a container that shares the list alone
        entry.unlink()
        entry.symlink_to(tmp_path / "of another container")

    other = [sys.executable, "-c", _START_AND_STOP]
    subprocess.run([*apart, *other, str(tmp_path / "other")], check=True, timeout=60)

    assert entry.is_symlink()
    if sees_its_files:
        assert running_systems() == [where]


def test_a_list_of_another_kind_is_not_used_and_the_system_runs(
    start: Start, runtime_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (runtime_dir / "rr_actors").symlink_to(elsewhere)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    start()

    assert os.listdir(elsewhere) == []
    assert len(running_systems()) == 1


def test_a_socket_that_was_removed_is_made_again(system: rr.System, state_dir: Path) -> None:
    (run_dir,) = (state_dir / "run").iterdir()
    (run_dir / "console.sock").unlink()
    node = node_of(system)

    node.dispatcher.run(node.keeper.look())

    connection: Any = eventually(lambda: _connection_or_none(state_dir))
    connection.close()


def _connection_or_none(state_dir: Path) -> ConsoleConnection | None:
    try:
        return ConsoleConnection(find_console(state_dir))
    except Unavailable:
        return None


# -- looking ---------------------------------------------------------------------------------------------------------


def test_the_tree_has_each_child_with_its_process_state_and_uptime(shop: rr.System, console: ConsoleConnection) -> None:
    rows = {row.path: row for row in console.children().rows}
    pid = shop.supervisor("inner").which_child("shop").pid if "root" in rows else shop.ref("shop").pid

    assert list(rows) == ["inner", "inner/shop"]
    assert rows["inner/shop"].pid == pid
    assert rows["inner/shop"].state == "running"
    assert rows["inner/shop"].depth == 1
    assert 0 < (rows["inner/shop"].up_s or 0) < 60
    assert rows["inner"].strategy == "one_for_one, 3 in 5 s"


def test_a_supervisor_that_is_stopped_is_shown_as_such(start: Start, state_dir: Path) -> None:
    system = start(rr.Supervisor([], id="inner"), rr.Supervisor([], id="other"))
    system.supervisor().terminate_child("inner")

    with ConsoleConnection(find_console(state_dir)) as connection:
        rows = {row.path: row.state for row in connection.children().rows}

    assert rows == {"root": "running", "root/inner": "stopped", "root/other": "running"}


def test_registrars_are_listed_with_their_servers_and_counts(shop: rr.System, console: ConsoleConnection) -> None:
    app = shop.open_registrar("app")
    app.load("shop/thing", Order("a"))

    rows = {row.name: row for row in console.registrars().rows}

    assert rows["shop"].servers == ["shop/thing"]
    assert rows["shop"].counts["resources"] == 1
    assert rows["app"].counts["queries"] == 1


def test_a_page_has_the_rows_that_are_visible_and_how_many_there_are(
    system: rr.System, app: rr.Registrar, served: Served, console: ConsoleConnection
) -> None:
    app.load_all([("provider/thing", f"item {number:03}") for number in range(700)])

    page = console.ask(ListResources(registrar="provider", offset=10, limit=3))
    one = console.ask(ListResources(match="item 123"))

    assert (page.total, len(page.rows)) == (701, 3)
    assert [row.request for row in one.rows] == ['"item 123"']
    assert len(console.resources().rows) == 701  # by two pages
    assert len(console.queries("app", "item 12").rows) == 10


def test_a_page_over_several_registrars_has_their_rows_in_order_wherever_it_begins_and_ends(
    system: rr.System, app: rr.Registrar, console: ConsoleConnection
) -> None:
    for name, count in (("a", 3), ("b", 0), ("c", 4)):
        serve(system.open_registrar(name), "thing")
        app.load_all([(f"{name}/thing", number) for number in range(count)])
    names = [(row.server, row.request) for row in console.resources().rows]
    assert names == [("a/thing", str(n)) for n in range(3)] + [("c/thing", str(n)) for n in range(4)]

    for offset in range(9):
        for limit in range(1, 9):
            page = console.ask(ListResources(offset=offset, limit=limit))
            found = [(row.server, row.request) for row in page.rows]
            assert (page.total, found) == (7, names[offset : offset + limit]), (offset, limit)


def test_a_sorted_page_over_several_registrars_has_the_most_first_wherever_it_begins_and_ends(
    system: rr.System, app: rr.Registrar, console: ConsoleConnection
) -> None:
    other, expected = system.open_registrar("other"), list[tuple[str, str, int, int]]()
    for name, count in (("a", 3), ("b", 2), ("c", 4)):
        registrar = system.open_registrar(name)
        serve(registrar, "thing")
        for number in range(count):
            query = app.load(f"{name}/thing", number, priority=number % 3)
            state = ("OK", "WARNING", "ERROR")[number % 3]
            registrar.send_status(query, rr.Status(state))
            if number % 2:
                other.load(f"{name}/thing", number, priority=-5)
            expected.append((f"{name}/thing", str(number), number % 3, 1 + number % 2))

    def rows(sort: str, offset: int = 0, limit: int = 500) -> list[tuple[str, str]]:
        page = console.ask(ListResources(offset=offset, limit=limit, sort=sort))
        assert page.total == 9
        return [(row.server, row.request) for row in page.rows]

    orders = {
        "state": sorted(expected, key=lambda row: -row[2]),
        "priority": sorted(expected, key=lambda row: -row[2]),
        "holders": sorted(expected, key=lambda row: -row[3]),
        "resource": expected,
    }
    for sort, ordered in orders.items():
        names = [row[:2] for row in ordered]
        assert rows(sort) == names, sort
        for offset in range(10):
            for limit in (1, 3, 8):
                assert rows(sort, offset, limit) == names[offset : offset + limit], (sort, offset, limit)
    with pytest.raises(rr.UsageError, match="expected one of resource, state, priority, holders, got 'age'"):
        rows("age")


def test_resources_are_chosen_by_state_and_holder_where_they_are(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, console: ConsoleConnection
) -> None:
    serve(provider, "thing")
    dirty, clean = (app.load("provider/thing", name) for name in ("dirty", "clean"))
    system.open_registrar("other").load("provider/thing", "clean")
    provider.send_status(dirty, rr.Status("WARNING", "dust"))

    def chosen(**wanted: Any) -> tuple[int, list[str]]:
        page = console.ask(ListResources(limit=1, **wanted))
        return page.total, [row.id for row in page.rows]

    assert chosen(states=("warning",)) == (1, [dirty.resource_id])
    assert chosen(states=("WARNING", "ok"))[0] == 2
    assert chosen(holder="other") == (1, [clean.resource_id])
    assert chosen(holder="other", states=("warning",)) == (0, [])


@pytest.mark.slow
def test_a_list_waits_once_for_all_managers_that_do_not_answer(
    start: Start, workshop: Workshop, state_dir: Path
) -> None:
    names = [f"shop{number}" for number in range(5)]
    system = start(*(rr.ChildSpec(Shop, id=name, args=(str(workshop.root),)) for name in names))
    system.open_registrar("app").load("shop0/thing", Order("a"))
    pids = [pid_of(system, name) for name in names[1:]]
    with ConsoleConnection(find_console(state_dir)) as console:
        for pid in pids:
            hang(pid)
        begun = time.monotonic()
        registrars = {row.name: row for row in console.registrars().rows}
        between = time.monotonic()
        resources = console.resources()
        ended = time.monotonic()
        for pid in pids:
            os.kill(pid, signal.SIGCONT)
    assert registrars["shop0"].counts["resources"] == 1
    assert all("within 5 s" in registrars[name].error for name in names[1:])
    assert [row.server for row in resources.rows] == ["shop0/thing"]
    assert len(resources.notes) == 4
    assert max(between - begun, ended - between) < 10.0  # each of the four would wait for 5 s after the one before


def test_a_search_finds_what_a_request_says_and_not_the_bytes_around_it(
    app: rr.Registrar, provider: rr.Registrar, console: ConsoleConnection
) -> None:
    serve(provider, "shelf")
    letters = {"room": "A"}, 'an "A"', "x" * 500 + "A"
    numbers = 65, [65.0, 0x4142434445464748], "x" * 65, b"A"
    app.load_all([("provider/shelf", request) for request in (*letters, *numbers)])

    def found(match: str) -> int:
        assert console.queries("app", match).total == console.ask(ListResources(match=match)).total
        return console.ask(ListResources(match=match)).total

    assert found("A") == len(letters)
    assert found('"room":"A"') == found('an "A"') == found('an \\"A\\"') == found("xA") == 1
    assert found("65.0") == found(str(0x4142434445464748)) == 1  # an id may have any two digits


def test_a_resource_is_found_by_its_id_or_the_beginning_of_it_with_its_holders_and_parts(
    shop: rr.System, console: ConsoleConnection
) -> None:
    app = shop.open_registrar("app")
    query = app.load("shop/thing", Order("whole", ("shop/thing:part",)))

    found = console.ask(Find(query.id))
    again = console.ask(Find(query.id[:-2]))

    (resource,), (held,) = found.resources, found.queries
    assert again == found
    assert [holder.origin for holder in resource.holders] == ["app"]
    assert (held.id, held.hold, held.parent) == (query.id, "held", "")
    (part,) = console.ask(Find(resource.parts[0])).queries
    assert part.parent == resource.id
    assert json.loads(part.request)["name"] == "part"


def test_resources_are_listed_also_if_their_statuses_are_together_too_long_for_an_answer(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, console: ConsoleConnection
) -> None:
    serve(provider, "thing")
    long = "\N{BELL}" * 9_000
    for query in app.load_all([("provider/thing", number) for number in range(130)]):
        provider.send_status(query, rr.Status("WARNING", long))

    rows = console.resources("provider").rows
    assert len({row.id for row in rows}) == 130
    assert {row.message for row in rows} == {long}


def test_resources_have_room_in_an_answer_beside_the_notes_on_registrars_that_do_not_answer(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, console: ConsoleConnection,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    serve(provider, "thing")
    long, longer = "\N{BELL}" * 9_000, "\N{BELL}" * 9_900
    for query in app.load_all([("provider/thing", number) for number in range(130)]):
        provider.send_status(query, rr.Status("WARNING", long))
    page = console_view.page

    def answered(registrar: rr.Registrar, wanted: Wanted) -> RowPage:
        if registrar.name == "app":
            raise Unavailable(longer)
        return page(registrar, wanted)

    monkeypatch.setattr(console_view, "page", answered)
    found = console.resources()
    assert len({row.id for row in found.rows}) == 130
    assert found.notes == [f"Unavailable: {longer}"]


def test_the_history_of_a_child_tells_of_its_exits(shop: rr.System, console: ConsoleConnection) -> None:
    assert shop.ref("shop").kill()

    def restarted() -> bool:
        records = console.ask(ListHistory("shop")).events
        return [record.event for record in records] == ["started", "exited", "restarted"]

    eventually(restarted)


def test_a_child_that_runs_and_of_which_no_event_is_kept_has_an_empty_history(
    start: Start, state_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console_view, "_HISTORY", 1)
    start(rr.Supervisor([rr.ChildSpec(rr.Actor, id=id, placement="thread") for id in ("older", "newer")], id="root"))

    with ConsoleConnection(find_console(state_dir)) as connection:
        assert [event.path for event in connection.ask(ListHistory("root")).events] == ["root/newer"]
        assert connection.ask(ListHistory("older")).events == []
        with pytest.raises(NotFound, match="'nobody': there is no child of this path or id"):
            connection.ask(ListHistory("nobody"))


def test_dead_letters_are_counted_and_shown(system: rr.System, console: ConsoleConnection) -> None:
    ref = rr.Actor.start()
    ref.stop()
    with pytest.raises(rr.ActorDeadError):
        ref.tell("too late")

    letters: Any = eventually(lambda: _letters(console))
    assert "too late" in letters.letters[-1].message


def _letters(console: ConsoleConnection) -> Letters | None:
    letters = console.ask(ListDeadLetters())
    return letters if letters.count else None


# -- driving ---------------------------------------------------------------------------------------------------------


def test_what_is_loaded_is_let_go_again_unless_it_is_kept(
    system: rr.System, provider: rr.Registrar, console: ConsoleConnection
) -> None:
    served = serve(provider, "thing")

    tried = console.ask(Load("provider/thing", '"x"'))
    assert tried.facts["response"] == {"of": "x", "number": 1}
    assert served.unloads.items == [("x", {"of": "x", "number": 1})]

    kept = console.ask(Load("provider/thing", '"y"', keep=True))
    assert kept.facts["holder"] == "console"
    assert [info.holders for info in provider.resources()] == [("console",)]

    assert "released query" in console.ask(Unload(kept.facts["query_id"])).text
    assert provider.resources() == []


def test_of_a_response_that_is_too_long_for_an_answer_the_beginning_is_shown_and_the_load_is_no_failure(
    system: rr.System, provider: rr.Registrar, console: ConsoleConnection
) -> None:
    serve(provider, "map", load=lambda request: "x" * 5_000_000)

    kept = console.ask(Load("provider/map", "1", keep=True))

    assert kept.facts["response"].startswith("'xxx")
    assert "released" in console.ask(Unload(kept.facts["query_id"])).text


def test_what_is_loaded_in_a_registrars_name_is_held_by_it(shop: rr.System, console: ConsoleConnection) -> None:
    app = shop.open_registrar("app")

    console.ask(Load("shop/thing", '{"name": "a"}', holder="app", keep=True))
    console.ask(Load("shop/thing", '{"name": "b"}', holder="shop", keep=True))

    assert [query.server_id for query in app.queries()] == ["shop/thing"]
    assert [query.request.name for query in shop.registrar("shop").queries()] == ["b"]


def test_a_console_that_leaves_while_it_loads_holds_nothing(
    system: rr.System, provider: rr.Registrar, state_dir: Path, gate: Gate
) -> None:
    served = serve(provider, "slow", load=lambda request: gate(request))
    connection = ConsoleConnection(find_console(state_dir))
    loading = Background(lambda: connection.ask(Load("provider/slow", "1", keep=True)))
    gate.wait_arrived()
    connection.close()
    with pytest.raises(NotRunning):
        loading.result()
    console = console_of(system)
    eventually(lambda: not console.sockets)

    gate.open()

    served.unloads.wait()
    assert system.registrar("console").queries() == []


def test_the_first_loads_of_two_consoles_at_once_both_succeed(
    system: rr.System, provider: rr.Registrar, state_dir: Path
) -> None:
    serve(provider, "thing")
    done = Calls()

    def load(number: int) -> None:
        with ConsoleConnection(find_console(state_dir)) as connection:
            done(connection.ask(Load("provider/thing", str(number), keep=True)))

    threads = [threading.Thread(target=load, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    assert len(done) == 8
    assert len(system.registrar("console").queries()) == 8


@pytest.mark.parametrize(
    ("server", "request_", "error", "words"),
    [
        ("shop/thing", "front", UsageError, "expected JSON"),
        ("shop/thing", '{"nam": 1}', rr.InvalidRequest, "name"),
        ("shop/nothing", "1", rr.UnknownServer, "it has thing"),
        ("nowhere/thing", "1", rr.UnknownRegistrar, "nowhere"),
        ("thing", "1", rr.InvalidName, "registrar/server"),
    ],
)
def test_a_load_that_cannot_be_says_why(
    shop: rr.System, console: ConsoleConnection, server: str, request_: str, error: type[RrError], words: str
) -> None:
    with pytest.raises(error, match=words):
        console.ask(Load(server, request_))
    assert console.children().rows  # and the connection goes on


def test_a_resource_is_only_taken_away_by_force(
    system: rr.System, app: rr.Registrar, served: Served, provider: rr.Registrar, console: ConsoleConnection
) -> None:
    (info,) = provider.resources()
    other = app.load("provider/thing", "x")
    app.unload(app.queries()[0])

    with pytest.raises(UnknownQuery, match=rf"it is a resource, and its queries are: {other.id[-8:]} of app.*--force"):
        console.ask(Unload(info.id))
    console.ask(Unload(info.id, force=True))

    assert provider.resources() == []


def test_a_status_reaches_the_holders(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, console: ConsoleConnection
) -> None:
    serve(provider, "thing")
    heard = Calls()
    query = app.load("provider/thing", "x", on_status=heard)

    done = console.ask(SendStatus(query.resource_id, "WARNING", "it is hot"))

    assert "told 1 holder" in done.text
    (status,) = heard.wait()
    assert (status.state, status.message) == (rr.State.WARNING, "it is hot")


def test_a_child_is_killed_and_comes_back(shop: rr.System, console: ConsoleConnection) -> None:
    pid = shop.ref("shop").pid

    done = console.ask(Kill("shop"))

    assert done.facts == {"path": "inner/shop", "pid": pid, "signal": "SIGKILL", "restart": "permanent"}
    eventually(lambda: shop.ref("shop").pid not in (None, pid))


def test_a_child_in_a_thread_is_not_killed(start: Start, state_dir: Path) -> None:
    start(rr.ChildSpec(rr.Actor, id="here", placement="thread"))

    with (
        ConsoleConnection(find_console(state_dir)) as connection,
        pytest.raises(UsageError, match="terminate it instead"),
    ):
        connection.ask(Kill("here"))


def test_a_child_is_stopped_and_started_again(shop: rr.System, console: ConsoleConnection) -> None:
    pid = shop.ref("shop").pid
    assert pid is not None

    console.ask(Terminate("inner/shop"))
    wait_gone(pid)
    with pytest.raises(rr.ActorUnavailable, match="it is stopped"):
        console.ask(Kill("shop"))
    done = console.ask(Restart("shop"))
    again = console.ask(Restart("shop"))

    assert lives(again.facts["pid"])
    assert not lives(done.facts["pid"])


def test_a_child_is_added_from_a_toml_text(shop: rr.System, workshop: Workshop, console: ConsoleConnection) -> None:
    spec = f'actor = "support_managers:Shop"\nid = "second"\nargs = ["{workshop.root}"]\n'

    done = console.ask(StartChild(spec))

    assert done.facts["path"] == "inner/second"
    assert shop.registrar("second").servers() == ["second/thing"]


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("actor = ", "TOML"),
        ('actor = "support_managers:Nothing"', "support_managers:Nothing"),
        ('id = "x"', "either actor = 'module:class' or children"),
        ('actor = "support_managers:Shop"\nrestarts = 1', "one of"),
    ],
)
def test_a_wrong_specification_is_refused_and_names_its_file(
    shop: rr.System, console: ConsoleConnection, spec: str, words: str
) -> None:
    with pytest.raises(ConfigError, match=f"shop.toml.*{words}"):
        console.ask(StartChild(spec, file="shop.toml"))


def test_dry_runs_change_nothing(shop: rr.System, workshop: Workshop, console: ConsoleConnection) -> None:
    app = shop.open_registrar("app")
    query = app.load("shop/thing", Order("a"))
    before = workshop.lines()
    spec = f'actor = "support_managers:Shop"\nid = "second"\nargs = ["{workshop.root}"]\n'
    for command in (
        Load("shop/thing", '{"name": "b"}', keep=True, dry_run=True),
        Unload(query.id, dry_run=True),
        Unload(query.id, force=True, dry_run=True),
        SendStatus(query.id, "FATAL", dry_run=True),
        Kill("shop", dry_run=True),
        Terminate("shop", dry_run=True),
        Restart("shop", dry_run=True),
        StartChild(spec, dry_run=True),
        ShutDown(dry_run=True),
    ):
        assert console.ask(command).text.startswith("would ")

    assert workshop.lines() == before
    assert len(console.children().rows) == 2
    assert app.queries() == [query]


def test_what_is_not_there_is_named_with_what_is(shop: rr.System, console: ConsoleConnection) -> None:
    with pytest.raises(NotFound, match="shop"):
        console.ask(Kill("inner/shp"))
    with pytest.raises(UnknownQuery, match="nobody holds"):
        console.ask(Unload("0123456789"))
    with pytest.raises(UnknownQuery, match="no registrar serves"):
        console.ask(SendStatus("0123456789", "OK"))


def test_a_system_that_is_shut_down_has_stopped_in_order(start: Start, workshop: Workshop, state_dir: Path) -> None:
    system = start(rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),)))
    system.open_registrar("app").load("shop/thing", Order("a"))
    with ConsoleConnection(find_console(state_dir)) as connection:
        connection.ask(ShutDown())

    assert system.wait(10.0)
    assert system.ended is not None
    assert "a console" in system.ended.detail
    notes = [line.split()[0:2] for line in workshop.lines()]
    assert ["unload", "a"] in notes
    assert ["stop", "shop"] in notes
    assert rr.System.running(state_dir) is None


# -- the feed --------------------------------------------------------------------------------------------------------


def test_events_are_numbered_without_gaps(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, follow: Callable[[Follow], Calls]
) -> None:
    serve(provider, "thing")
    heard = follow(Follow())
    node = node_of(system)
    eventually(lambda: bool(node.watched))

    for number in range(50):
        app.load("provider/thing", number).unload()

    events = heard.wait(100)
    assert [event.seq for event in events] == list(range(1, 101))
    assert [event.event for event in events[:2]] == ["loaded", "unloaded"]
    assert events[0].facts["server"] == "provider/thing"


def test_a_reader_hears_what_it_has_asked_for(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, follow: Callable[[Follow], Calls]
) -> None:
    serve(provider, "thing")
    serve(provider, "other")
    heard = follow(Follow(["loaded"], "other"))
    node = node_of(system)
    eventually(lambda: bool(node.watched))

    app.load("provider/thing", 1).unload()
    app.load("provider/other", 1).unload()

    (event,) = heard.wait()
    assert (event.event, event.facts["server"]) == ("loaded", "provider/other")


def test_when_the_last_reader_has_gone_the_system_is_not_watched_any_more(system: rr.System, state_dir: Path) -> None:
    node = node_of(system)
    connection = ConsoleConnection(find_console(state_dir))
    connection.follow(Follow())
    eventually(lambda: bool(node.watched))
    connection.close()

    eventually(lambda: not node.watched)


def test_a_reader_that_is_too_slow_hears_how_many_it_missed_and_how_the_tree_is_now(
    shop: rr.System, state_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console_feed, "KEPT", 100)
    console, node = console_of(shop), node_of(shop)
    with ConsoleConnection(find_console(state_dir)) as connection:
        feed = connection.follow(Follow())
        eventually(lambda: bool(console.feed.readers))
        big, sent = "x" * 100_000, 0
        while not next(iter(console.feed.readers)).missed:  # nobody reads: the connection fills, then the list
            node.dispatcher.run(_publish(node, big))
            sent += 1
            assert sent < 10_000

        heard, missed = 0, 0
        while heard + missed < sent:
            part = next(feed)
            if isinstance(part, Events):
                heard += len(part.events)
            elif isinstance(part, Missed):
                missed += part.count
                assert part.seq == heard + missed
                assert [row.path for row in part.tree.rows] == ["inner", "inner/shop"]

    assert missed >= 100


def test_many_long_texts_at_once_reach_a_console_that_records(system: rr.System, state_dir: Path) -> None:
    console, node, heard = console_of(system), node_of(system), Calls()
    connection = ConsoleConnection(find_console(state_dir))
    parts = connection.record()

    def read() -> None:
        for part in parts:
            assert isinstance(part, Entries)
            for one in part.entries:
                heard(one)

    thread = threading.Thread(target=read)
    thread.start()
    eventually(lambda: bool(console.feed.readers))
    try:
        node.dispatcher.run(_publish_statuses(node, "x" * 10_000))
        eventually(lambda: len(heard) == 500)
    finally:
        connection.close()
        thread.join()


async def _publish_statuses(node: Node, text: str) -> None:
    for _ in range(500):
        node.emit("status", registrar="r", server="r/s", resource_id="1", detail=text)


async def _publish(node: Node, text: str) -> None:
    node.emit("dead_letter", pid=os.getpid(), to=text)


def test_a_reader_that_never_reads_holds_up_nobody(
    system: rr.System, app: rr.Registrar, provider: rr.Registrar, state_dir: Path
) -> None:
    serve(provider, "thing")
    node = node_of(system)
    connection = ConsoleConnection(find_console(state_dir))
    try:
        connection.follow(Follow())
        eventually(lambda: bool(node.watched))
        began = time.monotonic()
        for number in range(2000):
            app.load("provider/thing", number).unload()
        assert time.monotonic() - began < 30
        with ConsoleConnection(find_console(state_dir)) as other:
            assert other.children().rows
    finally:
        connection.close()


@pytest.mark.parametrize("text", ["8080", '"port":8080', "80.5", "true", "front", '["front"', "provider/th"])
def test_a_search_finds_what_a_row_shows(
    app: rr.Registrar, provider: rr.Registrar, console: ConsoleConnection, text: str
) -> None:
    serve(provider, "thing")
    query = app.load("provider/thing", {"port": 8080, "rate": 80.5, "on": True, "names": ["front"]})
    app.load("provider/thing", {"port": 9})
    resources, queries = console.resources("provider", text), console.queries("app", text)

    assert query.resource_id in [row.id for row in resources.rows]
    assert query.id in [row.id for row in queries.rows]
    assert console.resources("provider", "8081").total == 0


def test_a_list_of_several_pages_has_the_notes_of_each(
    system: rr.System, console: ConsoleConnection, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = ResourceRow("a", "a/b", "", "", "loaded", "OK", "", 1, [], 0, [], 0)
    pages = [Resources(3, [row], ["x: down"]), Resources(3, [row], ["y: down", "x: down"]), Resources(3, [row])]
    asked: list[ListResources] = []

    def ask(request: ListResources) -> Resources:
        asked.append(request)
        return pages[request.offset]

    monkeypatch.setattr(console, "ask", ask)

    assert console.resources() == Resources(3, [row] * 3, ["x: down", "y: down"])
    assert console.resources(limit=2) == Resources(3, [row] * 2, ["x: down", "y: down"])
    assert [(one.offset, one.limit) for one in asked] == [(0, 500), (1, 500), (2, 500), (0, 2), (1, 1)]


def test_what_follows_begins_when_it_is_asked_for(system: rr.System, console: ConsoleConnection) -> None:
    parts = console.follow(Follow(["loaded"]))
    provider = system.open_registrar("provider")
    serve(provider, "thing")
    system.open_registrar("app").load("provider/thing", "x")
    part = next(parts)

    assert isinstance(part, Events)
    assert [event.event for event in part.events] == ["loaded"]
