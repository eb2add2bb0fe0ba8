"""What the tests among real nodes of ROS 2 share: a domain that no other test of this machine has, a patient bridge."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from rr_actors import ros2

_FIRST, _LAST = 1, 101  # above, the ports of a domain are among those that the kernel gives out


class PatientBridge(ros2.Bridge):
    """A bridge that has seen the other nodes before it looks for a name that is taken, on a busy machine, too."""

    _discovery_s = 8.0


class PatientNodes(ros2.Nodes):
    """The same of a manager of nodes."""

    _discovery_s = 8.0


@contextlib.contextmanager
def domain_of_its_own(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Iterator[int]:
    """Set the environment for one domain, on the loopback alone, without files in shared memory.

    Two tests in one domain would see each other's nodes. An abstract socket holds the number for this test: it has no
    file, and the kernel closes it with this process.
    """
    with contextlib.closing(socket.socket(socket.AF_UNIX)) as held:
        number = _hold_one(held)
        for name, value in (
            ("ROS_DOMAIN_ID", str(number)),
            ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"),
            ("FASTDDS_BUILTIN_TRANSPORTS", "UDPv4"),
            ("ROS_LOG_DIR", str(folder / "log")),
        ):
            monkeypatch.setenv(name, value)
        yield number


def _hold_one(held: socket.socket) -> int:
    count = _LAST - _FIRST + 1
    for i in range(count):
        number = _FIRST + (os.getpid() + i) % count
        with contextlib.suppress(OSError):  # another test has it
            held.bind(f"\0rr_actors test: domain {number} of ROS 2")
            return number
    raise AssertionError("expected a free domain of ROS 2, got none")
