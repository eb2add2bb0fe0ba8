"""A system whose catalogs have something in every table, to be kept for the tests of later versions.

`python tests/support_old_catalogs.py FILE` runs it with the installed version, kills it, and packs its state directory
into FILE (.tar.gz). A part of what it has done is in its journals.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
from pathlib import Path

import rr_actors as rr


class Parts(rr.Manager):
    """Serves what nothing else is needed for."""

    @rr.server("part")
    def load_part(self, request: str) -> str:
        return f"{request} of {os.getpid()}"


class Wholes(rr.Manager):
    """Serves what has parts."""

    @rr.server("whole")
    def load_whole(self, request: str) -> str:
        self.registrar.load("parts/part", f"part of {request}")
        return request

    @load_whole.unload
    def unload_whole(self, request: str, response: str | None) -> None:
        if request == "stuck":
            raise OSError("it does not come off")


CHILDREN = [rr.ChildSpec(Parts, id="parts"), rr.ChildSpec(Wholes, id="wholes")]


def main(state_dir: str) -> None:
    """Leave catalogs in which something is loaded, joined, shared, ill, or not to be unloaded; then die."""
    system = rr.System(CHILDREN, state_dir=state_dir).start()
    app = system.open_registrar("app")
    first = app.load("wholes/whole", "first")
    app.load("parts/part", "part of first")
    stuck = app.load("wholes/whole", "stuck")
    with contextlib.suppress(rr.UnloadFailed):
        stuck.unload()
    system.registrar("wholes").send_status(first.resource_id, rr.Status(rr.State.WARNING, "loose"))
    time.sleep(3.0)  # the journals are in the tables
    app.load("wholes/whole", "second")  # a commit in each of the three journals
    time.sleep(0.08)
    pids = [child.pid for child in system.supervisor().which_children() if child.pid is not None]
    for pid in pids:
        os.kill(pid, signal.SIGKILL)
    os.kill(os.getpid(), signal.SIGKILL)


def make(file: Path) -> None:
    """Pack the catalogs that main() leaves."""
    with tempfile.TemporaryDirectory() as place:
        subprocess.run([sys.executable, __file__, "--leave", place], check=False)
        time.sleep(1.0)
        with tarfile.open(file, "w:gz") as archive:
            for path in sorted(Path(place).glob("*/catalog.*")):
                if not path.name.endswith("-shm"):
                    archive.add(path, arcname=str(path.relative_to(place)))


if __name__ == "__main__":
    if sys.argv[1] == "--leave":
        main(sys.argv[2])
    else:
        make(Path(sys.argv[1]))
