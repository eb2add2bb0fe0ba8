"""`rr-actors learn`: the learner's directory, the session at a terminal, checks that do not end, a class, bad input."""

from __future__ import annotations

import json
import os
import re
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from rr_actors.base.errors import UsageError
from rr_actors.tools.learn.check_process import check_file
from rr_actors.tools.learn.learn_exercises import all_exercises
from rr_actors.tools.learn.learn_progress import LearnerFolder
from rr_actors.tools.module_watcher import SavedFile
from support import eventually, lives
from support_cli import run_cli
from support_tmux import Tmux, needs_tmux, terminal

FIRST, SECOND = all_exercises()[:2]
COUNT = len(all_exercises())


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A learner's directory, as the first call makes it."""
    return LearnerFolder.begin(tmp_path / "anna").path


# -- the directory -----------------------------------------------------------------------------------------------------


def test_the_first_call_makes_the_files_and_checks_once_without_a_terminal(tmp_path: Path) -> None:
    ran = run_cli("learn", tmp_path / "new" / "anna")

    assert ran.returncode == 1
    assert f"✗ {FIRST.file_name}: the scale went on" in ran.stdout
    assert "expected  it ends, and starts again" in ran.stdout
    names = sorted(path.name for path in (tmp_path / "new" / "anna").iterdir())
    assert names == [*(one.file_name for one in all_exercises()), "progress.json"]


def test_a_mended_file_passes_and_the_next_call_goes_on_with_the_next_exercise(folder: Path) -> None:
    (folder / FIRST.file_name).write_text(FIRST.solution)

    done = run_cli("learn", folder, "--check", FIRST.name)
    assert (done.returncode, f"✓ {FIRST.file_name} is mended" in done.stdout) == (0, True), done
    went_on = run_cli("learn", folder)
    assert (went_on.returncode, f"✗ {SECOND.file_name}" in went_on.stdout) == (1, True)
    rows = run_cli("learn", folder, "--list").stdout.splitlines()
    assert re.search(r"^ *1  let_it_crash .* done$", rows[1])
    assert re.search(r"^ *2  strategies .* here +1", rows[2])


@pytest.mark.parametrize("name", [FIRST.name, "1", FIRST.file_name])
def test_hints_come_one_at_a_time_and_are_counted(folder: Path, name: str) -> None:
    said = [run_cli("learn", folder, "--hint", name).stdout for _ in range(4)]

    assert [text[:12] for text in said] == [f"hint {number} of 3:" for number in (1, 2, 3, 3)]
    assert " ".join(said[2].split()).endswith(FIRST.declared.hints[2])
    assert "3 of 3" in run_cli("learn", folder, "--list").stdout


def test_a_deleted_file_is_named_and_comes_back(folder: Path) -> None:
    (folder / SECOND.file_name).unlink()

    assert "gone: --reset restores it" in run_cli("learn", folder, "--list").stdout
    checked = run_cli("learn", folder, "--check", SECOND.name)
    assert (checked.returncode, f"--reset {SECOND.name} restores it" in checked.stdout) == (1, True)
    assert run_cli("learn", folder, "--reset", SECOND.name).returncode == 0
    assert (folder / SECOND.file_name).read_text() == SECOND.text


def test_a_reset_keeps_the_learners_text_beside_the_file(folder: Path) -> None:
    (folder / FIRST.file_name).write_text("mine = 1\n")

    ran = run_cli("learn", folder, "--reset", FIRST.name)
    assert f"your text is in {FIRST.file_name}.before" in ran.stdout
    assert (folder / f"{FIRST.file_name}.before").read_text() == "mine = 1\n"
    assert (folder / FIRST.file_name).read_text() == FIRST.text


def test_a_text_is_kept_however_often_the_file_is_reset(folder: Path) -> None:
    learner, file = LearnerFolder.open(folder), folder / FIRST.file_name

    assert learner.reset(FIRST) is None  # there is nothing to keep
    for number, text in enumerate(("first = 1\n", "second = 2\n", "third = 3\n")):
        file.write_text(text)
        assert [path and path.name for path in (learner.reset(FIRST), learner.reset(FIRST))] == [
            f"{file.name}.before{number + 1 if number else ''}",
            None,
        ]
    texts = [(folder / f"{file.name}.before{number}").read_text() for number in ("", 2, 3)]
    assert texts == ["first = 1\n", "second = 2\n", "third = 3\n"]


