"""Commands: what the parts of a registrar's own process tell it, while messages come from other registrars.

They come from its API, its server actors, its timers and its links. `ticket` is any value that the caller wants back in
the Answer.
"""

from __future__ import annotations

from typing import Any

import msgspec

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.model.catalog import Server
from rr_actors.registrar.model.messages import FetchedQuery
from rr_actors.registrar.model.rows import Change, Notice, Resource, State


class Command(msgspec.Struct, frozen=True):
    """The base of all commands; decide() has a table from each type to its function."""


class BeginAgain(Command, frozen=True):
    """The registrar has opened its catalog. This is the first command, before any server is registered."""


class BeginServing(Command, frozen=True):
    """on_start has returned, and other registrars are let in: callbacks that waited for that begin."""

    event: str


class BeginClosing(Command, frozen=True):
    """The registrar is being closed for good: it loads nothing any more for others; `own`: nor for itself."""

    failure: Failure
    own: bool = False


class EndClosing(Command, frozen=True):
    """The registrar is closed for good: what it served and held is released, as far as that was possible."""


class EndProcess(Command, frozen=True):
    """The process ends cleanly: no callback that runs now is to blame for that, and the next process runs it again."""


class SetRows(Command, frozen=True):
    """Write rows that need no other decision, for example those of stored servers."""

    changes: list[Change]


# -- as a provider ---------------------------------------------------------------------------------------------------


class RefuseLoad(Command, frozen=True):
    """Refuse the load of a consumer whose request cannot be read."""

    origin: str
    query_id: str
    failure: Failure


class Reread(msgspec.Struct, frozen=True):
    """What today's types make of a stored resource: its request and response today, or why they do not fit."""

    resource_id: str
    request: bytes
    response: bytes | None
    misfit: str = ""


class Register(Command, frozen=True):
    """A server is registered; it serves its earlier resources again.

    `reread`: those that an earlier version stored. `digest`: of today's types, to which all others fit (rows.types_id).
    """

    server: Server
    event: str
    reread: tuple[Reread, ...] = ()
    digest: bytes = b""


class Unregister(Command, frozen=True):
    """A server is unregistered: each of its queries is released, and the holder gets a notice."""

    name: str
    event: str
    ticket: Any


class CallbackEnded(Command, frozen=True, gc=False):
    """The callback of a role (model/roles.py) has returned, or raised; or it did not have to run.

    Attributes:
        run: the number of the run: an attempt; of an unload, its `tries`.
        failure: why it raised; None: it returned. A status, usage or health callback has none.
        response: what it returned; None: no response, or no new one.
        event: the id of a status that may follow from that.
        notice: of a status callback: what it heard; `handled`: it has dealt with the notice.
        took_s: of a load callback: how long it ran, its wait for a thread included.
        stopped: of a load callback that raised: it was told to stop before, and nobody needed it when it ended.
    """

    role: str
    resource_id: str
    run: int = 0
    failure: Failure | None = None
    response: bytes | None = None
    event: str = ""
    notice: Notice | None = None
    handled: bool = False
    took_s: float = 0.0
    stopped: bool = False


class CallbackOverdue(Command, frozen=True):
    """The load or recover callback has run for longer than its server's load_timeout_s or recover_timeout_s."""

    role: str
    resource_id: str
    run: int
    failure: Failure


class BeginRun(Command, frozen=True):
    """A usage callback is due, or a health callback of a resource that was there when this process began.

    `waited`: the time is over for which a health callback waited in whose runs processes have died.
    """

    role: str
    resource: Resource
    waited: bool = False


class BeginTrial(Command, frozen=True):
    """It is this callback's turn to run, alone among those in whose runs the process has died."""

    run_id: str


class TrialOver(Command, frozen=True):
    """The callback has run for long enough: it is the next one's turn."""

    run_id: str


class RefusalOver(Command, frozen=True):
    """The time is over for which a request is refused, or remembered, because its load was given up."""

    run_id: str


class WaitOver(Command, frozen=True):
    """The time is over for which a load may wait in line (Load.wait_ms)."""

    query_id: str


class LingerOver(Command, frozen=True):
    """The time is over for which an idle resource is kept running, or an unheld one is kept."""

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
    """Unload a resource that others may hold; its holders hear `why`. `target`: its id, or that of a query on it.

    `clears`: a resource whose unload callback is not run any more is removed without it.
    """

    target: str
    event: str
    ticket: Any
    why: str = "unloaded by its owner"
    clears: bool = False


class Reload(Command, frozen=True):
    """Unload a resource and load it again, while its holders keep it. `target`: its id, or that of a query on it."""

    target: str
    ticket: Any


class Revoke(Command, frozen=True):
    """Have all holders let a resource go, the highest first. `target`: its id, or that of a query on it.

    What still holds it after `grace_ms` loses it, as by ForceUnload.
    """

    target: str
    event: str
    why: str
    grace_ms: int
    ticket: Any


class GraceOver(Command, frozen=True):
    """The time is over in which a revoked resource's holders could release it."""

    resource_id: str
    event: str


# -- as a consumer ---------------------------------------------------------------------------------------------------


class AskProvider(Command, frozen=True, gc=False):
    """Load from a provider's server, for a resource of this registrar (`parent`, "" for none).

    `seq`: its running number in the order of loads. `own`: the caller gave a `priority`; else a part inherits it.
    """

    query_id: str
    registrar: str
    server: str
    request: bytes
    parent: str
    seq: int
    priority: int = 0
    own: bool = False


class Got(Command, frozen=True, gc=False):
    """A provider has answered a load in flight, on the connection of the caller's thread; `run` is its epoch."""

    query_id: str
    resource_id: str
    response: bytes
    state: State = State.OK
    run: int = 0


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


class SetPriority(Command, frozen=True):
    """Give a query of this registrar a priority of its own."""

    query_id: str
    priority: int
    ticket: Any


class AddInFlight(Command, frozen=True):
    """Add the row of every load in flight, because somebody is about to read all rows."""


class ReleaseOverdue(Command, frozen=True):
    """End a caller's wait for its unload; the release stays owed."""

    query_id: str
    failure: Failure


class Heard(Command, frozen=True, gc=False):
    """All listeners of a query have heard what Hear told them. `handled`: one of them has dealt with it.

    `revoked`: it says that the resource is revoked.
    """

    query_id: str
    event: str
    handled: bool = False
    revoked: bool = False


class Reconcile(Command, frozen=True):
    """A link to a provider is up, with the provider's list of our queries; those in `same` agree, and are not listed.

    `link` is the number of the Fetch that opened the link, `run` the provider's epoch, `notices` whether some follow.
    """

    registrar: str
    queries: list[FetchedQuery]
    event: str
    same: list[tuple[int, int]] = []
    link: int = 0
    run: int = 0
    notices: bool = False


class ConsumerLost(Command, frozen=True):
    """The link of a consumer is down. It may come back."""

    origin: str


class LinkLost(Command, frozen=True):
    """The link to a provider is down. The client will try to open another."""

    registrar: str


class LeaseOver(Command, frozen=True):
    """The lease of this host at a provider's host is over: that may have released what is held there.

    `run`: the epoch of the provider in the links of that lease; 0: there was none.
    """

    registrar: str
    run: int
    why: str
    event: str


class PeerGone(Command, frozen=True):
    """A provider cannot be reached. `final`: it is gone for good, and with it every query that we held there.

    `empty`: no catalog of it is left, or one without anything. Otherwise its catalog may still have these queries, and
    it may be started again under this name.
    """

    registrar: str
    failure: Failure
    final: bool
    event: str
    empty: bool = False
