"""The mission as a whole, faster than in the demo: it reaches its goal through all faults and leaves nothing behind."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from support import REPOSITORY, eventually
from support_programs import running_programs
from support_slow import few_now

SCRIPT = REPOSITORY / "examples" / "mission.py"
ENVIRONMENT = dict(os.environ, PYTHONPATH=str(REPOSITORY))


def run_mission(tmp_path: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), "--speed", "6", "--output", str(tmp_path / "out"), *options]
    return subprocess.run(
        command, env=ENVIRONMENT, cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False
    )


def row(output: str, title: str) -> list[str]:
    """The cells of one row of the table."""
    (line,) = [line for line in output.splitlines() if line.startswith(f"│ {title}")]
    return [cell.strip() for cell in line.strip("│").split("│")]


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_the_robot_reaches_its_goal_through_all_faults_and_stops_at_the_first_without_recovery(tmp_path: Path) -> None:
    done = run_mission(tmp_path, "--seed", "7")
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stderr == ""
    assert "Traceback" not in done.stdout
    assert re.fullmatch(r"[\d.]+ s", row(done.stdout, "time without faults")[2])
    assert re.fullmatch(r"[\d.]+ s", row(done.stdout, "time with faults")[2])
    assert row(done.stdout, "time without recovery")[2].startswith("stopped at F1 after")
    assert "simulated robot; start-up of real devices not included" in done.stdout
    assert "WARNING: health: no line of its output for" in done.stdout
    for fault in ("F1 lidar 1 disconnected", "F2", "F3", "F4", "F5", "F6 lidar 2 killed"):
        _, _, standing, serving = row(done.stdout, fault)
        assert re.fullmatch(r"[\d.]+ s", standing)
        assert re.fullmatch(r"\d+ ms", serving)
    assert row(done.stdout, "resources still allocated")[2] == "0"
    assert row(done.stdout, "processes left")[2] == "0"
    for figure in ("path.png", "distance.png"):
        assert (tmp_path / "out" / figure).read_bytes().startswith(b"\x89PNG")
    with_faults = (tmp_path / "out" / "timeline-with-faults.svg").read_text()
    assert [child in with_faults for child in ("root/programs", "root/components", "root/robots")] == [True] * 3
    assert "killed" in with_faults
    assert "Traceback" not in (tmp_path / "out" / "mission.log").read_text()


@pytest.mark.parametrize(
    ("number", "code", "said"),
    [
        (signal.SIGINT, 130, "Interrupted; everything is unloaded and stopped."),
        pytest.param(signal.SIGTERM, 143, "", marks=pytest.mark.slow),
        pytest.param(signal.SIGHUP, 129, "", marks=pytest.mark.slow),
    ],
)
def test_told_to_end_it_unloads_and_stops_everything(
    tmp_path: Path, number: signal.Signals, code: int, said: str
) -> None:
    # Under nohup the tests, and with them the mission, would ignore SIGHUP.
    heed = "import os, signal, sys; signal.signal(signal.SIGHUP, signal.SIG_DFL); os.execv(sys.argv[1], sys.argv[1:])"
    command = [sys.executable, "-u", str(SCRIPT), "--no-faults", "--output", str(tmp_path / "out")]
    command = [sys.executable, "-c", heed, *command]
    environment = dict(ENVIRONMENT, TMPDIR=str(tmp_path))
    mission = subprocess.Popen(command, env=environment, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    try:
        assert mission.stdout is not None
        eventually(lambda: len(running_programs()) == 4, 20, "four programs")
        mission.send_signal(number)
        output, _ = mission.communicate(timeout=20)
    finally:
        mission.kill()
        mission.wait()
    assert mission.returncode == code, output
    assert said in output
    assert not running_programs()
    assert not list(tmp_path.glob("mission-*"))


def test_where_it_cannot_write_is_said(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("a file\n")
    done = run_mission(tmp_path)
    assert done.returncode == 1
    assert done.stderr == f"The mission cannot write to {tmp_path}/out: File exists: choose another --output.\n"


@pytest.mark.parametrize("missing", ["rich", "matplotlib"])
def test_without_a_library_it_says_what_to_install(tmp_path: Path, missing: str) -> None:
    (tmp_path / f"{missing}.py").write_text(f"raise ModuleNotFoundError('No module', name={missing!r})\n")
    environment = dict(ENVIRONMENT, PYTHONPATH=f"{tmp_path}:{REPOSITORY}")
    command = [sys.executable, str(SCRIPT)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 1
    assert (
        done.stderr
        == f"The mission needs {missing}: pip install '.[demo]' in the checkout, or run it with make demo.\n"
    )


@pytest.mark.parametrize("speed", few_now(["9"], ["0", "fast", "nan"]))
def test_a_wrong_speed_is_refused_with_what_is_expected(tmp_path: Path, speed: str) -> None:
    done = run_mission(tmp_path, "--speed", speed)
    assert done.returncode == 2
    assert f"expected a number from 0.25 to 8, got '{speed}'" in done.stderr
