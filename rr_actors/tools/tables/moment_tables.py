"""A moment of a recording as lines and cells, the same on the command line and in the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import msgspec

from rr_actors.base.errors import counted
from rr_actors.base.names import short_id
from rr_actors.system.recording.event_texts import clock
from rr_actors.system.rewound.moments import Change, ChildThen, Moment, ResourceThen
from rr_actors.system.rewound.rewinding import GONE, Rewound
from rr_actors.tools.tables.table import STATE_STYLES, Row

CHILD_HEADS = ("child", "state", "since", "pid", "restarts", "why")
RESOURCE_HEADS = ("resource", "state", "since", "message", "id")
CHANGE_HEADS = ("time", "what", "before", "after", "why")
_CHILD_STYLES = {"running": "", "stopped": "dim", "starting": "yellow", "restarting": "yellow", "unavailable": "red"}


def headline(rewound: Rewound, number: int, at: float | None = None) -> str:
    """Return a line about a moment: the system, the time, which step was the last, and what happened then.

    Args:
        at: the time that is asked for; None: that of the step.
    """
    step_at = rewound.since if number == 0 else rewound.steps[number - 1].at
    said = "the beginning" if number == 0 else str(rewound.steps[number - 1])
    shown = clock(step_at if at is None else at)
    return f"{rewound.title}  {shown}  step {number} of {len(rewound)}: {said.removeprefix(shown).strip()}"


def caveats(rewound: Rewound) -> list[str]:
    """Return sentences about what a recording does not have."""
    said: list[str] = []
    if rewound.missed:
        said.append(f"the recording lacks {counted(rewound.missed, 'entry')}: its reader was too slow")
    if rewound.left_out:
        said.append(f"{counted(rewound.left_out, 'resource')} of the beginning are not in the recording")
    said += [f"what was there at the beginning is not all known: {note}" for note in rewound.notes]
    if rewound.is_history:
        said.append(
            "the file does not say what was there when it began; a history has no load and no unload that went well, "
            "so it lacks resources, and has some that are unloaded"
        )
    elif not rewound.knows_beginning:
        what = "what no entry names is missing" if rewound.has_entries else "it has only its header"
        said.append(f"the recording does not say what was there when it began; {what}")
    return said


def child_cells(child: ChildThen) -> tuple[str, ...]:
    """Return the cells of a child, below CHILD_HEADS."""
    restarts = str(child.restarts) if child.restarts else ""
    pid = "" if child.pid is None else str(child.pid)
    return _indented(child), child.state, _since(child), pid, restarts, "" if child.state == "running" else child.why


def resource_cells(resource: ResourceThen) -> tuple[str, ...]:
    """Return the cells of a resource, below RESOURCE_HEADS."""
    return resource.name, resource.condition, _since(resource), resource.message, short_id(resource.id)


def change_cells(change: Change) -> tuple[str, ...]:
    """Return the cells of a change, below CHANGE_HEADS."""
    return clock(change.at), change.name, change.before or "-", change.after or GONE, change.why


def child_row(child: ChildThen, changed: bool) -> Row:
    """Return a child as a line; one that the step has changed is bold."""
    note = f"{child.state} {_since(child)}".rstrip()
    return Row(child.path, _indented(child), note, _bold(style_of(child), changed))


def resource_row(resource: ResourceThen, changed: bool) -> Row:
    """Return a resource as a line; one that the step has changed is bold."""
    note = " ".join(filter(None, (resource.condition, _since(resource), resource.message)))
    return Row(resource.id, resource.name, note, _bold(style_of(resource), changed))


def change_row(change: Change) -> Row:
    """Return a change as a line."""
    note = f"{change.before or '-'} → {change.after or GONE}"
    return Row(change.id, change.name, note, STATE_STYLES.get(change.after, ""))


def style_of(what: ChildThen | ResourceThen) -> str:
    """Return Rich's words for the colour of a child or a resource."""
    return (_CHILD_STYLES if isinstance(what, ChildThen) else STATE_STYLES).get(what.condition, "")


def facts_of(rewound: Rewound, number: int, moment: Moment, at: float) -> dict[str, Any]:
    """Return the moment at a time, after so many steps, for programs."""
    return {
        "step": number,
        "steps": len(rewound),
        "at": at,
        "event": "" if number == 0 else str(rewound.steps[number - 1]),
        "children": [msgspec.to_builtins(child) for child in moment.tree],
        "resources": [msgspec.to_builtins(one) | {"name": one.name} for one in moment.listed],
    }


def _bold(style: str, changed: bool) -> str:
    return f"{style} bold".strip() if changed else style


def _indented(child: ChildThen) -> str:
    return "  " * child.path.count("/") + child.path.rpartition("/")[2]


def _since(what: ChildThen | ResourceThen) -> str:
    return "" if what.since is None else clock(what.since)


def styles_of(those: Sequence[ChildThen | ResourceThen]) -> list[str]:
    """Return the colours of rows."""
    return [style_of(one) for one in those]
