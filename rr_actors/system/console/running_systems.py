"""Running systems: a private list of this user's systems, so that one is found without its state directory.

An entry is a symbolic link to the directory of a console's socket; its name begins with the pid of the system's
process. The list is in XDG_RUNTIME_DIR or, without that, in a directory of mode 0700 below the temporary files.

A system that starts removes the entries of killed ones. A system lives if it holds the lock beside its entry, or if its
console answers. Its pid and its directory say nothing: containers may share the list, and neither processes nor files.
"""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import re
from collections.abc import Iterator
from pathlib import Path

from rr_actors.base.errors import ConfigError
from rr_actors.base.folder import Folder
from rr_actors.system.console.console_messages import SOCKET
from rr_actors.wire.unix_sockets import SocketDir

_NAME = re.compile(r"(\d{1,10})-[0-9a-f]{8}")
_INCARNATION = re.compile(r"[0-9a-f]{8}")


class ListedSystem:
    """The entry of a running system in the list; make() creates it."""

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._name = f"{os.getpid()}-{os.urandom(4).hex()}"
        self._place: tuple[str, str] | None = None
        self._lock: io.FileIO | None = None

    def make(self) -> None:
        """Put the entry into the list; raise ConfigError if no directory can keep the list."""
        failure: OSError | None = None
        for place in _places():
            try:
                with _opened(place, make=True) as folder:
                    for name in filter(_NAME.fullmatch, folder.names()):
                        if not _lives(folder, name):
                            _discard(folder, name)
                    self._lock = lock = folder.open(_lock_of(self._name), os.O_RDWR | os.O_CREAT)
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    os.symlink(self._run_dir, self._name, dir_fd=folder.fd)
                self._place = place
                return
            except OSError as error:
                self.forget()
                failure = failure or error
        problem = "no directory" if failure is None else f"{failure.filename}: {failure.strerror}"
        raise ConfigError(f"no private list of running systems can be kept: {problem}; set XDG_RUNTIME_DIR")

    def remove(self) -> None:
        """Take the entry out of the list. A second call does nothing."""
        if self._place is not None:
            with contextlib.suppress(OSError), _opened(self._place) as folder:
                _discard(folder, self._name)
        self.forget()

    def forget(self) -> None:
        """Close the lock. A forked child must not keep its parent's."""
        if self._lock is not None:
            self._lock.close()


def _lock_of(name: str) -> str:
    return f".{name}.lock"


def _discard(folder: Folder, name: str) -> None:
    for each in (name, _lock_of(name)):
        folder.discard(each)


def _lives(folder: Folder, name: str) -> bool:
    """Return whether the system of an entry runs: it holds the entry's lock, or its console answers."""
    with contextlib.suppress(OSError), folder.open(_lock_of(name), os.O_RDWR) as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    with contextlib.suppress(OSError):
        return _answers(Path(os.readlink(name, dir_fd=folder.fd)))
    return False


def running_systems() -> list[Path]:
    """Return the directories of the consoles of this user's running systems, without the entries of killed systems.

    It reads the list in the first place that can be used, as a system that starts does.
    """
    found: list[Path] = []
    for place in _places():
        try:
            with _opened(place) as folder:
                for name in sorted(filter(_NAME.fullmatch, folder.names())):
                    with contextlib.suppress(OSError):  # its system has just removed it
                        run_dir = Path(os.readlink(name, dir_fd=folder.fd))
                        if _answers(run_dir):
                            found.append(run_dir)
            break
        except FileNotFoundError:
            if os.access(place[0], os.W_OK):  # no system has made a list in this place yet
                break
        except OSError:
            continue
    return list(dict.fromkeys(found))


def consoles_in(state_dir: Path) -> list[Path]:
    """Return the directories of the consoles of the systems that run in a state directory: one, or none.

    Raises:
        ConfigError: the directory cannot be read, or is a file.
    """
    run = state_dir / "run"
    try:
        names = sorted(os.listdir(run))
    except FileNotFoundError:
        return []
    except OSError as error:
        if state_dir.is_file():
            text = f"{state_dir}: expected a state directory of a system, got a file"
            raise ConfigError(text, file=str(state_dir)) from error
        raise ConfigError(f"{run}: cannot be read: {error.strerror}", file=str(run)) from error
    return [run / name for name in names if _INCARNATION.fullmatch(name) and _answers(run / name)]


def _places() -> Iterator[tuple[str, str]]:
    """Yield the places where the list may be: a directory, and the list's name in it."""
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        yield runtime, "rr_actors"
    for parent in (*filter(None, map(os.environ.get, ("TMPDIR", "TEMP", "TMP"))), "/tmp", "/var/tmp"):
        yield parent, f"rr_actors-{os.geteuid()}"


def _opened(place: tuple[str, str], *, make: bool = False) -> Folder:
    with Folder.at(place[0]) as parent:
        if not make and not parent.has(place[1]):
            raise FileNotFoundError
        return parent.inner(place[1])


def _answers(run_dir: Path) -> bool:
    """Return whether a console listens at the socket in this directory."""
    sockets = SocketDir(run_dir)
    try:
        sockets.connect(SOCKET).close()
    except BlockingIOError:  # too many connections wait to be accepted
        return True
    except (OSError, ConfigError):
        return False
    finally:
        sockets.close()
    return True
