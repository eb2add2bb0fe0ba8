"""`rr-actors new` makes a project that passes its own test, and runs as its files for services say."""

from __future__ import annotations

import configparser
import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

from rr_actors.testing.experiments import Trial, check_levers, check_trials
from rr_actors.tools.web.lab.lab_folder import read_experiment
from support import REPOSITORY, eventually
from support_cli import run_cli


def has_handler(pid: int, number: signal.Signals) -> bool:
    """Whether the process has a handler of its own for a signal."""
    status = dict(line.split(":\t") for line in Path(f"/proc/{pid}/status").read_text().splitlines())
    return bool(int(status["SigCgt"], 16) >> (number - 1) & 1)


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What `rr-actors new tea-robot` makes."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(REPOSITORY))
    ran = run_cli("new", "tea-robot")
    assert ran.returncode == 0, ran.stderr
    assert "tea-robot/README.md" in ran.stdout
    return tmp_path / "tea-robot"


def run(project: Path, *arguments: object) -> str:
    """What Python prints in the project."""
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(command, cwd=project, capture_output=True, text=True, timeout=50)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_a_new_project_passes_its_own_test(project: Path) -> None:
    assert "1 passed" in run(project, "-m", "pytest", "-q", "-p", "no:cacheprovider")


def test_a_new_project_can_be_built_and_its_wheel_has_its_command(project: Path) -> None:
    pytest.importorskip("hatchling", reason="the extra test has it")
    run(project, "-m", "hatchling", "build", "-t", "wheel", "-d", "dist")
    (wheel,) = (project / "dist").glob("tea_robot-*.whl")
    with zipfile.ZipFile(wheel) as archive:
        (listed,) = [file for file in archive.namelist() if file.endswith("entry_points.txt")]
        assert "tea-robot = tea_robot.__main__:main" in archive.read(listed).decode()
        assert "tea_robot/managers.py" in archive.namelist()


def test_the_application_of_a_new_project_runs_as_its_unit_says_and_stops_in_order(project: Path) -> None:
    unit = configparser.ConfigParser(interpolation=None)
    unit.optionxform = str  # type: ignore[assignment, method-assign]
    unit.read(project / "tea-robot.service")
    python, *arguments = shlex.split(unit["Service"]["ExecStart"])
    assert (Path(python).name, unit["Service"]["StateDirectory"]) == ("python", "tea-robot")
    assert unit["Service"]["Type"] == "notify"
    watchdog_us = int(unit["Service"]["WatchdogSec"]) * 1_000_000
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    manager.bind(str(project / "notices"))
    manager.settimeout(30.0)
    log = project / "log"
    with log.open("w") as out:
        environment = os.environ | {
            "STATE_DIRECTORY": str(project / "state"),
            "NOTIFY_SOCKET": str(project / "notices"),
            "WATCHDOG_USEC": str(watchdog_us),
        }
        service = subprocess.Popen([sys.executable, *arguments], cwd=project, env=environment, stdout=out, stderr=out)
    try:
        eventually(lambda: "has a map of the kitchen" in log.read_text(), 30.0, "the application's line")
        assert (project / "state" / "cameras").is_dir()
        assert manager.recv(1000).startswith(b"READY=1\n")
        assert manager.recv(1000) == b"WATCHDOG=1"
        eventually(lambda: has_handler(service.pid, signal.SIGTERM), what="run() handles SIGTERM")
        service.send_signal(signal.SIGTERM)
        assert service.wait(20) == 0
        assert manager.recv(1000).startswith(b"STOPPING=1\n")
    finally:
        manager.close()
        (project / "notices").unlink()
        service.kill()
        service.wait()
    assert log.read_text().index("erases the map") < log.read_text().index("closes the camera")


def test_the_container_of_a_new_project_has_what_it_starts(project: Path) -> None:
    instructions = (project / "Dockerfile").read_text()
    copied = {name for line in re.findall(r"^COPY (.*) \S+$", instructions, re.MULTILINE) for name in line.split()}
    assert {name for name in copied if not (project / name).exists()} == {"wheels"}  # as its first lines say
    facts = tomllib.loads((project / "pyproject.toml").read_text())
    assert {facts["project"]["readme"], *facts["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]} < copied
    (command,) = re.findall(r"^CMD (.*)$", instructions, re.MULTILINE)
    assert json.loads(command)[-2:] == ["-m", "tea_robot"]


def test_a_new_project_leaves_no_placeholder(project: Path) -> None:
    files = [path for path in project.rglob("*") if path.is_file()]
    assert len(files) == 9
    assert [path for path in files if re.search("_NAME_|_MODULE_", f"{path}{path.read_text()}")] == []


@pytest.mark.timeout(240)
def test_a_new_experiment_does_what_its_levers_say_as_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    ran = run_cli("new", "--experiment", "tea-break")
    assert (ran.returncode, "rr-actors web --lab ." in ran.stdout) == (0, True), ran.stderr
    made = tmp_path / "tea_break.py"
    assert list(tmp_path.iterdir()) == [made]
    assert re.search("_NAME_|_MODULE_", made.read_text()) is None
    experiment = read_experiment(made)
    assert (experiment.button, bool(experiment.look_for), bool(experiment.why)) == ("tea-break", True, True)
    trials = [Trial(made, {}, {"yes"}), Trial(made, {"max_restarts": 1}, {"no: its supervisor has given up"})]
    check_levers(trials)
    check_trials(trials)


def test_an_experiment_that_is_there_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tea_break.py").write_text("mine")
    ran = run_cli("new", "--experiment", "tea-break")
    assert (ran.returncode, ran.stderr) == (2, "rr-actors: tea_break.py: File exists\n")
    assert (tmp_path / "tea_break.py").read_text() == "mine"


@pytest.mark.parametrize(
    ("name", "word"),
    [("../robot", "hyphens"), ("Robot", "hyphens"), ("class", "word of Python"), ("json", "installed")],
)
def test_a_name_that_cannot_be_a_projects_is_refused(
    name: str, word: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ran = run_cli("new", name)
    assert (ran.returncode, word in ran.stderr) == (2, True)
    assert list(tmp_path.iterdir()) == []


def test_a_directory_that_is_there_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot").mkdir()
    ran = run_cli("new", "robot")
    assert (ran.returncode, ran.stderr) == (2, "rr-actors: robot: File exists\n")
    assert list((tmp_path / "robot").iterdir()) == []
