"""Our own protocol, broken on purpose in one place each. The simulation must notice every one of them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Container, Iterable
from operator import attrgetter
from typing import Any

import msgspec

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
from rr_actors.registrar.core import decide as deciding
from rr_actors.registrar.core.decide import decide
from rr_actors.registrar.core.loads import load_rings, loading
from rr_actors.registrar.links.consumer_links import Routes
from rr_actors.registrar.model import digests
from rr_actors.registrar.model.catalog import Catalog, Decision, Unsaved
from rr_actors.registrar.model.commands import (
    Command,
    EndClosing,
    Got,
    PeerGone,
    Reconcile,
    Release,
    ReleaseOverdue,
    Revoke,
    SetPriority,
)
from rr_actors.registrar.model.effects import SendRequest, UnloadResolved
from rr_actors.registrar.model.messages import FetchedQuery, Load, Loaded, Unload
from rr_actors.registrar.model.rows import Change, Held, Hold, Notice, Phase, Put, Resource, is_own
from simulation import sim_process, sim_registrar
from simulation.sim_links import TO_PROVIDER, SimLine, SimLink
from simulation.sim_process import SimShell
from simulation.sim_registrar import SimRegistrar

Patch = Callable[[object, str, Any], None]
"""As pytest's monkeypatch.setattr."""

_replace = msgspec.structs.replace


class AnswersFirst(SimRegistrar):
    """Replies leave before the commit."""

    def finish(self, decision: Decision, fault: str) -> None:
        effects, decision.effects = decision.effects, []
        later = Decision(self.catalog)
        later.effects = effects
        super().finish(later, "")
        super().finish(decision, fault)


class ForgetsWhatItOwes(SimRegistrar):
    """A release that was not delivered before a crash is forgotten."""

    def start(self) -> None:
        held = self.disk["held"]
        for id in [id for id, row in held.items() if row.hold is Hold.OWED]:  # type: ignore[union-attr]
            del held[id]
        super().start()


class ForgetsNotices(SimRegistrar):
    """Statuses that were not delivered before a crash are forgotten."""

    def start(self) -> None:
        self.disk["notices"].clear()
        super().start()


class NeverRepeated(SimRegistrar):
    """What may have been told before a crash is told as though for the first time."""

    def start(self) -> None:
        super().start()
        self.catalog.told.clear()


class SameAttempt(SimRegistrar):
    """A load that a crash interrupted is not told from the one that is run again."""

    def start(self) -> None:
        super().start()
        for resource in list(self.catalog.resources.values()):
            if resource.phase is Phase.LOADING and resource.attempt > 1:
                self.catalog.set("resources", resource.id, _replace(resource, attempt=resource.attempt - 1))
                self.disk["resources"][resource.id] = self.catalog.resources[resource.id]


class ListensToWhatIsOver(SimRegistrar):
    """What an old link of a consumer still brings is taken up when it has a new one."""

    def from_consumer(self, origin: str, link: SimLink, message: Any) -> None:
        self.receive(message, origin)


class ListensToLinesOfTheDead(SimRegistrar):
    """A direct line is listened to whichever incarnation of its consumer opened it."""

    def from_line(self, line: SimLine, message: Any, at_once: str | None = None, overtaking: str | None = None) -> None:
        if isinstance(message, Load):
            self.routes.asked_by_line(line, message)
        self.receive(message, line.consumer)


class NeverComesBackToAcknowledge(SimRegistrar):
    """A link that is lost is not made again for the sake of acknowledgements."""

    def unlinked(self, provider: str) -> None:
        self.catalog.acked.clear()
        super().unlinked(provider)


class OwesWithoutWriting(SimRegistrar):
    """A thread that releases what is on disk does not write that it is owed."""

    def owe(self, query_id: str, fault: str) -> bool:
        if fault or self.inbox:
            return False
        return holding.owe(self.catalog, self.unsaved, query_id, lambda row: True)


class WritesOlderRowsOver(SimRegistrar):
    """A row that was waiting to be written is written over one that a thread has written at once."""

    def owe(self, query_id: str, fault: str) -> bool:
        waiting = self.unsaved.changes()
        done = super().owe(query_id, fault)
        self.unsaved.add(waiting)
        return done