def test_a_directory_whose_making_was_killed_is_made_to_the_end(folder: Path) -> None:
    (folder / ".progress.json.4711").write_text("{")
    for one in all_exercises()[3:]:
        (folder / one.file_name).unlink()
    LearnerFolder.begin(folder)
    assert all((folder / one.file_name).read_text() == one.text for one in all_exercises())

    shutil.rmtree(folder)
    folder.mkdir()
    (folder / ".progress.json.4711").write_text("{")
    assert LearnerFolder.begin(folder).done() == 0


# -- files that are wrong ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "what", "where", "got"),
    [
        ("def tree(:\n", "the file is no Python program yet", f"line 1 of {FIRST.file_name}", "invalid syntax"),
        ("import nothing_at_all\n", "the file cannot be imported", "line 1 of", "ModuleNotFoundError: No module named"),
        ("", "Scale is missing in the file", FIRST.file_name, "none"),
        ("import os\nos._exit(7)\n", "the process ended before its check did", FIRST.file_name, "exit code 7"),
        ("import sys\nsys.exit(0)\n", "the file cannot be imported", "line 2 of", "SystemExit: 0"),
        (b"\xff = 1\n", "the file is no Python program", f"line 1 of {FIRST.file_name}", ""),
    ],
)
def test_a_file_that_cannot_be_checked_is_named_with_its_line(
    folder: Path, text: str | bytes, what: str, where: str, got: str
) -> None:
    (folder / FIRST.file_name).write_bytes(text if isinstance(text, bytes) else text.encode())

    ran = run_cli("learn", folder, "--check", FIRST.name)
    assert ran.returncode == 1
    assert f"✗ {FIRST.file_name}: {what}" in ran.stdout
    assert f"where     {where}" in ran.stdout
    assert got in ran.stdout


@pytest.mark.parametrize(
    ("make", "got"), [(os.mkfifo, "a pipe, and no regular file"), (Path.mkdir, "Is a directory")], ids=["pipe", "dir"]
)
def test_what_is_no_file_is_named(make: Callable[[Path], None], got: str, folder: Path) -> None:
    (folder / FIRST.file_name).unlink()
    make(folder / FIRST.file_name)

    ran = run_cli("learn", folder, "--check", FIRST.name)
    assert ran.returncode == 1
    assert f"✗ {FIRST.file_name}: the file cannot be read" in ran.stdout
    assert f"got       {got}" in ran.stdout


def test_a_syntax_error_shows_the_line_and_the_place(folder: Path) -> None:
    (folder / FIRST.file_name).write_text("x = 1\ny = = 2\n")

    lines = run_cli("learn", folder, "--check", FIRST.name).stdout.splitlines()
    assert lines[1:3] == ["  y = = 2", "      ^"]


ENDLESS = """
import os, subprocess, sys
import rr_actors as rr

class Scale(rr.Actor):
    def on_start(self):
        child = subprocess.Popen(["sleep", "600"])
        print("pids", os.getpid(), child.pid, flush=True)
        while True:
            pass
"""


def test_an_exercise_that_does_not_end_is_ended_and_leaves_no_process(folder: Path) -> None:
    (folder / FIRST.file_name).write_text(ENDLESS)

    began = time.monotonic()
    ran = run_cli("learn", folder, "--check", FIRST.name, "--limit", "8s")
    assert (ran.returncode, "it did not end, and was ended" in ran.stdout) == (1, True), ran.stdout
    assert "expected  an end within 8 s" in ran.stdout
    assert time.monotonic() - began < 40
    (pids,) = re.findall(r"pids (\d+) (\d+)", ran.stdout)
    eventually(lambda: not any(lives(int(pid)) for pid in pids), what=f"the end of {pids}")


@pytest.mark.parametrize(
    "text", ["import subprocess\nsubprocess.Popen(['sleep', '600'])\n", "import os\nos.close(1), os.close(2)\n"]
)
def test_a_check_is_over_when_its_process_is(text: str, folder: Path) -> None:
    (folder / FIRST.file_name).write_text(f"{FIRST.solution}\n{text}")

    found = check_file(FIRST, folder / FIRST.file_name, limit_s=50.0)
    assert (found.passed, found.what) == (True, "")


def test_what_a_file_prints_without_end_is_cut(folder: Path) -> None:
    (folder / FIRST.file_name).write_text("while True:\n    print('again ' * 100)\n")

    ran = run_cli("learn", folder, "--check", FIRST.name, "--limit", "4s")
    assert (ran.returncode, "it did not end, and was ended" in ran.stdout) == (1, True)
    assert len(ran.stdout) < 10_000


