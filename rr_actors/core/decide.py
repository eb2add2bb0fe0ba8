"""decide: one message or command, and what it changes and causes. The whole registrar on one page.

Pure: no I/O, clock, thread or randomness. `event` is a fresh id for a status that the decision may start itself.
"""

from __future__ import annotations

from rr_actors import messages as m
from rr_actors.core import commands as c
from rr_actors.core import holding, recovering, serving
from rr_actors.core.catalog import Batch


def decide(batch: Batch, message: m.Message, sender: str) -> None:
    """Handle a message of the registrar `sender`.

    Raises:
        TypeError: it is none that a registrar handles.
    """
    match message:
        case m.Load():
            serving.load(batch, message)
        case m.Loaded():
            holding.loaded(batch, sender, message)
        case m.Unload():
            serving.unload(batch, message)
        case m.Unloaded():
            holding.unloaded(batch, message)
        case m.LoadRefused():
            holding.load_refused(batch, message)
        case m.UnloadRefused():
            holding.unload_refused(batch, message)
        case m.Noticed():
            holding.noticed(batch, sender, message)
        case m.NoticesHandled():
            serving.notices_handled(batch, message)
        case m.Fetch():
            serving.fetch(batch, message)
        case m.Probe():
            serving.probe(batch, message)
        case m.Gone():
            serving.gone(batch, message)
        case _:
            raise TypeError(f"{batch.catalog.name}: not a message for a registrar: {message!r}")


def obey(batch: Batch, command: c.Command, event: str) -> None:
    """Handle a command of the registrar's own process.

    Raises:
        TypeError: it is none that a registrar handles.
    """
    match command:
        case c.Ask():
            holding.ask(batch, command)
        case c.GiveUp():
            holding.give_up(batch, command)
        case c.Release():
            holding.release(batch, command)
        case c.ReleaseOverdue():
            holding.release_overdue(batch, command)
        case c.LoadDone():
            serving.load_done(batch, command)
        case c.LoadErred():
            serving.load_erred(batch, command)
        case c.LoadOverdue():
            serving.load_overdue(batch, command)
        case c.UnloadDone():
            serving.unload_done(batch, command)
        case c.UnloadErred():
            serving.unload_erred(batch, command)
        case c.StatusDone():
            holding.status_done(batch, command)
        case c.RecoverDone():
            recovering.recover_done(batch, command)
        case c.RecoverErred():
            recovering.recover_erred(batch, command)
        case c.LingerOver():
            serving.linger_over(batch, command)
        case c.SetStatus():
            serving.set_status(batch, command)
        case c.SetResponse():
            serving.set_response(batch, command)
        case c.ForceUnload():
            serving.force_unload(batch, command)
        case c.Register():
            recovering.register(batch, command, event)
        case c.Unregister():
            serving.unregister(batch, command, event)
        case c.Reconcile():
            holding.reconcile(batch, command)
        case c.ConsumerLost():
            batch.forget(batch.catalog.consumers, command.origin)
        case c.LinkLost():
            holding.link_lost(batch, command)
        case c.PeerGone():
            holding.peer_gone(batch, command)
        case _:
            raise TypeError(f"{batch.catalog.name}: not a command for a registrar: {command!r}")
