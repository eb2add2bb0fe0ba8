"""Unloads: how a registrar lets go, of one query or of many, and what becomes of a release that takes too long.

One query goes by the registrar's actor, or, for a thread that waits, directly: the thread writes that it is owed, asks
the provider, and forgets it (actors/registrar_state.py). Who waits for a provider that is down hears so when the time
is up; the release stays owed, on disk, until it is back.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable

from rr_actors.actors.callbacks import Current, check_not_own, serving
from rr_actors.actors.calls import Calls, Together, settle
from rr_actors.actors.direct import Line
from rr_actors.actors.registrar import RegistrarActor, UnloadWaiter
from rr_actors.actors.releases import Releases
from rr_actors.actors.replies import Reply
from rr_actors.core import commands as c
from rr_actors.errors import NotHolder, RrError, Unavailable, UnknownServer, shortened
from rr_actors.messages import Failure, Unload, Unloaded, UnloadRefused
from rr_actors.names import ServerId
from rr_actors.records import Held, Hold
from rr_actors.views import Views


class Unloads:
    """The unloads of one registrar. From any thread."""

    def __init__(self, actor: RegistrarActor, calls: Calls, views: Views) -> None:
        self._actor = actor
        self.calls = calls
        self._views = views

    def wait(self, query_id: str, timeout_s: float | None) -> None:
        """Let a query go, and return when that is done.

        Raises:
            RrError: how the unload ended.
        """
        if self.calls.is_inside():  # a finalizer, which the garbage collector runs: it cannot wait
            self.future(query_id, timeout_s)
        elif not self._directly(query_id, timeout_s):
            self._finish(functools.partial(self.release, query_id), query_id, timeout_s, timeout_s)

    def _finish(
        self, begin: Callable[[UnloadWaiter], None], query_id: str, left_s: float | None, timeout_s: float | None
    ) -> None:
        future = self.calls.start(begin)
        overdue = functools.partial(self.release_overdue, query_id, timeout_s)
        self.calls.finish(future, left_s, f"unloading {query_id}", overdue)

    def future(self, query_id: str, timeout_s: float | None) -> Reply[None]:
        """Let a query go, and return a future of that at once."""
        releasing = _Releasing(self, query_id, timeout_s)
        self.calls.dispatcher.call(releasing.begin)
        return releasing.reply

    def force_wait(self, target: str, timeout_s: float | None) -> None:
        """Unload a resource served here whoever holds it, and return when that is done.

        Raises:
            RrError: how the unload ended.
        """

        def is_of_it(me: Current) -> bool:
            resource = self._actor.catalog.find(target)
            return serving(me) is self._actor and resource is not None and resource.id == me.resource_id

        what = f"registrar {self._actor.name!r}: the forced unload of {shortened(target)}"
        check_not_own(what, is_of_it, "with block=False it does not wait")
        try:
            self.calls.finish(self.force_future(target), timeout_s, f"unloading {shortened(target)}")
        except Unavailable as error:
            if type(error) is not Unavailable or timeout_s is None:  # closed, say
                raise
            server = self.calls.call(self._missing_server, target)
            if server is None:
                raise
            text = f"resource {target}: it is unloaded when its server is there again: register {server!r}"
            raise Unavailable(f"{text} (not within {timeout_s:g} s)", server=server, timeout_s=timeout_s) from None

    def _missing_server(self, target: str) -> str | None:
        catalog = self._actor.catalog
        resource = catalog.find(target)
        return None if resource is None or resource.server in catalog.servers else catalog.origin_of(resource)

    def force_future(self, target: str) -> Reply[None]:
        """Unload a resource served here whoever holds it, and return a future of that at once."""
        return self.calls.start(functools.partial(self._actor.force, target))

    def many(self, wanted: Callable[[Held], bool], timeout_s: float | None) -> Reply[None]:
        """Let every query go that is held and `wanted`, newest first; a future of when all have been tried."""
        return self.calls.call(self._release_many, wanted, timeout_s)

    def at_server(self, server: ServerId, timeout_s: float | None) -> Reply[None]:
        """Let every query go that is held at a server, newest first; a future of when all have been tried.

        Raises:
            UnknownServer: nothing is held there, nor ever was.
        """
        self.calls.call(self._check_client, server)
        return self.many(lambda held: (held.registrar, held.server) == server, timeout_s)

    def _check_client(self, server: ServerId) -> None:
        if self._views.was_at(server):
            return
        with self._actor.lock:
            held = self._actor.whole().held.values()
            known = tuple(sorted({f"{row.registrar}/{row.server}" for row in held if row.hold is not Hold.OWED}))
        at = "it holds nothing at any server" if not known else f"it holds something at {', '.join(known)}"
        text = f"unload_client({str(server)!r}): registrar {self._actor.name!r} holds nothing there and never did; {at}"
        raise UnknownServer(text, server=str(server), known=known)

    # -- directly ------------------------------------------------------------------------------------------------

    def _directly(self, query_id: str, timeout_s: float | None) -> bool:
        """Let a query go by a line of this thread's own; False if it is none for that, or there is no line.

        Raises:
            RrError: how the unload ended.
        """
        actor = self._actor
        provider = self._provider_of(query_id)
        if provider is None or not self.calls.dispatcher.may_block():
            return False
        line: Line | None = None
        began = time.monotonic()
        try:
            line = actor.direct.take(provider)
            if line is None:
                return False
            if not actor.owe(query_id):
                actor.direct.give_back(provider, line)
                return False
            answer = line.exchange(Unload(query_id, actor.name), timeout_s)
            actor.direct.give_back(provider, line)
            if type(answer) is Unloaded and not actor.let_go(query_id):
                self.calls.dispatcher.call(actor.receive, answer, provider)
        except OSError:  # TimeoutError, too: what is left of the time is nothing then
            _close(line)
            answer = None
        except BaseException:  # KeyboardInterrupt, say: it is let go all the same
            _close(line)
            self.calls.dispatcher.call(actor.go_on_unloading, query_id, _nobody)
            raise
        if type(answer) is Unloaded:
            self._views.forget(query_id)
        else:
            refusal = answer.failure if type(answer) is UnloadRefused else None
            left_s = None if timeout_s is None else max(0.0, timeout_s - (time.monotonic() - began))
            go_on = functools.partial(actor.go_on_unloading, query_id, refusal=refusal)
            self._finish(go_on, query_id, left_s, timeout_s)
        return True

    def _provider_of(self, query_id: str) -> str | None:
        held = self._actor.catalog.held.get(query_id)
        return None if held is None or held.parent else held.registrar

    # -- on the loop ---------------------------------------------------------------------------------------------

    def release(self, query_id: str, done: UnloadWaiter) -> None:
        """Let a query go by the registrar's actor; `done` hears how that ended."""
        theirs = self._actor.catalog.queries.get(query_id)
        if query_id not in self._actor.catalog.held and theirs is not None and theirs.origin != self._actor.name:
            done(not_holder(query_id, theirs.origin, self._actor.name))
        else:
            self._actor.release(query_id, done)

    def release_overdue(self, query_id: str, timeout_s: float | None) -> None:
        """Have who waits for the unload of a query hear that its provider has not answered in time."""
        held = self._actor.catalog.held.get(query_id)
        where = "its provider" if held is None else f"{held.registrar!r}"
        text = f"query {query_id}: {where} did not answer within {timeout_s:g} s; the release is owed and will be sent"
        details = {"registrar": "" if held is None else held.registrar, "timeout_s": timeout_s}
        if not self._actor.closed:
            self._actor.post(c.ReleaseOverdue(query_id, Failure("Unavailable", text, details)))

    def _release_many(self, wanted: Callable[[Held], bool], timeout_s: float | None) -> Reply[None]:
        with self._actor.lock:  # meanwhile no thread lets one of them go
            held = self._actor.whole().held
            mine = [id for id in self._actor.newest_first() if wanted(held[id]) and held[id].hold is Hold.HELD]
            together = Together(mine)
            releases = Releases(self._actor, mine, together.ended)
        if timeout_s is not None and mine:
            self.calls.limit(timeout_s, _ReleasingMany(self, releases, together, timeout_s))
        return together.reply


