"""`rr-actors chaos`: children of a running system are killed at random, and it is checked that the system recovers."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.registrar.model.rows import Held, Hold, Notice, Phase, Put, Resource, Row, ServedQuery, State
from rr_actors.storage.opening import open_store
from rr_actors.system.console.console_connection import ConsoleConnection, find_console
from rr_actors.system.console.console_messages import ChildRow
from rr_actors.tools.inspection import Contents, check_delivered
from rr_actors.tools.random_kills import KillPlan, RandomKills, missing_after
from support import LIMIT_S, Workshop, kill, pid_of, wait_respawned
from support_cli import run_cli
from support_managers import Order, Shop

pytestmark = pytest.mark.usefixtures("runtime_dir")

Start = Callable[..., rr.System]
OFTEN: dict[str, Any] = {"max_restarts": 100, "max_seconds": 1}


class Idler(rr.Actor):
    pass


@pytest.fixture
def shop(start: Start, workshop: Workshop) -> rr.System:
    """A system with two managers, `shop` and `store`, that may be restarted often."""
    children = [rr.ChildSpec(Shop, id=id, args=(str(workshop.root),)) for id in ("shop", "store")]
    return start(rr.Supervisor(children, **OFTEN))


def chaos(*arguments: object) -> subprocess.CompletedProcess[str]:
    return run_cli("chaos", *arguments)


def report_of(*arguments: object) -> dict[str, Any]:
    """The report of a run, as JSON."""
    return json.loads(chaos(*arguments, "--json").stdout)


def killed(report: dict[str, Any]) -> list[str]:
    return [kill["path"] for kill in report["kills"]]


# -- a system that recovers -------------------------------------------------------------------------------------------


def test_children_are_killed_until_the_number_is_reached_and_what_is_held_stays_held(shop: rr.System) -> None:
    before = {id: pid_of(shop, id) for id in ("shop", "store")}
    query = shop.open_registrar("app").load("shop/thing", Order("lamp"))

    ran = chaos("--kills", 3, "--seed", 1)

    assert ran.returncode == 0, ran.stdout + ran.stderr
    *table, count, verdict = ran.stdout.splitlines()
    assert table[0].split() == ["child", "kills", "longest", "return"]
    assert sum(int(line.split()[1]) for line in table[1:]) == 3
    assert count.startswith("3 kills in ")
    assert count.endswith("seed 1")
    assert verdict == "each child runs again; 3 catalogs, 1 query: no contradiction"
    assert "3 of 3: killed root/" in ran.stderr
    assert {id: pid_of(shop, id) for id in before} != before
    assert [one.id for one in shop.registrar("app").queries()] == [query.id]


def test_the_same_seed_kills_the_same_children_in_the_same_order(shop: rr.System) -> None:
    first, again = (report_of("--kills", 5, "--seed", 7) for _ in range(2))

    assert killed(first) == killed(again)
    assert len(set(killed(first))) == 2


def test_the_report_for_programs_has_each_kill_and_the_verdict(shop: rr.System) -> None:
    pid = pid_of(shop, "shop")

    report = report_of("--kills", 1, "--only", "shop")

    (kill,) = report["kills"]
    assert (kill["path"], kill["pid"]) == ("root/shop", pid)
    assert kill["back_s"] > 0
    assert (report["violations"], report["passed"]) == ([], True)


def test_only_the_named_children_are_killed_and_of_a_supervisor_all_below_it(start: Start) -> None:
    inner = rr.Supervisor([rr.ChildSpec(Idler, id="a"), rr.ChildSpec(Idler, id="b")], id="inner", **OFTEN)
    start(rr.Supervisor([rr.ChildSpec(Idler, id="outside"), inner], **OFTEN))

    assert json.loads(chaos("--only", "inner", "--dry-run", "--json").stdout)["children"] == [
        "root/inner/a",
        "root/inner/b",
    ]
    assert set(killed(report_of("--kills", 3, "--only", "root/inner/b"))) == {"root/inner/b"}


def test_a_supervisor_with_a_process_of_its_own_runs_again_with_all_below_it(start: Start) -> None:
    spec = rr.ChildSpec(rr.Supervisor([rr.ChildSpec(Idler, id="a")]), id="inner", placement="process")
    system = start(rr.Supervisor([spec], **OFTEN))
    pid = system.ref("root/inner/a").pid

    report = report_of("--kills", 1, "--seed", 3)

    assert killed(report) == ["root/inner"]
    assert report["passed"]
    assert system.ref("root/inner/a").pid != pid


def test_no_kill_begins_after_the_given_seconds(shop: rr.System) -> None:
    report = report_of("--seconds", 0)

    assert (killed(report), report["passed"]) == ([], True)


def test_ctrl_c_ends_a_run_with_a_report_of_what_was_done(start: Start) -> None:
    system = start(rr.Supervisor([rr.ChildSpec(Idler, id="a")], max_restarts=1, max_seconds=600))
    command = [sys.executable, "-m", "rr_actors", "chaos", "--state", str(system.state_dir)]

    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        assert running.stderr is not None
        progress = iter(running.stderr)
        assert any("waiting" in line for line in progress)
        running.send_signal(signal.SIGINT)
        out, _ = running.communicate(timeout=LIMIT_S)

    assert running.returncode == 130
    assert "1 kills in " in out
    assert out.endswith("interrupted: what follows the last kill was not checked\n")


# -- what is left alone -----------------------------------------------------------------------------------------------


def test_a_dry_run_says_what_might_be_killed_and_what_is_left_alone_and_kills_nothing(start: Start) -> None:
    strict = rr.Supervisor([rr.ChildSpec(Idler, id="once")], id="strict", max_restarts=0)
    passing = rr.ChildSpec(Idler, id="passing", restart="temporary")
    system = start(
        rr.ChildSpec(Idler, id="kept"), passing, rr.ChildSpec(Idler, id="inside", placement="thread"), strict
    )
    pids = {id: system.ref(id).pid for id in ("kept", "passing", "inside", "once")}

    plan = chaos("--dry-run", "--seed", 5, "--kills", 2).stdout.splitlines()

    assert plan[:2] == ["would send SIGKILL 2 times, each time to one of these at random (seed 5):", "  root/kept"]
    assert plan[2:] == [
        "left alone: root/inside: it runs in a thread, in a process with others",
        "left alone: root/passing: it is temporary: nobody starts it again",
        "left alone: root/strict: it runs in a thread, in a process with others",
        "left alone: root/strict/once: its supervisor root/strict allows no restart (see --regardless)",
    ]
    assert {id: system.ref(id).pid for id in pids} == pids
    assert "root/strict/once" in json.loads(chaos("--dry-run", "--json", "--regardless").stdout)["children"]


def test_a_system_with_nothing_to_kill_is_an_error_that_says_why(start: Start) -> None:
    start(rr.ChildSpec(Idler, id="passing", restart="temporary"))

    ran = chaos()

    assert (ran.returncode, ran.stdout) == (2, "")
    assert "root/passing: it is temporary" in ran.stderr


def test_a_child_that_is_not_there_is_refused(shop: rr.System) -> None:
    ran = chaos("--only", "shap")

    assert (ran.returncode, ran.stdout) == (2, "")
    assert "did you mean 'shop'" in ran.stderr


def test_without_a_running_system_it_says_so(tmp_path: Path) -> None:
    assert chaos("--state", tmp_path).returncode == 3


# -- the restart intensity --------------------------------------------------------------------------------------------


def test_a_kill_waits_until_the_supervisor_may_restart_the_child(start: Start) -> None:
    system = start(rr.Supervisor([rr.ChildSpec(Idler, id="a")], max_restarts=1, max_seconds=2))

    ran = chaos("--kills", 3)

    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "root has made all the restarts that it allows (one_for_one, 1 in 2 s): waiting" in ran.stderr
    assert system.ended is None


def test_a_restart_that_is_excused_for_now_takes_the_room_of_one(start: Start, workshop: Workshop) -> None:
    shop = rr.ChildSpec(Shop, id="shop", args=(str(workshop.root),))
    system = start(rr.Supervisor([shop], max_restarts=1, max_seconds=60))
    workshop.shut("load lamp")
    app = system.open_registrar("app")
    with ThreadPoolExecutor(1) as caller:
        loading = caller.submit(app.load, "shop/thing", Order("lamp"))
        workshop.wait("load lamp")
        wait_respawned(system, "shop", kill(system, "shop"))  # the load may be to blame, until it ends well

        ran = chaos("--kills", 1, "--seconds", 1)

        assert ran.stdout.splitlines()[-2].startswith("0 kills in ")
        assert "root has made all the restarts that it allows" in ran.stderr
        workshop.open("load lamp")
        loading.result()
    assert system.ended is None


def test_regardless_of_the_intensity_a_system_ends_and_the_answer_is_no(start: Start) -> None:
    start(rr.Supervisor([rr.ChildSpec(Idler, id="a")], max_restarts=1, max_seconds=60))

    ran = chaos("--kills", 5, "--regardless")

    assert ran.returncode == 1
    assert "wrong: the system ended after root/a was killed" in ran.stdout
    assert "2 kills in " in ran.stdout


# -- a system that does not recover -----------------------------------------------------------------------------------


def test_a_child_that_does_not_run_again_in_time_is_named_and_ends_the_run(shop: rr.System, workshop: Workshop) -> None:
    workshop.shut("start shop")

    ran = chaos("--kills", 5, "--only", "shop", "--timeout", 1)
    workshop.open("start shop")

    assert ran.returncode == 1
    (wrong,) = [line for line in ran.stdout.splitlines() if line.startswith("wrong: ")]
    assert wrong.startswith("wrong: root/shop was killed, and after 1 s root/shop is restarting")
    assert "1 kills in " in ran.stdout


def spoil(state_dir: Path) -> None:
    """Make the catalogs disagree: a registrar holds a query that the shop does not know."""
    store = open_store(state_dir / "ghost" / "catalog.sqlite3", durability="process", on_damage="refuse")
    store.load()
    store.commit([Put(Held("q9", "shop", "thing", b"\xc0", b"\xc0", "r9", "", 1, 1, Hold.HELD, State.OK))])
    store.close()


def test_catalogs_that_disagree_before_are_named_and_nothing_is_killed(shop: rr.System) -> None:
    spoil(shop.state_dir)
    pids = [pid_of(shop, id) for id in ("shop", "store")]

    ran = chaos("--timeout", 0.5)

    assert ran.returncode == 1
    assert "wrong: before the first kill: ghost: held query q9 is unknown to its provider shop/thing" in ran.stdout
    assert [pid_of(shop, id) for id in ("shop", "store")] == pids


def test_catalogs_that_disagree_after_a_kill_end_the_run(shop: rr.System) -> None:
    with ConsoleConnection(find_console(shop.state_dir)) as connection:
        plan = KillPlan(kills=5, seed=1, only=("shop",), timeout_s=5.0)
        report = RandomKills(connection, plan, lambda line: spoil(shop.state_dir)).run()

    assert [kill.path for kill in report.kills] == ["root/shop"]
    assert report.violations == [
        "after root/shop was killed: ghost: held query q9 is unknown to its provider shop/thing"
    ]


# -- what is looked at ------------------------------------------------------------------------------------------------


def tree(*rows: ChildRow) -> dict[str, ChildRow]:
    return {row.path: row for row in rows}


def worker(id: str, state: str = "running", pid: int | None = 7) -> ChildRow:
    return ChildRow(f"root/{id}", 1, "worker", state, pid)


@pytest.mark.parametrize(
    ("now", "missing"),
    [
        ([worker("a", pid=8), worker("b")], []),
        ([worker("a", "restarting", None), worker("b")], ["root/a is restarting"]),
        ([worker("a", pid=7), worker("b")], ["root/a is running"]),  # its supervisor has not noted the end yet
        ([worker("a", "stopped", None), worker("b")], ["root/a is stopped"]),
        ([worker("b")], ["root/a is not in the tree"]),
        ([worker("a", pid=8), worker("b", "starting", None)], ["root/b is starting"]),  # of the same group
        ([worker("a", pid=8), worker("b", "stopped", None)], []),  # it has ended in order
        ([worker("a", pid=8)], []),
        ([worker("a", pid=8), worker("late", "starting", None)], []),  # it did not run before
    ],
)
def test_a_killed_child_and_those_that_ran_before_must_run(now: Iterable[ChildRow], missing: list[str]) -> None:
    before = tree(worker("a"), worker("b"), worker("late", "restarting", None))

    assert missing_after("root/a", 7, before, tree(*now)) == missing


def catalogs(phase: Phase = Phase.LOADED, *more: Row, hold: Hold = Hold.HELD) -> dict[str, Contents]:
    """App holds query q on resource q of the maker."""
    maker = [Resource("q", "thing", b"1", b"2", phase, State.OK, "", 1), ServedQuery("q", "q", "app", "", 1, 1), *more]
    app = [Held("q", "maker", "thing", b"1", b"2", "q", "", 1, 1, hold, State.OK)]
    return {name: Contents(name, Path(name), rows) for name, rows in (("maker", maker), ("app", app))}


def test_rows_that_two_registrars_owe_each_other_are_found_unless_one_is_down() -> None:
    other = ServedQuery("p", "q", "app", "", 1, 2)
    notice = Notice("n", "q", "app", "q", "e", State.OK, "", "maker/thing")

    assert [*check_delivered(catalogs())] == []
    assert [*check_delivered(catalogs(Phase.LOADED, other))] == [
        "maker: query p is unknown to app, which should hold it"
    ]
    assert [*check_delivered(catalogs(Phase.LOADED, notice))] == ["maker: notice n for app is not delivered"]
    assert [*check_delivered(catalogs(hold=Hold.OWED))] == ["app: its query q at maker is owed"]
    for down in ("app", "maker"):
        assert [*check_delivered(catalogs(Phase.LOADED, other, notice, hold=Hold.OWED), {down})] == []


def test_a_load_that_is_not_answered_yet_owes_nothing() -> None:
    assert [*check_delivered(catalogs(Phase.LOADING, ServedQuery("p", "q", "app", "", 1, 2)))] == []


def test_a_shell_completes_the_children_that_may_be_named(shop: rr.System) -> None:
    words = ("rr-actors", "chaos", "--only", "sh")
    tab = {"_RR_ACTORS_COMPLETE": "complete_bash", "COMP_WORDS": " ".join(words), "COMP_CWORD": "3"}
    command = Path(sys.executable).with_name("rr-actors")

    ran = subprocess.run([command], env=os.environ | tab, capture_output=True, text=True, check=True)

    assert ran.stdout.split() == ["shop"]
