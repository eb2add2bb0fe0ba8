"""Notes of a manager under test: a file to which its processes append what they do, in order.

A line is one write to a file that is open for appending. So the lines of all processes stand in the order in which they
were written, and those of a process that gets SIGKILL stay.
"""

from __future__ import annotations

import os
from pathlib import Path

import msgspec

from rr_actors.registrar.servers.callback_context import current_or_none

_FILE = "notes"


class Note(msgspec.Struct, frozen=True):
    """One line.

    Attributes:
        pid: the process that wrote it.
        what: "started", "server", "begin", "end", "raised", "killed", "blocked", "opened", "closed", "race" or
            "census".
        role: the name of the callback's role.
        name: the resource's name for people.
        attempt: 1 at first; more if a crash interrupted an earlier run of the callback.
        text: what there is to say.
        outlives: of "opened" and "closed": whether the device stays open when the process dies.
    """

    pid: int
    what: str
    role: str = ""
    server: str = ""
    resource: str = ""
    name: str = ""
    attempt: int = 0
    text: str = ""
    outlives: bool = False

    def __str__(self) -> str:
        about = f"{self.role} {self.name}".strip()
        again = f" (attempt {self.attempt})" if self.attempt > 1 else ""
        lines = self.text.strip().split("\n")
        said = lines[0] if self.what == "race" else lines[-1]
        return f"{self.pid}  {self.what:<8}{about}{again}{': ' if said and about else ''}{said}"


class Notebook:
    """Appends notes of this process. From any thread.

    Args:
        directory: where the file is.
    """

    def __init__(self, directory: str) -> None:
        self._fd = os.open(Path(directory) / _FILE, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)

    def write(self, what: str, role: str = "", text: str = "", *, server: str = "", outlives: bool = False) -> None:
        """Append a note about the callback that runs here, if one does. When this returns, it outlives the process."""
        now = current_or_none()
        if now is None:
            note = Note(os.getpid(), what, role, server, text=text, outlives=outlives)
        else:
            place = server or now.server, now.resource_id, now.name, now.attempt
            note = Note(os.getpid(), what, role, *place, text, outlives)
        self.append(note)

    def append(self, note: Note) -> None:
        """Append a note."""
        os.write(self._fd, msgspec.json.encode(note) + b"\n")


def append_note(directory: str, note: Note) -> None:
    """Append a note, from a process that keeps no notebook."""
    with (Path(directory) / _FILE).open("ab", buffering=0) as file:
        file.write(msgspec.json.encode(note) + b"\n")


class NoteReader:
    """Reads what the processes append.

    Attributes:
        notes: what has been read.
    """

    def __init__(self, directory: Path) -> None:
        self.notes: list[Note] = []
        self._decoder = msgspec.json.Decoder(Note)
        self._rest = b""
        path = directory / _FILE
        path.touch(0o600)
        self._file = path.open("rb", buffering=0)

    def read(self) -> list[Note]:
        """Read what is new, and return all notes."""
        if more := self._file.read():
            *lines, self._rest = (self._rest + more).split(b"\n")
            self.notes += map(self._decoder.decode, lines)
        return self.notes

    def close(self) -> None:
        """Close the file."""
        self._file.close()


_here: list[Notebook] = []


def begin_notes(directory: str) -> Notebook:
    """Return the notebook of this process, which is a manager under test."""
    if not _here:
        _here.append(Notebook(directory))
    return _here[0]


def opened(key: str, *, outlives: bool = False) -> None:
    """Say that a device is open from now on. For the fake driver of a test; outside of check_manager() it does nothing.

    check_manager() then also checks that each device is closed as often as it was opened, whatever kills the manager.

    Args:
        key: the device, as the messages of the check name it.
        outlives: whether the device stays open when the process of the manager dies, as a power supply does. Default:
            False, the kernel closes it, as it does with a port.
    """
    for notebook in _here:
        notebook.write("opened", text=key, outlives=outlives)


def closed(key: str, *, outlives: bool = False) -> None:
    """Say that a device is closed from now on.

    Args:
        key, outlives: as opened() was given them.
    """
    for notebook in _here:
        notebook.write("closed", text=key, outlives=outlives)
