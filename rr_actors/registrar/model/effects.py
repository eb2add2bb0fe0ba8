"""Effects: the actions of a decision once its changes are on disk. Data only; the registrar's actor carries them out.

Each effect can be derived from the rows again. So a process that is killed before it has carried one out does so when
it comes back.
"""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from rr_actors.registrar.model.messages import Failure, Message
from rr_actors.registrar.model.rows import Held, Notice, Resource


class Effect(msgspec.Struct, frozen=True):
    """The base of all effects; EffectRunner has a table from each type to its method."""


class Reply(Effect, frozen=True, gc=False):
    """Send to the consumer `origin`; lost if it has no link (it will ask again)."""

    origin: str
    message: Message


class Request(Effect, frozen=True, gc=False):
    """Send to a provider over our link; lost if that is down (the next link sends all open messages again)."""

    registrar: str
    message: Message


class Connect(Effect, frozen=True):
    """Open a link to the provider if there is none, because something waits for it."""

    registrar: str


class StartLoad(Effect, frozen=True):
    """Run the load callback."""

    resource: Resource


class StartUnload(Effect, frozen=True):
    """Run the unload callback."""

    resource: Resource


class StartRecover(Effect, frozen=True):
    """Run the recover callback, or the load callback again if the policy is reload."""

    resource: Resource
    reload: bool


class StartStatus(Effect, frozen=True):
    """Run the status callback of the resource for a notice about it, or about a part of it; then post StatusDone.

    Without a status callback, StatusDone is posted at once.
    """

    resource: Resource
    notice: Notice
    repeated: bool


class SetTimer(Effect, frozen=True):
    """Post `command` after `delay_s`. It replaces the timer of the same key; with None it cancels that."""

    key: str
    delay_s: float | None
    command: Any


class LoadResolved(Effect, frozen=True, gc=False):
    """The load of this query has ended; `failure` is None if it is held."""

    held: Held
    failure: Failure | None


class UnloadResolved(Effect, frozen=True, gc=False):
    """The release of this query has ended, or cannot end now (`failure`)."""

    query_id: str
    failure: Failure | None


class Receive(Effect, frozen=True):
    """Decide this message as though `sender` had sent it: in its turn, and not before statuses are decided."""

    sender: str
    message: Message


class Hear(Effect, frozen=True):
    """Tell the listeners of a query about a notice; then post Heard."""

    held: Held
    notice: Notice
    repeated: bool


class Answer(Effect, frozen=True):
    """Answer a call of the owner."""

    ticket: Any
    failure: Failure | None


Happening = Literal["loaded", "load_failed", "unloaded", "unload_failed", "status"]


class Happened(Effect, frozen=True):
    """Tell the watchers of the system what has happened to a resource: "loaded", "unloaded", "status" ..."""

    what: Happening
    resource_id: str
    server: str
    detail: str
