"""Sequence diagrams: the entries of a trace as Mermaid text, with one arrow for each message."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Sequence

from rr_actors.registrar.model.recorded import Entry

_TEXT = 80  # characters of a label
_ANSWERS = {"Loaded": "Load", "LoadRefused": "Load", "Unloaded": "Unload", "UnloadRefused": "Unload"}
_CODES = {"#": "#35;", ";": "#59;", "<": "#lt;", ">": "#gt;", "%": "#37;", '"': "#quot;", "{": "#123;", "}": "#125;"}
_MOST = 1000  # arrows; a browser draws no more


def sequence_of(entries: Sequence[Entry]) -> str:
    """Return a diagram of these entries, which are in the order of their time.

    The arrow of a message that never arrived, as its receiver was killed, ends in a cross.
    """
    names = _participants(entries)
    lines = ["sequenceDiagram"]
    lines += [f"    participant {alias} as {_text(name)}" for name, alias in names.items()]
    began = entries[0].at if entries else 0.0
    pairs = _Arrivals(entries)
    since: dict[tuple[str, str, str], float] = {}
    drawn = 0
    for number, entry in enumerate(entries):
        at = f"{(entry.at - began) * 1000:.1f} ms"
        me = names.get(entry.registrar)
        if entry.event == "sent" or (entry.event == "received" and not pairs.has_arrow(number)):
            drawn += 1
            if drawn > _MOST:
                lines.append(f"    Note over {','.join(_ends(names))}: {len(entries) - number} entries more")
                break
            lines.append(_arrow(entry, names, lost=pairs.is_lost(number), at=at))
        elif entry.event == "began":
            since[entry.server, entry.resource, entry.name] = entry.at
            lines.append(f"    Note over {me}: {_text(f'{at}: {entry.name} {entry.server} begins')}")
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
    """Return the registrars of the entries, each with its name in the diagram, in the order of their appearance."""
    names: dict[str, str] = {}
    for entry in entries:
        ends = (entry.registrar, entry.peer) if entry.event == "sent" else (entry.peer, entry.registrar)
        for name in ends:
            if name and name not in names:
                names[name] = f"p{len(names)}"
    return names


def _ends(names: dict[str, str]) -> list[str]:
    aliases = list(names.values())
    return [aliases[0], aliases[-1]] if len(aliases) > 1 else aliases


def _arrow(entry: Entry, names: dict[str, str], *, lost: bool, at: str) -> str:
    me, other = names[entry.registrar], names[entry.peer]
    source, target = (me, other) if entry.event == "sent" else (other, me)
    is_answer = entry.name in _ANSWERS
    arrow = "-x" if lost else "-->>" if is_answer else "->>"
    if lost and is_answer:
        arrow = "--x"
    what = " ".join(text for text in (entry.name, entry.server, entry.detail) if text)
    end = " (did not arrive)" if lost else ""
    return f"    {source}{arrow}{target}: {_text(f'{at}: {what}')}{end}"


class _Arrivals:
    """Finds for each message its two entries: of its sending and of its arrival."""

    def __init__(self, entries: Sequence[Entry]) -> None:
        sent: dict[tuple[str, ...], deque[int]] = defaultdict(deque)
        self._arrived: set[int] = set()  # sendings whose arrival is among the entries
        self._paired: set[int] = set()  # arrivals whose sending is among the entries
        for number, entry in enumerate(entries):
            if entry.event == "sent":
                sent[_key(entry.registrar, entry.peer, entry)].append(number)
        for number, entry in enumerate(entries):
            if entry.event == "received" and (waiting := sent.get(_key(entry.peer, entry.registrar, entry))):
                self._arrived.add(waiting.popleft())
                self._paired.add(number)
        self._lost = {number for waiting in sent.values() for number in waiting} - _answered(entries)

    def has_arrow(self, number: int) -> bool:
        """Return whether an arrival needs no arrow, as the entry of its sending has one."""
        return number in self._paired

    def is_lost(self, number: int) -> bool:
        """Return whether the message was sent, and no entry shows that it arrived."""
        return number in self._lost


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
        if entry.event == "received" and (question := _ANSWERS.get(entry.name)) is not None:
            has_answer[entry.registrar, entry.query, question] = True
        elif entry.event == "sent":
            key = entry.registrar, entry.query, entry.name
            if has_answer.get(key):
                found.add(number)
            has_answer[key] = False
    return found


def _text(text: str) -> str:
    """Return a label: one line, in which the characters of Mermaid's syntax are escaped."""
    line = " ".join(text.split())
    line = line if len(line) <= _TEXT else line[: _TEXT - 1] + "…"
    return "".join(_CODES.get(char, char) for char in line)
