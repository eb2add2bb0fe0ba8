"""Control groups (version 2): directories of the kernel, in which processes are frozen together, and limits hold.

A program gets a group of its own where one can be made: below the group of the process that starts it, or below one
further up. A group whose limit on CPU or memory holds for that process is not left: else the program would escape it.
"""

from __future__ import annotations

import contextlib
import functools
import os
import time
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path

CONTROLLERS = {"cpu": "cpu", "memory_bytes": "memory"}
"""What can be limited, by the names that the usage of a program has; each with its controller."""

_PERIOD_US = 100_000
_LEAST_QUOTA_US = 1_000  # the kernel refuses less
_SETTLE_S = 1.0  # for a group whose processes all freeze, or have all just ended
_LOOK_S = 0.0002


class ControlGroup:
    """A group that may have been made; each method does nothing, or says so, where there is none."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def make(self, limits: Mapping[str, float]) -> dict[str, float]:
        """Make the group; return those of the limits that hold in it: "cpu" in CPUs, "memory_bytes".

        Raises:
            OSError: it cannot be made.
        """
        self.path.mkdir(exist_ok=True)
        return {what: amount for what, amount in limits.items() if self._limit(what, amount)}

    def _limit(self, what: str, amount: float) -> bool:
        controller = CONTROLLERS[what]
        text = str(int(amount))
        if what == "cpu":
            text = f"{max(int(amount * _PERIOD_US), _LEAST_QUOTA_US)} {_PERIOD_US}"
        try:
            if controller not in _words(self.path.parent / "cgroup.subtree_control"):
                (self.path.parent / "cgroup.subtree_control").write_text(f"+{controller}")
            (self.path / f"{controller}.max").write_text(text)
        except OSError:
            return False
        return True

    def pids(self) -> set[int]:
        """Return the processes in the group, and in those below it."""
        found: set[int] = set()
        for folder, _, _ in os.walk(self.path):
            found.update(map(int, _words(Path(folder, "cgroup.procs"))))
        return found

    def freeze(self, pid: int) -> bool:
        """Freeze the group, and return when all of it stands still; False if this process is not in it, or it cannot.

        Frozen processes can be killed by SIGKILL, and are moved by no other signal.
        """
        if pid not in self.pids() or not self._set_frozen("1"):
            return False
        deadline = time.monotonic() + _SETTLE_S
        while not self.is_frozen() and time.monotonic() < deadline:  # else a process is in the kernel, and freezes then
            time.sleep(_LOOK_S)
        return True

    def thaw(self) -> None:
        """Let the group go on."""
        self._set_frozen("0")

    def is_frozen(self) -> bool:
        """Return whether all processes of the group stand still."""
        return read_number(self.path / "cgroup.events", "frozen") == 1

    def remove(self) -> bool:
        """Remove the group with those below it; return whether it is gone. There must be no process in it."""
        deadline = time.monotonic() + _SETTLE_S
        while self.path.exists():
            with contextlib.suppress(OSError):  # a process is still ending
                for folder, _, _ in os.walk(self.path, topdown=False):
                    os.rmdir(folder)  # its files go with it
                return True
            if time.monotonic() > deadline:
                return False
            time.sleep(_LOOK_S)
        return True

    def _set_frozen(self, text: str) -> bool:
        try:
            (self.path / "cgroup.freeze").write_text(text)
        except OSError:
            return False
        return True


class ControlGroups:
    """The groups that can be made for programs of a process that is in the group `own`; None: there are none."""

    def __init__(self, own: Path | None, mounted: Path | None) -> None:
        self._own, self._mounted = own, mounted

    @classmethod
    def of_this_process(cls) -> ControlGroups:
        """Return those for programs that this process starts."""
        return cls(group_of(os.getpid()), mounted_at())

    def limits(self) -> list[str]:
        """Return what can be limited in a group, of "cpu" and "memory_bytes"."""
        offered = _offered(self._parent(CONTROLLERS))
        return [what for what, controller in CONTROLLERS.items() if controller in offered]

    def place(self, name: str, limits: Collection[str] = ()) -> ControlGroup | None:
        """Return the group of this name that is to be made, where most of these limits can be; None: nowhere."""
        parent = self._parent(limits)
        return None if parent is None else ControlGroup(parent / name)

    def _parent(self, limits: Collection[str]) -> Path | None:
        """Return the nearest group that can have groups with most of these limits; None: there is none."""
        wanted = {CONTROLLERS[what] for what in limits}
        allowed = [folder for folder in self._folders() if _can_have_groups(folder)]
        return max(allowed, key=lambda folder: len(wanted & _offered(folder)), default=None)

    def _folders(self) -> Iterator[Path]:
        """Return the own group and those above it, as far as no limit that holds for this process is left."""
        for folder in () if self._own is None else (self._own, *self._own.parents):
            yield folder
            limited = [_read(folder / file).split()[:1] for file in ("cpu.max", "memory.max")]
            if folder == self._mounted or any(first not in ([], ["max"]) for first in limited):
                return


def mounted_at() -> Path | None:
    """Return where control groups of version 2 are mounted; None: nowhere."""
    return _mount()[0]


def group_of(pid: int) -> Path | None:
    """Return the directory of a process's control group; None if there is none, or it is not mounted here."""
    mounted, root = _mount()
    for line in _read(Path(f"/proc/{pid}/cgroup")).splitlines():
        if mounted is not None and line.startswith("0::/"):
            path = "/" + line.removeprefix("0::/")
            found = mounted / os.path.relpath(path, root)
            return found if not path.startswith("/..") and found.is_dir() else None
    return None


def read_number(file: Path, *key: str) -> int:
    """Return the number in a control group's file, behind `key` if there are several; 0 if it is not there."""
    for line in _read(file).splitlines():
        *before, number = line.split()
        if before == list(key) and number.isdigit():
            return int(number)
    return 0


@functools.cache
def _mount() -> tuple[Path | None, str]:
    """Return where they are mounted, and which of the groups is there."""
    for line in _read(Path("/proc/self/mountinfo")).splitlines():
        mount, _, kind = line.partition(" - ")
        if kind.startswith("cgroup2 "):
            root, point = mount.split()[3:5]
            return Path(point), root
    return None, "/"


def _can_have_groups(folder: Path) -> bool:
    return os.access(folder, os.W_OK) and os.access(folder / "cgroup.procs", os.W_OK)


def _offered(folder: Path | None) -> set[str]:
    """Return the controllers that groups below this one have, or can have.

    They can be switched on where no process is in the group itself, and in the topmost one, which has no type.
    """
    if folder is None:
        return set()
    offered = _words(folder / "cgroup.subtree_control")
    can_switch = os.access(folder / "cgroup.subtree_control", os.W_OK)
    if can_switch and not (_words(folder / "cgroup.procs") and (folder / "cgroup.type").exists()):
        offered |= _words(folder / "cgroup.controllers")
    return offered


def _words(file: Path) -> set[str]:
    return set(_read(file).split())


def _read(file: Path) -> str:
    try:
        return file.read_text()
    except OSError:  # there is none, or it has gone meanwhile
        return ""
