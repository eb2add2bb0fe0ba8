"""Moments: the tree and the resources as they were at one time, folded from the entries of a recording. Pure.

`moment_after(moment, entries)` is the one function that says what an entry changes. All who show a moment use it, so
the command line and the terminal cannot disagree. A moment is never changed: a step back is an earlier moment.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import msgspec
from msgspec.structs import replace

from rr_actors.base.names import named, time_in
from rr_actors.registrar.model.recorded import Entry
from rr_actors.system.recording.event_texts import child_text

_STARTS = ("started", "start_failed", "ignored")
_PHASES = {"load": "loading", "unload": "unloading", "reload": "reloading", "pause": "pausing", "resume": "resuming"}
"""The phases of a resource while a callback runs, by the callback's role."""
_PHASE_AFTER = {
    "loaded": "loaded",
    "resumed": "loaded",
    "pause_failed": "loaded",
    "unload_failed": "unload_failed",
    "reloading": "reloading",
    "revoked": "revoked",
    "paused": "paused",
}
"""The phase of a resource after an event."""
_GONE = ("unloaded", "load_failed")
_SAYS = ("unload_failed", "revoked")
"""The events whose details are the resource's message from then on."""
_BEGINS = ("loaded", "load_failed")
_LASTING = "FATAL"
_IN_A_ROW_S = 2.0  # from one start of a supervisor's child to the next, at most


class ChildThen(msgspec.Struct, frozen=True):
    """A child of the tree at a moment.

    Attributes:
        path: its path.
        kind: "supervisor", "manager" or "actor"; "worker" of one that is known only from the recording's beginning; ""
            if nothing says it.
        state: "running", "starting", "restarting" or "stopped".
        since: since when it is in this state, in seconds since the epoch; None if that was before the recording.
        pid: of its process, while it runs; None if that is not known.
        why: how the last thing happened to it, for people: "killed: SIGKILL, after 12 s".
        restarts: how often it was restarted in the recording so far.
    """

    path: str
    kind: str = ""
    state: str = "running"
    since: float | None = None
    pid: int | None = None
    why: str = ""
    restarts: int = 0

    @property
    def name(self) -> str:
        """Its path."""
        return self.path

    @property
    def condition(self) -> str:
        """Its state."""
        return self.state


class ResourceThen(msgspec.Struct, frozen=True):
    """A resource at a moment.

    Attributes:
        id: its id.
        server: "registrar/server".
        text: its title, or its request as JSON; "" if the recording has neither.
        phase: "loaded", "loading", "unloading", "unload_failed", "reloading", "revoked", "pausing", "paused" or
            "resuming".
        state: that of its last status.
        message: of its last status, or why it could not be unloaded.
        since: since when it is so, in seconds since the epoch; None if that was before the recording.
    """

    id: str
    server: str = ""
    text: str = ""
    phase: str = "loaded"
    state: str = "OK"
    message: str = ""
    since: float | None = None

    @property
    def name(self) -> str:
        """Its server and its request or title, shortened for people."""
        return named(self.server, self.text)

    @property
    def condition(self) -> str:
        """The state of the last status while it is loaded, else its phase."""
        return self.state if self.phase == "loaded" else self.phase

    @property
    def why(self) -> str:
        """Its message."""
        return self.message


class Change(msgspec.Struct, frozen=True):
    """What an entry, or all between two moments, has changed of a child or a resource.

    Attributes:
        at: when it is so since, in seconds since the epoch; of what is gone, the time of the entry.
        id: the child's path, or the resource's id.
        name: the child's path, or the resource's name.
        before, after: its condition; "" if it was not there, or is not there any more.
        why: what was said of it.
    """

    at: float
    id: str
    name: str
    before: str
    after: str
    why: str = ""


class Moment(msgspec.Struct, frozen=True):
    """The tree and the resources at one time.

    Attributes:
        at: the time of the last entry that it has, in seconds since the epoch.
        children: by path.
        resources: by id.
        asked: what loads ask for that have no answer yet, by the ids of their queries: the server, and the request.
        first_starts: by the path of a supervisor, when the newest of its children's first starts in a row began and
            ended: the begin of the first of them, and the end of the last.
    """

    at: float = 0.0
    children: dict[str, ChildThen] = {}
    resources: dict[str, ResourceThen] = {}
    asked: dict[str, tuple[str, str]] = {}
    first_starts: dict[str, tuple[float, float]] = {}

    @property
    def tree(self) -> list[ChildThen]:
        """The children, each supervisor before its own ones."""
        return [self.children[path] for path in in_tree_order(self.children)]

    @property
    def listed(self) -> list[ResourceThen]:
        """The resources, by name."""
        return sorted(self.resources.values(), key=lambda one: (one.server, one.text, one.id))


def in_tree_order(paths: Iterable[str]) -> list[str]:
    """Return paths, each before those below it, and those of one supervisor by their names."""
    return sorted(paths, key=lambda path: path.split("/"))


