"""The registrars that this host exports: whether each is there, and its present incarnation."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable, Mapping
from typing import Any

from rr_actors.base.errors import NotExported, RegistrarDown, RrError, Unavailable, did_you_mean, few
from rr_actors.base.reporting.log import Log
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.links.consumer_links import GATEWAY
from rr_actors.registrar.model.messages import Leased, Released
from rr_actors.system.hosts.host_messages import Exported
from rr_actors.system.hosts.host_settings import Export, is_for
from rr_actors.wire.name_service import Presence
from rr_actors.wire.transport import Hello, Link
from rr_actors.wire.unix_transport import UnixTransport

_log = Log(__name__)

_LOOK_S = 0.1


class _Watch:
    """The receiver of a link to a registrar, by which it says that something is released, or that its process ended."""

    def __init__(self, released: Callable[[int], None]) -> None:
        self.ended = asyncio.Event()
        self._released = released

    def received(self, link: Link, message: Any) -> None:
        """Take what it has released; ignore what it tells all its consumers."""
        if type(message) is Released:
            self._released(message.number)

    def lost(self, link: Link, reason: Exception | None) -> None:
        self.ended.set()


class ExportedRegistrars:
    """What this host exports. It looks into the directory, and keeps a link to each registrar that is up.

    Args:
        host: this host's name, for errors.
        changed: called when the status of one has changed.
        leased: returns the hosts that have a lease; None: this is not known yet.
    """

    def __init__(
        self,
        host: str,
        exports: Mapping[str, Export],
        node: Node,
        transport: UnixTransport,
        changed: Callable[[], None],
        leased: Callable[[], set[str] | None],
    ) -> None:
        self._host, self._exports, self._node, self._transport, self._changed = host, exports, node, transport, changed
        self._leased = leased
        self._fences = {name: _Fence() for name, export in exports.items() if export.on_lost == "release"}
        self._states = {
            name: Exported(name, Presence.STARTING.value, 0, "not looked for yet", name in self._fences)
            for name in exports
        }
        loop = asyncio.get_running_loop()
        self._tasks = [loop.create_task(self._watch(name)) for name in exports]

    def for_host(self, host: str) -> list[Exported]:
        """Return what another host may load from."""
        return [self._states[name] for name, export in self._exports.items() if is_for(export, host)]

    def check(self, name: str, host: str) -> Exported:
        """Return the state of a registrar that is up, for a link from another host.

        Raises:
            NotExported: the other host may not use it.
            RegistrarDown: it is not up now.
            Unavailable: it is still to release what that host held before.
        """
        export = self._exports.get(name)
        if export is None or not is_for(export, host):
            known = [other.name for other in self.for_host(host)]
            hint = did_you_mean(name, known) or f"; it exports: {few(known) or 'none'}"
            text = f"host {self._host!r} does not export {name!r} to {host!r}{hint}"
            raise NotExported(text, host=self._host, registrar=name, known=tuple(known))
        state = self._states[name]
        if state.status != Presence.UP:
            text = f"registrar {self._host}/{name}: {state.status}: {state.why}"
            raise RegistrarDown(text, registrar=name, status=state.status)
        if name in self._fences and self._fences[name].bars(host):
            raise Unavailable(f"registrar {self._host}/{name}: releases what {host!r} held before its lease was over")
        return state

    def lease_over(self, host: str) -> None:
        """Have what that host holds released, also by registrars that are not up now. Until then it gets no link."""
        for fence in self._fences.values():
            fence.owed.add(host)
        self.tell_leased()

    def tell_leased(self) -> None:
        """Tell all registrars that are up which hosts have a lease."""
        for name in self._fences:
            self._tell(name)

    def _tell(self, name: str) -> None:
        fence, leased = self._fences[name], self._leased()
        if fence.link is None or leased is None:
            return
        try:
            fence.link.send_now(fence.leased(leased))
        except RrError as error:
            _log.warning("closing the link to %s: %s", name, error)
            fence.link.close()

    def address(self, name: str) -> str:
        """Return where a registrar of this host is reached; "" if it is not up."""
        entry = self._node.find(name)
        return "" if entry is None else entry.address

    def close(self) -> None:
        """Stop looking."""
        for task in self._tasks:
            task.cancel()

    def _set(self, name: str, status: Presence, epoch: int, why: str) -> None:
        state = Exported(name, str(status), epoch, why, name in self._fences)
        if state != self._states[name]:
            self._states[name] = state
            self._changed()

    async def _watch(self, name: str) -> None:
        while True:
            entry = self._node.find(name)
            if entry is None:
                self._set(name, Presence.STARTING, 0, f"{self._host} has no registrar {name!r} yet")
            elif entry.status is Presence.UP:
                await self._stay(name, entry.address)
            else:
                self._set(name, entry.status, 0, entry.why)
            await asyncio.sleep(_LOOK_S)

    async def _stay(self, name: str, address: str) -> None:
        """Keep a link to a registrar as long as its process lives."""
        fence = self._fences.get(name, _Fence())
        watch = _Watch(fence.released)
        try:
            hello = Hello("registrar", name, GATEWAY, 0)
            link = await self._transport.connect(address, hello, lambda _link: watch)
        except RrError as error:
            self._set(name, Presence.STARTING, 0, str(error))
            return
        try:
            fence.link = link
            if name in self._fences:
                self._tell(name)
            self._set(name, Presence.UP, link.welcome.epoch, "")
            await watch.ended.wait()
            self._set(name, Presence.STARTING, 0, "its process has ended, or closed its registrar")
        finally:
            fence.link = None
            fence.sent.clear()
            link.close()


class _Fence:
    """What one registrar is still to release of hosts whose lease is over.

    Attributes:
        link: to the registrar, while it is up.
        owed: the hosts that it has not said to be released.
        sent: what it was told and has not answered, by number: the hosts that have a lease, and those that it owed.
    """

    def __init__(self) -> None:
        self.link: Link | None = None
        self.owed: set[str] = set()
        self.sent: dict[int, tuple[set[str], set[str]]] = {}
        self._numbers = itertools.count(1)

    def leased(self, hosts: set[str]) -> Leased:
        """Return what to tell the registrar. One that has a lease again is not named before the old one is released."""
        number = next(self._numbers)
        named = hosts - self.owed
        self.sent[number] = named, set(self.owed)
        return Leased(sorted(named), number)

    def released(self, number: int) -> None:
        """Note the registrar's answer."""
        _, owed = self.sent.pop(number, (set(), set()))
        self.owed -= owed

    def bars(self, host: str) -> bool:
        """Return whether what a host holds may still be released, so that it gets no link."""
        return host in self.owed or any(host not in named for named, _ in self.sent.values())
