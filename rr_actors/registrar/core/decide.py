"""decide: what one message or command changes and causes. The whole registrar on one page.

Pure: no I/O, clock, thread or randomness.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from msgspec.structs import replace

from rr_actors.base.errors import shown
from rr_actors.base.values.failure import Failure
from rr_actors.registrar.core import (
    callback_runs,
    holding,
    notices,
    priorities,
    reconciliation,
    recovery,
    releasing,
    status_changes,
    status_delivery,
    unloading,
)
from rr_actors.registrar.core.loads import lines, load_rings, loading
from rr_actors.registrar.core.notices import refuse
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import messages as m
from rr_actors.registrar.model.catalog import Catalog, Decision
from rr_actors.registrar.model.effects import AnswerCall, LoadResolved, SendReply, UnloadResolved
from rr_actors.registrar.model.rows import Hold, Put

Item = tuple[Any, str | None]
"""A message and the registrar that sent it, or a command of this process and None."""


def decide(catalog: Catalog, items: Iterable[Item]) -> Decision:
    """Decide messages and commands in their order as one decision: either all of them happen, or none.

    The catalog in memory is changed at once. Then commit the decision, close() it and act, or undo() it.

    Raises:
        TypeError: an item is no message or command that a registrar handles.
    """
    decision = Decision(catalog)
    for item, sender in items:
        kind = item.__class__
        if catalog.early:
            recovery.begin_early(decision, item)
        if sender is None:
            if (obey := _COMMANDS.get(kind)) is None:
                raise TypeError(f"{catalog.name}: not a command for a registrar: {shown(item)}")
            obey(decision, item)
        elif (receive := _MESSAGES.get(kind)) is not None:
            receive(decision, item)
        elif (receive_from := _MESSAGES_OF_A_SENDER.get(kind)) is not None:
            receive_from(decision, sender, item)
        else:
            raise TypeError(f"{catalog.name}: not a message for a registrar: {shown(item)}")
    while catalog.touched or catalog.stirred:
        if catalog.stirred:
            lines.arrange(decision)
        for resource_id in list(catalog.touched):
            unloading.balance(decision, resource_id)
        priorities.settle(decision)
    if catalog.rising:
        priorities.rise(decision)
    return decision


def _describe(decision: Decision, sender: str, message: m.Describe) -> None:
    """Answer with the types of a server; if there is no such server, send nothing."""
    server = decision.catalog.servers.get(message.server)
    if server is not None:
        decision.cause(SendReply(sender, m.Described(message.server, server.types)))


def _unload_ended(decision: Decision, ended: c.CallbackEnded) -> None:
    unloading.unload_ended(decision, ended)
    if ended.failure is not None:
        # Those that waited for a load which was not run again. A resource that stays hears them all the same.
        status_delivery.start_deferred(decision, ended.resource_id)


def _set_rows(decision: Decision, command: c.SetRows) -> None:
    for change in command.changes:
        if isinstance(change, Put):
            decision.put(change.row)
        elif (row := decision.catalog.tables[change.table].get(change.id)) is not None:
            decision.drop(row)


_MESSAGES: dict[type[Any], Callable[[Decision, Any], None]] = {
    m.Load: loading.load,
    m.Unload: unloading.unload,
    m.LoadRefused: holding.load_refused,
    m.UnloadRefused: holding.unload_refused,
    m.NoticesHandled: notices.notices_handled,
    m.Fetch: reconciliation.fetch,
    m.Probe: load_rings.probe,
    m.WaitedFor: load_rings.awaited,
    m.Gone: unloading.gone,
    m.Reprioritise: priorities.reprioritise,
    m.Reprioritised: priorities.reprioritised,
}

_MESSAGES_OF_A_SENDER: dict[type[Any], Callable[[Decision, str, Any], None]] = {
    m.Loaded: holding.loaded,
    m.Unloaded: holding.unloaded,
    m.Noticed: status_delivery.noticed,
    m.Describe: _describe,
    m.Leased: reconciliation.leased,
}
"""The messages that do not name their sender, and whose function needs it."""

_ENDS: dict[str, Callable[[Decision, c.CallbackEnded], None]] = {
    "load": loading.load_ended,
    "unload": _unload_ended,
    "recover": recovery.recover_ended,
    "reload": recovery.reload_ended,
    "status": status_delivery.status_ended,
    "pause": loading.pause_ended,
    "resume": loading.resume_ended,
    "health": recovery.run_ended,
    "usage": recovery.run_ended,
}
"""By role (model/roles.py): what follows from the end of its callback."""

_LIMITS: dict[str, Callable[[Decision, c.CallbackOverdue], None]] = {
    "load": loading.load_overdue,
    "recover": recovery.recover_overdue,
}

_COMMANDS: dict[type[c.Command], Callable[[Decision, Any], None]] = {
    c.BeginAgain: lambda decision, _: recovery.begin_again(decision),
    c.BeginServing: recovery.begin_serving,
    c.BeginClosing: reconciliation.begin_closing,
    c.EndClosing: reconciliation.end_closing,
    c.EndProcess: lambda decision, _: recovery.end_process(decision),
    c.SetRows: _set_rows,
    c.RefuseLoad: lambda decision, it: decision.cause(refuse(decision, it.origin, it.query_id, it.failure)),
    c.Register: recovery.register,
    c.Unregister: unloading.unregister,
    c.CallbackEnded: lambda decision, it: _ENDS[it.role](decision, it),
    c.CallbackOverdue: lambda decision, it: _LIMITS[it.role](decision, it),
    c.BeginRun: recovery.begin_run,
    c.BeginTrial: recovery.begin_trial,
    c.TrialOver: recovery.trial_over,
    c.RefusalOver: callback_runs.refusal_over,
    c.WaitOver: lines.wait_over,
    c.LingerOver: unloading.linger_over,
    c.SetStatus: status_changes.set_status,
    c.SetResponse: status_changes.set_response,
    c.Swap: status_changes.swap,
    c.ForceUnload: unloading.force_unload,
    c.Reload: loading.reload,
    c.Revoke: status_changes.revoke,
    c.GraceOver: unloading.grace_over,
    c.AskProvider: holding.ask,
    c.Got: holding.got,
    c.SendAgain: holding.send_again,
    c.GiveUp: holding.give_up,
    c.Release: holding.release,
    c.SetPriority: priorities.set_priority,
    c.AddInFlight: lambda decision, _: releasing.add_all_in_flight(decision),
    c.ReleaseOverdue: holding.release_overdue,
    c.Heard: status_delivery.heard,
    c.Reconcile: reconciliation.reconcile,
    c.ConsumerLost: reconciliation.consumer_lost,
    c.LinkLost: reconciliation.link_lost,
    c.PeerGone: reconciliation.peer_gone,
    c.LeaseOver: reconciliation.lease_over,
}


def refuse_uncommitted(catalog: Catalog, items: Iterable[Item], failure: Failure) -> tuple[Decision, list[Item]]:
    """Refuse items whose changes could not be written; return that decision, and the items to be decided again.

    The caller has undone their decision: nothing of them has happened. Callers that wait get `failure`. Later messages
    have to wait behind the items to be decided again, because decisions rely on the order of messages. The decision
    returned has effects only and no changes, so it needs no room on the disk.
    """
    decision = Decision(catalog)
    again: list[Item] = []
    for item, sender in items:
        match item:
            case m.Load() if item.query_id not in decision.catalog.queries:
                decision.cause(refuse(decision, item.origin, item.query_id, failure))
            case c.AskProvider():
                decision.cause(LoadResolved(holding.pending(item), failure))
            case c.GiveUp() if (ended := holding.given_up(catalog, item)) is not None:
                decision.cause(ended)  # its caller's time is over; the load is withdrawn when there is room
                again.append((replace(item, unheard=True), sender))
            case c.Release():
                decision.cause(UnloadResolved(item.query_id, failure))
            case c.ReleaseOverdue():
                held = decision.catalog.held.get(item.query_id)
                if held is not None and held.hold is Hold.OWED:  # its row stays; its caller has waited
                    decision.cause(UnloadResolved(item.query_id, item.failure))
            case (
                c.SetStatus()
                | c.SetResponse()
                | c.Swap()
                | c.ForceUnload()
                | c.Reload()
                | c.Revoke()
                | c.Unregister()
                | c.SetPriority()
            ):
                decision.cause(AnswerCall(item.ticket, failure))
            case _:
                again.append((item, sender))
    return decision, again
