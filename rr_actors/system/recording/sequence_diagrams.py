"""Sequence diagrams: the entries of a trace as Mermaid text, with one arrow for each message."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator, Sequence

from rr_actors.actors.messaging.dead_letters import LOST_WITH
from rr_actors.actors.messaging.message_notes import MESSAGES, REPLIES
from rr_actors.base.errors import counted
from rr_actors.registrar.model.recorded import DEAD_LETTER, Entry
from rr_actors.system.recording.timings import ANSWERS

_TEXT = 80  # characters of a label
_CODES = {"#": "#35;", ";": "#59;", "<": "#lt;", ">": "#gt;", "%": "#37;", '"': "#quot;", "{": "#123;", "}": "#125;"}
_MOST = 1000  # arrows; a browser draws no more
_DEAD = " (did not arrive)"
_UNKNOWN = " (no record of its arrival)"


def sequence_of(entries: Sequence[Entry]) -> str:
    """Return a diagram of these entries, which are in the order of their time.

    The arrow of a message that is not known to have arrived ends in a cross. If a dead letter proves that it did not,
    its label says "(did not arrive)". If the receiver was killed, its last entries are lost: "(no record of its
    arrival)".
    """
    names = _participants(entries)
    lines = ["sequenceDiagram"]
    lines += [f"    participant {alias} as {_text(name)}" for name, alias in names.items()]
    began = entries[0].at if entries else 0.0
    paired, lost = _arrivals(entries)
    undelivered = _undelivered(entries, lost)
    since: dict[tuple[str, str, str], float] = {}
    drawn = 0
    for number, entry in enumerate(entries):
        at = f"{(entry.at - began) * 1000:.1f} ms"
        me = names.get(entry.registrar)
        if entry.event == "sent" or (entry.event == "received" and number not in paired):
            drawn += 1
            if drawn > _MOST:
                ends = dict.fromkeys(("p0", f"p{len(names) - 1}"))
                lines.append(f"    Note over {','.join(ends)}: {counted(len(entries) - number, 'more entry')}")
                break
            end = "" if number not in lost else _DEAD if number in undelivered else _UNKNOWN
            lines.append(_arrow(entry, names, end, at))
        elif entry.event == "began":
            since[entry.server, entry.resource, entry.name] = entry.at
            what = f"{at}: {entry.name} {entry.server} begins"
            lines.append(f"    Note over {me}: {_text(', '.join(filter(None, (what, entry.detail))))}")
        elif entry.event == "ended":
            start = since.pop((entry.server, entry.resource, entry.name), None)
            took = "" if start is None else f" after {(entry.at - start) * 1000:.1f} ms"
            how = f"raised{took}: {entry.detail}" if entry.detail else f"returned{took}"
            lines.append(f"    Note over {me}: {_text(f'{at}: {entry.name} {entry.server} {how}')}")
        elif entry.event not in ("sent", "received") and me is not None:
            pid = f", pid {entry.pid}" if entry.pid else ""
            lines.append(f"    Note over {me}: {_text(f'{at}: {entry.event} {entry.detail}'.rstrip() + pid)}")
    return "\n".join(lines)


def _participants(entries: Sequence[Entry]) -> dict[str, str]:
    """Return the registrars and actors of the entries, each with its alias, in the order of their appearance."""
    names: dict[str, str] = {}
    for entry in entries:
        ends = (entry.registrar, entry.peer) if entry.event == "sent" else (entry.peer, entry.registrar)
        for name in ends:
            if name and name not in names:
                names[name] = f"p{len(names)}"
    return names


def _arrow(entry: Entry, names: dict[str, str], end: str, at: str) -> str:
    me, other = names[entry.registrar], names[entry.peer]
    source, target = (me, other) if entry.event == "sent" else (other, me)
    arrow = ("--" if entry.name in ANSWERS else "-") + ("x" if end else ">>")
    what = " ".join(text for text in (entry.name, entry.server, entry.detail) if text)
    return f"    {source}{arrow}{target}: {_text(f'{at}: {what}')}{end}"


def _arrivals(entries: Sequence[Entry]) -> tuple[set[int], set[int]]:
    """Return the arrivals whose sending is among the entries, and the sendings that no entry shows to have arrived."""
    sent: dict[tuple[str, ...], deque[int]] = defaultdict(deque)
    for number, entry in enumerate(entries):
        if entry.event == "sent":
            sent[_key(entry.registrar, entry.peer, entry)].append(number)
    paired: set[int] = set()
    for number, entry in enumerate(entries):
        if entry.event == "received" and (waiting := sent.get(_key(entry.peer, entry.registrar, entry))):
            waiting.popleft()
            paired.add(number)
    lost = {number for waiting in sent.values() for number in waiting} - _answered(entries)
    lost = set(_without_effect(entries, lost))
    return paired, {number for number in lost if entries[number].name not in REPLIES}  # a future's answer is noted once


def _key(source: str, target: str, entry: Entry) -> tuple[str, ...]:
    return source, target, entry.name, entry.query, entry.resource


def _answered(entries: Sequence[Entry]) -> set[int]:
    """Return the questions that were answered before they were asked again: they have certainly arrived.

    The entry of an arrival may be missing: within one process a thread may ask without a message.
    """
    found: set[int] = set()
    has_answer: dict[tuple[str, str, str], bool] = {}  # whether the question's next entry is its answer
    for number in range(len(entries) - 1, -1, -1):
        entry = entries[number]
        if entry.event == "received" and (question := ANSWERS.get(entry.name)) is not None:
            has_answer[entry.registrar, entry.query, question] = True
        elif entry.event == "sent":
            key = entry.registrar, entry.query, entry.name
            if has_answer.get(key):
                found.add(number)
            has_answer[key] = False
    return found


def _without_effect(entries: Sequence[Entry], lost: set[int]) -> Iterator[int]:
    """Yield the sendings of which the receiver has shown no effect before they were sent again.

    A receiver that is killed takes its last entries with it. Its next process reads the request from the catalog, and
    its callback runs: so the request has arrived.
    """
    effects: set[tuple[str, str, str]] = set()  # of the entries after this one: where, which callback, for what
    for number in range(len(entries) - 1, -1, -1):
        entry = entries[number]
        if entry.event in ("began", "ended"):
            effects |= {(entry.registrar, entry.name, id) for id in (entry.query, entry.resource) if id}
        elif entry.event == "sent":
            shown = {(entry.peer, entry.name.lower(), id) for id in (entry.query, entry.resource) if id}
            if number in lost and not effects & shown:
                yield number
            effects -= shown


def _undelivered(entries: Sequence[Entry], lost: set[int]) -> set[int]:
    """Return the lost messages between actors that a dead letter proves not to have arrived.

    A letter has no id. It is of the newest message before it that has its text, or else that its own process has sent:
    one process's messages to an actor arrive in their order. A letter of a message that was on its way to a process
    that died proves nothing: it may be what the process died of.
    """
    found: set[int] = set()
    waiting: dict[str, list[int]] = defaultdict(list)  # the lost messages to an actor, oldest first
    for number, entry in enumerate(entries):
        if number in lost and entry.name in MESSAGES:
            waiting[entry.peer].append(number)
        elif entry.event == DEAD_LETTER and not str(entry.facts.get("why", "")).startswith(LOST_WITH):
            text, sent = entry.facts.get("message"), waiting[entry.registrar]
            meant = [one for one in sent if entries[one].detail == text]
            meant = meant or [one for one in sent if entries[one].pid == entry.pid]
            if meant:
                found.add(meant[-1])
                sent.remove(meant[-1])
    return found


def _text(text: str) -> str:
    """Return a label: one line, in which the characters of Mermaid's syntax are escaped."""
    line = " ".join(text.split())
    line = line if len(line) <= _TEXT else line[: _TEXT - 1] + "…"
    return "".join(_CODES.get(char, char) for char in line)
