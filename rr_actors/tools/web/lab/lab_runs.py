"""Runs of the lab: each runs an experiment in a process and a state directory of its own, and leaves nothing."""

from __future__ import annotations

import asyncio
import contextlib
import json
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import IO

from rr_actors.base.errors import RrError
from rr_actors.runtime.processes.lifeline import kill_group
from rr_actors.tools.web.lab.lab_declarations import Seen, Value
from rr_actors.tools.web.watch import Watch

AT_ONCE = 4
"""How many experiments may run at a time, of all browsers together."""
_PROGRAM = "rr_actors.tools.web.lab"
_CHANGED = "changed_experiment.py"
_STOP_S = 15.0  # what is killed may leave programs that run on
_LOOK_S = 0.1
_LINES = 100


class Run:
    """A run of an experiment, from its start to its end. Any thread may use it.

    Args:
        program: the file of the experiment.
        levers: the arguments of its main().
        code: a text that is run in the place of its program; "" runs that.

    Attributes:
        name: of the experiment.
        began: seconds since the epoch.
        said: the lines that it has printed, each with its time.
        watch: the watch of the system that it has started; None until that is reached.
    """

    def __init__(self, program: Path, levers: Mapping[str, Value] | None = None, code: str = "") -> None:
        self.name = program.stem
        self.began = time.time()
        self.said: deque[tuple[float, str]] = deque(maxlen=_LINES)
        self.watch: Watch | None = None
        self._place = Path(tempfile.mkdtemp(prefix="rr-lab-"))
        self._state = str(self._place / "state")
        self._stopping = threading.Event()
        folder = program.parent
        if code:
            program = self._place / _CHANGED
            program.write_text(code)
        command = [sys.executable, "-m", _PROGRAM, program, folder, self._state, json.dumps(dict(levers or {}))]
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

    @property
    def has_finished(self) -> bool:
        """True after its program has come to its own end, without an error."""
        return not self.is_running and self._program.returncode == 0

    @property
    def lines(self) -> list[str]:
        """The lines that it has printed."""
        return [line for _, line in self.said.copy()]

    @property
    def seen(self) -> Seen:
        """What it has shown until now."""
        watch = self.watch
        return Seen(list(watch.events.copy()) if watch is not None else [], self.lines)

    def wait(self) -> None:
        """Wait until the run has come to its own end, after 90 s at the latest, and nothing is left of it."""
        self._keeper.join()

    def stop(self) -> None:
        """End the run, and wait until nothing of it is left. A second call does nothing."""
        self._stopping.set()
        self._keeper.join()

    def _read(self, output: IO[str]) -> None:
        for line in output:
            self.said.append((time.time(), line.rstrip("\n")))

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
        shutil.rmtree(self._place, ignore_errors=True)


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

    async def start(self, program: Path, levers: Mapping[str, Value] | None = None, code: str = "") -> bool:
        """Stop the page's experiment and start another; return False if too many run on other pages."""
        async with self._lock:
            await self._stop()
            if self._has_left:
                return True
            if sum(one.is_running for one in self._runs) >= AT_ONCE:
                return False
            self.run = Run(program, levers, code)
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
