"""The names and addresses of registrars and actors, in a private directory that each process of the system can read.

An entry is a symbolic link whose target is its content, "up:4711-0a1b2c3d.sock" or "stopped". Replacing it is one
atomic rename, reading it one readlink. A process that is killed at any instruction leaves the old entry or the new.

    <state_dir>/            0700
      system.lock           held (flock) by the living system; contains the pid of its process
      run/<incarnation>/    0700; removed when the system ends, or by the next system after a kill
        names/              the entries
        4711-0a1b2c3d.sock  the processes' sockets

Each incarnation has a directory of its own: nobody reads what a process of a dead system still writes. The files are
reached through descriptors of the directories (folder.py). The system marks them as used within each hour, and locks
them, which systemd-tmpfiles respects. If they are removed all the same, the system's processes make them again.
"""

from __future__ import annotations

import contextlib
import enum
import errno
import fcntl
import functools
import hashlib
import io
import itertools
import os
import re
import stat
import threading
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Protocol

import msgspec

from rr_actors.base.errors import (
    CatalogLocked,
    ConfigError,
    UnknownRegistrar,
    UsageError,
    did_you_mean,
    shortened,
    shown,
)
from rr_actors.base.folder import Folder, NotOurs, Place, make_directories
from rr_actors.base.names import REGISTRAR, ServerId, check_name, check_registrar_name, is_part
from rr_actors.base.reporting.log import Log
from rr_actors.base.scarcity import wanted_by
from rr_actors.base.steps import Steps

_log = Log(__name__)

_REGISTRAR = "r."  # the prefix of a registrar's entry
_CLASSES = "c."  # the prefix of an entry with the classes of a manager
_HOSTS = "h."  # the prefix of an entry with what is known of another host
_LABELS = "l."  # the prefix of an entry with what a server provides
_NOTES = "n."  # the prefix of an entry with what an operator should know of a manager
_BELOW = "~"  # stands for "/" in the name of an actor's entry
_LOCK = "system.lock"
_KEY_BYTES = 32
_INCARNATION_BYTES = 4
_INCARNATION = re.compile(rf"[0-9a-f]{{{2 * _INCARNATION_BYTES}}}")
_SHOWN = 10  # names in an error at most
_CONTENT_BYTES = 1000  # XFS has links of at most 1023 bytes
_PATH_CHARACTERS = 200  # a file's name has at most 255 bytes

LABELS_BYTES = 900
"""The limit for what a server provides, as JSON."""

PATH_BYTES = 482
"""The limit for the path of the state directory. SQLite opens paths of 504 bytes: this, and "/a/catalog.sqlite3.new".
A registrar with a longer name needs a shorter path; that is checked when its catalog is opened."""


class Presence(enum.StrEnum):
    """The state of a registrar or actor: UP at an address; STARTING or being respawned; STOPPED, can be restarted; GONE
    for good; DORMANT, a registrar whose process died and whose catalog nobody has open."""

    UP = "up"
    STARTING = "starting"
    STOPPED = "stopped"
    GONE = "gone"
    DORMANT = "dormant"


class Turn(enum.StrEnum):
    """The place of a STARTING actor among its siblings, which start one after another: DUE ones start when the NOW one
    is up. A STOPPED one that is DUE starts when its supervisor, which stops as well, is started again."""

    NOW = "now"
    DUE = "due"


class NameEntry(msgspec.Struct, frozen=True):
    """The entry of one name; the address is "" unless the status is UP, or STARTING with a running process.

    `why` is a text for people: the reason for STOPPED or GONE, or how the last processes died while STARTING; "" if
    the reason is not known.
    `once`: the actor is UP, and will not be started again when it ends.
    `turn`: the actor is STARTING in its turn, or STOPPED together with its supervisor; None if what it does depends on
    no other.
    """

    status: Presence
    address: str
    why: str = ""
    once: bool = False
    turn: Turn | None = None

    @property
    def because(self) -> str:
        """The reason as the end of a sentence: ": killed (SIGKILL)"; "" if it is not known."""
        return f": {self.why}" if self.why else ""


