"""VirtualTree: a whole tree of supervisors that decide as always, with children on paper and a clock that jumps.

Each supervisor's state changes by the decisions of restarts.py alone. What supervision/engine.py does with processes
is done here with a queue of what comes next. So an hour takes milliseconds, and the same seed gives the same hour.

The supervision around it behaves as with real processes in what this models: one start at a time where the core asks
for it, time limits of starts and stops, heartbeats, and a supervisor's process whose end takes all below with it. It
does not model callbacks of resources, want of memory or descriptors, and children that are added at run time.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from rr_actors.base.errors import RrError, StartFailed
from rr_actors.supervision.core import restarts
from rr_actors.supervision.core.specs import Chance, ChildModel, ChildSpec, EndReason, Supervisor, draw
from rr_actors.supervision.core.state import (
    Decision,
    Exit,
    ExitSupervisor,
    Report,
    StartChild,
    StopChild,
    SupervisorStarted,
    SupervisorState,
    Why,
)

_ENDS: Mapping[EndReason, Exit] = {
    "killed": Exit("killed", "SIGKILL", -9),
    "abnormal": Exit("abnormal", "exit code 1", 1),
    "normal": Exit("normal", "exit code 0", 0),
}


class Happening(NamedTuple):
    """A report of a supervisor, with the facts of the run that it is about.

    Attributes:
        at: seconds since the tree's start.
        path: the child's.
        spec: with which the child was started last; None if it never was.
        is_restart: whether that start was a restart.
        began, ready_at: of that run, in seconds since the tree's start; None if it did not come to that.
    """

    at: float
    path: str
    report: Report
    spec: ChildSpec | None
    is_restart: bool
    began: float | None
    ready_at: float | None


class Uptime:
    """When one child was up, and how often it ended.

    Attributes:
        up_s: seconds in which it was ready.
        deaths: how often it ended by itself, or was killed.
        starts: how often it became ready.
        longest_outage_s: the longest time between two of these, or from the last one to the end.
    """

    __slots__ = ("_down_since", "_up_since", "deaths", "longest_outage_s", "starts", "up_s")

    def __init__(self) -> None:
        self.up_s = self.longest_outage_s = 0.0
        self.deaths = self.starts = 0
        self._up_since: float | None = None
        self._down_since: float | None = None

    def up(self, now: float) -> None:
        """Note that the child is ready."""
        self.starts += 1
        self._up_since = now
        if self._down_since is not None:
            self.longest_outage_s = max(self.longest_outage_s, now - self._down_since)
            self._down_since = None

    def down(self, now: float) -> None:
        """Note that the child does not work any more."""
        if self._up_since is not None:
            self.up_s += now - self._up_since
            self._up_since, self._down_since = None, now

    def end(self, now: float) -> None:
        """Note the end of the time that is looked at."""
        if self._up_since is not None:
            self.up_s += now - self._up_since
            self._up_since = None
        elif self._down_since is not None:
            self.longest_outage_s = max(self.longest_outage_s, now - self._down_since)


class _Run:
    """One run of one child. `level` is the supervisor that the child is, while it runs."""

    __slots__ = ("action", "began", "is_hung", "is_over", "is_stopping", "level", "path", "ready_at")

    def __init__(self, action: StartChild, path: str) -> None:
        self.action = action
        self.path = path
        self.began: float | None = None
        self.ready_at: float | None = None
        self.level: _Level | None = None
        self.is_hung = self.is_over = self.is_stopping = False


class VirtualTree:
    """A tree in virtual time. `run(until_s)` lets that time pass.

    Args:
        models: of children, by path. The others never fail, and start as `default` says.
        deaths: when which child's process ends, by path, and how.
        chance_of: returns the random numbers of the child at a path. Each child has its own, so what happens to one
            changes nothing for the others.
        start_timeout_s: the system's time limit for a start.
    """

    def __init__(
        self,
        spec: Supervisor,
        models: Mapping[str, ChildModel],
        default: ChildModel,
        deaths: Iterable[tuple[float, str, EndReason]] = (),
        *,
        chance_of: Callable[[str], Chance],
        start_timeout_s: float | None = None,
    ) -> None:
        self.now = 0.0
        self.happenings: list[Happening] = []
        self.uptimes: dict[str, Uptime] = {}
        self.missed: list[tuple[float, str]] = []
        self.ended_at: float | None = None
        self.error: RrError | None = None
        self.was_ready = False
        self.start_timeout_s = start_timeout_s
        self._models, self._default, self._chance_of = models, default, chance_of
        self._chances: dict[str, Chance] = {}
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = itertools.count()
        self.runs: dict[str, _Run] = {}
        self._root = _Level(self, spec, spec.id, None)
        for at, path, reason in deaths:
            self.at(at, lambda path=path, reason=reason: self._strike(path, reason))
        self.at(0.0, self._root.start)

    def run(self, until_s: float) -> None:
        """Let the time pass until then, or until the tree has ended."""
        queue = self._queue
        while queue and queue[0][0] <= until_s and self.ended_at is None:
            self.now, _, step = heapq.heappop(queue)
            step()
        self.now = until_s
        for uptime in self.uptimes.values():
            uptime.end(until_s)

    # -- what levels use -------------------------------------------------------------------------------------------

    def at(self, at: float, step: Callable[[], None]) -> None:
        """Have a step taken at a time, after those that have been asked for that time before."""
        heapq.heappush(self._queue, (at, next(self._numbers), step))

    def soon(self, step: Callable[[], None]) -> None:
        """Have a step taken now, after those that are due."""
        self.at(self.now, step)

    def chance(self, path: str) -> Chance:
        """Return the random numbers of the child at a path."""
        if (chance := self._chances.get(path)) is None:
            chance = self._chances[path] = self._chance_of(path)
        return chance

    def model(self, path: str) -> ChildModel:
        """Return how the child at a path behaves."""
        return self._models.get(path, self._default)

    def uptime(self, path: str) -> Uptime:
        """Return when the child at a path was up."""
        return self.uptimes.setdefault(path, Uptime())

    def _strike(self, path: str, reason: EndReason) -> None:
        run = self.runs.get(path)
        level = None if run is None else self._level_of(path)
        if run is None or level is None or run.is_over or run.began is None:
            self.missed.append((self.now, path))
        else:
            level.end(run, _ENDS[reason])

    def _level_of(self, path: str) -> _Level | None:
        """Return the supervisor that the child at a path has now."""
        above = path.rpartition("/")[0]
        if above == self._root.path:
            return self._root
        run = self.runs.get(above)
        return None if run is None else run.level


class _Level:
    """One supervisor of a VirtualTree: what supervision/engine.py is for a real one."""

    def __init__(self, tree: VirtualTree, spec: Supervisor, path: str, within: tuple[_Level, _Run] | None) -> None:
        self.path = path
        self._tree = tree
        self._within = within  # the supervisor above it, and its own run there
        self._state = SupervisorState.of(spec, path)
        self._runs: dict[int, _Run] = {}
        self._is_dead = False

    def start(self) -> None:
        self._apply(restarts.decide_start(self._state, self._tree.now))

    def stop(self) -> None:
        self._apply(restarts.decide_stop(self._state, self._tree.now))

    def kill(self) -> None:
        """End all below at once, without a decision: their process is gone."""
        self._is_dead = True
        for run in self._runs.values():
            self._over(run)

    def end(self, run: _Run, exit: Exit) -> None:
        """Note that the child has ended by itself or was killed, whatever it did at the time."""
        path, number, now = run.path, run.action.run, self._tree.now
        self._tree.uptime(path).deaths += 1
        self._over(run)
        if run.is_stopping:
            self._apply(restarts.decide_stopped(self._state, run.action.id, number, exit, now))
        elif run.ready_at is None:
            text = f"{path}: {exit} before it was ready"
            self._start_failed(run, StartFailed(text, id=path, code=exit.code))
        else:
            chance = self._tree.chance(path)()
            self._apply(restarts.decide_exit(self._state, run.action.id, number, exit, now, chance))

    # -- actions ---------------------------------------------------------------------------------------------------

    def _apply(self, decision: Decision) -> None:
        if self._is_dead:
            return
        self._state, actions = decision
        tree = self._tree
        for action in actions:
            match action:
                case StartChild():
                    run = _Run(action, f"{self.path}/{action.id}")
                    self._runs[action.run] = tree.runs[run.path] = run
                    tree.at(tree.now + action.delay_s, lambda run=run: self._begin(run))
                case StopChild():
                    run = self._runs[action.run]
                    run.is_stopping = True
                    tree.soon(lambda run=run, action=action: self._stop(run, action))
                case Report():
                    self._note(action)
                case SupervisorStarted():
                    self._is_up()
                case ExitSupervisor():
                    tree.soon(lambda action=action: self._has_ended(action))
                case _:  # nobody calls
                    pass

    def _note(self, report: Report) -> None:
        tree, path, run = self._tree, f"{self.path}/{report.id}", self._runs.get(report.run)
        if run is None:
            tree.happenings.append(Happening(tree.now, path, report, None, False, None, None))
        else:
            is_restart = run.action.why is Why.RESTART
            happening = Happening(tree.now, path, report, run.action.spec, is_restart, run.began, run.ready_at)
            tree.happenings.append(happening)

    def _begin(self, run: _Run) -> None:
        if run.is_over or run.is_stopping or self._is_dead:
            return
        tree, spec = self._tree, run.action.spec
        run.began = tree.now
        if isinstance(inner := spec.actor_class_or_manager, Supervisor):
            run.level = _Level(tree, inner, run.path, (self, run))
            run.level.start()
            return
        model, chance = tree.model(run.path), tree.chance(run.path)
        takes_s, fails = draw(model.start_s, chance), chance() < model.start_fails
        limit_s = tree.start_timeout_s if spec.start_timeout_s is None else spec.start_timeout_s
        if limit_s is not None and takes_s > limit_s:
            killed = Exit("killed", f"on_start had not returned after {limit_s:g} s (start_timeout_s)", -9)
            tree.at(tree.now + limit_s, lambda: self._end_unless_over(run, killed))
        elif fails:
            error = StartFailed(f"{run.path}: on_start failed, as its model says", id=run.path)
            tree.at(tree.now + takes_s, lambda: self._fail(run, error))
        else:
            tree.at(tree.now + takes_s, lambda: self._ready(run))

    def _fail(self, run: _Run, error: StartFailed) -> None:
        if not (run.is_over or run.is_stopping):
            self._over(run)
            self._start_failed(run, error)

    def _start_failed(self, run: _Run, error: BaseException) -> None:
        chance = self._tree.chance(run.path)()
        number, now = run.action.run, self._tree.now
        self._apply(restarts.decide_start_failed(self._state, run.action.id, number, error, now, chance))

    def _ready(self, run: _Run) -> None:
        if run.is_over or run.is_stopping:
            return
        tree = self._tree
        run.ready_at = tree.now
        tree.uptime(run.path).up(tree.now)
        if run.level is None:
            self._let_live(run)
        self._apply(restarts.decide_started(self._state, run.action.id, run.action.run, tree.now))

    def _let_live(self, run: _Run) -> None:
        tree, model, chance = self._tree, self._tree.model(run.path), self._tree.chance(run.path)
        if model.every_s is None:
            return
        end = tree.now + draw(model.every_s, chance)
        if chance() < model.hangs:
            tree.at(end, lambda: self._hang(run))
        else:
            tree.at(end, lambda: self._end_unless_over(run, _ENDS[model.reason]))

    def _end_unless_over(self, run: _Run, exit: Exit) -> None:
        if not (run.is_over or run.is_hung or run.is_stopping):
            self.end(run, exit)

    def _hang(self, run: _Run) -> None:
        if run.is_over or run.is_stopping:
            return
        run.is_hung = True
        self._tree.uptime(run.path).down(self._tree.now)
        limit_s = run.action.spec.heartbeat_s
        if limit_s is not None:  # it is asked twice in each limit
            exit = Exit("abnormal", f"hung: its loop had not answered for {limit_s:g} s (heartbeat_s)", -9)
            asked = self._tree.now + self._tree.chance(run.path)() * limit_s / 2
            self._tree.at(asked + limit_s, lambda: None if run.is_over or run.is_stopping else self.end(run, exit))

    def _stop(self, run: _Run, action: StopChild) -> None:
        if run.is_over or self._is_dead:
            return
        tree, limit_s = self._tree, action.shutdown_s
        if run.began is None:
            self._has_stopped(run, Exit("shutdown", "was not started"))
        elif limit_s == "brutal_kill":
            self._has_stopped(run, Exit("killed", "brutal_kill", -9))
        else:
            if run.level is not None:
                run.level.stop()
            elif not run.is_hung:
                takes_s = draw(tree.model(run.path).stop_s, tree.chance(run.path))
                code = 0 if run.action.spec.placement == "process" else None
                tree.at(tree.now + takes_s, lambda: self._has_stopped(run, Exit("shutdown", code=code)))
            if limit_s != "infinity":
                late = Exit("killed", f"had not stopped after shutdown_s={limit_s:g} s", -9)
                tree.at(tree.now + limit_s, lambda: self._has_stopped(run, late))

    def _has_stopped(self, run: _Run, exit: Exit) -> None:
        if not run.is_over:
            self._over(run)
            now = self._tree.now
            self._apply(restarts.decide_stopped(self._state, run.action.id, run.action.run, exit, now))

    def _over(self, run: _Run) -> None:
        if run.is_over:
            return
        run.is_over = True
        if run.level is not None:
            run.level.kill()
        self._tree.uptime(run.path).down(self._tree.now)

    # -- the supervisor itself -------------------------------------------------------------------------------------

    def _is_up(self) -> None:
        if self._within is None:
            self._tree.was_ready = True
        else:
            above, run = self._within
            self._tree.soon(lambda: above._ready(run))

    def _has_ended(self, ending: ExitSupervisor) -> None:
        if self._is_dead:
            return
        self._is_dead = True
        if self._within is None:
            self._tree.ended_at, self._tree.error = self._tree.now, ending.error
            return
        above, run = self._within
        exit = Exit("shutdown", "" if ending.error is None else str(ending.error))
        if run.is_stopping:
            above._has_stopped(run, exit)
        elif run.ready_at is None and ending.error is not None:
            above._fail(run, StartFailed(str(ending.error), id=run.path))
        elif not run.is_over:
            above.end(run, exit)
