"""Pictures as text, for a terminal: a timeline as lanes of lives, a sequence diagram as columns and arrows."""

from __future__ import annotations

import html
import re
from typing import NamedTuple

from rr_actors.system.recording.timeline_lanes import Bar, Lane
from rr_actors.system.recording.timelines import Timeline

WIDTH = 78
"""The columns of a picture."""

_NAME = 24  # characters
_ENDS = {"killed": "✗", "crashed": "◆", "stopped": "■", "unknown": "?"}
_LEGEND = "━ runs  ░ starts  ✗ killed  ◆ ended with an error  ■ stopped  ▲ gave up"
_CODE = re.compile(r"#(quot|lt|gt|\d+);")
_PARTICIPANT = re.compile(r"participant (p\d+) as (.*)")
_ARROW = re.compile(r"(p\d+)(--?)(>>|x)(p\d+): (.*)")
_NOTE = re.compile(r"Note over (p\d+)(?:,p\d+)?: (.*)")
_SAID = re.compile(r"([\d.]+ ms): (.*)", re.DOTALL)


def timeline_text(timeline: Timeline, width: int = WIDTH) -> str:
    """Return a timeline as text: a line for each child, and below them the time in seconds."""
    lanes = [lane for lane in timeline.lanes if lane.bars or lane.marks]
    if not lanes:
        return "nothing has happened to a child"
    names = [_short("  " * lane.path.count("/") + lane.path.rpartition("/")[2]) for lane in lanes]
    label = max(map(len, names)) + 2
    scale = _Scale(timeline.since, timeline.until, width - label)
    lines = [f"{name:<{label}}{_lane(lane, scale)}".rstrip() for name, lane in zip(names, lanes, strict=True)]
    return "\n".join([*lines, " " * label + _axis(scale), " " * label + _LEGEND])


def _short(name: str) -> str:
    return name if len(name) <= _NAME else f"{name[: _NAME - 1]}…"


class _Scale(NamedTuple):
    since: float
    until: float
    columns: int

    def column(self, at: float) -> int:
        place = (at - self.since) / (self.until - self.since) * (self.columns - 1)
        return min(max(round(place), 0), self.columns - 1)


def _lane(lane: Lane, scale: _Scale) -> str:
    cells = [" "] * scale.columns
    gave_up = [mark.at for mark in lane.marks if mark.kind == "gave_up"]
    for bar in lane.bars:
        _draw(bar, cells, scale)
    for bar in lane.bars:  # an end is seen, also where the next life begins
        if bar.how and bar.end is not None:
            cells[scale.column(bar.end)] = _ENDS[bar.how]
    for at in gave_up:
        cells[scale.column(at)] = "▲"
    if gave_up and not any(bar.begin is not None and bar.begin > gave_up[-1] for bar in lane.bars):
        del cells[scale.column(gave_up[-1]) + 1 :]
    return "".join(cells)


def _draw(bar: Bar, cells: list[str], scale: _Scale) -> None:
    begin = scale.column(scale.since if bar.begin is None else bar.begin)
    end = scale.column(scale.until if bar.end is None else bar.end)
    ready = scale.column(bar.ready) if bar.ready is not None else end if bar.how else begin
    for column in range(begin, end + 1):
        cells[column] = "░" if column < ready else "━"


def _axis(scale: _Scale) -> str:
    span_s = scale.until - scale.since
    unit, size = ("ms", 0.001) if span_s < 1 else ("s", 1.0) if span_s < 600 else ("min", 60.0)
    middle, end = (f"{_number(part * span_s / size)} {unit}" for part in (0.5, 1.0))
    half = scale.columns // 2
    return f"{f'0 {unit}':<{half}}{middle:<{scale.columns - half - len(end)}}{end}"


def _number(value: float) -> str:
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def sequence_text(mermaid: str, width: int = WIDTH) -> str:
    """Return a sequence diagram as text, from its Mermaid text: a column for each actor, a line for each message."""
    drawn = [line.strip() for line in mermaid.splitlines()[1:]]
    names = [_plain(found[2]) for line in drawn if (found := _PARTICIPANT.fullmatch(line))]
    if not names:
        return "nothing was sent"
    if len(set(short := [name.removeprefix("root/") for name in names])) == len(names):
        names = short
    names = list(map(_short, names))
    room = max(map(len, names)) + 2
    head = " " * _CLOCK + "".join(name.center(room) for name in names)
    lines = [_cut(head.rstrip(), width)]
    for line in drawn:
        if found := _ARROW.fullmatch(line):
            columns = _arrow(int(found[1][1:]), int(found[4][1:]), found[2] == "--", found[3] == "x", len(names), room)
            lines.append(_with_words(columns, found[5], width))
        elif found := _NOTE.fullmatch(line):
            columns = _lifelines(len(names), room)
            columns[_middle(int(found[1][1:]), room)] = "■"
            lines.append(_with_words(columns, found[2], width))
    if (more := len(lines) - _MOST) > 1:
        lines[_MOST // 2 : _MOST // 2 + more] = [f"{' ' * _CLOCK}… {more} more lines"]
    return "\n".join(lines)


_CLOCK = 11
_MOST = 30  # lines


def _middle(number: int, room: int) -> int:
    return number * room + room // 2


def _lifelines(count: int, room: int) -> list[str]:
    cells = [" "] * (count * room)
    for number in range(count):
        cells[_middle(number, room)] = "│"
    return cells


def _arrow(source: int, target: int, is_answer: bool, is_lost: bool, count: int, room: int) -> list[str]:
    cells = _lifelines(count, room)
    begin, end = _middle(source, room), _middle(target, room)
    if begin == end:
        cells[begin] = "↻"
        return cells
    step = 1 if end > begin else -1
    for column in range(begin + step, end, step):
        cells[column] = "┄" if is_answer else "─"
    cells[end - step] = "✗" if is_lost else ">" if step > 0 else "<"
    return cells


def _with_words(cells: list[str], said: str, width: int) -> str:
    found = _SAID.fullmatch(_plain(said))
    clock, words = (found[1], found[2]) if found else ("", _plain(said))
    line = f"{clock:>{_CLOCK - 1}} {''.join(cells)}  {words}"
    return _cut(line, width)


def _cut(line: str, width: int) -> str:
    return line if len(line) <= width else line[: width - 1] + "…"


def _plain(text: str) -> str:
    """Return a label of Mermaid as it is read."""
    return _CODE.sub(lambda code: html.unescape(f"&{code[0]}" if code[1].isdigit() else f"&{code[1]};"), text)
