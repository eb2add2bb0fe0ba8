"""The plugin of pytest, as the tests of an application use it."""

from __future__ import annotations

import os
import tomllib
from pathlib import Path

import pytest

from support import REPOSITORY

pytest_plugins = ["pytester"]

HEAD = """
import subprocess, sys, threading
import rr_actors as rr

class Lamps(rr.Manager):
    @rr.server("lamp")
    def switch_on(self, room: str) -> str:
        return f"{room} is lit"
"""


def run(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, test: str, *options: str) -> pytest.RunResult:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (str(REPOSITORY), os.environ.get("PYTHONPATH")))))
    pytester.makepyfile(HEAD + test)
    return pytester.runpytest_subprocess(
        "-p", "no:cacheprovider", "-p", "no:rerunfailures", *options
    )  # that has a thread


def test_a_test_gets_a_system_that_is_stopped_after_it(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = run(
        pytester,
        monkeypatch,
        """
def test_lamps(rr_system, tmp_path):
    system = rr_system(rr.ChildSpec(Lamps, id="lamps"))
    assert system.open_registrar("app").load("lamps/lamp", "hall").response == "hall is lit"
    assert system.state_dir == tmp_path / "rr_state"
    other = rr_system(rr.Supervisor([rr.ChildSpec(Lamps, id="lamps")], max_restarts=1))
    assert other.open_registrar("app").load("lamps/lamp", "attic").response == "attic is lit"
    one_list = rr_system([rr.ChildSpec(Lamps, id="lamps"), rr.ChildSpec(Lamps, id="more")])  # as rr.System takes it
    assert one_list.open_registrar("app").load("more/lamp", "cellar").response == "cellar is lit"

def test_nothing_runs_any_more():
    assert [thread.name for thread in threading.enumerate()] == ["MainThread"]
    assert rr.System.running("rr_state") is None
""",
    )
    result.assert_outcomes(passed=2)


def test_a_system_that_fails_to_stop_does_not_keep_the_others_from_being_stopped(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = run(
        pytester,
        monkeypatch,
        """
def test_two_systems(rr_system):
    rr_system()
    second = rr_system()
    stop = second.stop
    def fail():
        stop()
        raise RuntimeError("the second one does not stop")
    second.stop = fail

def test_nothing_runs_any_more():
    assert [thread.name for thread in threading.enumerate()] == ["MainThread"]
""",
    )
    result.assert_outcomes(passed=2, errors=1)
    result.stdout.fnmatch_lines(["*RuntimeError: the second one does not stop*"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("leave", "said"),
    [
        (
            "subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(7)'])",
            "*left behind: process * time.sleep(7)*",
        ),
        (
            "threading.Thread(target=threading.Event().wait, args=(7,), name='mine').start()",
            "*left behind: thread mine*",
        ),
        ("global kept; import socket; kept = socket.socket()", "*behind: open socket:*"),
    ],
)
def test_a_test_that_leaves_something_behind_fails_and_names_it(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch, leave: str, said: str
) -> None:
    result = run(
        pytester,
        monkeypatch,
        f"""
def test_leaves(rr_system):
    rr_system()
    {leave}
""",
    )
    result.assert_outcomes(passed=1, errors=1)
    result.stdout.fnmatch_lines([said])


def test_what_a_test_holds_is_released_and_what_cannot_be_unloaded_fails_it(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = run(
        pytester,
        monkeypatch,
        """
class Doors(rr.Manager):
    @rr.server("door")
    def open_door(self, room: str) -> None: ...

    @open_door.unload
    def close_door(self, room: str, response: None) -> None:
        if room == "stuck":
            raise OSError("the door is stuck")

def test_held(rr_system: rr.StartSystem):
    system = rr_system(rr.ChildSpec(Doors, id="doors", placement="thread"))
    system.open_registrar("app").load("doors/door", "hall")

def test_stuck(rr_system: rr.StartSystem):
    system = rr_system(rr.ChildSpec(Doors, id="doors", placement="thread"))
    system.open_registrar("app").load("doors/door", "stuck")
""",
    )
    result.assert_outcomes(passed=2, errors=1)
    result.stdout.fnmatch_lines(["*left behind: registrar app of *: it holds 1 x doors/door; registrar doors of *"])


def test_the_package_says_to_pytest_where_the_plugin_is() -> None:
    project = tomllib.loads(Path(REPOSITORY, "pyproject.toml").read_text())["project"]
    assert project["entry-points"]["pytest11"] == {"rr_actors": "rr_actors_pytest.plugin"}


def test_a_failing_test_shows_its_own_lines_and_all_frames_on_request(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    test = """
def test_nobody(rr_system):
    app = rr_system(rr.ChildSpec(Lamps, id="lamps")).open_registrar("app")
    app.load("lamps/lamp", 3)  # the line that fails
"""
    shown = run(pytester, monkeypatch, test).stdout.str()
    assert '>       app.load("lamps/lamp", 3)  # the line that fails' in shown
    assert "InvalidRequest: " in shown
    assert "rr_actors/" not in shown.partition("FAILURES")[2]
    monkeypatch.setenv("PYTEST_ADDOPTS", "--full-trace")
    assert "rr_actors/registrar/registrar.py" in run(pytester, monkeypatch, test).stdout.str()


COUNTERS = """
class Counters(rr.Manager):
    def __init__(self):
        self.count = 0
        self.meeting = threading.Barrier(2)

    @rr.server("counter")
    def count_one(self, name: str) -> str:
        self.meeting.wait(30)  # both load callbacks run now
        self.count += 1
        self.meeting.wait(30)
        return name

@pytest.mark.parametrize("placement", ["thread", "process"])
def test_counters(rr_system, placement):
    system = rr_system(rr.Supervisor([rr.ChildSpec(Counters, id="counters", placement=placement)]))
    with system.open_registrar("app").load_all([(Counters.count_one, "a"), (Counters.count_one, "b")]):
        pass

def test_a_lock(rr_system):
    class Locked(rr.Manager):
        def __init__(self):
            self.count = 0
            self.lock = threading.Lock()
            self.meeting = threading.Barrier(2)

        @rr.server("counter")
        def count_one(self, name: str) -> str:
            self.meeting.wait(30)
            with self.lock:
                self.count += 1
            self.meeting.wait(30)
            return name

    system = rr_system(rr.ChildSpec(Locked, id="counters"))
    with system.open_registrar("app").load_all([("counters/counter", "a"), ("counters/counter", "b")]):
        pass
"""


def test_a_race_is_shown_with_both_places(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    result = run(pytester, monkeypatch, "import pytest\n" + COUNTERS, "--rr-races")

    result.assert_outcomes(passed=3, errors=2)
    result.stdout.fnmatch_lines(
        [
            "rr_system: callbacks race for self.count",
            '*the load callback of counters/counter "*" wrote it',
            "*in Counters.count_one: self.count += 1",
            '*the load callback of counters/counter "*" read it',
            "*in Counters.count_one: self.count += 1",
            "serial=True of the class, at_once=1 of a server, or a lock mends it",
        ]
    )


def test_without_the_option_nothing_is_seen(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    run(pytester, monkeypatch, "import pytest\n" + COUNTERS).assert_outcomes(passed=3)
