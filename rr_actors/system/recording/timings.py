"""Timings: how long each load, unload, ask and callback of a trace took, as a tree over all processes."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence

import msgspec

from rr_actors.actors.messaging.message_notes import ANSWER, ASK, RAISED, REPLIES
from rr_actors.registrar.model.recorded import Entry

ANSWERS = {
    "Loaded": "Load", "LoadRefused": "Load", "Unloaded": "Unload", "UnloadRefused": "Unload", ANSWER: ASK, RAISED: ASK
}  # fmt: skip
"""For the name of each answer, that of its question."""


_DIGITS = re.compile("[0-9a-f]{32}")


class Timing(msgspec.Struct, frozen=True):
    """The duration of a load, an unload or a callback, or of an ask or its handler.

    Attributes:
        id: 16 hexadecimal digits, the same in each process.
        trace_id: 32 hexadecimal digits, of the whole trace: see trace_id_of().
        parent: the id of the timing that it belongs to; "" for none.
        name: "load cameras/camera", "unload cameras/camera", "callback load cameras/camera"; "ask root/maps",
            "handle Ask".
        kind: "client" for a load or unload at its consumer, and an ask; "server" for a callback or a handler.
        process, pid: the process that did it.
        began, ended: seconds since the epoch. `ended` is None if the recording does not have its end.
        error: the error of a failure; "" if there was none.
    """

    id: str
    trace_id: str
    parent: str
    name: str
    kind: str
    process: str
    pid: int
    registrar: str
    server: str
    query: str
    resource: str
    began: float
    ended: float | None = None
    error: str = ""


def trace_id_of(what: str) -> str:
    """Return the 32 hexadecimal digits of a trace: the id that it is about, or digits that are made of the words."""
    return what if _DIGITS.fullmatch(what) else hashlib.blake2b(what.encode(), digest_size=16).hexdigest()


def timings_of(trace_id: str, entries: Sequence[Entry]) -> list[Timing]:
    """Return the timings of a trace, in the order in which they began.

    Args:
        entries: in the order of their time.
    """
    calls, resources, parents = _calls(trace_id, entries)
    callbacks = _callbacks(trace_id, entries)
    found = [*calls, *(msgspec.structs.replace(one, parent=_cause(one, calls, resources)) for one in callbacks)]
    placed = [
        msgspec.structs.replace(timing, parent=_callback_of(parents.get(timing.query, ""), timing, found))
        if timing.kind == "client"
        else timing
        for timing in found
    ]
    return sorted([*placed, *_asks(trace_id, entries)], key=lambda timing: timing.began)


def _asks(trace_id: str, entries: Sequence[Entry]) -> list[Timing]:
    """Return the asks between actors, each with the time of its handler below it, and below the handler what it asked.

    An ask that a callback makes is below nothing.
    """
    found: dict[tuple[str, str], Timing] = {}
    for entry in entries:
        if entry.name == ASK:
            is_sent = entry.event == "sent"
            kind, above = ("client", ("handle", entry.parent)) if is_sent else ("server", ("ask", entry.query))
            key = ("ask" if is_sent else "handle"), entry.query
            parent = found[above].id if above in found else ""
            name = f"ask {entry.peer}" if is_sent else f"handle {entry.name}"
            what = _id(trace_id, *key), trace_id, parent, name, kind
            found[key] = Timing(*what, entry.process, entry.pid, entry.registrar, "", entry.query, "", entry.at)
        elif entry.name in REPLIES:
            for key in (("ask", entry.query), ("handle", entry.query)):
                if key in found and (
                    key[0] == "ask" or entry.event == "sent"
                ):  # a handler has ended before that is heard
                    error = entry.detail if entry.name == RAISED else ""
                    found[key] = msgspec.structs.replace(found[key], ended=entry.at, error=error)
    return list(found.values())


def _calls(trace_id: str, entries: Sequence[Entry]) -> tuple[list[Timing], dict[str, str], dict[str, str]]:
    """Return loads and unloads as consumers see them; the resource of each query; the resource it was loaded for."""
    calls: dict[tuple[str, str], Timing] = {}
    servers: dict[str, str] = {}
    resources: dict[str, str] = {}
    parents: dict[str, str] = {}
    for entry in entries:
        if entry.name in ("Load", "Unload") and entry.event in ("sent", "received"):
            if entry.name == "Load":
                servers[entry.query], parents[entry.query] = entry.server, entry.parent
            known = calls.get((entry.name, entry.query))
            if known is None or (entry.event == "sent" and known.process == ""):
                consumer = entry.registrar if entry.event == "sent" else entry.peer
                server = servers.get(entry.query, entry.peer if entry.event == "sent" else entry.registrar)
                where = (entry.process, entry.pid) if entry.event == "sent" else ("", 0)
                what = _id(trace_id, entry.name, entry.query), trace_id, "", f"{entry.name.lower()} {server}", "client"
                began = entry.at if known is None else min(known.began, entry.at)
                calls[entry.name, entry.query] = Timing(*what, *where, consumer, server, entry.query, "", began)
        elif entry.name in ANSWERS:
            if entry.resource:
                resources[entry.query] = entry.resource
            key = ANSWERS[entry.name], entry.query
            known = calls.get(key)
            if known is not None and (entry.event == "received" or known.ended is None):
                error = entry.detail if entry.name.endswith("Refused") else ""
                calls[key] = msgspec.structs.replace(known, ended=entry.at, error=error)
    found = [msgspec.structs.replace(call, resource=resources.get(call.query, "")) for call in calls.values()]
    return found, resources, parents


def _callbacks(trace_id: str, entries: Sequence[Entry]) -> list[Timing]:
    running: dict[tuple[int, str, str], Timing] = {}
    found: list[Timing] = []
    for number, entry in enumerate(entries):
        key = entry.pid, entry.resource, entry.name
        if entry.event == "began":
            id = _id(trace_id, "callback", f"{entry.resource} {entry.name} {number}")
            what = id, trace_id, "", f"callback {entry.name} {entry.server}", "server"
            where = entry.process, entry.pid, entry.registrar, entry.server
            running[key] = Timing(*what, *where, "", entry.resource, entry.at)
        elif entry.event == "ended" and (began := running.pop(key, None)) is not None:
            found.append(msgspec.structs.replace(began, ended=entry.at, error=entry.detail))
    return [*found, *running.values()]


def _cause(callback: Timing, calls: Sequence[Timing], resources: dict[str, str]) -> str:
    """Return the id of the call that the callback runs for: the first load or unload of its resource that waits."""
    role = callback.name.split()[1]
    if role not in ("load", "unload"):
        return ""
    waiting = [
        call
        for call in calls
        if call.name.startswith(f"{role} ")
        and callback.resource in (call.query, resources.get(call.query))
        and call.began <= callback.began
        and (call.ended is None or call.ended >= callback.began)
    ]
    return min(waiting, key=lambda call: call.began).id if waiting else ""


def _callback_of(resource: str, call: Timing, found: Sequence[Timing]) -> str:
    """Return the id of the callback that made the load, or that caused the unload."""
    if not resource:
        return ""
    around = [
        callback
        for callback in found
        if callback.kind == "server" and callback.resource == resource and callback.began <= call.began
    ]
    return max(around, key=lambda callback: callback.began).id if around else ""


def _id(trace_id: str, what: str, which: str) -> str:
    return hashlib.blake2b(f"{trace_id} {what} {which}".encode(), digest_size=8).hexdigest()
