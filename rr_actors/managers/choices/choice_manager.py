"""Choices: the manager that gives a resource of a kind, and another in its place when that one fails.

A choice is a resource with one part: the alternative in use. matching.py says which alternatives are allowed and
which is best, planning.py when to try a better one again; this module carries that out with the calls that every
manager has.
"""

from __future__ import annotations

import functools
import os
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import msgspec

from rr_actors.actors.actor_tables import TableColumn, table
from rr_actors.actors.messaging.futures import Reply
from rr_actors.base.checks import is_number
from rr_actors.base.errors import (
    ConfigError,
    LoadFailed,
    RegistrarDown,
    RrError,
    Unavailable,
    UnknownQuery,
    UnknownServer,
    UsageError,
    shown,
    text_of,
)
from rr_actors.base.names import new_id, short_id
from rr_actors.base.reporting.log import Log
from rr_actors.base.toml import wrong
from rr_actors.managers.choices.addresses import Addresses
from rr_actors.managers.choices.alternatives import Alternative, check_rings, read_alternatives
from rr_actors.managers.choices.by_hand import ByHand, ChoiceInfo, ChoicesRecord, ChosenByHand, find_choice, find_key
from rr_actors.managers.choices.choice_search import ChoiceSearch, breaks_first, loading_of
from rr_actors.managers.choices.chosen import Choose, Chosen, HeldChoice, held_choice
from rr_actors.managers.choices.labelled import Labelled
from rr_actors.managers.choices.offers import Offers, nothing_left
from rr_actors.managers.choices.planning import ChoiceState, in_turn
from rr_actors.managers.choices.trials import FAILED, Trials
from rr_actors.managers.planning.blame import is_own_failure, is_own_fault, part_of
from rr_actors.managers.planning.hedging import HEDGE_S
from rr_actors.managers.planning.kept_record import KeptRecord
from rr_actors.managers.planning.reliability import Reliabilities
from rr_actors.managers.planning.retries import SOON_S, Retries
from rr_actors.managers.planning.searches import CandidateLoad, groups, release, release_soon, strays
from rr_actors.registrar.declarations import server
from rr_actors.registrar.manager import Manager
from rr_actors.registrar.model.rows import LOWEST, Phase, State
from rr_actors.registrar.queries import Query, Status, StatusCallback
from rr_actors.registrar.registrar import begin_planned
from rr_actors.registrar.servers.callback_context import current

logger = Log("rr_actors.managers.choices")

# messages of a status that a choice gets from its own manager
_TAKE = "returns to "  # and the key of an alternative
_FIXED = "takes what is chosen by hand"
_AGAIN = "chooses again, as a crash came in between"
_FIRST_HEDGE_S = 5.0  # nobody uses anything that has failed yet, and devices are slow to start


