"""Census: find the processes of one chaos run by a mark in their environment, so that no other one is harmed."""

from __future__ import annotations

import os
import signal
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from chaos.victim_managers import LOG_TO, OWNER
from rr_actors.runtime.processes.control_groups import ControlGroup, group_of
from rr_actors.runtime.processes.lifeline import signal_if

_VARIABLE = "RR_ACTORS_CHAOS"


@dataclass(frozen=True)
class Census:
    """The living processes of the run.

    Attributes:
        managers: the managers' process ids by registrar.
        fork_servers: the processes that make the others.
        others: supervisors in processes of their own, and processes that are still starting.
    """

    managers: Mapping[str, int]
    fork_servers: tuple[int, ...]
    others: tuple[int, ...]


class Mark:
    """The mark of this run's processes: a variable that they inherit. Make it before the first of them.

    Args:
        log_dir: the directory for their logs; they inherit it in another variable.
    """

    def __init__(self, log_dir: Path) -> None:
        variables = {_VARIABLE: uuid.uuid4().hex, LOG_TO: str(log_dir)}
        self._mark = f"{_VARIABLE}={variables[_VARIABLE]}".encode()
        self._before = {name: os.environ.get(name) for name in variables}
        os.environ.update(variables)

    def remove(self) -> None:
        """Remove the mark from this process: processes that it starts later are not of this run."""
        for name, value in self._before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value

    def processes(self) -> dict[int, int]:
        """Return the living processes of this run except this one: their parents' ids by their ids."""
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
        """Return the living daemons of this run whose managers have ended."""
        living = self.processes()
        return [pid for pid in living if (owner := _owner_of(pid)) is not None and owner not in living]

    def is_on(self, pid: int) -> bool:
        """Return whether a process is of this run."""
        return self._mark in _variables(pid)

    def signal(self, pid: int, number: signal.Signals) -> bool:
        """Send a process a signal; return False if it has ended, or is not of this run."""
        try:
            return signal_if(pid, number, lambda: self.is_on(pid))
        except OSError:
            return False

    def census(self, state_dir: Path, registrars: tuple[str, ...]) -> Census:
        """Return the living processes by role. A manager's pid is in the first line of its catalog's lock file."""
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


def stands(pid: int) -> bool:
    """Return whether a process stands still: stopped by a signal, or frozen with its control group."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return False
    group = group_of(pid)
    return fields[0] == "T" or (group is not None and ControlGroup(group).is_frozen())


def _owner_of(pid: int) -> int | None:
    """Return the pid of the manager that started this daemon; None if the process is no daemon."""
    prefix = f"{OWNER}=".encode()
    return next((int(one.removeprefix(prefix)) for one in _variables(pid) if one.startswith(prefix)), None)


def _variables(pid: int) -> list[bytes]:
    """Return a process's environment; nothing if it has ended, or is another user's."""
    try:
        return Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return []
