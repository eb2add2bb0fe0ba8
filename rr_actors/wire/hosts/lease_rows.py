"""The row of a lease at another host, which all processes of this system read: whether it is over.

The gateway writes it at each heartbeat. It may be frozen or killed when the lease ends, so each process that holds
something looks for itself. The row is a file of the state directory: a system that was started again has it, too.
"""

from __future__ import annotations

import contextlib
import functools
import os
import random
import time
from pathlib import Path

import msgspec

_FOLDER = ".leases"
_IDENTITY = ".identity"  # no host has such a name


class LeaseRow(msgspec.Struct, frozen=True):
    """A lease. `number`: its number; the next one has a higher number. `until`: when it ends, by now_s().

    `boot`: of which start of the machine that is. `registrars`: those of the other host that release at its end.
    """

    number: int
    until: float
    boot: str
    registrars: list[str]

    @property
    def left_s(self) -> float:
        """How long it goes on if it is not renewed; 0 or less: it is over."""
        return self.until - now_s() if self.boot == boot_id() else 0.0


def now_s() -> float:
    """Return the time of a clock that nobody sets, and that goes on while the machine sleeps."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


@functools.cache
def boot_id() -> str:
    """Return what differs between two starts of the machine."""
    with contextlib.suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    return ""


_encode = msgspec.json.Encoder().encode
_decode = msgspec.json.Decoder(LeaseRow).decode


def read_lease(state_dir: str, host: str) -> LeaseRow | None:
    """Return the lease at a host; None if there was none, or nothing there releases at its end."""
    with contextlib.suppress(OSError, msgspec.MsgspecError):
        return _decode(Path(state_dir, _FOLDER, host).read_bytes())
    return None


def identity(state_dir: str) -> int:
    """Return a number that differs between state directories: one that is new knows nothing of what is held elsewhere.

    Raises:
        OSError: it cannot be written, for instance as the disk is full.
    """
    folder = Path(state_dir, _FOLDER)
    folder.mkdir(mode=0o700, exist_ok=True)
    place = folder / _IDENTITY
    with contextlib.suppress(OSError, ValueError):
        return int(place.read_text(encoding="ascii"))
    number = random.SystemRandom().randrange(1, 1 << 62)
    draft = folder / f"{_IDENTITY}.new"
    draft.write_text(str(number), encoding="ascii")
    os.replace(draft, place)
    return number


def write_lease(state_dir: str, host: str, row: LeaseRow) -> None:
    """Write the lease at a host. A reader finds the row before this one, or this one.

    Raises:
        OSError: the disk is full, for instance. Then the lease seems to end earlier than it does.
    """
    folder = Path(state_dir, _FOLDER)
    folder.mkdir(mode=0o700, exist_ok=True)
    draft = folder / f".{host}.new"
    draft.write_bytes(_encode(row))
    os.replace(draft, folder / host)
