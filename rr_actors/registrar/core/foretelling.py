"""What a registrar would decide after a restart, or about statuses: its decisions on a copy of what it knows. Pure.

Each callback returns what it returned before, and deals with no status. Nothing else happens meanwhile, so a load that
is interrupted ends nowhere here.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

from msgspec import Struct

from rr_actors.registrar.core.decide import Item, decide
from rr_actors.registrar.core.status_delivery import is_listened
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.catalog import Catalog
from rr_actors.registrar.model.effects import Effect, Hear, SetTimer, StartCallback
from rr_actors.registrar.model.messages import Noticed
from rr_actors.registrar.model.rows import Content, Notice, Resource, State

End = Literal["crash", "stop"]
"""How the process of the registrar ends before it is started again."""

_MOST = 100_000  # decisions
_MEMORY = (
    "servers", "up", "consumers", "listened", "in_flight", "heard", "hearing", "next_to_hear", "deferred", "statuses",
    "recovering", "ending", "told", "behind", "early", "fresh", "direct", "kept",
)  # fmt: skip
"""What is in memory only, and decisions about statuses need."""


class Known(NamedTuple):
    """A copy of what a registrar knows."""

    name: str
    epoch: int
    content: Content
    memory: dict[str, Any]

    def catalog(self, epoch: int) -> Catalog:
        """Return a catalog with these rows, which decisions may change."""
        content: Any = {table: rows.copy() for table, rows in self.content.items()}
        return Catalog(self.name, content, epoch)


class Fate(Struct, frozen=True):
    """What becomes of a resource.

    Attributes:
        becomes: "recovered" by its recover callback, "loaded again", "lost", "unloaded"; or the state that it gets.
        message: of the status that says so.
    """

    resource: Resource
    becomes: str
    message: str = ""


class HeardStatus(Struct, frozen=True):
    """A status that a registrar hears of a query that it holds for itself, or that somebody listens to.

    Attributes:
        server: "registrar/server" of the resource; `request`: its request.
        listens: whether a callback of the holder hears it; else only the query's state says it.
    """

    query_id: str
    server: str
    request: bytes
    state: str
    message: str
    listens: bool


class Foretold(Struct, frozen=True):
    """What one registrar would do.

    Attributes:
        fates: of the resources of which something becomes; `kept`: how many stay as they are.
        heard: the statuses that it hears. `notices`: those that it sends to the holders of its resources.
    """

    fates: tuple[Fate, ...] = ()
    kept: int = 0
    heard: tuple[HeardStatus, ...] = ()
    notices: tuple[Notice, ...] = ()


def known_of(catalog: Catalog) -> Known:
    """Return a copy of what decisions need. The caller has the registrar's lock."""
    content: Any = {table: rows.copy() for table, rows in catalog.tables.items()}
    return Known(catalog.name, catalog.epoch, content, {name: getattr(catalog, name).copy() for name in _MEMORY})


def foretell_restart(known: Known, end: End) -> Foretold:
    """Return what a registrar would do with its resources when its process has ended, and is started again."""
    course = _Course(known.catalog(known.epoch + 1))
    if end == "stop":
        course.run([(c.EndProcess(), None)])
    course.run([(c.BeginAgain(), None)])
    for server in known.memory["servers"].values():
        course.run([(c.Register(server, f"foretold:{server.name}"), None)])
    course.run([(c.BeginServing("foretold"), None)])
    return course.foretold(known)


def foretell_statuses(known: Known, provider: str, notices: Iterable[Notice]) -> Foretold:
    """Return what a registrar would do about statuses of the queries that it holds at a provider."""
    catalog = known.catalog(known.epoch)
    for name, value in known.memory.items():
        setattr(catalog, name, value.copy())
    course = _Course(catalog)
    course.run([(Noticed(notice), provider) for notice in notices])
    return course.foretold(known)


class _Course:
    """Decisions one after another, with all that follows from their effects."""

    def __init__(self, catalog: Catalog) -> None:
        self._catalog = catalog
        self._ran: dict[str, str] = {}  # by resource, what the last callback says of it
        self._heard: list[HeardStatus] = []

    def run(self, items: Sequence[Item]) -> None:
        ahead = deque[Effect](self._decided(items))
        for _ in range(_MOST):
            if not ahead:
                return
            ahead += self._decided(self._answer(ahead.popleft()))

    def _decided(self, items: Sequence[Item]) -> list[Effect]:
        if not items:
            return []
        decision = decide(self._catalog, items)
        decision.close()
        return decision.effects

    def _answer(self, effect: Effect) -> list[Item]:
        """Return what follows from an effect: the callback returns, a listener has heard a status."""
        match effect:
            case StartCallback():
                return self._returned(effect)
            case Hear(held, notice):
                listens = is_listened(self._catalog, held)
                if listens or not held.parent:
                    place = held.id, f"{held.registrar}/{held.server}", held.request
                    self._heard.append(HeardStatus(*place, str(notice.state), notice.message, listens))
                return [(c.Heard(held.id, notice.event, False, False), None)]
            case SetTimer(_, 0.0, command):  # the next callback's turn
                return [(command, None)]
            case _:
                return []

    def _returned(self, effect: StartCallback) -> list[Item]:
        resource, role = effect.resource, effect.role
        match role:
            case "recover":
                self._ran[resource.id] = "loaded again" if effect.reload else "recovered"
                ended = c.CallbackEnded(
                    role, resource.id, resource.attempt, None, resource.response, f"foretold:{resource.id}"
                )
            case "load":
                self._ran[resource.id] = "loaded again"
                return []
            case "unload":
                self._ran[resource.id] = "unloaded"
                ended = c.CallbackEnded(role, resource.id, resource.tries)
            case "reload":
                ended = c.CallbackEnded(role, resource.id, resource.attempt, event=f"foretold:{resource.id}")
            case "status":
                ended = c.CallbackEnded(role, resource.id, notice=effect.notice)
            case _:
                return []
        return [(ended, None)]

    def foretold(self, known: Known) -> Foretold:
        """Return what is different from what the registrar knows."""
        before: dict[str, Resource] = known.content["resources"]
        fates = [fate for row in before.values() if (fate := self._fate(row)) is not None]
        told = known.content["notices"]
        notices = [one for id, one in self._catalog.notices.items() if id not in told and one.origin]
        return Foretold(tuple(fates), len(before) - len(fates), tuple(self._heard), tuple(notices))

    def _fate(self, before: Resource) -> Fate | None:
        after = self._catalog.resources.get(before.id)
        if after is None:
            return Fate(before, "unloaded")
        if after.state is not before.state:
            return Fate(before, "lost" if after.state is State.FATAL else str(after.state), after.message)
        if (becomes := self._ran.get(before.id)) is not None:
            return Fate(before, becomes)
        return None
