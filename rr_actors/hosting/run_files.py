"""The files of a running system, which are restored while it runs, and the byte that says whether anybody watches."""

from __future__ import annotations

import asyncio
import contextlib
import mmap
import os
import time
from collections.abc import Callable

from rr_actors.base.errors import CatalogError, ConfigError
from rr_actors.base.folder import Folder, Place
from rr_actors.base.reporting.log import Log
from rr_actors.base.scarcity import wanted_by
from rr_actors.base.steps import Steps
from rr_actors.wire.name_service import Directory
from rr_actors.wire.unix_transport import UnixTransport

_NAME = "watched"
_EVENTS, _MESSAGES = 1, 3
"""Values of the byte: send events; send events and messages."""
DECISIONS = 4
"""From this value on, the decisions of registrars, too. A recording that wants them sets another of these values."""


class Watched:
    """One byte that all processes of a running system share, false at first. It is true while anybody wants events.

    Most systems run unwatched. To send every load to the system's own process costs as much as a tenth of the load, so
    nothing is sent then. All processes see a change of the byte at once, and read it without a system call.

    Args:
        run_dir: the system's StateDir.run_dir.

    Attributes:
        level: the byte: 0 nobody watches, 1 events are wanted, above 1 the messages between registrars, too, and from
            DECISIONS on their decisions. Code that runs in every load reads it here, in 20 ns; bool() takes five times
            as long.

    Raises:
        ConfigError: the file cannot be made there.
    """

    def __init__(self, run_dir: str | os.PathLike[str]) -> None:
        self._run_dir = os.fspath(run_dir)
        self._file: os.stat_result
        self.level: mmap.mmap | bytearray = self._open()

    def _open(self) -> mmap.mmap:
        try:
            with Folder.unlinked(self._run_dir) as run, run.open(_NAME, os.O_RDWR | os.O_CREAT) as file:
                os.ftruncate(file.fileno(), 1)
                self._file = os.fstat(file.fileno())
                return mmap.mmap(file.fileno(), 1)
        except OSError as error:
            path = f"{self._run_dir}/{_NAME}"
            advice = wanted_by(error) or "remove it, or choose another state_dir"
            text = f"cannot use {path}: {error.strerror or error}: {advice}"
            raise ConfigError(text, file=path, key="state_dir") from error

    def restore(self) -> None:
        """Make the file again if it was removed, or use the one that another process has made.

        Raises:
            ConfigError: the file cannot be made.
        """
        with contextlib.suppress(OSError):  # the file is gone
            if os.path.samestat(os.lstat(f"{self._run_dir}/{_NAME}"), self._file):
                return
        wanted = self.level[0]
        self.level = self._open()
        if wanted:
            self.level[0] = wanted

    def close(self) -> None:
        """Let the file go: nobody watches any more. Threads that still read the byte find 0."""
        self.level = bytearray(1)

    def __bool__(self) -> bool:
        return self.level[0] != 0

    def set(self, watched: bool, recording: bool = False, decisions: int = 0) -> None:
        """Set the byte for all processes of the system; `recording` wants events and messages.

        Args:
            decisions: the number of the newest recording that wants decisions, too; 0: there is none.
        """
        if decisions:
            self.level[0] = DECISIONS + decisions % (256 - DECISIONS)
        else:
            self.level[0] = _MESSAGES if recording else _EVENTS if watched else 0


LOOK_S = 5.0
"""Seconds from one check to the next."""
_TOUCH_S = 3600.0  # most cleaners of temporary files remove old ones

logger = Log("rr_actors")


class RunKeeper:
    """Looks after one process's names and sockets, and the byte that all processes share. On the loop.

    It makes removed files again, logs that, and touches the others each hour.

    Attributes:
        also: further checks, which the loop calls; they must be quick.
        transports: the transports with these sockets.
    """

    def __init__(
        self, directory: Directory, transport: UnixTransport, watched: Watched, place: Place | None = None
    ) -> None:
        self.also: list[Callable[[], object]] = []
        self._place = place
        self._is_there = True
        self._directory = directory
        self.transports = [transport]
        self._watched = watched
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Check the files from now on, every LOOK_S."""
        self._task = asyncio.get_running_loop().create_task(self._keep())

    def stop(self) -> None:
        """End the checks."""
        task, self._task = self._task, None
        if task is not None:
            task.cancel()

    async def _keep(self) -> None:
        touched = time.monotonic()
        while True:
            await asyncio.sleep(LOOK_S)
            await self.look()
            if time.monotonic() - touched > _TOUCH_S:
                touched = time.monotonic()
                self._directory.touch()

    async def look(self) -> None:
        """Make removed files again, unless the state directory itself has gone away."""
        if not self._look_at_place():
            return
        steps = Steps()
        steps.take("looking after the directory of names", self._restore_names)
        await steps.take_async("looking after the socket", self._restore_socket())
        steps.take("looking after the file that says whether anybody watches", self._watched.restore)
        for look in self.also:
            steps.take("looking after the state directory", look)
        steps.report(logger, "what a running system needs on disk was removed, and cannot be made again")

    def _look_at_place(self) -> bool:
        try:
            if self._place is not None:
                self._place.check()
        except CatalogError as error:
            if self._is_there:
                self._is_there = False
                logger.error("%s", error)
            return False
        if not self._is_there:
            self._is_there = True
            logger.warning("%s: the directory is in its place again, and written to", self._place and self._place.path)
        return True

    def _restore_names(self) -> None:
        if self._directory.restore():
            logger.error(
                "%s: it was removed while the system runs, and is made again; keep it from cleaners of temporary files,"
                " or choose another state_dir",
                self._directory.run_dir,
            )

    async def _restore_socket(self) -> None:
        for transport in self.transports:
            if await transport.keep():
                logger.error("%s: the process's socket was removed, and is made again", transport.address)
