"""decide: one message or command, and what it changes and causes. The whole registrar on one page.

Pure: no I/O, clock, thread or randomness.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from rr_actors.base.errors import shown
from rr_actors.registrar.core import (
    holding,
    loading,
    notices,
    reconciliation,
    recovery,
    releasing,
    status_changes,
    status_delivery,
    unloading,
)
from rr_actors.registrar.core.notices import refuse
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import messages as m
from rr_actors.registrar.model.catalog import Catalog, Decision
from rr_actors.registrar.model.effects import Answer, LoadResolved, Reply, UnloadResolved
from rr_actors.registrar.model.messages import Failure, Load
from rr_actors.registrar.model.rows import Change, Hold, Put

Item = tuple[Any, str | None]
"""A message and the registrar that sent it, or a command of this process and None."""


def decide(catalog: Catalog, items: Iterable[Item]) -> Decision:
    """Decide messages and commands in their order, as one: either all of it happens, or nothing.

    The catalog in memory is changed at once. Commit the decision, then close() it and do its effects; or undo() it.

    Raises:
        TypeError: one of them is none that a registrar handles.
    """
    decision = Decision(catalog)
    for item, sender in items:
        if sender is None:
            _obey(decision, item)
        else:
            _receive(decision, item, sender)
    return decision


def _receive(decision: Decision, message: m.Message, sender: str) -> None:
    match message:  # the most frequent first, as they are tried in their order
        case m.Load():
            loading.load(decision, message)
        case m.Unload():
            unloading.unload(decision, message)
        case m.Loaded():
            holding.loaded(decision, sender, message)
        case m.Unloaded():
            holding.unloaded(decision, sender, message)
        case m.LoadRefused():
            holding.load_refused(decision, message)
        case m.UnloadRefused():
            holding.unload_refused(decision, message)
        case m.Noticed():
            status_delivery.noticed(decision, sender, message)
        case m.NoticesHandled():
            notices.notices_handled(decision, message)
        case m.Fetch():
            reconciliation.fetch(decision, message)
        case m.Probe():
            loading.probe(decision, message)
        case m.Gone():
            unloading.gone(decision, message)
        case m.Describe():
            _describe(decision, message, sender)
        case _:
            raise TypeError(f"{decision.catalog.name}: not a message for a registrar: {shown(message)}")


def _obey(decision: Decision, command: c.Command) -> None:
    match command:  # the most frequent first
        case c.LoadDone():
            loading.load_done(decision, command)
        case c.Ask():
            holding.ask(decision, command)
        case c.Release():
            holding.release(decision, command)
        case c.UnloadDone():
            unloading.unload_done(decision, command)
        case c.Got():
            holding.got(decision, command)
        case c.BeginAgain():
            recovery.begin_again(decision)
        case c.SetRows():
            _set_rows(decision, command.changes)
        case c.RefuseLoad():
            decision.cause(refuse(decision, command.origin, command.query_id, command.failure))
        case c.SendAgain():
            holding.send_again(decision, command)
        case c.GiveUp():
            holding.give_up(decision, command)
        case c.AddInFlight():
            releasing.add_all_in_flight(decision)
        case c.ReleaseOverdue():
            holding.release_overdue(decision, command)
        case c.LoadErred():
            loading.load_erred(decision, command)
        case c.LoadOverdue():
            loading.load_overdue(decision, command)
        case c.UnloadErred():
            unloading.unload_erred(decision, command)
        case c.Heard():
            status_delivery.heard(decision, command)
        case c.StatusDone():
            status_delivery.status_done(decision, command)
        case c.RecoverDone():
            recovery.recover_done(decision, command)
        case c.RecoverErred():
            recovery.recover_erred(decision, command)
        case c.LingerOver():
            unloading.linger_over(decision, command)
        case c.SetStatus():
            status_changes.set_status(decision, command)
        case c.SetResponse():
            status_changes.set_response(decision, command)
        case c.Swap():
            status_changes.swap(decision, command)
        case c.ForceUnload():
            unloading.force_unload(decision, command)
        case c.Register():
            recovery.register(decision, command)
        case c.Unregister():
            unloading.unregister(decision, command)
        case c.Reconcile():
            reconciliation.reconcile(decision, command)
        case c.ConsumerLost():
            reconciliation.consumer_lost(decision, command)
        case c.LinkLost():
            reconciliation.link_lost(decision, command)
        case c.PeerGone():
            reconciliation.peer_gone(decision, command)
        case _:
            raise TypeError(f"{decision.catalog.name}: not a command for a registrar: {shown(command)}")


def _describe(decision: Decision, message: m.Describe, sender: str) -> None:
    """Answer with the types of a server; of one that is not there nothing is said."""
    server = decision.catalog.servers.get(message.server)
    if server is not None:
        decision.cause(Reply(sender, m.Described(message.server, server.types)))


def _set_rows(decision: Decision, changes: Sequence[Change]) -> None:
    for change in changes:
        if isinstance(change, Put):
            decision.put(change.row)
        elif (row := decision.catalog.tables[change.table].get(change.id)) is not None:
            decision.drop(row)


# Uncommitted: what becomes of messages and commands whose changes could not be written.
#
# Nothing of them has happened. Those who wait hear so; the rest is done again, in its order, and what comes later
# waits behind it, as the order of messages is relied upon.


def refuse_uncommitted(catalog: Catalog, items: Iterable[Item], failure: Failure) -> tuple[Decision, list[Item]]:
    """Refuse what can be refused, for `failure`; return that, and what is to be done again.

    Causes effects alone, no changes: it needs no room on the disk. The decision of the items has been undone.
    """
    decision = Decision(catalog)
    again: list[Item] = []
    for item, sender in items:
        match item:
            case Load() if item.query_id not in decision.catalog.queries:
                decision.cause(refuse(decision, item.origin, item.query_id, failure))
            case c.Ask():
                decision.cause(LoadResolved(holding.pending(item, 0, 0), failure))
            case c.Release():
                decision.cause(UnloadResolved(item.query_id, failure))
            case c.ReleaseOverdue():
                held = decision.catalog.held.get(item.query_id)
                if held is not None and held.hold is Hold.OWED:  # as it was before, and it is late already
                    decision.cause(UnloadResolved(item.query_id, item.failure))
            case c.SetStatus() | c.SetResponse() | c.Swap() | c.ForceUnload() | c.Unregister():
                decision.cause(Answer(item.ticket, failure))
            case _:
                again.append((item, sender))
    return decision, again
