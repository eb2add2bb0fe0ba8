"""Log: the package's loggers. A log call neither raises nor waits long, whatever the user's filters and handlers do.

In a process with an event loop a thread of its own gives the records to the user's handlers, one after another: a
handler that raises or hangs harms neither the loop nor an actor. A thread that may wait does so for a moment, so that
its record is usually written when it goes on. In other processes, such as tools, the calling thread gives the records.
"""

from __future__ import annotations

import atexit
import logging
import os
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping
from contextvars import copy_context
from types import TracebackType

from rr_actors.base.errors import shown, text_of
from rr_actors.base.reporting.tracebacks import trace_of, traceback_of

_ExcInfo = (
    bool
    | BaseException
    | tuple[type[BaseException], BaseException, TracebackType | None]
    | tuple[None, None, None]
    | None
)

WAIT_S = 0.5
"""How long a thread that may wait does so for its record; it does not wait behind another that waits."""

WAITING_LIMIT = 10_000
"""How many records may wait for the user's handlers; more are dropped and counted."""


class Log(logging.LoggerAdapter[logging.Logger]):
    """A logger of the package. Its calls raise nothing, and wait for no handler that hangs."""

    def __init__(self, name: str) -> None:
        super().__init__(logging.getLogger(name))

    def log(
        self,
        level: int,
        msg: object,
        *args: object,
        exc_info: _ExcInfo = None,
        stack_info: bool = False,
        stacklevel: int = 1,
        extra: Mapping[str, object] | None = None,
        trace: object = None,
        **_: object,
    ) -> None:
        """Log a message, as logging.Logger.log() does; all other methods call this one.

        Args:
            trace: the trace of the exception, if it is made already; otherwise `trace_of` makes it.
        """
        logger = self.logger
        try:
            if not logger.isEnabledFor(level):
                return
            error = sys.exc_info()[1] if exc_info is True else exc_info
            if isinstance(error, tuple):
                error = error[1]
            # A level further: the frame of this method is not the caller's.
            file, line, function, stack = logger.findCaller(stack_info, stacklevel + 1)
            found = (type(error), error, traceback_of(error)) if isinstance(error, BaseException) else None
            record = logger.makeRecord(logger.name, level, file, line, msg, args, found, function, extra, stack)
            record.exc_text = trace if isinstance(trace, str) else None
        except BaseException as reason:  # of a user's class of loggers, or factory of records
            _write_last(logging.LogRecord(logger.name, level, "", 0, msg, args, None), reason)
        else:
            context = copy_context()
            _writer.give(lambda: context.run(_write, logger, record))


def _write(logger: logging.Logger, record: logging.LogRecord) -> None:
    """Give a record to the user's filters and handlers. Its texts are made before: a handler could not do it safely."""
    try:
        _say(record)
        logger.handle(record)
    except BaseException as reason:
        _write_last(record, reason)


def _say(record: logging.LogRecord) -> None:
    if record.exc_info and record.exc_info[1] is not None and not record.exc_text:
        record.exc_text = trace_of(record.exc_info[1])
    try:
        record.getMessage()
    except BaseException:  # the text of an argument raises
        arguments: object = record.args
        record.msg, record.args = f"{record.msg} {shown(arguments)}", ()


def _write_last(record: logging.LogRecord, reason: BaseException) -> None:
    """Write a record where a process without handlers does, as a filter or handler of the user's raised."""
    if isinstance(reason, KeyboardInterrupt) and threading.current_thread() is threading.main_thread():
        raise reason
    last = logging.lastResort
    if last is None or record.levelno < last.level:
        return
    try:
        _say(record)
        text = f"{record.getMessage()} (here on its own, as the logging raised {text_of(reason)})"
        facts = {**vars(record), "msg": text, "args": None, "exc_info": None}
        last.handle(logging.makeLogRecord(facts))
    except BaseException:  # standard error is closed, say
        return


class _Writer:
    """Writes records, in a thread that ends when there is none left."""

    def __init__(self) -> None:
        self.may_block: Callable[[], bool] | None = None  # without it the calling thread writes
        self._lock = threading.Lock()
        self._waiting: deque[Callable[[], object]] = deque()
        self._works = False  # whether the thread runs or comes
        self._dropped = 0

    def give(self, write: Callable[[], object]) -> None:
        """Have a record written."""
        if self.may_block is None:
            write()
        elif self._works or not self.may_block():
            self._add(write)
        else:
            self._add(write)
            self.flush(WAIT_S)

    def flush(self, timeout_s: float) -> None:
        """Wait until the records so far are written, at most `timeout_s` seconds."""
        if self._works:
            written = threading.Lock()
            written.acquire()
            self._add(written.release)
            written.acquire(timeout=timeout_s)

    def _add(self, write: Callable[[], object]) -> None:
        with self._lock:
            if len(self._waiting) >= WAITING_LIMIT:
                self._dropped += 1
                return
            self._waiting.append(write)
            if self._works:
                return
            self._works = True
        try:
            threading.Thread(target=self._work, name="rr-log", daemon=True).start()
        except RuntimeError:  # the machine gives no thread
            self._work()
        except BaseException:  # a signal handler's, before or after the start: two threads are better than none
            self._works = False
            raise

    def _work(self) -> None:
        while True:
            with self._lock:
                if not self._waiting:
                    self._works = False
                    return
                write = self._waiting.popleft()
                dropped, self._dropped = self._dropped, 0
            write()
            if dropped:
                logger.warning("the handlers here are too slow: %d log records are missing", dropped)


logger = Log("rr_actors")

_writer = _Writer()


def flush(timeout_s: float = 1.0) -> None:
    """Wait until the user's handlers have had the records so far, at most `timeout_s` seconds."""
    _writer.flush(timeout_s)


def begin_thread(may_block: Callable[[], bool]) -> None:
    """Have a thread write the records from now on. `may_block`: returns whether the calling thread may wait."""
    if _writer.may_block is None:
        atexit.register(flush)
    _writer.may_block = may_block


os.register_at_fork(after_in_child=_writer.__init__)  # the child has not the thread
