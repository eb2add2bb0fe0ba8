"""Life: one run of one child as its supervisor sees it, and what is put on record of it."""

from __future__ import annotations

import asyncio
import time
import traceback

from rr_actors.actors.history import Record
from rr_actors.actors.runs import End, Run
from rr_actors.core.tree import Report, StartChild, Why
from rr_actors.processes import signal_name


class Life:
    """One run of one child, as its supervisor sees it."""

    def __init__(self, action: StartChild, path: str) -> None:
        self.id = action.id
        self.number = action.run
        self.spec = action.spec
        self.why = action.why
        self.path = path
        self.run: Run | None = None
        self.told_to_stop = asyncio.Event()
        self.began = time.monotonic()
        self.ready_at: float | None = None
        self.end: End | None = None

    @property
    def pid(self) -> int | None:
        """The process it is in, once there is one."""
        return None if self.run is None else self.run.pid


def record_of(report: Report, path: str, kind: str, life: Life | None) -> Record:
    """What the core reports of a child, with what the run itself has to say."""
    end = life.end if life is not None and report.event in ("exited", "stopped") else None
    up_at = None if life is None else life.ready_at
    code = None if end is None else end.code
    restarted = report.event == "started" and life is not None and life.why is Why.RESTART
    return Record(
        event="restarted" if restarted else report.event,
        path=path,
        kind=kind,
        run=report.run,
        at=time.time(),
        state=report.state,
        pid=None if life is None else life.pid,
        reason="" if report.exit is None else report.exit.reason,
        detail=_detail(report),
        code=code,
        signal=signal_name(-code) if code is not None and code < 0 else "",
        traceback=_traceback(report, end),
        restarts=report.restarts,
        delay_s=report.delay_s,
        ready_s=None if life is None or up_at is None else up_at - life.began,
        up_s=None if end is None or up_at is None else time.monotonic() - up_at,
    )


def _detail(report: Report) -> str:
    if report.error is not None:
        return f"{type(report.error).__name__}: {report.error}"
    return "" if report.exit is None else report.exit.detail


def _traceback(report: Report, end: End | None) -> str:
    if report.event == "start_failed" and report.error is not None:
        return "".join(traceback.format_exception(report.error))
    return "" if end is None else end.traceback
