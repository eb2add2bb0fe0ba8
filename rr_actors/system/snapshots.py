"""Snapshots: the tree and the registrars as plain data, for people, tests and tools; and previews.

A preview asks the supervisors and the registrars what they would do. Each decides that by its own core, on a copy.
"""

from __future__ import annotations

import concurrent.futures
import os
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, TypeVar

import msgspec
import pykka

from rr_actors.base.errors import NotFound, RrError, Unavailable, counted, few, shown, text_of
from rr_actors.registrar.core.foretelling import End
from rr_actors.registrar.engine.node import Node
from rr_actors.registrar.model.rows import Notice
from rr_actors.registrar.pages import ForeseenResource, ForeseenStatus, ForetoldPage, ResourceRow, Wanted
from rr_actors.registrar.queries import Query, ResourceInfo
from rr_actors.registrar.registrar import Registrar, page
from rr_actors.streams.stream import StreamInfo
from rr_actors.supervision.core.foreseen import Foreseen, What
from rr_actors.supervision.supervisor import SupervisorRef
from rr_actors.system.registrar_lookup import registrar_in
from rr_actors.wire.name_service import Presence

T = TypeVar("T")
_Asked = TypeVar("_Asked")

_ASKED_AT_ONCE = 16
_PRESENT_S = 2.0  # for one supervisor or registrar to say what is there, or what it would do: it may hang
_PRESENT = 2000
"""The most resources of one registrar that a recording has from its beginning on."""

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


def present_in(node: Node, root: str | None) -> tuple[list[dict[str, Any]], list[ResourceRow], int, list[str]]:
    """Return what is there now: all children, resources, how many more there are, and why some are not known.

    Args:
        root: the path of the root supervisor; None if it has ended.
    """
    tree = list[dict[str, Any]]()
    if root is not None:
        described = describe_supervisor(SupervisorRef(root, timeout_s=_PRESENT_S))
        tree += _all_of(described | {"state": "running", "pid": os.getpid(), "up_s": None})
    wanted = Wanted("resources", limit=_PRESENT)
    answers = ask_registrars(node, lambda registrar: _soon(registrar.name, lambda: page(registrar, wanted)))
    pages = [answer for answer in answers.values() if not isinstance(answer, RrError)]
    resources = [row for one in pages for row in one.resources]
    notes = [text_of(answer) for answer in answers.values() if isinstance(answer, RrError)]
    return tree, resources, sum(one.total for one in pages) - len(resources), notes


def _soon(name: str, ask: Callable[[], T]) -> T:
    """Return the answer of a registrar. One that comes later is dropped, in a thread that waits for it.

    Raises:
        Unavailable: it has not answered in time.
    """
    answer = concurrent.futures.Future[T]()

    def run() -> None:
        try:
            answer.set_result(ask())
        except BaseException as error:
            answer.set_exception(error)

    threading.Thread(target=run, name="rr-actors-snapshot", daemon=True).start()
    try:
        return answer.result(_PRESENT_S)
    except concurrent.futures.TimeoutError:
        raise Unavailable(f"{name}: it has not answered within {_PRESENT_S:g} s") from None


