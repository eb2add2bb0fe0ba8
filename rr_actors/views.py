"""Views: the Query objects of one registrar, who listens to them, and how to read their bytes."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rr_actors import pickling, queries
from rr_actors.actors.raised import log_raised
from rr_actors.actors.registrar import RegistrarActor
from rr_actors.actors.shielding import Flag
from rr_actors.core.canonical import Codec
from rr_actors.errors import Unavailable
from rr_actors.names import ServerId, parse_server_id
from rr_actors.queries import Query
from rr_actors.records import Held, Notice, ServerType
from rr_actors.statuses import Status, status_of

if TYPE_CHECKING:
    from rr_actors.registrar import Registrar

logger = logging.getLogger("rr_actors.registrar")

StatusCallback = Callable[[Status], Any]

PLAIN = Codec(None)
_TYPES_S = 2.0


class Views:
    """One for each query that somebody has seen; a status reaches them, and the callbacks that listen.

    Attributes:
        holder: the Registrar that people use.
    """

    def __init__(self, actor: RegistrarActor, holder: Registrar) -> None:
        self._actor = actor
        self.holder = holder
        self._queries: dict[str, Query] = {}
        self._on_query: dict[str, StatusCallback] = {}
        self._on_server: dict[str, list[StatusCallback]] = {}
        self._codecs: dict[str, tuple[bytes, tuple[Codec, Codec]]] = {}
        self._codecs_of = self.codecs_of  # one for all queries
        self._left: set[ServerId] = set()  # servers that something was held at, and let go

    def new(self, id: str, place: ServerId, request: bytes, parent: str) -> Query:
        """A Query that is being loaded, and not listened to (yet)."""
        return Query(id, place, request, parent, self._actor.name, self.holder, self._codecs_of)

    def seen(self, held: Held) -> Query:
        """A Query of its own of a held row."""
        query = self.new(held.id, ServerId(held.registrar, held.server), held.request, held.parent)
        queries.loaded(query, held)
        return query

    def of(self, held: Held) -> Query:
        """The Query of a held row; the same each time."""
        view = self._queries.get(held.id)
        if view is None:
            view = self._queries[held.id] = self.seen(held)
        return view

    def add(self, query: Query) -> None:
        """Have statuses reach it."""
        self._queries[query.id] = query

    def listen(self, query_id: str, callback: StatusCallback) -> None:
        """Have the callback called for one query."""
        self._actor.catalog.listened.add(query_id)
        self._on_query[query_id] = callback

    def listen_to_server(self, server: str, callback: StatusCallback) -> None:
        """Have the callback called for every query at a server."""
        self._actor.catalog.listened.add(server)
        self._on_server.setdefault(server, []).append(callback)

    def forget(self, query_id: str) -> None:
        """The query is held no more."""
        if (view := self._queries.pop(query_id, None)) is not None:
            queries.end(view)
            if view.resource_id:
                self._left.add(ServerId(view.registrar, view.server))
        if self._on_query.pop(query_id, None) is not None:
            self._actor.catalog.listened.discard(query_id)

    def was_at(self, server: ServerId) -> bool:
        """Return whether the registrar holds something at the server, is loading it, or did once. On the loop.

        What it held in an earlier life the catalog tells by the server's types, which it keeps.
        """
        if server in self._left or str(server) in self._actor.catalog.server_types:
            return True
        with self._actor.lock:
            rows = (*self._queries.values(), *self._actor.whole().held.values())
        return any((row.registrar, row.server) == server for row in rows)

    def hear(self, held: Held, notice: Notice, heard: Callable[[bool], None], *, repeated: bool) -> None:
        """A status has arrived. On the loop.

        `heard` is called when all callbacks have returned, with whether one of them has dealt with it: until then a
        crash has the provider say it again.
        """
        status = status_of(notice, repeated=repeated)
        view = self._queries.get(held.id)
        if view is not None:
            queries.hear(view, status, notice.response, released=notice.released)
        callbacks = list(self._on_server.get(f"{held.registrar}/{held.server}", ()))
        if (own := self._on_query.get(held.id)) is not None:
            callbacks.insert(0, own)
        left = itertools.count(len(callbacks) - 1, -1)
        for callback in callbacks:
            self._run(held, callback, status, lambda: None if next(left) else heard(status.is_handled))
        if not callbacks:
            heard(False)

    def _run(self, held: Held, callback: StatusCallback, status: Status, through: Callable[[], None]) -> None:
        def done(_result: Any, error: BaseException | None) -> None:
            through()
            if error is not None:
                self._actor.callback_failures += 1
                log_raised(logger, error, "%s: a status callback for %s raised", self._actor.name, held.server)

        try:
            self._actor.workers.serial(("hear", held.id), callback, status, done=done)
        except Unavailable as error:
            done(None, error)

    def codecs_of(self, server_id: str) -> tuple[Codec, Codec]:
        """How to read the requests and responses of a server: by its types, as it told them. Not on the loop."""
        known = self._actor.catalog.server_types.get(server_id) or self._ask_types(server_id)
        if known is None:
            return PLAIN, PLAIN
        cached = self._codecs.get(server_id)
        if cached is None or cached[0] != known.blob:
            request_type, response_type = pickling.loads(known.blob)
            codecs = Codec(request_type, f"{server_id}: request"), Codec(response_type, f"{server_id}: response")
            cached = self._codecs[server_id] = (known.blob, codecs)
        return cached[1]

    def _ask_types(self, server_id: str) -> ServerType | None:
        """After a crash its types may not be in the catalog: ask the provider, and do without if it is down."""
        dispatcher = self._actor.node.dispatcher
        if dispatcher.is_loop_thread() or self._actor.closed:
            return None
        told = Flag()
        dispatcher.call(self._actor.types.tell, parse_server_id(server_id), told.set)
        told.wait(_TYPES_S)
        return self._actor.catalog.server_types.get(server_id)
