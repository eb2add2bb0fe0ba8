"""Home: one external program's directory, as its manager sees it. shim.py lists the files in it.

OutputLog: what programs print, as log lines of their manager. A thread reads what the files have got.
"""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import os
import shutil
import tempfile
import threading
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any, NotRequired, TypedDict, cast

import msgspec

from rr_actors.base.errors import readable
from rr_actors.base.folder import Folder
from rr_actors.base.reporting.log import Log
from rr_actors.managers.exit_watcher import ProcessHandle
from rr_actors.managers.process_marks import kill_allocation
from rr_actors.runtime.processes.control_groups import ControlGroup

logger = Log("rr_actors.managers.program_directory")
output_logger = Log("rr_actors.managers.programs.output")

_LINE_LIMIT = 500  # characters
_ROOM_BYTES = 4096  # as much as a state takes
OUTPUT = "output.log"
_RETIRED = ".retired-"
_LOOK_S = 0.2
_MOST = 100  # lines of one program in one look
_LINE_LIMIT_BYTES = 4096
_PART_BYTES = 2**16


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


# -- as log lines -------------------------------------------------------------------------------------------------


class OutputLog:
    """Logs the lines of programs from now on. Its thread runs while there are any."""

    def __init__(self) -> None:
        self._files: dict[str, _Tail] = {}
        self._lock = threading.Lock()
        self._is_over = threading.Event()
        self._thread: threading.Thread | None = None

    def follow(self, key: str, name: str, file: Path, *, from_start: bool) -> None:
        """Log the lines of a program: all of them, or those that come from now on."""
        with self._lock:
            self._files[key] = _Tail(name, file, from_start=from_start)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="rr-program-output", daemon=True)
                self._thread.start()

    def leave(self, key: str) -> None:
        """Log what has come of a program that is over, and no more."""
        with self._lock:
            tail = self._files.pop(key, None)
            if tail is not None:
                tail.look(final=True)

    def close(self) -> None:
        """Log nothing more."""
        self._is_over.set()
        thread = self._thread
        if thread is not None:
            thread.join()

    def _run(self) -> None:
        while not self._is_over.wait(_LOOK_S):
            with self._lock:
                if not self._files:
                    self._thread = None
                    return
                for tail in self._files.values():
                    tail.look()


class _Tail:
    """How far the output file of one program was read. The file begins anew when it is long (shim.py)."""

    def __init__(self, name: str, file: Path, *, from_start: bool) -> None:
        self._name, self._path = name, file
        self._file: int | None = None
        self._rest = b""
        if not from_start:
            self._open()
            if self._file is not None:
                os.lseek(self._file, 0, os.SEEK_END)

    def look(self, *, final: bool = False) -> None:
        """Log the lines that have come."""
        lines = self._new_lines()
        for line in itertools.islice(lines, _MOST):
            self._log(line)
        if more := sum(1 for _ in lines):  # they may be too many to be kept
            output_logger.info("%s: %d lines more, in %s", self._name, more, self._path)
        if final:
            if self._rest:
                self._log(self._rest)
            self._close()

    def _log(self, line: bytes) -> None:
        output_logger.info("%s: %s", self._name, readable(line.decode(errors="replace")))

    def _new_lines(self) -> Iterator[bytes]:
        while True:
            if self._file is None and not self._open():
                return
            is_over = self._began_anew()  # asked first: from then on no more comes into the file that is open
            data = self._read()
            if not data:
                if not is_over:
                    return
                self._close()
                continue
            *lines, self._rest = (self._rest + data).split(b"\n")
            yield from (line[:_LINE_LIMIT_BYTES] for line in lines)
            if len(self._rest) > _LINE_LIMIT_BYTES:
                yield self._rest[:_LINE_LIMIT_BYTES]
                self._rest = b""

    def _open(self) -> bool:
        with contextlib.suppress(OSError):  # the program has written nothing yet, or no descriptor is left
            self._file = os.open(self._path, os.O_RDONLY | os.O_CLOEXEC)
        return self._file is not None

    def _read(self) -> bytes:
        assert self._file is not None
        with contextlib.suppress(OSError):
            return os.read(self._file, _PART_BYTES)
        return b""

    def _began_anew(self) -> bool:
        assert self._file is not None
        with contextlib.suppress(OSError):
            return os.fstat(self._file).st_ino != self._path.stat().st_ino
        return False

    def _close(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None
