"""Blame: the one place that decides whose fault a failure is, and what a status is about.

Only a fault of its own lowers the reliability of a component or an alternative, and makes it wait. Want of room, a
revocation, a ring of requests, a server that is not there, a full disk of somebody else are no fault of a device.
"""

from __future__ import annotations

from typing import NamedTuple

from rr_actors.base.errors import (
    CatalogError,
    CircularDependency,
    LoadError,
    MailboxFull,
    OverCapacity,
    RegistrarDown,
    UsageError,
)
from rr_actors.base.scarcity import wanted_by
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query, Status
from rr_actors.registrar.registrar import Registrar
from rr_actors.registrar.servers.callback_context import current

_OF_OTHERS = (CatalogError, CircularDependency, MailboxFull, OverCapacity, RegistrarDown, UsageError)
_FAILED = (State.ERROR, State.FATAL)


def is_own_fault(error: BaseException) -> bool:
    """Return whether what could not be loaded is to blame for it."""
    return isinstance(error, LoadError) and not isinstance(error, _OF_OTHERS) and not wanted_by(error)


def is_own_failure(status: Status) -> bool:
    """Return whether a status says that what it is about has failed, and is to blame for it."""
    return status.state in _FAILED and status.reason != "revoked"


class About(NamedTuple):
    """What a status is about, as the status callback of a whole sees it.

    Attributes:
        is_whole: it is about the whole itself, so its holders hear it.
        part: the part that it is about; None if that has been replaced or released meanwhile, perhaps by a run of the
            callback that a crash has interrupted. Then call ``status.handled()``.
    """

    is_whole: bool
    part: Query | None


def part_of(registrar: Registrar, status: Status) -> About:
    """Return what a status is about. Call it in a status callback.

    Raises:
        UnknownQuery: the whole is being unloaded.
    """
    whole = current().resource_id
    if status.resource_id == whole:
        return About(True, None)
    parts = registrar.children(whole)
    return About(False, next((part for part in parts if part.id == status.query_id), None))
