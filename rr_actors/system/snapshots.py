"""Snapshots: the tree and the registrars as plain data, for people, tests and tools."""

from __future__ import annotations

import concurrent.futures
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import msgspec
import pykka

from rr_actors.base.errors import NotFound, RrError, shown
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.queries import Query, ResourceInfo
from rr_actors.registrar.registrar import Registrar
from rr_actors.streams.stream import StreamInfo
from rr_actors.supervision.supervisor import SupervisorRef
from rr_actors.system.registrar_lookup import registrar_in
from rr_actors.wire.name_service import Presence

T = TypeVar("T")
_Asked = TypeVar("_Asked")

_ASKED_AT_ONCE = 16

_NO_ANSWER = (RrError, pykka.Timeout)
"""What a supervisor raises that is stopped or being respawned, or whose process does not answer in time."""


def describe_supervisor(supervisor: SupervisorRef, said: Callable[[Exception], str] = str) -> dict[str, Any]:
    """Return a supervisor and all below it: id, path, settings, and its children in the order of their start.

    One that does not answer, within the time limit of `supervisor`, has an "error" and no children.

    Args:
        said: returns the text of an error.
    """
    here = {"id": supervisor.id, "path": supervisor.path, "type": "supervisor"}
    try:
        described = supervisor.describe()
    except _NO_ANSWER as error:
        return here | {"error": said(error), "children": []}
    children = [_describe_child(supervisor, child, said) for child in described["children"]]
    return here | described | {"children": children}


def _describe_child(
    above: SupervisorRef, child: dict[str, Any], said: Callable[[Exception], str] = str
) -> dict[str, Any]:
    """Return a child as its supervisor describes it; a running supervisor, with all below it."""
    child["path"] = f"{above.path}/{child['id']}"
    if child["type"] == "supervisor" and child["state"] == "running":
        return describe_supervisor(SupervisorRef(child["path"], timeout_s=above.timeout_s), said) | child
    return child


def describe_at(place: SupervisorRef) -> dict[str, Any]:
    """Return what is at a path: a supervisor and all below it, or another child as its supervisor describes it.

    Raises:
        NotFound: there is nothing at this path.
    """
    described = describe_supervisor(place)
    above, _, id = place.path.rpartition("/")
    if "error" not in described or not above:
        return described
    try:
        children: list[dict[str, Any]] = SupervisorRef(above).describe()["children"]
    except NotFound:
        raise
    except _NO_ANSWER:  # the supervisor above does not answer either
        return described
    for child in children:
        if child["id"] == id:
            return _describe_child(SupervisorRef(above), child)
    there = ", ".join(child["id"] for child in children) or "none"
    raise NotFound(f"supervisor {above} has no child {shown(id)} (it has: {there})", id=place.path)


def paths_to(id: str, supervisor: SupervisorRef) -> list[str]:
    """Return the paths of all children of this id below a supervisor.

    Raises:
        ActorUnavailable, pykka.Timeout: a supervisor on the way is being respawned, or its process does not answer, so
            the children below it are not known.
    """
    ahead, paths = [supervisor], list[str]()
    while ahead:
        place = ahead.pop()
        try:
            children = place.which_children()
        except NotFound:  # the supervisor is stopped, or has ended just now
            continue
        paths += [f"{place.path}/{child.id}" for child in children if child.id == id]
        ahead += [SupervisorRef(f"{place.path}/{child.id}") for child in children if child.type == "supervisor"]
    return sorted(paths)


def ask_registrars(node: Node, ask: Callable[[Registrar], T]) -> dict[str, T | RrError]:
    """Ask every registrar that is up, as ask_each() does, and return the answers by name; of one that fails, its error.

    Args:
        node: the node of any process of the system.
        ask: is called in a thread of its own, with a handle that does not wait for a restart.
    """

    def answer(name: str) -> T | RrError:
        try:
            return ask(registrar_in(node, name, patient=False))
        except RrError as error:
            return error

    up = [name for name, status in node.statuses().items() if status is Presence.UP]
    return dict(zip(up, ask_each(up, answer), strict=True))


def ask_each(asked: Sequence[_Asked], ask: Callable[[_Asked], T]) -> list[T]:
    """Call `ask` with each of them, several at a time, and return the results in the order of `asked`.

    One that waits for a process that has stopped holds up only itself.
    """
    if len(asked) < 2:
        return [ask(one) for one in asked]
    with concurrent.futures.ThreadPoolExecutor(_ASKED_AT_ONCE, thread_name_prefix="rr-actors-snapshot") as threads:
        return list(threads.map(ask, asked))


def describe_registrars(node: Node) -> dict[str, dict[str, Any]]:
    """Return every registrar that is not gone, by name: its state, and if it is up, its servers, resources and queries.

    Args:
        node: the node of any process of the system.
    """
    described = {name: {"state": str(status)} for name, status in node.statuses().items()}
    for name, answer in ask_registrars(node, describe_registrar).items():
        described.setdefault(name, {"state": str(Presence.UP)})
        described[name] |= {"error": str(answer)} if isinstance(answer, RrError) else answer
    return described


def streams_of(node: Node) -> list[StreamInfo]:
    """Return the open streams of every registrar that answers."""
    answers = ask_registrars(node, Registrar.streams).values()
    return [stream for answer in answers if not isinstance(answer, RrError) for stream in answer]


def describe_registrar(registrar: Registrar) -> dict[str, Any]:
    """Return a registrar: its servers, its resources with their holders and dependencies, and the queries it holds."""
    queries, resources = registrar.queries(), registrar.resources()
    depends: dict[str, list[str]] = {}
    for query in queries:
        if query.parent:
            depends.setdefault(query.parent, []).append(query.id)
    return {
        "servers": registrar.servers(),
        "stats": registrar.stats(),
        "resources": [_describe_resource(info, depends.get(info.id, [])) for info in resources],
        "queries": [_describe_query(query) for query in queries],
    }


def _describe_resource(info: ResourceInfo, depends_on: list[str]) -> dict[str, Any]:
    lists = {"holders": list(info.holders), "queries": list(info.queries), "depends_on": depends_on}
    return msgspec.to_builtins(info) | lists


def _describe_query(query: Query) -> dict[str, Any]:
    return {
        "id": query.id,
        "resource_id": query.resource_id,
        "origin": query.origin,
        "server": query.server_id,
        "request": msgspec.to_builtins(query.request),
        "response": msgspec.to_builtins(query.response),
        "state": str(query.state),
        "parent": query.parent,
    }
