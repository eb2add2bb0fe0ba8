"""Log lines: a record as one aligned line, coloured on a terminal, or as one JSON object for machines."""

from __future__ import annotations

import json
import logging
import sys
import time
from typing import IO

_COLOURS = {"DEBUG": "2", "INFO": "32", "WARNING": "33", "ERROR": "31", "CRITICAL": "1;31"}
_OURS = "rr_actors."


def begin_logging(level: str, *, as_json: bool, stream: IO[str] | None = None) -> None:
    """Write this process's log records as lines, to standard error unless a stream is given.

    Args:
        level: the lowest level that is written, such as "info".
    """
    out = sys.stderr if stream is None else stream
    handler = logging.StreamHandler(out)
    handler.setFormatter(JsonLines() if as_json else Lines(colour=out.isatty()))
    logging.basicConfig(level=level.upper(), handlers=[handler])


class Lines(logging.Formatter):
    """Lines for people: time, level, child or logger, and message in columns. An indented traceback follows.

    Characters that could control the terminal are written as their codes.
    """

    def __init__(self, *, colour: bool) -> None:
        super().__init__()
        self._colour = colour

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as its line, and the lines of its traceback."""
        level = f"{record.levelname:<8}"
        if self._colour and (code := _COLOURS.get(record.levelname)):
            level = f"\x1b[{code}m{level}\x1b[0m"
        line = f"{_clock(record)} {level} {_where(record):<16} {printable(record.getMessage())}"
        trace = _trace(self, record)
        return line + "".join(f"\n    {printable(one)}" for one in trace.splitlines())


class JsonLines(logging.Formatter):
    """Lines for machines: one object each, with "at", "level", "logger", "process", "pid" and "message".

    Some have "traceback", or "supervision" with the facts of an event of the tree.
    """

    def format(self, record: logging.LogRecord) -> str:
        """Return a record as one line of JSON."""
        facts: dict[str, object] = {
            "at": record.created,
            "level": record.levelname.lower(),
            "logger": record.name,
            "process": record.processName,
            "pid": record.process,
            "message": record.getMessage(),
        }
        if trace := _trace(self, record):
            facts["traceback"] = trace
        if (supervision := getattr(record, "supervision", None)) is not None:
            facts["supervision"] = supervision
        return json.dumps(facts, ensure_ascii=True, default=str)


def _clock(record: logging.LogRecord) -> str:
    return f"{time.strftime('%H:%M:%S', time.localtime(record.created))}.{int(record.msecs):03d}"


def _where(record: logging.LogRecord) -> str:
    """Return the path of the child that logged the record; for this process, the logger's name."""
    name = record.processName or ""
    return name if "/" in name else record.name.removeprefix(_OURS)


def _trace(formatter: logging.Formatter, record: logging.LogRecord) -> str:
    if record.exc_info:
        return formatter.formatException(record.exc_info)
    return record.exc_text or ""


def printable(text: str) -> str:
    """Return a text in which codes replace the characters that could control a terminal, newlines included."""
    if text.isprintable():
        return text
    return "".join(char if char.isprintable() else char.encode("unicode_escape").decode() for char in text)
