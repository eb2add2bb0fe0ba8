"""Events as lines for people, the same on the command line, in the terminal and on the web page.

A status that spreads over many resources is one line. Events that say the same, and follow each other within ten
seconds, are one line, too, with their number.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

from rr_actors.base.errors import UsageError, counted, few, shown
from rr_actors.registrar.engine.progress import shown_progress
from rr_actors.system.console.console_messages import Missed
from rr_actors.system.event_subscribers import kinds_for_all
from rr_actors.system.recording.event_memory import Event
from rr_actors.system.recording.event_texts import clock, subject_and_how

_KEPT = 500  # lines
_TOGETHER_S = 10.0
_SETTLED_S = 0.3
"""A line is settled when nothing has been added to it for so long ..."""
_LATEST_S = 2.0
"""... or when it is so old: a status may come again and again."""


@dataclass(frozen=True)
class EventFilter:
    """Which lines a person wants to see; what is empty chooses nothing.

    Attributes:
        kinds: kinds of events.
        child: a child's id or path; the events of all below it are wanted, too.
        server: a registrar, or "registrar/server".
        texts: each of them is in what a line says of its event (kind, subject, how), or in the name of a resource that
            its status has reached. The clock, the number of times and the reach are not searched.
    """

    kinds: frozenset[str] = frozenset()
    child: str = ""
    server: str = ""
    texts: tuple[str, ...] = ()

    @classmethod
    def of(cls, kinds: Iterable[str] = (), child: str = "", server: str = "", text: str = "") -> EventFilter:
        """Return a filter of the command line's options.

        Raises:
            UsageError: there is no such kind of event.
        """
        known, wanted = kinds_for_all(), frozenset(kinds)
        if unknown := sorted(wanted.difference(known)):
            raise UsageError(f"--event: expected one of {', '.join(known)}, got {shown(unknown[0])}")
        return cls(wanted, child.strip("/"), server, (text,) if text else ())

    @classmethod
    def parse(cls, text: str) -> EventFilter:
        """Return the filter that a person types: "event:status child:cameras server:maps blurred"."""
        chosen: dict[str, list[str]] = {"event": [], "child": [], "server": []}
        texts: list[str] = []
        for word in text.split():
            key, colon, value = word.partition(":")
            (chosen[key] if colon and key in chosen else texts).append(value if colon and key in chosen else word)
        child, server = ("".join(chosen[key][-1:]) for key in ("child", "server"))
        return cls(frozenset(filter(None, chosen["event"])), child.strip("/"), server, tuple(texts))

    def accepts(self, line: EventLine) -> bool:
        """Return whether a line is wanted."""
        if self.kinds and not any(line.kind.startswith(kind) for kind in self.kinds):
            return False
        if self.child and f"/{self.child}/" not in f"/{line.path}/":
            return False
        if self.server and not any(f"{server}/".startswith(f"{self.server}/") for server in list(line.servers)):
            return False
        said = (line.said, *line.names.copy())
        return all(any(text in one for one in said) for text in self.texts)


@dataclass
class EventLine:
    """What a line says.

    Attributes:
        at: the time of the newest event.
        kind: of the events.
        subject: the path of the child, or the name of the resource; of a status, of the one where it began.
        how: what happened to it.
        path: of the child.
        servers, names: of the resources; of a status, of all that it has reached.
        heard_by: the registrars that have heard the status for themselves.
        times: how many events say the same; of a status, how often it was sent.
        first: the time of the first of several.
    """

    at: float
    kind: str
    subject: str
    how: str
    path: str = ""
    servers: set[str] = field(default_factory=set[str])
    names: dict[str, None] = field(default_factory=dict[str, None])
    heard_by: dict[str, None] = field(default_factory=dict[str, None])
    times: int = 1
    first: float = 0.0
    source: str = ""  # the server where a status began, until its own event has come
    began: float = 0.0
    touched: float = 0.0

    @classmethod
    def of(cls, event: Event, above: str = "") -> EventLine:
        """Return the line of one event. The path `above` is left out of it."""
        facts = event.facts
        subject, how = subject_and_how(facts)
        if event.path:
            below = f"{subject}/".removeprefix(f"{above}/") if above else subject
            return cls(event.at, event.event, below.strip("/"), how, subject)
        if server := facts.get("server", ""):
            if "fraction" in facts:
                how = shown_progress(facts["fraction"], facts.get("text", ""))
            heard = dict.fromkeys(filter(None, str(facts.get("heard_by", "")).split(", ")))
            return cls(event.at, event.event, subject, how, "", {server}, {subject: None}, heard)
        return cls(event.at, event.event, subject, how)

    @property
    def said(self) -> str:
        """The event in words: its kind, its subject and how; without the clock, the times and the reach."""
        return " ".join(filter(None, (self.kind, self.subject, self.how)))

    @property
    def reach(self) -> str:
        """How far a status has come: "401 resources in 3 managers, heard by app"."""
        others = len(self.names) - 1
        managers = len({server.partition("/")[0] for server in list(self.servers)})
        parts = (
            f"{counted(others, 'resource')} in {counted(managers, 'manager')}" if others else "",
            f"heard by {few(list(self.heard_by))}" if self.heard_by else "",
        )
        return ", ".join(filter(None, parts))

    def __str__(self) -> str:
        how = self.how
        if self.kind == "status" and (reach := self.reach):
            how = f"{how} → {reach}"
        if self.times > 1:
            since = f" since {clock(self.first)}" if 0 < self.first < self.at - _TOGETHER_S else ""
            how = f"{how} ({self.times} times{since})".lstrip()
        return "  ".join(filter(None, (f"{clock(self.at)}  {self.kind:<12}", self.subject, how))).rstrip()


class EventLines:
    """Lines of the newest events, oldest first. For one thread that takes; others may read `lines`."""

    def __init__(self) -> None:
        self._lines: dict[object, EventLine] = {}
        self._spreading: dict[str, object] = {}  # statuses, with the keys of their lines
        self._newest: dict[object, object] = {}  # the keys of the newest lines, by what they say
        self._numbers = itertools.count()

    def lines(self, wanted: EventFilter | None = None) -> list[EventLine]:
        """Return the lines that a filter accepts, or all."""
        lines = list(self._lines.copy().values())
        if wanted is None or wanted == EventFilter():
            return lines
        return [line for line in lines if wanted.accepts(line)]

    def note(self, text: str, at: float) -> None:
        """Add a line that is no event."""
        self._keep(next(self._numbers), EventLine(at, text, "", ""))

    def take(self, event: Event) -> None:
        """Add an event to its line."""
        line = EventLine.of(event)
        status_id = event.facts.get("status_id", "")
        if status_id:
            self._take_status(status_id, event.facts, line)
        else:
            self._join((line.kind, line.subject, line.path and line.how) if line.path or line.servers else None, line)

    def _take_status(self, status_id: str, facts: dict[str, Any], line: EventLine) -> None:
        began_here = facts["source"] == facts["server"]
        key = self._spreading.get(status_id)
        known = self._lines.pop(key, None) if key is not None else None
        if known is not None:
            if began_here and known.source:
                known.at, known.subject, known.how, known.source = line.at, line.subject, line.how, ""
            known.names.update(line.names)
            known.servers |= line.servers
            known.heard_by.update(line.heard_by)
            line = known
        elif not began_here:
            line.source = facts["source"]
        if line.source:  # the event of the server where it began is on its way
            key = status_id
            self._keep(key, line)
        elif key is not None and key != status_id:
            self._keep(key, line)
        else:
            key = self._join((line.kind, line.subject, line.how), line)
        self._spreading[status_id] = key
        while len(self._spreading) > _KEPT:
            del self._spreading[next(iter(self._spreading))]

    def _join(self, says: object, line: EventLine) -> object:
        """Keep a line in the place of one that says the same and is not much older; return its key.

        `says`: what it says; None: nothing that another line could say.
        """
        key = self._newest.pop(says, None)
        known = self._lines.get(key)
        if known is not None and line.at - known.at <= _TOGETHER_S:
            del self._lines[key]
            line.times, line.began, line.first = known.times + 1, known.began, known.first or known.at
        else:
            key = next(self._numbers)
        if says is not None:
            self._newest[says] = key
            while len(self._newest) > _KEPT:
                del self._newest[next(iter(self._newest))]
        self._keep(key, line)
        return key

    def _keep(self, key: object, line: EventLine) -> None:
        line.touched = time.monotonic()
        line.began = line.began or line.touched
        self._lines[key] = line
        while len(self._lines) > _KEPT:
            del self._lines[next(iter(self._lines))]

    def take_settled(self, *, all_of_them: bool = False) -> list[EventLine]:
        """Remove the lines to which nothing more is likely to be added, and return them."""
        now = time.monotonic()
        settled = [
            key
            for key, line in self._lines.items()
            if all_of_them or now > line.touched + _SETTLED_S or now > line.began + _LATEST_S
        ]
        return sorted((self._lines.pop(key) for key in settled), key=lambda line: line.at)


def event_line(event: Event, above: str = "") -> str:
    """Return one event as a line for people, with its child's path from `above` on."""
    return str(EventLine.of(event, above))


def missed_line(missed: Missed) -> str:
    """Return a sentence that says how many events a reader of the feed has missed."""
    return f"missed {counted(missed.count, 'event')}, up to number {missed.seq}: this reader was too slow"
