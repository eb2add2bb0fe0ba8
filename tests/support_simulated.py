"""Children that exist only on paper: what supervision/supervisor.py does with real ones, done by hand or at once."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Hashable, Iterable
from typing import Any, Literal

from rr_actors.supervision.core import child_calls, restarts
from rr_actors.supervision.core.specs import ChildSpec, Supervisor
from rr_actors.supervision.core.state import (
    Action,
    CallReply,
    Decision,
    Exit,
    ExitSupervisor,
    KeptChild,
    Mode,
    Report,
    StartChild,
    StopChild,
    SupervisorStarted,
    SupervisorState,
)

Outcome = Literal["ok", "fail", "ignore"]
SHUTDOWN = Exit("shutdown")


class World:
    """One supervisor with simulated children.

    `log` has what was done in order: "start a", "up a", "fail a", "ignore a", "stop a", "down a". What is asked for and
    not done yet is in `starts` and `stops`, by child id. `outcomes[id]` says how its next starts end; by default "ok".
    """

    def __init__(self, spec: Supervisor, chance: float = 0.0) -> None:
        self.tree = SupervisorState.of(spec)
        self.now = 0.0
        self.chance = chance
        self.log: list[str] = []
        self.starts: dict[str, StartChild] = {}
        self.stops: dict[str, StopChild] = {}
        self.up: dict[str, int] = {}
        self.outcomes: dict[str, deque[Outcome]] = defaultdict(deque)
        self.replies: dict[Hashable, CallReply] = {}
        self.reports: list[Report] = []
        self.started = False
        self.ended: ExitSupervisor | None = None
        self._callers = 0

    # -- the supervisor's actions --

    def take(self, decision: Decision) -> None:
        self.tree, actions = decision
        for action in actions:
            self._act(action)

    def _act(self, action: Action) -> None:
        assert self.ended is None or isinstance(action, CallReply), f"{action} after the supervisor's end"
        match action:
            case StartChild(id=id, run=run):
                assert id not in self.up, f"{id} started while it is up"
                assert id not in self.starts, f"{id} started while it is starting"
                assert id not in self.stops, f"{id} started while it is stopping"
                self.starts[id] = action
                self.log.append(f"start {id}")
            case StopChild(id=id, run=run):
                assert id not in self.stops, f"{id} stopped twice"
                assert id in self.starts or self.up.get(id) == run, f"{id} stopped while it is down"
                self.stops[id] = action
                self.log.append(f"stop {id}")
            case CallReply(caller=caller):
                assert caller not in self.replies, f"caller {caller} answered twice"
                self.replies[caller] = action
            case Report(id=id):
                assert action.state is not None or id not in {*self.up, *self.starts}, f"{id} forgotten while it is up"
                self.reports.append(action)
            case SupervisorStarted():
                assert not self.started
                self.started = True
            case ExitSupervisor():
                assert not self.up
                assert not self.starts
                assert not self.stops
                self.ended = action

    # -- what happens to children --

    def finish_start(self, id: str) -> None:
        action = self.starts.pop(id)
        outcome = self.outcomes[id].popleft() if self.outcomes[id] else "ok"
        if outcome == "fail":
            self.log.append(f"fail {id}")
            self.take(restarts.decide_start_failed(self.tree, id, action.run, OSError("no"), self.now, self.chance))
            return
        self.log.append(f"{'up' if outcome == 'ok' else 'ignore'} {id}")
        if outcome == "ok":
            self.up[id] = action.run
        self.take(restarts.decide_started(self.tree, id, action.run, self.now, ignored=outcome == "ignore"))

    def finish_stop(self, id: str) -> None:
        action = self.stops.pop(id)
        self.starts.pop(id, None)
        self.up.pop(id, None)
        self.log.append(f"down {id}")
        self.take(restarts.decide_stopped(self.tree, id, action.run, SHUTDOWN, self.now))

    def exit(self, id: str, reason: Literal["normal", "shutdown", "abnormal", "killed"] = "killed") -> None:
        run = self.up.pop(id)
        self.take(restarts.decide_exit(self.tree, id, run, Exit(reason), self.now, self.chance))

    def settle(self, limit: int = 1000) -> World:
        """Do everything that is asked for, oldest first, until nothing is."""
        for _ in range(limit):
            if self.stops:
                self.finish_stop(next(iter(self.stops)))
            elif self.starts:
                self.finish_start(next(iter(self.starts)))
            else:
                return self
        raise AssertionError("it never comes to rest")

    # -- calls --

    def start(self, kept: Iterable[KeptChild] = ()) -> World:
        self.take(restarts.decide_start(self.tree, self.now, kept))
        return self

    def stop(self) -> World:
        self.take(restarts.decide_stop(self.tree, self.now))
        return self

    def call(self, name: str, argument: Any, *more: Any) -> int:
        """Make an administrative call; its number is the key of its reply."""
        self._callers += 1
        function: Any = getattr(child_calls, name)
        self.take(function(self.tree, argument, self._callers, self.now, *more))
        return self._callers

    def answer(self, name: str, argument: Any, *more: Any) -> str | None:
        """Make a call, let everything happen that it takes, and return or raise its answer."""
        caller = self.call(name, argument, *more)
        self.settle()
        reply = self.replies[caller]
        if reply.error:
            raise reply.error
        return reply.id

    # -- looking --

    def states(self) -> dict[str, str]:
        return {id: child.state for id, child in self.tree.children.items()}

    def drain(self) -> list[str]:
        """What was done since the last time."""
        done, self.log = self.log, []
        return done

    @property
    def alive(self) -> bool:
        return self.tree.mode in (Mode.STARTING, Mode.RUNNING)


class Thing:
    """What the children would be, if they were."""


def child(id: str, restart: Any = "permanent", **fields: Any) -> ChildSpec:
    return ChildSpec(Thing, id=id, restart=restart, **fields)


def world(*children: ChildSpec | Supervisor, strategy: Any = "one_for_one", **fields: Any) -> World:
    """A started supervisor, all children up, nothing in the log."""
    started = World(Supervisor(list(children), strategy=strategy, **fields)).start().settle()
    assert started.started
    assert started.alive
    started.drain()
    started.reports.clear()
    return started