class JoinsWithoutWriting(SimRegistrar):
    """A thread that joins what is held in its own process does not write that it holds it, too."""

    def join(self, load: Load, fault: str) -> Loaded | None:
        query = loading.join(self.catalog, load)
        if fault or query is None or self.inbox or load.origin not in self.links:
            return None
        self.catalog.set("queries", query.id, query)
        return Loaded(query.id, query.resource_id, self.catalog.resources[query.resource_id].response or b"")


class JoinsAtOnceWithoutWriting(SimRegistrar):
    """What a direct line joins at once is in memory, and not on disk."""

    def join_at_once(self, load: Load, fault: str) -> Loaded | None:
        query = loading.join(self.catalog, load)
        if fault or query is None or self.inbox:
            return None
        self.catalog.set("queries", query.id, query)
        return Loaded(query.id, query.resource_id, self.catalog.resources[query.resource_id].response or b"")


class TellsWithoutWriting(SimRegistrar):
    """The thread that ran a callback answers, and writes nothing."""

    def tell(self, done: Command, fault: str) -> bool:
        if fault or self.inbox or self.disk_is_full:
            return False
        decision = decide(self.catalog, [(done, None)])
        decision.close()
        self.act_by_thread(decision)
        return True


class AnswersAndNothingElse(SimRegistrar):
    """The thread that ran a callback answers one who waits, and forgets what else is to be done."""

    def act_by_thread(self, decision: Decision) -> None:
        super().act_by_thread(decision)
        self.effects.clear()


class TellsWhoHasGivenUp(SimRegistrar):
    """Who has given a load up, and has left its direct line, is told all the same that it is held."""

    def load_ended(self, query_id: str, failure: Failure | None) -> None:
        self.given_up.clear()
        super().load_ended(query_id, failure)


def _in_place(cls: type[SimRegistrar]) -> Callable[[Patch], type[SimRegistrar]]:
    return lambda patch: cls


def in_tables(patch: Patch, function: Any, by: Any) -> None:
    """Have decide() call another function where its tables have this one."""
    found = 0
    for name in ("_MESSAGES", "_MESSAGES_OF_A_SENDER", "_COMMANDS"):
        table = getattr(deciding, name)
        found += function in table.values()
        patch(deciding, name, {kind: by if known is function else known for kind, known in table.items()})
    assert found, f"{function} is in no table"


def no_undo(patch: Patch) -> type[SimRegistrar]:
    """What could not be committed stays in memory."""

    def keep(decision: Decision) -> None:
        decision.close()
        decision.changes.clear()
        decision.later.clear()
        decision.effects.clear()

    patch(Decision, "undo", keep)
    return SimRegistrar


def answers_on_one_way(patch: Patch) -> type[SimRegistrar]:
    """A Load that has come by a direct line and by the link is answered by the line alone, which may be dead."""

    class OnOneWay(Routes):
        def asked_by_link(self, consumer: str, question: Load | Unload) -> None:
            if self.line_of(question) is None:
                super().asked_by_link(consumer, question)

    patch(sim_process, "Routes", OnOneWay)
    return SimRegistrar


def answers_lines_alone(patch: Patch) -> type[SimRegistrar]:
    """What has come by the link is answered by the line that it comes by as well, and by that alone."""

    class LinesAlone(Routes):
        def asked_by_line(self, line: Any, question: Load | Unload, released: Container[str] = ()) -> None:
            self.way_of(question)  # which forgets the link's question
            super().asked_by_line(line, question)

    patch(sim_process, "Routes", LinesAlone)
    return SimRegistrar


def forgets_withdrawals(patch: Patch) -> type[SimRegistrar]:
    """A load that nobody waits for any longer is forgotten, whatever becomes of it."""

    def withdraw(decision: Decision, held: Any, failure: Any) -> None:
        releasing.withdraw(decision, held, failure)
        decision.drop(decision.catalog.held[held.id])
        decision.effects.pop()

    patch(holding, "withdraw", withdraw)
    patch(load_rings, "withdraw", withdraw)
    return SimRegistrar


def no_dedupe(patch: Patch) -> type[SimRegistrar]:
    """A Load that is sent again is another load."""

    def again(decision: Decision, message: Load, query: Any) -> None:
        decision.drop(query)
        loading.load(decision, message)

    patch(loading, "_load_again", again)
    return SimRegistrar


