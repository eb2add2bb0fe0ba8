"""What the notes of a scenario say: which processes and callbacks run, and which promises they break."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence

import msgspec

from rr_actors.registrar.model.roles import LOAD, PAUSE, RECOVER, RESUME, STATUS, UNLOAD, USAGE
from rr_actors.testing.callback_notes import Note

ONCE = "each open is closed once"
RECOVERED = "after a crash, recover gives the same or says lost"
LEFT = "nothing is left when nothing is loaded"
KEYS = "two resources of one request do not share a key"
LIMIT = "no callback takes longer than its limit"
REFUSED = "a wrong request is refused"
AGAIN = "a request that loads in a fresh manager always loads"
RETURNS = "no callback but load and recover raises"
LIVES = "the manager's process dies by the check alone"
RACES = "callbacks that run at the same time do not race for an attribute"

PROMISES = (ONCE, RECOVERED, LEFT, KEYS, LIMIT, REFUSED, AGAIN, RETURNS, LIVES, RACES)
_MUST_RETURN = {role.name for role in (UNLOAD, STATUS, PAUSE, RESUME, USAGE)}
_ENDS = ("end", "raised")


class Fault(msgspec.Struct, frozen=True):
    """A promise that a manager has broken.

    Attributes:
        promise: one of PROMISES.
        text: what has happened.
    """

    promise: str
    text: str


def process_of(notes: Sequence[Note]) -> int:
    """Return the id of the process that has started last; 0 if a callback of it has got SIGKILL since, or for none."""
    for note in reversed(notes):
        if note.what == "killed":
            return 0
        if note.what == "started":
            return note.pid
    return 0


def runs_in(pid: int, notes: Sequence[Note]) -> list[Note]:
    """Return the callbacks that run in a process, without health callbacks, which run at any time."""
    found: dict[tuple[str, str], Note] = {}
    for note in notes:
        if note.pid == pid and note.what == "begin" and note.role != "health":
            found[note.role, note.resource] = note
        elif note.pid == pid and note.what in _ENDS:
            found.pop((note.role, note.resource), None)
    return list(found.values())


def has_ended(role: str, resource: str, notes: Sequence[Note]) -> bool:
    """Return whether a callback of a resource has ended, and has not died after that."""
    ended = False
    for note in notes:
        if (note.role, note.resource) == (role, resource):
            ended = note.what in _ENDS if note.what in (*_ENDS, "begin", "killed") else ended
    return ended


def faults_of_callbacks(notes: Sequence[Note]) -> Iterator[Fault]:
    """Yield what callbacks did wrong by themselves."""
    for note in notes:
        if note.what == "blocked":
            yield Fault(LIMIT, f"the {note.role} callback of {note.name}: {_last(note)}\n{note.text}")
        elif note.what == "race":
            yield Fault(RACES, note.text)
        elif note.what == "changed":
            yield Fault(RECOVERED, f"the recover callback of {note.name}: {note.text}")
        elif note.what == "raised" and note.role in _MUST_RETURN:
            promise = RETURNS if note.role != UNLOAD.name else KEYS if _has_twin(note, notes) else ONCE
            yield Fault(promise, f"the {note.role} callback of {note.name} raised: {_last(note)}\n{note.text}")


def _last(note: Note) -> str:
    return note.text.strip().rpartition("\n")[2]


def _has_twin(note: Note, notes: Sequence[Note]) -> bool:
    """Return whether there was another resource of the same request before."""
    for other in notes:
        if other is note:
            return False
        if other.role == LOAD.name and other.name == note.name and other.resource != note.resource:
            return True
    return False


def faults_of_devices(notes: Sequence[Note], pid: int) -> Iterator[Fault]:
    """Yield what the notes of fake devices say is wrong, when nothing is loaded any more.

    A callback that a SIGKILL has interrupted runs again, and cannot know what the first run has done to a device that
    outlives its process: it may open or close such a device a second time.

    Args:
        pid: the process that lives.
    """
    outside: dict[tuple[str, str], Note] = {}  # by resource and device
    inside: dict[int, Counter[str]] = defaultdict(Counter)
    held: dict[str, Counter[tuple[int, str]]] = defaultdict(Counter)  # by resource: of (process, device)
    for note in notes:
        by = f" by the {note.role or 'callback'} of {note.name}" if note.name else ""
        if note.what == "opened" and note.outlives:
            outside[note.resource, note.text] = note
        elif note.what == "closed" and note.outlives:
            nobodys = [key for key in outside if key[1] == note.text and "" in (key[0], note.resource)]
            if outside.pop((note.resource, note.text), None) is None and note.attempt < 2:
                if not nobodys:
                    yield Fault(ONCE, f"{note.text} was closed{by}, and was not open")
                else:
                    del outside[nobodys[0]]
        elif note.what == "opened":
            held[note.resource][note.pid, note.text] += 1
            inside[note.pid][note.text] += 1
        elif note.what == "closed":
            held[note.resource][note.pid, note.text] -= 1
            if inside[note.pid][note.text] <= 0:
                yield Fault(ONCE, f"{note.text} was closed{by} in process {note.pid}, which does not have it open")
            inside[note.pid][note.text] -= 1
        elif note.what == "end" and note.role == RECOVER.name and note.resource:
            mine = held[note.resource]
            before = {key for (process, key), count in mine.items() if process != note.pid and count > 0}
            for key in sorted(before - {key for process, key in mine if process == note.pid}):
                said = f"the recover callback of {note.name} says that it is there"
                yield Fault(RECOVERED, f"{said}: its load callback had opened {key}, and it has not opened it again")
    for (_, key), note in outside.items():
        yield Fault(LEFT, f"{key} is still open: it was opened for {note.name or 'the manager'}")
    for key, count in inside[pid].items():
        if count > 0:
            yield Fault(LEFT, f"process {pid} still has {key} open" + (f" {count} times" if count > 1 else ""))


def faults_of_runs(notes: Sequence[Note], unloads: set[str]) -> Iterator[Fault]:
    """Yield the resources that were loaded and not unloaded, when nothing is loaded any more.

    Args:
        unloads: the servers that have an unload callback.
    """
    last: dict[str, Note] = {}
    for note in notes:
        if note.what in _ENDS and note.role in (LOAD.name, UNLOAD.name):
            last[note.resource] = note
    for note in last.values():
        if note.role == LOAD.name and note.what == "end" and note.server in unloads:
            yield Fault(ONCE, f"{note.name} was loaded, and its unload callback has not run")