class HostInfo(msgspec.Struct, frozen=True):
    """Another host, as System.hosts() returns it.

    Attributes:
        name: the host's name.
        state: "up"; "unreachable": it was lost, or has not been seen yet; "refused": it speaks another version, or
            another system has this host's name.
        since: when that began, in seconds since 1970.
        why: the reason, for people. If it is up: that a second system has its name, or "".
        exports: the statuses of the registrars that it lets this host use, by name.
    """

    name: str
    state: str
    since: float
    why: str
    exports: dict[str, str]


class HostSettings(Protocol):
    """What System(hosts=...) takes: rr.Hosts. Programs without other hosts do not import it."""

    @property
    def name(self) -> str:
        """The name of this host."""
        ...


class OtherHosts(Protocol):
    """What the processes of a system with hosts= know of other hosts; wire/hosts/host_names.py has it."""

    @property
    def host(self) -> str:
        """The name of this host."""
        ...

    def provider(self, asked: ServerId, directory: Directory) -> ServerId:
        """Return the server that is meant: behind a route, or without the own host's name."""
        ...

    def known(self, directory: Directory) -> list[HostInfo]:
        """Return the other hosts that the directory knows, sorted by name."""
        ...

    def unreachable(self, directory: Directory, registrar: str) -> HostInfo | None:
        """Return the host of a registrar if that is another one, and not reachable now."""
        ...

    def lease(self, state_dir: str, registrar: str) -> tuple[int, float] | None:
        """Return the number of the lease at the host of a registrar, and how many seconds it goes on.

        None: that registrar is of this host, or it releases nothing when a lease ends.
        """
        ...


_AWAY = (Presence.GONE, Presence.DORMANT)
_MARKS = {
    **{status.value: NameEntry(status, "") for status in Presence if status is not Presence.UP},
    **{f"{Presence.STARTING.value} {turn.value}": NameEntry(Presence.STARTING, "", turn=turn) for turn in Turn},
    f"{Presence.STOPPED.value} {Turn.DUE.value}": NameEntry(Presence.STOPPED, "", turn=Turn.DUE),
}
_UP = Presence.UP.value + ":"
_UP_ONCE = Presence.UP.value + " once:"
_OPENING = Presence.STARTING.value + ":"
_WHY = " because "
_WHY_BYTES = 900  # with the status in front of it, and "…"


def _fitting(why: str) -> str:
    """Return as much of a reason as fits into a symbolic link."""
    whole = why.replace("\0", " ").encode("utf-8", "backslashreplace")
    return whole.decode() if len(whole) <= _WHY_BYTES else whole[:_WHY_BYTES].decode("utf-8", "ignore") + "…"


def registrar_key(name: str) -> str:
    """Return the name of a registrar's entry; that of another host is "host/registrar"."""
    check_registrar_name(name)
    return _key_of(name)


def _key_of(name: str) -> str:
    return _REGISTRAR + name.replace("/", _BELOW)


@functools.lru_cache(1024)  # called for each message to an actor of another process
def actor_key(path: str) -> str:
    """Return the name of an actor's entry, from its path in the tree, "root/inner/cameras"."""
    for part in path.split("/"):
        check_name(part, "child id")
    key = path.replace("/", _BELOW)
    if len(key) > _PATH_CHARACTERS:
        key = f"{key[: _PATH_CHARACTERS - 40]}{_BELOW}{_BELOW}{hashlib.sha256(key.encode()).hexdigest()[:32]}"
    return f"a.{key}"


def _owner_key(path: str) -> str:
    """Return the key of the actor of which that at `path` is a part; "" if it is a part of none.

    The owner of "root/cameras/registrar" is the manager; that of "app" and "app/clients/maps" the application's
    registrar.
    """
    ids = path.split("/")
    if REGISTRAR in ids[1:]:
        return actor_key("/".join(ids[: ids.index(REGISTRAR, 1)]))
    return registrar_key(ids[0]) if is_part(path) else ""