def no_stamp(patch: Patch) -> type[SimRegistrar]:
    """What an interrupted run had loaded is taken for the next one's."""

    def stampless(decision: Decision, query: FetchedQuery) -> FetchedQuery:
        parent = decision.catalog.resources.get(query.parent)
        return query if parent is None else _replace(query, attempt=parent.attempt)

    in_tables(patch, reconciliation.reconcile, _taking_back(stampless))
    return SimRegistrar


def _taking_back(read: Callable[[Decision, FetchedQuery], FetchedQuery]) -> Callable[[Decision, Reconcile], None]:
    """Return reconcile() that reads so what a provider has and its consumer does not know."""
    plain = reconciliation.reconcile

    def reconcile(decision: Decision, command: Reconcile) -> None:
        known = decision.catalog.held
        queries = [query if query.query_id in known else read(decision, query) for query in command.queries]
        plain(decision, _replace(command, queries=queries))

    return reconcile


def first_to_leave(patch: Patch) -> type[SimRegistrar]:
    """The resource is unloaded when the first of its holders lets go."""

    def release(decision: Decision, query: Any) -> None:
        resource = decision.catalog.resources[query.resource_id]
        if resource.phase is Phase.LOADED:
            unloading.begin_unload(decision, resource)

    patch(unloading, "_release", release)
    return SimRegistrar


def takes_silently(patch: Patch) -> type[SimRegistrar]:
    """A holder is not told that its resource was taken away."""
    patch(unloading, "notify", lambda *args, **kwargs: None)
    return SimRegistrar


def loses_silently(patch: Patch) -> type[SimRegistrar]:
    """A holder is not told that what it holds went with its provider."""
    patch(reconciliation, "lose", lambda *args: None)
    return SimRegistrar


def acknowledges_at_once(patch: Patch) -> type[SimRegistrar]:
    """A notice is acknowledged before anybody has dealt with it."""
    noticed: Any = status_delivery.noticed

    def hasty(decision: Decision, provider: str, message: Any) -> None:
        noticed(decision, provider, message)
        if message.notice.id in decision.catalog.hearing:
            notices.acknowledge(decision, provider, message.notice.id)

    in_tables(patch, noticed, hasty)
    return SimRegistrar


def hears_twice(patch: Patch) -> type[SimRegistrar]:
    """A notice that is sent again is heard again."""
    noticed: Any = status_delivery.noticed

    def forgetful(decision: Decision, provider: str, message: Any) -> None:
        decision.catalog.hearing.pop(message.notice.id, None)
        for place in [place for place in decision.catalog.heard if place[2] == message.notice.event]:
            del decision.catalog.heard[place]
        noticed(decision, provider, message)

    in_tables(patch, noticed, forgetful)
    return SimRegistrar


def keeps_to_itself(patch: Patch) -> type[SimRegistrar]:
    """What depends on a resource does not pass its statuses on."""
    patch(status_delivery, "spread", lambda *args, **kwargs: None)
    return SimRegistrar


def no_queue(patch: Patch) -> type[SimRegistrar]:
    """A load begins while what it replaces is still being unloaded."""
    plain = loading.load

    def impatient(decision: Decision, message: Load) -> None:
        unloading_now = dict(decision.catalog.unloading)
        decision.catalog.unloading.clear()
        plain(decision, message)
        decision.catalog.unloading.update(unloading_now)

    in_tables(patch, plain, impatient)
    patch(recovery, "load", impatient)
    return SimRegistrar


def releases_later(patch: Patch) -> type[SimRegistrar]:
    """A release reaches the provider before it is on disk."""

    def release(decision: Decision, command: Release) -> None:
        held = decision.catalog.held.get(command.query_id)
        if held is None or held.hold is not Hold.HELD:
            original(decision, command)
            return
        decision.put_later(_replace(held, hold=Hold.OWED))
        decision.request(held.registrar, Unload(held.id, decision.catalog.name))

    original: Any = holding.release
    in_tables(patch, original, release)
    return SimRegistrar


def no_probes(patch: Patch) -> type[SimRegistrar]:
    """Rings are not looked for."""
    patch(loading, "look_for_ring", lambda *args: None)
    return SimRegistrar


