"""The journal: record the runs of callbacks in files that survive a kill, and check them against the promises.

Lines are "time registrar what resource attempt", appended with one write each. After a few hundred lines a new file
begins, so that a process whose files may not grow (the monkey's full disk) can still write.
"""

from __future__ import annotations

import os
import threading
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

_FILE_LIMIT_BYTES = 8 * 1024


class Line(NamedTuple):
    """One line. `what`: load, loaded, failed, unload, unloaded; or an operation of a consumer in its own process."""

    at: int  # time.monotonic_ns(), the same clock in all processes
    registrar: str
    what: str
    subject: str  # a resource's id, or an error's name
    attempt: int
    pid: int


class Journal:
    """This process's files of the journal in a directory. Any thread may write."""

    def __init__(self, directory: Path | str) -> None:
        self._directory = Path(directory)
        self._lock = threading.Lock()
        self._file = -1
        self._written = 0

    def note(self, registrar: str, what: str, subject: str, attempt: int = 0) -> None:
        """Append a line; once this returns, the line outlives the process."""
        with self._lock:
            now = time.monotonic_ns()
            if self._file < 0 or self._written > _FILE_LIMIT_BYTES:
                self._begin(now)
            line = f"{now} {registrar} {what} {subject} {attempt}\n".encode()
            self._written += os.write(self._file, line)

    def _begin(self, now: int) -> None:
        self.close()
        path = self._directory / f"{os.getpid()}-{now}.journal"
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        self._written = 0

    def close(self) -> None:
        """Close the present file."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def read_journal(directory: Path) -> list[Line]:
    """Return the lines that all processes wrote, oldest first, without a last line that a kill has torn."""
    found: list[Line] = []
    for path in directory.glob("*.journal"):
        pid = int(path.name.partition("-")[0])
        for text in path.read_text().split("\n")[:-1]:
            at, registrar, what, subject, attempt = text.split(" ")
            found.append(Line(int(at), registrar, what, subject, int(attempt), pid))
    return sorted(found)


def check_journal(lines: Iterable[Line], living: Mapping[str, set[str]]) -> list[str]:
    """Return each wrong deed of a callback as a sentence.

    For each resource loads come first, then unloads. A callback runs again only after an interruption, and with a
    higher attempt. Exactly the resources that were loaded and not unloaded are in the catalog (`living`: resource ids
    by registrar). If a process dies in a load, a later process may unload it, even if it had just failed: the load was
    withdrawn, or that was its last attempt, and no process knows how far it came.
    """
    of: dict[tuple[str, str], list[Line]] = defaultdict(list)
    for line in lines:
        if line.what in ("load", "loaded", "failed", "unload", "unloaded"):
            of[line.registrar, line.subject].append(line)
    violations: list[str] = []
    for (registrar, resource), history in of.items():
        what = f"journal: {registrar}: resource {resource}"
        told = " ".join(f"{line.what}/{line.attempt}@{line.pid}" for line in history)
        wrongs = _wrong(history, resource in living.get(registrar, ()))
        violations += [f"{what}: {wrong}: {told}" for wrong in wrongs]
    for registrar, resources in living.items():
        violations += [
            f"journal: {registrar}: resource {resource} is in the catalog and was never loaded"
            for resource in resources
            if (registrar, resource) not in of
        ]
    return violations


def _wrong(history: list[Line], lives: bool) -> Iterator[str]:
    begun: dict[str, Line] = {}  # the last run of each callback
    open_run: Line | None = None
    outcome = ""
    for line in history:
        if line.what in ("load", "unload"):
            before = begun.get(line.what)
            if before is not None and line.attempt <= before.attempt:
                yield f"{line.what} run again without being told so (attempt {line.attempt} after {before.attempt})"
            if open_run is not None and open_run.pid == line.pid:
                yield f"{line.what} while {open_run.what} runs"
            if line.what == "load" and "unload" in begun:
                yield "loaded after its unload"
            cut_off = outcome in ("loading", "failed") and begun["load"].pid != line.pid
            if line.what == "unload" and outcome not in ("loaded", "unloaded") and not cut_off:
                yield f"unloaded when it was {outcome or 'not loaded'}"
            begun[line.what] = open_run = line
            if line.what == "load":
                outcome = "loading"
        else:
            if open_run is None or open_run.pid != line.pid:
                yield f"{line.what} without a beginning in its process"
            outcome, open_run = line.what, None
    if open_run is not None:
        yield f"{open_run.what} interrupted and not run again"
    elif outcome == "loaded" and not lives:
        yield "loaded, never unloaded, and not in the catalog"
    elif outcome != "loaded" and lives:
        yield f"in the catalog, though {outcome}"
