"""breakpoint() in a manager's process: the debugger has the terminal of the program, and the manager lives on."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from support import REPOSITORY

LIMIT_S = 30.0
PROGRAM = """
import os, sys, threading
import rr_actors as rr

class Cameras(rr.Manager):
    @rr.server("camera")
    def open_camera(self, device: str) -> str:
        topic = "/images/" + device
        breakpoint()
        return topic + f" {os.getpid()}"

if __name__ == "__main__":
    ids, options = sys.argv[1].split(","), {"heartbeat_s": 1.0}
    if "thread" in sys.argv:
        options = {"placement": "thread"}
    with rr.System([rr.ChildSpec(Cameras, id=id, **options) for id in ids]) as system:
        pids = {child.pid for child in system.supervisor().which_children()}
        app = system.open_registrar("app")
        if "thread" in sys.argv:
            print("loaded", app.load(f"{ids[0]}/camera", "front", timeout_s=None).response)
            sys.exit()
        futures = [app.load(f"{id}/camera", id, timeout_s=None, block=False) for id in ids]
        for future in futures:
            try:
                topic, pid = future.get().response.split()
                print("loaded", topic, int(pid) in pids)
            except rr.LoadFailed as error:
                print("failed", error)
"""


class Session:
    """A program at a terminal of its own, and what a person there reads and writes."""

    def __init__(self, place: Path, *arguments: str) -> None:
        program = place / "program.py"
        program.write_text(PROGRAM)
        self.terminal, theirs = pty.openpty()
        self.said = ""  # and not read yet
        self.all_said = ""
        self.process = subprocess.Popen(
            [sys.executable, str(program), *arguments],
            cwd=place,
            env={**os.environ, "PYTHONPATH": str(REPOSITORY), "TERM": "dumb"},
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),  # it controls the new session
        )
        os.close(theirs)

    def _read(self, deadline: float, wanted: str) -> str:
        """What is said next; nothing: it has ended."""
        ready, _, _ = select.select([self.terminal], [], [], max(0.0, deadline - time.monotonic()))
        assert ready, f"not said: {wanted!r}, but {self.said!r}"
        try:
            read = os.read(self.terminal, 65536).decode()
        except OSError:  # how a terminal ends
            read = ""
        self.said += read
        self.all_said += read
        return read

    def read_until(self, text: str) -> str:
        """What was said up to the text; it is gone from what is read next."""
        deadline = time.monotonic() + LIMIT_S
        while text not in self.said:
            assert self._read(deadline, text), f"ended without {text!r}: {self.said!r}"
        before, _, self.said = self.said.partition(text)
        return before

    def read_all(self) -> str:
        """What it has said from its beginning to its end."""
        deadline = time.monotonic() + LIMIT_S
        while self._read(deadline, "the end"):
            pass
        return self.all_said

    def write(self, text: str) -> None:
        os.write(self.terminal, text.encode())

    def end(self) -> int:
        code = self.process.wait(LIMIT_S)
        os.close(self.terminal)
        return code


@pytest.fixture
def sessions() -> Iterator[list[Session]]:
    begun: list[Session] = []
    yield begun
    for session in begun:
        if session.process.poll() is None:
            session.process.kill()
            session.process.wait()


def begin(sessions: list[Session], place: Path, *arguments: str) -> Session:
    session = Session(place, *arguments)
    sessions.append(session)
    return session


def test_the_debugger_asks_at_the_terminal_and_the_heartbeat_goes_on(sessions: list[Session], tmp_path: Path) -> None:
    session = begin(sessions, tmp_path, "cameras")
    assert "open_camera()" in session.read_until("(Pdb cameras) ")
    began = time.monotonic()
    while time.monotonic() < began + 2.4:  # longer than two heartbeats: it answers all the time
        session.write("p topic.upper()\n")
        session.read_until("'/IMAGES/CAMERAS'")
        session.read_until("(Pdb cameras) ")
    session.write("c\n")
    session.read_until("loaded /images/cameras True")  # in the process that was there before
    assert session.end() == 0


@pytest.mark.slow
def test_ctrl_c_at_the_debugger_ends_neither_the_manager_nor_the_program(
    sessions: list[Session], tmp_path: Path
) -> None:
    session = begin(sessions, tmp_path, "cameras")
    session.read_until("(Pdb cameras) ")
    session.write("\x03")
    session.write("p 6 * 7\n")
    session.read_until("42")
    session.write("c\n")
    session.read_until("loaded /images/cameras True")
    assert session.end() == 0


@pytest.mark.slow
def test_one_manager_asks_after_the_other(sessions: list[Session], tmp_path: Path) -> None:
    session = begin(sessions, tmp_path, "left,right")
    for _ in range(2):
        session.read_until("(Pdb ")
        name = session.read_until(") ")
        session.write("p topic\n")
        session.read_until(f"'/images/{name}'")
        session.read_until(f"(Pdb {name}) ")
        session.write("c\n")
    said = session.read_all()  # one may have been loaded before the other asked
    assert said.count("loaded /images/left True") == said.count("loaded /images/right True") == 1
    assert session.end() == 0


@pytest.mark.slow
def test_to_quit_the_debugger_fails_the_load(sessions: list[Session], tmp_path: Path) -> None:
    session = begin(sessions, tmp_path, "cameras")
    session.read_until("(Pdb cameras) ")
    session.write("q\n")
    assert "failed" in session.read_until("BdbQuit")
    assert session.end() == 0


def test_a_manager_in_a_thread_has_pythons_own_debugger(sessions: list[Session], tmp_path: Path) -> None:
    session = begin(sessions, tmp_path, "cameras", "thread")
    session.read_until("(Pdb) ")
    session.write("p topic\n")
    session.read_until("'/images/front'")
    session.write("c\n")
    session.read_until("loaded /images/front")
    assert session.end() == 0


@pytest.mark.parametrize(("variable", "said"), [("", "there is no terminal to ask at, so it goes on"), ("0", "")])
def test_without_a_terminal_the_callback_goes_on(tmp_path: Path, variable: str, said: str) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    if variable:
        environment["PYTHONBREAKPOINT"] = variable
    ran = subprocess.run(
        [sys.executable, program, "cameras"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        start_new_session=True,
        check=False,
    )
    assert ran.stdout == "loaded /images/cameras True\n"
    assert said in ran.stderr
    assert bool(said) == bool(ran.stderr)
