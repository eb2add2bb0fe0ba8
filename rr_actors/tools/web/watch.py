"""Watch: the state of one system for the pages, now and in the last minutes.

Three threads wait for the system: one for its events, one for its tree, one for the rows of registrars and resources.
So news of a child never waits for many rows. The pages wait for none of them: when `version` has changed, they show the
newest moment.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import msgspec

from rr_actors.base.errors import RrError
from rr_actors.registrar.pages import ResourceRow, ServerRow
from rr_actors.streams.stream import Stream
from rr_actors.system.console import console_messages as c
from rr_actors.system.console import console_questions as questions
from rr_actors.system.console.attention.attention_questions import Attention, ListAttention
from rr_actors.system.console.console_connection import read_pages
from rr_actors.system.console.console_view import Verb
from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.recordings import entry_of
from rr_actors.system.recording.timeline_lanes import Lane, Lanes
from rr_actors.system.recording.timelines import Timeline
from rr_actors.tools.terminal.console_link import ConsoleLink
from rr_actors.tools.terminal.event_lines import EventLines
from rr_actors.tools.terminal.figure_curves import FigureCurves
from rr_actors.tools.terminal.stream_frames import Thumbnails

GROUPED_FROM = 300
"""From so many resources on, a picture shows servers in place of resources."""
CHILDREN = 1000
"""The most children that a picture shows."""
KEPT_S = 600.0
_KEPT = 3000
"""How long moments are kept, and how many at most. A moment shares unchanged rows with the moment before."""
_EVENTS_KEPT = 1000
_TREE_S = 0.1
_NEWS_S = 0.4
_SELDOM_S = 2.0
"""The least time between two looks after a child's event, and after a resource's; the longest time between looks."""
_SHARE = 10
_TREE_PAUSE_S, _ROWS_PAUSE_S = 0.2, 5.0
"""A pause is ten times as long as the look before it, and no longer than this: after a look at the tree, at the rows.

