"""What a drawer says, as HTML. Every text of a system is escaped, and every name of a thing is a link to it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rr_actors.base.notebook import escape
from rr_actors.tools.tables.row_commands import QUERY_COMMANDS, RowCommand
from rr_actors.tools.tables.table import Row
from rr_actors.tools.web.frame.details import Detail, Fact, Link, Place, Told
from rr_actors.tools.web.frame.page_addresses import link_to
from rr_actors.tools.web.frame.page_style import look_of, pill, sign


def link_html(link: Link, *, look: str = "rr-link") -> str:
    """Return a name as HTML: a link that chooses its thing, if it has one."""
    if not link.kind:
        return escape(link.text)
    return f'<a class="{look}" data-choose href="{escape(link_to(link.kind, link.name))}">{escape(link.text)}</a>'


def head_html(detail: Detail) -> str:
    """Return the head of a drawer."""
    state = pill(detail.state) if detail.state else ""
    note = f'<div class="rr-note">{escape(detail.note)}</div>' if detail.note else ""
    return f"{state}<h2>{escape(detail.title)}</h2>{note}"


def buttons_html(offered: Sequence[RowCommand], *, is_past: bool) -> str:
    """Return the buttons of what can be done."""
    return "".join(_button(one.name, one.name, "", harms=one.harms, is_past=is_past) for one in offered)


def body_html(detail: Detail, *, is_past: bool) -> str:
    """Return the rest of a drawer: its facts, the chain, the rows, what happened, and the log."""
    facts = "".join(
        f"<dt>{escape(fact.head)}</dt><dd>{_code(fact) if fact.is_code else link_html(fact.value)}</dd>"
        for fact in detail.facts
    )
    parts = [f'<dl class="rr-facts">{facts}</dl>' if facts else ""]
    if len(detail.chain) > 1:
        parts.append(f'<h3>Who is touched</h3><ol class="rr-chain">{"".join(map(_place, detail.chain))}</ol>')
    if detail.rows:
        rows = "".join(_row(row, is_past=is_past) for row in detail.rows)
        parts.append(f'<h3>{escape(detail.rows_head)}</h3><div class="rr-list">{rows}</div>')
    told = "".join(map(_told, detail.told)) or '<div class="rr-note">Nothing since this page was served.</div>'
    parts.append(f'<h3>What happened to it</h3><div class="rr-list">{told}</div>')
    if detail.log:
        lines = "".join(_logged(detail.log))
        parts.append(
            f"<h3>The log of {link_html(detail.logger)}</h3>"
            f'<pre class="rr-log" role="region" tabindex="0" aria-label="log">{lines}</pre>'
        )
    parts += [f'<div class="rr-note">{escape(text)}</div>' for text in detail.more]
    return "".join(parts)


def refused_html(text: str) -> str:
    """Return why nothing can be said."""
    return f'<p class="rr-line rr-red">{escape(text)}</p>'


def _code(fact: Fact) -> str:
    return f"<code>{escape(fact.value.text)}</code>"


def _place(place: Place) -> str:
    look = look_of(place.state)
    state = f"{place.state}, " if place.state and place.state != "OK" else ""
    note = f'<span class="rr-note">{escape(state + place.note)}</span>'
    return f'<li class="rr-is-{look}">{sign(look)}{link_html(place.link)} {note}</li>'


def _row(row: Row, *, is_past: bool) -> str:
    text = row.text.strip().removeprefix("-> ")
    styles = "".join(f" rr-{word}" for word in row.style.split())
    link = Link(text, "resource" if row.resource else "", row.resource)
    note = f'<span class="rr-note">{escape(row.note)}</span>' if row.note else ""
    buttons = ""
    if any(not one.obstacle(row) for one in QUERY_COMMANDS):
        acts = [(one.name, one.harms) for one in QUERY_COMMANDS if not one.obstacle(row)]
        buttons = "".join(
            _button(name, name, row.query, harms=harms, is_past=is_past, small=True)
            for name, harms in [*acts, ("priority", False)]
        )
    return f'<div class="rr-line{styles}"><span>{link_html(link)}</span>{note}{buttons}</div>'


def _told(told: Told) -> str:
    style = "".join(f" rr-{word}" for word in told.style.split())
    more = f'<pre class="rr-log" tabindex="0">{escape(chr(10).join(told.more))}</pre>' if told.more else ""
    text = f'<span class="{style.strip()}">{escape(told.text)}</span>'
    return f'<div class="rr-line"><time>{told.at}</time>{text}</div>{more}'


def _logged(lines: Iterable[Told]) -> Iterable[str]:
    for line in lines:
        style = "".join(f" rr-{word}" for word in line.style.split())
        more = "".join(f"\n    {escape(text)}" for text in line.more)
        yield f'<span class="{style.strip()}">{escape(line.text)}</span>{more}\n'


def _button(text: str, act: str, of: str, *, harms: bool, is_past: bool, small: bool = False) -> str:
    looks = " ".join(filter(None, ("rr-act", "rr-harmful" if harms else "", "rr-small" if small else "")))
    off = " disabled" if is_past else ""
    marks = f'class="{looks}" data-act="{escape(act)}" data-of="{escape(of)}"{off}'
    return f'<button type="button" {marks}>{escape(text)}</button>'
