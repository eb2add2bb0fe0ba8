"""Watch: what the pages know of one system, as it is and as it was in the last minutes.

Two threads wait for the system: one hears its events, one asks for the rows that a page can show. The pages wait for
neither. They see that `version` has changed, and show the newest moment.
"""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TypeVar

import msgspec

from rr_actors.base.errors import RrError
from rr_actors.registrar.pages import ResourceRow
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.console_client import NotRunning
from rr_actors.tools.terminal.console_link import ConsoleLink

GROUPED_FROM = 300
"""From so many resources on, a picture shows registrars in place of resources."""
_SAMPLE = 20
_SAMPLED = 50
CHILDREN = 1000
"""The most children that a picture shows."""
KEPT_S = 600.0
_KEPT = 3000
"""How long moments are kept, and how many at most. A moment shares what has not changed with the one before."""
_EVENTS_KEPT = 1000
_TREE_S = 0.1
_NEWS_S = 0.4
_SELDOM_S = 2.0
"""The shortest time between two looks after a child's event, and after a resource's; the longest time between two."""
_SHARE = 10
_LONGEST_S = 5.0
_AGAIN_S = 0.5
_LOOK_S = 10.0

_Row = TypeVar("_Row", c.ChildRow, c.RegistrarRow, ResourceRow)


@dataclass(frozen=True)
class Moment:
    """A system at one time.

    Attributes:
        at: seconds since the epoch.
        resources: all of them, if there are few; else the first of each registrar.
        total: how many resources there are.
        problem: why there is no system, or why it does not answer; "" if it is there.
    """

    at: float
    children: tuple[c.ChildRow, ...] = ()
    registrars: tuple[c.RegistrarRow, ...] = ()
    resources: tuple[ResourceRow, ...] = ()
    total: int = 0
    problem: str = ""

    def says_the_same(self, other: Moment) -> bool:
        """Whether only the time is another."""
        return (self.problem, self.total, self.children, self.registrars, self.resources) == (
            other.problem,
            other.total,
            other.children,
            other.registrars,
            other.resources,
        )


