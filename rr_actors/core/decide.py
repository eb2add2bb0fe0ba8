"""decide: one message or command, and what it changes and causes. The whole registrar on one page.

Pure: no I/O, clock, thread or randomness. `event` is a fresh id for a status that the decision may start itself.
"""

from __future__ import annotations

from rr_actors import messages as m
from rr_actors.core import commands as c
from rr_actors.core import (
    evicting,
    fetching,
    hearing,
    holding,
    loading,
    notices,
    probing,
    reconciling,
    recovering,
    statuses,
    unloading,
)
from rr_actors.core.batch import Batch
from rr_actors.errors import shown


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
            hearing.noticed(batch, sender, message)
        case m.NoticesHandled():
            notices.notices_handled(batch, message)
        case m.Fetch():
            fetching.fetch(batch, message)
        case m.Probe():
            probing.probe(batch, message)
        case m.Gone():
            evicting.gone(batch, message)
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
            hearing.heard(batch, command)
        case c.StatusDone():
            hearing.status_done(batch, command)
        case c.RecoverDone():
            recovering.recover_done(batch, command)
        case c.RecoverErred():
            recovering.recover_erred(batch, command)
        case c.LingerOver():
            unloading.linger_over(batch, command)
        case c.SetStatus():
            statuses.set_status(batch, command)
        case c.SetResponse():
            statuses.set_response(batch, command)
        case c.ForceUnload():
            evicting.force_unload(batch, command)
        case c.Register():
            recovering.register(batch, command, event)
        case c.Unregister():
            evicting.unregister(batch, command, event)
        case c.Reconcile():
            reconciling.reconcile(batch, command)
        case c.ConsumerLost():
            fetching.consumer_lost(batch, command)
        case c.LinkLost():
            reconciling.link_lost(batch, command)
        case c.PeerGone():
            reconciling.peer_gone(batch, command)
        case _:
            raise TypeError(f"{batch.catalog.name}: not a command for a registrar: {shown(command)}")