A look at the tree is cheap. It takes long where the machine is busy, as while a killed manager recovers.
"""
_AGAIN_S = 0.5
_LOOK_S = 10.0
_STREAMS = 4  # of one resource that are shown as pictures

_A = TypeVar("_A")
_Row = TypeVar("_Row", c.ChildRow, c.RegistrarRow, ResourceRow)


@dataclass(frozen=True)
class Moment:
    """The state of a system at one time.

    Attributes:
        at: seconds since the epoch; 0.0 before the first answer.
        resources: all resources, if there are few.
        servers: else the servers, with their resources counted.
        total: the number of all resources.
        problem: why no system runs, or why it does not answer; "" if it answers.
        stale: why registrars and resources may have changed; "" if they have not, None before their first answer.
    """

    at: float
    children: tuple[c.ChildRow, ...] = ()
    registrars: tuple[c.RegistrarRow, ...] = ()
    resources: tuple[ResourceRow, ...] = ()
    total: int = 0
    problem: str = ""
    servers: tuple[ServerRow, ...] = ()
    stale: str | None = None

    def says_the_same(self, other: Moment) -> bool:
        """Return whether another moment differs only in its time."""
        return replace(self, at=other.at) == other


class _Looks:
    """The looks at one part of a system, in a thread: soon after news of that part, and seldom without.

    Args:
        look: asks the system, and returns the longest time until the next look.
        pause_s: the longest pause after a look.

    Attributes:
        soon, news: set to have a look at once, or when the last look has become older.
    """

    def __init__(self, look: Callable[[], float], pause_s: float) -> None:
        self.soon, self.news = threading.Event(), threading.Event()
        self._look, self._pause_s = look, pause_s

    def run(self, closed: threading.Event) -> None:
        """Look again and again, until `closed` and `soon` are set."""
        while not closed.is_set():
            began = time.monotonic()
            latest = began + self._look()
            took_s = time.monotonic() - began
            closed.wait(max(_TREE_S, min(_SHARE * took_s, self._pause_s)))
            while not self.soon.wait(0.05) and time.monotonic() < latest:
                if self.news.is_set() and time.monotonic() > began + _NEWS_S:
                    break
            self.soon.clear()
            self.news.clear()


class Moments(deque[Moment]):
    """The moments of the last minutes, oldest first, never empty."""

    def add(self, moment: Moment) -> bool:
        """Add a moment that says something new, and drop those that are past; return whether it was added."""
        if moment.says_the_same(self[-1]):
            return False
        self.append(moment)
        while len(self) > 1 and self._is_past(self[0]):
            self.popleft()
        return True

    def _is_past(self, oldest: Moment) -> bool:
        is_whole = oldest.at and oldest.stale is not None  # not before the first answer, nor before the rows came
        return not is_whole or len(self) > _KEPT or oldest.at < self[-1].at - KEPT_S


@dataclass
class Watch:
    """Watches the system in one state directory, also over its restarts. Its threads run from start() to stop().

    Attributes:
        link: the link for questions and commands of a page.
        moments: the moments of the last minutes, oldest first, never empty; one for each change.
        events, lines: the newest events, and their lines for people.
        heard: the number of all events.
        version: grows with each change that a page could show.
        figures: the figures of the children over the last minutes.
        pages: the names of the pages that are served.
        attention: what needs attention.
    """

    state_dir: str | os.PathLike[str] | None
    moments: Moments = field(default_factory=lambda: Moments([Moment(0.0, problem="not asked yet")]))
    events: deque[Event] = field(default_factory=lambda: deque[Event](maxlen=_EVENTS_KEPT))
    heard: int = 0
    missed: int = 0
    version: int = 0
    welcome: c.Welcome | None = None
    lines: EventLines = field(default_factory=EventLines)
    pages: tuple[str, ...] = ()
    attention: Attention = field(default_factory=lambda: Attention(0, []))

    def __post_init__(self) -> None:
        self.link = ConsoleLink(self.state_dir)
        self._tree = _Looks(self._look_at_tree, _TREE_PAUSE_S)
        self._rows = _Looks(self._look_at_rows, _ROWS_PAUSE_S)
        self._closed = threading.Event()
        self._changing = threading.Lock()
        self._versions = itertools.count(1)
        self._lanes, self._lanes_lock = Lanes(), threading.Lock()
        self.figures = FigureCurves()
        self._thumbnails = Thumbnails()
        self._attended = 0.0
        self._latest = 0.0  # the time of the newest event in the lanes
        self._known: set[float] = set()  # the times of those that were remembered, of which the feed may tell again
        self._lanes_of: tuple[int, list[Lane], float | None] | None = (
            None  # the lanes of a version, and when they began
        )
        self._threads = [
            threading.Thread(target=target, name=f"rr-watch-{name}", daemon=True)
            for name, target in (
                ("follow", self._follow),
                ("tree", partial(self._tree.run, self._closed)),
                ("rows", partial(self._rows.run, self._closed)),
            )
        ]

    @property
    def now(self) -> Moment:
        """The newest moment."""
        return self.moments[-1]

    def moment_at(self, at: float) -> Moment:
        """Return the last moment that is not later than `at`, or else the oldest one."""
        found = self.moments[0]
        for moment in self.moments.copy():
            if moment.at > at:
                break
            found = moment
        return found

    def pictures_of(self, resource_id: str) -> dict[str, bytes]:
        """Return a small PNG for each stream of a resource that has pictures, by its name. It reads the streams."""
        with contextlib.suppress(RrError):  # the next moment says why there is no answer
            rows = self.link.ask(questions.ListStreams(resource_id, 0, _STREAMS), _LOOK_S).rows
            names = [
                row.info.name for row in rows if row.info.resource_id == resource_id and row.info.age_s is not None
            ]
            found = {name: self._thumbnails.newest(Stream(resource_id, name)) for name in names}
            return {name: picture for name, picture in found.items() if picture}
        return {}

    def timeline(self) -> Timeline:
        """Return the timeline of all that is known: the records of the state directory, and the events since then."""
        version, now = self.version, self.now
        if (made := self._lanes_of) is None or made[0] != version:
            with self._lanes_lock:
                made = self._lanes_of = version, self._lanes.lanes(), self._lanes.began
        until = now.at if now.problem and now.at else time.time()
        return Timeline(made[1], made[2] or until, until, self.welcome.system if self.welcome is not None else "")

    def start(self) -> None:
        """Start the threads."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Close the connections, and wait until the threads have ended."""
        self._closed.set()
        self.look_soon()
        self.link.close()
        for thread in self._threads:
            if thread.is_alive():
                thread.join()

    def look_soon(self) -> None:
        """Ask for the tree and the rows again soon, as a page has changed something."""
        self._tree.soon.set()
        self._rows.soon.set()

    # -- in the thread that follows events ---------------------------------------------------------------------------

    def _follow(self) -> None:
        while not self._closed.is_set():
            problem = self.link.follow(self._reached, self._hear)
            self._change(partial(replace, problem=problem, stale=problem))
            self._closed.wait(_AGAIN_S)

    def _reached(self, welcome: c.Welcome) -> None:
        self.welcome = welcome
        with contextlib.suppress(RrError):  # the system ends
            known = self._ask(questions.ListEvents()).events
            self._known = {event.at for event in known}
            self._take([event for event in known if event.at > self._latest])
        self.look_soon()

    def _hear(self, part: c.Events | c.Missed) -> None:
        if isinstance(part, c.Missed):
            self.missed += part.count
            self.heard += part.count
            self.look_soon()
        else:
            events = [event for event in part.events if event.at not in self._known]
            self.events.extend(events)
            self._take(events)
            self._rows.news.set()
            if any("path" in event.facts for event in part.events):  # an event of the tree
                self.look_soon()
        self.version = next(self._versions)

    def _take(self, events: Sequence[Event]) -> None:
        self.heard += len(events)
        for event in events:
            self.lines.take(event)
            self._latest = max(self._latest, event.at)
        with self._lanes_lock:
            for event in events:
                self._lanes.take(entry_of(event))

    # -- in the threads that look ------------------------------------------------------------------------------------

    def _look_at_tree(self) -> float:
        try:
            pages = read_pages(self._ask, questions.ListChildren(), CHILDREN)
            children = [row for page in pages for row in page.rows][:CHILDREN]
        except RrError as error:
            self._change(partial(replace, problem=str(error)))
            return _SELDOM_S
        with self._lanes_lock:
            for row in children if self._latest else ():  # after the records of what was before
                self._lanes.sees(row.path, row.pid or 0, time.time())
        rows = [msgspec.structs.replace(row, up_s=None) for row in children]
        self._change(lambda now: replace(now, children=_shared(rows, now.children), problem=""))
        is_counting = any(row.recent_restarts for row in children)  # a restart window empties by itself
        return _NEWS_S if is_counting else _SELDOM_S

    def _look_at_rows(self) -> float:
        try:
            registrars = self._ask(questions.ListRegistrars()).rows
            total, resources, servers = self._asked_resources(grouped=bool(self.now.servers))
            if time.monotonic() > self._attended + _SELDOM_S:
                self.attention, self._attended = self._ask(ListAttention()), time.monotonic()
        except RrError as error:
            self._change(partial(replace, stale=str(error)))
            return _SELDOM_S
        self.figures.take(self.now.children, registrars)
        self._change(
            lambda now: replace(
                now,
                registrars=_shared(registrars, now.registrars),
                resources=_shared(resources, now.resources),
                total=total,
                servers=now.servers if servers == list(now.servers) else tuple(servers),
                stale="",
            )
        )
        return _SELDOM_S

    def _asked_resources(self, *, grouped: bool) -> tuple[int, list[ResourceRow], list[ServerRow]]:
        """Return how many resources there are; and all of them, or where these are too many the servers.

        Args:
            grouped: they were too many before: count them first.
        """
        total = self._ask(questions.ListResources(limit=1)).total if grouped else 0
        if total <= GROUPED_FROM:
            pages = read_pages(self._ask, questions.ListResources(), GROUPED_FROM)
            found = next(pages)
            if (total := found.total) <= GROUPED_FROM:  # an answer has no room for many long texts: there may be more
                return total, [*found.rows, *(row for page in pages for row in page.rows)], []
        return total, [], self._ask(questions.ListServers()).rows

    def _ask(self, request: Verb[_A]) -> _A:
        return self.link.ask(request, _LOOK_S)

    # -- in all of these threads -------------------------------------------------------------------------------------

    def _change(self, change: Callable[[Moment], Moment]) -> None:
        """Add the moment that differs by `change`. While the system does not answer, its time is since when."""
        with self._changing:
            now, new = self.now, change(self.now)
            if self.moments.add(replace(new, at=now.at if now.problem and new.problem else time.time())):
                self.version = next(self._versions)


def _shared(rows: Sequence[_Row], before: tuple[_Row, ...]) -> tuple[_Row, ...]:
    """Return the rows, with the objects from `before` for the rows that have not changed."""
    known = {_key(row): row for row in before}

    def same(row: _Row) -> _Row:
        kept = known.get(_key(row), row)
        return kept if kept == row else row

    found = tuple(map(same, rows))
    return before if found == before else found


def _key(row: c.ChildRow | c.RegistrarRow | ResourceRow) -> str:
    return row.path if isinstance(row, c.ChildRow) else row.name if isinstance(row, c.RegistrarRow) else row.id
