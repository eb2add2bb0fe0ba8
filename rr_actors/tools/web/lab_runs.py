"""Runs of the lab: each runs an experiment in a process and a state directory of its own, and leaves nothing."""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import inspect
import shutil
import subprocess
import sys
import tempfile
import threading
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from rr_actors.base.errors import RrError
from rr_actors.runtime.processes.lifeline import kill_group
from rr_actors.tools.web.watch import Watch

_PACKAGE = "rr_actors.tools.experiments"
_NAMES = (
    "four_strategies", "restart_storm", "escalation_levels", "poisoned_actor", "sharing_and_parts", "kill_in_a_load",
)  # fmt: skip
AT_ONCE = 4
"""How many experiments may run at a time, of all browsers together."""
_LOOK_FOR = "Look for:"
_STOP_S = 5.0
_LOOK_S = 0.1
_LINES = 100


@dataclass(frozen=True)
class Experiment:
    """One of the lab's programs.

    Attributes:
        title, about, look_for: texts for people, from the module's docstring.
        code: the module's text after the docstring.
    """

    name: str
    title: str
    about: str
    look_for: str
    code: str


def experiments() -> list[Experiment]:
    """Return all experiments, as the lab shows them."""
    return [_read(name) for name in _NAMES]


def _read(name: str) -> Experiment:
    spec = importlib.util.find_spec(f"{_PACKAGE}.{name}")
    assert spec is not None
    assert spec.origin is not None
    _, docstring, code = Path(spec.origin).read_text().split('"""', 2)
    title, _, rest = inspect.cleandoc(docstring).partition("\n")
    about, _, look_for = rest.partition(_LOOK_FOR)
    return Experiment(name, title.rstrip("."), _flowing(about), _flowing(look_for), code.strip() + "\n")


def _flowing(text: str) -> str:
    return " ".join(text.split())


class Run:
    """A run of an experiment, from its start to its end. Any thread may use it.

    Attributes:
        lines: the lines that it has printed.
        watch: the watch of the system that it has started; None until that is reached.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.lines: deque[str] = deque(maxlen=_LINES)
        self.watch: Watch | None = None
        self._state = tempfile.mkdtemp(prefix="rr-lab-")
        self._stopping = threading.Event()
        command = [sys.executable, "-m", _PACKAGE, name, self._state]
        self._program = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, process_group=0
        )
        assert self._program.stdout is not None
        self._reader = threading.Thread(target=self._read, args=(self._program.stdout,), name="rr-lab-reader")
        self._reader.start()
        self._keeper = threading.Thread(target=self._keep, name="rr-lab-run")
        self._keeper.start()

    @property
    def is_running(self) -> bool:
        """True until the run has ended and nothing of it is left."""
        return self._keeper.is_alive()

    def stop(self) -> None:
        """End the run, and wait until nothing of it is left. A second call does nothing."""
        self._stopping.set()
        self._keeper.join()

    def _read(self, output: IO[str]) -> None:
        for line in output:
            self.lines.append(line.rstrip("\n"))

    def _keep(self) -> None:
        try:
            while self._program.poll() is None and not self._stopping.wait(_LOOK_S):
                if self.watch is None:
                    self._find()
        finally:
            self._end()

    def _find(self) -> None:
        with contextlib.suppress(RrError):  # the system has not started yet
            watch = Watch(self._state)
            watch.start()
            self.watch = watch

    def _end(self) -> None:
        watch, program = self.watch, self._program
        if program.poll() is None:
            program.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                program.wait(_STOP_S)
        kill_group(program.pid)
        program.wait()
        if watch is not None:
            watch.stop()
        self._reader.join(_STOP_S)
        for pipe in (program.stdin, program.stdout):
            if pipe is not None:
                pipe.close()
        shutil.rmtree(self._state, ignore_errors=True)


class Place:
    """Runs the experiments of one page: one at a time, and none after the page has gone. On one loop.

    Args:
        runs: the runs of all pages.

    Attributes:
        run: the page's newest run, until it is stopped.
    """

    def __init__(self, runs: set[Run]) -> None:
        self.run: Run | None = None
        self._runs = runs
        self._lock = asyncio.Lock()  # stopping takes a while, and another click may come meanwhile
        self._has_left = False

    async def start(self, name: str) -> bool:
        """Stop the page's experiment and start another; return False if too many run on other pages."""
        async with self._lock:
            await self._stop()
            if self._has_left:
                return True
            if sum(one.is_running for one in self._runs) >= AT_ONCE:
                return False
            self.run = Run(name)
            self._runs.add(self.run)
            return True

    async def stop(self) -> None:
        """Stop the page's experiment. A second call does nothing."""
        async with self._lock:
            await self._stop()

    async def leave(self) -> None:
        """Stop the page's experiment for good, as the page has gone: no other one is started."""
        self._has_left = True
        await self.stop()

    async def _stop(self) -> None:
        running, self.run = self.run, None
        if running is not None:
            await asyncio.to_thread(running.stop)
            self._runs.discard(running)
