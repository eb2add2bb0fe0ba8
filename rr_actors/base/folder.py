"""Folder: a directory that is held open, and whose files are reached through it, never by a path.

If another user can write a directory of a path, the path can lead elsewhere at any time. A name in a folder cannot: no
link is followed, and a file is checked before anything of it is read, cut off or changed.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import os
import stat
import weakref
from pathlib import Path
from typing import Self

import msgspec

from rr_actors.base.errors import CatalogError

_KINDS = (
    (stat.S_ISLNK, "a symbolic link"),
    (stat.S_ISDIR, "a directory"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)
_OF_PROCESSES = "/proc/"
_AS_DIRECTORY = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC


def may_block(path: Path) -> bool:
    """Return whether to read this may wait for ever: a pipe, a socket or a device is in the place of a file."""
    return path.exists() and not path.is_file() and not path.is_dir()


def open_plain(path: str | os.PathLike[str]) -> io.BufferedReader:
    """Open a file that a user names, to read it. To open a pipe would wait until somebody writes, perhaps for ever.

    /dev/null is an empty file. A pipe that this process was given may be read: /dev/stdin, or the shell's /dev/fd/63.

    Raises:
        OSError: it cannot be opened; or it is a pipe, a socket or a device, and `strerror` says so.
        ValueError: no file has such a name.
    """
    path = Path(path)
    if may_block(path) and not path.samefile(os.devnull) and not str(path.resolve()).startswith(_OF_PROCESSES):
        mode = path.stat().st_mode
        kind = next(name for is_kind, name in _KINDS if is_kind(mode))
        raise OSError(errno.EINVAL, f"{kind}, and no regular file", str(path))
    return path.open("rb")


def read_plain(path: str | os.PathLike[str]) -> bytes:
    """Return the content of a file that open_plain() opens; raise what that raises."""
    with open_plain(path) as file:
        return file.read()


def make_directories(path: str | os.PathLike[str], *, synced: bool = False) -> None:
    """Make a directory and its missing parents, each with mode 0700. `synced`: a power cut does not lose them."""
    if os.path.isdir(path):  # mostly: a process of a running system finds all that it needs
        return
    missing: list[Path] = []
    at = Path(path)
    with contextlib.suppress(OSError):  # its parent is not there
        os.mkdir(at, 0o700)
        if synced:
            _sync(at.parent)
        return
    while not at.is_dir():
        if at.exists():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(at))
        missing.append(at)
        at = at.parent
    for directory in reversed(missing):
        with contextlib.suppress(FileExistsError):  # another process was faster
            os.mkdir(directory, 0o700)
        if synced:
            _sync(directory.parent)


def _sync(directory: Path) -> None:
    # As SQLite does, ignore a directory that this user cannot read, or that its file system cannot sync.
    with contextlib.suppress(OSError), Folder.at(directory) as folder:
        os.fsync(folder.fd)


class NotOurs(PermissionError):
    """Something in a folder belongs to another user. `.owner`: the id of that user."""

    def __init__(self, path: Path, expected: int, got: int) -> None:
        runs = ", who runs this" if expected == os.geteuid() else ""
        super().__init__(errno.EPERM, f"expected to belong to user {expected}{runs}, got user {got}", str(path))
        self.owner = got


class NotAFile(OSError):
    """Something in the place of a file is no file, or has a second name (hard link). `.got` describes it."""

    def __init__(self, path: Path, got: str) -> None:
        super().__init__(errno.EINVAL, f"expected a file of its own, got {got}", str(path))
        self.got = got


class Place(msgspec.Struct, frozen=True):
    """The path of a directory in use, and what the kernel calls that directory."""

    path: str
    device: int
    inode: int

    def is_there(self) -> bool:
        """Return whether the path still leads to the directory. One system call."""
        try:
            found = os.stat(self.path)
        except (FileNotFoundError, NotADirectoryError):
            return False
        except OSError:  # this process may not look any more: that does not say that the directory is gone
            return True
        return (found.st_dev, found.st_ino) == (self.device, self.inode)

    def check(self) -> None:
        """Raise CatalogError if the path does not lead to the directory any more."""
        if not self.is_there():
            raise CatalogError(
                f"{self.path}: the directory in use is not there any more: it was removed or renamed, or something is"
                " mounted over it; nothing is written. Put it back, or stop the system",
                path=self.path,
                wanted=f"directory: {self.path} is not in its place",
            )


class Folder:
    """A directory that is held open by a descriptor of its own. Usable from any thread.

    The descriptor is closed once, by close() or when the last reference to the folder is gone: a second close could hit
    a file of another thread that has got the same number. A thread that passes `fd` on must hold the folder meanwhile.

    Attributes:
        fd: the descriptor; -1 once it is closed.
        owner: the user to whom the directory and its files must belong.
    """

    def __init__(self, path: str, fd: int, owner: int) -> None:
        self._path = path  # no Path: a child process would not need one, and each part of that copies memory
        self.fd = fd
        self.owner = owner
        self._close = weakref.finalize(self, os.close, fd)
        self._close.atexit = False  # other threads may use it until the process ends

    @classmethod
    def at(cls, path: str | os.PathLike[str], *, to_read: bool = False) -> Self:
        """Open the directory at a path. Links in the path are followed, because the caller chose the path.

        With `to_read` the directory may belong to another user; its files must belong to the same user then.
        """
        folder = cls.unlinked(os.path.realpath(path))
        if to_read:
            folder.owner = os.fstat(folder.fd).st_uid
        return folder

    @classmethod
    def unlinked(cls, path: str | os.PathLike[str]) -> Self:
        """Open the directory at a path. A link in the place of its last name is not followed: that is an OSError."""
        path = os.fspath(path)
        return cls(path, os.open(path, _AS_DIRECTORY), os.geteuid())

    @classmethod
    def below(cls, top: str | os.PathLike[str], path: Path) -> Self:
        """Open the directory at a path below `top`. A link in the place of `top` is followed, a link below it is not.

        Raises:
            NotAFile: a link is in the place of a directory.
        """
        folder = cls.at(top)
        for name in path.relative_to(top).parts:
            with folder:
                inner = f"{folder._path}/{name}"
                if os.path.islink(inner):
                    raise NotAFile(Path(inner), "a symbolic link")
                folder = cls(inner, os.open(name, _AS_DIRECTORY, dir_fd=folder.fd), folder.owner)
        return folder

    @property
    def path(self) -> Path:
        """The directory's path when it was opened."""
        return Path(self._path)

    @property
    def place(self) -> Place:
        """Where the directory is."""
        found = os.fstat(self.fd)
        return Place(self._path, found.st_dev, found.st_ino)

    def close(self) -> None:
        """Close the descriptor. A second call does nothing."""
        self.fd = -1
        self._close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    # -- the directory itself ------------------------------------------------------------------------------------

    def check_owner(self) -> os.stat_result:
        """Return the directory's stat result; raise NotOurs if it is another user's."""
        found = os.fstat(self.fd)
        if found.st_uid != self.owner:
            raise NotOurs(self.path, self.owner, found.st_uid)
        return found

    def tighten(self, mask: int) -> tuple[int, int]:
        """Remove the rights in `mask` if check_owner() allows it; return the directory's mode before and after."""
        mode = stat.S_IMODE(self.check_owner().st_mode)
        if mode & mask:
            os.fchmod(self.fd, mode & ~mask)
        return mode, mode & ~mask

    def is_there(self) -> bool:
        """Return whether the directory still exists: it may have been removed since it was opened."""
        return os.fstat(self.fd).st_nlink > 0

    def inner(self, name: str) -> Folder:
        """Open or make a directory in this one, with mode 0700; raise NotOurs and change nothing if it is not ours."""
        with contextlib.suppress(FileExistsError):
            os.mkdir(name, 0o700, dir_fd=self.fd)
        path = f"{self._path}/{name}"
        try:
            fd = os.open(name, _AS_DIRECTORY, dir_fd=self.fd)
        except OSError as error:
            error.filename = path
            raise
        folder = Folder(path, fd, self.owner)
        try:
            folder.tighten(0o077)
        except BaseException:
            folder.close()
            raise
        return folder

    # -- files ---------------------------------------------------------------------------------------------------

    def open(self, name: str, flags: int = os.O_RDONLY) -> io.FileIO:
        """Open a file. A new file has mode 0600. O_TRUNC empties the file after the checks.

        Raises:
            NotAFile: the name belongs to a link, a pipe, a device, a directory or a file with several names; nothing is
                changed, and the call does not wait.
            NotOurs: the file is another user's; nothing is changed.
            OSError: the file cannot be opened.
        """
        self.look(name)
        safe = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC  # nonblocking: the file may have become a pipe by now
        opening = functools.partial(os.open, mode=0o600, dir_fd=self.fd)
        try:
            # One call, for which Python runs no instruction of its own: an interrupt finds no descriptor without owner.
            file = next(map(io.FileIO, map(opening, (name,), ((flags & ~os.O_TRUNC) | safe,)), ("r+",)))
        except OSError as error:
            error.filename = str(self.path / name)
            raise
        try:
            found = os.fstat(file.fileno())
            self._check(name, found)
            if flags & os.O_TRUNC and found.st_size:
                os.ftruncate(file.fileno(), 0)
        except BaseException:
            file.close()
            raise
        return file

    def read(self, name: str) -> bytes:
        """Return the content of a file, which open() opens and checks."""
        with self.open(name) as file:
            return file.readall()

    def write(self, name: str, data: bytes, *, synced: bool = False) -> None:
        """Write a file whole, by a rename: a crash, or with `synced` a power cut, leaves the old file or the new."""
        new = f".{name}.new"
        self.discard(new)  # left by a crash
        with io.BufferedWriter(self.open(new, os.O_CREAT | os.O_EXCL | os.O_WRONLY)) as file:
            file.write(data)
            if synced:
                file.flush()
                os.fsync(file.fileno())
        self.rename(new, name)
        if synced:
            os.fsync(self.fd)

    def look(self, name: str) -> os.stat_result | None:
        """Return a file's stat result, checked as by open(), without opening the file; None if there is no file."""
        try:
            found = os.stat(name, dir_fd=self.fd, follow_symlinks=False)
        except FileNotFoundError:
            return None
        self._check(name, found)
        return found

    def _check(self, name: str, found: os.stat_result) -> None:
        if not stat.S_ISREG(found.st_mode):
            kind = next((kind for is_kind, kind in _KINDS if is_kind(found.st_mode)), "something unknown")
            raise NotAFile(self.path / name, kind)
        if found.st_uid != self.owner:
            raise NotOurs(self.path / name, self.owner, found.st_uid)
        if found.st_nlink > 1:
            raise NotAFile(self.path / name, f"a file with {found.st_nlink} names (hard links)")

    def has(self, name: str) -> bool:
        """Return whether the name exists, as a file or as anything else."""
        try:
            os.stat(name, dir_fd=self.fd, follow_symlinks=False)
        except FileNotFoundError:
            return False
        return True

    def names(self) -> list[str]:
        """Return the names of all entries of the directory."""
        fd = os.open(".", _AS_DIRECTORY, dir_fd=self.fd)  # listings by one open file share its place, and lose names
        try:
            return os.listdir(fd)
        finally:
            os.close(fd)

    def rename(self, old: str, new: str) -> None:
        """Rename the entry `old` to `new`, and replace an entry `new`."""
        os.rename(old, new, src_dir_fd=self.fd, dst_dir_fd=self.fd)

    def unlink(self, name: str) -> None:
        """Remove an entry that exists; the target of a link stays."""
        os.unlink(name, dir_fd=self.fd)

    def discard(self, name: str) -> None:
        """Remove an entry if it exists; ignore every OSError."""
        with contextlib.suppress(OSError):
            self.unlink(name)