class _Releasing:
    """A release by the registrar's actor, and its reply. On the loop."""

    __slots__ = ("_query_id", "_timeout_s", "_unloads", "reply")

    def __init__(self, unloads: Unloads, query_id: str, timeout_s: float | None) -> None:
        self._unloads = unloads
        self._query_id = query_id
        self._timeout_s = timeout_s
        self.reply: Reply[None] = Reply()

    def begin(self) -> None:
        """Let it go."""
        self._unloads.release(self._query_id, self._ended)
        if self._timeout_s is not None:
            self._unloads.calls.limit(self._timeout_s, self)

    def _ended(self, error: RrError | None) -> None:
        settle(self.reply, error)

    @property
    def is_done(self) -> bool:
        """Whether it has ended."""
        return self.reply.done()

    def overdue(self) -> None:
        """See Unloads.release_overdue()."""
        self._unloads.release_overdue(self._query_id, self._timeout_s)


class _ReleasingMany:
    """The releases of many queries that have one time limit. On the loop."""

    def __init__(self, unloads: Unloads, releases: Releases, together: Together, timeout_s: float) -> None:
        self._unloads = unloads
        self._releases = releases
        self._together = together
        self._timeout_s = timeout_s

    @property
    def is_done(self) -> bool:
        """Whether all have ended."""
        return self._together.reply.done()

    def overdue(self) -> None:
        """Have all of those that have not ended be owed, and known to be late."""
        self._releases.hurry()
        for query_id in list(self._together.pending):
            self._unloads.release_overdue(query_id, self._timeout_s)


def _close(line: Line | None) -> None:
    if line is not None:
        line.close()


def _nobody(_error: RrError | None) -> None:
    """Who hears how an unload ends whose caller was interrupted."""


def not_holder(query_id: str, origin: str, caller: str) -> NotHolder:
    """The error for who lets go what another registrar holds."""
    text = f"query {query_id}: held by {origin!r}, not by {caller!r}; unload it there"
    return NotHolder(text, query_id=query_id, origin=origin, caller=caller)