def moment_after(moment: Moment, entries: Iterable[Entry]) -> Moment:
    """Return the moment that follows when these entries have happened. It does not change the one before."""
    fold = Fold(moment)
    for entry in entries:
        fold.take(entry)
    return fold.moment


def differences(before: Moment, after: Moment) -> list[Change]:
    """Return what is different between two moments, in the order of time."""
    found = [
        _change(after.at, id, old.get(id), new.get(id))
        for old, new in ((before.children, after.children), (before.resources, after.resources))
        for id in dict.fromkeys((*old, *new))
    ]
    return sorted(filter(None, found), key=lambda one: one.at)


def _change(
    at: float, id: str, old: ChildThen | ResourceThen | None, new: ChildThen | ResourceThen | None
) -> Change | None:
    """Return what differs of a child or a resource, for people; None if nothing does."""
    if new is None:
        return None if old is None else Change(at, id, old.name, old.condition, "", old.why)
    if old is not None and (old.condition, old.since, old.why) == (new.condition, new.since, new.why):
        return None
    since = at if new.since is None else new.since
    return Change(since, id, new.name, "" if old is None else old.condition, new.condition, new.why)


class Fold:
    """A moment that entries move on. take() returns what the entry has changed."""

    def __init__(self, moment: Moment) -> None:
        self._at = moment.at
        self._children = moment.children.copy()
        self._resources = moment.resources.copy()
        self._asked = moment.asked.copy()
        self._first_starts = moment.first_starts.copy()
        self._changes: list[Change] = []

    @property
    def moment(self) -> Moment:
        """The moment after the entries so far."""
        children, resources = self._children.copy(), self._resources.copy()
        return Moment(self._at, children, resources, self._asked.copy(), self._first_starts.copy())

    def take(self, entry: Entry) -> list[Change]:
        """Apply an entry."""
        self._at = entry.at
        self._changes = []
        if is_of_child(entry):
            self._take_child(entry)
        elif entry.resource and entry.facts and entry.server:
            self._take_resource(entry)
        elif entry.event in ("began", "ended"):
            self._take_callback(entry)
        elif entry.event in ("sent", "received"):
            self._take_message(entry)
        return self._changes

    # -- children ------------------------------------------------------------------------------------------------------

    def _take_child(self, entry: Entry) -> None:
        path, facts = entry.process, entry.facts
        if entry.event == "ended":
            for other in [*self._below(path), path]:
                before = self._children.get(other, ChildThen(other, "supervisor"))
                self._set_child(
                    other, replace(before, state="stopped", since=entry.at, pid=None, why=child_text(facts))
                )
            return
        state, kind = facts["state"], str(facts.get("kind", ""))
        if entry.event in _STARTS and facts.get("run") == 1:
            self._forget_earlier_supervisor(path, entry.at - float(facts.get("ready_s") or 0.0), entry.at)
        if state is None:
            for other in (*self._below(path), path):
                self._set_child(other, None)
            return
        self._add_supervisors(path, entry.at)
        before = self._children.get(path)
        restarts = (0 if before is None else before.restarts) + (entry.event == "restarted")
        runs = state == "running"
        pid = (facts.get("pid") or None) if runs else None
        self._set_child(path, ChildThen(path, kind, state, entry.at, pid, child_text(facts), restarts))
        if kind == "supervisor" and not runs:
            for other in self._below(path):
                self._set_child(other, None)

    def _forget_earlier_supervisor(self, path: str, began: float, at: float) -> None:
        """Forget the children that a supervisor had which was killed, at the first start of a child that is known.

        A supervisor starts its children one after another. So the next one has those whose first starts are in a row.
        A time that is later than this start is of a clock that was put back since.
        """
        above = path.rpartition("/")[0]
        first, last = self._first_starts.get(above, (began, began))
        is_next = at >= last and began - last < _IN_A_ROW_S
        first = min(first, began) if is_next else began
        self._first_starts[above] = (first, at)
        if path not in self._children:
            return
        for other in self._below(above):
            since = self._children[other].since
            is_own = f"{other}/".startswith(f"{path}/")
            if since is not None and other != path and not (began if is_own else first) <= since <= at:
                self._set_child(other, None)

    def _add_supervisors(self, path: str, at: float) -> None:
        """Add the supervisors above a child. The root has no events of its own; another one is being started."""
        above = path.rpartition("/")[0]
        if not above:
            return
        self._add_supervisors(above, at)
        if above not in self._children:
            state = "starting" if "/" in above else "running"
            self._set_child(above, ChildThen(above, "supervisor", state, at))
        elif "/" not in above and self._children[above].state != "running":
            self._set_child(above, ChildThen(above, "supervisor", "running", at))  # the next system of the directory

    def _below(self, path: str) -> list[str]:
        return [other for other in self._children if other.startswith(f"{path}/")]

    def _set_child(self, path: str, child: ChildThen | None) -> None:
        before = self._children.pop(path, None) if child is None else self._children.get(path)
        if child is not None:
            self._children[path] = child
        if (change := _change(self._at, path, before, child)) is not None:
            self._changes.append(change)

    # -- resources -----------------------------------------------------------------------------------------------------

    def _take_resource(self, entry: Entry) -> None:
        id, facts = entry.resource, entry.facts
        if entry.event in _GONE:
            self._set_resource(id, None)
            return
        text = str(facts.get("title") or facts.get("request", ""))
        before = self._resources.get(id) or ResourceThen(id)
        now = replace(before, server=entry.server, text=text)
        if entry.event == "status":
            said, _, message = entry.detail.partition(" ")
            state = _LASTING if before.state == _LASTING else said
            phase = "loaded" if before.phase == "reloading" else before.phase
            now = replace(now, state=state, message=message, phase=phase, since=entry.at)
        elif entry.event in _PHASE_AFTER:
            message = entry.detail if entry.event in _SAYS else before.message
            now = replace(now, phase=_PHASE_AFTER[entry.event], message=message, since=entry.at)
        elif before.id not in self._resources:
            return  # its priority, its progress or a stream, of one that is not known otherwise
        self._set_resource(id, now)

    def _take_callback(self, entry: Entry) -> None:
        id, before = entry.resource, self._resources.get(entry.resource)
        if entry.event == "began" and (phase := _PHASES.get(entry.name)) is not None:
            if before is None and entry.name == "load":
                before = ResourceThen(id, entry.server, self._asked.get(id, ("", ""))[1])
            if before is not None and before.phase != phase:
                self._set_resource(id, replace(before, phase=phase, since=entry.at))
        elif before is not None and entry.event == "ended" and entry.name == "recover" and before.phase == "reloading":
            self._set_resource(id, replace(before, phase="loaded", since=entry.at))

    def _take_message(self, entry: Entry) -> None:
        if entry.name == "Load":
            self._asked[entry.query] = (entry.server, entry.detail)
        elif entry.name in ("Loaded", "LoadRefused"):
            self._asked.pop(entry.query, None)

    def _set_resource(self, id: str, resource: ResourceThen | None) -> None:
        before = self._resources.pop(id, None) if resource is None else self._resources.get(id)
        if resource is not None:
            self._resources[id] = resource
        if (change := _change(self._at, id, before, resource)) is not None:
            self._changes.append(change)


