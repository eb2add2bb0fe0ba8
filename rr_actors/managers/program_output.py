"""The output of external programs as log lines of their manager: a thread reads what the files have got."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path

from rr_actors.base.errors import readable
from rr_actors.base.reporting.log import Log

logger = Log("rr_actors.managers.programs.output")

_LOOK_S = 0.2
_MOST = 100  # lines of one program in one look
_LINE_LIMIT_BYTES = 4096
_PART_BYTES = 2**16


class OutputLog:
    """Logs the lines of programs from now on. Its thread runs while there are any."""

    def __init__(self) -> None:
        self._files: dict[str, _Tail] = {}
        self._lock = threading.Lock()
        self._is_over = threading.Event()
        self._thread: threading.Thread | None = None

    def follow(self, key: str, name: str, file: Path, *, from_start: bool) -> None:
        """Log the lines of a program: all of them, or those that come from now on."""
        with self._lock:
            self._files[key] = _Tail(name, file, from_start=from_start)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="rr-program-output", daemon=True)
                self._thread.start()

    def leave(self, key: str) -> None:
        """Log what has come of a program that is over, and no more."""
        with self._lock:
            tail = self._files.pop(key, None)
            if tail is not None:
                tail.look(final=True)

    def close(self) -> None:
        """Log nothing more."""
        self._is_over.set()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        while not self._is_over.wait(_LOOK_S):
            with self._lock:
                for tail in self._files.values():
                    tail.look()


class _Tail:
    """How far the output file of one program was read. The file begins anew when it is long (shim.py)."""

    def __init__(self, name: str, file: Path, *, from_start: bool) -> None:
        self._name, self._path = name, file
        self._file: int | None = None
        self._rest = b""
        if not from_start:
            self._open()
            if self._file is not None:
                os.lseek(self._file, 0, os.SEEK_END)

    def look(self, *, final: bool = False) -> None:
        """Log the lines that have come."""
        lines = list(self._new_lines())
        if final and self._rest:
            lines.append(self._rest)
            self._rest = b""
        for line in lines[:_MOST]:
            logger.info("%s: %s", self._name, readable(line.decode(errors="replace")))
        if len(lines) > _MOST:
            logger.info("%s: %d lines more, in %s", self._name, len(lines) - _MOST, self._path)
        if final:
            self._close()

    def _new_lines(self) -> Iterator[bytes]:
        while True:
            if self._file is None and not self._open():
                return
            data = self._read()
            if not data:
                if not self._began_anew():
                    return
                self._close()
                continue
            *lines, self._rest = (self._rest + data).split(b"\n")
            yield from (line[:_LINE_LIMIT_BYTES] for line in lines)
            if len(self._rest) > _LINE_LIMIT_BYTES:
                yield self._rest[:_LINE_LIMIT_BYTES]
                self._rest = b""

    def _open(self) -> bool:
        with contextlib.suppress(OSError):  # the program has written nothing yet, or no descriptor is left
            self._file = os.open(self._path, os.O_RDONLY | os.O_CLOEXEC)
        return self._file is not None

    def _read(self) -> bytes:
        assert self._file is not None
        with contextlib.suppress(OSError):
            return os.read(self._file, _PART_BYTES)
        return b""

    def _began_anew(self) -> bool:
        assert self._file is not None
        with contextlib.suppress(OSError):
            return os.fstat(self._file).st_ino != self._path.stat().st_ino
        return False

    def _close(self) -> None:
        if self._file is not None:
            os.close(self._file)
            self._file = None
