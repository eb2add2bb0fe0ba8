"""Checks in processes of their own: each has a time limit, and leaves nothing behind."""

from __future__ import annotations

import contextlib
import os
import selectors
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import IO

import msgspec

from rr_actors.base.folder import read_plain
from rr_actors.runtime.processes.lifeline import kill_group
from rr_actors.tools.learn.learn_exercises import Exercise
from rr_actors.tools.learn.scenes import Outcome

LIMIT_S = 30.0
"""The longest time of a check in seconds: then its process is killed, with all processes that it has started."""
_LOOK_S = 0.02  # between two looks at whether a program has ended
_AFTER_S = 10.0  # how long what was killed may take to end
_KEPT = 4000  # bytes of what a file prints


def check_file(exercise: Exercise, file: Path, limit_s: float = LIMIT_S) -> Outcome:
    """Check a learner's file, and return what was found. Blocks for `limit_s` seconds at most."""
    try:
        compile(read_plain(file), file.name, "exec")
    except SyntaxError as error:
        return _is_no_program(error, file)
    except OSError as error:
        got = error.strerror or str(error)
        return Outcome(False, "the file cannot be read", file.name, "a file that you can read", got)
    except (ValueError, RecursionError, MemoryError) as error:
        got = str(error) or type(error).__name__
        return Outcome(False, "the file is no Python program", file.name, "a Python program in UTF-8", got)
    with tempfile.TemporaryDirectory(prefix="rr-learn-") as place:
        return _run(exercise, file.resolve(), Path(place), limit_s)


def check_as_given(exercise: Exercise, limit_s: float = LIMIT_S) -> Outcome:
    """Check the file of an exercise as learners get it. Its lines answer the question."""
    with tempfile.TemporaryDirectory(prefix="rr-learn-") as place:
        file = Path(place, exercise.file_name)
        file.write_text(exercise.text, "utf-8")
        return check_file(exercise, file, limit_s)


def _is_no_program(error: SyntaxError, file: Path) -> Outcome:
    line = (error.text or "").rstrip()
    pointer = f"\n{' ' * (max(error.offset or 1, 1) - 1)}^" if line else ""
    where = f"line {error.lineno or 1} of {file.name}"
    return Outcome(
        False, "the file is no Python program yet", where, "valid Python", error.msg, picture=f"{line}{pointer}"
    )


def _run(exercise: Exercise, file: Path, place: Path, limit_s: float) -> Outcome:
    check, folder, outcome = place / "check.py", place / "folder", place / "outcome.json"
    check.write_text(exercise.check, "utf-8")
    folder.mkdir()
    program = subprocess.Popen(
        [sys.executable, "-m", "rr_actors.tools.learn", check, file, folder, outcome],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        cwd=folder,
        # A save within one second would go unseen: Python knows compiled files by whole seconds.
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        process_group=0,
    )
    assert program.stdin is not None
    assert program.stdout is not None
    printed = b""
    try:
        printed, is_late = _watched(program, program.stdout, time.monotonic() + limit_s)
    finally:
        kill_group(program.pid)
        program.wait()
        with contextlib.suppress(KeyboardInterrupt):
            printed = _read(program.stdout, time.monotonic() + _AFTER_S, printed)[0]  # until its children have ended
        program.stdin.close()
        program.stdout.close()
    found = _outcome(outcome, program.returncode, file, limit_s if is_late else None)
    found.printed = printed.decode(errors="replace")
    return found


def _watched(program: subprocess.Popen[bytes], output: IO[bytes], until: float) -> tuple[bytes, bool]:
    """Read what a program prints while it runs, until a time; return the last of it, and whether it still runs.

    The output may stay open after its end, as it is that of its children, too; or be closed before.
    """
    printed, is_over = b"", False
    while program.poll() is None:
        if time.monotonic() >= until:
            return printed, True
        if is_over:
            time.sleep(_LOOK_S)
        else:
            printed, is_over = _read(output, min(until, time.monotonic() + _LOOK_S), printed)
    return printed, False


def _read(output: IO[bytes], until: float, before: bytes) -> tuple[bytes, bool]:
    """Read to the end, or until a time; return the last of what was read, and whether it was the end."""
    with selectors.DefaultSelector() as selector:
        selector.register(output, selectors.EVENT_READ)
        while (left_s := until - time.monotonic()) > 0:
            if not selector.select(left_s):
                break
            data = os.read(output.fileno(), 65_536)
            if not data:
                return before, True
            before = (before + data)[-_KEPT:]
    return before, False


def _outcome(written: Path, code: int, file: Path, limit_s: float | None) -> Outcome:
    if limit_s is not None:
        expected = f"an end within {limit_s:g} s"
        return Outcome(False, "it did not end, and was ended", file.name, expected, "a loop, or a wait without a limit")
    try:
        return msgspec.json.decode(written.read_bytes(), type=Outcome)
    except (OSError, msgspec.MsgspecError):
        got = f"exit code {code}" if code >= 0 else f"signal {-code}"
        return Outcome(False, "the process ended before its check did", file.name, "no end of the whole process", got)
