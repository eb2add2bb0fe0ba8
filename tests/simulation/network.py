"""Links and processes of a simulated world: how messages arrive, and how connections and processes come and go."""

from __future__ import annotations

from typing import Any

from rr_actors.base.values.failure import Failure
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.messages import Gone
from rr_actors.registrar.model.rows import Hold
from simulation.sim_links import TO_CONSUMER, TO_PROVIDER, SimLine, SimLink
from simulation.world_state import WorldState

DOWN = Failure("RegistrarDown", "stopped")
OLD = 2  # the way of messages that a consumer sent over the link before the present one


class Network(WorldState):
    """Steps: net, dial, up, serve; crash, retire."""

    def net(self, consumer: str, provider: str, way: int) -> bool:
        """The next message on a link arrives; behind the last on a cut one, that it is cut."""
        key = ("net", consumer, provider, way)
        if key not in self.todo or (self.held_up and self.parted(consumer, provider)):
            return False
        if way == OLD:
            link = self.old[consumer, provider]
            queue = link.ways[TO_PROVIDER]
        elif way == TO_PROVIDER:
            link = self.registrars[provider].links[consumer]
            queue = link.ways[way]
        else:
            link = self.registrars[consumer].clients[provider].link
            queue = link.ways[way]
        if queue:
            message = queue.popleft()
            if not queue and not link.cut:
                self.todo.discard(key)
            if way == TO_CONSUMER:
                self.registrars[consumer].from_provider(provider, message)
            else:
                self.registrars[provider].from_consumer(consumer, link, message)
            return True
        self.todo.discard(key)
        if way == TO_CONSUMER:
            self.registrars[consumer].unlinked(provider)
        elif way == OLD:
            del self.old[consumer, provider]
        else:
            del self.registrars[provider].links[consumer]
            self.registrars[provider].consumer_lost(consumer)
        return True

    def dial(self, consumer: str, provider: str) -> bool:
        """A consumer tries to reach a provider."""
        key = ("dial", consumer, provider)
        if key not in self.todo:
            return False
        here, there = self.registrars[consumer], self.registrars[provider]
        known = there.state in ("away", "absent") and provider in here.gone and provider not in here.asked
        stays_down = there.state == "absent" or (there.state == "stopped" and provider in here.stopped)
        asked = provider in here.asked or (stays_down and here.catalog.waits_for(provider))
        (here.stopped.add if there.state == "stopped" else here.stopped.discard)(provider)
        if not known and (gone := self.unreachable(provider, asked)) is not None:
            here.asked.discard(provider)
            here.post(gone)
            if gone.final:
                here.gone.add(provider)
        if there.state not in ("away", "absent"):
            here.gone.discard(provider)
        if there.state == "gone" or (there.state in ("away", "absent") and not here.catalog.needs(provider)):
            self.todo.discard(key)
        if self.parted(consumer, provider) or (
            there.state != "up" and not (there is here and there.state == "starting")
        ):
            return there.state in ("gone", "stopped", "away", "absent")
        self.todo.discard(key)
        link = SimLink(here.epoch)
        old = there.links.get(consumer)
        there.links[consumer] = link
        if old is not None:
            self._replace_link(consumer, provider, old)
        here.linked(provider, link, self.run_of(consumer, provider))
        self.todo.discard(key)  # what was decided meanwhile has found no link yet: this one is for it, too
        return True

    def _replace_link(self, consumer: str, provider: str, old: SimLink) -> None:
        self.registrars[provider].consumer_lost(consumer)
        self.todo.discard(("net", consumer, provider, TO_PROVIDER))
        old.cut = True
        self.old[consumer, provider] = old
        self.todo.add(("net", consumer, provider, OLD))

    def up(self, name: str) -> bool:
        """A dead registrar is started again."""
        registrar = self.registrars[name]
        if registrar.state not in ("down", "stopped", "away", "absent") or registrar.disk_is_full:
            return False
        self.todo.discard(("up", name))
        registrar.start()
        return True

    def serve(self, name: str) -> bool:
        """A registrar's on_start has returned."""
        key = ("serve", name)
        if key not in self.todo:
            return False
        self.todo.discard(key)
        registrar = self.registrars[name]
        for origin in {**registrar.catalog.by_origin, **registrar.catalog.notices_to}:
            if self.is_gone(origin):
                registrar.receive(Gone(origin), origin)
        registrar.serve()
        return True

    def unreachable(self, provider: str, asked: bool) -> c.PeerGone | None:
        """What a consumer concludes about a provider that it cannot reach."""
        raise AssertionError(provider, asked)

    def is_gone(self, name: str) -> bool:
        """Whether the directory says that a registrar is gone for good."""
        raise AssertionError(name)

    # -- what breaks ---------------------------------------------------------------------------------------------

    def _cut(self, consumer: str, provider: str, link: SimLink, kept: tuple[int, int]) -> None:
        link.lose(kept)
        if self.registrars[provider].links.get(consumer) is link:
            self.todo.add(("net", consumer, provider, TO_PROVIDER))
        peering = self.registrars[consumer].clients.get(provider)
        if peering is not None and peering.link is link:
            self.todo.add(("net", consumer, provider, TO_CONSUMER))

    def crash(self, name: str, becomes: str = "down") -> bool:
        """A process is killed."""
        registrar = self.registrars[name]
        if registrar.state not in ("up", "starting"):
            return False
        registrar.state = becomes
        for key in [key for key in self.todo.keys if key[0] in _OF_A_PROCESS and key[1] == name]:
            self.todo.discard(key)
        for provider, peering in list(registrar.clients.items()):  # what it sent may still arrive
            registrar.clients.pop(provider)
            self.todo.discard(("net", name, provider, TO_CONSUMER))
            self._cut(name, provider, peering.link, (1_000_000, 0))
        for consumer, link in list(registrar.links.items()):
            registrar.links.pop(consumer)
            self.todo.discard(("net", consumer, name, TO_PROVIDER))
            self._cut(consumer, name, link, (0, 1_000_000))
        for consumer, provider in [pair for pair in self.old if pair[1] == name]:
            del self.old[consumer, provider]
            self.todo.discard(("net", consumer, provider, OLD))
        self._break_lines(name)
        on_disk = registrar.disk["held"]
        for query_id, fate in self.ledger.fate.items():
            if fate == "held" and not _is_held(on_disk.get(query_id)) and self.asker.get(query_id) == name:
                self.ledger.forgotten.add(query_id)
        for query_id in [id for id, holder in self.letting.items() if holder == name]:
            del self.letting[query_id]
        self.ledger.cut_short.update((run.id, run.number) for run in registrar.runs.values() if run.kind == "reload")
        registrar.fresh()
        self.ledger.crashed(name)
        self.ledger.forget_ends(id for id, asker in self.asker.items() if asker == name)
        if becomes != "gone":
            self.todo.add(("up", name))
        return True

    def break_line(self, line: SimLine) -> None:
        """Its provider closes it."""
        query_id = line.query_id
        line.broken = True
        line.ways[TO_PROVIDER].clear()
        self.todo.discard(("line", query_id, TO_PROVIDER))
        if not line.left:
            self.todo.add(("line", query_id, TO_CONSUMER))

    def _break_lines(self, name: str) -> None:
        for query_id, line in list(self.lines.items()):
            if line.consumer == name:
                line.left = True
                self.todo.discard(("line", query_id, TO_CONSUMER))
            elif line.provider == name:
                self.break_line(line)
            if line.left and not line.ways[TO_PROVIDER]:
                self.todo.discard(("line", query_id, TO_CONSUMER))
                del self.lines[query_id]

    def expel(self, provider: str, consumer: str) -> None:
        """A provider does not listen to a consumer any more that is gone for good."""
        link = self.registrars[provider].links.pop(consumer, None)
        if link is not None:
            self.todo.discard(("net", consumer, provider, TO_PROVIDER))
            self._cut(consumer, provider, link, (0, 1_000_000))
            self.registrars[provider].consumer_lost(consumer)

    def retire(self, name: str) -> bool:
        """A process dies for good: all its providers hear of it, those that are down when they are back."""
        if not self.crash(name, "gone"):
            return False
        self.retired.add(name)
        for registrar in self.registrars.values():
            if registrar.state == "up":
                registrar.receive(Gone(name), name)
        return True


_OF_A_PROCESS = frozenset(
    ("wake", "act", "save", "register", "serve", "timer", "call", "tire", "late", "dial", "reregister", "closing")
)


def _is_held(row: Any) -> bool:
    return row is not None and row.hold is Hold.HELD
