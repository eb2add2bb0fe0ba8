"""Notices to the service manager, as systemd's sd_notify sends them: it has started, how it is, it lives, it stops.

systemd names the socket in NOTIFY_SOCKET. With `WatchdogSec=` it names a time in WATCHDOG_USEC, too: it ends a process
that says nothing for so long. The event loop of the application's process says so, so that a loop that stands still is
noticed. Elsewhere nothing is sent. See sd_notify(3).
"""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Mapping

from rr_actors.base.errors import counted
from rr_actors.base.reporting.log import Log
from rr_actors.runtime.thread_rules import on_loop

logger = Log("rr_actors")

_OFTEN = 3  # notices within the time of the watchdog: one may be late


@on_loop
class ServiceNotices:
    """What the service manager hears of one system. It never fails: a service that runs is worth more than a notice.

    Args:
        environment: the variables of the process.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, environment: Mapping[str, str] = os.environ) -> None:
        self._loop = loop
        self._address = environment.get("NOTIFY_SOCKET", "")
        self._every_s = _watchdog_s(environment) / _OFTEN
        self._timer: asyncio.TimerHandle | None = None
        self._restarts = 0

    def started(self, status: str) -> None:
        """Say that all children are ready, and go on saying that the loop lives."""
        self._send(f"READY=1\nSTATUS={status}")
        self._live()

    def restarted(self, path: str) -> None:
        """Say that a child was started again."""
        self._restarts += 1
        self._send(f"STATUS=runs; {counted(self._restarts, 'restart')}, the last of {path}")

    def ended(self, why: str) -> None:
        """Say that the tree has ended by itself. The process may go on."""
        self._send(f"STATUS=the tree has ended: {' '.join(why.split())}")

    def stopping(self) -> None:
        """Say that the system stops. The watchdog is fed until it has stopped: that has a time limit of its own."""
        self._send("STOPPING=1\nSTATUS=stops")

    def close(self) -> None:
        """Say nothing more."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _live(self) -> None:
        if self._address and self._every_s:
            self._send("WATCHDOG=1")
            self._timer = self._loop.call_later(self._every_s, self._live)

    def _send(self, text: str) -> None:
        if not self._address:
            return
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
                sender.setblocking(False)
                sender.sendto(text.encode(errors="replace"), address)
        except OSError as error:
            logger.warning("the service manager at NOTIFY_SOCKET=%s does not hear: %s", self._address, error)


def _watchdog_s(environment: Mapping[str, str]) -> float:
    """Return how long this process may say nothing; 0 for no limit."""
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return 0.0
    try:
        return max(0, int(environment.get("WATCHDOG_USEC", "0"))) / 1_000_000
    except ValueError:
        return 0.0
