"""What the tests of the managers share: the external programs of this test run."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Any

from rr_actors.managers import Programs
from rr_actors.managers.process_marks import VARIABLE, find_processes
from rr_actors.runtime.processes.control_groups import group_of

_MARK = "RR_ACTORS_TESTS"  # set in conftest.py, inherited by every process of the tests


def running_programs(resource_id: str = "") -> dict[int, str]:
    """Pids of all programs that run for these tests, with their allocations; of one resource, if it is named."""
    ours = find_processes(_MARK, os.environ[_MARK])
    return {pid: value for pid, value in find_processes(VARIABLE, resource_id).items() if pid in ours}


def group_of_program(pid: int) -> Path | None:
    """The control group that a program has been given; None if it has none."""
    group = group_of(pid)
    return group if group is not None and group.name.startswith("rr-") else None


class CrampedPrograms(Programs):
    """A program manager whose disk has no room for another program while the file `full` exists."""

    def __init__(self, full: str) -> None:
        super().__init__()
        self.full = Path(full)

    def on_start(self) -> None:
        real = os.mkdir

        def mkdir(path: Any, *args: Any, **options: Any) -> None:
            if self.full.exists() and Path(path).parent.name == "programs":
                raise OSError(errno.EDQUOT, os.strerror(errno.EDQUOT), str(path))
            real(path, *args, **options)

        os.mkdir = mkdir