class Directory:
    """The names of one running system. Each process and thread may have its own Directory of the same `run_dir`.

    A method that writes raises ConfigError if the directory cannot be written: it was removed, or the disk is full.

    Args:
        run_dir: StateDir.run_dir.
        keeps: make the directory again if it was removed; only for a caller that knows that the system runs.
        place: the state directory. Nothing is made while it is not in its place.
    """

    def __init__(self, run_dir: str | os.PathLike[str], *, keeps: bool = False, place: Place | None = None) -> None:
        self._run_dir = os.fspath(run_dir)
        self._place = place
        self._keeps = keeps
        self._draft = f".{os.urandom(4).hex()}."
        self._numbers = itertools.count()
        self._written: dict[str, str] = {}  # the entries that this object wrote
        self._restoring = threading.Lock()
        self._names = self._open()

    def _open(self) -> Folder:
        if self._place is not None:
            self._place.check()
        with _named_errors("make", f"{self._run_dir}/names"):
            make_directories(self._run_dir)
            with Folder.unlinked(self._run_dir) as run:
                return run.inner("names")

    @property
    def run_dir(self) -> Path:
        """The directory that this one is in."""
        return Path(self._run_dir)

    def close(self) -> None:
        """Close the directory: later look-ups find nothing, and writes fail."""
        self._names.close()

    def restore(self) -> bool:
        """Make the directory again if it was removed, with this object's entries; return whether it was removed."""
        with self._restoring:
            names = self._names
            if names.fd < 0 or (names.is_there() and (self.run_dir / "names").exists()):
                return False
            self._names = self._open()  # the old folder stays open for threads that use it
            for name, content in list(self._written.items()):
                if content.startswith(_UP) or self.lookup(name) is None:
                    self._write(name, content)
            return True

    def touch(self) -> None:
        """Mark all files as used now, so that no cleaner of temporary files removes them as old."""
        paths = [self.run_dir.parent, self.run_dir, self.run_dir / "names"]
        with contextlib.suppress(OSError):  # it was removed; restore() makes it again
            paths.extend(self.run_dir.iterdir())
        for path in paths:
            with contextlib.suppress(OSError):
                os.utime(path, follow_symlinks=False)
        names = self._names
        for name in self.names():
            with contextlib.suppress(OSError):
                os.utime(name, dir_fd=names.fd, follow_symlinks=False)

    def publish(self, name: str, address: str, *, once: bool = False) -> None:
        """Write that `name` is UP at `address`; `once`: when it ends, it will not be started again."""
        self._put(name, (_UP_ONCE if once else _UP) + address)

    def announce(self, name: str, address: str) -> None:
        """Write that `name` is STARTING and will be UP at `address`: its process runs."""
        self._put(name, _OPENING + address)

    def mark(self, name: str, status: Presence, why: str = "", turn: Turn | None = None) -> None:
        """Write a status in which `name` has no address, and `why`, of which at most 900 bytes are kept."""
        if status is Presence.UP:
            raise UsageError(f"{name}: UP needs an address; use publish")
        mark = f"{status.value} {turn.value}" if turn else status.value
        self._put(name, f"{mark}{_WHY}{_fitting(why)}" if why else mark)

    def _put(self, name: str, content: str) -> None:
        if not name or name[0] == "." or "/" in name:
            raise UsageError(f"{name!r} is not a name for the directory: use registrar_key or actor_key", name=name)
        self._written[name] = content
        with _named_errors("write", f"{self._run_dir}/names/{name}"):
            try:
                self._write(name, content)
            except FileNotFoundError:
                if not self._keeps:
                    raise
                self.restore()  # or another thread has restored it meanwhile
                self._write(name, content)

    def _write(self, name: str, content: str) -> None:
        names = self._names
        try:
            if os.readlink(name, dir_fd=names.fd) == content:  # a new link costs a hundred times as much as this look
                return
        except FileNotFoundError:
            with contextlib.suppress(FileExistsError):  # another process has written it meanwhile
                os.symlink(content, name, dir_fd=names.fd)
                return
        except OSError:  # something else has the name: it is replaced
            pass
        draft = f"{self._draft}{next(self._numbers)}"
        os.symlink(content, draft, dir_fd=names.fd)
        try:
            names.rename(draft, name)
        except OSError:
            names.discard(draft)
            raise

    def lookup(self, name: str) -> NameEntry | None:
        """Return the entry, or None if there is none. One system call."""
        names = self._names
        try:
            content = os.readlink(name, dir_fd=names.fd)
        except OSError:  # no such entry, or no symbolic link
            return None
        if content.startswith(_UP):
            return NameEntry(Presence.UP, content[len(_UP) :])
        if content.startswith(_OPENING):
            return NameEntry(Presence.STARTING, content[len(_OPENING) :])
        if content.startswith(_UP_ONCE):
            return NameEntry(Presence.UP, content[len(_UP_ONCE) :], once=True)
        mark, _, why = content.partition(_WHY)
        entry = _MARKS.get(mark)
        return entry if entry is None or not why else NameEntry(entry.status, "", why, turn=entry.turn)

    def actor(self, path: str) -> NameEntry | None:
        """Return the entry of an actor; of a part, such as a manager's registrar, the entry of that of which it is one.

        Raises:
            InvalidName: this is no path.
        """
        entry = self.lookup(actor_key(path))
        owner = _owner_key(path) if entry is None else ""
        return self.lookup(owner) if owner else entry

    def names(self) -> list[str]:
        """Return the names of all entries, sorted."""
        try:
            return sorted(name for name in self._names.names() if not name.startswith("."))
        except OSError:
            return []

    def registrars(self) -> list[str]:
        """Return the names of this host's registrars that have an entry, sorted."""
        return [name for name in self._all_registrars() if "/" not in name]

    def other_hosts_registrars(self) -> list[str]:
        """Return the registrars of other hosts that have an entry, as "host/registrar", sorted."""
        return [name for name in self._all_registrars() if "/" in name]

    def _all_registrars(self) -> list[str]:
        keys = [name.removeprefix(_REGISTRAR) for name in self.names() if name.startswith(_REGISTRAR)]
        return [key.replace(_BELOW, "/") for key in keys]

    def put_host(self, host: str, text: str) -> None:
        """Write what is known of another host, at most 900 bytes."""
        self._put(_HOSTS + check_name(host, "host name"), text)

    def host(self, host: str) -> str:
        """Return what is known of another host; "" if nothing is. One system call."""
        with contextlib.suppress(OSError):
            return os.readlink(_HOSTS + host, dir_fd=self._names.fd)
        return ""

    def remove_host(self, host: str) -> None:
        """Remove what is known of a host."""
        self._put_or_remove(_HOSTS + host, "")

    def hosts(self) -> list[str]:
        """Return the names of the other hosts of which anything is known, sorted."""
        return [name.removeprefix(_HOSTS) for name in self.names() if name.startswith(_HOSTS)]

    def put_classes(self, registrar: str, classes: Sequence[str]) -> None:
        """Write the names of the classes of the manager that has this registrar."""
        self._put(_CLASSES + check_name(registrar, "registrar name"), _joined(classes))

    def manager_classes(self) -> dict[str, list[str]]:
        """Return the classes of each manager that has been in the system, by the name of its registrar."""
        found: dict[str, list[str]] = {}
        names = self._names
        for name in self.names():
            if name.startswith(_CLASSES):
                with contextlib.suppress(OSError):
                    found[name.removeprefix(_CLASSES)] = os.readlink(name, dir_fd=names.fd).split(",")
        return found

    def put_labels(self, registrar: str, server: str, labels: str) -> None:
        """Write what a server provides, or remove that if it is ""."""
        self._put_or_remove(f"{_LABELS}{check_name(registrar, 'registrar name')}{_BELOW}{server}", labels)

    def put_note(self, registrar: str, text: str) -> None:
        """Write what an operator should know of a manager, of which 900 bytes are kept; remove it if it is ""."""
        self._put_or_remove(_NOTES + check_name(registrar, "registrar name"), _fitting(text))

    def notes(self) -> dict[str, str]:
        """Return what an operator should know of managers, by the names of their registrars."""
        found: dict[str, str] = {}
        for name in self.names():
            if name.startswith(_NOTES):
                with contextlib.suppress(OSError):  # it was removed just now
                    found[name.removeprefix(_NOTES)] = os.readlink(name, dir_fd=self._names.fd)
        return found

    def _put_or_remove(self, name: str, text: str) -> None:
        if text:
            self._put(name, text)
            return
        self._written.pop(name, None)
        with contextlib.suppress(OSError):  # there is none
            os.unlink(name, dir_fd=self._names.fd)

    def labels(self) -> dict[str, str]:
        """Return what the servers of the registrars that are there provide, by server id, sorted."""
        found: dict[str, str] = {}
        names = self._names
        for name in self.names():
            if name.startswith(_LABELS):
                registrar, _, server = name.removeprefix(_LABELS).partition(_BELOW)
                entry = self.lookup(_REGISTRAR + registrar)
                if entry is not None and entry.status in (Presence.UP, Presence.STARTING):
                    with contextlib.suppress(OSError):  # it was removed just now
                        found[f"{registrar}/{server}"] = os.readlink(name, dir_fd=names.fd)
        return found

    def changed_at(self) -> int:
        """Return when an entry was written or removed last, in ns of the system's clock; coarse. One system call."""
        with contextlib.suppress(OSError):
            return os.fstat(self._names.fd).st_mtime_ns
        return 0

    def actors_below(self, path: str) -> list[str]:
        """Return the names of the entries of all actors below this path, sorted."""
        prefix = actor_key(path) + _BELOW
        return [name for name in self.names() if name.startswith(prefix)]

    def actor_paths(self, top: str) -> list[str]:
        """Return the paths of all actors below `top`, sorted; not those that are too long for the name of an entry."""
        found = [key.removeprefix("a.").replace(_BELOW, "/") for key in self.actors_below(top)]
        return [path for path in found if "//" not in path]

    def no_registrar(self, name: str) -> UnknownRegistrar:
        """Return the error for an unknown registrar; it names the known ones, and the one that was probably meant."""
        entry = self.lookup(_key_of(name))
        entries = {other: self.lookup(_key_of(other)) for other in self._all_registrars()}
        known = [other for other, found in entries.items() if found and found.status not in _AWAY]
        there = ", ".join(known[:_SHOWN]) + (", ..." if len(known) > _SHOWN else "")
        what = "there is none of this name in the system"
        if entry is not None and entry.status is Presence.GONE and entry.why:
            what += f" any more, it is gone for good{entry.because}"
        hint = did_you_mean(name, known) or ";"
        text = f"registrar {name!r}: {what}{hint} it has: {there or 'none'}"
        return UnknownRegistrar(text, registrar=name, known=tuple(known))


