"""decide: one message or command, and what it changes and causes. The whole registrar on one page.

Pure: no I/O, clock, thread or randomness. `event` is a fresh id for a status that the decision may start itself.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rr_actors.base.errors import shown
from rr_actors.registrar.core import (
    holding,
    loading,
    notices,
    reconciliation,
    recovery,
    status_changes,
    status_delivery,
    unloading,
)
from rr_actors.registrar.core.notices import refuse
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import messages as m
from rr_actors.registrar.model.catalog import Batch
from rr_actors.registrar.model.effects import Answer, LoadResolved, UnloadResolved
from rr_actors.registrar.model.messages import Failure, Load
from rr_actors.registrar.model.rows import Hold


def decide(batch: Batch, message: m.Message, sender: str) -> None:
    """Handle a message of the registrar `sender`.

    Raises:
        TypeError: it is none that a registrar handles.
    """
    match message:
        case m.Load():
            loading.load(batch, message)
        case m.Loaded():
            holding.loaded(batch, sender, message)
        case m.Unload():
            unloading.unload(batch, message)
        case m.Unloaded():
            holding.unloaded(batch, sender, message)
        case m.LoadRefused():
            holding.load_refused(batch, message)
        case m.UnloadRefused():
            holding.unload_refused(batch, message)
        case m.Noticed():
            status_delivery.noticed(batch, sender, message)
        case m.NoticesHandled():
            notices.notices_handled(batch, message)
        case m.Fetch():
            reconciliation.fetch(batch, message)
        case m.Probe():
            loading.probe(batch, message)
        case m.Gone():
            unloading.gone(batch, message)
        case _:
            raise TypeError(f"{batch.catalog.name}: not a message for a registrar: {shown(message)}")


def obey(batch: Batch, command: c.Command, event: str) -> None:
    """Handle a command of the registrar's own process.

    Raises:
        TypeError: it is none that a registrar handles.
    """
    match command:
        case c.Ask():
            holding.ask(batch, command)
        case c.Got():
            holding.got(batch, command)
        case c.SendAgain():
            holding.send_again(batch, command)
        case c.GiveUp():
            holding.give_up(batch, command)
        case c.Release():
            holding.release(batch, command)
        case c.OwnUp():
            holding.own_up_to_all(batch)
        case c.ReleaseOverdue():
            holding.release_overdue(batch, command)
        case c.LoadDone():
            loading.load_done(batch, command)
        case c.LoadErred():
            loading.load_erred(batch, command)
        case c.LoadOverdue():
            loading.load_overdue(batch, command)
        case c.UnloadDone():
            unloading.unload_done(batch, command)
        case c.UnloadErred():
            unloading.unload_erred(batch, command)
        case c.Heard():
            status_delivery.heard(batch, command)
        case c.StatusDone():
            status_delivery.status_done(batch, command)
        case c.RecoverDone():
            recovery.recover_done(batch, command)
        case c.RecoverErred():
            recovery.recover_erred(batch, command)
        case c.LingerOver():
            unloading.linger_over(batch, command)
        case c.SetStatus():
            status_changes.set_status(batch, command)
        case c.SetResponse():
            status_changes.set_response(batch, command)
        case c.Swap():
            status_changes.swap(batch, command)
        case c.ForceUnload():
            unloading.force_unload(batch, command)
        case c.Register():
            recovery.register(batch, command, event)
        case c.Unregister():
            unloading.unregister(batch, command, event)
        case c.Reconcile():
            reconciliation.reconcile(batch, command)
        case c.ConsumerLost():
            reconciliation.consumer_lost(batch, command)
        case c.LinkLost():
            reconciliation.link_lost(batch, command)
        case c.PeerGone():
            reconciliation.peer_gone(batch, command)
        case _:
            raise TypeError(f"{batch.catalog.name}: not a command for a registrar: {shown(command)}")


# Uncommitted: what becomes of a wake-up's messages and commands when their changes could not be written.
#
# Nothing of them has happened. Who can be told so is told; the rest is done again, in its order, and what comes later
# waits behind it, as the order of messages is relied upon.


def refuse_uncommitted(
    batch: Batch, items: Iterable[tuple[Any, str | None]], failure: Failure
) -> list[tuple[Any, str | None]]:
    """Refuse what can be refused, for `failure`; return what is to be done again.

    Causes effects alone, no changes: it needs no room on the disk.

    Args:
        batch: a new one; that of the items has been undone.
        items: messages and who sent them, commands and None.
    """
    again: list[tuple[Any, str | None]] = []
    for item, sender in items:
        match item:
            case Load() if item.query_id not in batch.catalog.queries:
                batch.cause(refuse(batch, item.origin, item.query_id, failure))
            case c.Ask(direct=False):
                batch.cause(LoadResolved(holding.pending(item, 0, 0), failure))
            case c.Release():
                batch.cause(UnloadResolved(item.query_id, failure))
            case c.ReleaseOverdue():
                held = batch.catalog.held.get(item.query_id)
                if held is not None and held.hold is Hold.OWED:  # as it was before, and it is late already
                    batch.cause(UnloadResolved(item.query_id, item.failure))
            case c.SetStatus() | c.SetResponse() | c.Swap() | c.ForceUnload() | c.Unregister():
                batch.cause(Answer(item.ticket, failure))
            case _:
                again.append((item, sender))
    return again
