"""The entries of a recording: each is something that a process of the system sent, received, ran or heard of.

The ids in them join a load, its dependencies, its callbacks and their answers. The entry of a load has its query's id,
and that of a callback its resource's id. If a callback loads, the load has that resource as its `parent`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import msgspec

from rr_actors.base.errors import readable, shortened
from rr_actors.base.values.canonical import text_of_value
from rr_actors.registrar.model import messages as m
from rr_actors.registrar.model.messages import Message
from rr_actors.registrar.model.rows import shown_priority

DECIDED = "decided"
"""The event of an entry that has a note about a decision, or a part of one (registrar/decisions)."""
DEAD_LETTER = "dead_letter"
"""The event of a message that reached no actor. Its registrar is that actor."""
_LONG = 1000  # the bytes of a request that is shown, at most
_PUT_BACK_S = 0.25  # by which the time of one source falls if the clock is put back; threads may be late by less


class Entry(msgspec.Struct, frozen=True, omit_defaults=True):
    """One line of a recording.

    Attributes:
        seq: its number in the recording; 0 until it has one. Entries are numbered as they arrive.
        at: when it happened, in seconds since the epoch; not always in the order of `seq`.
        event: "sent" or "received" for a message; "began" or "ended" for a callback; "decided" for a decision of a
            registrar, if the recording has those. Otherwise an event of the tree or of a resource, named as in
            System.subscribe(). A message between actors is "received" when its handler
            begins.
        process: the path of the process where it happened, "root/cameras"; `pid`: its process id.
        registrar: the registrar or actor where it happened. Code of no actor has the name of its process.
        peer: of a message, the registrar or actor at its other end.
        name: of a message between registrars, its class, "Load"; between actors, "Ask", "Tell", "Timer", "Down" or
            "Stop", and of an answer "Answer" or "Raised"; of a callback, its role: "load", "unload", "recover" or
            "status".
        query, resource: the ids that it is about. A message between actors has an id of its own as its `query`, and
            so has its answer.
        parent: what it is for: of a load, the sender's resource; of a message between actors, the message that its
            sender was handling, or the resource whose callback the sender ran.
        server: "registrar/server", if it is known.
        detail: a request (as JSON), a message, an error or a status, for people.
        facts: all the facts of an event of the tree.
    """

    at: float
    event: str
    seq: int = 0
    process: str = ""
    pid: int = 0
    registrar: str = ""
    peer: str = ""
    name: str = ""
    query: str = ""
    resource: str = ""
    parent: str = ""
    server: str = ""
    detail: str = ""
    facts: dict[str, Any] = {}


def in_order(entries: Iterable[Entry]) -> list[Entry]:
    """Return entries in the order in which they happened, also if the clock was put back meanwhile.

    A process sends its entries in batches, so one may arrive after a later one of another process: their times say
    which was first. The entries of one source arrive in their order. If their time falls, the clock was put back: then
    all that arrived before comes before.
    """
    ordered, of_one_clock = list[Entry](), list[Entry]()
    newest = dict[str, float]()
    for entry in sorted(entries, key=lambda one: one.seq):
        source = _source(entry)
        if source and entry.at < newest.get(source, entry.at) - _PUT_BACK_S:
            ordered += sorted(of_one_clock, key=lambda one: one.at)
            of_one_clock.clear()
            newest.clear()
        of_one_clock.append(entry)
        newest[source] = max(entry.at, newest.get(source, entry.at))
    return ordered + sorted(of_one_clock, key=lambda one: one.at)


def _source(entry: Entry) -> str:
    """Return what has noted an entry, whose entries arrive in their order: a supervisor, a registrar or a process.

    A message may be noted long after the time that it was sent: "".
    """
    if entry.event in ("sent", "received"):
        return ""
    if entry.facts:
        return entry.process.rpartition("/")[0] or entry.registrar
    return f"{entry.process} {entry.pid}"


def message_entry(at: float, event: str, process: str, pid: int, registrar: str, peer: str, message: Message) -> Entry:
    """Return the entry of a message that `registrar` has sent to `peer`, or received from it."""
    where = (at, event, 0, process, pid, registrar, peer, type(message).__name__)
    match message:
        case m.Load():
            provider = peer if event == "sent" else registrar
            size = len(message.request)
            request = shortened(text_of_value(message.request)) if size <= _LONG else f"<{size} bytes>"
            return Entry(*where, message.query_id, "", message.parent, f"{provider}/{message.server}", request)
        case m.Loaded():
            return Entry(*where, message.query_id, message.resource_id)
        case m.LoadRefused() | m.UnloadRefused():
            return Entry(*where, message.query_id, detail=shortened(message.failure.message))
        case m.Unload() | m.Unloaded():
            return Entry(*where, message.query_id)
        case m.Noticed():
            notice = message.notice
            text = f"{notice.state} {notice.message}".rstrip()
            return Entry(*where, notice.query_id, notice.resource_id, detail=readable(shortened(text)))
        case m.Probe() | m.WaitedFor():
            return Entry(*where, message.query_id, detail=shortened(" > ".join(message.ring)))
        case m.Reprioritise() | m.Reprioritised():
            return Entry(*where, message.query_id, detail=shown_priority(message.priority))
        case m.Gone():
            return Entry(*where, detail=message.origin)
        case m.Leased():
            return Entry(*where, detail=shortened(" ".join(message.hosts)))
        case _:
            return Entry(*where)
