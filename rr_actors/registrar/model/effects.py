"""Effects: the actions of a decision once its changes are on disk. Data only; the registrar's actor carries them out.

Each effect can be derived from the rows again. So a process that is killed before it has carried one out does so when
it comes back.
"""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.model.messages import Message
from rr_actors.registrar.model.rows import Held, Notice, Resource


class Effect(msgspec.Struct, frozen=True):
    """The base of all effects; EffectRunner has a table from each type to its method."""


class SendReply(Effect, frozen=True, gc=False):
    """Send to the consumer `origin`; lost if it has no link (it will ask again)."""

    origin: str
    message: Message


class SendRequest(Effect, frozen=True, gc=False):
    """Send to a provider over our link; lost if that is down (the next link sends all open messages again)."""

    registrar: str
    message: Message


class Connect(Effect, frozen=True):
    """Open a link to the provider if there is none, because something waits for it."""

    registrar: str


class StartCallback(Effect, frozen=True):
    """Run the callback of a role (model/roles.py) for a resource, if it still is there; then post CallbackEnded.

    Without a server, a callback with a phase waits: the resource goes on when its server is registered.

    Attributes:
        notice: of a status callback: what it hears, about the resource or about a part of it.
        repeated: whether it may have heard that before.
        reload: of a recover callback: the load callback runs in its place, as the policy says.
    """

    role: str
    resource: Resource
    notice: Notice | None = None
    repeated: bool = False
    reload: bool = False


class SetTimer(Effect, frozen=True):
    """Post `command` when the process has run for `delay_s`; None: never. It replaces the timer of the same key."""

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


class FellBehind(Effect, frozen=True):
    """Say that a consumer is slow with the statuses of one query: `on_way` wait there, and newer ones wait here.

    `dropped`: how many of those that waited here are dropped. Without a query it is the server of the resource itself
    that is slow.
    """

    origin: str
    resource_id: str
    query_id: str
    on_way: int
    dropped: int = 0


class AnswerCall(Effect, frozen=True):
    """Answer a call of the owner."""

    ticket: Any
    failure: Failure | None


class Died(Effect, frozen=True):
    """The process before this one died while callbacks of resources ran, and not of something else.

    `runs` names them; `given_up` has a sentence for each callback that will not run again.
    """

    runs: tuple[str, ...]
    given_up: tuple[str, ...]


class Acquitted(Effect, frozen=True):
    """Say that none of the callbacks that ran when the process before died ends the process: the death counts."""


class RingBroken(Effect, frozen=True):
    """Say that a part was released that held its own whole."""

    why: str


class InLine(Effect, frozen=True):
    """Tell the load that waits for a QUEUED resource its place in line; "": it waits no longer.

    Nothing derives it again: the next change of the line says the places anew.

    Attributes:
        holder: the registrar that has the resource; "": nobody does. `since`: when that one asked for it.
    """

    resource_id: str
    text: str
    holder: str = ""
    since: float | None = None


Happening = Literal[
    "loaded",
    "load_failed",
    "unloaded",
    "unload_failed",
    "status",
    "priority",
    "revoked",
    "reloading",
    "paused",
    "pause_failed",
    "resumed",
]


class Happened(Effect, frozen=True):
    """Tell the watchers of the system what has happened to a resource: "loaded", "unloaded", "status" ...

    `notice`: the status that the resource has got. `kept`: the system's memory keeps it, also while nobody watches.
    """

    what: Happening
    resource: Resource
    detail: str
    notice: Notice | None = None
    kept: bool = False
