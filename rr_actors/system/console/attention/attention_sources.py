"""Collects what the rules of attention look at. In a worker of the console, only when it is asked.

Each registrar is asked for its troubled resources alone, at most 500, those first where the trouble began. Stacks are
asked for only of managers for whose loads somebody waits too long.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from rr_actors.actors.refs import Timeout
from rr_actors.base.errors import RrError
from rr_actors.registrar.pages import LoadRow, QueryRow, Wanted
from rr_actors.system.console import console_messages as c
from rr_actors.system.console.attention.attention_items import (
    DEATHS_S,
    Choice,
    Fill,
    KeptThing,
    Known,
    PoolUse,
    is_late,
)
from rr_actors.system.console.console_view import View
from rr_actors.system.snapshots import ask_each

_EVENTS = 2000
_TROUBLE = ("warning", "error", "fatal")
_STACK_S = _PLANNER_S = 1.0
_CALLBACK = "ServerActor._wrapped"
_NOT_USERS = (str(Path(__file__).parents[3]) + os.sep, os.path.dirname(os.__file__) + os.sep)
_QUESTIONS = {"Budgets": "pools", "Keeper": "get", "Choices": "choices"}  # of this package's planning managers
_T = TypeVar("_T", PoolUse, KeptThing, Choice)


def known_of(view: View) -> tuple[Known, list[str]]:
    """Return what is known of a system now, and notes on registrars that could not be asked."""
    now = time.time()
    children = view.children(limit=2**40).rows
    notes: dict[str, None] = {}
    troubled, said = view.page(Wanted("resources", states=_TROUBLE, sort="trouble", limit=c.PAGE_LIMIT))
    notes |= dict.fromkeys(said)
    loads, said = view.page(Wanted("loads", limit=c.PAGE_LIMIT))
    notes |= dict.fromkeys(said)
    streams, said = view.page(Wanted("streams", limit=c.PAGE_LIMIT))
    notes |= dict.fromkeys(said)
    pools, kept, choices = _planned(view, children)
    bad = {row.id for row in troubled.resources}
    known = Known(
        now,
        children,
        view.memory.of_children(_EVENTS, min(now - DEATHS_S, view.memory.began)),
        troubled.resources,
        troubled.total,
        loads.queries,
        loads.loads,
        _standing(view, now, loads.queries, loads.loads, children),
        _began(view, bad) if bad else {},
        pools,
        kept,
        choices,
        streams.streams,
        _mailboxes(view, children),
        [_disk(view.memory.directory)],
    )
    return known, list(notes)


def _disk(directory: Path) -> Fill:
    """Return how full the file system of a directory is, as `df` says it: what is kept for root is not counted."""
    found = os.statvfs(directory)
    used = found.f_blocks - found.f_bfree
    return Fill(str(directory), used * found.f_frsize, (used + found.f_bavail) * found.f_frsize)


def _began(view: View, ids: set[str]) -> dict[str, float]:
    """Return when these resources got their last statuses, as far as the system remembers."""
    events = view.memory.newest(_EVENTS, lambda event: event.facts.get("resource_id", "") in ids)
    return {event.facts["resource_id"]: event.at for event in events}


def _standing(
    view: View, now: float, waiting: Iterable[QueryRow], loads: Iterable[LoadRow], children: Iterable[c.ChildRow]
) -> dict[str, str]:
    """Return the lines in which load callbacks stand, of servers for whose loads somebody waits too long."""
    p95 = {row.server: row.p95_s for row in loads}
    late = {row.server for row in waiting if is_late(row, now, p95.get(row.server, 0.0))}
    paths = {row.id: row.path for row in children if row.pid not in (None, os.getpid())}
    asked = [server for server in sorted(late) if server.partition("/")[0] in paths]

    def ask(server: str) -> str:
        registrar, _, name = server.partition("/")
        try:
            stacks = view.node.dispatcher.run(view.node.stacks.of(paths[registrar], _STACK_S))
        except RrError:
            return ""
        return callback_line((thread.frames for thread in stacks.threads), name)

    return {server: line for server, line in zip(asked, ask_each(asked, ask), strict=True) if line}


def callback_line(threads: Iterable[list[str]], server: str) -> str:
    """Return the line in which the load callback of a server stands: "cameras.py:71, in Cameras.load_camera: ...".

    Args:
        threads: the frames of each thread, the innermost one last.

    Returns:
        "" if no thread runs a callback, or several do and none has the server's name.
    """
    found: dict[str, str] = {}
    for frames in threads:
        begins = [at for at, frame in enumerate(frames) if _CALLBACK in frame.partition("\n")[0]]
        if not begins or not (inside := frames[begins[-1] + 1 :]):
            continue
        users = [frame for frame in inside if not frame.removeprefix('File "').startswith(_NOT_USERS)]
        method = inside[0].partition("\n")[0].rpartition(", in ")[2]
        found[method] = _short((users or inside)[-1])
    named = [line for method, line in found.items() if method.rpartition(".")[2] in (server, f"load_{server}")]
    if len(named) == 1:
        return named[0]
    return next(iter(found.values())) if len(found) == 1 else ""


def _short(frame: str) -> str:
    place, _, source = frame.partition("\n")
    file, line, where = place.removeprefix('File "').replace('", line ', "\0").replace(", in ", "\0").split("\0")[:3]
    return f"{Path(file).name}:{line}, in {where}{f': {source}' if source else ''}"


def _planned(view: View, children: Iterable[c.ChildRow]) -> tuple[list[PoolUse], list[KeptThing], list[Choice]]:
    """Return what the planning managers of the tree say of themselves; nothing of one that does not answer."""
    asked: list[tuple[str, str]] = []
    for row in children:
        if row.type != "supervisor" and row.state == "running":
            try:
                classes = view.system.ref(row.path).actor_class.__mro__
            except RrError:
                continue
            ours = [one.__name__ for one in classes if one.__module__.startswith("rr_actors.managers.")]
            asked += [(row.path, one) for one in ours if one in _QUESTIONS]

    def ask(planner: tuple[str, str]) -> list[dict[str, Any]]:
        try:
            return view.system.ref(planner[0]).ask({_QUESTIONS[planner[1]]: None}, timeout=_PLANNER_S)
        except (RrError, Timeout):
            return []

    pools, kept, choices = list[PoolUse](), list[KeptThing](), list[Choice]()
    for (path, kind), rows in zip(asked, ask_each(asked, ask), strict=True):
        if kind == "Budgets":
            pools += _converted(rows, path, PoolUse)
        elif kind == "Keeper":
            kept += _converted(rows, path, KeptThing)
        else:
            choices += _converted(rows, path, Choice)
    return pools, kept, choices


def _converted(rows: list[dict[str, Any]], path: str, kind: type[_T]) -> list[_T]:
    return [msgspec.convert(row | {"path": path}, kind) for row in rows]


def _mailboxes(view: View, children: Iterable[c.ChildRow]) -> list[Fill]:
    """Return how full the mailboxes are of actors that run."""
    paths = [row.path for row in children if row.type != "supervisor" and row.state == "running"]

    def look(path: str) -> Fill | None:
        try:
            found = view.system.mailbox(path).look()
        except Exception as error:
            if isinstance(error, RrError | Timeout):
                return None
            raise
        return Fill(found.path, found.length, found.limit)

    return [one for one in ask_each(paths, look) if one is not None]
