"""What a registrar decided, in words for people and as plain data for programs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from enum import Enum
from typing import Any, cast

import msgspec

from rr_actors.base.errors import TEXT_LIMIT, few, readable, shortened
from rr_actors.base.names import short_id
from rr_actors.base.values.canonical import text_of_value
from rr_actors.registrar.decisions.decided import Began
from rr_actors.registrar.decisions.deciding_again import Difference, RowChange
from rr_actors.registrar.decisions.typed_values import Opaque
from rr_actors.registrar.model.effects import Receive, SendReply, SendRequest
from rr_actors.registrar.model.rows import key_of_row
from rr_actors.system.recording.event_texts import clock
from rr_actors.system.rewound.replaying import ReplayStep

_WORDS = ("role", "server", "name", "state", "message")  # the fields that a short text of a message has
_IDS = ("resource_id", "target", "query_id", "run_id", "id")
_SHORT = 24  # characters of a value in one line
_MARGIN = "  "


def outcome_of(step: ReplayStep) -> str:
    """Say whether today's code decides the same: "same", "different", or "not decided again"."""
    if not step.is_decided:
        return "not decided again"
    return "different" if step.differences else "same"


def items_text(step: ReplayStep) -> str:
    """Say in one line what was decided: "Load camera "front" from app"."""
    what = step.what
    if isinstance(what, Began):
        rows = Counter(change.table for change in _rows(what))
        known = few(f"{table}: {count}" for table, count in rows.items()) or "no rows"
        return f"all that it knew; {known}"
    said = [_item_text(item, sender) for item, sender in what.items]
    end = "" if what.end == "committed" else f"{what.end}: {what.why}: "
    return end + few(said)


def changes_text(step: ReplayStep) -> str:
    """Say in one line which rows were changed: "resources 1f3a0c2d: phase loading → loaded"."""
    return few(_change_text(change) for change in step.rows)


def effects_text(step: ReplayStep) -> str:
    """Say in one line what followed: "StartCallback load, SendReply Loaded to app"."""
    return "" if isinstance(step.what, Began) else few(map(_effect_text, step.what.effects))


def step_lines(step: ReplayStep) -> Iterator[str]:
    """Yield the lines that show all of a step."""
    where = f"in {step.process} ({step.pid})"
    yield f"step {step.number} of {step.registrar}  {clock(step.at)}  {where}: {_said(step)}"
    what = step.what
    if isinstance(what, Began):
        yield items_text(step)
        yield from _indented(_value_lines(row.after) for row in _rows(what))
    else:
        yield "items"
        for item, sender in what.items:
            lines = list(_value_lines(item))
            lines[0] += f" from {sender}" if sender is not None else ""
            yield from _indented([lines])
        if what.outside:
            yield "changed before it, by other code than decisions"
            yield from _indented([[f"{name}: {_outside_text(*one)}"] for name, one in what.outside.items()])
        if step.rows:
            yield "changes of rows"
            yield from _indented(_row_lines(change) for change in step.rows)
        if what.effects:
            yield "effects, when that is on disk"
            yield from _indented(map(_value_lines, what.effects))
        if what.again:
            yield "to be decided again a moment later"
            yield from _indented([_item_text(*one)] for one in what.again)
    if step.differences:
        yield "different"
        yield from _indented(map(_difference_lines, step.differences))


def facts_of(step: ReplayStep) -> dict[str, Any]:
    """Return a step as plain data."""
    what = step.what
    facts: dict[str, Any] = {
        "registrar": step.registrar,
        "step": step.number,
        "at": step.at,
        "process": step.process,
        "pid": step.pid,
        "outcome": outcome_of(step),
    }
    if isinstance(what, Began):
        facts |= {"began": [_plain(row) for row in what.rows]}
    else:
        facts |= {
            "end": what.end,
            "why": what.why,
            "items": [{"item": _plain(item), "sender": sender} for item, sender in what.items],
            "rows": [_plain(change) for change in step.rows],
            "effects": [_plain(effect) for effect in what.effects],
        }
    return facts | {"differences": [_plain(difference) for difference in step.differences]}


def difference_text(difference: Difference) -> str:
    """Say in one line what is different."""
    name = f" {difference.name}" if difference.name else ""
    recorded, today = (shortened(_value_text(value)) for value in (difference.recorded, difference.today))
    return f"{difference.of}{name}: recorded {recorded}, today {today}"


def _said(step: ReplayStep) -> str:
    if isinstance(step.what, Began):
        return "the decisions before do not lead here" if step.differences else "where the decisions begin"
    return {"same": "decided again, the same", "different": "today's code decides differently"}.get(
        outcome_of(step), outcome_of(step)
    )


def _rows(began: Began) -> list[RowChange]:
    return [RowChange(*key_of_row(row), None, row) for row in began.rows]


