"""Acting on effects in a simulated world: what registrar/engine/effect_runner.py does, with links and callbacks that
are made up.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from rr_actors.registrar.core.loads.loading import is_reloaded
from rr_actors.registrar.core.status_changes import is_busy
from rr_actors.registrar.core.status_delivery import is_listened
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model import effects as e
from rr_actors.registrar.model.messages import Loaded, Released
from rr_actors.registrar.model.rows import is_own, is_revocation
from simulation.oracle import Violation
from simulation.sim_links import TO_CONSUMER, TO_PROVIDER
from simulation.sim_process import SimShell


def _reply(shell: SimShell, effect: e.SendReply) -> None:
    """To a consumer, by the way its request came."""
    message: Any = effect.message
    if type(message) is Loaded and message.query_id not in shell.world.ledger.stored:
        raise Violation("acknowledged", f"{message.query_id}: answered as loaded, and it is not on disk")
    if type(message) is Released:
        shell.world.released(shell.name, message.number)
        return
    line, by_link = shell.routes.way_of(message)
    if line is not None:
        shell.answer(line, message)
    link = shell.links.get(effect.origin) if by_link else None
    if link is not None:
        shell.send(link, effect.origin, shell.name, TO_CONSUMER, message)


def _request(shell: SimShell, effect: e.SendRequest) -> None:
    """To a provider, if there is a link."""
    peering = shell.clients.get(effect.registrar)
    if peering is None:
        shell.want(effect.registrar)
    elif shell.catalog.up.get(effect.registrar) == peering.number:  # else it was decided for a link before this one
        shell.send(peering.link, shell.name, effect.registrar, TO_PROVIDER, effect.message)


def _unload_resolved(shell: SimShell, effect: e.UnloadResolved) -> None:
    if not shell.world.has_line(effect.query_id):  # else its thread waits for the line's own answer
        shell.world.unload_ended(shell, effect.query_id, effect.failure)


def _load_resolved(shell: SimShell, effect: e.LoadResolved) -> None:
    shell.catalog.wait_limits.pop(effect.held.id, None)
    if effect.failure is not None:
        shell.world.leave_line(effect.held.id)  # which is cut
    if not shell.world.has_line(effect.held.id):  # else its thread waits for the line's own answer
        shell.load_ended(effect.held.id, effect.failure)


def _start_callback(shell: SimShell, effect: e.StartCallback) -> None:
    resource = effect.resource
    match effect.role:
        case "status":
            _start_status(shell, effect)
        case "health" | "usage":
            shell.world.note(f"{shell.name}: runs the {effect.role} callback of {resource.id}")
        case "load" | "unload":
            if resource.server in shell.registered:
                number = resource.attempt if effect.role == "load" else resource.tries
                shell.start_run(effect.role, resource.id, number, resource)
        case "reload":
            shell.start_run("renew", resource.id, resource.attempt, resource)
        case role:
            shell.start_run("reload" if effect.reload else role, resource.id, resource.attempt, resource)


def _start_status(shell: SimShell, effect: e.StartCallback) -> None:
    resource, notice = effect.resource, effect.notice
    assert notice is not None
    now = shell.catalog.resources.get(resource.id)
    begun = now is not None and is_reloaded(shell.catalog, now.id) and now.id not in shell.reloading
    if now is not None and is_busy(shell.catalog, now) and not begun:  # else it was caused before its reload
        raise Violation("statuses", f"{resource.id} hears {notice} before its load has returned")
    if is_own(notice):
        if now is not None and notice.id not in shell.disk["notices"]:
            raise Violation("statuses", f"{resource.id} hears {notice}, which is not on disk")
        shell.world.ledger.hear_own(notice, shell.epoch, effect.repeated)
    server = shell.catalog.servers.get(resource.server)
    if server is None or not server.has_status:
        shell.post(c.CallbackEnded("status", resource.id, notice=notice, handled=False))
        return
    run = shell.start_run("status", resource.id, notice.event, resource)
    run.notice = notice


def _hear(shell: SimShell, effect: e.Hear) -> None:
    if shell.state != "up":
        raise Violation("statuses", f"{effect.held.id} heard {effect.notice} before on_start had returned")
    _check_window(shell, effect)
    excused = shell.world.may_be_lost(shell, effect.held)
    shell.world.ledger.hear(effect.held.id, effect.notice, shell.epoch, effect.repeated, excused)
    if is_revocation(effect.notice):  # the whole is revoked, or lets its part go
        shell.world.ledger.revoked.add(effect.held.id)
        shell.world.ledger.given_up_parts.add((effect.held.parent, effect.notice.resource_id))
    else:
        holders = set(shell.catalog.holders.get(effect.held.parent, ())) - shell.begun
        shell.world.ledger.must_go_on(shell.name, effect.held, effect.notice.event, holders)
    run = shell.start_run("hear", effect.held.id, effect.notice.event, None)
    run.notice = effect.notice
    if is_listened(shell.catalog, effect.held):
        run.listener = effect.held.parent


def _check_window(shell: SimShell, effect: e.Hear) -> None:
    """Of one query no more statuses wait at its holder than its provider may have on their way.

    They count for each resource: a provider that has lost a query, and gets its Load again, drops what it has sent of
    the resource before.
    """
    hearing = shell.catalog.hearing.items()  # its holder itself says that it is lost, if there is no provider
    deleted, about = shell.world.ledger.deleted, shell.world.ledger.about
    about[effect.notice.id] = effect.notice.resource_id
    alike = {
        id
        for id, it in hearing
        if it.provider and id.endswith(f":{effect.held.id}") and about.get(id) == about[effect.notice.id]
    }
    waiting = len(alike - deleted)
    window = shell.world.registrars[effect.held.registrar].catalog.window
    if waiting > window:
        raise Violation("bounds", f"{waiting} statuses of {effect.held.id} wait at {shell.name}: more than {window}")


def _fell_behind(shell: SimShell, effect: e.FellBehind) -> None:
    shell.world.note(f"{shell.name}: {effect.origin} is behind with the statuses of {effect.query_id}")


def _set_timer(shell: SimShell, effect: e.SetTimer) -> None:
    key = ("timer", shell.name, effect.key)
    if effect.delay_s is None:
        shell.timers.pop(effect.key, None)
        shell.world.todo.discard(key)
    else:
        shell.timers[effect.key] = effect.command
        shell.world.todo.add(key)


def _receive(shell: SimShell, effect: e.Receive) -> None:
    shell.receive(effect.message, effect.sender)


def _connect(shell: SimShell, effect: e.Connect) -> None:
    shell.want(effect.registrar)


def _answer(shell: SimShell, effect: e.AnswerCall) -> None:
    ledger = shell.world.ledger
    ledger.ticket(effect.ticket, given=False)
    ledger.wish_answered(effect.ticket, done=effect.failure is None)
    if effect.failure is None and effect.ticket in ledger.swaps:
        ledger.replaced.add(ledger.swaps[effect.ticket])


def _happened(shell: SimShell, effect: e.Happened) -> None:
    if effect.what == "reloading":
        shell.world.ledger.reload_began(shell.name, effect.resource.id)
        shell.reloading.add(effect.resource.id)
    shell.world.note(f"{shell.name}: {effect.what} {effect.resource.id} {effect.detail}")


def _died(shell: SimShell, effect: e.Died) -> None:
    for text in effect.given_up:
        if (found := re.search(r"the reload callback for resource ([^;]+);", text)) is not None:
            shell.world.ledger.given_up_reloads.add((shell.name, found[1]))
    shell.world.note(f"{shell.name}: its last process died in {'; '.join(effect.runs)}")


def _acquitted(shell: SimShell, _effect: e.Acquitted) -> None:
    shell.world.note(f"{shell.name}: its last process has not died in a callback")


def _ring_broken(shell: SimShell, effect: e.RingBroken) -> None:
    shell.world.note(f"{shell.name}: {effect.why}")


def _in_line(shell: SimShell, effect: e.InLine) -> None:
    shell.world.note(f"{shell.name}: {effect.resource_id} is {effect.text or 'in line no more'}")


ACT: dict[type, Callable[[SimShell, Any], None]] = {
    e.SendReply: _reply,
    e.SendRequest: _request,
    e.Connect: _connect,
    e.StartCallback: _start_callback,
    e.SetTimer: _set_timer,
    e.LoadResolved: _load_resolved,
    e.UnloadResolved: _unload_resolved,
    e.Receive: _receive,
    e.Hear: _hear,
    e.FellBehind: _fell_behind,
    e.AnswerCall: _answer,
    e.Happened: _happened,
    e.Died: _died,
    e.Acquitted: _acquitted,
    e.RingBroken: _ring_broken,
    e.InLine: _in_line,
}
