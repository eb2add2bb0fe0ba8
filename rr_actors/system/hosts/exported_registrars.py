"""The registrars that this host exports: whether each is there, and its present incarnation."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from typing import Any

from rr_actors.base.errors import NotExported, RegistrarDown, RrError, did_you_mean, few
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.model.messages import retired
from rr_actors.system.hosts.host_messages import Exported, Exports
from rr_actors.system.hosts.host_settings import Export, is_for
from rr_actors.wire.name_service import Presence
from rr_actors.wire.transport import Hello, Link
from rr_actors.wire.unix_transport import UnixTransport

_LOOK_S = 0.1
_WATCH = "hosts"


class _Watch:
    """The receiver of a link to a registrar that only says when its process has ended."""

    def __init__(self) -> None:
        self.ended = asyncio.Event()

    def received(self, link: Link, message: Any) -> None:
        """Ignore what the registrar tells all its consumers."""

    def lost(self, link: Link, reason: Exception | None) -> None:
        self.ended.set()


class ExportedRegistrars:
    """What this host exports. It looks into the directory, and keeps a link to each registrar that is up.

    Args:
        host: this host's name, for errors.
        changed: called when the status of one has changed.
    """

    def __init__(
        self,
        host: str,
        exports: Mapping[str, Export],
        node: Node,
        transport: UnixTransport,
        changed: Callable[[], None],
    ) -> None:
        self._host, self._exports, self._node, self._transport, self._changed = host, exports, node, transport, changed
        self._states = {name: Exported(name, str(Presence.STARTING), 0, "not looked for yet") for name in exports}
        loop = asyncio.get_running_loop()
        self._tasks = [loop.create_task(self._watch(name)) for name in exports]

    def for_host(self, host: str) -> Exports:
        """Return what another host may load from."""
        return Exports([self._states[name] for name, export in self._exports.items() if is_for(export, host)])

    def check(self, name: str, host: str) -> Exported:
        """Return the state of a registrar that is up, for a link from another host.

        Raises:
            NotExported: the other host may not use it.
            RegistrarDown: it is not up now.
        """
        export = self._exports.get(name)
        if export is None or not is_for(export, host):
            known = [other.name for other in self.for_host(host).exported]
            hint = did_you_mean(name, known) or f"; it exports: {few(known) or 'none'}"
            text = f"host {self._host!r} does not export {name!r} to {host!r}{hint}"
            raise NotExported(text, host=self._host, registrar=name, known=tuple(known))
        state = self._states[name]
        if state.status != Presence.UP:
            text = f"registrar {self._host}/{name}: {state.status}: {state.why}"
            raise RegistrarDown(text, registrar=name, status=state.status)
        return state

    def address(self, name: str) -> str:
        """Return where a registrar of this host is reached; "" if it is not up."""
        entry = self._node.find(name)
        return "" if entry is None else entry.address

    def close(self) -> None:
        """Stop looking."""
        for task in self._tasks:
            task.cancel()

    def _set(self, name: str, status: Presence, epoch: int, why: str) -> None:
        state = Exported(name, str(status), epoch, why)
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
        watch = _Watch()
        try:
            hello = Hello("registrar", name, retired(_WATCH), 0)
            link = await self._transport.connect(address, hello, lambda _link: watch)
        except RrError as error:
            self._set(name, Presence.STARTING, 0, str(error))
            return
        try:
            self._set(name, Presence.UP, link.welcome.epoch, "")
            await watch.ended.wait()
            self._set(name, Presence.STARTING, 0, "its process has ended, or closed its registrar")
        finally:
            link.close()
