"""Ledger: what the world outside saw of a simulated run - the answers people got, the callbacks that ran - and what
must never be seen. It lives on when simulated processes die.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

from rr_actors.registrar.core.callback_runs import ATTEMPTS
from rr_actors.registrar.model.rows import Held, Notice, State


class Violation(Exception):
    """A promise was broken. `kind` names which."""

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(f"{kind}: {text}")
        self.kind = kind


class Life(NamedTuple):
    """Where the outside sees a resource: its callbacks' log, folded."""

    stage: str  # loading, loaded, unloading, unload_failed; renewing, renewed: unloaded, to be loaded again
    number: int  # of the last run: attempt or tries
    interrupted: bool  # a crash may have come since that run began or ended


class Ledger:
    """Who was told what, and which callbacks ran."""

    def __init__(self) -> None:
        self.lives: dict[tuple[str, str], Life] = {}  # (registrar, resource)
        self.by_request: dict[tuple[str, str, bytes], set[str]] = {}
        self.request_of: dict[tuple[str, str], tuple[str, str, bytes]] = {}
        self.open: dict[tuple[str, str, str], int] = {}  # (registrar, kind, resource) -> callbacks that run now
        self.deaths: dict[tuple[str, str, str], int] = {}  # the same -> processes in a row that died in its runs
        self.early: set[str] = set()  # queries whose loads have ended for those who asked, and not on disk
        self.fate: dict[str, str] = {}  # query -> asked, held, letting, released, failed, lost
        self.given_up: set[tuple[str, str]] = set()  # loads that died, and are not run again: what is left is unloaded
        self.parts: dict[tuple[str, int], list[str]] = {}  # resource, attempt -> queries its callback was given
        self.swapped: set[str] = set()  # parts and their spares: of each pair one stays
        self.swaps: dict[Any, str] = {}  # by ticket: the part that is replaced
        self.replaced: set[str] = set()  # parts of which the callback was told that they are
        self.cut_short: set[tuple[str, int]] = set()  # resource and attempt of each reload whose process died
        self.provider: dict[str, str] = {}
        self.noticed: dict[str, Notice] = {}
        self.open_notices: dict[str, list[str]] = {}
        self.numbers: dict[str, int] = {}  # of the notices that were ever on disk, in their order; 0: twice
        self.last_heard: dict[tuple[str, int], int] = {}  # by query and incarnation of its holder
        self.stored: set[str] = set()  # queries that were ever on a provider's disk
        self.told: set[tuple[str, str]] = set()  # event and query of every notice that was ever on disk
        self.let_go: set[str] = set()  # queries that have left a provider's disk
        self.reached: set[tuple[str, str]] = set()  # resources, and the events that came to them
        self.on_the_way: set[tuple[str, str, str, str, str]] = set()
        self.handled: set[tuple[str, str]] = set()  # resource and event: its status callback kept it to itself
        self.forgotten: set[str] = set()  # held, and a crash of the holder came before the row was written
        self.evicted: set[str] = set()
        self.taken: dict[str, set[str]] = {}  # query -> the resources that it was on when it was evicted
        self.refused: set[str] = set()  # held again since an unload failed; it may have been asked for twice
        self.own_hears: dict[str, list[int]] = {}  # notice for a server itself -> incarnations it was heard in
        self.own_heard: set[tuple[str, str]] = set()  # resource and event: its status callback was through with it
        self.said: set[str] = set()  # events that status callbacks have said of their own resources
        self.hears: dict[tuple[str, str], list[int]] = {}  # (query, event) -> incarnations it was heard in
        self.heard: set[tuple[str, str]] = set()  # and it was dealt with
        self.about: dict[str, str] = {}  # notice -> its resource
        self.losses: set[str] = set()  # queries whose holders heard that they are gone
        self.revoked: set[str] = set()  # queries whose holders heard that they are to let them go
        self.given_up_parts: set[tuple[str, str]] = set()  # a whole, and the revoked resource that it was to let go
        self.forced: set[str] = set()  # resources that their owners took away, or whose grace was over
        self.on: dict[str, str] = {}  # query -> the resource that it was last on
        self.deleted: set[str] = set()  # notices that their provider forgot when it was deleted
        self.answered: dict[str, bool] = {}
        self.wishes: dict[str, list[tuple[int, int | None]]] = {}  # query -> ticket and priority; None: it inherits
        self.acknowledged = 0

    # -- callbacks -----------------------------------------------------------------------------------------------

    def run_started(
        self, registrar: str, id: str, kind: str, number: int, request: tuple[str, str, bytes], excused: set[str]
    ) -> None:
        """A load or unload callback begins.

        Args:
            excused: resources of the request that may live beside a new one.
        """
        key = (registrar, id)
        given_up = kind == "unload" and key in self.given_up
        self.given_up.discard(key)
        life = self.lives.get(key)
        who = f"{registrar}: {kind} callback of {id} (run {number})"
        if life is None:
            if kind != "load" and not given_up:
                raise Violation("callbacks", f"{who} without anything loaded")
            others = self.by_request.setdefault(request, set()) - excused - {id}
            if others:
                raise Violation("loaded twice", f"{who} begins while {sorted(others)} of the same request live")
            self.by_request[request].add(id)
            self.request_of[key] = request
        elif not (_may_follow(life, kind, number) or (given_up and life.interrupted)):
            raise Violation("callbacks", f"{who} follows {life}")
        self.lives[key] = Life(_BEGINS[kind], number, False)

    def run_ended(self, registrar: str, id: str, stage: str) -> None:
        """It ended; `stage` is what it led to: loaded, gone, unload_failed."""
        key = (registrar, id)
        self.lives[key] = self.lives[key]._replace(stage=stage)
        if stage == "unload_failed":  # from now on it does not stand in the way of a fresh one
            self.by_request[self.request_of[key]].discard(id)

    def callback_began(self, registrar: str, kind: str, id: str) -> None:
        """A callback of a resource begins: not for a fourth time, if three processes have died in its runs."""
        key = (registrar, kind, id)
        if self.deaths.get(key, 0) >= ATTEMPTS:
            raise Violation("callbacks", f"{registrar}: {kind} of {id} begins after {self.deaths[key]} deaths")
        self.open[key] = self.open.get(key, 0) + 1

    def callback_ended(self, registrar: str, kind: str, id: str) -> None:
        """A callback of a resource has ended, and its process lives."""
        key = (registrar, kind, id)
        self.deaths.pop(key, None)
        self.open[key] = max(0, self.open.get(key, 0) - 1)

    def reload_began(self, registrar: str, id: str) -> None:
        """An owner has a resource reloaded: what was given up before is tried again."""
        self.deaths.pop((registrar, "renew", id), None)

    def given_up_unload(self, registrar: str, id: str, *, died: bool) -> None:
        """That a resource is kept as unload_failed is on disk: its unload callback has ended so, or runs no more.

        `died`: three processes have, that were to run it. They may not have come so far.
        """
        life = self.lives.get((registrar, id))
        if life is not None and (life.stage == "unloading" or (died and life.interrupted and life.stage != "gone")):
            self.run_ended(registrar, id, "unload_failed")

    def unload_began(self, id: str, wholes: dict[str, int]) -> None:
        """The unload callback of a revoked resource begins: what depends on it has been unloaded, or has let it go.

        Args:
            wholes: the attempts of all resources that are loaded and have not dealt with the revocation.
        """
        if id in self.forced:
            return
        for whole, attempt in wholes.items():
            for part in self.parts.get((whole, attempt), ()):
                if self.on.get(part) == id and part not in self.swapped | self.losses:
                    raise Violation("revocations", f"{id} is unloaded, and {whole} is loaded, which holds it by {part}")

    def settled(self, registrar: str, id: str, *, cleared: bool = False) -> None:
        """That a resource is gone is on disk: its callbacks must not run again. `cleared`: without its callback."""
        key = (registrar, id)
        for kind in ("load", "unload", "recover", "reload", "renew", "status", "pause", "resume"):
            self.deaths.pop((registrar, kind, id), None)
            self.open.pop((registrar, kind, id), None)
        life = self.lives.pop(key, None)
        if life is None:
            return
        if life.stage not in ("gone", "renewed") and not (cleared and life.stage == "unload_failed"):
            raise Violation("callbacks", f"{registrar}: {id} left the catalog while it was {life}")
        self.by_request[self.request_of.pop(key)].discard(id)

    def crashed(self, registrar: str) -> None:
        """A process died: what its callbacks did may be repeated."""
        for key in [key for key, count in self.open.items() if key[0] == registrar and count]:
            self.deaths[key] = self.deaths.get(key, 0) + 1
            del self.open[key]
        for key, life in self.lives.items():
            if key[0] == registrar:
                self.lives[key] = life._replace(interrupted=True)

    # -- answers -------------------------------------------------------------------------------------------------

    def loaded(self, query_id: str, on_disk: bool) -> None:
        """Whoever asked was told that the query is held."""
        if not on_disk:
            raise Violation(
                "acknowledged", f"{query_id}: its load was acknowledged, its provider's disk has no such row"
            )
        if self.fate.get(query_id) not in ("asked", "lost"):
            raise Violation("acknowledged", f"{query_id}: loaded, after it was {self.fate.get(query_id)}")
        self.acknowledged += 1
        self.fate[query_id] = "held"

    def failed(self, query_id: str) -> None:
        """Whoever asked was told that it failed."""
        self.fate[query_id] = "failed"

    def told_early(self, query_ids: Iterable[str]) -> None:
        """Those who asked were told in their time, and the disk was full: a crash forgets that they were."""
        self.early.update(id for id in query_ids if self.fate.get(id) == "failed")

    def withdrawn(self, query_ids: Iterable[str]) -> None:
        """The disk has by now that these loads were given up."""
        self.early.difference_update(query_ids)

    def forget_ends(self, query_ids: Iterable[str]) -> None:
        """The process of those who asked has died. Of loads that the disk has not, they are not told again."""
        for id in self.early.intersection(query_ids):
            self.early.discard(id)
            self.fate[id] = "unanswered"

    def letting(self, query_id: str) -> None:
        """Somebody lets the query go, and is not answered yet."""
        self.fate[query_id] = "unanswered"

    def released(self, query_id: str, on_disk: bool) -> None:
        """Whoever let it go was told that this is done."""
        if on_disk:
            raise Violation(
                "acknowledged", f"{query_id}: its unload was acknowledged, its provider's disk still has it"
            )
        self.acknowledged += 1
        self.fate[query_id] = "released"

    def kept(self, query_id: str) -> None:
        """The unload was refused: it is still held."""
        self.fate[query_id] = "held"

    # -- statuses ------------------------------------------------------------------------------------------------

    def notice(self, notice: Notice) -> None:
        """A notice is on its provider's disk."""
        self.told.add((notice.event, notice.query_id))
        self.noticed.setdefault(notice.id, notice)
        self.numbers[notice.id] = 0 if notice.id in self.numbers else len(self.numbers) + 1
        if notice.released:
            self.evicted.add(notice.query_id)
            self.taken.setdefault(notice.query_id, set()).add(notice.resource_id)
        else:
            self.open_notices.setdefault(notice.query_id, []).append(notice.id)

    def own_notice(self, notice: Notice) -> None:
        """A notice for the server of the resource itself is on disk."""
        if notice.event in self.said:
            raise Violation("statuses", f"{notice} comes back to the callback that has said it")

    def hear_own(self, notice: Notice, incarnation: int, repeated: bool) -> None:
        """A server is being told what is said of its own resource."""
        times = self.own_hears.setdefault(notice.id, [])
        if incarnation in times:
            raise Violation("statuses", f"{notice} was heard twice in one incarnation")
        if times and not repeated:
            raise Violation("statuses", f"{notice} was heard again, and it was not marked as repeated")
        times.append(incarnation)

    def own_dealt_with(self, notice: Notice, queries: Iterable[str], passed_over: bool) -> None:
        """It has left the disk, and its resource has not: its server has dealt with it, and those on it are told.

        `passed_over`: its server's callback runs no more, as three processes have died in it.
        """
        place = (notice.resource_id, notice.event)
        if not passed_over and place not in self.own_heard and notice.id not in self.own_hears:
            raise Violation("statuses", f"{notice} was forgotten before its server had dealt with it")
        untold = [id for id in queries if (notice.event, id) not in self.told]
        if untold and place not in self.handled:
            raise Violation("statuses", f"{notice} went no further, and was not dealt with: {untold} do not hear it")

    def begun(self, query_id: str) -> None:
        """A query is on its provider's disk. What was said about one of the same id before is not about this one."""
        self.stored.add(query_id)
        if query_id in self.evicted:
            self.evicted.discard(query_id)
            for id in [n.id for n in self.noticed.values() if n.query_id == query_id]:
                del self.noticed[id]

    def dropped(self, query_id: str) -> None:
        """A provider does not have the query any more: what was said about it before may be forgotten."""
        self.let_go.add(query_id)
        for id in self.open_notices.pop(query_id, ()):
            self.noticed.pop(id, None)

    def hear(self, query_id: str, notice: Notice, incarnation: int, repeated: bool, excused: bool) -> None:
        """Who listens to the query is being told. `excused`: there is a reason for a loss that is not in the ledger."""
        number = self.numbers.get(notice.id)  # None: its holder says by itself that it is lost
        again = query_id in self.refused  # held again, as its unload failed: then older statuses come again
        if number and not again and number < self.last_heard.get((query_id, incarnation), 0):
            raise Violation("statuses", f"{query_id} heard {notice.event} after a later one")
        self.last_heard[query_id, incarnation] = number or 0
        times = self.hears.setdefault((query_id, notice.event), [])
        if incarnation in times:
            raise Violation("statuses", f"{query_id} heard {notice.event} twice in one incarnation")
        if times and not repeated:
            raise Violation("statuses", f"{query_id} heard {notice.event} again, and it was not marked as repeated")
        times.append(incarnation)
        if notice.released:
            after_all = query_id in self.refused and query_id in self.let_go
            taken = query_id in self.evicted or notice.resource_id in self.taken.get(query_id, ())
            if not (taken or excused or after_all):
                raise Violation("false loss", f"{query_id} was said to be lost ({notice.message}): nobody took it away")
            self.losses.add(query_id)
            if notice.state is not State.FATAL:
                raise Violation("statuses", f"{query_id}: taken away with state {notice.state}")

    def must_go_on(self, registrar: str, part: Held, event: str, holders: Iterable[str]) -> None:
        """A resource's part was heard of: the resource's holders of now are to hear of it too, unless it is dealt with.

        By another way of a diamond it comes later, and is known; those who hold since then need not hear of it.
        """
        place = (part.parent, event)
        if place not in self.reached:
            self.reached.add(place)
            self.on_the_way.update((registrar, part.id, part.parent, event, query_id) for query_id in holders)

    def dealt_with(self, query_id: str, event: str) -> None:
        """Who listens has heard it to the end."""
        self.heard.add((query_id, event))

    def ticket(self, ticket: Any, given: bool) -> None:
        """An owner's call was made, or answered."""
        if given:
            self.answered[ticket] = False
        elif self.answered.get(ticket, True):
            raise Violation("answers", f"the owner's call {ticket} was answered twice")
        else:
            self.answered[ticket] = True

    # -- priorities ----------------------------------------------------------------------------------------------

    def wished(self, query_id: str, ticket: int, priority: int) -> None:
        """Somebody gives a query a priority. Until that is answered, it may have this one or the one before."""
        self.wishes.setdefault(query_id, [(0, 0)]).append((ticket, priority))

    def wish_answered(self, ticket: Any, *, done: bool) -> None:
        """A query has the priority that it was given, or has not got it."""
        for query_id, wishes in self.wishes.items():
            if wishes[-1][0] >= ticket and any(one == ticket for one, _ in wishes):
                kept = [wish for wish in wishes if (wish[0] >= ticket if done else wish[0] != ticket)]
                self.wishes[query_id] = kept


_BEGINS = {"load": "loading", "reload": "loaded", "unload": "unloading", "renew": "renewing"}
_INTERRUPTED = {"load": ("loading", "loaded", "gone"), "reload": ("loaded",), "unload": ("unloading", "gone")}


def _may_follow(life: Life, kind: str, number: int) -> bool:
    """Load, then unload, in turn; a repetition only where a crash came between, and told by a greater number."""
    if kind in ("unload", "renew") and life.stage == "loaded":
        return True
    if kind == "renew":
        return life.interrupted and life.stage in ("renewing", "renewed")
    if kind == "reload" and (life.stage == "renewed" or (life.interrupted and life.stage == "renewing")):
        return number > life.number
    if kind == "unload" and life.interrupted and life.stage in ("renewing", "renewed"):
        return True  # nobody holds it any more
    if kind == "unload" and life.stage == "unload_failed":
        return number > life.number
    return life.interrupted and life.stage in _INTERRUPTED[kind] and number > life.number