def _all_of(node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    yield node
    for child in node.get("children", ()):
        yield from _all_of(child)


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


# -- previews ----------------------------------------------------------------------------------------------------------


class Preview(msgspec.Struct, frozen=True):
    """What would happen if a child was killed, stopped or restarted now. System.preview() returns it.

    The cores of the supervisors and registrars decide it on copies of their states. It assumes that each start
    succeeds, that each callback returns what it returned before, and that no status callback deals with a status. str()
    says it in words.

    Attributes:
        what: "kill", "stop" or "restart".
        path: of which child.
        supervisors: what each supervisor would do that acts, from the child's own upwards.
        ends: whether the system would end.
        resources: of which something would become; also those that depend on one that is lost.
        kept: by registrar that is started again, how many of its resources would stay as they are.
        unserved: by registrar that ends, and is not started again, how many resources nobody would serve.
        heard: which statuses holders would hear.
        notes: why registrars could not be asked.
    """

    what: What
    path: str
    supervisors: tuple[Foreseen, ...]
    ends: bool
    resources: tuple[ForeseenResource, ...] = ()
    kept: dict[str, int] = {}
    unserved: dict[str, int] = {}
    heard: tuple[ForeseenStatus, ...] = ()
    notes: tuple[str, ...] = ()

    def sentences(self) -> list[str]:
        """Return what would happen, a sentence for each supervisor, registrar and holder."""
        said = [*filter(None, map(_course_text, self.supervisors))]
        if self.ends:
            said.append("the system would end")
        said += [f"{counted(count, 'resource')} of {name} would stay" for name, count in self.kept.items() if count]
        fates: dict[str, list[str]] = {}
        for resource in self.resources:
            fates.setdefault(resource.becomes, []).append(resource.name)
        said += [f"would be {becomes}: {few(names)}" for becomes, names in fates.items()]
        said += [f"{counted(n, 'resource')} of {name} would have no server" for name, n in self.unserved.items() if n]
        hearings = dict.fromkeys((one.holder, one.state, one.name) for one in self.heard)
        by_holder: dict[tuple[str, str], list[str]] = {}
        for holder, state, name in hearings:
            by_holder.setdefault((holder, state), []).append(name)
        said += [f"{holder} would hear {state} of {few(names)}" for (holder, state), names in by_holder.items()]
        return [*said, *self.notes]

    def __str__(self) -> str:
        return "\n".join(self.sentences())


_ROUNDS = 100  # of statuses from one registrar to the next


def preview_in(node: Node, root: str, path: str, what: What) -> Preview:
    """Return what would happen if the child at a path was killed, stopped or restarted.

    Raises:
        NotFound: there is no such child.
        ActorUnavailable, pykka.Timeout: its supervisor does not answer.
    """
    courses, ends = _courses(path, what)
    below = {child["path"]: child for child in _all_of(describe_supervisor(SupervisorRef(root, timeout_s=_PRESENT_S)))}
    ended: dict[str, End] = {}
    comes_back: dict[str, bool] = {}
    for course in courses:
        for step in course.steps:
            place = f"{course.path}/{step.id}"
            for one in [other for other in below if f"{other}/".startswith(f"{place}/")]:
                name = one.rpartition("/")[2]
                if step.happens != "starts":
                    is_crash = what == "kill" and place == path
                    ended.setdefault(name, "crash" if is_crash else "stop")
                comes_back[name] = step.happens == "starts"
    return _with_registrars(node, Preview(what, path, tuple(courses), ends), ended, comes_back)


def _courses(path: str, what: What) -> tuple[list[Foreseen], bool]:
    """Return what each supervisor would do, from the child's own upwards, and whether the root would end."""
    courses: list[Foreseen] = []
    while "/" in path:
        above, _, id = path.rpartition("/")
        courses.append(SupervisorRef(above).foresee(id, what))
        if not courses[-1].ends:
            return courses, False
        path, what = above, "kill"
    return courses, True


def _with_registrars(node: Node, preview: Preview, ended: dict[str, End], comes_back: dict[str, bool]) -> Preview:
    """Return the preview with what the registrars would do that end, and those that hold something there."""
    notes: list[str] = []
    kept, unserved = dict[str, int](), dict[str, int]()
    resources, heard = dict[str, ForeseenResource](), list[ForeseenStatus]()
    ahead: dict[tuple[str, str], list[Notice]] = {}  # what is on its way, by provider and holder

    def foretold(name: str, wanted: Wanted) -> ForetoldPage | None:
        try:
            found = _soon(name, lambda: page(registrar_in(node, name, patient=False), wanted)).foretold
        except RrError as error:
            notes.append(text_of(error))
            return None
        resources.update((one.id, one) for one in found.resources)
        heard.extend(found.heard)
        for notice in found.notices:
            ahead.setdefault((name, notice.origin), []).append(notice)
        return found

    for name in [name for name, status in node.statuses().items() if status is Presence.UP and name in ended]:
        if comes_back[name]:
            if (found := foretold(name, Wanted("foretold", end=ended[name]))) is not None:
                kept[name] = found.kept
        else:
            try:
                registrar = registrar_in(node, name, patient=False)
                unserved[name] = _soon(name, partial(page, registrar, Wanted("resources", limit=0))).total
            except RrError as error:
                notes.append(text_of(error))
    for _ in range(_ROUNDS):
        if not ahead:
            break
        (provider, holder), notices = next(iter(ahead.items()))
        del ahead[provider, holder]
        if comes_back.get(holder, True):
            foretold(holder, Wanted("foretold", provider=provider, notices=tuple(notices)))
    return msgspec.structs.replace(
        preview,
        resources=tuple(resources.values()),
        kept=kept,
        unserved=unserved,
        heard=tuple(heard),
        notes=tuple(notes),
    )


def _course_text(course: Foreseen) -> str:
    happens: dict[str, list[str]] = {}
    for step in course.steps:
        happens.setdefault(step.happens, []).append(step.id)
    happens.pop("dies", None)
    said = [f"{few(ids)} would {verb.removesuffix('s')}" for verb, ids in happens.items()]
    if course.restarts > course.before:
        said.append(f"{course.restarts} of {course.max_restarts} restarts in {course.max_seconds:g} s")
    if course.ends:
        said.append("which is too many: it would give up" if course.error else "it would end")
    return f"{course.path} ({course.strategy}): {', '.join(said)}" if said else ""
