"""Releases: many queries are released, newest first, and few at a time, so that both sides keep up."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable, Iterable

from rr_actors.base.errors import RrError
from rr_actors.registrar.engine.registrar_actor import RegistrarActor
from rr_actors.registrar.model.rows import Hold
from rr_actors.runtime.thread_rules import on_loop

AT_A_TIME = 4096
"""Releases in progress at each provider: as many as callbacks may wait for its workers. More would wait there, half
done on both sides. Rows that exist for a moment only would be written, and all rows would leave the processor's caches.
"""


@on_loop
class Releases:
    """Releases queries in their order at each provider; one that is down or slow delays no other.

    Args:
        registrar: the actor that holds them.
        query_ids: queries that are held, or asked for.
        ended: called as ended(query_id, error) when a query has ended. If another caller releases a query before its
            turn, `error` is None.
    """

    def __init__(
        self, registrar: RegistrarActor, query_ids: Iterable[str], ended: Callable[[str, RrError | None], object]
    ) -> None:
        self._registrar = registrar
        self._ended = ended
        self._waiting: dict[str, deque[str]] = {}
        with registrar.lock:
            held = registrar.whole().held
            for query_id in query_ids:
                provider = held[query_id].registrar if query_id in held else ""  # it is gone: nothing is to be done
                self._waiting.setdefault(provider, deque()).append(query_id)
        for queue in self._waiting.values():
            self._begin(queue, AT_A_TIME)

    def hurry(self) -> None:
        """Begin all remaining releases: the time is up, and each must be owed on disk, or be known to be late."""
        for queue in self._waiting.values():
            self._begin(queue, len(queue))

    def _begin(self, queue: deque[str], count: int) -> None:
        while queue and count:
            query_id = queue.popleft()
            row = self._registrar.catalog.held.get(query_id)
            if row is None or row.hold is Hold.OWED or query_id in self._registrar.unloads:
                self._ended(query_id, None)
            else:
                count -= 1
                self._registrar.release(query_id, functools.partial(self._went, queue, query_id))

    def _went(self, queue: deque[str], query_id: str, error: RrError | None) -> None:
        self._ended(query_id, error)
        if not self._registrar.closed:
            self._begin(queue, 1)
            return
        while queue:  # the first release that hears of the closing ends all that wait
            self._ended(queue.popleft(), error)