# -- bad input ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--check", "strateges"], "--check: expected the name or number of an exercise"),
        (["--hint", "0"], "--hint: expected the name or number of an exercise"),
        (["--reset", "99"], "--reset: expected the name or number of an exercise"),
        (["--list", "--hint", "1"], "learn: expected one of --list, --hint, got 2 of them"),
        (["--limit", "soon"], "--limit: expected a time"),
        (["--limit", "0"], "--limit: expected more than 0 s, got 0 s"),
        (["--watch"], "learn: expected --class with --watch, got none"),
    ],
)
def test_a_wrong_call_is_refused(folder: Path, options: list[str], said: str) -> None:
    ran = run_cli("learn", folder, *options)
    assert (ran.returncode, said in ran.stderr) == (2, True), ran.stderr


def test_what_is_no_learners_directory_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "file").write_text("")
    for path, got in (
        (tmp_path, "a directory with other files, and without progress.json"),
        (tmp_path / "file", "a file"),
    ):
        ran = run_cli("learn", path)
        assert (ran.returncode, ran.stderr.count("\n")) == (2, 1)
        assert f"learn: {path}: expected a learner's directory, or the name of a new one, got {got}" in ran.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "notes.txt"]
    assert "got nothing of that name" in run_cli("learn", tmp_path / "none", "--list").stderr
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize(
    ("text", "got"),
    [
        ("{", "damaged"),
        ('{"version": 2, "learner": "a"}', "of version 2"),
        ('{"learner": "a"}', "version"),
        ("[]", "damaged"),
    ],
)
def test_progress_that_is_damaged_is_named(folder: Path, text: str, got: str) -> None:
    (folder / "progress.json").write_text(text)

    ran = run_cli("learn", folder, "--list")
    assert (ran.returncode, f"learn: {folder}: " in ran.stderr, got in ran.stderr) == (2, True, True), ran.stderr


def test_a_directory_that_cannot_be_written_is_named() -> None:
    """Nobody, not even root, makes a directory there."""
    ran = run_cli("learn", "/proc/self/learner")
    assert ran.returncode == 2
    assert "learn: /proc/self/learner: expected a directory that you can write, got: " in ran.stderr


def test_progress_that_cannot_be_written_is_named_and_the_old_one_stays(folder: Path) -> None:
    learner = LearnerFolder.open(folder)
    before = (folder / "progress.json").read_bytes()
    (folder / f".progress.json.{os.getpid()}").mkdir()  # in the way of the new file, for root as well
    with pytest.raises(UsageError, match=f"{folder}: expected a directory that you can write, got: Is a directory"):
        learner.take_hint(FIRST)
    assert (folder / "progress.json").read_bytes() == before


# -- a class -----------------------------------------------------------------------------------------------------------


def test_a_class_is_a_table_with_those_who_are_behind_first(folder: Path, tmp_path: Path) -> None:
    ahead, broken = tmp_path / "ben", tmp_path / "carl"
    shutil.copytree(folder, ahead)
    shutil.copytree(folder, broken)
    (broken / "progress.json").write_text("{")
    (tmp_path / "notes").mkdir()
    progress = json.loads((ahead / "progress.json").read_text())
    progress["learner"] = "ben"
    now = time.time()
    progress["steps"] = {
        FIRST.name: {"began_at": now - 900, "done_at": now - 600, "hints": 3, "has_read_solution": True},
        SECOND.name: {"began_at": now - 600, "tries": 4, "hints": 2},
    }
    (ahead / "progress.json").write_text(json.dumps(progress))

    ran = run_cli("learn", "--class", tmp_path)
    head, first, second = ran.stdout.splitlines()
    assert head.split() == ["learner", "directory", "done", "at", "since", "failed", "hints", "solutions"]
    assert re.search(rf"anna +0 of {COUNT}  1 let_it_crash$", first)
    assert re.search(rf"^ben +ben +1 of {COUNT}  2 strategies +10 min +4 +2 +1$", second)
    assert f"learn: {broken}: " in ran.stderr
    assert run_cli("learn", "--class", ahead, folder).stdout.splitlines() == [head, first, second]


def test_a_class_without_learners_is_an_error(tmp_path: Path) -> None:
    for path, got in ((tmp_path, "got none with a progress.json"), (tmp_path / "none", "got: No such file")):
        ran = run_cli("learn", "--class", path)
        assert (ran.returncode, got in ran.stderr) == (2, True)


