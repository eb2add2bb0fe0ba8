"""What the overview says, as HTML: whether all is well, five figures, and the last ten minutes of each child."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from rr_actors.base.errors import counted
from rr_actors.base.notebook import escape
from rr_actors.system.console.attention.attention_items import AttentionItem
from rr_actors.system.console.console_messages import ChildRow
from rr_actors.system.recording.event_texts import ago
from rr_actors.system.recording.timeline_lanes import OF_CHILDREN, Lane
from rr_actors.system.recording.timelines import Timeline
from rr_actors.tools.terminal.figure_curves import Curve
from rr_actors.tools.web.frame.detail_html import link_html
from rr_actors.tools.web.frame.details import Link
from rr_actors.tools.web.frame.page_addresses import link_to
from rr_actors.tools.web.frame.page_style import sign

SPAN_S = 600.0
LANES = 60
"""How far back the lanes go, in seconds, and how many there are at most."""
_HOUR_S = 3600.0
_OF_CHILDREN = ("deaths", "given up", "frozen", "stopped", "unavailable", "note", "mailbox")
_WIDTH = 600
_LEAST = 12  # steps of a curve, however little is known
_DEATHS = frozenset(("killed", "crashed", "start_failed", "gave_up"))


@dataclass(frozen=True)
class Figure:
    """One of the five figures: its head, its value, a note, its curve, and how it looks."""

    head: str
    value: str
    note: str
    curve: Sequence[float | None]
    look: str = "still"


def head_card(troubles: Sequence[AttentionItem], problem: str) -> str:
    """Return the head: all is well, or how many things need attention; while nobody answers, that this is not known."""
    if problem:
        look, title, about = "still", "Nobody answers", f"{problem}: what is below is the last that was known."
    elif troubles:
        title = f"{counted(len(troubles), 'thing')} {'needs' if len(troubles) == 1 else 'need'} attention"
        look, about = _look(troubles[0]), troubles[0].what
    else:
        look, title, about = "good", "All is well", "Every child runs, and every resource that is loaded is OK."
    return (
        f'<section class="rr-card rr-head rr-is-{look}">{sign(look)}<div>'
        f'<h1 class="rr-title">{title}</h1><p>{escape(about)}</p></div></section>'
    )


def figures_html(figures: Iterable[Figure]) -> str:
    """Return the five figures, each with its curve."""
    return f'<div class="rr-five">{"".join(map(_figure, figures))}</div>'


def _figure(figure: Figure) -> str:
    known = [value for value in figure.curve if value is not None]
    first = next((at for at, value in enumerate(figure.curve) if value is not None), 0)
    curve = figure.curve[min(first, max(0, len(figure.curve) - _LEAST)) :]
    most = max([1e-9, *known])
    line = "".join(_strokes(curve, most))
    note = f'<span class="rr-note">{escape(figure.note)}</span>' if figure.note else ""
    said = f"{figure.head}, the last ten minutes"
    picture = (
        f'<svg viewBox="0 0 {max(1, len(curve))} 32" preserveAspectRatio="none" role="img" '
        f'aria-label="{escape(said)}"><path d="{line}"/></svg>'
    )
    return (
        f'<section class="rr-card rr-is-{figure.look}"><h2>{escape(figure.head)}</h2>'
        f"<b>{escape(figure.value)}</b>{note}{picture}</section>"
    )


def _strokes(values: Sequence[float | None], most: float) -> Iterator[str]:
    before: float | None = None
    for x, value in enumerate(values):
        if value is not None:
            yield f"{'M' if before is None else 'L'}{x} {30 - 28 * value / most:.1f}h1"
        before = value


def troubles_html(troubles: Sequence[AttentionItem], problem: str) -> str:
    """Return the list of what needs attention, the worst first."""
    rows = "".join(map(_trouble, troubles))
    if not rows:
        text = "What was known is kept below." if problem else "Nothing. What goes wrong stands here, the worst first."
        rows = f'<p class="rr-empty">{text}</p>'
    return (
        '<section class="rr-card rr-plain"><header><h2>Needs attention</h2>'
        '<span class="rr-note">worst first</span></header>' + rows + "</section>"
    )


def _look(item: AttentionItem) -> str:
    return "warm" if item.severity == "WARNING" else "bad"


def _trouble(item: AttentionItem) -> str:
    look, more = _look(item), item.touched - len(item.touches)
    since = "" if item.since is None else f"<time>{ago(max(0.0, time.time() - item.since))}</time>"
    touches = f"touches {', '.join(item.touches)}{f' and {more} more' if more > 0 else ''}" if item.touches else ""
    about = f"<p>{escape(touches)}</p>" if touches else ""
    silence = (
        f'<button type="button" class="rr-act" data-act="silence" data-of="{escape(item.id)}" '
        f'aria-label="silence for 10 min: {escape(item.what)}">Silence</button>'
    )
    return (
        f'<div class="rr-trouble rr-is-{look}" data-key="{escape(item.id)}">{sign(look)}'
        f"<div><b>{escape(item.what)}</b>{about}</div>{since}{silence}{_way_on(item)}</div>"
    )


def _way_on(item: AttentionItem) -> str:
    """Return the button that leads on: to the resource or the child that it is about, or the command that does."""
    if item.resource:
        text, link = "Why", link_to("resource", item.resource)
    elif item.kind in _OF_CHILDREN:
        text, link = "Lives", link_to("child", item.name)
    else:
        return f"<code>rr-actors {escape(item.command)}</code>" if item.command else ""
    label = f'aria-label="{text}: {escape(item.what)}"'
    return f'<a class="rr-act rr-item" data-choose href="{escape(link)}" {label}>{text}</a>'


def restarts_of(lane: Lane, since: float, until: float) -> int:
    """Return how often the child of a lane died between two times."""
    return sum(
        sum(count for kind, count in (mark.counts or {mark.kind: mark.count}).items() if kind in _DEATHS)
        for mark in lane.marks
        if since <= mark.at <= until
    )


def deaths(timeline: Timeline, steps: int = 60) -> tuple[int, str, list[float | None]]:
    """Return how often children died in the last hour, who died most, and the number of each minute."""
    since = timeline.until - _HOUR_S
    counts = {lane.path: restarts_of(lane, since, timeline.until) for lane in timeline.lanes}
    most = max(counts, key=lambda path: counts[path], default="")
    step = _HOUR_S / steps
    curve = [0.0] * steps
    for lane in timeline.lanes:
        for mark in lane.marks:
            if since <= mark.at <= timeline.until:
                died = restarts_of(Lane(lane.path, lane.kind, [], [mark]), since, timeline.until)
                curve[min(steps - 1, int((mark.at - since) / step))] += died
    note = f"{counts[most]} of {most.rpartition('/')[2]}" if most and counts[most] else ""
    return sum(counts.values()), note, list(curve)


def total(curves: Iterable[Sequence[Curve]], kind: str) -> list[float | None]:
    """Return the sum of a figure of all children, step by step; None where nobody looked."""
    columns = zip(
        *(curve.values for curves_of in curves for curve in curves_of if curve.kind.name == kind), strict=False
    )
    return [
        None if all(value is None for value in column) else sum(value for value in column if value is not None)
        for column in columns
    ]


def newest(values: Sequence[float | None]) -> float | None:
    """Return the newest value of a curve, if it is one of the last steps."""
    return next((value for value in reversed(values[-3:]) if value is not None), None)


def lanes_html(timeline: Timeline, children: Sequence[ChildRow], notes: dict[str, str]) -> str:
    """Return the last ten minutes of each child: a bar where it lived, a mark where it died."""
    until = timeline.until
    since = until - SPAN_S
    known = {lane.path: lane for lane in timeline.lanes}
    shown = children[:LANES]
    rows = "".join(_lane(row, known.get(row.path), since, until, notes.get(row.path, "")) for row in shown)
    if not rows:
        rows = '<p class="rr-empty">No child yet. rr-actors start adds one to the tree that runs.</p>'
    else:
        rows = f'<div class="rr-lanes">{rows}</div>'
    first = f"the first {LANES} of {len(children)} children · " if len(children) > LANES else ""
    begins, ends = (time.strftime("%H:%M", time.localtime(at)) for at in (since, until))
    return (
        '<section class="rr-card rr-plain"><header><h2>Last 10 minutes</h2>'
        f'<span class="rr-note">{first}{begins} – {ends}</span></header>{rows}</section>'
    )


def _lane(row: ChildRow, lane: Lane | None, since: float, until: float, usage: str) -> str:
    bars = "".join(_bars(lane, row, since, until)) if lane is not None else ""
    died = restarts_of(lane, since, until) if lane is not None else 0
    note = f"{died} died" if died > 1 else "1 died" if died else usage
    said = f"{row.path}: {row.state}, died {counted(died, 'time')} in ten minutes"
    name = link_html(Link(row.id, "child", row.path), look="rr-item").replace(
        "<a ", f'<a title="{escape(row.path)}" style="padding-left: {12 * max(0, row.depth - 1)}px" ', 1
    )
    return (
        f'{name}<svg viewBox="0 0 {_WIDTH} 18" preserveAspectRatio="none" role="img" aria-label="{escape(said)}">'
        f'{bars}</svg><span class="rr-note">{escape(note)}</span>'
    )


def _bars(lane: Lane, row: ChildRow, since: float, until: float) -> Iterator[str]:
    def x(at: float) -> float:
        return _WIDTH * (min(max(at, since), until) - since) / (until - since)

    for bar in lane.bars:
        end = until if bar.end is None else bar.end
        if end <= since or (bar.begin or since) >= until:
            continue
        left, right = x(bar.begin or since), x(end)
        yield f'<rect class="rr-bar-good" x="{left:.1f}" y="2" width="{max(0.8, right - left):.1f}" height="14"/>'
    last = max((bar.end or until for bar in lane.bars), default=since)
    if row.state in ("unavailable", "restarting", "starting") and last < until:
        look = "bad" if row.state == "unavailable" else "warm"
        yield f'<rect class="rr-bar-{look}" x="{x(last):.1f}" y="2" width="{x(until) - x(last):.1f}" height="14"/>'
    for mark in lane.marks:
        if since <= mark.at <= until and mark.kind in OF_CHILDREN and mark.kind in _DEATHS:
            yield f'<line class="rr-mark" x1="{x(mark.at):.1f}" x2="{x(mark.at):.1f}" y1="0" y2="18"/>'
