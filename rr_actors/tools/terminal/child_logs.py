"""Log lines of a child as text: one life after the other, each with its process and its end."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress

from rr_actors.base.errors import NotFound
from rr_actors.base.values.canonical import Codec
from rr_actors.hosting.forwarded_logs import LogLine
from rr_actors.system.console.asking.actor_calls import CallActor, given_bytes
from rr_actors.system.console.console_connection import ConsoleConnection
from rr_actors.system.console.console_messages import PAGE_LIMIT, ChildLog
from rr_actors.system.console.console_questions import Find, ListChildren, ListHistory, ListLog
from rr_actors.system.recording.event_memory import Event

_answer = Codec(None, "answer")
_TICK_S = 0.3  # between two questions for new lines


class LogText:
    """The text of a child's log lines. A heading stands where a life begins, and where one has ended.

    Args:
        path: the child's.
        events: of its history, which say how its processes ended.
    """

    def __init__(self, path: str, events: Sequence[Event] = ()) -> None:
        self._path = path
        self._events = [event for event in events if event.path == path]
        self._pid = 0

    def of(self, lines: Iterable[LogLine]) -> Iterator[str]:
        """Yield the lines of text for further log lines."""
        for line in lines:
            if line.pid != self._pid:
                yield from self.end()
                yield f"-- {self._path}, process {line.pid} --"
                self._pid = line.pid
            first, *more = line_texts(line)
            yield first
            yield from (f"    {one}" for one in more)

    def end(self) -> Iterator[str]:
        """Yield a heading with the end of the last life, if it is known."""
        for event in self._events:
            reason, detail = event.facts.get("reason"), event.facts.get("detail")
            if event.facts.get("pid") == self._pid and reason:
                how = ": ".join(dict.fromkeys(filter(None, (reason, detail))))
                yield f"-- process {self._pid} ended at {_clock(event.at)}: {how} --"


def line_texts(line: LogLine) -> list[str]:
    """Return the text of a log line with its time, and the further lines of its message and traceback."""
    first, *more = line.text.splitlines() or [""]
    return [f"{_clock(line.at)} {line.level:<8} {line.logger}: {first}", *more]


def _clock(at: float) -> str:
    return f"{time.strftime('%H:%M:%S', time.localtime(at))}.{int(at % 1 * 1000):03d}"


def log_of(connection: ConsoleConnection, child: str, count: int, *, previous: bool = False) -> ChildLog:
    """Return the last `count` lines of a child; with `previous` those of the process before the one that runs."""
    log = connection.ask(ListLog(child))
    lines = log.lines
    if previous:
        rows = connection.ask(ListChildren(log.path)).rows
        runs = {row.pid for row in rows if row.path == log.path}
        before = [line.pid for line in lines if line.pid not in runs]
        lines = [line for line in lines if line.pid == before[-1]] if before else []
    return ChildLog(log.path, log.total, lines[-count:], log.note)


def events_of_child(connection: ConsoleConnection, path: str) -> list[Event]:
    """Return the newest events of a child's history."""
    return connection.ask(ListHistory(path, PAGE_LIMIT)).events


def new_lines(connection: ConsoleConnection, path: str, after: int) -> Iterator[list[LogLine]]:
    """Yield the lines of a child with higher numbers than `after` as they come, without end.

    Raises:
        NotRunning: the system has ended.
    """
    while True:
        lines = connection.ask(ListLog(path, after)).lines
        if lines:
            after = lines[-1].seq
            yield lines
        time.sleep(_TICK_S)


def output_of(connection: ConsoleConnection, program: str, count: int) -> list[str] | None:
    """Return the last lines of an external program's output; None if this is the name or id of no program."""
    found = [row for row in connection.ask(Find(program)).resources if row.server.endswith("/program")]
    if len(found) != 1:
        return None
    registrar, id = found[0].server.partition("/")[0], found[0].id
    given = given_bytes(registrar, "output", (id, count))
    with suppress(NotFound):  # another manager than Programs
        return _answer.show(connection.ask(CallActor(registrar, "output", given)).answer)
    return None
