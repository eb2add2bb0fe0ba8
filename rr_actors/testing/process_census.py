"""Census: the processes of one chaos run, found by a mark in their environment, and never another one harmed."""

from __future__ import annotations

import os
import signal
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from rr_actors.runtime.processes.lifeline import signal_if
from rr_actors.testing.victim_managers import LOG_TO, OWNER

_VARIABLE = "RR_ACTORS_CHAOS"


@dataclass(frozen=True)
class Census:
    """Who lives now.

    Attributes:
        managers: process ids by registrar.
        fork_servers: who makes processes.
        others: supervisors in processes of their own, and processes that have yet to say who they are.
    """

    managers: Mapping[str, int]
    fork_servers: tuple[int, ...]
    others: tuple[int, ...]


class Mark:
    """What marks this run's processes: a variable that they inherit. Made before the first of them is.

    Args:
        log_dir: for their logs; they hear it in the same way.
    """

    def __init__(self, log_dir: Path) -> None:
        variables = {_VARIABLE: uuid.uuid4().hex, LOG_TO: str(log_dir)}
        self._mark = f"{_VARIABLE}={variables[_VARIABLE]}".encode()
        self._before = {name: os.environ.get(name) for name in variables}
        os.environ.update(variables)

    def remove(self) -> None:
        """Processes started from now on are not of this run."""
        for name, value in self._before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value

    def processes(self) -> dict[int, int]:
        """The living processes of this run but this one: their parents' ids by their ids."""
        found: dict[int, int] = {}
        for entry in os.listdir("/proc"):
            if entry.isdigit() and int(entry) != os.getpid() and self.is_on(int(entry)):
                try:
                    fields = Path(f"/proc/{entry}/stat").read_text().rpartition(")")[2].split()
                except OSError:
                    continue
                if fields[0] not in "ZX":
                    found[int(entry)] = int(fields[1])
        return found

    def strays(self) -> list[int]:
        """The living daemons of this run whose managers have ended."""
        living = self.processes()
        return [pid for pid in living if (owner := _owner_of(pid)) is not None and owner not in living]

    def is_on(self, pid: int) -> bool:
        """Whether a process is of this run."""
        try:
            return self._mark in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
        except OSError:
            return False

    def signal(self, pid: int, number: signal.Signals) -> bool:
        """Send a signal; False if it has ended, or is not of this run."""
        try:
            return signal_if(pid, number, lambda: self.is_on(pid))
        except OSError:
            return False

    def census(self, state_dir: Path, registrars: tuple[str, ...]) -> Census:
        """Look who is who: a manager's process holds its catalog's lock, and has said so in its first line."""
        living = self.processes()
        managers: dict[str, int] = {}
        for name in registrars:
            try:
                pid = int((state_dir / name / "catalog.lock").read_text().partition("\n")[0] or 0)
            except (OSError, ValueError):
                continue
            if pid in living:
                managers[name] = pid
        servers = {living[pid] for pid in managers.values() if living[pid] in living}
        known = {*managers.values(), *servers}
        others = [pid for pid, parent in living.items() if pid not in known and parent in servers]
        return Census(managers, tuple(sorted(servers)), tuple(others))


def _owner_of(pid: int) -> int | None:
    """The manager that started this daemon; None if it is none."""
    try:
        variables = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return None
    prefix = f"{OWNER}=".encode()
    return next((int(variable.removeprefix(prefix)) for variable in variables if variable.startswith(prefix)), None)
