"""The decisions at the end of a lease between two hosts (docs/decisions/0110-leases-between-hosts.md).

Both sides decide for themselves. The provider's host releases what registrars of the other host hold. The registrars
of the consumer's host have taken it as lost before that. All other rules see a lost link.
"""

from __future__ import annotations

from collections.abc import Collection

from rr_actors.registrar.core.holding import lose
from rr_actors.registrar.core.releasing import add_all_in_flight
from rr_actors.registrar.core.unloading import gone
from rr_actors.registrar.model.catalog import Decision
from rr_actors.registrar.model.commands import LeaseOver
from rr_actors.registrar.model.effects import Connect, SendReply
from rr_actors.registrar.model.messages import Gone, Leased, Released
from rr_actors.registrar.model.rows import Hold


def is_fenced(origin: str, leased: Collection[str]) -> bool:
    """Return whether a consumer is of another host, which has no lease."""
    host, slash, _ = origin.partition("/")
    return bool(slash) and host not in leased


def leased(decision: Decision, sender: str, message: Leased) -> None:
    """Release what registrars of hosts without a lease hold, and say that this is on disk."""
    catalog = decision.catalog
    parked = [one.origin for waiting in catalog.recovering.values() for one in waiting]
    for origin in dict.fromkeys([*catalog.by_origin, *catalog.notices_to, *parked]):
        if is_fenced(origin, message.hosts):
            gone(decision, Gone(origin))
    decision.cause(SendReply(sender, Released(message.number)))


def lease_over(decision: Decision, command: LeaseOver) -> None:
    """Lose all that is held at a provider of another host. It may still have that: the releases are owed.

    Loads that wait go on waiting: the next link asks for them again. An answer of the lease that is over may still be
    on its way to a thread; got() passes it over.
    """
    catalog, provider = decision.catalog, command.registrar
    add_all_in_flight(decision, provider)
    decision.note(catalog.lapsed, provider, command.run)
    for id in list(catalog.outbound.get(provider, ())):
        held = catalog.held[id]
        decision.forget(catalog.fresh, id)
        if held.hold is Hold.HELD and id not in catalog.ending:
            decision.note(catalog.doubted, id, True)
            lose(decision, held, command.event, command.why)
    decision.cause(Connect(provider))
