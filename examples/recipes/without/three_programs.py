"""A pipeline of three programs without rr_actors: nobody notices that one has ended, unless a loop looks."""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile

SOURCE = "while true; do i=$((i + 1)); echo $i >> raw; sleep 0.02; done"
FILTER = "tail -n +1 -F raw | sed -u s/^/measured:/ >> clean"
SINK = "tail -n +1 -F clean > shown"


def begin(folder: str, script: str) -> subprocess.Popen[str]:
    command = ["sh", "-c", f"echo begins; {script}"]
    program = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert program.stdout is not None
    program.stdout.readline()
    return program


def end(program: subprocess.Popen[str]) -> None:
    os.killpg(program.pid, signal.SIGTERM)  # the group: sh has started others. After kill -9 of this program: nobody
    program.wait()


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        programs = [begin(folder, script) for script in (SOURCE, FILTER, SINK)]
        try:
            os.killpg(programs[1].pid, signal.SIGKILL)
            programs[1].wait()  # a loop or a thread would look here, for each program
            programs[1] = begin(folder, FILTER)
            print("with a spare")
        finally:
            for program in programs:
                end(program)


if __name__ == "__main__":
    main()