def keeps_parts(patch: Patch) -> type[SimRegistrar]:
    """What a failed load had loaded elsewhere is not released."""

    def keep(decision: Decision, resource_id: str, after: Any, keep_attempt: int | None = None) -> None:
        for effect in after:
            decision.cause(effect)

    patch(loading, "release_parts", keep)
    return SimRegistrar


def takes_everything_back(patch: Patch) -> type[SimRegistrar]:
    """A query that was let go while its provider did not listen is taken for one lost in a crash."""

    def since_ever(_decision: Decision, query: FetchedQuery) -> FetchedQuery:
        return _replace(query, seq=0, response=query.response or b"")

    in_tables(patch, reconciliation.reconcile, _taking_back(since_ever))
    return SimRegistrar


def starts_over(patch: Patch) -> type[SimRegistrar]:
    """After a crash nobody looks for what an interrupted load had loaded."""
    patch(recovery.holding, "begin_again", lambda decision: None)
    return SimRegistrar


def waits_for_a_broken_line(patch: Patch) -> type[SimRegistrar]:
    """A load whose direct line broke is not asked for again."""
    in_tables(patch, holding.send_again, lambda decision, command: None)
    return SimRegistrar


def owes_what_it_had(patch: Patch) -> type[SimRegistrar]:
    """Also what was held before a crash is let go by line."""

    def owe(catalog: Catalog, unsaved: Unsaved, query_id: str, write: Callable[[Held], bool]) -> bool:
        since, catalog.since = catalog.since, 0
        try:
            return original(catalog, unsaved, query_id, write)
        finally:
            catalog.since = since

    original = holding.owe
    patch(holding, "owe", owe)
    return SimRegistrar


def forgets_what_is_in_flight(patch: Patch) -> type[SimRegistrar]:
    """A load in flight is unknown when something is decided about it."""
    patch(status_delivery, "add_in_flight", lambda decision, query_id: None)
    patch(reconciliation, "add_all_in_flight", lambda decision, provider: None)
    return SimRegistrar


def overlooks_parts_in_flight(patch: Patch) -> type[SimRegistrar]:
    """What a callback's thread has just asked for is not known of when the resource ends, or a ring is looked for."""
    for module in (releasing, load_rings):
        patch(module, "parts_of", lambda decision, resource_id: decision.catalog.parts_of(resource_id))
    return SimRegistrar


def takes_unsaved_for_new(patch: Patch) -> type[SimRegistrar]:
    """Of a query whose row waits to be written it is taken that nothing is on disk: it may wait to be updated."""

    def add(unsaved: Unsaved, changes: Iterable[Change]) -> None:
        changes = list(changes)
        original(unsaved, changes)
        for change in changes:
            if type(change) is Put and type(change.row) is Held:
                unsaved.some.pop(("held", change.row.id), None)
                unsaved.new[change.row.id] = change.row

    original = Unsaved.add
    patch(Unsaved, "add", add)
    return SimRegistrar


def writes_what_is_let_go(patch: Patch) -> type[SimRegistrar]:
    """That a query is held is written although it has been let go since."""

    def owe(catalog: Catalog, unsaved: Unsaved, query_id: str, write: Callable[[Held], bool]) -> bool:
        waiting = unsaved.new.get(query_id)
        done = original(catalog, unsaved, query_id, write)
        if waiting is not None:
            unsaved.new[query_id] = waiting
        return done

    original = holding.owe
    patch(holding, "owe", owe)
    return SimRegistrar


def forgets_what_came_meanwhile(patch: Patch) -> type[SimRegistrar]:
    """A list of the provider's is taken for newer than what a line has answered while the link was down."""

    def hold(catalog: Catalog, unsaved: Unsaved, command: Got) -> bool:
        asked = catalog.in_flight.get(command.query_id)
        up, catalog.up = catalog.up, {**catalog.up, asked.registrar: 1} if asked else catalog.up
        try:
            return original(catalog, unsaved, command)
        finally:
            catalog.up = up

    original = holding.hold
    patch(holding, "hold", hold)
    return SimRegistrar


