"""Home: one external program's directory, as its manager sees it. shim.py, which works there, says what is in it."""

from __future__ import annotations

import contextlib
import fcntl
import logging
import os
import shutil
from collections.abc import Generator
from pathlib import Path
from typing import Any, NotRequired, TypedDict, cast

import msgspec

from rr_actors.folder import Folder
from rr_actors.managers.allocations import kill_allocation
from rr_actors.managers.exits import ProcessHandle

logger = logging.getLogger("rr_actors.managers.home")

_LINE_LIMIT = 500  # characters


class _End(TypedDict, total=False):
    code: int
    signal: int


class _State(TypedDict):
    """What the shim writes; a process is [pid, start ticks]."""

    shim: tuple[int, int]
    grace_s: float
    ready: bool
    program: NotRequired[tuple[int, int]]
    failed: NotRequired[str]
    stopped: NotRequired[bool]
    ended: NotRequired[_End]


class Home:
    """The directory of the program of one key: its last part is the key. It need not be there."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.key = path.name

    def exists(self) -> bool:
        """Whether there is one."""
        return self.path.exists()

    def make(self) -> None:
        """Make it, with a lock that nobody holds."""
        self.path.mkdir(mode=0o700)
        (self.path / "lock").touch(mode=0o600)

    def remove(self) -> None:
        """Remove it with all that is in it."""
        shutil.rmtree(self.path)

    @contextlib.contextmanager
    def held(self) -> Generator[bool]:
        """Hold its lock; False if a shim does."""
        try:
            with Folder.at(self.path) as folder:
                descriptor = folder.open("lock", os.O_RDWR | os.O_CREAT)
        except FileNotFoundError:
            yield False  # the directory has gone meanwhile
            return
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                yield False
            else:
                yield True
        finally:
            os.close(descriptor)

    def is_held(self) -> bool:
        """Whether a shim lives for it."""
        if not (self.path / "lock").exists():
            return False
        with self.held() as mine:
            return not mine

    def state(self) -> dict[str, Any]:
        """What the shim last wrote; empty before its first word.

        A damaged file is set aside, and what was wrong with it is given once, as "damaged". What runs here is ended,
        since nobody can tell what it is; the shim writes anew if it lives.
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
        """Whether the shim that wrote this has ended, and no other has taken its place, which will write anew."""
        shim = shim_of(state)
        if shim is None:
            return not self.is_held()
        with contextlib.closing(shim):
            return shim.wait(0) and not self.is_held()

    def output(self, lines: int) -> tuple[str, ...]:
        """The last lines of the program's output, running or ended."""
        data = b""
        for name in ("output.old", "output.log"):
            with contextlib.suppress(OSError):  # there is none yet
                data += (self.path / name).read_bytes()
        last = data.decode(errors="replace").rstrip("\n").split("\n")[-lines:] if data else []
        return tuple(line[:_LINE_LIMIT] for line in last)


def shim_of(state: dict[str, Any]) -> ProcessHandle | None:
    """The shim that wrote this, to be closed; None if it is gone, or has not said who it is."""
    if "shim" not in state:
        return None
    try:
        return ProcessHandle(*state["shim"])
    except ProcessLookupError:
        return None
