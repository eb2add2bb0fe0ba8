"""Effects: what a decision wants done once its changes are on disk. Data only; the registrar actor does them.

Each can be derived again from the rows, so that a process killed before it was done does it when it comes back.
"""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from rr_actors.registrar.model.messages import Failure, Message
from rr_actors.registrar.model.rows import Held, Notice, Resource


class Effect(msgspec.Struct, frozen=True):
    """Any of them: EffectRunner has a table from each type to its method."""


class Reply(Effect, frozen=True, gc=False):
    """Send to the consumer `origin` over its link; lost if there is none (it will ask again)."""

    origin: str
    message: Message


class Request(Effect, frozen=True, gc=False):
    """Send to the provider over our link; lost if it is not up (everything open is sent again when it is)."""

    registrar: str
    message: Message


class Connect(Effect, frozen=True):
    """See to it that there is a link to the provider: something waits for it."""

    registrar: str


class StartLoad(Effect, frozen=True):
    """Run the load callback."""

    resource: Resource


class StartUnload(Effect, frozen=True):
    """Run the unload callback."""

    resource: Resource


class StartRecover(Effect, frozen=True):
    """Run the recover callback, or the load callback again when the policy says reload."""

    resource: Resource
    reload: bool


class StartStatus(Effect, frozen=True):
    """Run the status callback of the resource for a notice about it, or about a part of it; then give StatusDone.

    Without a status callback that is given at once.
    """

    resource: Resource
    notice: Notice
    provider: str
    repeated: bool


class SetTimer(Effect, frozen=True):
    """Give `command` to the registrar after `delay_s`; one with the same key replaces it, None cancels it."""

    key: str
    delay_s: float | None
    command: Any


class LoadResolved(Effect, frozen=True, gc=False):
    """The load of this query has ended: `failure` is None when it is held."""

    held: Held
    failure: Failure | None


class UnloadResolved(Effect, frozen=True, gc=False):
    """The release of this query has ended, or cannot end now (`failure`)."""

    query_id: str
    failure: Failure | None


class Receive(Effect, frozen=True):
    """Handle this as though `sender` had sent it: in its turn, and not before statuses may be heard."""

    sender: str
    message: Message


class Hear(Effect, frozen=True):
    """Tell the listeners of this query of its own; then give the registrar Heard."""

    held: Held
    notice: Notice
    repeated: bool


class Answer(Effect, frozen=True):
    """Answer a call of the owner."""

    ticket: Any
    failure: Failure | None


Happening = Literal["loaded", "load_failed", "unloaded", "unload_failed", "status"]


class Happened(Effect, frozen=True):
    """Something for those who watch: "loaded", "unloaded", "status" ..., and of which resource."""

    what: Happening
    resource_id: str
    server: str
    detail: str