def _joined(classes: Sequence[str]) -> str:
    """Join the names of the first classes, as many as fit into a symbolic link."""
    text = ""
    for name in classes:
        if len(text.encode()) + len(name.encode()) >= _CONTENT_BYTES:
            break
        text = f"{text},{name}" if text else name
    return text or "?"


class StateDir:
    """A state directory opened by the one living system that uses it.

    Attributes:
        path: the absolute path of the directory.
        place: the same, to look whether it is still there.
        run_dir: the directory for the names and sockets of this incarnation.
        key: 32 secret bytes, new each time; only the system's own processes get them.
        folder: the directory, held open.
    """

    def __init__(self, folder: Folder, lock: io.FileIO) -> None:
        self.path = folder.path
        self.place = folder.place
        self._lock = lock
        self.key = os.urandom(_KEY_BYTES)
        self.folder = folder
        with _named_errors("use", self.path / "run"), folder.inner("run") as run:
            _lock_shared(folder.fd)
            _remove_incarnations(run)
            self._run = run.inner(os.urandom(_INCARNATION_BYTES).hex())
            self.run_dir = self._run.path
            _lock_shared(self._run.fd)

    def keep(self) -> None:
        """Take the lock again if its file was removed, and log that: another system could start here meanwhile. Blocks.

        Raises:
            CatalogLocked: another system has taken the lock already; both use the directory, and one must be stopped.
        """
        if self._lock.closed:
            return
        found = self.folder.look(_LOCK)
        if found is not None and os.path.samestat(found, os.fstat(self._lock.fileno())):
            return
        _log.error("state directory %s: its lock, %s, was removed; it is taken again", self.path, _LOCK)
        lost, self._lock = self._lock, _take_lock(self.folder)
        lost.close()

    def close(self) -> None:
        """Remove the files that only a running system needs, and release the lock. A second call does nothing.

        Each step is tried. The next start removes the files that cannot be removed now.
        """
        if self._lock.closed:
            return
        steps = Steps()
        steps.take("removing what only a running system needs", self._clear)
        with contextlib.suppress(OSError):  # the pid in the file is only for people
            os.ftruncate(self._lock.fileno(), 0)
        steps.take("giving its lock back", self.forget)
        steps.end(f"state directory {self.path}: not closed altogether")

    def _clear(self) -> None:
        if not self.folder.is_there():
            return  # it was removed with all that is in it
        try:
            with self.folder.inner("run") as run:
                _remove_incarnations(run)
        finally:
            with contextlib.suppress(OSError):  # a late process has written a file again: the next start removes it
                os.rmdir("run", dir_fd=self.folder.fd)

    def forget(self) -> None:
        """Close the lock and the directories, and remove nothing. A forked child must not keep its parent's lock."""
        self._lock.close()
        self._run.close()
        self.folder.close()


