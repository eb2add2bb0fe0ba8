"""Texts about the mailbox of an actor: what waits, what is handled, whom the handler waits for, and rings of asks."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from rr_actors.actors.messaging.mailbox_looks import COUNTED, ON_START, MailboxInfo, MessageInfo
from rr_actors.base.errors import NotFound, Unavailable
from rr_actors.tools.explanations import seconds_text

Look = Callable[[str], MailboxInfo]
_DEEP = 20  # actors that wait for one another


def mailbox_lines(found: MailboxInfo) -> Iterator[str]:
    """Yield lines about a mailbox: how full it is, what waits since when, and what is handled since when."""
    yield f"{found.path}: {_count(found.length)}, at most {found.limit:,}{', paused' if found.is_paused else ''}"
    if found.oldest is not None:
        yield f"    oldest: {found.oldest}{_for(found.oldest.since_s)}"
        first = f" (of the first {COUNTED})" if found.length > COUNTED else ""
        yield f"    types: {_types(found)}{first}"
    yield f"    handles: {'nothing' if found.handled is None else f'{found.handled}{_since(found.handled)}'}"
    if found.waits_for:
        yield f"    waits for: {', '.join(found.waits_for)}"


def explain_actor(look: Look, id: str) -> list[str]:
    """Return sentences about what an actor does, whom it waits for, and so on; none if no actor has this id or path.

    Args:
        look: returns the mailbox of the actor of an id or path, or raises NotFound.
    """
    if " " in id:  # the name of a resource
        return []
    try:
        found = look(id)
    except NotFound:
        return []
    return list(_explained(look, found))


def _explained(look: Look, found: MailboxInfo) -> Iterator[str]:
    yield f"{found.path} {_doing(found)}."
    if found.length:
        oldest = (
            f", the oldest{_for(found.oldest.since_s)}" if found.oldest and found.oldest.since_s is not None else ""
        )
        yield f"In its mailbox {_count(found.length)}{oldest}: {_types(found)}."
    yield from _waits(look, found, [found.path])


def _waits(look: Look, found: MailboxInfo, above: list[str]) -> Iterator[str]:
    """Say for whom an actor waits, and what that one does; `above` are the actors that wait for this one."""
    for target in found.waits_for:
        waits = f"{found.path} waits for {target}"
        if target in above:
            ring = " → ".join((*above[above.index(target) :], target))
            yield f"{waits}: that is a ring of asks, {ring}. It lasts until the time limit of one of them."
            continue
        try:
            asked = look(target)
        except (NotFound, Unavailable) as error:
            yield f"{waits}: {error}."
            continue
        waiting = f"; in its mailbox {_count(asked.length)}" if asked.length else ""
        yield f"{waits}, which {_doing(asked)}{waiting}."
        if len(above) < _DEEP:
            yield from _waits(look, asked, [*above, target])


def _doing(found: MailboxInfo) -> str:
    doing = found.handled
    if doing is None:
        return "is paused, and handles nothing" if found.is_paused else "handles nothing"
    paused = "is paused, and " if found.is_paused else ""
    if doing.type == ON_START:
        return f"{paused}has been in its on_start{_for(doing.since_s)}"
    kind = f"`{doing.type}`" if doing.type else "a message"
    sender = f" from {doing.sender}" if doing.sender else ""
    return f"{paused}has handled {kind}{sender}{_since(doing)}"


def _types(found: MailboxInfo) -> str:
    return ", ".join(f"{count} {kind or 'of unknown type'}" for kind, count in found.types.items())


def _count(count: int) -> str:
    return "no message waits" if not count else "1 message waits" if count == 1 else f"{count:,} messages wait"


def _since(message: MessageInfo) -> str:
    return "" if message.since_s is None else f" since {seconds_text(message.since_s)}"


def _for(seconds: float | None) -> str:
    return "" if seconds is None else f" for {seconds_text(seconds)}"
