"""The output of external programs: in a file, as log lines of the manager, or in the manager's own output."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors.managers import Programs, Ready, RunProgram
from rr_actors.managers.program_directory import OutputLog
from support import TEST_PATHS, eventually
from support_cli import run_cli

Start = Callable[..., rr.System]
SAYS = RunProgram("sh", ("-c", "for n in 1 2 3; do echo line $n; done; exec sleep 600"), ready=Ready(line="line 3"))


def spec(output: str = "file") -> rr.ChildSpec:
    return rr.ChildSpec(Programs, id="programs", kwargs={"output": output}, placement="thread")


def test_the_output_of_a_program_is_shown_by_its_id_or_name(rr_system: Start) -> None:
    system = rr_system(spec())
    with system.open_registrar("app").load("programs/program", SAYS) as program:
        lines = ["line 1", "line 2", "line 3"]
        assert system.ref("programs").proxy().output(program.resource_id).get(timeout=30) == lines
        said = run_cli("logs", program.resource_id, "--lines", "2", "--state", system.state_dir)
        assert said.stdout.splitlines() == lines[1:], said.stderr
        wrong = run_cli("logs", program.resource_id, "--follow", "--state", system.state_dir)
        assert (wrong.returncode, "expected a child for --follow" in wrong.stderr) == (2, True)
        for lines in (0, -5, "all", True):
            with pytest.raises(rr.UsageError, match="output: lines: expected a whole number of at least 1, got"):
                system.ref("programs").proxy().output(program.resource_id, lines).get(timeout=30)
        id = program.resource_id
    with pytest.raises(rr.NotFound, match=f"no program '{id}': expected one of none"):
        system.ref("programs").proxy().output(id).get(timeout=30)
    assert run_cli("logs", id, "--state", system.state_dir).returncode == 2


def test_the_lines_of_a_program_are_logged(rr_system: Start, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    system = rr_system(spec("log"))
    with system.open_registrar("app").load("programs/program", SAYS):
        assert eventually(lambda: "sh: line 3" in caplog.messages)
    assert [line for line in caplog.messages if line.startswith("sh: ")] == ["sh: line 1", "sh: line 2", "sh: line 3"]


def test_a_long_output_is_followed_when_its_file_begins_anew(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    file, log = tmp_path / "output.log", OutputLog()
    file.write_text("before\n")
    log.follow("a", "it", file, from_start=False)
    with file.open("a") as more:
        more.write("one\ntw")
    assert eventually(lambda: "it: one" in caplog.messages)
    with file.open("a") as more:
        more.write("o\n")
    file.rename(tmp_path / "output.old")
    file.write_text("".join(f"{number}\n" for number in range(150)))
    assert eventually(lambda: any(line.endswith(f"lines more, in {file}") for line in caplog.messages))
    with file.open("a") as more:
        more.write("the end")
    log.leave("a")
    log.close()
    assert caplog.messages[:2] == ["it: one", "it: two"]
    assert caplog.messages[-1] == "it: the end"
    assert "it: before" not in caplog.messages


def test_what_comes_just_before_the_file_begins_anew_is_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.INFO)
    file, log, read = tmp_path / "output.log", OutputLog(), os.read
    file.write_text("one\n")
    inode = file.stat().st_ino

    def read_before_more_comes(fd: int, most: int) -> bytes:
        data = read(fd, most)
        if not data and file.stat().st_ino == inode == os.fstat(fd).st_ino:
            with file.open("a") as more:
                more.write("two\n")
            file.rename(tmp_path / "output.old")
            file.write_text("three\n")
        return data

    monkeypatch.setattr(os, "read", read_before_more_comes)
    log.follow("a", "it", file, from_start=True)
    assert eventually(lambda: "it: three" in caplog.messages)
    log.close()
    assert caplog.messages == ["it: one", "it: two", "it: three"]


def test_nothing_waits_for_output_when_no_program_runs(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    file, log = tmp_path / "output.log", OutputLog()
    file.write_text("one\n")
    for key in ("a", "b"):
        log.follow(key, key, file, from_start=True)
        log.leave(key)
        assert caplog.messages.pop() == f"{key}: one"
        assert eventually(lambda: "rr-program-output" not in [thread.name for thread in threading.enumerate()])
    log.close()


PROGRAM = """
import sys
import rr_actors as rr
from rr_actors.managers import Programs, Ready, RunProgram

if __name__ == "__main__":
    says = RunProgram("sh", ("-c", "echo one; echo two >&2; exec sleep 600"), ready=Ready(line="two"))
    spec = rr.ChildSpec(Programs, id="programs", kwargs={"output": "inherit"})
    with rr.System([spec], state_dir=sys.argv[1]) as system:
        system.open_registrar("app").load("programs/program", says).unload()
"""


def test_a_program_inherits_the_output_of_its_manager(tmp_path: Path) -> None:
    Path(tmp_path, "main.py").write_text(PROGRAM)
    command = (sys.executable, tmp_path / "main.py", tmp_path / "state")
    environment = os.environ | {"PYTHONPATH": TEST_PATHS}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=50)
    assert (done.returncode, done.stdout) == (0, "one\ntwo\n"), done.stderr


def test_an_output_that_is_none_is_refused() -> None:
    with pytest.raises(rr.UsageError, match="output: expected 'file', 'log' or 'inherit', got 'journal'"):
        Programs(output="journal")  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