def compares_ids_alone(patch: Patch) -> type[SimRegistrar]:
    """Lists are taken for equal that have the same queries, whatever has become of them."""

    def ids_of(catalog: Catalog, queries: Any, *_: Any) -> list[list[str]]:
        return [[query.id for query in queries if query.resource_id not in catalog.moving]]

    patch(digests, "_FACTS", (attrgetter("id"),))
    patch(digests, "_facts", ids_of)
    return SimRegistrar


def sends_over_the_next_link(patch: Patch) -> type[SimRegistrar]:
    """What was decided for a link goes over the one after it."""

    def request(shell: SimShell, effect: SendRequest) -> None:
        peering = shell.clients.get(effect.registrar)
        if peering is None:
            shell.want(effect.registrar)
        else:
            shell.send(peering.link, shell.name, effect.registrar, TO_PROVIDER, effect.message)

    patch(sim_registrar, "ACT", {**sim_registrar.ACT, SendRequest: request})
    return SimRegistrar


def sends_to_the_same_run(patch: Patch) -> type[SimRegistrar]:
    """What was decided for a link goes over any that leads to the same run of the provider."""

    def request(shell: SimShell, effect: SendRequest) -> None:
        peering, up = shell.clients.get(effect.registrar), shell.catalog.up.get(effect.registrar, 0)
        if peering is None:
            shell.want(effect.registrar)
        elif shell.epochs.get(up) == shell.epochs[peering.number]:
            shell.send(peering.link, shell.name, effect.registrar, TO_PROVIDER, effect.message)

    patch(sim_registrar, "ACT", {**sim_registrar.ACT, SendRequest: request})
    return SimRegistrar


def keeps_what_is_owed(patch: Patch) -> type[SimRegistrar]:
    """Of a release that is owed and overdue it is said that it was not done, if a commit fails."""

    def refuse(catalog: Catalog, items: list[Any], failure: Failure) -> tuple[Decision, list[Any]]:
        overdue = [item for item, _ in items if isinstance(item, ReleaseOverdue)]
        decision, again = original(catalog, [(item, sender) for item, sender in items if item not in overdue], failure)
        for item in overdue:
            decision.cause(UnloadResolved(item.query_id, failure))
        return decision, again

    original: Any = sim_registrar.refuse_uncommitted
    patch(sim_registrar, "refuse_uncommitted", refuse)
    return SimRegistrar


def tells_holders_first(patch: Patch) -> type[SimRegistrar]:
    """What the owner says goes to the holders at once, and to its own server as well."""
    start_status: Any = status_changes.start_status

    def hasty(decision: Decision, start: Any) -> None:
        if is_own(start.notice):
            for query in decision.catalog.queries_of(start.resource.id):
                notices.notify(decision, query, start.notice)
        start_status(decision, start)

    patch(status_changes, "start_status", hasty)
    return SimRegistrar


def forgets_its_own_server(patch: Patch) -> type[SimRegistrar]:
    """What its own server had not dealt with before a crash goes to nobody."""

    def forget(decision: Decision, server: str) -> None:
        for notice in [n for n in decision.catalog.notices.values() if is_own(n)]:
            if decision.catalog.resources[notice.resource_id].server == server:
                status_changes.drop_notice(decision, notice)

    patch(recovery, "start_own", forget)
    return SimRegistrar


def comes_back(patch: Patch) -> type[SimRegistrar]:
    """What a status callback says of its own resource comes back to it."""

    def of_nobody(plain: Callable[[Decision, Any], None]) -> Callable[[Decision, Any], None]:
        return lambda decision, command: plain(decision, _replace(command, callback_of=""))

    for plain in (status_changes.set_status, status_changes.set_response):
        in_tables(patch, plain, of_nobody(plain))
    return SimRegistrar


def does_not_wait_for_the_load(patch: Patch) -> type[SimRegistrar]:
    """A resource hears what is said while it is loading."""
    patch(status_changes, "is_busy", lambda catalog, resource: False)
    return SimRegistrar


def loses_what_waited(patch: Patch) -> type[SimRegistrar]:
    """What was said while a resource was loading is forgotten when it is loaded."""
    patch(
        loading, "start_deferred", lambda decision, resource_id: decision.forget(decision.catalog.deferred, resource_id)
    )
    return SimRegistrar