def _lock_shared(fd: int) -> None:
    """Lock a directory, which cleaners of temporary files respect; if another process has locked it, do nothing."""
    with contextlib.suppress(OSError):
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)


def open_state_dir(path: Path | str) -> StateDir:
    """Make a state directory private, or create it, and lock it for this system.

    Raises:
        CatalogLocked: a living system has locked it; `.pid` is the process of that system.
        ConfigError: the directory cannot be written, belongs to another user, or is shared with other users.
    """
    path = absolute_path(path)
    with _named_errors("use", path):
        if path.exists() and not path.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, "it is a file, not a directory")
        make_directories(path, synced=True)  # a registrar in it may have the durability "power"
        folder = Folder.at(path)
    with contextlib.ExitStack() as if_not:
        if_not.enter_context(folder)
        _make_private(folder)
        lock = if_not.enter_context(_take_lock(folder))
        opened = StateDir(folder, lock)
        if_not.pop_all()
        return opened


def absolute_path(path: Path | str) -> Path:
    """Return the real path of a state directory.

    Raise ConfigError if it is relative to a current directory that was removed, or longer than PATH_BYTES.
    """
    try:
        absolute = Path(os.path.realpath(path))
    except FileNotFoundError as error:
        text = (
            f"{str(path)!r} is relative to the current directory, which has been removed: change to another one "
            "(os.chdir), or choose an absolute state_dir"
        )
        raise _unusable(path, text, "an absolute path", str(path)) from error
    length = len(os.fsencode(absolute))
    if length > PATH_BYTES:
        text = (
            f"{shortened(str(absolute))}: its path has {length} bytes, expected at most {PATH_BYTES}, as SQLite opens "
            "no file below it then: choose a shorter state_dir"
        )
        raise _unusable(absolute, text, PATH_BYTES, length)
    return absolute


