"""A program that is ended by a signal while its system starts: no other process than its own says anything."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from support import eventually

LIMIT_S = 30.0
TRIES = 12
PROGRAM = """
import signal, sys
import rr_actors as rr


class Cameras(rr.Manager):
    @rr.server("camera")
    def open_camera(self, device: str) -> str:
        return device


def leave(*_):
    sys.exit(3)


if sys.argv[2] == "leaving":
    signal.signal(signal.SIGTERM, leave)
print("begins", flush=True)
with rr.System([rr.ChildSpec(Cameras, id=f"cameras{n}") for n in range(4)], state_dir=sys.argv[1]):
    print("started", flush=True)
    signal.pause()
"""


def marked(mark: str) -> list[int]:
    """The processes that have this mark in their environment."""
    wanted = f"RR_TRY={mark}".encode()
    found: list[int] = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if wanted in (entry / "environ").read_bytes().split(b"\0"):
                found.append(int(entry.name))
        except OSError:
            continue
    return found


def said_when_signalled(directory: Path, number: signal.Signals, how: str, delay_s: float) -> tuple[int, str]:
    """Run the program as a terminal does, in a process group; end it after so long; its exit code, what all said."""
    directory.mkdir()
    mark = os.urandom(6).hex()
    with (directory / "said").open("w+") as said:
        program = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, str(directory / "state"), how],
            stdout=subprocess.PIPE,
            stderr=said,
            text=True,
            process_group=0,
            env={**os.environ, "RR_TRY": mark},
        )
        try:
            assert program.stdout is not None
            assert program.stdout.readline() == "begins\n"
            time.sleep(delay_s)
            os.killpg(program.pid, number)
            code = program.wait(LIMIT_S)
            eventually(lambda: not marked(mark), what="end of all processes")
        finally:
            program.kill()
            program.wait()
            program.communicate()
            # A program that dies leaves its sockets to the next start.
            shutil.rmtree(directory / "state", ignore_errors=True)
        said.seek(0)
        return code, said.read()


def tries(directory: Path, number: signal.Signals, how: str) -> list[tuple[int, str]]:
    """At moments that are spread over a start, and a little beyond."""
    directory.mkdir()
    with ThreadPoolExecutor(4) as several:
        return list(
            several.map(lambda n: said_when_signalled(directory / str(n), number, how, n * 0.6 / TRIES), range(TRIES))
        )


@pytest.mark.slow
@pytest.mark.parametrize(("how", "code"), [("dying", -signal.SIGTERM), ("leaving", 3)])
def test_nothing_is_said_when_a_start_is_ended_by_sigterm(tmp_path: Path, how: str, code: int) -> None:
    assert tries(tmp_path / "tries", signal.SIGTERM, how) == [(code, "")] * TRIES


@pytest.mark.slow
def test_only_the_program_itself_says_that_it_was_interrupted(tmp_path: Path) -> None:
    for code, said in tries(tmp_path / "tries", signal.SIGINT, "dying"):
        assert code == -signal.SIGINT
        assert said.startswith("Traceback (most recent call last):\n"), said  # perhaps of the interpreter's own start
        assert said.count("Traceback") == 1, said
        assert said.endswith("\nKeyboardInterrupt\n")
