"""Chaos: a short run of it on real processes; and that its witnesses see what is wrong."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

import rr_actors as rr
from chaos.callback_log import Journal, Line, check_journal, read_journal
from chaos.invariants import check_at_rest, check_empty, check_told
from chaos.load_threads import Consumer, Sent
from chaos.monkey import Monkey
from chaos.report import KILLS, Report, Tally
from chaos.run import Options, _harm, run  # pyright: ignore[reportPrivateUsage]
from chaos.soak import slope
from chaos.victim_managers import Want
from chaos.watchdog import Interrupted, Watch
from rr_actors.registrar.model.rows import Held, Hold, Notice, Phase, Resource, Row, ServedQuery, State
from rr_actors.tools.inspection import Contents
from support import TESTS, eventually

pytestmark = pytest.mark.cold


@pytest.mark.slow
def test_twenty_kills_and_other_harm_break_no_promise(tmp_path: Path) -> None:
    shown: list[str] = []

    report = run(Options(kills=20, seconds=10.0, seed=3, state_dir=tmp_path / "state", pace_s=0.1), show=shown.append)

    assert report.violations == []
    assert report.kills >= 8
    assert sum(report.operations.values()) > 50
    assert sum(report.callbacks.values()) > 50
    assert report.catalogs >= 12  # of the managers; those of the applications are empty, and may have gone
    assert report.catalogs_damaged == 0
    assert any("kills" in line for line in shown)
    assert json.loads(report.json())["passed"] is True


@pytest.fixture
def consumer(start: Callable[..., rr.System]) -> Consumer:
    """A consumer that does only what the test calls, and holds one thing."""
    system = start()
    provider = system.open_registrar("provider")
    provider.register_server("thing", lambda request: "made", lambda request, made: None, request_type=Want)
    found = Consumer(system, system.open_registrar("app"), ("provider/thing",), 1, Tally())
    found.load("provider/thing", Want(1), 20.0)
    return found


def wrongs(consumer: Consumer) -> list[str]:
    """What the consumer finds when everything that was sent has arrived."""
    provider = consumer.system.registrar("provider")
    eventually(lambda: provider.stats()["notices"] == 0)
    consumer.check_heard()
    return consumer.tally.violations


def test_a_consumer_expects_nothing_of_a_resource_after_the_fatal_but_what_is_heard_then(consumer: Consumer) -> None:
    for state in (State.WARNING, State.FATAL, State.OK, State.WARNING, State.ERROR, State.UPDATE, State.FATAL):
        consumer.send(0, state)

    assert wrongs(consumer) == []


@pytest.mark.parametrize("state", [State.FATAL, State.UPDATE])
def test_a_consumer_misses_what_is_heard_even_after_a_fatal(consumer: Consumer, state: State) -> None:
    consumer.send(0, State.FATAL)
    consumer.held[0][1].append(Sent("told-0-lost", state, time.monotonic_ns()))

    assert ["told-0-lost" in wrong for wrong in wrongs(consumer)] == [True]


@pytest.mark.parametrize("fatal", [False, True])
def test_a_consumer_misses_what_was_sent_before_a_fatal_or_without_one(consumer: Consumer, fatal: bool) -> None:
    consumer.held[0][1].append(Sent("told-0-lost", State.WARNING, time.monotonic_ns()))
    consumer.send(0, State.FATAL if fatal else State.ERROR)

    assert ["told-0-lost" in wrong for wrong in wrongs(consumer)] == [True]


def test_a_consumer_has_heard_what_comes_first_as_repeated_and_finds_only_what_comes_twice_unmarked(
    consumer: Consumer,
) -> None:
    query, sent = consumer.held[0]
    sent += [Sent(f"told-0-{name}", State.OK, time.monotonic_ns()) for name in ("late", "again", "twice")]
    for name, repeated in (("late", True), ("again", False), ("again", True), ("twice", False), ("twice", False)):
        consumer.hear(rr.Status("OK", f"told-0-{name}", query_id=query.id, repeated=repeated))

    assert ["told-0-twice 2 times" in wrong for wrong in wrongs(consumer)] == [True]


@pytest.mark.slow
def test_a_soak_says_how_much_each_figure_grew(tmp_path: Path) -> None:
    result = tmp_path / "report.json"

    options = ["--soak", "4", "--churn", "0.5", "--state-dir", str(tmp_path / "state"), "--json", str(result)]

    ran = subprocess.run(
        [sys.executable, "-m", "chaos", *options], cwd=TESTS, capture_output=True, text=True, timeout=50
    )

    report = json.loads(result.read_text())
    growth = "\n".join(report["growth"])
    assert sum(report["faults"].values()) >= 3
    assert "Traceback" not in ran.stderr
    for what in ("USS (MiB)", "descriptors", "threads", "catalog (KiB)", "state directory (KiB)"):
        assert f"largest growth of {what}" in growth
    assert "violations" in ran.stdout


def test_options_out_of_range_are_refused(tmp_path: Path) -> None:
    (tmp_path / "something").touch()
    with pytest.raises(rr.UsageError, match="expected an empty directory"):
        Options(state_dir=tmp_path)
    with pytest.raises(rr.UsageError, match="churn: expected a soak with it, got none"):
        Options(churn_s=1.0)
    with pytest.raises(rr.UsageError, match="kills: expected a number above 0, got 0"):
        Options(kills=0)


def test_on_the_command_line_they_are_refused_in_words() -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "chaos", "--pace", "0"], cwd=TESTS, capture_output=True, text=True, timeout=30
    )

    assert ran.returncode == 2
    assert "pace: expected a number above 0, got 0" in ran.stderr
    assert "Traceback" not in ran.stderr


def test_a_slow_pace_is_no_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    tally, now = Tally(), [0.0]

    class SlowMonkey:
        def __init__(self, *args: object) -> None:
            self._faults = itertools.cycle(["links of a manager cut", "byte of a closed catalog spoilt", KILLS])

        def pause(self, meanwhile: Callable[[], None]) -> None:
            meanwhile()

        def step(self) -> None:
            now[0] += 40.0
            tally.fault(next(self._faults))

        def recover(self) -> None:
            pass

    chaos = sys.modules[Options.__module__]
    monkeypatch.setattr(chaos, "Monkey", SlowMonkey)
    monkeypatch.setattr(chaos, "time", SimpleNamespace(monotonic=lambda: now[0]))
    _harm(cast("Any", None), Options(kills=5, pace_s=40.0), tally, Watch(20.0), lambda line: None)
    assert (tally.kills, tally.violations) == (5, [])


def test_a_slow_monkey_is_interrupted_before_its_next_deed() -> None:
    monkey = Monkey(cast("Any", None), Tally(), 0, pace_s=1000.0)

    def interrupt() -> None:
        raise Interrupted

    with pytest.raises(Interrupted):
        monkey.pause(interrupt)


@pytest.mark.slow
def test_interrupted_it_leaves_nothing_and_no_traceback(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "chaos", "--kills", "1000"]
    environment = dict(os.environ, TMPDIR=str(tmp_path))
    chaos = subprocess.Popen(command, cwd=TESTS, env=environment, stderr=subprocess.PIPE, text=True)
    try:
        assert chaos.stderr is not None
        said = chaos.stderr.readline() + chaos.stderr.readline()  # the second: it harms
        chaos.send_signal(signal.SIGINT)
        said += chaos.communicate(timeout=30)[1]
    finally:
        chaos.kill()
        chaos.wait()

    assert chaos.returncode == 130, said
    assert said.endswith("interrupted; everything is stopped\n")
    assert "Traceback" not in said
    assert not list(tmp_path.iterdir())


def test_an_interrupted_run_has_ended_before_its_watch_says_so() -> None:
    waits, told, go_on, ended = (threading.Event() for _ in range(4))

    class WatchThatSays(Watch):
        def _see_end(self, ended: threading.Event) -> None:
            waits.set()
            super()._see_end(ended)

    watch = WatchThatSays(20.0)

    def work() -> None:
        waits.wait()
        os.kill(os.getpid(), signal.SIGINT)
        try:
            while True:
                watch.phase("a deed")
                time.sleep(0.001)
        except Interrupted:
            told.set()
            go_on.wait()
            ended.set()
            raise

    def let_it_end() -> None:
        told.wait()
        time.sleep(0.3)  # for a watch that does not wait: it has returned by now
        go_on.set()

    other = threading.Thread(target=let_it_end)
    other.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            watch.run(work)
        assert ended.is_set()
    finally:
        told.set()
        other.join()


STANDSTILL = """
    import sys
    sys.path[:0] = {paths!r}
    from chaos import __main__, monkey, victim_system
    import time
    {breakage}
    sys.argv[1:] = ["--kills", "3", "--pace", "0.1", "--patience", "{patience}"]
    sys.argv += ["--state-dir", {state!r}, "--json", {report!r}]
    code = __main__.main()
    sys.stdout.flush()
    __main__.os._exit(code)