# -- at a terminal -----------------------------------------------------------------------------------------------------


@pytest.fixture
def tmux(tmp_path: Path) -> Iterator[Tmux]:
    """`rr-actors learn` in a real terminal."""
    with terminal(tmp_path, "learn", str(tmp_path / "anna"), columns=90, lines=60, then="stty -a; ") as tmux:
        yield tmux


@pytest.mark.timeout(240)
@needs_tmux
def test_a_learner_answers_takes_a_hint_mends_the_file_and_goes_on(tmux: Tmux, tmp_path: Path) -> None:
    file = tmp_path / "anna" / FIRST.file_name

    def shows(*texts: str) -> None:
        def seen() -> bool:
            screen = " ".join(tmux("capture-pane", "-p").split())  # long lines are wrapped
            return all(text in screen for text in texts)

        eventually(seen, 60.0, repr(texts))

    shows(f"1 of {COUNT}: {FIRST.title}", "Press 1 to 3")
    tmux("send-keys", "1")
    shows("Not quite. You said: 15, the mean of both numbers. It was: 10, a mean of three.")
    shows(f"✗ {FIRST.file_name}: the scale went on", "It is checked when you save it.")
    tmux("send-keys", "h")
    shows("hint 1 of 3:")
    tmux("send-keys", "s")
    shows("Have you tried to let the error leave on_receive? And there are 2 more hints", "y/N")
    tmux("send-keys", "n")
    shows("Good: try it.")
    tmux("send-keys", "s", "y")
    shows('- print("cannot weigh", message)')
    file.write_text("x = = 1\n")
    shows("the file is no Python program yet")
    file.unlink()
    tmux("send-keys", "c")
    shows(f"{FIRST.file_name} is gone")
    tmux("send-keys", "r")
    shows(f"{FIRST.file_name} is as it was given")
    file.write_text(FIRST.solution)
    shows(f"✓ {FIRST.file_name} is mended.", "n next exercise")
    tmux("send-keys", "n")
    shows(f"2 of {COUNT}: {SECOND.title}", "Press 1 to")
    tmux("send-keys", "q")
    shows(f"1 of {COUNT} are done. Go on with: rr-actors learn ", "exit code 0")
    shows(" icanon", " echo ")  # the terminal is as it was
    steps = json.loads((tmp_path / "anna" / "progress.json").read_text())["steps"]
    step = steps[FIRST.name]
    assert (step["hints"], step["has_read_solution"]) == (1, True)
    assert step["answer"] == "15, the mean of both numbers"
    assert step["tries"] >= 2


@pytest.mark.timeout(120)
@needs_tmux
def test_ctrl_c_leaves_the_terminal_as_it_was(tmux: Tmux) -> None:
    eventually(lambda: "Press 1 to 3" in tmux("capture-pane", "-p"), 60.0)
    tmux("send-keys", "C-c")
    eventually(lambda: " icanon" in tmux("capture-pane", "-p"), 60.0)


SLOW = """
import pathlib, time
pathlib.Path({began!r}).touch()
while not pathlib.Path({ends!r}).exists():
    time.sleep(0.01)
"""


@pytest.mark.timeout(120)
@needs_tmux
def test_a_save_during_the_first_check_is_checked_as_well(folder: Path, tmp_path: Path) -> None:
    learner, file = LearnerFolder.open(folder), folder / FIRST.file_name
    learner.step(FIRST).answer = next(iter(FIRST.question.answers))
    learner.save()
    began, ends = tmp_path / "began", tmp_path / "ends"
    file.write_text(SLOW.format(began=str(began), ends=str(ends)))

    with terminal(tmp_path, "learn", str(folder), columns=90, lines=60) as tmux:
        eventually(began.exists, 60.0)
        file.write_text(FIRST.solution)
        ends.touch()
        eventually(lambda: f"✓ {FIRST.file_name} is mended." in tmux("capture-pane", "-p"), 60.0)


def test_a_save_is_seen_when_the_file_is_whole(tmp_path: Path) -> None:
    file = tmp_path / "one.py"
    file.write_text("a")
    saved = SavedFile(file)
    assert not saved.look()
    file.write_text("abc")
    assert not saved.look()  # it may be written at this moment
    file.write_text("abcd")
    assert not saved.look()
    assert saved.look()
    assert not saved.look()
    file.unlink()
    assert not saved.look()
    file.write_text("abc")
    assert [saved.look(), saved.look(), saved.look()] == [False, True, False]
