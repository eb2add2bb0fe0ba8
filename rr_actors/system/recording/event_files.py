"""Files with what happened in a system: a recording, or the history that each state directory has."""

from __future__ import annotations

import os
import time
from pathlib import Path

import msgspec

from rr_actors.base.errors import ConfigError
from rr_actors.base.folder import open_plain, read_plain
from rr_actors.registrar.model.recorded import Entry
from rr_actors.supervision.event_history import Record
from rr_actors.system.recording.event_memory import FILE, OLDER, event_in
from rr_actors.system.recording.recordings import LINE_LIMIT, Recording, add, entry_of, recording_in


def read_events(path: str | os.PathLike[str]) -> Recording:
    """Return what happened, as a recording: of a recording's file, a state directory, or the history.jsonl in one.

    A history has the events of children, and what the system remembers of its resources. A line of it that is not whole
    is left out.

    Raises:
        ConfigError: it cannot be read, or is none of these; the error names the line.
    """
    path = Path(path)
    if path.is_dir():
        files = [path / name for name in (OLDER, FILE) if (path / name).exists()]
        if not files:
            expected = f"a recording, or a state directory with a {FILE}"
            raise ConfigError(
                f"{path}: cannot be read: expected {expected}, got a directory without one", file=str(path)
            )
        return _history(path, [entry for file in files for entry in _read_history(file)])
    try:
        with open_plain(path) as file:
            first = file.readline(LINE_LIMIT)
            if first.startswith(b'{"event":'):
                return _history(path, _entries_in(path, first + file.read()))
            if not first:
                raise ConfigError(f"{path}: expected a recording, or a {FILE}, got an empty file", file=str(path))
            recording = recording_in(path, file, first)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}", file=str(path)) from error
    for entry in recording.entries():
        _check(path, entry)
    return recording


def _history(path: Path, entries: list[Entry]) -> Recording:
    recording = Recording(path.name, limit=max(1, len(entries)))
    add(recording, entries)
    recording.since = min((entry.at for entry in entries), default=0.0)
    recording.is_history = True
    return recording


def _check(path: Path, entry: Entry) -> None:
    """Raise ConfigError if an entry cannot be shown."""
    try:
        time.localtime(entry.at)
        if entry.process and not entry.server:
            must_have = {"path": entry.process, "kind": "", "run": 0, "event": entry.event, "at": entry.at}
            msgspec.convert(must_have | entry.facts, Record)
    except (msgspec.MsgspecError, OverflowError, ValueError, OSError) as error:
        text = f"{path}: {entry.event}, number {entry.seq}: expected what rr-actors record writes: {error}"
        raise ConfigError(text, file=str(path)) from error


def _read_history(path: Path) -> list[Entry]:
    try:
        return _entries_in(path, read_plain(path))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}", file=str(path)) from error


def _entries_in(path: Path, history: bytes) -> list[Entry]:
    entries: list[Entry] = []
    for number, line in enumerate(history.splitlines(keepends=True), 1):
        try:
            event = event_in(line)
            time.localtime(event.at)
            entries.append(entry_of(event))
        except (msgspec.MsgspecError, RecursionError, OverflowError, ValueError, OSError) as error:
            if isinstance(error, msgspec.DecodeError) and not isinstance(error, msgspec.ValidationError):
                continue  # a crash has cut it
            text = f"{path}: line {number}: expected a recording, or a state directory's history.jsonl: {error}"
            raise ConfigError(text, file=str(path)) from error
    return entries