def is_of_child(entry: Entry) -> bool:
    """Return whether an entry is an event of a child, or the end of the tree."""
    facts = entry.facts
    return entry.process != "" and bool(facts) and not entry.server and ("state" in facts or entry.event == "ended")


# -- the beginning -----------------------------------------------------------------------------------------------------


def first_moment(entries: Iterable[Entry], present: Iterable[Mapping[str, Any]], since: float) -> Moment:
    """Return the moment before the first entry.

    Args:
        present: what the recording noted when it began: mappings with "children" and "resources". If there is nothing,
            the beginning is what the entries tell: what ends, or has a status, was there before.
        since: when the recording began.
    """
    present = list(present)
    if not present:
        return _told_by(entries, since)
    children, resources = dict[str, ChildThen](), dict[str, ResourceThen]()
    for part in present:
        for facts in part.get("children", ()):
            child = msgspec.convert(facts, ChildThen)
            children[child.path] = child
        for facts in part.get("resources", ()):
            resource = msgspec.convert(facts, ResourceThen)
            resources[resource.id] = resource
    return Moment(since, children, resources)


def _told_by(entries: Iterable[Entry], since: float) -> Moment:
    children, resources = dict[str, ChildThen | None](), dict[str, ResourceThen | None]()
    for entry in entries:
        if is_of_child(entry) and entry.process not in children:
            children[entry.process] = _child_before(entry)
            above = entry.process
            while above := above.rpartition("/")[0]:
                starts = entry.event in _STARTS and children[entry.process] is None
                children.setdefault(above, None if starts else ChildThen(above, "supervisor"))
        elif entry.resource and entry.facts and entry.server and entry.resource not in resources:
            resources[entry.resource] = _resource_before(entry, since)
    return Moment(
        since,
        {path: child for path, child in children.items() if child is not None},
        {id: resource for id, resource in resources.items() if resource is not None},
    )


def _child_before(entry: Entry) -> ChildThen | None:
    """Return the child whose first event this is, as it was before; None if it did not run, or nothing says so."""
    facts = entry.facts
    if entry.event not in ("exited", "stopped") or facts.get("up_s") is None:
        return ChildThen(entry.process, "supervisor") if entry.event == "ended" else None
    return ChildThen(entry.process, str(facts.get("kind", "")), "running", None, facts.get("pid") or None)


def _resource_before(entry: Entry, since: float) -> ResourceThen | None:
    """Return the resource whose first event this is, as it was before; None if it was loaded later.

    Nothing says which state it had.
    """
    made = time_in(entry.resource)
    if entry.event in _BEGINS or (made is not None and made > since):
        return None
    text = str(entry.facts.get("title") or entry.facts.get("request", ""))
    return ResourceThen(entry.resource, entry.server, text)