def loads_what_was_withdrawn(patch: Patch) -> type[SimRegistrar]:
    """A load that a crash has interrupted is run again, whoever wants it."""

    def again(decision: Decision, resource: Resource) -> None:
        resource = _replace(resource, tries=0)
        decision.put(resource)
        callback_runs.start_load(decision, resource)

    patch(recovery, "_interrupted", again)
    return SimRegistrar


def forgets_what_was_withdrawn(patch: Patch) -> type[SimRegistrar]:
    """What an interrupted load has left that nobody holds is not cleaned up."""
    patch(recovery, "unheld", lambda decision, resource: None)
    return SimRegistrar


def sends_no_more(patch: Patch) -> type[SimRegistrar]:
    """Statuses that wait until older ones are handled are not sent then."""
    patch(notices, "_send_more", lambda decision, query_id: None)
    return SimRegistrar


def sends_all_over_a_new_link(patch: Patch) -> type[SimRegistrar]:
    """A new link brings all statuses at once."""
    plain = notices.send_notices_to

    def send_all(decision: Decision, origin: str) -> None:
        window, decision.catalog.window = decision.catalog.window, sys.maxsize
        plain(decision, origin)
        decision.catalog.window = window

    patch(reconciliation, "send_notices_to", send_all)
    return SimRegistrar


def keeps_what_was_replaced(patch: Patch) -> type[SimRegistrar]:
    """A part that was replaced is not released."""
    patch(status_changes, "_release", lambda decision, resource_id, ids: None)
    return SimRegistrar


def forgets_who_was_away(patch: Patch) -> type[SimRegistrar]:
    """At its closing a registrar forgets also the providers that it has not reached since it was opened."""

    def end_closing(decision: Decision, command: EndClosing) -> None:
        original(decision, command)
        for peer in list(decision.catalog.peers.values()):
            if peer.id not in decision.catalog.outbound:
                decision.drop(peer)

    original = reconciliation.end_closing
    in_tables(patch, original, end_closing)
    return SimRegistrar


def holds_again_after_closing(patch: Patch) -> type[SimRegistrar]:
    """What a provider has from before a closing is held again."""
    patch(Catalog, "last_number", lambda self: 0)
    return SimRegistrar


def forgets_what_is_gone(patch: Patch) -> type[SimRegistrar]:
    """What a provider had that is gone for good is not owed to it, though it may come back."""

    def peer_gone(decision: Decision, command: PeerGone) -> None:
        original(decision, _replace(command, empty=command.final))

    original = reconciliation.peer_gone
    in_tables(patch, original, peer_gone)
    return SimRegistrar


def keeps_priorities(patch: Patch) -> type[SimRegistrar]:
    """The parts of a resource keep their priority when the holder leaves for whose sake they had it."""
    patch(notices, "touch", lambda decision, resource_id: None)
    return SimRegistrar


def writes_priorities_later(patch: Patch) -> type[SimRegistrar]:
    """A priority is written a moment after it is acknowledged."""

    def set_priority(decision: Decision, command: SetPriority) -> None:
        count = len(decision.changes)
        original(decision, command)
        for change in decision.changes[count:]:
            assert isinstance(change, Put)
            decision.later["held", change.row.id] = change
        del decision.changes[count:]

    original = priorities.set_priority
    in_tables(patch, original, set_priority)
    return SimRegistrar


def tells_priorities_once(patch: Patch) -> type[SimRegistrar]:
    """A priority that was lost with its link is not sent again."""
    patch(reconciliation, "tell", lambda decision, held: None)
    return SimRegistrar


def forgets_priorities_between_links(patch: Patch) -> type[SimRegistrar]:
    """A priority that changes between the question what a provider has and its answer is not sent."""

    def forget(decision: Decision, provider: str) -> None:
        for id in list(decision.catalog.unsent):
            decision.forget(decision.catalog.unsent, id)

    patch(reconciliation, "tell_unsent", forget)
    return SimRegistrar


def compares_no_priorities(patch: Patch) -> type[SimRegistrar]:
    """The digests of two lists say nothing of priorities."""
    patch(digests, "_priority", lambda row: 0)
    patch(digests, "_FACTS", (*map(attrgetter, ("id", "resource_id", "response", "state")), lambda row: 0))
    return SimRegistrar


