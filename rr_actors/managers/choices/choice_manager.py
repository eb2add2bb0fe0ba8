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
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Literal, cast

import msgspec
from msgspec.structs import replace

from rr_actors.base.checks import RELIABILITY, is_number
from rr_actors.base.errors import (
    CircularDependency,
    ConfigError,
    LoadFailed,
    OverCapacity,
    RrError,
    Unavailable,
    UnknownQuery,
    UnknownServer,
)
from rr_actors.base.names import new_id
from rr_actors.base.reporting.log import Log
from rr_actors.base.toml import wrong
from rr_actors.base.values.canonical import encode, shown_plain
from rr_actors.managers.choices.alternatives import Alternative, key_of, read_alternatives
from rr_actors.managers.choices.labelled import Labelled
from rr_actors.managers.choices.matching import ranked, why_none
from rr_actors.managers.choices.planning import Choice, in_turn
from rr_actors.managers.choices.relays import Address, Relays, parse_address
from rr_actors.managers.choices.trials import FAILED, Trials
from rr_actors.managers.planning.kept_record import KeptRecord
from rr_actors.managers.reliability import Reliabilities
from rr_actors.managers.templates import Parameter
from rr_actors.registrar.declarations import server
from rr_actors.registrar.engine.server import current
from rr_actors.registrar.engine.status import Status
from rr_actors.registrar.manager import Manager
from rr_actors.registrar.model.rows import Phase, State
from rr_actors.registrar.queries import Query, StatusCallback
from rr_actors.registrar.registrar import NO_FIELDS

logger = Log("rr_actors.managers.choices")

_TAKE = "returns to "  # and the key of an alternative: the message of a status that a choice gets from its own manager
_AGAIN = "chooses again, as a crash came in between"


