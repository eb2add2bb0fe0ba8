"""Home: one external program's directory, as its manager sees it. shim.py lists the files in it."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Generator
from pathlib import Path
from typing import Any, NotRequired, TypedDict, cast

import msgspec

from rr_actors.base.folder import Folder
from rr_actors.base.reporting.log import Log
from rr_actors.managers.exit_watcher import ProcessHandle
from rr_actors.managers.process_marks import kill_allocation
from rr_actors.runtime.processes.control_groups import ControlGroup

logger = Log("rr_actors.managers.program_directory")

_LINE_LIMIT = 500  # characters
_ROOM_BYTES = 4096  # as much as a state takes
OUTPUT = "output.log"
_RETIRED = ".retired-"


class _End(TypedDict, total=False):
    code: int
    signal: int


class _State(TypedDict):
    """The state that the shim writes; a process is [pid, start ticks]."""

    shim: tuple[int, int]
    grace_s: float
    ready: bool
    program: NotRequired[tuple[int, int]]
    failed: NotRequired[str]
    errno: NotRequired[int]
    stopped: NotRequired[bool]
    ended: NotRequired[_End]


class Home:
    """The directory of one program. The last part of its path is the program's key. It need not exist."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.key = path.name

    def exists(self) -> bool:
        """Return whether the directory exists."""
        return self.path.exists()

    def make(self) -> None:
        """Make the directory, with a lock file that no process holds."""
        while True:
            self.path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with contextlib.suppress(FileNotFoundError):  # the end of the last other program has removed the parent
                self.path.mkdir(mode=0o700)
                break
        (self.path / "lock").touch(mode=0o600)

    def retire(self) -> None:
        """Rename the directory, for remove_retired(), and remove the control group, in which no process is left."""
        group = self.group()
        if group is not None and not group.remove():
            logger.warning("%s cannot be removed: a process of another user runs in it", group.path)
        self.path.rename(self.path.with_name(f"{self.key}{_RETIRED}{os.urandom(4).hex()}"))

    def note_group(self, group: ControlGroup) -> None:
        """Note the program's control group, before it is made."""
        (self.path / "group").write_text(str(group.path))

    def group(self) -> ControlGroup | None:
        """Return the program's control group; None if it has none."""
        try:
            noted = (self.path / "group").read_text()
        except FileNotFoundError:
            return None
        return ControlGroup(Path(noted)) if noted else None  # the manager was killed before it had written

    @contextlib.contextmanager
    def held(self) -> Generator[bool]:
        """Hold the directory's lock in the with block; yield False if a shim holds it, or the directory is gone."""
        try:
            with Folder.at(self.path) as folder:
                lock = folder.open("lock", os.O_RDWR | os.O_CREAT)
        except FileNotFoundError:
            yield False  # the directory has gone meanwhile
            return
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                yield False
            else:
                yield True

    def is_held(self) -> bool:
        """Return whether a living shim holds the directory's lock."""
        if not (self.path / "lock").exists():
            return False
        with self.held() as mine:
            return not mine

    def state(self) -> dict[str, Any]:
        """Return the state that the shim wrote last; empty before it first writes.

        A damaged file is moved aside, and its damage is returned once, as "damaged". The program is then ended, since
        its pid is not known. A living shim writes a new file.
        """
        path = self.path / "state.json"
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            return {}
        try:
            return cast("dict[str, Any]", msgspec.json.decode(data, type=_State))
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            aside = self.path.with_name(f"{self.key}.state.damaged")
            with contextlib.suppress(FileNotFoundError):  # another reader was faster
                path.replace(aside)
            damage = f"{path}: expected the JSON object that the program's shim writes, got {data[:60]!r} ({error})"
            logger.error("%s; it is kept as %s, and the program is ended, if it runs: load it again", damage, aside)
            kill_allocation(self.key)
            return {"damaged": f"{damage}; kept as {aside}; the program was ended"}

    def is_over(self, state: dict[str, Any]) -> bool:
        """Return whether the shim that wrote this state has ended, and no other shim holds the lock."""
        shim = shim_of(state)
        if shim is None:
            return not self.is_held()
        with contextlib.closing(shim):
            return shim.wait(0) and not self.is_held()

    def check_room(self) -> None:
        """Check that a state could be written here.

        Raises:
            OSError: it could not.
        """
        with contextlib.suppress(FileNotFoundError), tempfile.TemporaryFile(dir=self.path) as file:
            file.write(bytes(_ROOM_BYTES))

    def output(self, lines: int) -> tuple[str, ...]:
        """Return the last lines of the program's output, whether it runs or has ended."""
        data = b""
        for name in ("output.old", OUTPUT):
            with contextlib.suppress(OSError):  # the file does not exist yet
                data += (self.path / name).read_bytes()
        last = data.decode(errors="replace").rstrip("\n").split("\n")[-lines:] if data else []
        return tuple(line[:_LINE_LIMIT] for line in last)


def remove_retired(directory: Path) -> None:
    """Remove the directories of programs that are over. One that cannot be removed now is left to the next call.

    On NFS and FUSE a file that is removed while it is open stays under another name, and its directory with it.
    """
    with contextlib.suppress(OSError):
        for path in directory.glob(f"*{_RETIRED}*"):
            shutil.rmtree(path, ignore_errors=True)


def shim_of(state: dict[str, Any]) -> ProcessHandle | None:
    """Return a handle on the shim that wrote this state, to be closed; None if it is gone, or wrote no pid yet."""
    if "shim" not in state:
        return None
    try:
        return ProcessHandle(*state["shim"])
    except ProcessLookupError:
        return None
