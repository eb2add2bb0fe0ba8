"""Forwarded logs: the log records of a child process reach the logging of the application.

In a child, a record that no handler takes is sent up like an event, as plain data. Python would write it to standard
error. The application's process gives it to its own logger of the same name, with that logger's levels, filters and
handlers. Code in the child that configures handlers, for instance by basicConfig, keeps its records. A function such as
logging.warning() calls basicConfig by itself where nothing is configured; in a child that call does nothing.

The system keeps the last lines of each child's process for people who look at it. It keeps them by the child's path. So
those of a process that has died stand before those of its successor.
"""

from __future__ import annotations

import functools
import inspect
import logging
import os
import threading
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Any

import msgspec

EVENT = "log"

_TEXT_LIMIT = 64 * 1024  # characters of a message, and of a traceback
_FORMATTER = logging.Formatter()
_AS_IT_IS = (
    *("name", "levelno", "levelname", "created", "msecs", "relativeCreated", "thread", "threadName"),
    *("pathname", "filename", "module", "lineno", "funcName"),
)
"""The attributes of a record that are sent unchanged."""


class Forwarder(logging.Handler):
    """The handler of a child's records that have no other. It writes to standard error what it cannot send."""

    _last: logging.Handler | None
    _path: str
    _send: Callable[[dict[str, Any]], bool]

    def begin(self, path: str, send: Callable[[dict[str, Any]], bool]) -> None:
        """Replace logging's last resort.

        Args:
            path: the child's, "root/cameras".
            send: sends an event up, from any thread; returns False if that is not possible any more.
        """
        self._last, self._path, self._send = logging.lastResort, path, send
        logging.lastResort = self  # pyright: ignore[reportAttributeAccessIssue] - a handler is what it is

    def emit(self, record: logging.LogRecord) -> None:
        """Send a record."""
        try:
            sent = self._send(_facts_of(record, self._path))
        except Exception:  # mostly the fault of the record's arguments
            self.handleError(record)
            return
        if not sent and self._last is not None and record.levelno >= self._last.level:
            self._last.handle(record)


_forwarder = Forwarder()  # made with its locks in the fork server, and not in each child


def levels() -> dict[str, int]:
    """Return the levels that were set for loggers of this process, by name; the root logger's is ""."""
    root = logging.getLogger()
    loggers = list(root.manager.loggerDict.items())
    found = {name: logger.level for name, logger in loggers if isinstance(logger, logging.Logger) and logger.level}
    return {"": root.level, **found}


def begin(path: str, levels: dict[str, int], send: Callable[[dict[str, Any]], bool]) -> None:
    """Send up the records of this process from now on, and set these levels for its loggers."""
    _forwarder.begin(path, send)
    logging.basicConfig = _configure_if_asked
    for name, level in levels.items():
        logger = logging.getLogger(name)
        if logger.level != level:  # to set it goes through all loggers
            logger.setLevel(level)


_basic_config = logging.basicConfig


@functools.wraps(_basic_config)
def _configure_if_asked(**options: Any) -> None:
    caller: Any = inspect.currentframe()
    if caller.f_back.f_globals is not vars(logging):
        _basic_config(**options)


def take(event: dict[str, Any]) -> None:
    """Hand a record of a child to the logger of its name in this process. In a worker: handlers may wait."""
    facts = dict(event)
    del facts["event"]
    logger = logging.getLogger(facts["name"])
    if logger.isEnabledFor(facts["levelno"]):
        logger.handle(logging.makeLogRecord(facts))


def _facts_of(record: logging.LogRecord, path: str) -> dict[str, Any]:
    trace = record.exc_text or (_FORMATTER.formatException(record.exc_info) if record.exc_info else None)
    return {key: getattr(record, key) for key in _AS_IT_IS} | {
        "event": EVENT,
        "msg": _cut(record.getMessage()),
        "args": None,
        "exc_text": None if trace is None else _cut(trace),
        "stack_info": None if record.stack_info is None else _cut(record.stack_info),
        "process": os.getpid(),
        "processName": path,
    }


def _cut(text: str, limit: int = _TEXT_LIMIT) -> str:
    plain = text.encode("utf-8", "backslashreplace").decode()
    return plain if len(plain) <= limit else f"{plain[:limit]}… ({len(plain)} characters)"


# -- kept for people -------------------------------------------------------------------------------------------------

LINES_LIMIT = 500
"""The most lines of a child that are kept."""
BYTES_LIMIT = 256 * 1024
"""The most bytes of a child's lines, as MessagePack, that are kept."""
ALL_BYTES_LIMIT = 32 * 2**20
"""The most bytes of the lines of all children: above it, the child that has been silent for longest loses its lines."""

_LINE_LIMIT = 32 * 1024  # characters of a line's message, traceback and stack together
_NAME_LIMIT = 200


class LogLine(msgspec.Struct, frozen=True, omit_defaults=True):
    """A log record of a child's process.

    Attributes:
        seq: its number among all lines of this run of the system, from 1 on.
        at: seconds since the epoch.
        level: "WARNING", for instance.
        logger: the name of its logger.
        pid: the process that logged it. Each life of a child has its own.
        text: the message, in the next lines the traceback, if there is one.
    """

    seq: int
    at: float
    level: str
    logger: str
    pid: int
    text: str


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(LogLine)


class KeptLogs:
    """The last log lines of the children of one system, in memory. From any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lines: OrderedDict[str, deque[bytes]] = OrderedDict()  # by path; last, the child that logged last
        self._sizes: dict[str, int] = {}
        self._size = 0
        self._seq = 0

    def take(self, facts: dict[str, Any]) -> None:
        """Keep a record, in the form in which the process of a child sends it."""
        path: str = facts["processName"]
        text = "\n".join(part for key in ("msg", "exc_text", "stack_info") if (part := facts[key]))
        names = str(facts["levelname"])[:_NAME_LIMIT], str(facts["name"])[:_NAME_LIMIT]
        with self._lock:
            self._seq += 1
            line = LogLine(self._seq, facts["created"], *names, facts["process"], _cut(text, _LINE_LIMIT))
            encoded = _encoder.encode(line)
            lines = self._lines.setdefault(path, deque())
            self._lines.move_to_end(path)
            lines.append(encoded)
            self._grow(path, len(encoded))
            while len(lines) > LINES_LIMIT or self._sizes[path] > BYTES_LIMIT:
                self._grow(path, -len(lines.popleft()))
            while self._size > ALL_BYTES_LIMIT:
                silent, _ = self._lines.popitem(last=False)
                self._size -= self._sizes.pop(silent)

    def _grow(self, path: str, size: int) -> None:
        self._sizes[path] = self._sizes.get(path, 0) + size
        self._size += size

    def paths(self) -> list[str]:
        """Return the paths of the children of which there are lines."""
        with self._lock:
            return list(self._lines)

    def lines(self, path: str, after: int = 0) -> list[LogLine]:
        """Return the kept lines of a child with higher numbers than `after`, oldest first."""
        with self._lock:
            kept = list(self._lines.get(path, ()))
        return [line for line in map(_decoder.decode, kept) if line.seq > after]