def believes_what_was_overtaken(patch: Patch) -> type[SimRegistrar]:
    """A priority that comes a second time, after a newer one, is left as it is."""
    in_tables(patch, priorities.reprioritised, lambda decision, message: None)
    return SimRegistrar


def overlooks_loads_in_flight(patch: Patch) -> type[SimRegistrar]:
    """A part keeps the priority that its whole had when it was asked for."""
    patch(holding, "follow", lambda decision, held: None)
    return SimRegistrar


def lets_revoked_parts_go(patch: Patch) -> type[SimRegistrar]:
    """A whole that does not deal with the revocation of a part lets the part go, and stays loaded."""
    plain = status_delivery.pass_revocation_on

    def pass_on(decision: Decision, resource: Resource, notice: Notice, *, handled: bool) -> None:
        plain(decision, resource, notice, handled=True)

    patch(status_delivery, "pass_revocation_on", pass_on)
    return SimRegistrar


def overlooks_revocations(patch: Patch) -> type[SimRegistrar]:
    """The revocation of a part is acknowledged, and its whole stays as it is."""
    patch(status_delivery, "pass_revocation_on", lambda decision, resource, notice, *, handled: None)
    return SimRegistrar


def unloads_what_is_revoked(patch: Patch) -> type[SimRegistrar]:
    """A revoked resource is unloaded without waiting for its holders."""
    plain = status_changes.revoke

    def revoke(decision: Decision, command: Revoke) -> None:
        plain(decision, command)
        resource = decision.catalog.find(command.target)
        if resource is not None and resource.id in decision.catalog.revocations and resource.phase is Phase.LOADED:
            unloading.begin_unload(decision, resource)

    in_tables(patch, plain, revoke)
    return SimRegistrar


def loses_a_pause_in_a_crash(patch: Patch) -> type[SimRegistrar]:
    """A pause or a resumption that a crash has interrupted does not run again."""
    patch(recovery, "_rest_again", lambda decision, resource, event: None)
    return SimRegistrar


def leaves_what_is_needed_paused(patch: Patch) -> type[SimRegistrar]:
    """A paused resource is not resumed when it is needed."""
    balance = unloading.balance

    def leave(decision: Decision, resource_id: str) -> None:
        resource = decision.catalog.resources.get(resource_id)
        if resource is None or resource.phase is not Phase.PAUSED:
            balance(decision, resource_id)

    patch(unloading, "balance", leave)
    return SimRegistrar


def never_pauses_what_is_on_standby(patch: Patch) -> type[SimRegistrar]:
    """Only what nobody holds is paused."""
    balance = unloading.balance

    def overlook(decision: Decision, resource_id: str) -> None:
        resource = decision.catalog.resources.get(resource_id)
        if resource is None or resource.phase is not Phase.LOADED or resource_id not in decision.catalog.holders:
            balance(decision, resource_id)

    patch(unloading, "balance", overlook)
    patch(loading, "balance", overlook)
    return SimRegistrar


def forgets_a_reload_in_a_crash(patch: Patch) -> type[SimRegistrar]:
    """A reload that a crash interrupts does not go on."""
    patch(recovery, "is_reloaded", lambda catalog, id: False)
    return SimRegistrar