def _item_text(item: Any, sender: str | None) -> str:
    words = [type(item).__name__]
    words += [str(value) for name in _WORDS if (value := getattr(item, name, ""))]
    request = getattr(item, "request", None)
    if isinstance(request, bytes):
        words.append(text_of_value(request))
    elif id := next((id for name in _IDS if (id := getattr(item, name, ""))), ""):
        words.append(short_id(str(id)))
    server = getattr(item, "server", None)
    if isinstance(server, msgspec.Struct):  # of Register
        words[1] = str(getattr(server, "name", ""))
    words += ["from", sender] if sender is not None else []
    return shortened(readable(" ".join(words)))


def _effect_text(effect: Any) -> str:
    match effect:
        case SendReply(origin, message):
            return f"SendReply {type(message).__name__} to {origin}"
        case SendRequest(registrar, message):
            return f"SendRequest {type(message).__name__} to {registrar}"
        case Receive(sender, message):
            return f"Receive {type(message).__name__} from {sender}"
        case _:
            what = getattr(effect, "role", "") or getattr(effect, "what", "") or getattr(effect, "key", "")
            return f"{type(effect).__name__} {what}".rstrip()


def _change_text(change: RowChange) -> str:
    name = f"{change.table} {short_id(change.id)}"
    if change.after is None:
        return f"{name}: gone"
    if change.before is None:
        return f"{name}: {'new' if change.knows_before else 'put'}"
    return f"{name}: {few(_field_changes(change, _SHORT)) or 'the same'}"


def _field_changes(change: RowChange, most: int = TEXT_LIMIT) -> Iterator[str]:
    """Yield what is different in a row, each value with so many characters at the most."""
    for name in change.after.__struct_fields__ if change.after is not None else ():
        before, after = getattr(change.before, name), getattr(change.after, name)
        if before != after:
            texts = map(_value_text, (before, after))
            yield f"{name} {' → '.join(text if len(text) <= most else f'{text[: most - 1]}…' for text in texts)}"


def _row_lines(change: RowChange) -> Iterator[str]:
    later = ", written a moment later" if change.later else ""
    if change.before is not None and change.after is not None:
        yield f"{change.table} {change.id}{later}"
        yield from _indented([[text] for text in _field_changes(change)])
        return
    yield f"{_change_text(change).replace(short_id(change.id), change.id)}{later}"
    yield from list(_value_lines(change.after or change.before))[1:]


def _difference_lines(difference: Difference) -> Iterator[str]:
    yield f"{difference.of} {difference.name}".rstrip()
    for when, value in (("recorded", difference.recorded), ("today", difference.today)):
        lines = list(_value_lines(value))
        yield f"{_MARGIN}{when}: {lines[0]}"
        yield from _indented([lines[1:]])


def _outside_text(put: dict[Any, Any], taken: list[Any]) -> str:
    parts = [f"+ {_value_text(key)}" for key in put] + [f"- {_value_text(key)}" for key in taken]
    return few(parts)


def _value_lines(value: Any) -> Iterator[str]:
    """Yield the lines of a message, a row or an effect: its class, and a line for each field that says something."""
    if not isinstance(value, msgspec.Struct):
        yield _value_text(value)
        return
    yield type(value).__name__
    for name, field in _fields(value):
        yield f"{_MARGIN}{name}: {_value_text(field)}"


def _fields(value: msgspec.Struct) -> Iterator[tuple[str, Any]]:
    """Yield the fields that say something: not empty, and not as they are if nobody gives them."""
    for field in msgspec.structs.fields(value):
        one = getattr(value, field.name)
        if one is not None and one != "" and one != () and one != [] and one != field.default:
            yield field.name, one


def _value_text(value: Any) -> str:
    match value:
        case bytes():
            return text_of_value(value)
        case Opaque(kind):
            return f"<{kind}>"
        case Enum():
            return str(value)
        case "" | None:
            return "nothing"
        case str():
            return readable(value) if value.isprintable() else repr(value)
        case msgspec.Struct():
            said = ", ".join(f"{name}={_value_text(one)}" for name, one in _fields(value))
            return f"{type(value).__name__}({said})"
        case list() | tuple() | set():
            several = ", ".join(map(_value_text, cast("Iterable[Any]", value)))
            return f"[{several}]"
        case dict():
            pairs = cast("dict[Any, Any]", value).items()
            return "{" + ", ".join(f"{_value_text(key)}: {_value_text(one)}" for key, one in pairs) + "}"
        case _:
            return str(value)


def _plain(value: Any) -> Any:
    match value:
        case bytes():
            return text_of_value(value)
        case Opaque(kind):
            return f"<{kind}>"
        case msgspec.Struct():
            return {"is": type(value).__name__} | {one: _plain(getattr(value, one)) for one in value.__struct_fields__}
        case list() | tuple() | set():
            return [_plain(one) for one in cast("Iterable[Any]", value)]
        case dict():
            return {_value_text(key): _plain(one) for key, one in cast("dict[Any, Any]", value).items()}
        case Enum():
            return str(value)
        case _:
            return value


def _indented(blocks: Iterable[Iterable[str]]) -> Iterator[str]:
    for block in blocks:
        for line in block:
            yield _MARGIN + line