class Choose(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The request for the best alternative of a kind.

    Attributes:
        kind: what is needed, such as "range".
        where: what it must provide: `{"rate_hz": ">=10", "place": "roof"}`. A value alone is to be equal.
        prefer: what is better, the most important first: "rate_hz" is more of it, "-cost" less. Of equal alternatives
            the first that was given is better.
        bind: "relay" opens an address that stays, `Chosen.address`, for programs that connect to what is chosen. The
            response of each alternative has to be its own address, or to have it as its field "address":
            "unix:/run/camera.sock" or "tcp:127.0.0.1:5000".
    """

    kind: str
    where: dict[str, Parameter] = {}
    prefer: list[str] = []
    bind: Literal["", "relay"] = ""


class Chosen(msgspec.Struct, frozen=True):
    """The response: the alternative in use, what it provides, and its own response, as plain values.

    When another one takes its place, the response changes, and its holders hear an UPDATE status.

    Attributes:
        address: of the relay, of the same form as the address of the alternative that was chosen first. It stays the
            same. "" without `bind="relay"`.
    """

    server: str
    request: Any
    response: Any
    provides: dict[str, Parameter]
    address: str = ""


class _Held(msgspec.Struct):
    """A choice that is loaded. `moving`: it has been told to return to a better alternative, and has not done so."""

    request: Choose
    present: str
    address: str = ""
    failing: bool = False
    moving: bool = False


class _Broken(msgspec.Struct):
    """The choices whose part has been released before another one was loaded in its place."""

    choices: list[str] = []


class Choices(Manager):
    """Serves `choice`: loads the best alternative of a kind, and another one when that fails.

    The holders hear UPDATE when another alternative takes the place of the one in use, and FATAL when nothing is left;
    that message says for each alternative why not. A better one that is well again for `settle_s` takes its place back.
    """

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
        self._given = self._every = read_alternatives(file_or_alternatives, self._beginning())
        self._labelled_before: tuple[Alternative, ...] = ()
        if not is_number(settle_s) or settle_s < 0:
            raise wrong(None, "settle_s", "a number of seconds, at least 0", settle_s, where="Choices")
        for i, host in enumerate(relay_hosts):
            if not host or not isinstance(host, str):  # pyright: ignore[reportUnnecessaryIsInstance]
                raise wrong(None, f"relay_hosts[{i}]", "the name or number of a host", host, where="Choices")
        self._relay_hosts = tuple(relay_hosts)
        self._relays = Relays()
        self._changed = threading.Condition(threading.RLock())
        self._trials = Trials(
            self._changed,
            settle_s,
            self._choices,
            self._load_on_trial,
            self._have_taken,
            self._has_new_labels,
            self._strays,
        )
        self._begun = ""

    def on_start(self) -> None:
        """Go on with the choices that are held. Trials of the process before are ended, and begin anew."""
        with self._changed:
            held = dict(self._held)
            self._begun = new_id()
        self._restore_relays(held)
        for id in list(self._broken.now.choices):
            if id in held:
                self.registrar.send_status(id, Status(State.UPDATE, _AGAIN))
            else:
                self._mend(id)
        self._trials.start()

    def on_stop(self) -> None:
        """End the thread of the trials, and close the relays."""
        self._trials.stop()
        self._relays.stop()

    # -- the server ------------------------------------------------------------------------------------------------

    @server("choice", recovery="keep")
    def load_choice(self, request: Choose) -> Chosen:
        """Load the best alternative that can be loaded."""
        best = self._allowed(request)
        id, held = current().resource_id, _Held(request, "")
        tried: list[str] = []
        for one in self._in_turn(best, ()):
            try:
                chosen = self._first(id, held, one)
            except RrError as error:
                if current().stopping.is_set():
                    self._relays.close(id)
                    raise
                tried.append(self._not_loaded(one, error))
            else:
                with self._changed:
                    self._held[id] = held
                if one is not best[0]:
                    self._trials.look()
                return chosen
        self._relays.close(id)
        raise LoadFailed(_nothing(request, tried), server=f"{self.registrar.name}/choice")

    @load_choice.unload
    def unload_choice(self, request: Choose, response: Chosen | None) -> None:
        """Forget the choice; the registrar releases its part."""
        self._forget(current().resource_id)

    @load_choice.status
    def choice_status(self, request: Choose, status: Status) -> None:
        """Put the next best alternative in the place of one that has failed, or a better one that is well again."""
        id = current().resource_id
        with self._changed:
            held = self._held.get(id)
        try:
            if status.resource_id == id:
                self._hear_own(id, held, status)
            else:
                self._hear_part(id, held, status)
        except UnknownQuery:  # the choice is being unloaded
            status.handled()

    # -- hearing ---------------------------------------------------------------------------------------------------

    def _hear_part(self, id: str, held: _Held | None, status: Status) -> None:
        part = next((part for part in self.registrar.children(id) if part.id == status.query_id), None)
        if part is None or held is None:
            status.handled()  # a run before a crash has dealt with it
        elif status.state in FAILED:
            self._replace(id, held, status, part)
        elif status.state is not State.UPDATE:
            held.failing = False
        elif (one := self._in_use(held)) is not None:
            self._hear_response(id, held, one, part, status)

    def _hear_response(self, id: str, held: _Held, one: Alternative, part: Query, status: Status) -> None:
        """Pass on a new response of the part; if it has no address and needs one, replace the part."""
        try:
            chosen = self._made(id, held, one, part)
        except (ConfigError, Unavailable) as error:
            logger.warning("%s: %s", one.key, error)
            self._replace(id, held, status, part)
            return
        self.registrar.update_response(id, chosen, status.message)
        self._point(id, chosen)
        status.handled()

    def _hear_own(self, id: str, held: _Held | None, status: Status) -> None:
        """Do what this manager has told a choice to do; other statuses of the choice are for its holders."""
        if status.state is State.FATAL:
            self._forget(id)
        elif status.message == _AGAIN:
            status.handled()
            if held is not None:
                self._choose_again(id, held, status)
        elif status.message.startswith(_TAKE):
            status.handled()
            if held is not None:
                self._return(id, held, status.message.removeprefix(_TAKE), status)

    # -- replacing -------------------------------------------------------------------------------------------------

    def _return(self, id: str, held: _Held, key: str, status: Status) -> None:
        """Put a better alternative in the place of the one in use."""
        kind = held.request.kind
        try:
            parts = self.registrar.children(id)
            better = self._find(kind, key)
            if key != held.present and better is not None and parts:  # else a run before a crash has done it
                self._put(id, held, better, status, parts[0])
                logger.info("%s: returns to %s", kind, key)
        except RrError as error:
            logger.warning("%s: cannot return to %s: %s", kind, key, error)
            self._trials.failed(key)
        finally:
            held.moving = False
            self._trials.look()

    def _replace(self, id: str, held: _Held, status: Status, part: Query) -> None:
        """Put the next best alternative in the place of one that has failed; give up if there is none."""
        failed, said = held.present, status.message or str(status.state)
        if status.reason != "revoked":
            self._lower(self._in_use(held), status.resource_id)
        self._trials.failed(failed)
        tried = [f"{failed}: {said}"]
        if self._fill(id, held, status, part, {failed}, tried):
            logger.warning("%s: %s takes the place of %s: %s", held.request.kind, held.present, failed, said)
        elif self._is_broken(id) or (status.state is State.FATAL and status.reason != "revoked"):
            self._give_up(id, held, status, tried)
        else:  # with ERROR it may be of some use still; a part that is revoked takes the choice with it
            held.failing = True
            logger.warning("%s", _nothing(held.request, tried))
        self._trials.look()

    def _choose_again(self, id: str, held: _Held, status: Status) -> None:
        """Choose anew after a crash, when one had been released and it is not known how far the next one had come."""
        for part in self.registrar.children(id):
            self._release(part)
        tried: list[str] = []
        if not self._fill(id, held, status, None, (), tried):
            self._give_up(id, held, status, tried)
        self._trials.look()

    def _fill(
        self, id: str, held: _Held, status: Status, part: Query | None, without: Collection[str], tried: list[str]
    ) -> bool:
        """Put the first alternative that can be loaded in the place of the part; `tried` gets why others cannot.

        Return whether there was one.
        """
        present = self._in_use(held)
        breaks = present is not None and present.break_first
        for one in self._in_turn(self._allowed_now(held.request), without):
            if part is not None and (breaks or one.break_first):
                self._break(id, part)
                part = None
            try:
                self._put(id, held, one, status, part)
                return True
            except UnknownQuery:
                raise
            except RrError as error:
                tried.append(self._not_loaded(one, error))
        return False

    def _put(self, id: str, held: _Held, one: Alternative, status: Status, part: Query | None) -> None:
        """Load an alternative in the place of the part, or as the part of a choice that has none now."""
        made, request = functools.partial(self._made, id, held, one), _request_of(one)
        if part is not None:
            limit_s = one.timeout_s
            query = self.registrar.replace_part(
                status, request, one.server, part=part, response=made, timeout_s=limit_s
            )
        else:
            query = self.registrar.load(one.server, request, timeout_s=one.timeout_s)
            try:
                self.registrar.update_response(id, made(query), f"{one.key} takes the place of another one")
            except RrError:
                self._release(query)
                raise
            self._mend(id)
            status.handled()
        held.present, held.failing = one.key, False
        self._point(id, made(query))

    def _give_up(self, id: str, held: _Held, status: Status, tried: Sequence[str]) -> None:
        text = _nothing(held.request, tried)
        logger.warning("%s", text)
        self._forget(id)
        self.registrar.send_status(id, Status(State.FATAL, text))
        status.handled()

    def _break(self, id: str, part: Query) -> None:
        """Release the part. It is on disk before that the choice has none, and so a crash does not leave it so."""
        with self._changed:
            self._broken.now.choices.append(id)
            self._broken.save()
        self._relays.point(id, None)
        self._release(part)

    def _is_broken(self, id: str) -> bool:
        with self._changed:
            return id in self._broken.now.choices

    def _mend(self, id: str) -> None:
        with self._changed:
            if id in self._broken.now.choices:
                self._broken.now.choices = [other for other in self._broken.now.choices if other != id]
                self._broken.save()

    def _release(self, part: Query) -> None:
        try:
            part.unload_if_held()
        except RrError as error:
            logger.warning("%s cannot be released: %s", part.server_id, error)

    # -- relays ----------------------------------------------------------------------------------------------------

    def _first(self, id: str, held: _Held, one: Alternative) -> Chosen:
        """Load an alternative as the part of a new choice, and open its relay if it is to have one."""
        query = self.registrar.load(one.server, _request_of(one), timeout_s=one.timeout_s)
        try:
            chosen = self._made(id, held, one, query)
        except RrError:
            self._release(query)
            raise
        held.present = one.key
        self._point(id, chosen)
        return chosen

    def _made(self, id: str, held: _Held, one: Alternative, query: Query) -> Chosen:
        """Return the response of a choice with this part.

        Raises:
            ConfigError: it is to have a relay, and the part's response has no address that a relay may connect to.
            Unavailable: the relay cannot be opened.
        """
        chosen = _chosen(one, query)
        if held.request.bind:
            source = self._source_of(chosen)
            held.address = held.address or str(self._relays.open(id, self._new_address(id, source)))
            chosen = replace(chosen, address=held.address)
        return chosen

    def _new_address(self, id: str, source: Address) -> Address:
        return Address("127.0.0.1") if source.port else Address(str(self.registrar.directory / f"{id[-12:]}.sock"))

    def _source_of(self, chosen: Chosen) -> Address:
        given: object = chosen.response
        if isinstance(given, dict):
            given = cast("dict[str, object]", given).get("address")
        return parse_address(given, self._relay_hosts)

    def _point(self, id: str, chosen: Chosen) -> None:
        if chosen.address:
            self._relays.point(id, self._source_of(chosen))

    def _restore_relays(self, held: Mapping[str, _Held]) -> None:
        """Open the relays at the addresses that programs know; a choice is lost if that is not possible."""
        for info in self.registrar.resources():
            if info.id in held and info.response.address:
                try:
                    self._relays.open(info.id, parse_address(info.response.address))
                    self._point(info.id, info.response)
                except RrError as error:
                    self.registrar.send_status(info.id, Status(State.FATAL, f"its relay is lost: {error}"))

    # -- choosing --------------------------------------------------------------------------------------------------

    def reliability(self, alternative: Alternative) -> float:
        """Return how far an alternative is trusted now, from 0 to 1."""
        with self._changed:
            return self._reliabilities.of(alternative.key, float(alternative.provides.get(RELIABILITY, 1.0)))

    def _allowed(self, request: Choose) -> list[Alternative]:
        """Return the alternatives that a choice allows, the best first.

        Raises:
            ConfigError: the choice is wrong. `.key`, `.expected`, `.got`
            LoadFailed: no alternative is allowed; it says why not.
        """
        of = (self._alternatives(), request.kind, request.where)
        found = ranked(*of, request.prefer, self.reliability)
        if not found:
            raise LoadFailed(_nothing(request, why_none(*of, self.reliability).splitlines()))
        return found

    def _allowed_now(self, request: Choose) -> list[Alternative]:
        """Return what a choice that was made before allows: the file may have changed, and nothing may be left."""
        try:
            return self._allowed(request)
        except (ConfigError, LoadFailed):
            return []

    def _in_turn(self, best: Sequence[Alternative], without: Collection[str]) -> list[Alternative]:
        order = in_turn([one.key for one in best], self._trials.standings(), without, time.monotonic())
        by_key = {one.key: one for one in best}
        return [by_key[key] for key in order]

    def _not_loaded(self, one: Alternative, error: RrError) -> str:
        """Note that an alternative cannot be loaded, and return why. Only a fault of its own lowers its reliability."""
        if isinstance(error, LoadFailed) and not isinstance(error, (CircularDependency, OverCapacity)):
            self._lower(one, new_id())
        self._trials.failed(one.key)
        return f"{one.key}: {error}"

    def _lower(self, one: Alternative | None, failure_id: str) -> None:
        if one is not None:
            with self._changed:
                self._reliabilities.lower(one.key, float(one.provides.get(RELIABILITY, 1.0)), failure_id)

    def _in_use(self, held: _Held) -> Alternative | None:
        """Return the alternative that a choice has; None if neither the file nor a server names it any more."""
        return self._find(held.request.kind, held.present)

    def _find(self, kind: str, key: str) -> Alternative | None:
        return next((one for one in self._alternatives() if (one.kind, one.key) == (kind, key)), None)

    def _alternatives(self) -> tuple[Alternative, ...]:
        """Return the alternatives that were given, and those of servers' labels that are no others' as well."""
        with self._changed:
            labelled = self._labelled.alternatives()
            if labelled is not self._labelled_before:
                known = {(one.kind, one.key) for one in self._given}
                more = tuple(one for one in labelled if (one.kind, one.key) not in known)
                self._labelled_before, self._every = labelled, (*self._given, *more)
            return self._every

    def _has_new_labels(self) -> bool:
        return self._labelled.has_changed()

    def _strays(self) -> list[Query]:
        """Return what the process before has loaded on trial: ids grow with the time at which they are made."""
        return [query for query in self.registrar.queries() if not query.parent and query.id < self._begun]

    # -- for the trials --------------------------------------------------------------------------------------------

    def _choices(self) -> dict[str, Choice]:
        return {id: self._choice(held) for id, held in self._held.items()}

    def _choice(self, held: _Held) -> Choice:
        allowed = self._allowed_now(held.request)
        present = self._in_use(held)
        breaks = present is not None and present.break_first
        fixed = frozenset(one.key for one in allowed if breaks or one.break_first)
        return Choice(tuple(one.key for one in allowed), held.present, fixed, held.failing)

    def _load_on_trial(self, key: str, on_status: StatusCallback) -> Query:
        """Load an alternative, as urgently as the choices that would have it."""
        with self._changed:
            wanting = {id for id, choice in self._choices().items() if key in choice.better()}
        numbers = [info.priority for info in self.registrar.resources() if info.id in wanting]
        priority = max((number for number in numbers if number is not None), default=None)
        one = next((one for one in self._alternatives() if one.key == key), None)
        if one is None:
            raise UnknownServer(f"{key}: its server is not there any more", server=key, known=())
        limit_s = one.timeout_s
        return self.registrar.load(
            one.server, _request_of(one), on_status=on_status, priority=priority, timeout_s=limit_s
        )

    def _have_taken(self, id: str, key: str) -> None:
        """Have a choice return to an alternative, in its status callback, where a crash can repeat it."""
        with self._changed:
            held = self._held.get(id)
            if held is None or held.moving:
                return
            held.moving = True
        try:
            self.registrar.send_status(id, Status(State.UPDATE, _TAKE + key))
        except RrError as error:
            logger.info("%s: does not return to %s: %s", held.request.kind, key, error)
            held.moving = False

    # -- what is known ---------------------------------------------------------------------------------------------

    def _forget(self, id: str) -> None:
        self._relays.close(id)
        with self._changed:
            self._held.pop(id, None)
            self._mend(id)
        if self._trials.standings():
            self._trials.look()

    @functools.cached_property
    def _held(self) -> dict[str, _Held]:
        """The choices by resource id; at first those of the catalog. With the lock."""
        return {
            info.id: _held(info.request, info.response)
            for info in self.registrar.resources()
            if info.server == "choice" and info.phase == Phase.LOADED and info.status is not State.FATAL
        }

    @functools.cached_property
    def _labelled(self) -> Labelled:
        return Labelled(self._node.directory)

    @functools.cached_property
    def _broken(self) -> KeptRecord[_Broken]:
        return KeptRecord(self.registrar.directory / "choices.json", _Broken)

    @functools.cached_property
    def _reliabilities(self) -> Reliabilities:
        return Reliabilities(self.registrar.directory / "reliability.json")


def _request_of(one: Alternative) -> Any:
    return NO_FIELDS if one.request is None else one.request


def _held(request: Choose, chosen: Chosen) -> _Held:
    return _Held(request, key_of(chosen.server, chosen.request), chosen.address)


def _chosen(one: Alternative, query: Query) -> Chosen:
    request, response = (shown_plain(encode(value)) for value in (one.request, query.response))
    return Chosen(one.server, request, response, one.provides)


def _nothing(request: Choose, why: Sequence[str]) -> str:
    return "\n".join([f"nothing is left for {request.kind!r}:", *why])