@dataclass
class Watch:
    """The watch of the system in one state directory, also over its restarts. The threads run from start() to stop().

    Attributes:
        link: for questions and commands of a page.
        moments: the last minutes, oldest first, never empty; one for each change.
        events: the newest.
        heard: how many events there were.
        version: grows with everything that a page could show anew.
    """

    state_dir: str | os.PathLike[str] | None
    moments: deque[Moment] = field(default_factory=lambda: deque([Moment(0.0, problem="not asked yet")]))
    events: deque[c.Event] = field(default_factory=lambda: deque[c.Event](maxlen=_EVENTS_KEPT))
    heard: int = 0
    missed: int = 0
    version: int = 0
    welcome: c.Welcome | None = None

    def __post_init__(self) -> None:
        self.link = ConsoleLink(self.state_dir)
        self._tree_news, self._news = threading.Event(), threading.Event()
        self._closed = threading.Event()
        self._versions = itertools.count(1)
        self._threads = [
            threading.Thread(target=target, name=f"rr-watch-{target.__name__.strip('_')}", daemon=True)
            for target in (self._follow, self._keep_looking)
        ]

    @property
    def now(self) -> Moment:
        """The newest moment."""
        return self.moments[-1]

    def moment_at(self, at: float) -> Moment:
        """Return how it was at a time: the last moment that is not later; the oldest one, if that was earlier."""
        found = self.moments[0]
        for moment in self.moments.copy():
            if moment.at > at:
                break
            found = moment
        return found

    def start(self) -> None:
        """Begin to look."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Close the connections, and wait until both threads have ended."""
        self._closed.set()
        self._tree_news.set()
        self.link.close()
        for thread in self._threads:
            if thread.is_alive():
                thread.join()

    def look_soon(self) -> None:
        """Look again: a page has changed something."""
        self._tree_news.set()

    # -- in the thread that hears ------------------------------------------------------------------------------------

    def _follow(self) -> None:
        while not self._closed.is_set():
            try:
                self.link.follow(self._reached, self._hear)
                problem = f"the system in {self.link.state_dir} has stopped"
            except NotRunning:
                problem = f"no system runs in {self.link.state_dir}"
            except RrError as error:
                problem = str(error)
            if not self.now.problem:
                self._add(replace(self.now, at=time.time(), problem=problem))
            self._closed.wait(_AGAIN_S)

    def _reached(self, welcome: c.Welcome) -> None:
        self.welcome = welcome
        self._tree_news.set()

    def _hear(self, part: c.Events | c.Missed) -> None:
        if isinstance(part, c.Missed):
            self.missed += part.count
            self.heard += part.count
            self._tree_news.set()
        else:
            self.events.extend(part.events)
            self.heard += len(part.events)
            self._news.set()
            if any("path" in event.facts for event in part.events):  # of the tree
                self._tree_news.set()
        self.version = next(self._versions)

    # -- in the thread that asks -------------------------------------------------------------------------------------

    def _keep_looking(self) -> None:
        while not self._closed.is_set():
            began = time.monotonic()
            self._look()
            took_s = time.monotonic() - began
            self._closed.wait(max(_TREE_S, min(_SHARE * took_s, _LONGEST_S)))
            self._wait_for_news(began)

    def _wait_for_news(self, began: float) -> None:
        """Until a child's event; until a resource's, if the last look is old enough; until it is old."""
        is_counting = any(row.recent_restarts for row in self.now.children)  # a window that empties by itself
        latest = began + (_NEWS_S if is_counting else _SELDOM_S)
        while not self._tree_news.wait(0.05) and time.monotonic() < latest:
            if self._news.is_set() and time.monotonic() > began + _NEWS_S:
                break
        self._tree_news.clear()
        self._news.clear()

    def _look(self) -> None:
        try:
            moment = self._asked()
        except RrError as error:
            moment = replace(self.now, at=time.time(), problem=str(error))
        self._add(moment)

    def _asked(self) -> Moment:
        before = self.now
        page = self.link.ask(c.ListChildren(), c.Children, _LOOK_S)
        rows = list(page.rows)
        while len(rows) < min(page.total, CHILDREN) and page.rows:
            page = self.link.ask(c.ListChildren("", len(rows)), c.Children, _LOOK_S)
            rows += page.rows
        registrars = self.link.ask(c.ListRegistrars(), c.Registrars, _LOOK_S).rows
        resources = self.link.ask(c.ListResources(limit=GROUPED_FROM), c.Resources, _LOOK_S)
        if resources.total > GROUPED_FROM:
            resources = c.Resources(resources.total, self._samples(registrars))
        return Moment(
            time.time(),
            _shared([msgspec.structs.replace(row, up_s=None) for row in rows[:CHILDREN]], before.children),
            _shared(registrars, before.registrars),
            _shared(resources.rows, before.resources),
            resources.total,
        )

    def _samples(self, registrars: list[c.RegistrarRow]) -> list[ResourceRow]:
        """A few resources of each registrar, which show how registrars depend on each other."""
        rows: list[ResourceRow] = []
        for registrar in registrars[:_SAMPLED]:
            if registrar.status == "up":
                request = c.ListResources(registrar=registrar.name, limit=_SAMPLE)
                rows += self.link.ask(request, c.Resources, _LOOK_S).rows
        return rows

    def _add(self, moment: Moment) -> None:
        if moment.says_the_same(self.now):
            return
        self.moments.append(moment)
        while len(self.moments) > _KEPT or self.moments[0].at < moment.at - KEPT_S or not self.moments[0].at:
            self.moments.popleft()
        self.version = next(self._versions)


def _shared(rows: Sequence[_Row], before: tuple[_Row, ...]) -> tuple[_Row, ...]:
    """The rows, and those among them that have not changed as the objects that are kept already."""
    known = {_key(row): row for row in before}

    def same(row: _Row) -> _Row:
        kept = known.get(_key(row), row)
        return kept if kept == row else row

    found = tuple(map(same, rows))
    return before if found == before else found


def _key(row: c.ChildRow | c.RegistrarRow | ResourceRow) -> str:
    return row.path if isinstance(row, c.ChildRow) else row.name if isinstance(row, c.RegistrarRow) else row.id
