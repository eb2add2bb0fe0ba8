"""Leases between hosts: how long a provider keeps what another host holds while it hears nothing of that host.

No I/O and no clock: the caller says what time it is. Any clock does that goes on while the machine sleeps, and that
nobody sets; the clocks of the two hosts may differ, if one is not faster than the other by more than MARGIN.

The consumer counts from when it sent the last heartbeat that was acknowledged. The provider counts from when it heard
the last one, and waits longer. So the consumer knows first that its lease is over.
"""

from __future__ import annotations

MARGIN = 0.1
"""The provider waits longer by this part of the lease: clocks drift, and the consumer's programs have to hear of it."""
BEATS = 5
"""The heartbeats of one lease."""


class TakenLease:
    """The consumer's side of a lease.

    Args:
        until: the end of a lease that began before, for a process that was started again; None: it has not begun.

    Attributes:
        until: when it ends, if nothing is acknowledged any more; None: it has not begun.
    """

    def __init__(self, until: float | None = None) -> None:
        self.until = until
        self._sent: dict[int, float] = {}
        self._number = 0

    def beat(self, now: float) -> int:
        """Return the number of a heartbeat that is sent now."""
        self._number += 1
        self._sent[self._number] = now
        return self._number

    def acknowledged(self, number: int, lease_s: float) -> bool:
        """Note that the provider has heard a heartbeat; return whether it is one of this lease that was not yet."""
        sent = self._sent.pop(number, None)
        if sent is None:
            return False
        for older in [one for one in self._sent if one < number]:
            del self._sent[older]
        self.until = max(self.until or 0.0, sent + lease_s)
        return True

    def lose(self) -> None:
        """Forget the heartbeats that are not acknowledged: the link that carried them is lost."""
        self._sent.clear()

    def is_over(self, now: float) -> bool:
        """Return whether the provider may release what is held there, or will soon."""
        return self.until is not None and now >= self.until


class GivenLease:
    """The provider's side of a lease, which begins now.

    Args:
        identity: of the system that has it; another one of the same name has no part in it.
    """

    def __init__(self, now: float, lease_s: float, identity: int = 0) -> None:
        self.identity = identity
        self._heard = now
        self._lease_s = lease_s

    def hear(self, now: float) -> None:
        """Note a heartbeat."""
        self._heard = now

    def is_over(self, now: float) -> bool:
        """Return whether what the other host holds is to be released."""
        return now >= self._heard + kept_s(self._lease_s)


def kept_s(lease_s: float) -> float:
    """Return for how long a provider keeps what a host holds of which it hears nothing."""
    return lease_s * (1 + MARGIN)
