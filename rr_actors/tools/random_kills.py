"""Random kills: kill children of a running system at random, and check that it recovers.

The supervisors say which process each child has now, and the console sends the signal: no pid is kept between a look
and a kill. After each kill the child must run again, and the catalogs must agree.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import msgspec

from rr_actors.base.config import CATALOG_FILE
from rr_actors.base.errors import ActorUnavailable, NotFound, NotRunning, UsageError, few
from rr_actors.base.names import child_meant, no_child
from rr_actors.system.console.console_commands import Kill
from rr_actors.system.console.console_connection import ConsoleConnection
from rr_actors.system.console.console_messages import ChildRow
from rr_actors.tools.inspection import Contents, check, check_delivered, read_state

_LOOK_S = 0.1
_MOMENT_S = 0.5  # the longest pause before a kill, so that kills come at any moment of the children's work
_MOVING = ("starting", "restarting", "unavailable")


class KillPlan(msgspec.Struct, frozen=True):
    """What to kill, and how often.

    Attributes:
        kills: the number of kills.
        seed: the seed of the choices and of the pauses.
        seconds: begin no kill after this number of seconds.
        only: paths or ids of children; a supervisor stands for itself and for all below it. (): any child.
        regardless: kill a child even if its supervisor then gives up, because it has restarted too often.
        timeout_s: seconds until a killed child must run again, and then until the catalogs must agree.
    """

    kills: int
    seed: int
    seconds: float | None = None
    only: tuple[str, ...] = ()
    regardless: bool = False
    timeout_s: float = 30.0


class Killed(msgspec.Struct, frozen=True):
    """A kill: the child, the process that it had, and after how many seconds it ran again; None: not in time."""

    path: str
    pid: int
    back_s: float | None = None


class KillReport(msgspec.Struct):
    """What was done, and what is wrong.

    Attributes:
        left_alone: why a child was never killed, by its path.
        violations: what is wrong, a sentence each. The first of them ended the run.
        interrupted: whether Ctrl-C ended the run. What follows the last kill was then not checked.
    """

    seed: int
    left_alone: dict[str, str]
    kills: list[Killed] = []
    seconds: float = 0.0
    catalogs: int = 0
    queries: int = 0
    violations: list[str] = []
    interrupted: bool = False


class RandomKills:
    """A run of kills at a system.

    Args:
        say: is called with a line of progress for people.

    Attributes:
        report: is complete when run() has returned.

    Raises:
        NotFound: `plan.only` names no child.
        UsageError: no child can be killed; the text says why.
    """

    def __init__(self, connection: ConsoleConnection, plan: KillPlan, say: Callable[[str], None]) -> None:
        self._connection = connection
        self._plan = plan
        self._say = say
        self._chance = random.Random(plan.seed)
        self._state_dir = Path(connection.welcome.state_dir)
        self._returns: set[str] = set()  # paths of children that their supervisors start again
        self._began = time.monotonic()
        self.report = KillReport(plan.seed, {})
        rows = self._rows()
        for name in plan.only:
            if child_meant(name, rows) is None:
                raise no_child(name, rows)
        if not self.victims(rows):
            reasons = few(f"{path}: {why}" for path, why in self.report.left_alone.items()) or "no child runs"
            raise UsageError(f"chaos: expected a child that can be killed and comes back, found none ({reasons})")

    def victims(self, rows: Mapping[str, ChildRow] | None = None) -> list[str]:
        """Return the paths of the children that can be killed now, and note in the report why others cannot."""
        rows = self._rows() if rows is None else rows
        tops = tuple(f"{child_meant(name, rows)}/" for name in self._plan.only)
        wanted = [path for path in sorted(rows) if rows[path].depth and f"{path}/".startswith(tops or "")]
        return [path for path in wanted if rows[path].pid is not None and self._comes_back(path, rows)]

    def _comes_back(self, path: str, rows: Mapping[str, ChildRow]) -> bool:
        if path in self._returns or path in self.report.left_alone:
            return path in self._returns
        above = path.rpartition("/")[0]
        try:
            facts = self._connection.ask(Kill(path, dry_run=True)).facts
        except UsageError:
            why = "it runs in a thread, in a process with others"
        except (ActorUnavailable, NotFound):  # it has ended meanwhile
            return False
        else:
            if facts["restart"] == "temporary":
                why = "it is temporary: nobody starts it again"
            elif not rows[above].max_restarts and not self._plan.regardless:
                why = f"its supervisor {above} allows no restart (see --regardless)"
            else:
                self._returns.add(path)
                return True
        self.report.left_alone[path] = why
        return False

    def run(self) -> KillReport:
        """Kill until the plan is done, something is wrong, or Ctrl-C, and return the report.

        Raises:
            NotRunning: the system ended before the first kill.
        """
        report = self.report
        try:
            self._check("before the first kill")
            while not report.violations and len(report.kills) < self._plan.kills and not self._is_late():
                self._kill_one()
        except NotRunning:
            if not report.kills:
                raise
            report.violations.append(f"the system ended after {report.kills[-1].path} was killed")
        except KeyboardInterrupt:
            report.interrupted = True
        report.seconds = time.monotonic() - self._began
        return report

    def _kill_one(self) -> None:
        path = self._choose()
        if path is None:
            return
        time.sleep(self._chance.uniform(0.0, _MOMENT_S))
        before = self._rows()
        try:
            pid: int = self._connection.ask(Kill(path)).facts["pid"]
        except (ActorUnavailable, NotFound):  # it has ended meanwhile: no process got a signal
            return
        self.report.kills.append(Killed(path, pid))
        back_s = self._await_return(path, pid, before)
        if back_s is not None:
            self.report.kills[-1] = Killed(path, pid, back_s)
            number = f"{len(self.report.kills)} of {self._plan.kills}"
            self._say(f"{number}: killed {path} (pid {pid}); it runs again after {back_s:.1f} s")
            self._check(f"after {path} was killed")

    def _choose(self) -> str | None:
        """Choose a child whose supervisor may restart it; wait until there is one. None: the time is over."""
        until = time.monotonic() + self._plan.timeout_s
        said: set[str] = set()
        while not self._is_late():
            rows = self._rows()
            victims = self.victims(rows)
            if free := victims if self._plan.regardless else [path for path in victims if _has_room(path, rows)]:
                return self._chance.choice(free)
            for above in sorted({path.rpartition("/")[0] for path in victims} - said):
                said.add(above)
                self._say(f"{above} has made all the restarts that it allows ({rows[above].strategy}): waiting")
            if not victims and time.monotonic() > until:
                self.report.violations.append(f"no child that can be killed has run for {self._plan.timeout_s:g} s")
                return None
            time.sleep(_LOOK_S)
        return None

    def _await_return(self, path: str, pid: int, before: Mapping[str, ChildRow]) -> float | None:
        """Wait until a killed child and all that ran before run, and return after how many seconds; else None."""
        killed_at = time.monotonic()
        while missing := missing_after(path, pid, before, self._rows()):
            if time.monotonic() - killed_at > self._plan.timeout_s:
                text = f"{path} was killed, and after {self._plan.timeout_s:g} s"
                self.report.violations += [f"{text} {one}" for one in missing]
                return None
            time.sleep(_LOOK_S)
        return time.monotonic() - killed_at

    def _check(self, when: str) -> None:
        """Look at the catalogs until none of the disagreements of the first look is left, or the time is over.

        What is in flight looks like a disagreement, and a system in use always has some: each has the whole time.
        """
        until = time.monotonic() + self._plan.timeout_s
        left = set(self._look())
        while left and time.monotonic() < until:
            time.sleep(_LOOK_S)
            left &= set(self._look())
        self.report.violations += [f"{when}: {one}" for one in sorted(left)]

    def _look(self) -> list[str]:
        registrars = {row.name: row.status for row in self._connection.registrars().rows}
        state = _catalogs(self._state_dir)
        down = {name for name in {*registrars, *state} if registrars.get(name) != "up"}
        self.report.catalogs = len(state)
        self.report.queries = sum(len(contents.queries) for contents in state.values())
        return [*check(state), *check_delivered(state, down)]

    def _rows(self) -> dict[str, ChildRow]:
        rows = self._connection.children().rows
        if rows[0].state == "stopped":
            raise NotRunning(f"the system in {self._state_dir} has ended: {rows[0].error}")
        return {row.path: row for row in rows}

    def _is_late(self) -> bool:
        return self._plan.seconds is not None and time.monotonic() - self._began > self._plan.seconds


def missing_after(path: str, pid: int, before: Mapping[str, ChildRow], now: Mapping[str, ChildRow]) -> Sequence[str]:
    """Return what is still missing after the child at `path`, with process `pid`, was killed, a sentence each.

    A child that was stopped, or has left, has ended cleanly: only those count that are on their way.
    """
    killed = now.get(path)
    if killed is None:
        return [f"{path} is not in the tree"]
    if killed.state != "running" or killed.pid in (None, pid):
        return [_state(killed)]
    ran = {row.path for row in before.values() if row.state == "running"}
    return [_state(row) for row in now.values() if row.state in _MOVING and row.path in ran]


def _state(row: ChildRow) -> str:
    return f"{row.path} is {row.state}{f': {row.error}' if row.error else ''}"


def _has_room(path: str, rows: Mapping[str, ChildRow]) -> bool:
    """Return whether a restart of this child is allowed, also if those count later that are excused for now."""
    above = rows[path.rpartition("/")[0]]
    return above.recent_restarts + above.excused_restarts < above.max_restarts


def _catalogs(state_dir: Path) -> dict[str, Contents]:
    return read_state(state_dir) if any(state_dir.glob(f"*/{CATALOG_FILE}")) else {}
