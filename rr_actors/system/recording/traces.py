"""Traces: the entries of a recording that belong to one load or one message, from all processes.

The entries are joined by the ids that registrars send each other anyway. A load has the id of its query. The answer,
or a callback, has the id of the resource. A load that a callback makes has this resource as its parent. A message
between actors has an id of its own, and its cause as its parent.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import msgspec

from rr_actors.actors.messaging.message_notes import ANSWER, MESSAGES
from rr_actors.base.checks import needing
from rr_actors.base.errors import NotFound, UsageError, counted, did_you_mean, few, shown
from rr_actors.base.names import named
from rr_actors.base.notebook import bundle, table
from rr_actors.registrar.model.recorded import DEAD_LETTER, Entry, in_order
from rr_actors.system.recording.sequence_diagrams import sequence_of
from rr_actors.system.recording.timings import ANSWERS, Timing, timings_of, trace_id_of

BEGINNINGS = {"Load", "Unload", *MESSAGES}
"""The names of the messages with which a trace can begin."""
_PREFIX = 4  # an id can be given by its first characters, at least so many
_STARTS = ("started", "restarted")
_ENDS = ("exited", "stopped", "started", "restarted", "start_failed", "gave_up")


class Beginning(msgspec.Struct, frozen=True):
    """A load, or a message that is for nothing else: a trace that a recording has.

    Attributes:
        id: of its query, or of the message.
        at: when it was sent, in seconds since the epoch.
        by: the registrar or actor that sent it.
        what: for people: its class, and the name that trace_of() takes, or the receiver and the message.
        took_s: until its answer arrived, in seconds; None if the recording has no answer.
        error: the error of its answer; "" if there was none.
    """

    id: str
    at: float
    by: str
    what: str
    took_s: float | None = None
    error: str = ""


def beginnings_of(entries: Sequence[Entry]) -> list[Beginning]:
    """Return what the entries have traces of, in the order of time: loads and messages that are for nothing else.

    Args:
        entries: the entries of a recording, in the order of time.
    """
    found: dict[str, Beginning] = {}
    for entry in entries:
        if entry.event == "sent" and entry.name in BEGINNINGS and not entry.parent and entry.query not in found:
            what = " ".join(filter(None, (entry.name.lower(), name_of_load(entry) or entry.peer, _said(entry))))
            found[entry.query] = Beginning(entry.query, entry.at, entry.registrar, what)
        elif entry.event == "received" and entry.name in ANSWERS and (first := found.get(entry.query)):
            error = "" if entry.name in ("Loaded", "Unloaded", ANSWER) else entry.detail
            answered = msgspec.structs.replace(first, took_s=entry.at - first.at, error=error)
            found[entry.query] = answered if first.took_s is None else first
    return list(found.values())


def name_of_load(entry: Entry) -> str:
    """Return the name of what a load asks for, as commands show it; "" of an entry of another kind."""
    return named(entry.server, entry.detail) if entry.name == "Load" else ""


def _said(entry: Entry) -> str:
    return "" if entry.name == "Load" else entry.detail


class Trace:
    """The entries of one load, one message or some actors, from all processes. Recording.trace() makes it.

    Attributes:
        id: the id of the query, resource or message; of messages(), the names of the actors.
        entries: the entries in the order of time, with the ends and starts of the processes that took part.
    """

    def __init__(self, id: str, entries: Sequence[Entry]) -> None:
        self.id = id
        self.entries = list(entries)

    def sequence(self) -> str:
        """Return a Mermaid sequence diagram: registrars and actors, messages, callbacks, the deaths of processes."""
        return sequence_of(self.entries)

    def timings(self) -> list[Timing]:
        """Return the duration of each load, unload and ask, with its callback or handler, below what it is for."""
        return timings_of(trace_id_of(self.id), self.entries)

    def spans(self) -> list[Any]:
        """Return the timings as OpenTelemetry's spans, for any SpanExporter's export(). Needs the extra `otel`.

        A load's span belongs to the consumer's process. Below it is the span of its callback, in the provider's
        process. An ask has one of its asker, and below it that of the handler. The trace's id is the query's id, or
        that of the message; of a resource, or of several actors, it is made of the id or the names.

        Raises:
            MissingDependency: the extra is not installed.
        """
        with needing("spans()", "otel"):  # even an installed extra is imported only here
            from rr_actors.system.recording.otel_export import span_of
        return [span_of(timing) for timing in self.timings()]

    def __str__(self) -> str:
        began = self.entries[0].at if self.entries else 0.0
        return "\n".join(f"{(entry.at - began) * 1000:10.2f} ms  {line_of(entry)}" for entry in self.entries)

    def __repr__(self) -> str:
        return f"<Trace of {self.id}: {counted(len(self.entries), 'entry')}>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        began = self.entries[0].at if self.entries else 0.0
        rows = [(f"{(one.at - began) * 1000:.2f}", one.process, line_of(one)) for one in self.entries]
        return bundle(str(self), html=table(("ms", "process", "what"), rows), mermaid=self.sequence())


def line_of(entry: Entry) -> str:
    """Return an entry as one line for people."""
    if entry.event == "sent":
        what = f"{entry.registrar} -> {entry.peer}: {entry.name}"
    elif entry.event == "received":
        what = f"{entry.registrar} <- {entry.peer}: {entry.name}"
    elif entry.event in ("began", "ended"):
        what = f"{entry.registrar}: {entry.name} callback of {entry.server} {entry.event}"
    else:
        what = f"{entry.event} {entry.process or entry.server}"
    ids = " ".join(text for text in (entry.query, entry.resource) if text)
    return " ".join(text for text in (what, ids, entry.detail) if text)


def messages_of(entries: Sequence[Entry], actors: Sequence[str]) -> Trace:
    """Return the messages, callbacks and ends of these actors and registrars; of all, if none is named.

    Args:
        entries: the entries of a recording, in the order of time.
        actors: names such as "root/cameras", or the last part of one.

    Raises:
        NotFound: the recording has no message of an actor of this name.
    """
    named = {name for entry in entries for name in (entry.registrar, entry.peer) if name}
    wanted: set[str] = set()
    for actor in actors:
        found = {name for name in named if actor in (name, name.rpartition("/")[2])}
        if not found:
            text = f"{shown(actor)}: the recording has no message of an actor or registrar of this name; there are: "
            raise NotFound(text + (few(sorted(named)) or "none"), id=actor, known=tuple(sorted(named)))
        wanted |= found
    events = ("sent", "received", "began", "ended", DEAD_LETTER)
    chosen = [
        entry
        for entry in entries
        if entry.event in events and (not actors or entry.registrar in wanted or entry.peer in wanted)
    ]
    return Trace(" ".join(actors), in_order([*chosen, *Index(entries).deaths(chosen, entries)]))


def trace_of(entries: Sequence[Entry], id: str, *, of_query: bool = False) -> Trace:
    """Return the trace of a query, a resource or a message; or that of all loads of a name.

    Args:
        entries: the entries of a recording, in the order of time.
        id: an id, or its first characters; or a name such as 'cameras/camera "front"', or a server, 'cameras/camera'.
        of_query: prefer the query to the resource of this id: a resource has the id of the query that made it.

    Raises:
        NotFound, UsageError: see Recording.trace().
    """
    known = Index(entries)
    chosen: set[int] = set()
    if (loads := known.of_name.get(id)) is None:
        id = known.whole(id)
        loads = {id: None}
    for load in loads:
        chosen |= known.below(load, of_query=of_query)
    found = [entries[number] for number in sorted(chosen)]
    return Trace(id, in_order([*found, *known.deaths(found, found)]))


class Index:
    """Finds the entries of a recording by the ids that join them. It names an entry by its number in the recording."""

    def __init__(self, entries: Sequence[Entry]) -> None:
        self.entries = entries
        self.of_query: dict[str, list[int]] = defaultdict(list)
        self.of_resource: dict[str, list[int]] = defaultdict(list)
        self.resource_of: dict[str, str] = {}
        self.loads_for: dict[str, dict[str, None]] = defaultdict(dict)  # resource -> the queries of its parts
        self.queries_on: dict[str, dict[str, None]] = defaultdict(dict)
        self.of_name: dict[str, dict[str, None]] = defaultdict(dict)  # a name, or a server -> the queries of its loads
        self.messages: set[str] = set()  # the ids of messages between actors
        for number, entry in enumerate(entries):
            if entry.name in MESSAGES:
                self.messages.add(entry.query)
            if name := name_of_load(entry):
                for one in (entry.server, name, f"{entry.server} {entry.detail}"):
                    self.of_name[one][entry.query] = None
            if entry.query:
                self.of_query[entry.query].append(number)
                if entry.resource:
                    self.resource_of[entry.query] = entry.resource
                if entry.parent:
                    self.loads_for[entry.parent][entry.query] = None
            elif entry.resource:
                self.of_resource[entry.resource].append(number)
        for query in self.of_query:
            if query in self.of_resource:  # it made the resource, and its load was refused
                self.resource_of.setdefault(query, query)
        for query, resource in self.resource_of.items():
            self.queries_on[resource][query] = None

    def whole(self, id: str) -> str:
        """Return the whole id that begins with these characters."""
        known = {**dict.fromkeys(self.of_query), **dict.fromkeys(self.of_resource)}
        if id in known:
            return id
        found = [other for other in known if other.startswith(id)] if len(id) >= _PREFIX else []
        if len(found) > 1:
            several = ", ".join(found[:5]) + (", ..." if len(found) > 5 else "")
            raise UsageError(f"{shown(id)}: several ids begin so: {several}; give more of the id")
        if not found:
            hint = did_you_mean(id, self.of_name) if "/" in id else ""
            text = f"{shown(id)}: the recording has no query, resource or message of this id, and no load of this name"
            raise NotFound(text + hint, id=id)
        return found[0]

    def below(self, id: str, *, of_query: bool) -> set[int]:
        """Return the entries of a query, or of a resource and all its queries, and of all that they depend on."""
        chosen: set[int] = set()
        seen: set[str] = set()
        ahead: list[tuple[str, float]] = []
        if id in self.of_resource and not (of_query and id in self.of_query):
            first = min(self.entries[number].at for number in self.of_resource[id])
            self._resource(id, first, chosen, ahead, seen)
            ahead += [(query, 0.0) for query in self.queries_on.get(id, ())]
        ahead.append((id, 0.0))
        while ahead:
            query, since = ahead.pop()
            numbers = [number for number in self.of_query.get(query, ()) if self.entries[number].at >= since]
            if query in seen or not numbers:
                continue
            seen.add(query)
            chosen.update(numbers)
            if query in self.messages:
                ahead += [(caused, 0.0) for caused in self.loads_for.get(query, ())]
            resource = self.resource_of.get(query)
            if resource is not None and f"resource {resource}" not in seen:
                self._resource(resource, self.entries[numbers[0]].at, chosen, ahead, seen)
        return chosen

    def _resource(
        self, resource: str, since: float, chosen: set[int], ahead: list[tuple[str, float]], seen: set[str]
    ) -> None:
        """Choose the entries of a resource since a moment, and the callback that ran then: a load may join that."""
        seen.add(f"resource {resource}")
        open_since: dict[str, int] = {}
        numbers = self.of_resource.get(resource, [])
        for number in numbers:
            entry = self.entries[number]
            if entry.event == "began":
                open_since[entry.name] = number
            elif entry.event == "ended":
                began = open_since.pop(entry.name, None)
                if began is not None and entry.at >= since:
                    since = min(since, self.entries[began].at)
        for began in open_since.values():  # the callback still runs, or its process was killed
            since = min(since, self.entries[began].at)
        chosen.update(number for number in numbers if self.entries[number].at >= since)
        ahead += [(query, since) for query in self.loads_for.get(resource, ())]

    def deaths(self, chosen: Sequence[Entry], during: Sequence[Entry]) -> list[Entry]:
        """Return the ends and starts of the children that took part, and the start after an end.

        Args:
            during: between the first and the last of these entries, which are some of the recording's own.
        """
        if not chosen:
            return []
        names = {name for entry in chosen for name in (entry.registrar, entry.peer) if name}
        ids = set(map(id, during))  # times do not say the order: the clock may have been put back
        numbers = [number for number, entry in enumerate(self.entries) if id(entry) in ids]
        first, last = numbers[0], numbers[-1]
        down: set[str] = set()
        found: list[Entry] = []
        for number, entry in enumerate(self.entries):
            name = entry.process if entry.process in names else entry.process.rpartition("/")[2]
            if entry.event not in _ENDS or name not in names or number < first:
                continue
            if number <= last or (entry.process in down and entry.event in _STARTS):
                found.append(msgspec.structs.replace(entry, registrar=name))
                (down.discard if entry.event in _STARTS else down.add)(entry.process)
        return found
