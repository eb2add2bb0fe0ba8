"""Heartbeat: checks that the loop of a child's process is alive, and that the process can work.

The loop itself answers, so a user's callback may take any time. A process that is stopped, holds the interpreter or
blocks its loop does not answer. The answer has the trouble that Health finds in that process.

A supervisor that itself stood still (SIGSTOP for the whole process group, a suspended machine, a debugger) does not
count that time: the child may have stood still with it. Nor does time count in which the child's loop was ready to run,
and other processes had all processors.
"""

from __future__ import annotations

import asyncio
import errno
import os
from collections.abc import Callable, Iterable
from pathlib import Path

from rr_actors.runtime.time_limits import wait_while_running

_LAST_LOOK = 1 / 20  # of the limit: how much longer to wait for an answer that has arrived unread

_OF_ALL = (errno.ENFILE, errno.ENOMEM, errno.EINTR, errno.EIO, errno.ENOENT, errno.ENOTDIR)
"""Errors that a new process in its place would have as well."""
_SPARE = 8
"""How many descriptors must be free: a connection or a segment of a journal takes some for a while."""


class Heartbeat:
    """Asks twice in each `limit_s`, from now on, whether the child's loop is alive. On the loop.

    Args:
        ping: sends the question.
        kill: called with the reason, at the end of the heartbeat: there was no answer for `limit_s`, or two answers in
            a row had a trouble, which may pass by itself after the first.
        starved_s: returns how many seconds the child's loop has waited for a processor since its start.
    """

    def __init__(
        self, limit_s: float, ping: Callable[[], None], kill: Callable[[str], None], starved_s: Callable[[], float]
    ) -> None:
        self._limit_s = limit_s
        self._ping = ping
        self._kill = kill
        self._starved_s = starved_s
        self._answer: asyncio.Future[str] | None = None
        self._asking = asyncio.get_running_loop().create_task(self._ask())

    def heard(self, trouble: str) -> None:
        """Note the answer, with the trouble of the process."""
        if self._answer is not None and not self._answer.done():
            self._answer.set_result(trouble)

    def stop(self) -> None:
        """Ask no more."""
        self._asking.cancel()

    async def _ask(self) -> None:
        was_ill = False
        while True:
            await asyncio.sleep(self._limit_s / 2)
            answer = self._answer = asyncio.get_running_loop().create_future()
            before = self._starved_s()
            self._ping()
            left_s = self._limit_s
            while not answer.done() and left_s > self._limit_s * _LAST_LOOK:
                await wait_while_running(answer, left_s)
                before, left_s = (now := self._starved_s()), now - before
            if not answer.done():  # uvloop runs timers before it reads: an answer may be there, unread
                await asyncio.sleep(self._limit_s * _LAST_LOOK)
            if not answer.done():
                self._kill(f"hung: its loop had not answered for {self._limit_s:g} s (heartbeat_s)")
                return
            trouble = answer.result()
            if trouble and was_ill:
                self._kill(f"unhealthy: it {trouble} (heartbeat_s)")
                return
            was_ill = bool(trouble)


class ProcessHealth:
    """The health of this process.

    Args:
        directories: returns the directories in which the process works now.
    """

    def __init__(self, directories: Callable[[], Iterable[Path]]) -> None:
        self._directories = directories
        self._root = os.stat("/")

    def trouble(self) -> str:
        """Return why this process cannot go on, in words; "" if it can.

        It opens each directory, which takes free descriptors and the rights to it. An error that a new process would
        have as well is no trouble. Blocks for some 10 µs for each directory.
        """
        if not os.path.samestat(self._root, os.stat("/")):
            return "has another root directory than it was started in (chroot)"
        for directory in self._directories():
            try:
                _open(directory)
            except OSError as error:
                if error.errno not in _OF_ALL:
                    name = errno.errorcode.get(error.errno or 0, "OSError")
                    return f"cannot open {directory}: {name} ({error.strerror})"
        return ""


def _open(directory: Path) -> None:
    opened = [os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)]
    try:
        opened.extend(os.dup(opened[0]) for _ in range(_SPARE - 1))
    finally:
        for descriptor in opened:
            os.close(descriptor)
