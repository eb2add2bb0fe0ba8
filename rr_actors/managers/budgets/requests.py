"""The requests of a Budgets manager, a share and a supply, and what it says of a pool."""

from __future__ import annotations

import msgspec

from rr_actors.base.checks import is_number
from rr_actors.base.errors import UsageError, shown
from rr_actors.base.names import new_id
from rr_actors.registrar.servers.callback_context import current_or_none


def _whose() -> str:
    """Return the resource whose callback runs here; outside of callbacks a new id, so no two requests are the same."""
    callback = current_or_none()
    return new_id() if callback is None else callback.resource_id


def _whose_name() -> str:
    callback = current_or_none()
    return "" if callback is None else callback.name


class Share(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The request for a part of a pool. Load it as a part, in the load callback of what needs it.

    Attributes:
        pool: the pool's name.
        amount: how much of it, at least 0.
        wait_s: how many seconds it may wait for others to release theirs. Room that is being made by a reserve, or by
            others that are revoked, is waited for in any case. `timeout_s` of the load should be longer.
        instance: a name that distinguishes requests that are otherwise the same, which would be one share. By default
            the resource whose callback makes the request; outside of callbacks each request is one of its own.
        whose: for people, the name of what the share is for. By default that of the same resource.
    """

    pool: str
    amount: float
    wait_s: float = 0.0
    instance: str = msgspec.field(default_factory=_whose)
    whose: str = msgspec.field(default_factory=_whose_name)

    def __rr_title__(self) -> str:
        return f"{self.amount:g} of {self.pool}{f' for {self.whose}' if self.whose else ''}"


class Supply(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The request to add to a pool's capacity. Load it as a part, as the last of the load callback.

    It adds while what it is a part of is needed: not while that is idle, paused, or FATAL, or has the priority -1000.
    """

    pool: str
    amount: float
    instance: str = msgspec.field(default_factory=_whose)

    def __rr_title__(self) -> str:
        return f"{self.amount:g} to {self.pool}"


class PoolInfo(msgspec.Struct, frozen=True):
    """A pool at one moment: `capacity` with its supplies, `used`, and how many loads are `waiting`.

    `problem`: what is wrong with the probe of its measure; meanwhile the last measured capacity holds. `enforced`:
    external programs can use no more of it than their shares. That is so of the pools "cpu" and "memory_bytes", where
    control groups can be made.
    """

    name: str
    capacity: float
    used: float
    waiting: int
    problem: str = ""
    enforced: bool = False

    @property
    def free(self) -> float:
        """What is left of the capacity, at least 0."""
        return max(0.0, self.capacity - self.used)


def check_request(request: Share | Supply) -> None:
    """Raise UsageError for a request whose numbers are wrong."""
    _check_number(request.amount, "amount")
    if isinstance(request, Share):
        _check_number(request.wait_s, "wait_s")


def _check_number(value: float, field: str) -> None:
    if not is_number(value) or value < 0:
        expected = "a number of at least 0"
        raise UsageError(f"{field}: expected {expected}, got {shown(value)}", field=field, expected=expected, got=value)
