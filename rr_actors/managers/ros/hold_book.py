"""HoldBook: which node of ROS holds what, since when, and until when. Pure: callers give it the time and the graph.

A message comes in, and actions go out: begin a load, withdraw it, release a query, answer, tell a status. A hold is
known by its owner and the id that the owner has chosen. The same id again is the same hold, so that an owner may send
a message again whose answer has been lost.
"""

from __future__ import annotations

import fnmatch
import itertools
import math
from collections import OrderedDict
from collections.abc import Collection, Iterator
from typing import Any, Literal

import msgspec

from rr_actors.base.errors import (
    LoadFailed,
    NotAllowed,
    RrError,
    Unavailable,
    UnknownQuery,
    did_you_mean,
    few,
    shortened,
    shown,
)
from rr_actors.managers.ros.ros_config import Json
from rr_actors.managers.ros.ros_messages import Key, Load, Renew, Unload, Verb, invalid

OWNER_S = 3.0
"""How long a load waits until its owner is in the graph: a new node is seen a little later than its first message."""
GONE_S = 2.0
"""How long an owner must be missing in the graph before it is gone."""
RESTORED_S = 10.0
"""The same after a start of the bridge, which finds the nodes anew."""
RETRY_S = 10.0
"""How long after a release that failed the next one follows."""
MOST_ENDED = 10_000
"""So many ids of holds that have ended are remembered: a late message must not load again."""


