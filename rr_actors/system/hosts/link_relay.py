"""Relay: a link that was accepted, and the link that is opened for it; what one brings goes out by the other."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from rr_actors.base.errors import RrError, Unavailable
from rr_actors.base.reporting.log import Log
from rr_actors.wire.transport import Attach, Link, Receiver

_log = Log(__name__)

WAITING_LIMIT = 10_000
"""How many messages may wait until the other link is open."""
_AGAIN_S = 0.2


class _End:
    """One end of a relay: a Receiver."""

    def __init__(self, received: Callable[[Link, Any], None], lost: Callable[[Link, Exception | None], None]) -> None:
        self._received, self._lost = received, lost

    def received(self, link: Link, message: Any) -> None:
        self._received(link, message)

    def lost(self, link: Link, reason: Exception | None) -> None:
        self._lost(link, reason)


class Relay:
    """The messages between two links. If one is lost, the other is closed: its end opens a new one and asks again.

    Args:
        near: the link that was accepted.
        epoch: the incarnation of the provider for which it was accepted.
        dial: opens the other link.
        forth: takes a message of the near link. Returns what goes out by the other; None: nothing does.
        back: the same for a message of the other link.
        ended: called once, when both links are closed.
    """

    def __init__(
        self,
        near: Link,
        epoch: int,
        dial: Callable[[Attach], Awaitable[Link]],
        forth: Callable[[Link, Any], Any],
        back: Callable[[Link, Any], Any],
        ended: Callable[[Relay], None],
    ) -> None:
        self._near, self._epoch, self._dial, self._ended = near, epoch, dial, ended
        self._forth, self._back = forth, back
        self._far: Link | None = None
        self._waiting: list[Any] = []
        self._closed = False
        self._opening = asyncio.get_running_loop().create_task(self._open())

    @property
    def end(self) -> Receiver:
        """The receiver of the near link."""
        return _End(self._from_near, self._lost)

    async def _open(self) -> None:
        hello = self._near.hello
        try:
            far = await self._dial(lambda _link: _End(self._from_far, self._lost))
            if self._closed:
                far.close()
                return
            self._far = far
            if far.welcome.epoch != self._epoch:
                raise Unavailable(f"{hello.to} has started again meanwhile")
            waiting, self._waiting = self._waiting, []
            for message in waiting:
                far.send(message)
            far.flush()
        except Exception as error:
            if isinstance(error, RrError):
                _log.info("no link of %s to %s: %s", hello.origin, hello.to, error)
            else:
                _log.exception("no link of %s to %s", hello.origin, hello.to)
            await asyncio.sleep(_AGAIN_S)  # the other end of `near` opens another at once
            self.close()

    def _from_near(self, link: Link, message: Any) -> None:
        if (out := self._forth(link, message)) is None:
            return
        if self._far is not None:
            self._pass_on(self._far, out, more=link.more)
        elif len(self._waiting) < WAITING_LIMIT:
            self._waiting.append(out)
        else:
            self._give_up(f"{len(self._waiting)} messages wait for the link to {link.hello.to}")

    def _from_far(self, link: Link, message: Any) -> None:
        if (out := self._back(link, message)) is not None:
            self._pass_on(self._near, out, more=link.more)

    def _pass_on(self, link: Link, message: Any, *, more: bool) -> None:
        try:
            link.send(message)
            if not more:
                link.flush()
        except RrError as error:
            self._give_up(str(error))

    def _give_up(self, why: str) -> None:
        _log.warning("closing the link of %s to %s: %s", self._near.hello.origin, self._near.hello.to, why)
        asyncio.get_running_loop().call_soon(self.close)  # not within the receiver of one of them

    def _lost(self, _link: Link, _reason: Exception | None) -> None:
        self.close()

    def close(self) -> None:
        """Close both links."""
        if self._closed:
            return
        self._closed = True
        if self._opening is not asyncio.current_task():
            self._opening.cancel()
        if self._far is not None:
            self._far.close()
        self._near.close()
        self._ended(self)