def _unusable(path: object, text: str, expected: object, got: object) -> ConfigError:
    return ConfigError(f"state directory {text}", file=str(path), key="state_dir", expected=expected, got=got)


def _take_lock(folder: Folder) -> io.FileIO:
    path = folder.path
    lock_path = path / _LOCK
    with _named_errors("write", lock_path):
        lock = folder.open(_LOCK, os.O_RDWR | os.O_CREAT)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with _named_errors("write", lock_path):
            os.ftruncate(lock.fileno(), 0)
            lock.write(b"%d\n" % os.getpid())
    except BlockingIOError as error:
        text = os.pread(lock.fileno(), 20, 0).strip()
        pid = int(text) if text.isdigit() else None
        lock.close()
        who = f"pid {pid}" if pid else "another process"
        instead = "stop that system or choose another state_dir"
        if pid == os.getpid():
            who = f"a system of this same process (pid {pid})"
            instead = f"rr_actors.System.running({str(path)!r}) returns it; use it, or stop it first"
        raise CatalogLocked(f"state directory {path} is in use by {who}: {instead}", path=str(path), pid=pid) from error
    except BaseException:
        lock.close()
        raise
    return lock


def _make_private(folder: Folder) -> None:
    """Give the directory mode 0700; refuse one that is not this user's alone."""
    path = folder.path
    try:
        mode = stat.S_IMODE(folder.check_owner().st_mode)
    except NotOurs as error:
        runs = f"{os.geteuid()} (who runs this): choose a directory of your own as state_dir"
        text = f"{path} belongs to user {error.owner}, expected {runs}"
        raise _unusable(path, text, os.geteuid(), error.owner) from error
    if mode & stat.S_ISVTX or path == path.parent:
        text = f"{path} is shared by all users: choose a directory in it as state_dir"
        raise _unusable(path, text, "a private directory", oct(mode))
    with _named_errors("use", path):
        others = _others_files(folder)
    if others:
        text = "state directory %s: it has files of others, and no system has used it yet (%s); %s keeps them apart"
        _log.warning(text, path, ", ".join(map(shown, others[:_SHOWN])), path / "rr_state")
    with _named_errors("tighten", path):
        before, after = folder.tighten(0o077)
    if before != after:
        _log.info("state directory %s: mode %o tightened to 700", path, before)