MUTATIONS: dict[str, Callable[[Patch], type[SimRegistrar]]] = {
    "a pause lost in a crash": loses_a_pause_in_a_crash,
    "a reload lost in a crash": forgets_a_reload_in_a_crash,
    "what is needed left paused": leaves_what_is_needed_paused,
    "what is on standby never paused": never_pauses_what_is_on_standby,
    "reply before commit": _in_place(AnswersFirst),
    "no undo of what could not be committed": no_undo,
    "owed releases forgotten in a crash": _in_place(ForgetsWhatItOwes),
    "notices forgotten in a crash": _in_place(ForgetsNotices),
    "repetition not marked": _in_place(NeverRepeated),
    "an interrupted load run under the same attempt": _in_place(SameAttempt),
    "withdrawal forgotten": forgets_withdrawals,
    "attempt stamp not checked in reconcile": no_stamp,
    "unload without waiting for the last holder": first_to_leave,
    "taken away without a word": takes_silently,
    "lost without a word": loses_silently,
    "notice acknowledged before it was dealt with": acknowledges_at_once,
    "notice heard again when sent again": hears_twice,
    "statuses that wait not sent": sends_no_more,
    "all statuses sent over a new link": sends_all_over_a_new_link,
    "status not passed on": keeps_to_itself,
    "the holders told before the own server": tells_holders_first,
    "the own server's status forgotten in a crash": forgets_its_own_server,
    "a status that comes back to the callback that says it": comes_back,
    "a status heard before the load has returned": does_not_wait_for_the_load,
    "a status that waited for the load forgotten": loses_what_waited,
    "a withdrawn load run again after a crash": loads_what_was_withdrawn,
    "a withdrawn load forgotten after a crash": forgets_what_was_withdrawn,
    "load not queued behind the unload": no_queue,
    "a replaced part kept": keeps_what_was_replaced,
    "release written later": releases_later,
    "rings not looked for": no_probes,
    "parts of a failed load kept": keeps_parts,
    "what was let go taken back": takes_everything_back,
    "interrupted load not started clean": starts_over,
    "a replaced link still listened to": _in_place(ListensToWhatIsOver),
    "a dead incarnation's direct line listened to": _in_place(ListensToLinesOfTheDead),
    "no link for acknowledgements": _in_place(NeverComesBackToAcknowledge),
    "a load in flight forgotten": forgets_what_is_in_flight,
    "a part in flight overlooked": overlooks_parts_in_flight,
    "let go, and written as held": writes_what_is_let_go,
    "let go by line, and not written": _in_place(OwesWithoutWriting),
    "let go by line, and an older row written over that": _in_place(WritesOlderRowsOver),
    "joined by a thread, and not written": _in_place(JoinsWithoutWriting),
    "joined at once, and not written": _in_place(JoinsAtOnceWithoutWriting),
    "decided by a thread, and not written": _in_place(TellsWithoutWriting),
    "answered by a thread, and nothing else done": _in_place(AnswersAndNothingElse),
    "a load whose line broke not asked for again": waits_for_a_broken_line,
    "lists compared by their ids alone": compares_ids_alone,
    "a request sent over any link to the same run": sends_to_the_same_run,
    "priority not lowered when a holder leaves": keeps_priorities,
    "a priority acknowledged and lost in a crash": writes_priorities_later,
    "a priority lost with its link": tells_priorities_once,
    "lists compared without their priorities": compares_no_priorities,
    "a priority that is overtaken by an older one": believes_what_was_overtaken,
    "a priority that overtakes the load of a part": overlooks_loads_in_flight,
    "a revoked part let go, and its whole left as it is": lets_revoked_parts_go,
    "a revocation acknowledged, and not passed on": overlooks_revocations,
    "a revoked resource unloaded before what depends on it": unloads_what_is_revoked,
}

# Those that chance meets too seldom, and what is broken in the one world made for each (test_simulation.py has it).
DIRECTED: dict[str, tuple[Callable[[Patch], type[SimRegistrar]], str]] = {
    "queries from before a closing held again": (holds_again_after_closing, "known to nobody"),
    "what was decided for a link sent over the next": (sends_over_the_next_link, "links"),
    "what was decided for a link sent over the next, to the same run": (sends_to_the_same_run, "links"),
    "a load told to be held that was given up": (_in_place(TellsWhoHasGivenUp), "acknowledged"),
    "a release that is owed said to be refused": (keeps_what_is_owed, "acknowledged"),
    "what came by both ways answered by one": (answers_on_one_way, "memory"),
    "no dedupe of query ids": (no_dedupe, "disagree"),
    "an update that waits taken for the first row": (takes_unsaved_for_new, "false loss"),
    "answered by line while the link was down, and not remembered": (forgets_what_came_meanwhile, "false loss"),
    "an unload answered by the line alone": (answers_lines_alone, "stuck"),
    "an unload refused, and done by a line that was left": (answers_lines_alone, "check"),
    "what is from before a crash let go by line": (owes_what_it_had, "false loss"),
    "a priority given between two links lost": (forgets_priorities_between_links, "priorities"),
    "providers that were away forgotten at the closing": (forgets_who_was_away, "check"),
    "queries of a provider that is gone forgotten": (forgets_what_is_gone, "acknowledged"),
}
