"""What an earlier version of a program has stored, read by the types of today."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from rr_actors.base.errors import RrError, readable, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.base.values.canonical import encode, shown_plain
from rr_actors.registrar.engine.server import Callback
from rr_actors.registrar.model import commands as c
from rr_actors.registrar.model.rows import Resource
from rr_actors.registrar.servers.server_actor import ServerActor

logger = Log("rr_actors.server")


def reread(server: ServerActor, resources: Iterable[Resource], digest: bytes) -> tuple[c.Reread, ...]:
    """Read stored requests and responses by today's types; return what differs. Not on the loop: users' code runs.

    What does not fit goes through the upgrade callback, if there is one. With an unchanged digest of the types only
    users' code, such as a __post_init__, may read a value in another way than before.
    """
    if digest and digest == server.digest:
        resources = (it for it in resources if _runs_code(server, it))
    return tuple(found for resource in resources if (found := _reread(server, resource)) is not None)


def _runs_code(server: ServerActor, resource: Resource) -> bool:
    response = resource.response
    return server.request.runs_code(resource.request) or (response is not None and server.response.runs_code(response))


def _reread(server: ServerActor, resource: Resource) -> c.Reread | None:
    place, response = resource.id, resource.response
    try:
        request = server.request.today(resource.request)
        if response is not None:
            server.response.decode(response, "", "response")
    except RrError as error:
        misfit = f"{error.message}, stored by an earlier version"
    else:
        return None if request == resource.request else c.Reread(place, request, response)
    if server.spec.upgrade is not None:
        try:
            return _upgraded(server, resource, server.spec.upgrade)
        except Exception as error:
            text = readable(text_of(error))
            logger.exception("%s: the upgrade callback raised for resource %s", server.origin, place)
            misfit += f", and the upgrade callback raised {text}"
    logger.error("%s: resource %s is lost: %s", server.origin, place, misfit)
    return c.Reread(place, resource.request, response, misfit)


def _upgraded(server: ServerActor, resource: Resource, upgrade: Callback) -> c.Reread:
    old = None if resource.response is None else shown_plain(resource.response)
    request, response = upgrade(shown_plain(resource.request), old)
    new = server.request.canonical(encode(request), server.origin)
    answer = None if resource.response is None else server.response.encode(response, server.origin)
    if (error := server.too_long(msgspec.structs.replace(resource, request=new), answer)) is not None:
        raise error
    return c.Reread(resource.id, new, answer)
