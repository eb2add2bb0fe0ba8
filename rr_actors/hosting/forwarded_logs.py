"""Forwarded logs: the log records of a child process reach the logging of the application.

In a child, a record that no handler takes is sent up like an event, as plain data. Python would write it to standard
error. The application's process gives it to its own logger of the same name, with that logger's levels, filters and
handlers. Code in the child that configures handlers, for instance by basicConfig, keeps its records. A function such as
logging.warning() calls basicConfig by itself where nothing is configured; in a child that call does nothing.
"""

from __future__ import annotations

import functools
import inspect
import logging
import os
from collections.abc import Callable
from typing import Any

EVENT = "log"

_TEXT_LIMIT = 64 * 1024  # characters of a message, and of a traceback
_FORMATTER = logging.Formatter()
_AS_IT_IS = (
    *("name", "levelno", "levelname", "created", "msecs", "relativeCreated", "thread", "threadName"),
    *("pathname", "filename", "module", "lineno", "funcName"),
)
"""The attributes of a record that are sent unchanged."""


class Forwarder(logging.Handler):
    """The handler of a child's records that have no other. It writes to standard error what it cannot send.

    Args:
        path: the child's, "root/cameras".
        send: sends an event up, from any thread; returns False if that is not possible any more.
    """

    def __init__(self, path: str, send: Callable[[dict[str, Any]], bool]) -> None:
        super().__init__()
        self._last = logging.lastResort
        self._path = path
        self._send = send

    def emit(self, record: logging.LogRecord) -> None:
        """Send a record."""
        try:
            sent = self._send(_facts_of(record, self._path))
        except Exception:  # mostly the fault of the record's arguments
            self.handleError(record)
            return
        if not sent and self._last is not None and record.levelno >= self._last.level:
            self._last.handle(record)


def levels() -> dict[str, int]:
    """Return the levels that were set for loggers of this process, by name; the root logger's is ""."""
    root = logging.getLogger()
    loggers = list(root.manager.loggerDict.items())
    found = {name: logger.level for name, logger in loggers if isinstance(logger, logging.Logger) and logger.level}
    return {"": root.level, **found}


def begin(path: str, levels: dict[str, int], send: Callable[[dict[str, Any]], bool]) -> None:
    """Send up the records of this process from now on, and set these levels for its loggers."""
    logging.lastResort = Forwarder(path, send)  # pyright: ignore[reportAttributeAccessIssue] - a handler is what it is
    logging.basicConfig = _configure_if_asked
    for name, level in levels.items():
        logging.getLogger(name).setLevel(level)


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


def _cut(text: str) -> str:
    plain = text.encode("utf-8", "backslashreplace").decode()
    return plain if len(plain) <= _TEXT_LIMIT else f"{plain[:_TEXT_LIMIT]}… ({len(plain)} characters)"