class Choices(Manager):
    """Serves `choice`: loads the best alternative of a kind, and another one when that fails.

    The holders hear UPDATE when another alternative takes the place of the one in use, and FATAL when nothing is left;
    that message says for each alternative why not. A better one that is well again for `settle_s` takes its place back.
    """

    _rr_side_by_side = True

    def __init__(
        self,
        file_or_alternatives: str | os.PathLike[str] | Sequence[Alternative] = (),
        settle_s: float = 2.0,
        relay_hosts: Sequence[str] = (),
    ) -> None:
        """Take the alternatives from a TOML file, or as they are given; the preferred first.

        After them come the servers that are registered with `provides=`, as long as they are there.

        `settle_s`: so many seconds after its failure an alternative is loaded again, on trial beside the one in use,
        and for so many it has to be well before it is used.
        `relay_hosts`: the hosts, besides this machine, whose addresses relays may connect to.

        Raises:
            ConfigError: the file cannot be read, or an alternative or a host is wrong. `.file`, `.key`, `.expected`,
                `.got`
        """
        self._given = read_alternatives(file_or_alternatives, self._rr_beginning())
        if not is_number(settle_s) or settle_s < 0:
            raise wrong(None, "settle_s", "a number of seconds, at least 0", settle_s, where="Choices")
        for i, host in enumerate(relay_hosts):
            if not host or not isinstance(host, str):  # pyright: ignore[reportUnnecessaryIsInstance]
                raise wrong(None, f"relay_hosts[{i}]", "the name or number of a host", host, where="Choices")
        self._relay_hosts = tuple(relay_hosts)
        self._lock = threading.RLock()
        self._trials = Trials(
            self._lock,
            settle_s,
            self._choices,
            self._load_on_trial,
            self._have_taken,
            lambda: self._offers.has_changed(),
            lambda: strays(self.registrar, self._begun),
            self._rr_failed,
        )
        self._begun = ""

    def on_start(self) -> None:
        """Go on with the choices that are held. Trials of the process before are ended, and begin anew.

        Raises:
            ConfigError: alternatives hold each other in a ring.
        """
        check_rings(self._given, f"{self.registrar.name}/choice", self._allowed_keys)
        with self._lock:
            held = dict(self._held)
            self._begun = new_id()
            self._by_hand.keep_only(held)
        self._restore_relays(held)
        for id in list(self._record.now.choices):
            if id in held:
                self.registrar.send_status(id, Status(State.UPDATE, _AGAIN))
            else:
                self._mend(id)
        self._trials.start()

    def on_stop(self) -> None:
        """End the trials, and close the relays."""
        self._trials.stop()
        self._addresses.stop()

    # -- messages --------------------------------------------------------------------------------------------------

    def choose(self, choice: str, alternative: str, *, by: str = "", dry_run: bool = False) -> ChoiceInfo:
        """Fix which alternative a choice has, until choose_freely(). The choice goes over to it soon.

        It is before all others then. If it fails, another one serves until it is well again. One with `break_first` is
        not tried again by itself. What was chosen is on disk.

        Args:
            choice: the choice's id, the beginning or end of that, or a kind that only one choice has.
            alternative: its key, as choices() says it, or its server if it is the only one of that.
            by: who chooses, for people.
            dry_run: change nothing, and return the choice as it is.

        Raises:
            NotFound: there is no such choice, or it allows no such alternative. `.id`, `.known`
            UsageError: several are meant.
            Unavailable: the disk refuses it. Nothing has changed.
        """
        with self._lock:
            id = find_choice(choice, self._held)
            held = self._held[id]
            key = find_key(alternative, [one.key for one in self._offers.allowed_now(held.request)])
            if not dry_run:
                self._by_hand.set(id, ByHand(key, str(by), time.time()))
        if not dry_run:
            logger.info("%s: %s is chosen by hand%s", held.request.kind, key, f", by {by}" if by else "")
            self._tell(id, held, _FIXED)
        return self._info(id, held)

    def choose_freely(self, choice: str, *, dry_run: bool = False) -> ChoiceInfo:
        """Take back what was chosen by hand. The choice returns to what is best when that has been well for a while.

        Raises:
            RrError: as choose(); or UsageError: nothing was chosen for it by hand.
        """
        with self._lock:
            id = find_choice(choice, self._held)
            held = self._held[id]
            if not self._by_hand.key(id):
                raise UsageError(f"choice {short_id(id)} ({held.request.kind}): nothing is chosen for it by hand")
            if not dry_run:
                self._by_hand.set(id, None)
        self._trials.look()
        return self._info(id, held)

    def choices(self) -> list[ChoiceInfo]:
        """Return all choices as they are now."""
        with self._lock:
            held = dict(self._held)
        return [self._info(id, one) for id, one in held.items()]

    @table(
        "choices",
        TableColumn("id", kind="id"),
        TableColumn("kind"),
        TableColumn("present", "in use", "long"),
        TableColumn("by_hand", "by hand", "long"),
        TableColumn("by"),
        TableColumn("why", "why not", "problem"),
        TableColumn("passed_over", "passed over", "problem"),
    )
    def choice_rows(self) -> list[dict[str, Any]]:
        """Return all choices as they are now, with why those that are better than the one in use were passed over."""
        with self._lock:
            held = dict(self._held)
        rows: list[dict[str, Any]] = []
        for id, one in held.items():
            info = self._info(id, one)
            better = info.allowed[: info.allowed.index(info.present)] if info.present in info.allowed else info.allowed
            why = {key: one.failures.get(key, "it is not known to be well yet") for key in better}
            rows.append(msgspec.structs.asdict(info) | {"passed_over": why})
        return rows

    def on_receive(self, message: Any) -> list[dict[str, Any]]:
        """Answer what `rr-actors choices` and `rr-actors choose` ask."""
        match message:
            case {"choices": None}:
                return self.choice_rows()
            case {"choose": choice, "alternative": None, "dry_run": bool(dry_run)}:
                found = [self.choose_freely(choice, dry_run=dry_run)]
            case {"choose": choice, "alternative": alternative, "by": str(by), "dry_run": bool(dry_run)}:
                found = [self.choose(choice, alternative, by=by, dry_run=dry_run)]
            case _:
                raise UsageError(f"{self.registrar.name}: expected a question to Choices, got {shown(message)}")
        return [msgspec.structs.asdict(info) for info in found]

    def _info(self, id: str, held: HeldChoice) -> ChoiceInfo:
        with self._lock:
            return self._by_hand.info(id, held, [one.key for one in self._allowed_now(id, held)])

    # -- the server ------------------------------------------------------------------------------------------------

    @server("choice", recovery="keep")
    def load_choice(self, request: Choose) -> Chosen:
        """Load the best alternative that can be loaded."""
        best = self._offers.allowed(request)
        search = self._search(HeldChoice(request, ""), retries=Retries())  # what is new waits for nothing

        def take(one: Alternative, query: Query) -> Chosen:
            return self._addresses.made(search.id, search.held, one, query)

        def failed(one: Alternative, error: Exception) -> None:
            if current().stopping.is_set():
                raise error
            self._not_loaded(search, one, error)

        def tried(group: Sequence[Alternative]) -> Chosen | None:
            return self._try(search, group, search.as_part, take, failed, hedge_s=_FIRST_HEDGE_S)

        try:
            chosen = next(filter(None, map(tried, groups(self._in_turn(best, ()), breaks_first))), None)
        except BaseException:
            self._addresses.close(search.id)
            raise
        if chosen is None:
            self._addresses.close(search.id)
            text, server = nothing_left(request, search.tried), f"{self.registrar.name}/choice"
            raise LoadFailed(text, server=server, wanted=search.wanted)
        self._use(search, chosen)
        if search.held.present != best[0].key:
            self._trials.look()
        return chosen

    @load_choice.unload
    def unload_choice(self, request: Choose, response: Chosen | None) -> None:
        """Forget the choice; the registrar releases its part."""
        self._forget(current().resource_id)

    @load_choice.status
    def choice_status(self, request: Choose, status: Status) -> None:
        """Put the next best alternative in the place of one that has failed, or a better one that is well again."""
        id = current().resource_id
        with self._lock:
            held = self._held.get(id)
        try:
            if status.resource_id == id:
                self._hear_own(id, held, status)
            else:
                self._hear_part(id, held, status)
        except UnknownQuery:  # the choice is being unloaded
            status.handled()
        except RegistrarDown as error:  # the next process hears the status again
            logger.info("%s: %s", request.kind, error)

    # -- hearing ---------------------------------------------------------------------------------------------------

    def _hear_part(self, id: str, held: HeldChoice | None, status: Status) -> None:
        part = part_of(self.registrar, status).part
        if part is None or held is None:
            status.handled()  # a run before a crash has dealt with it
        elif status.state in FAILED:
            self._replace(id, held, status, part)
        elif status.state is not State.UPDATE:
            held.failing = False
        elif (one := self._in_use(held)) is not None:
            self._hear_response(id, held, one, part, status)

    def _hear_response(self, id: str, held: HeldChoice, one: Alternative, part: Query, status: Status) -> None:
        """Pass on a new response of the part; if it has no address and needs one, replace the part."""
        try:
            chosen = self._addresses.made(id, held, one, part)
        except (ConfigError, Unavailable) as error:
            logger.warning("%s: %s", one.key, error)
            self._replace(id, held, status, part)
            return
        self.registrar.update_response(id, chosen, status.message)
        self._addresses.point(id, chosen)
        status.handled()

    def _hear_own(self, id: str, held: HeldChoice | None, status: Status) -> None:
        """Do what this manager has told a choice to do; other statuses of the choice are for its holders."""
        if status.state is State.FATAL:
            self._forget(id)
        elif status.message == _AGAIN:
            status.handled()
            if held is not None:
                self._choose_again(id, held, status)
        elif status.message == _FIXED:
            status.handled()
            if held is not None:
                self._take_by_hand(id, held, status)
        elif status.message.startswith(_TAKE):
            status.handled()
            if held is not None:
                self._return(id, held, status.message.removeprefix(_TAKE), status)

    # -- replacing -------------------------------------------------------------------------------------------------

    def _return(self, id: str, held: HeldChoice, key: str, status: Status) -> None:
        """Put a better alternative in the place of the one in use."""
        kind = held.request.kind
        try:
            parts = self.registrar.children(id)
            better = self._offers.find(key, kind)
            if key != held.present and better is not None and parts:  # else a run before a crash has done it
                self._swap(self._search(held, parts[0]), status, better)
                logger.info("%s: returns to %s", kind, key)
        except RrError as error:
            logger.warning("%s: cannot return to %s: %s", kind, key, error)
            held.failures[key] = text_of(error)
            self._trials.failed(key, is_own=is_own_fault(error))
        finally:
            held.moving = False
            self._trials.look()

    def _take_by_hand(self, id: str, held: HeldChoice, status: Status) -> None:
        """Put what was chosen by hand in the place of the one in use."""
        with self._lock:
            key = self._by_hand.key(id)
        one, present = self._offers.find(key, held.request.kind), self._in_use(held)
        parts = self.registrar.children(id)
        breaks = one is not None and (one.break_first or (present is not None and present.break_first))
        if key == held.present or not parts or not breaks:
            self._return(id, held, key, status)
            return
        held.moving = False
        self._break(id, parts[0])
        self._choose_again(id, held, status)

    def _replace(self, id: str, held: HeldChoice, status: Status, part: Query) -> None:
        """Put the next best alternative in the place of one that has failed; give up if there is none."""
        failed, said = held.present, status.message or str(status.state)
        with self._lock:
            if failed == self._by_hand.key(id):
                said += "; it was chosen by hand, and takes its place back when it is well"
        is_own = is_own_failure(status)
        if is_own and (one := self._in_use(held)) is not None:
            self._offers.lower(one, status.resource_id)
        self._trials.failed(failed, status.resource_id, is_own=is_own)
        held.failures[failed] = said
        search = self._search(held, part, [f"{failed}: {said}"])
        if self._fill(search, status, {failed}):
            logger.warning("%s: %s takes the place of %s: %s", held.request.kind, held.present, failed, said)
        elif id in self._record.now.choices or (status.state is State.FATAL and status.reason != "revoked"):
            self._give_up(search, status)
        else:  # with ERROR it may be of some use still; a part that is revoked takes the choice with it
            held.failing = True
            logger.warning("%s", nothing_left(held.request, search.tried))
        self._trials.look()

    def _choose_again(self, id: str, held: HeldChoice, status: Status) -> None:
        """Choose anew where one has been released; after a crash, the next one may have come as far as to be a part."""
        for part in self.registrar.children(id):
            release(part)
        search = self._search(held)
        if not self._fill(search, status, ()):
            self._give_up(search, status)
        self._trials.look()

    def _search(
        self,
        held: HeldChoice,
        part: Query | None = None,
        tried: Sequence[str] = (),
        retries: Retries[str] | None = None,
    ) -> ChoiceSearch:
        return ChoiceSearch(self.registrar, retries or self._trials.retries, held, part, tried)

    def _fill(self, search: ChoiceSearch, status: Status, without: Collection[str]) -> bool:
        """Put the first alternative that can be had in the place of the part. Return whether there was one."""

        def one_pass() -> bool | None:
            with self._lock:  # else what fails meanwhile is tried once more
                search.decided_at = time.monotonic()
                allowed = self._allowed_now(search.id, search.held)
                fixed = {one.key for one in allowed[:1]} & {self._by_hand.key(search.id)}
                in_turn = self._in_turn(allowed, without, fixed or self._trials.well_beside(search.id))
            return any(self._fill_from(search, status, group) for group in groups(in_turn, breaks_first)) or None

        with search.telling(SOON_S, "the next one is being loaded"):
            return search.until_had(one_pass) is not None

    def _fill_from(self, search: ChoiceSearch, status: Status, group: Sequence[Alternative]) -> bool:
        present = self._in_use(search.held)
        if search.part is not None and (group[0].break_first or (present is not None and present.break_first)):
            self._break(search.id, search.part)
            search.part = None
        failed = functools.partial(self._not_loaded, search)
        if search.part is None:
            put = functools.partial(self._put, search, status)
            return self._try(search, group, self._load_part, put, failed, search.check_wanted) is not None

        def swap(one: Alternative, query: Query) -> Chosen:
            chosen = self._swap(search, status, one)
            release_soon(query)
            return chosen

        return self._try(search, group, search.beside, swap, failed, search.check_wanted) is not None

    def _try(
        self,
        search: ChoiceSearch,
        group: Sequence[Alternative],
        begin: Callable[[CandidateLoad], Reply[Query]],
        take: Callable[[Alternative, Query], Chosen],
        failed: Callable[[Alternative, Exception], None],
        check: Callable[[], object] = lambda: None,
        hedge_s: float = HEDGE_S,
    ) -> Chosen | None:
        """Take the first of these alternatives that can be had, the next one beside one that hangs."""

        def use(one: Alternative, query: Query) -> Chosen:
            chosen = take(one, query)
            search.held.present, search.held.failing = one.key, False
            self._trials.used(one.key)
            return chosen

        return search.first(group, lambda one: begin(loading_of(one)), use, failed, check=check, hedge_s=hedge_s)

    def _load_part(self, load: CandidateLoad) -> Reply[Query]:
        """Load the part of a choice that has none, and wait for it: a load that a crash left would be one too many."""
        loaded: Reply[Query] = Reply()
        loaded.set(self.registrar.load(load.server, load.request, timeout_s=load.timeout_s))
        return loaded

    def _swap(self, search: ChoiceSearch, status: Status, one: Alternative) -> Chosen:
        made = functools.partial(self._addresses.made, search.id, search.held, one)
        chosen = search.swap(status, search.part, loading_of(one), made)
        search.held.present, search.held.failing = one.key, False
        self._use(search, chosen)
        self._trials.used(one.key)
        return chosen

    def _put(self, search: ChoiceSearch, status: Status, one: Alternative, query: Query) -> Chosen:
        """Use what is loaded as the part of a choice that has none now."""
        chosen = self._addresses.made(search.id, search.held, one, query)
        self.registrar.update_response(search.id, chosen, f"{one.key} takes the place of another one")
        self._mend(search.id)
        status.handled()
        self._use(search, chosen)
        return chosen

    def _use(self, search: ChoiceSearch, chosen: Chosen) -> None:
        """Note that a choice has this part now."""
        self._addresses.point(search.id, chosen)
        with self._lock:
            self._held[search.id] = search.held

    def _give_up(self, search: ChoiceSearch, status: Status) -> None:
        text = nothing_left(search.held.request, search.tried)
        logger.warning("%s", text)
        self.registrar.send_status(search.id, Status(State.FATAL, text))  # this process may be ending: it is not lost
        status.handled()
        self._forget(search.id)

    def _break(self, id: str, part: Query) -> None:
        """Release the part. It is on disk before that the choice has none, and so a crash does not leave it so."""
        with self._lock:
            self._record.now.choices.append(id)
            self._record.save()
        self._addresses.point(id, None)
        release(part)

    def _mend(self, id: str) -> None:
        with self._lock:
            if id in self._record.now.choices:
                self._record.now.choices = [other for other in self._record.now.choices if other != id]
                self._record.save()

    def _restore_relays(self, held: Mapping[str, HeldChoice]) -> None:
        """Open the relays at the addresses that programs know; a choice is lost if that is not possible."""
        for info in self.registrar.resources():
            if info.id in held and info.response.address:
                try:
                    self._addresses.restore(info.id, info.response)
                except RrError as error:
                    self.registrar.send_status(info.id, Status(State.FATAL, f"its relay is lost: {error}"))

    # -- choosing --------------------------------------------------------------------------------------------------

    def reliability(self, alternative: Alternative) -> float:
        """Return how far an alternative is trusted now, from 0 to 1."""
        return self._offers.reliability(alternative)

    def _allowed_keys(self, request: Any) -> list[str]:
        """Return what a request for a choice, as plain values, allows; nothing if it is wrong."""
        try:
            return [one.key for one in self._offers.allowed(msgspec.convert(request, Choose))]
        except (msgspec.ValidationError, ConfigError, LoadFailed):
            return []

    def _allowed_now(self, id: str, held: HeldChoice) -> list[Alternative]:
        """Return what a choice allows now, the best first, and what was chosen by hand before all. With the lock."""
        by_hand = self._by_hand.key(id)
        return sorted(self._offers.allowed_now(held.request), key=lambda one: one.key != by_hand)

    def _in_turn(
        self, best: Sequence[Alternative], without: Collection[str], loaded: Collection[str] = ()
    ) -> list[Alternative]:
        order = in_turn([one.key for one in best], self._trials.standings(), without, time.monotonic(), loaded)
        by_key = {one.key: one for one in best}
        return [by_key[key] for key in order]

    def _not_loaded(self, search: ChoiceSearch, one: Alternative, error: Exception) -> None:
        """Note that an alternative cannot be loaded. Only a fault of its own lowers its reliability, and once."""
        is_own = is_own_fault(error)
        search.held.failures[one.key] = text_of(error)
        counts = self._trials.failed(one.key, began=search.decided_at, is_own=is_own)
        if is_own and counts:
            self._offers.lower(one, new_id())

    def _in_use(self, held: HeldChoice) -> Alternative | None:
        """Return the alternative that a choice has; None if neither the file nor a server names it any more."""
        return self._offers.find(held.present, held.request.kind)

    # -- for the trials --------------------------------------------------------------------------------------------

    def _choices(self) -> dict[str, ChoiceState]:
        return {id: self._choice(id, held) for id, held in self._held.items()}

    def _choice(self, id: str, held: HeldChoice) -> ChoiceState:
        allowed = self._allowed_now(id, held)
        present = self._in_use(held)
        breaks = present is not None and present.break_first
        fixed = frozenset(one.key for one in allowed if breaks or one.break_first)
        return ChoiceState(tuple(one.key for one in allowed), held.present, fixed, held.failing)

    def _load_on_trial(self, key: str, on_status: StatusCallback) -> Reply[Query]:
        """Begin to load an alternative, as the least urgent load there is: it takes only room that is free."""
        one = self._offers.find(key)
        if one is None:
            raise UnknownServer(f"{key}: its server is not there any more", server=key, known=())
        server, request, limit_s = loading_of(one)
        return begin_planned(self.registrar, server, request, on_status=on_status, priority=LOWEST, timeout_s=limit_s)

    def _have_taken(self, id: str, key: str) -> None:
        """Have a choice return to an alternative, in its status callback, where a crash can repeat it."""
        with self._lock:
            held = self._held.get(id)
            if held is None or held.moving:
                return
            held.moving = True
        self._tell(id, held, _TAKE + key)

    def _tell(self, id: str, held: HeldChoice, what: str) -> None:
        """Tell a choice of this manager what to do, in its status callback."""
        held.moving = True
        try:
            self.registrar.send_status(id, Status(State.UPDATE, what))
        except RrError as error:
            logger.info("%s: %s, and cannot: %s", held.request.kind, what, error)
            held.moving = False

    # -- what is known ---------------------------------------------------------------------------------------------

    def _forget(self, id: str) -> None:
        self._addresses.close(id)
        with self._lock:
            self._held.pop(id, None)
            self._mend(id)
            self._by_hand.keep_only(self._held)
        if self._trials.standings():
            self._trials.look()

    @functools.cached_property
    def _held(self) -> dict[str, HeldChoice]:
        """The choices by resource id; at first those of the catalog. With the lock."""
        return {
            info.id: held_choice(info.request, info.response, self.registrar.children(info.id))
            for info in self.registrar.resources()
            if info.server == "choice" and info.phase == Phase.LOADED and info.status is not State.FATAL
        }

    @functools.cached_property
    def _offers(self) -> Offers:
        reliabilities = Reliabilities(self.registrar.directory / "reliability.json")
        return Offers(self._given, Labelled(self._rr_node.directory), reliabilities)

    @functools.cached_property
    def _addresses(self) -> Addresses:
        return Addresses(self.registrar.directory, self._relay_hosts)

    @functools.cached_property
    def _by_hand(self) -> ChosenByHand:
        return ChosenByHand(self._record)

    @functools.cached_property
    def _record(self) -> KeptRecord[ChoicesRecord]:
        return KeptRecord(self.registrar.directory / "choices.json", ChoicesRecord)
