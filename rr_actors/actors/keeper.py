"""Keeper: looks after the files of a running system that a cleaner of temporary files, or a person, may remove.

What is gone is made again, and the log says so. What is there is touched each hour: most cleaners take what is old.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable

from rr_actors.actors.watched import Watched
from rr_actors.directory import Directory
from rr_actors.steps import Steps
from rr_actors.transports.unix import UnixTransport

LOOK_S = 5.0
"""Seconds from one look to the next."""
_TOUCH_S = 3600.0

logger = logging.getLogger("rr_actors")


class Keeper:
    """Of one process: its names, its socket, and the byte that all share. On the loop.

    Attributes:
        also: what else to look after; called on the loop, and quick.
    """

    def __init__(self, directory: Directory, transport: UnixTransport, watched: Watched) -> None:
        self.also: list[Callable[[], object]] = []
        self._directory = directory
        self._transport = transport
        self._watched = watched
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Look from now on."""
        self._task = asyncio.get_running_loop().create_task(self._keep())

    def stop(self) -> None:
        """Look no more."""
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
        """Make again what is gone."""
        steps = Steps()
        steps.take("looking after the directory of names", self._restore_names)
        await steps.take_async("looking after the socket", self._restore_socket())
        steps.take("looking after the file that says whether anybody watches", self._watched.restore)
        for look in self.also:
            steps.take("looking after the state directory", look)
        steps.report(logger, "what a running system needs on disk was removed, and cannot be made again")

    def _restore_names(self) -> None:
        if self._directory.restore():
            logger.error(
                "%s: it was removed while the system runs, and is made again; keep it from cleaners of temporary files,"
                " or choose another state_dir",
                self._directory.run_dir,
            )

    async def _restore_socket(self) -> None:
        if await self._transport.keep():
            logger.error("%s: the process's socket was removed, and is made again", self._transport.address)
