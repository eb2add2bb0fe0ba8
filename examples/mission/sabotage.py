"""The saboteur: harms one process after the other while the robot drives, and times how long the repair takes."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import rr_actors as rr
from mission.record import Fault, Record

REPAIR_LIMIT_S = 20.0


class Strike(NamedTuple):
    """One process to harm: `pid` finds it, `repaired` waits until what it did is done again; False if it never is.

    `number` is the signal that does to it what `done` says.
    """

    name: str
    what: str
    pid: Callable[[], int]
    repaired: Callable[[], bool]
    done: str = "killed"
    number: signal.Signals = signal.SIGKILL


class Saboteur:
    """Strikes at given distances; never before the strike before is repaired, or cannot be."""

    def __init__(
        self, strikes: Sequence[Strike], at_m: Sequence[float], record: Record, say: Callable[[str], None]
    ) -> None:
        self._due = list(zip(at_m, strikes, strict=False))
        self._record = record
        self._say = say
        self._repair = threading.Thread()

    def look(self) -> None:
        """Strike if it is time to."""
        at = self._record.samples[-1] if self._record.samples else None
        if at is None or not self._due or at.driven_m < self._due[0][0] or self._repair.is_alive():
            return
        _, strike = self._due.pop(0)
        pid = strike.pid()
        fault = Fault(strike.name, strike.what, strike.done, at.time_s, at.x, at.y, at.driven_m)
        self._record.faults.append(fault)
        self._say(f"{strike.name}: {strike.what} is {strike.done} ({strike.number.name} for pid {pid})")
        self._repair = threading.Thread(target=self._time_repair, args=(strike, fault, time.monotonic()), daemon=True)
        os.kill(pid, strike.number)
        self._repair.start()

    def finish(self) -> None:
        """Wait until the last repair is timed."""
        if self._repair.is_alive():
            self._repair.join(REPAIR_LIMIT_S)

    def _time_repair(self, strike: Strike, fault: Fault, began: float) -> None:
        try:
            repaired = strike.repaired()
        except rr.RrError as error:
            self._say(f"{strike.name}: {error}")
            return
        if repaired:
            fault.serving_s = time.monotonic() - began
            self._say(f"{strike.name}: {strike.what} serves again after {fault.serving_s * 1000:.0f} ms")


def replaced(query: rr.Query) -> Callable[[], bool]:
    """Wait until the holder of a part hears that it was replaced (UPDATE), or could not be (FATAL)."""

    def repaired() -> bool:
        while (state := query.wait_status(timeout_s=REPAIR_LIMIT_S).state) not in (rr.State.UPDATE, rr.State.FATAL):
            pass  # a WARNING comes before
        return state is rr.State.UPDATE

    return repaired


def answers(app: rr.Registrar, query: rr.Query) -> Callable[[], bool]:
    """Wait until a manager answers again: load from it what is loaded, which takes no longer than the answer."""

    def repaired() -> bool:
        app.load(query.server_id, query.request, timeout_s=REPAIR_LIMIT_S).unload()
        return True

    return repaired


def child_pid(system: rr.System, id: str) -> Callable[[], int]:
    """Find the process of one of the root supervisor's children."""

    def pid() -> int:
        found = {child.id: child.pid for child in system.supervisor().which_children()}[id]
        if found is None:
            raise rr.ActorUnavailable(f"{id} is being restarted", id=id)
        return found

    return pid