"""

STANDING = {
    "a deed": ("monkey.Monkey.step = lambda self: time.sleep(1000)", "after 0 faults, the next", 15),
    "the checks": ("victim_system.check_at_rest = lambda state: time.sleep(1000)", "checking what is held", 20),
    "the stop": ("victim_system.System.stop = lambda self: time.sleep(1000)", "stopping", 20),
    "the start": ("victim_system.System.start = lambda self: time.sleep(1000)", "starting", 4),
}


@pytest.mark.slow
@pytest.mark.timeout(120)
@pytest.mark.parametrize("what", STANDING)
def test_a_standstill_ends_in_its_time_is_named_and_is_a_failure(what: str, tmp_path: Path) -> None:
    breakage, phase, patience_s = STANDING[what]
    paths = [str(TESTS)]
    report = tmp_path / "report.json"
    program = textwrap.dedent(STANDSTILL).format(
        breakage=breakage, paths=paths, patience=patience_s, state=str(tmp_path / "state"), report=str(report)
    )

    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=110)

    assert ran.returncode == 1, ran.stderr
    said = json.loads(report.read_text())
    assert said["passed"] is said["verdict"] is False
    violation = said["violations"][-1]  # the last: nothing is looked for after it
    assert violation.startswith(f"standstill: {phase}"), said["violations"]
    assert "thread chaos:" in violation  # where it stands
    assert "no verdict on the rest" in ran.stdout
    shutil.rmtree(tmp_path / "state" / "run", ignore_errors=True)  # its sockets: nobody has stopped it


def test_a_report_without_a_verdict_has_not_passed() -> None:
    assert not Report(seed=1).passed
    assert Report(seed=1, verdict=True).passed
    assert not Report(seed=1, verdict=True, violations=["something"]).passed


# -- the journal ---------------------------------------------------------------------------------------------------


def history(*steps: str) -> list[Line]:
    """Lines of resource r from "load/1@7": what, attempt, process."""
    lines: list[Line] = []
    for at, step in enumerate(steps):
        what, _, rest = step.partition("/")
        attempt, _, pid = rest.partition("@")
        lines.append(Line(at, "maker", what, "r", int(attempt), int(pid or 1)))
    return lines


@pytest.mark.parametrize(
    ("steps", "lives"),
    [
        (["load/1", "loaded/1"], True),
        (["load/1", "failed/1"], False),
        (["load/1", "loaded/1", "unload/1", "unloaded/1"], False),
        (["load/1@1", "load/2@2", "loaded/2@2"], True),
        (["load/1@1", "loaded/1@1", "load/2@2", "loaded/2@2"], True),  # killed before its answer was committed
        (["load/1@1", "loaded/1@1", "unload/1@1", "unload/2@2", "unloaded/2@2"], False),
        (["load/1@1", "loaded/1@1", "unload/1@1", "unloaded/1@1", "unload/2@2", "unloaded/2@2"], False),
        (["load/1@1", "failed/1@1", "load/2@2", "failed/2@2"], False),
        (["load/1@1", "load/2@2", "load/3@3", "unload/1@4", "unloaded/1@4"], False),  # given up
        (["load/1@1", "load/2@2", "load/3@3", "failed/3@3", "unload/1@4", "unloaded/1@4"], False),  # and killed then
        (["load/1@1", "unload/1@2", "unloaded/1@2"], False),  # withdrawn, and cleaned up
        (["load/1@1", "load/2@2", "failed/2@2", "unload/1@3", "unloaded/1@3"], False),
    ],
)
def test_what_a_crash_may_bring_about_is_no_violation(steps: list[str], lives: bool) -> None:
    assert check_journal(history(*steps), {"maker": {"r"} if lives else set()}) == []


@pytest.mark.parametrize(
    ("steps", "lives", "says"),
    [
        (["load/1", "loaded/1"], False, "never unloaded, and not in the catalog"),
        (["load/1", "failed/1"], True, "in the catalog, though failed"),
        (["load/1", "loaded/1", "unload/1", "unloaded/1"], True, "in the catalog, though unloaded"),
        (["load/1"], False, "load interrupted and not run again"),
        (["load/1", "loaded/1", "unload/1"], False, "unload interrupted and not run again"),
        (["load/1@1", "load/1@2", "loaded/1@2"], True, "without being told so"),
        (["load/1", "loaded/1", "unload/1", "unloaded/1", "unload/1", "unloaded/1"], False, "without being told so"),
        (["load/1", "loaded/1", "unload/1", "unloaded/1", "load/2", "loaded/2"], True, "loaded after its unload"),
        (["unload/1", "unloaded/1"], False, "unloaded when it was not loaded"),
        (["load/1", "failed/1", "unload/1", "unloaded/1"], False, "unloaded when it was failed"),
        (["load/1@1", "load/2@2", "load/3@3", "unload/1@3", "unloaded/1@3"], False, "unload while load runs"),
        (["load/1@1", "load/2@2", "load/3@3", "failed/3@3", "unload/1@3"], False, "unloaded when it was failed"),
        (["load/1", "load/2", "loaded/2"], True, "load while load runs"),
        (["loaded/1"], True, "without a beginning"),
        ([], True, "never loaded"),
    ],
)
def test_what_callbacks_must_not_do_is_found(steps: list[str], lives: bool, says: str) -> None:
    (violation, *_) = check_journal(history(*steps), {"maker": {"r"} if lives else set()})
    assert violation.startswith("journal: maker: resource r")
    assert says in violation


def test_a_line_that_a_kill_has_torn_is_no_line(tmp_path: Path) -> None:
    (tmp_path / "7-1.journal").write_text("1 maker load r 1\n2 maker unlo")
    assert [(line.what, line.pid) for line in read_journal(tmp_path)] == [("load", 7)]


def test_a_killed_process_leaves_whole_lines_and_a_long_journal_several_files(tmp_path: Path) -> None:
    code = (
        "import sys; from chaos.callback_log import Journal\n"
        "journal = Journal(sys.argv[1])\n"
        "for n in range(1000): journal.note('maker', 'load', f'r{n}', n)\n"
        "print('done', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], cwd=TESTS, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"done\n"
        process.send_signal(signal.SIGKILL)
    mine = Journal(tmp_path)
    mine.note("maker", "loaded", "last")
    mine.close()

    lines = read_journal(tmp_path)

    assert [line.subject for line in lines] == [*(f"r{n}" for n in range(1000)), "last"]
    assert lines[-1].pid == os.getpid()
    assert len(list(tmp_path.iterdir())) > 3
    assert max(path.stat().st_size for path in tmp_path.iterdir()) < 16 * 1024


# -- the catalogs --------------------------------------------------------------------------------------------------


def agreeing(*more: Row) -> dict[str, Contents]:
    """App holds query q on resource q of the maker; `more` rows come after these, or take their place."""
    resource = Resource("q", "thing", b"1", b"2", Phase.LOADED, State.OK, "", 1)
    held = Held("q", "maker", "thing", b"1", b"2", "q", "", 1, 1, Hold.HELD, State.OK)
    of_maker = [resource, ServedQuery("q", "q", "app", "", 1, 1), *(row for row in more if not isinstance(row, Held))]
    of_app = [held, *(row for row in more if isinstance(row, Held))]
    return {name: Contents(name, Path(name), rows) for name, rows in (("maker", of_maker), ("app", of_app))}


def test_agreeing_catalogs_are_at_rest_and_not_empty() -> None:
    state = agreeing()
    assert check_at_rest(state) == []
    assert check_told(state, {"app": ["q"]}) == []
    assert len(check_empty(state)) == 3


def test_whatever_moves_hangs_or_disagrees_is_found() -> None:
    def wrong(*rows: Row, lacks: str = "") -> str:
        state = agreeing(*rows)
        if lacks:
            getattr(state["app" if lacks == "held" else "maker"], lacks).clear()
        return "; ".join(check_at_rest(state))

    owed = Held("q", "maker", "thing", b"1", b"2", "q", "", 1, 1, Hold.OWED, State.OK)
    assert "is loading" in wrong(Resource("r", "thing", b"3", None, Phase.LOADING, State.OK, "", 1))
    assert "is held by nobody" in wrong(Resource("r", "thing", b"3", b"4", Phase.LOADED, State.OK, "", 1))
    assert "is held by nobody" in wrong(lacks="queries")
    assert "points to resource q, which does not exist" in wrong(lacks="resources")
    assert "is unknown to app" in wrong(lacks="held")
    assert "is owed" in wrong(owed)
    assert "another resource" in wrong(ServedQuery("q", "r", "app", "", 1, 1))
    assert "is not delivered" in wrong(Notice("n", "q", "app", "q", "e", State.OK, "", "maker/thing"))


def test_a_consumer_that_was_told_otherwise_is_found() -> None:
    state = agreeing()
    assert check_told(state, {"app": []}) == ["app: its catalog has query q, of which it was not told"]
    assert check_told(state, {"app": ["q", "p"]}) == ["app: heard of query p, which its catalog lacks"]


def test_growth_is_theslope_of_a_line_through_the_samples() -> None:
    assert slope([(0.0, 1.0), (1.0, 3.0), (2.0, 5.0)]) == pytest.approx(2.0)
    assert slope([(0.0, 4.0), (1.0, 4.0)]) == 0.0
    assert slope([(1.0, 4.0), (1.0, 5.0)]) == 0.0
