"""What happens to the streams of a resource, as the watchers of the system hear it."""

from __future__ import annotations

import contextlib
import functools

from rr_actors.base.errors import Unavailable
from rr_actors.base.names import short_id
from rr_actors.base.values.canonical import text_of_value
from rr_actors.registrar.model.rows import Resource
from rr_actors.registrar.servers.server_base import ServerBase
from rr_actors.streams.stream import StreamNews


def tell(server: ServerBase, resource: Resource, news: StreamNews) -> None:
    """Tell the watchers of the system what has happened to a stream. From any thread."""
    node = server.registrar.node
    if not node.watched.level[0]:
        return
    facts = {"registrar": server.registrar.name, "server": server.origin, "resource_id": resource.id}
    facts |= {"request": text_of_value(resource.request), "stream": news.stream.name, "detail": news.stream.name}
    if (before := news.before) is not None:
        instead = f"{before.name} of resource {short_id(before.resource_id)}"
        facts["detail"] += f", read by {news.reader} instead of {instead}"
        facts |= {"reader": news.reader, "before": f"{before.resource_id}/{before.name}"}
    with contextlib.suppress(Unavailable):  # the loop has ended
        node.dispatcher.call(functools.partial(node.emit, news.what, **facts))
