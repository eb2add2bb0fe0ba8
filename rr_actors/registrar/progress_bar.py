"""Bars on the terminal for loads with progress=True. The one module of the registrar that needs the library rich.

A terminal has one live display at a time, so all bars of the process are lines of one. The display begins with the
first report of a load, and ends with the last of these loads. If standard error is no terminal, nothing is drawn.
"""

from __future__ import annotations

import sys
import threading

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn

from rr_actors.base.reporting.log import Log
from rr_actors.registrar.engine import progress as reports

logger = Log("rr_actors.registrar")


class _Display:
    """The live display of this process, while there are bars."""

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._shown: Progress | None = None
        self._bars = 0

    def add(self, description: str) -> tuple[Progress, TaskID] | None:
        """Draw one bar more. Return None if the output is no terminal, or another live display has it."""
        with self._lock:
            if self._shown is None:
                console = Console(stderr=True)
                if not console.is_terminal:
                    return None
                text = TextColumn("{task.description}", markup=False)
                columns = (text, BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
                shared = sys.stdout.isatty()  # then printed lines go above the bars; else they are left alone
                shown = Progress(*columns, console=console, transient=True, redirect_stdout=shared)
                try:
                    shown.start()
                except Exception as error:
                    logger.info("progress=True: nothing is drawn: %s", error)
                    return None
                self._shown = shown
            self._bars += 1
            return self._shown, self._shown.add_task(description, total=1.0)

    def remove(self, task: TaskID) -> None:
        """Remove the bar of a load that has ended; with the last bar, end the display."""
        with self._lock:
            self._bars -= 1
            if self._shown is not None:
                self._shown.remove_task(task)
                if not self._bars:
                    shown, self._shown = self._shown, None
                    shown.stop()


_display = _Display()


class Bar:
    """The bar of one load, drawn from its first report on."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._drawn: tuple[Progress, TaskID] | None = None
        self._over = False

    def show(self, progress: reports.Progress) -> None:
        """Draw how far the load has come."""
        text = "".join(character if character.isprintable() else " " for character in progress.text)
        description = f"{progress.server} {text}".rstrip()
        with self._lock:
            if self._over:
                return
            if self._drawn is None:
                self._drawn = _display.add(description)
            if self._drawn is None:
                self._over = True
                return
            display, task = self._drawn
            display.update(task, completed=progress.fraction, description=description)

    def close(self) -> None:
        """Remove the bar, because the load has ended."""
        with self._lock:
            drawn, self._drawn, self._over = self._drawn, None, True
        if drawn is not None:
            _display.remove(drawn[1])
