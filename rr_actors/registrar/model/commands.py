"""Commands: what the actors of a registrar's own process tell it, beside the messages of other registrars.

From its API, its server actors, its timers and its links. `ticket` is whatever the caller wants back in the Answer.
"""

from __future__ import annotations

from typing import Any

import msgspec

from rr_actors.registrar.model.catalog import Server
from rr_actors.registrar.model.messages import Failure, FetchedQuery
from rr_actors.registrar.model.rows import Change, Notice, State


class Command(msgspec.Struct, frozen=True):
    """Any of them: decide() has a table from each type to its function."""


class BeginAgain(Command, frozen=True):
    """The registrar has opened its catalog. The first of all, before any server is registered."""


class SetRows(Command, frozen=True):
    """Write rows from which nothing follows, for example those of stored servers."""

    changes: list[Change]


# -- as a provider ---------------------------------------------------------------------------------------------------


class RefuseLoad(Command, frozen=True):
    """Refuse the load of a consumer whose request cannot be read."""

    origin: str
    query_id: str
    failure: Failure


class Register(Command, frozen=True):
    """A server is there; it serves its resources from before again."""

    server: Server
    event: str


class Unregister(Command, frozen=True):
    """A server goes: every query on it is released and its holder told."""

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
    """The resource lives; `response` is None when it is as it was."""

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
    """An unheld resource has been kept warm for long enough."""

    resource_id: str


class SetStatus(Command, frozen=True):
    """The owner says how a resource is. `target`: its id, or that of a query on it.

    `callback_of`: the resource whose status callback says it; "" if none does.
    """

    target: str
    event: str
    state: State
    message: str
    ticket: Any
    callback_of: str = ""


class SetResponse(Command, frozen=True):
    """The owner replaces a resource's response. `callback_of`: as in SetStatus."""

    target: str
    event: str
    response: bytes
    message: str
    ticket: Any
    callback_of: str = ""


class Swap(Command, frozen=True):
    """A status callback puts a spare in the place of a part that its resource holds, and releases the part.

    `others` are spares of the same part that an interrupted run of the callback has loaded: they are released, too.
    `response` is the new one of the resource; None leaves it as it is.
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
    """The owner unloads a resource, and its holders hear `why`. `target`: its id, or that of a query on it."""

    target: str
    event: str
    ticket: Any
    why: str = "unloaded by its owner"


# -- as a consumer ---------------------------------------------------------------------------------------------------


class Ask(Command, frozen=True, gc=False):
    """Load: from whom, what, and for which resource of this registrar ("" for none).

    `seq`: its place in the order of what is asked; 0: the next.
    """

    query_id: str
    registrar: str
    server: str
    request: bytes
    parent: str
    seq: int = 0


class Got(Command, frozen=True, gc=False):
    """A load in flight has got something: its provider has answered on the connection of the caller's thread."""

    query_id: str
    resource_id: str
    response: bytes


class SendAgain(Command, frozen=True):
    """The connection of the caller's thread broke: the load, or the unload, goes on by the registrar's link."""

    query_id: str


class GiveUp(Command, frozen=True):
    """The caller does not wait for its load any longer: withdraw it. `unheard`: even if it is held by now.

    That is for a thread that has left its own connection: it did not hear the answer, and hears the failure.
    """

    query_id: str
    failure: Failure
    unheard: bool = False


class Release(Command, frozen=True, gc=False):
    """Unload a query of one's own."""

    query_id: str


class AddInFlight(Command, frozen=True):
    """Have a row of every load in flight: somebody is about to look at all that there is."""


class ReleaseOverdue(Command, frozen=True):
    """The caller does not wait for its unload any longer: it stays owed."""

    query_id: str
    failure: Failure


class Heard(Command, frozen=True, gc=False):
    """All who listen to a query have been through with what Hear told them. `handled`: one has dealt with it."""

    query_id: str
    event: str
    handled: bool = False


class StatusDone(Command, frozen=True):
    """A server's status callback, or who listens to the query, has dealt with a notice; or it is passed on.

    The notice is about a part that `provider` serves, or about the resource itself (rows.is_own).
    """

    resource_id: str
    notice: Notice
    provider: str
    handled: bool


class Reconcile(Command, frozen=True):
    """A link to a provider is up, and this is what it has of ours; where it is the `same` as here it is not listed.

    `link` is the number of the Fetch that opened it.
    """

    registrar: str
    queries: list[FetchedQuery]
    event: str
    same: list[tuple[int, int]] = []
    link: int = 0


class ConsumerLost(Command, frozen=True):
    """The link from a consumer is down; it will be back or not."""

    origin: str


class LinkLost(Command, frozen=True):
    """The link to a provider is down; it will be tried again."""

    registrar: str


class PeerGone(Command, frozen=True):
    """A provider cannot be reached. `final`: it is gone for good, and with it all we held there."""

    registrar: str
    failure: Failure
    final: bool
    event: str