def _others_files(folder: Folder) -> list[str]:
    """Return the files that show that a directory has another purpose; none if a system has used it before."""
    names = sorted(name for name in folder.names() if name[0] != "." and name not in ("run", "lost+found"))
    if _LOCK in names or any(next((folder.path / name).glob("catalog.*"), None) for name in names):
        return []
    return [name for name in names if _has_files(folder.path / name)]


def _has_files(path: Path) -> bool:
    try:
        return next(path.iterdir(), None) is not None
    except NotADirectoryError:
        return True
    except OSError:  # the directory cannot be read
        return False


def _remove_incarnations(run: Folder) -> None:
    """Remove the directories of dead systems, although a late process of theirs may still write to them.

    Remove nothing else: a registrar may be called "run", and its catalog is then here.
    """
    with _named_errors("use", run.path):
        found = [name for name in run.names() if _INCARNATION.fullmatch(name)]
    if not found:
        return
    import shutil  # brings bz2 and lzma, and only a start after a crash needs it

    for name in found:
        # Not by its dir_fd, which it refuses in a program that has imported eventlet.
        shutil.rmtree(f"/proc/self/fd/{run.fd}/{name}", ignore_errors=True)
        run.discard(name)  # if it was no directory


@contextlib.contextmanager
def _named_errors(verb: str, path: object) -> Generator[None]:
    """Turn an OSError into a ConfigError that names the action, the path and the reason."""
    try:
        yield
    except BlockingIOError:
        raise
    except OSError as error:
        text = f"cannot {verb} {path}: {error.strerror or error}: {wanted_by(error) or _advice(error, Path(str(path)))}"
        raise ConfigError(text, file=str(path), key="state_dir") from error


def _advice(error: OSError, path: Path) -> str:
    """Return what the user can do about the error."""
    match error.errno:
        case errno.EACCES | errno.EPERM:
            return "make it writable, or choose another state_dir"
        case errno.ENOSPC | errno.EDQUOT:
            return "make room there, or choose another state_dir"
        case errno.ENAMETOOLONG:
            return "choose a shorter state_dir"
        case errno.ENOTDIR | errno.EEXIST:
            files = [part for part in path.parents if part.exists() and not part.is_dir()]
            return f"{files[-1]} is a file; choose another state_dir" if files else "choose another state_dir"
        case _:
            return "choose another state_dir"
