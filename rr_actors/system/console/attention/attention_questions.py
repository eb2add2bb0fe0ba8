"""The console's question about what needs attention, and the command that silences an item for a while."""

from __future__ import annotations

import time

import msgspec

from rr_actors.base.errors import NotFound, few, shown
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.attention.attention_items import AttentionItem, needs_attention
from rr_actors.system.console.attention.attention_sources import known_of
from rr_actors.system.console.connected_registrars import Caller
from rr_actors.system.console.console_view import Command, Look, View


class Attention(c.Message, frozen=True):
    """What needs attention, the worst first: at most 500 items, of `total`.

    `silenced`: the items that are silenced, and until when (seconds since the epoch). `notes`: registrars that could
    not be asked, and why.
    """

    total: int
    items: list[AttentionItem]
    silenced: dict[str, float] = msgspec.field(default_factory=dict[str, float])
    notes: list[str] = msgspec.field(default_factory=list[str])


class ListAttention(Look[Attention], frozen=True):
    """What needs attention now, without what is silenced."""

    def _carry_out(self, view: View, caller: Caller) -> Attention:
        known, notes = known_of(view)
        silenced = view.silences.now()
        items = [item for item in needs_attention(known) if item.id not in silenced]
        return Attention(len(items), items[: c.PAGE_LIMIT], silenced, notes)


class Silence(Command[c.Done], frozen=True):
    """Leave an item out of the answers for `for_s` seconds; with 0 it is shown again.

    `item` may be a part of its id.
    """

    item: c.Text
    for_s: c.Seconds

    def _carry_out(self, view: View, caller: Caller) -> c.Done:
        ids = [*(item.id for item in needs_attention(known_of(view)[0])), *view.silences.now()]
        meant = [id for id in ids if id == self.item] or [id for id in ids if self.item in id]
        named = list(dict.fromkeys(meant))
        if len(named) != 1:
            got = f"several have it: {few(named)}" if named else f"there are: {few(dict.fromkeys(ids)) or 'none'}"
            raise NotFound(f"{shown(self.item)}: expected the id of an item, or a part of one id; {got}", id=self.item)
        until = view.silences.add(named[0], self.for_s)
        facts = {"item": named[0], "until": until}
        if not self.for_s:
            return c.Done(f"{named[0]} is shown again", facts)
        return c.Done(f"{named[0]} is silenced until {time.strftime('%H:%M:%S', time.localtime(until))}", facts)