class Lease(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The request to the bridge's own server `lease`: what is loaded is its part. So the catalog has all holds."""

    owner: str
    id: str
    server: str
    request: Any
    lease_s: float | None = None
    priority: int | None = 0

    def __rr_title__(self) -> str:
        return f"{self.owner or 'switch'} {self.id}: {self.server}"

    @property
    def key(self) -> Key:
        """What the hold is known by."""
        return self.owner, self.id


# -- actions ---------------------------------------------------------------------------------------------------------


class Begin(msgspec.Struct, frozen=True):
    """Load the lease. Its end comes by loaded() or failed(), with the same number."""

    number: int
    lease: Lease


class Withdraw(msgspec.Struct, frozen=True):
    """Withdraw the load of this number."""

    number: int


class Release(msgspec.Struct, frozen=True):
    """Release the query. Its end comes by released(), with the same number."""

    number: int
    query: str


class Answer(msgspec.Struct, frozen=True):
    """Answer a message."""

    verb: Verb
    key: Key
    error: RrError | None = None
    query: str = ""
    response: Any = None


class Say(msgspec.Struct, frozen=True):
    """Tell a status of a hold: the words of a Status, or "lease_ended" or "owner_gone" as its reason."""

    key: Key
    query: str
    state: str
    message: str
    source: str = ""
    reason: str = ""
    response: Any = None


Action = Begin | Withdraw | Release | Answer | Say


class Hold(msgspec.Struct):
    """One hold.

    Attributes:
        phase: "awaited": its owner is not in the graph yet.
        until: when its lease ends, or the wait for its owner; None: never.
        gone_since: since when its owner is missing; `gone_s`: how long it may be.
        is_asked: whether somebody waits for the answer of its release.
    """

    number: int
    lease: Lease
    phase: Literal["awaited", "loading", "held", "releasing"]
    until: float | None
    gone_s: float = GONE_S
    gone_since: float | None = None
    query: str = ""
    response: Any = None
    state: str = "OK"
    is_asked: bool = False


class HoldBook:
    """The holds of one bridge. Not thread-safe."""

    def __init__(self, json: Json | None, load_topic: str = "load", own_server: str = "") -> None:
        """Make an empty book.

        Args:
            own_server: that of the leases, which no node may load from: what is in a lease is not checked again.
        """
        self._json, self._topic, self._own_server = json, load_topic, own_server
        self._holds: dict[Key, Hold] = {}
        self._owed: dict[int, tuple[str, float]] = {}  # releases that no hold waits for: the query, when it is due
        self._ended: OrderedDict[Key, str] = OrderedDict()
        self._numbers = itertools.count(1)

    def holds(self) -> list[Hold]:
        """Return all holds."""
        return list(self._holds.values())

    def hold(self, key: Key) -> Hold | None:
        """Return a hold; None if there is none."""
        return self._holds.get(key)

    @property
    def awaits(self) -> bool:
        """Whether a load waits for its owner to be in the graph."""
        return any(hold.phase == "awaited" for hold in self._holds.values())

    # -- what nodes ask ------------------------------------------------------------------------------------------------

    def load(self, asked: Load, now: float, nodes: Collection[str]) -> list[Action]:
        """Handle that a node wants a resource, maybe again."""
        key = (asked.owner, asked.id)
        hold = self._holds.get(key)
        if hold is None:
            return self._first_load(asked, now, nodes)
        if (hold.lease.server, hold.lease.request) != (asked.server, asked.request):
            expected = f"another id for another request: {asked.owner} holds {hold.lease.server} by this one"
            return [Answer("load", key, invalid(self._topic, "id", expected, asked.id))]
        if hold.phase == "releasing":
            return [Answer("load", key, self._unknown(key, "it is being released"))]
        if hold.phase != "awaited":
            self._renew(hold, now)
        return [Answer("load", key, None, hold.query, hold.response)] if hold.phase == "held" else []

    def _first_load(self, asked: Load, now: float, nodes: Collection[str]) -> list[Action]:
        key = (asked.owner, asked.id)
        if key in self._ended:
            return [Answer("load", key, self._unknown(key, f"{self._ended[key]}; expected a new id"))]
        try:
            self._check_allowed(asked)
        except RrError as error:
            return [Answer("load", key, error)]
        lease = Lease(asked.owner, asked.id, asked.server, asked.request, asked.lease_s, asked.priority)
        hold = Hold(next(self._numbers), lease, "awaited", now + OWNER_S)
        self._holds[key] = hold
        return [self._begin(hold, now)] if asked.owner in nodes else []

    def switch_on(self, name: str, server: str, request: Any, priority: int | None, now: float) -> list[Action]:
        """Load the resource of a switch. One that is lost is released, and loaded anew."""
        key = ("", name)
        hold = self._holds.get(key)
        before: list[Action] = []
        if hold is not None and hold.phase == "held" and hold.state != "FATAL":
            return [Answer("load", key, None, hold.query, hold.response)]
        if hold is not None and hold.phase == "loading":
            return []
        if hold is not None:
            before = [Release(hold.number, hold.query)] if hold.phase == "held" else [Answer("unload", key)]
            self._owed[hold.number] = hold.query, math.inf
        hold = Hold(next(self._numbers), Lease("", name, server, request, None, priority), "loading", None)
        self._holds[key] = hold
        return [*before, self._begin(hold, now)]

    def switch_off(self, name: str) -> list[Action]:
        """Release the resource of a switch, if it is held."""
        hold = self._holds.get(("", name))
        return [Answer("unload", ("", name))] if hold is None else self._unload(hold)

    def unload(self, asked: Unload) -> list[Action]:
        """Handle that a node needs a resource no more. For a hold that has ended, that is done already."""
        key = (asked.owner, asked.id)
        hold = self._holds.get(key)
        if hold is not None:
            return self._unload(hold)
        return [Answer("unload", key, None if key in self._ended else self._unknown(key))]

    def renew(self, asked: Renew, now: float) -> list[Action]:
        """Handle that a node still needs a resource."""
        key = (asked.owner, asked.id)
        hold = self._holds.get(key)
        if hold is None or hold.phase == "releasing":
            return [Answer("renew", key, self._unknown(key, self._ended.get(key, "")))]
        if hold.phase != "awaited":
            self._renew(hold, now)
        return [Answer("renew", key, None, hold.query, hold.response)]

    def _unload(self, hold: Hold) -> list[Action]:
        hold.is_asked = True
        if hold.phase == "releasing":
            return []
        if hold.phase == "held":
            hold.phase = "releasing"
            return [Release(hold.number, hold.query)]
        why = "it was released while it was loading"
        return [*self._withdrawn(hold, why), Answer("unload", hold.lease.key)]

    def _withdrawn(self, hold: Hold, why: str) -> list[Action]:
        """End a hold that is not loaded yet."""
        self._end(hold, why)
        error = LoadFailed(f"{hold.lease.server}: {why}", server=hold.lease.server)
        withdraw: list[Action] = [Withdraw(hold.number)] if hold.phase == "loading" else []
        return [*withdraw, Answer("load", hold.lease.key, error)]

    # -- what happens --------------------------------------------------------------------------------------------------

    def interrupted(self, lease: Lease, now: float) -> list[Action]:
        """Go on with a load that a process before this one has begun."""
        hold = self._holds[lease.key] = Hold(next(self._numbers), lease, "loading", None, RESTORED_S)
        return [self._begin(hold, now)]

    def restored(self, lease: Lease, query: str, response: Any, state: str, now: float) -> int:
        """Go on with a hold of a process before this one. Return its number."""
        hold = Hold(next(self._numbers), lease, "held", None, RESTORED_S)
        hold.query, hold.response, hold.state = query, response, state
        self._renew(hold, now)
        self._holds[lease.key] = hold
        return hold.number

    def is_exposed(self, lease: Lease, switches: Collection[str]) -> bool:
        """Return whether a hold of a process before this one is still exposed by the configuration."""
        if not lease.owner:
            return lease.id in switches
        return lease.key not in self._holds and self._json is not None and self._allows(self._json, lease.server)

    def loaded(self, number: int, query: str, response: Any, now: float) -> list[Action]:
        """Handle that a load has succeeded. If nobody wants it any more, release it."""
        hold = self._of(number)
        if hold is None or hold.phase != "loading":
            self._owed[number] = query, math.inf
            return [Release(number, query)]
        hold.phase, hold.query, hold.response = "held", query, response
        self._renew(hold, now)
        return [Answer("load", hold.lease.key, None, query, response)]

    def failed(self, number: int, error: RrError) -> list[Action]:
        """Handle that a load has failed. Its id may be used again: nothing was held."""
        hold = self._of(number)
        if hold is None:
            return []
        del self._holds[hold.lease.key]
        return [Answer("load", hold.lease.key, error)]

    def released(self, number: int, error: RrError | None, now: float) -> list[Action]:
        """Handle that a release has ended. If it is owed to a provider, it is done for the owner."""
        hold, is_done = self._of(number), error is None or isinstance(error, (UnknownQuery, Unavailable))
        if hold is None:
            owed = self._owed.pop(number, None)
            if owed is not None and not is_done:
                self._owed[number] = owed[0], now + RETRY_S
            return []
        if is_done:
            self._end(hold, "it has been released")
            return [Answer("unload", hold.lease.key)] if hold.is_asked else []
        hold.phase, hold.until = "held", None if hold.lease.lease_s is None else now + RETRY_S
        hold.gone_since, hold.gone_s = None, RETRY_S
        answer = Answer("unload", hold.lease.key, error, hold.query)
        is_asked, hold.is_asked = hold.is_asked, False
        return [answer] if is_asked else []

    def heard(self, number: int, said: Say) -> list[Action]:
        """Handle a status of a hold; `said` comes without its key."""
        hold = self._of(number)
        if hold is None:
            return []
        hold.state = "FATAL" if hold.state == "FATAL" else said.state
        if said.response is not None:
            hold.response = said.response
        return [msgspec.structs.replace(said, key=hold.lease.key)]

    def tick(self, now: float, nodes: Collection[str]) -> list[Action]:
        """Handle that time has passed: end what nobody holds any more."""
        due = [(number, query) for number, (query, at) in self._owed.items() if now >= at]
        self._owed.update((number, (query, math.inf)) for number, query in due)
        again = [Release(number, query) for number, query in due]
        return [*again, *(action for hold in self.holds() for action in self._looked_at(hold, now, nodes))]

    def owe(self, query: str) -> list[Action]:
        """Release a query that no hold has, again and again until it is released."""
        number = next(self._numbers)
        self._owed[number] = query, math.inf  # until its end is heard
        return [Release(number, query)]

    def _looked_at(self, hold: Hold, now: float, nodes: Collection[str]) -> Iterator[Action]:
        owner, is_over = hold.lease.owner, hold.until is not None and now >= hold.until
        if hold.phase == "awaited":
            if owner in nodes:
                yield self._begin(hold, now)
            elif is_over:
                del self._holds[hold.lease.key]
                expected = f"the full name of a node in the graph{did_you_mean(owner, nodes)}"
                yield Answer("load", hold.lease.key, invalid(self._topic, "owner", expected, owner))
            return
        if not owner or hold.phase == "releasing":
            return
        if owner in nodes:
            hold.gone_since, hold.gone_s = None, GONE_S
        elif hold.gone_since is None:
            hold.gone_since = now
        elif now - hold.gone_since >= hold.gone_s:
            yield from self._ended_by_itself(hold, "owner_gone", f"node {owner} has left the graph")
            return
        if is_over:
            text = f"the lease of {hold.lease.lease_s:g} s was not renewed"
            yield from self._ended_by_itself(hold, "lease_ended", text)

    def _ended_by_itself(self, hold: Hold, reason: str, text: str) -> list[Action]:
        said = Say(hold.lease.key, hold.query, "FATAL", text, reason=reason)
        if hold.phase == "held":
            hold.phase = "releasing"
            return [said, Release(hold.number, hold.query)]
        return [said, *self._withdrawn(hold, text)]

    # ------------------------------------------------------------------------------------------------------------------

    def _begin(self, hold: Hold, now: float) -> Begin:
        hold.phase = "loading"
        self._renew(hold, now)
        return Begin(hold.number, hold.lease)

    def _renew(self, hold: Hold, now: float) -> None:
        hold.until = None if hold.lease.lease_s is None else now + hold.lease.lease_s

    def _of(self, number: int) -> Hold | None:
        return next((hold for hold in self._holds.values() if hold.number == number), None)

    def _end(self, hold: Hold, why: str) -> None:
        del self._holds[hold.lease.key]
        if hold.lease.owner:
            self._ended[hold.lease.key] = why
            while len(self._ended) > MOST_ENDED:
                self._ended.popitem(last=False)

    def _check_allowed(self, asked: Load) -> None:
        """Raise the error for what the configuration does not allow."""
        if self._json is None or asked.server == self._own_server or not self._allows(self._json, asked.server):
            allowed = () if self._json is None else self._json.allow
            hint = did_you_mean(asked.server, [one for one in allowed if "*" not in one])
            text = f"{self._topic}: server: expected one of {few(allowed) or 'none'}, got {shown(asked.server)}{hint}"
            raise NotAllowed(text, server=shortened(asked.server), allowed=allowed)
        if asked.priority is not None and asked.priority > self._json.max_priority:
            expected = f"{self._json.max_priority} at most, the bridge's max_priority"
            raise invalid(self._topic, "priority", expected, asked.priority)

    @staticmethod
    def _allows(json: Json, server: str) -> bool:
        return any(fnmatch.fnmatchcase(server, pattern) for pattern in json.allow)

    def _unknown(self, key: Key, why: str = "") -> UnknownQuery:
        owner, id = key
        known = [other for of, other in self._holds if of == owner]
        why = why or f"its ids are {few(known) or 'none'}"
        return UnknownQuery(f"{owner} holds nothing by the id {shown(id)}: {why}", query_id=id)
