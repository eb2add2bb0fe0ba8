"""Running systems: a private list of those of this user, so that one is found without its state directory.

An entry is a symbolic link, called by the pid of its system's process, that leads to the directory with its console's
socket. It is in XDG_RUNTIME_DIR, or where there is none in a directory of mode 0700 below the temporary files. What a
killed system left, the next one removes.
"""

from __future__ import annotations

import contextlib
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


class Entry:
    """A running system's entry in the list, when it is made."""

    def __init__(self, run_dir: Path) -> None:
        self._run_dir = run_dir
        self._name = f"{os.getpid()}-{os.urandom(4).hex()}"
        self._place: tuple[str, str] | None = None

    def make(self) -> None:
        """Put it into the list.

        Raises:
            ConfigError: there is no place for it.
        """
        failure: OSError | None = None
        for place in _places():
            try:
                with _opened(place, make=True) as folder:
                    _sweep(folder)
                    os.symlink(self._run_dir, self._name, dir_fd=folder.fd)
                self._place = place
                return
            except OSError as error:
                failure = failure or error
        problem = "no directory" if failure is None else f"{failure.filename}: {failure.strerror}"
        raise ConfigError(f"no private list of running systems can be kept: {problem}; set XDG_RUNTIME_DIR")

    def remove(self) -> None:
        """Take it out of the list. Again is nothing."""
        if self._place is not None:
            with contextlib.suppress(OSError), _opened(self._place) as folder:
                folder.discard(self._name)


def running_systems() -> list[Path]:
    """Return the directories with the consoles of this user's running systems; those left behind are not in it.

    It looks in the first place that can be used, as a system that starts does.
    """
    found: list[Path] = []
    for place in _places():
        try:
            with _opened(place) as folder:
                for name in sorted(folder.names()):
                    run_dir = _target(folder, name)
                    if run_dir is not None and _answers(run_dir):
                        found.append(run_dir)
            break
        except FileNotFoundError:
            if os.access(place[0], os.W_OK):  # nobody has made a list here yet
                break
        except OSError:
            continue
    return list(dict.fromkeys(found))


def consoles_in(state_dir: Path) -> list[Path]:
    """Return the directories with the consoles of the systems that run in a state directory: one, or none.

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
    """Where the list may be: a directory, and its name there."""
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        yield runtime, "rr_actors"
    for parent in (*filter(None, map(os.environ.get, ("TMPDIR", "TEMP", "TMP"))), "/tmp", "/var/tmp"):
        yield parent, f"rr_actors-{os.geteuid()}"


def _opened(place: tuple[str, str], *, make: bool = False) -> Folder:
    with Folder.at(place[0]) as parent:
        if not make and not parent.has(place[1]):
            raise FileNotFoundError
        return parent.inner(place[1])


def _sweep(folder: Folder) -> None:
    """Remove the entries of processes that are gone."""
    for name in folder.names():
        match = _NAME.fullmatch(name)
        if match is not None and not Path("/proc", match[1]).exists():
            folder.discard(name)


def _target(folder: Folder, name: str) -> Path | None:
    if _NAME.fullmatch(name) is None:
        return None
    try:
        return Path(os.readlink(name, dir_fd=folder.fd))
    except OSError:
        return None


def _answers(run_dir: Path) -> bool:
    """Whether somebody listens at the console's socket there."""
    sockets = SocketDir(run_dir)
    try:
        sockets.connect(SOCKET).close()
    except BlockingIOError:  # too many wait there
        return True
    except (OSError, ConfigError):
        return False
    finally:
        sockets.close()
    return True
