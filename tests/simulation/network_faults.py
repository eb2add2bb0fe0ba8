"""Trouble around the processes of a simulated world: broken links, partitions, messages that come twice, full disks."""

from __future__ import annotations

import itertools

from rr_actors.registrar.model.messages import Fetch, Fetched, Noticed
from simulation.network import Network
from simulation.sim_links import TO_CONSUMER, SimLink

_ONCE = (Fetch, Fetched)
"""What opens a link: said once on each, and never again behind anything else."""


class Trouble(Network):
    """Steps: cut, snap, part, heal, dup, full, space."""

    def cut(self, consumer: str, provider: str, kept_there: int, kept_here: int) -> bool:
        """A link breaks; of what is on its way, so many messages to the provider and to the consumer still arrive."""
        peering = self.registrars[consumer].clients.get(provider)
        if peering is None or peering.link.cut:
            return False
        self._cut(consumer, provider, peering.link, (kept_there, kept_here))
        return True

    def snap(self, query_id: str) -> bool:
        """A direct line breaks: the question may be lost, or the answer."""
        line = self.lines.get(query_id)
        if line is None or line.broken or line.left:
            return False
        self.break_line(line)
        line.ways[TO_CONSUMER].clear()
        return True

    # -- partitions ----------------------------------------------------------------------------------------------

    def part(self, names: tuple[str, ...], how: str, kept: int = 0) -> bool:
        """Some registrars are cut off from the others until it heals: no new links.

        Args:
            names: those on one side.
            how: "cut": the links across break, so many messages of each way still arrive. "hold": they stay, and
                what is on them does not arrive before it heals.
            kept: of "cut".
        """
        if self.apart:
            return False
        self.apart = frozenset(names)
        self.held_up = how == "hold"
        if how == "cut":
            for registrar in self.registrars.values():
                for provider in list(registrar.clients):
                    if self.parted(registrar.name, provider):
                        self.cut(registrar.name, provider, kept, kept)
            for query_id, line in list(self.lines.items()):
                if self.parted(line.consumer, line.provider):
                    self.snap(query_id)
        return True

    def heal(self) -> bool:
        """All can reach all again."""
        if not self.apart:
            return False
        self.apart = frozenset()
        self.held_up = False
        return True

    # -- messages that come twice --------------------------------------------------------------------------------

    def dup(self, consumer: str, provider: str, way: int, place: int, behind: int) -> bool:
        """A message on a link comes a second time. A notice before the list is passed over: it never comes behind that.

        Args:
            place: of the message among those on their way.
            behind: so many others come between, if there are as many.
        """
        peering = self.registrars[consumer].clients.get(provider)
        link: SimLink | None = peering.link if peering is not None else None
        if link is None or len(link.ways[way]) <= place or isinstance(link.ways[way][place], _ONCE):
            return False
        queue = link.ways[way]
        between = itertools.islice(queue, place + 1, place + 1 + behind)
        if isinstance(queue[place], Noticed) and any(isinstance(message, Fetched) for message in between):
            return False
        queue.insert(place + 1 + behind, queue[place])
        return True

    # -- disks ---------------------------------------------------------------------------------------------------

    def full(self, name: str) -> bool:
        """A registrar's disk is full until there is space again: no commit succeeds, and no start."""
        registrar = self.registrars[name]
        if registrar.disk_is_full:
            return False
        registrar.disk_is_full = True
        return True

    def space(self, name: str) -> bool:
        """There is space again."""
        registrar = self.registrars[name]
        if not registrar.disk_is_full:
            return False
        registrar.disk_is_full = False
        return True
