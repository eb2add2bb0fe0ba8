"""Commands: what the parts of a registrar's own process tell it, while messages come from other registrars.

They come from its API, its server actors, its timers and its links. `ticket` is any value that the caller wants back in
the Answer.
"""

from __future__ import annotations

from typing import Any

import msgspec

from rr_actors.registrar.model.catalog import Server
from rr_actors.registrar.model.messages import Failure, FetchedQuery
from rr_actors.registrar.model.rows import Change, Notice, State


class Command(msgspec.Struct, frozen=True):
    """The base of all commands; decide() has a table from each type to its function."""


class BeginAgain(Command, frozen=True):
    """The registrar has opened its catalog. This is the first command, before any server is registered."""


class SetRows(Command, frozen=True):
    """Write rows that need no other decision, for example those of stored servers."""

    changes: list[Change]


# -- as a provider ---------------------------------------------------------------------------------------------------


class RefuseLoad(Command, frozen=True):
    """Refuse the load of a consumer whose request cannot be read."""

    origin: str
    query_id: str
    failure: Failure


class Register(Command, frozen=True):
    """A server is registered; it serves its earlier resources again."""

    server: Server
    event: str


class Unregister(Command, frozen=True):
    """A server is unregistered: each of its queries is released, and the holder gets a notice."""

    name: str
    event: str
    ticket: Any


class LoadDone(Command, frozen=True, gc=False):
    """The load callback returned."""

    resource_id: str
    attempt: int
    response: bytes


class LoadErred(Command, frozen=True):
    """The load callback raised."""

    resource_id: str
    attempt: int
    failure: Failure


class LoadOverdue(Command, frozen=True):
    """The load callback has run for longer than the server's load_timeout_s."""

    resource_id: str
    attempt: int
    failure: Failure


class UnloadDone(Command, frozen=True, gc=False):
    """The unload callback returned."""

    resource_id: str
    tries: int


class UnloadErred(Command, frozen=True):
    """The unload callback raised."""

    resource_id: str
    tries: int
    failure: Failure


class RecoverDone(Command, frozen=True):
    """The resource lives; `response` is None if it has not changed."""

    resource_id: str
    attempt: int
    response: bytes | None
    event: str


class RecoverErred(Command, frozen=True):
    """The resource is lost."""

    resource_id: str
    attempt: int
    failure: Failure
    event: str


class LingerOver(Command, frozen=True):
    """The time is over for which an unheld resource is kept warm."""

    resource_id: str


class SetStatus(Command, frozen=True):
    """Set the status of a resource. `target`: its id, or that of a query on it.

    `callback_of`: the resource whose status callback sets it; "" if none does.
    """

    target: str
    event: str
    state: State
    message: str
    ticket: Any
    callback_of: str = ""


class SetResponse(Command, frozen=True):
    """Replace the response of a resource. `callback_of`: as in SetStatus."""

    target: str
    event: str
    response: bytes
    message: str
    ticket: Any
    callback_of: str = ""


class Swap(Command, frozen=True):
    """Put a spare in the place of a part that a resource holds, from its status callback, and release the part.

    `others` are spares of the same part that an interrupted run of the callback has loaded; they are released, too.
    `response` is the new response of the resource; None leaves it as it is.
    """

    resource_id: str
    part: str
    spare: str
    others: tuple[str, ...]
    event: str
    response: bytes | None
    message: str
    ticket: Any


class ForceUnload(Command, frozen=True):
    """Unload a resource that others may hold; its holders hear `why`. `target`: its id, or that of a query on it."""

    target: str
    event: str
    ticket: Any
    why: str = "unloaded by its owner"


# -- as a consumer ---------------------------------------------------------------------------------------------------


class Ask(Command, frozen=True, gc=False):
    """Load from a provider's server, for a resource of this registrar (`parent`, "" for none).

    `seq`: its running number in the order of loads.
    """

    query_id: str
    registrar: str
    server: str
    request: bytes
    parent: str
    seq: int


class Got(Command, frozen=True, gc=False):
    """A provider has answered a load in flight, on the connection of the caller's thread."""

    query_id: str
    resource_id: str
    response: bytes


class SendAgain(Command, frozen=True):
    """The connection of the caller's thread broke: the registrar's link goes on with the load or unload."""

    query_id: str


class GiveUp(Command, frozen=True):
    """Withdraw a load for which its caller does not wait any longer. `unheard`: even if it is held by now.

    That is for a thread that has closed its own connection: it has not heard the answer, and hears the failure.
    """

    query_id: str
    failure: Failure
    unheard: bool = False


class Release(Command, frozen=True, gc=False):
    """Release a query of this registrar."""

    query_id: str


class AddInFlight(Command, frozen=True):
    """Add the row of every load in flight, because somebody is about to read all rows."""


class ReleaseOverdue(Command, frozen=True):
    """End a caller's wait for its unload; the release stays owed."""

    query_id: str
    failure: Failure


class Heard(Command, frozen=True, gc=False):
    """All listeners of a query have heard what Hear told them. `handled`: one of them has dealt with it."""

    query_id: str
    event: str
    handled: bool = False


class StatusDone(Command, frozen=True):
    """A server's status callback has run for a notice, or did not have to. `handled`: it has dealt with the notice.

    The notice is about a part, or about the resource itself (rows.is_own).
    """

    resource_id: str
    notice: Notice
    handled: bool


class Reconcile(Command, frozen=True):
    """A link to a provider is up, with the provider's list of our queries; those in `same` agree, and are not listed.

    `link` is the number of the Fetch that opened the link.
    """

    registrar: str
    queries: list[FetchedQuery]
    event: str
    same: list[tuple[int, int]] = []
    link: int = 0


class ConsumerLost(Command, frozen=True):
    """The link of a consumer is down. It may come back."""

    origin: str


class LinkLost(Command, frozen=True):
    """The link to a provider is down. The client will try to open another."""

    registrar: str


class PeerGone(Command, frozen=True):
    """A provider cannot be reached. `final`: it is gone for good, and with it every query that we held there."""

    registrar: str
    failure: Failure
    final: bool
    event: str
