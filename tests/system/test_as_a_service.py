"""As a service: sd_notify, and `rr-actors run` of TOML files, Python files and modules, from any directory."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors.base.checks import EXTRAS, missing_library
from support import REPOSITORY, TEST_PATHS
from support_cli import run_cli

Start = Callable[..., rr.System]
LIMIT_S = 30.0
PARTS = """
import pathlib
import rr_actors as rr

class Part(rr.Manager):
    def __init__(self, file=None):
        self.text = pathlib.Path(file).read_text() if file else ""

    def read(self) -> str:
        return self.text

TREE = rr.Supervisor([rr.ChildSpec(Part, id="part")], id="robot")
CHILDREN = [rr.ChildSpec(Part, id="part")]
NUMBER = 5

def made():
    return TREE
"""
TOML = """
id = "robot"
[[children]]
id = "part"
actor = "parts_beside:Part"
args = ["words.txt"]
"""


class Part(rr.Actor):
    def on_receive(self, message: object) -> None:
        raise ValueError("no such part")


@contextmanager
def heard(place: str | Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], list[str]]]:
    """Yield a function that returns the lines of the next notice, as systemd hears it."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as there:
        there.settimeout(LIMIT_S)
        there.bind(f"\0{str(place)[1:]}" if str(place).startswith("@") else str(place))
        monkeypatch.setenv("NOTIFY_SOCKET", str(place))
        yield lambda: there.recv(4096).decode().splitlines()
    Path(place).unlink(missing_ok=True)


@pytest.mark.parametrize("abstract", [False, True])
def test_systemd_hears_that_it_has_started_and_stops(
    rr_system: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, abstract: bool
) -> None:
    with heard(f"@rr-{os.getpid()}" if abstract else tmp_path / "notify", monkeypatch) as next_notice:
        system = rr_system(rr.ChildSpec(Part, id="part", placement="thread"), name="robot")
        assert next_notice() == ["READY=1", f"STATUS=system robot runs in {system.state_dir}"]
        system.ref("part").tell("break")
        assert next_notice() == ["STATUS=runs; 1 restart, the last of root/part"]
        system.stop()
        assert next_notice() == ["STOPPING=1", "STATUS=stops"]


def test_the_event_loop_feeds_the_watchdog(rr_system: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "30000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    with heard(tmp_path / "notify", monkeypatch) as next_notice:
        rr_system([])
        assert next_notice()[0] == "READY=1"
        assert [next_notice() for _ in range(3)] == [["WATCHDOG=1"]] * 3


@pytest.mark.parametrize(("name", "value"), [("WATCHDOG_PID", "1"), ("WATCHDOG_USEC", "soon")])
def test_another_processs_watchdog_is_not_fed(
    rr_system: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, value: str
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "30000")
    monkeypatch.setenv(name, value)
    with heard(tmp_path / "notify", monkeypatch) as next_notice:
        rr_system([]).stop()
        assert [next_notice()[0], next_notice()[0]] == ["READY=1", "STOPPING=1"]


def test_a_service_manager_that_does_not_hear_ends_nothing(
    rr_system: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    rr_system([]).stop()
    assert f"the service manager at NOTIFY_SOCKET={tmp_path / 'nobody'} does not hear" in caplog.text


@pytest.fixture
def project(tmp_path: Path) -> Path:
    folder = tmp_path / "project"
    folder.mkdir()
    Path(folder, "parts_beside.py").write_text(PARTS)
    Path(folder, "robot.toml").write_text(TOML)
    Path(folder, "words.txt").write_text("beside the tree")
    return folder


@pytest.mark.parametrize(
    ("tree", "here"),
    [("{project}/robot.toml", False), ("{project}/parts_beside.py", False), ("parts_beside:made", True)],
)
def test_run_finds_the_tree_and_what_is_beside_it(project: Path, tmp_path: Path, tree: str, here: bool) -> None:
    state, cwd = tmp_path / "state", project if here else tmp_path
    command = (sys.executable, "-m", "rr_actors", "run", tree.format(project=project), "--state", "state")
    environment = os.environ | {"PYTHONPATH": TEST_PATHS}
    state = cwd / "state"
    with subprocess.Popen(command, cwd=cwd, env=environment, stderr=subprocess.PIPE, text=True) as running:
        try:
            with rr.connect(state, wait_s=LIMIT_S) as connection:
                assert connection.system == "robot"  # as its tree
                connection.wait_for("part")
                said = connection.proxy("part").read().get(timeout=LIMIT_S)
                assert said == ("beside the tree" if tree.endswith("toml") else "")
        finally:
            running.send_signal(signal.SIGTERM)
        assert running.stderr is not None
        assert f"system robot runs in state (pid {running.pid})" in running.stderr.read()
    assert running.returncode == 0


@pytest.mark.parametrize(
    ("tree", "says"),
    [
        ("parts_beside:TREEE", "expected an object 'TREEE' in parts_beside, got none; did you mean 'TREE'?"),
        ("parts_beside:NUMBER", "expected a Supervisor, or a list of its children, got 5 (int)"),
        ("no_parts:TREE", "got no module 'no_parts' here or among what is installed"),
        ("no_parts.py", "expected a file that can be read, got no such file"),
        ("odd-name.py", "expected a file whose name is that of a module"),
        ("broken.py", "expected a module that can be imported, got SyntaxError"),
        ("no.toml", "no.toml"),
    ],
)
def test_what_is_no_tree_says_what_was_expected(project: Path, tree: str, says: str) -> None:
    Path(project, "odd-name.py").touch()
    Path(project, "broken.py").write_text("TREE = (")
    done = subprocess.run(
        (sys.executable, "-m", "rr_actors", "verify", tree),
        cwd=project,
        env=os.environ | {"PYTHONPATH": TEST_PATHS},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
    )
    assert done.returncode == 2, done
    assert says in done.stderr
    assert done.stderr.count("\n") == 1


def test_verify_takes_what_run_takes(project: Path) -> None:
    assert run_cli("verify", f"{project}/parts_beside.py:CHILDREN").returncode == 0


def test_the_advice_for_a_missing_library_names_what_the_extra_installs() -> None:
    extras = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["optional-dependencies"]

    def all_of(extra: str) -> set[str]:
        nested = {name for text in extras[extra] for name in re.findall(r"^rr-actors\[(.+)\]$", text)}
        plain = {text for text in extras[extra] if not text.startswith("rr-actors")}
        return plain.union(*(all_of(name) for name in nested))

    assert {extra: set(names) for extra, names in EXTRAS.items()} == {extra: all_of(extra) for extra in EXTRAS}
    error = missing_library("textual", "top", "top")
    assert "pip install 'rich>=" in str(error)
    assert "rr-actors[" not in str(error)
