"""History: the events of a supervisor's children and their reasons, kept in memory and written to the log.

One line for each record on the logger rr_actors.supervision, "exited path=root/cameras reason=killed ...", with the
same facts as the log record's attribute `supervision`.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from typing import Any, NamedTuple

import msgspec

from rr_actors.base.errors import StartFailed, text_of
from rr_actors.base.notebook import bundle, table
from rr_actors.base.reporting.log import Log
from rr_actors.base.reporting.tracebacks import trace_of
from rr_actors.base.scarcity import wanted_by
from rr_actors.runtime.processes.process import signal_name
from rr_actors.supervision.core.state import Report

logger = Log("rr_actors.supervision")

KEPT = 1000
"""How many records a supervisor keeps."""

_ENDS = ("exited", "stopped", "start_failed")


class Record(msgspec.Struct, frozen=True):
    """An event of a child.

    Attributes:
        event: "started", "restarted", "ignored" (on_start said IGNORE), "start_failed", "exited" (by itself), "stopped"
            (on request), "deleted", "gave_up" (too many restarts, the last one because of this child) or
            "auto_shutdown" (because of this significant child).
        path: the child's.
        kind: "manager", "actor" or "supervisor".
        run: how often the child has been started, this start included.
        at: when, seconds since the epoch.
        state: the child's from then on: "running", "starting", "restarting", "stopped"; None when it is forgotten.
        pid: the id of its process.
        reason: of an exit: "normal", "shutdown", "abnormal" or "killed".
        detail: for people: "SIGKILL", "ValueError: no such device".
        code: exit code of its own process; -9 for signal 9; None without one, or if it is unknown.
        signal: "SIGKILL", or "".
        traceback: of the exception that ended it, as it was in its own process.
        restarts: restarts within the supervisor's window, this one included.
        delay_s: how long the restart that follows waits.
        ready_s: from its start until it was ready.
        up_s: from then until its end, in seconds.
    """

    event: str
    path: str
    kind: str
    run: int
    at: float
    state: str | None = None
    pid: int | None = None
    reason: str = ""
    detail: str = ""
    code: int | None = None
    signal: str = ""
    traceback: str = ""
    restarts: int = 0
    delay_s: float = 0.0
    ready_s: float | None = None
    up_s: float | None = None

    @property
    def id(self) -> str:
        """The child's name among its siblings."""
        return self.path.rpartition("/")[2]

    def facts(self) -> dict[str, Any]:
        """Return all fields except the event and the empty ones, as plain data. `state` is always in it."""
        facts = msgspec.structs.asdict(self)
        del facts["event"]
        return {key: value for key, value in facts.items() if value not in (None, "", 0)} | {"state": self.state}

    def __str__(self) -> str:
        hidden = {"kind", "at", "traceback"}
        if self.signal:  # it says what the code says, and at times the detail
            hidden |= {"code", "detail"} if self.detail == self.signal else {"code"}
        shown = {key: value for key, value in self.facts().items() if key not in hidden}
        return " ".join([self.event, *(f"{key}={_short(value)}" for key, value in shown.items())])


class Records(list[Record]):
    """Records, oldest first. A notebook shows them as a table."""

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        rows = [(_clock(one.at), one.event, one.path, one.pid, one.reason, one.detail) for one in self]
        columns = ("time", "event", "child", "pid", "reason", "detail")
        return bundle("\n".join(map(str, self)), html=table(columns, rows))


def _clock(at: float) -> str:
    return time.strftime("%H:%M:%S", time.localtime(at)) + f"{at % 1:.3f}"[1:]


class History:
    """The last records of one supervisor, oldest first."""

    def __init__(self) -> None:
        self._records: deque[Record] = deque()
        self._ends: dict[str, deque[Record]] = {}  # those among them that are about ends of runs, by path

    def add(self, record: Record) -> None:
        """Keep a record, and log it."""
        self._records.append(record)
        if record.event in _ENDS:
            self._ends.setdefault(record.path, deque()).append(record)
        if len(self._records) > KEPT:
            oldest = self._records.popleft()
            if oldest.event in _ENDS:
                ends = self._ends[oldest.path]
                ends.popleft()
                if not ends:
                    del self._ends[oldest.path]
        logger.log(_level(record), "%s", record, extra={"supervision": {"event": record.event, **record.facts()}})

    def records(self) -> list[Record]:
        """Return all records that are kept."""
        return list(self._records)

    def deaths(self, path: str, count: int) -> list[str]:
        """Say how the child's last `count` runs died, oldest first: "SIGKILL", "exit code 3: ValueError: ...".

        The list ends at a run that ended as it should: neither that run nor any before it is a death.
        """
        found: list[str] = []
        for record in reversed(self._ends.get(path, ())):
            dropped = record.event == "stopped" and not record.reason  # while it waited for its turn to start
            if len(found) == count or dropped or record.reason in ("normal", "shutdown"):
                break
            found.append(_how(record))
        return found[::-1]


class RunFacts(NamedTuple):
    """Facts of the run that a report is about: whether its start was a restart, its process, and two times in seconds.

    `ready_s`: from its start until it was ready. `up_s`: from then until now. None if it did not come to that.
    """

    is_restart: bool
    pid: int | None
    ready_s: float | None
    up_s: float | None


def record_of(report: Report, path: str, kind: str, at: float, run: RunFacts | None) -> Record:
    """Return the Record of a report of the core, completed with the facts of the run."""
    exit, error = report.exit, report.error
    if exit is not None:
        code = exit.code
    else:  # a StartFailed has the code if the process died before it was ready
        code = error.details.get("code") if isinstance(error, StartFailed) else None
    return Record(
        event="restarted" if report.event == "started" and run is not None and run.is_restart else report.event,
        path=path,
        kind=kind,
        run=report.starts,
        at=at,
        state=report.state,
        pid=None if run is None else run.pid,
        reason="" if exit is None else exit.reason,
        detail=_detail(report),
        code=code,
        signal=signal_name(-code) if code is not None and code < 0 else "",
        traceback=_traceback(report),
        restarts=report.restarts,
        delay_s=report.delay_s,
        ready_s=None if run is None else run.ready_s,
        up_s=None if run is None or exit is None else run.up_s,
    )


def _detail(report: Report) -> str:
    if report.error is not None:
        text, wanted = text_of(report.error), wanted_by(report.error)
        return text if wanted in text else f"{text}: {wanted}"
    return "" if report.exit is None else report.exit.detail


def _traceback(report: Report) -> str:
    if report.event == "start_failed" and report.error is not None:
        return trace_of(report.error)
    return "" if report.exit is None else report.exit.traceback


def _how(record: Record) -> str:
    how = record.signal or (f"exit code {record.code}" if record.code is not None else "")
    if record.detail == how or (how and record.event == "start_failed"):  # the detail has the code or signal, too
        return how
    return ": ".join(filter(None, (how, record.detail)))


def _level(record: Record) -> int:
    match record.event:
        case "gave_up":
            return logging.ERROR
        case "start_failed":
            return logging.WARNING
        case "exited" | "stopped" if record.reason in ("abnormal", "killed"):
            return logging.WARNING
        case "exited" | "stopped" | "auto_shutdown":
            return logging.INFO
        case _:
            return logging.DEBUG


def _short(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.3f}"
    text = str(value)
    return repr(text) if " " in text or "\n" in text else text
