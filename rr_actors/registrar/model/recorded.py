"""What a recording has: entries, each something that a process of the system sent, received, ran or heard of.

The ids in them join a load, its dependencies, its callbacks and their answers. A load has its query's id, a callback
its resource's. A load that a callback makes has that resource as its `parent`.
"""

from __future__ import annotations

from typing import Any

import msgspec

from rr_actors.base.errors import shortened
from rr_actors.base.values.canonical import shown_plain
from rr_actors.registrar.model.messages import (
    Gone,
    Load,
    Loaded,
    LoadRefused,
    Message,
    Noticed,
    Probe,
    Unload,
    Unloaded,
    UnloadRefused,
    readable,
)

_LONG = 1000  # bytes of a request that is shown


class Entry(msgspec.Struct, frozen=True, omit_defaults=True):
    """One line of a recording.

    Attributes:
        seq: its number in the recording; 0 until it has one. They count in the order of arrival, `at` of happening.
        at: when, seconds since the epoch.
        event: "sent" or "received": a message between registrars. "began" or "ended": a callback. Else an event of the
            tree or of a resource, as System.subscribe() calls it.
        process: the path of the process where it happened, "root/cameras"; `pid`: its number.
        registrar: whose it is.
        peer: of a message, the registrar at its other end.
        name: of a message its class, "Load"; of a callback its role, "load", "unload", "recover" or "status".
        query, resource: the ids that it is about; `parent`: the sender's resource that a load is for.
        server: "registrar/server", where it is known.
        detail: a request, an error, a status; for people.
        facts: everything that an event of the tree says.
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


def message_entry(at: float, event: str, process: str, pid: int, registrar: str, peer: str, message: Message) -> Entry:
    """Return the entry of a message that `registrar` has sent to `peer`, or received from it."""
    where = (at, event, 0, process, pid, registrar, peer, type(message).__name__)
    match message:
        case Load():
            provider = peer if event == "sent" else registrar
            request = _shown(message.request)
            return Entry(*where, message.query_id, "", message.parent, f"{provider}/{message.server}", request)
        case Loaded():
            return Entry(*where, message.query_id, message.resource_id)
        case LoadRefused() | UnloadRefused():
            return Entry(*where, message.query_id, detail=shortened(message.failure.message))
        case Unload() | Unloaded():
            return Entry(*where, message.query_id)
        case Noticed():
            notice = message.notice
            text = f"{notice.state} {notice.message}".rstrip()
            return Entry(*where, notice.query_id, notice.resource_id, detail=readable(shortened(text)))
        case Probe():
            return Entry(*where, message.query_id, detail=shortened(" > ".join(message.ring)))
        case Gone():
            return Entry(*where, detail=message.origin)
        case _:
            return Entry(*where)


def _shown(request: bytes) -> str:
    return shortened(repr(shown_plain(request))) if len(request) <= _LONG else f"<{len(request)} bytes>"
