"""The administrative calls of a supervisor (OTP: start_child, terminate_child, restart_child, delete_child ...).

`caller` is whatever tells the performer whom to answer: each call is answered by exactly one Reply(caller), at once or
when the start or stop that it needs is done. OTP's answers are errors here:

    {error, {already_started, Pid}}  AlreadyStarted      {error, running}             ChildRunning
    {error, already_present}         AlreadyPresent      {error, restarting}          ChildRestarting
    {error, not_found}               NotFound            {error, simple_one_for_one}  NotForDynamic
    {error, Reason}                  StartFailed

Calls on a supervisor that is stopping or has stopped are answered with NotFound. Manual starts and stops never count as
restarts. A call about a child that a caller is starting or stopping waits for that; one about a child that is being
restarted does not. Under one_for_all and rest_for_one a start waits for its turn while the group restarts.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Sequence
from typing import Any, Literal, NamedTuple

from msgspec.structs import replace

from rr_actors.base.checks import invalid
from rr_actors.base.errors import (
    AlreadyPresent,
    AlreadyStarted,
    ChildRestarting,
    ChildRunning,
    InvalidSpec,
    NotForDynamic,
    NotFound,
    RrError,
    TooManyChildren,
    shown,
)
from rr_actors.supervision.core.specs import ChildSpec, Supervisor, as_child_spec, check_significant
from rr_actors.supervision.core.state import Call, Child, Decision, Phase, Tree, Why
from rr_actors.supervision.core.transition import Draft

# -- calls ---------------------------------------------------------------------------------------------------------


def start_child(tree: Tree, spec: ChildSpec | Supervisor | Sequence[Any], caller: Hashable, now: float) -> Decision:
    """Add a child after the others and start it; under simple_one_for_one `spec` is a list of additional arguments.

    Reply: its id, or None when it said IGNORE (its specification is kept, unless temporary or dynamic); AlreadyStarted,
    AlreadyPresent; StartFailed (then it is not a child); InvalidSpec; TooManyChildren.
    """
    draft = Draft(tree, now)
    try:
        child = _newcomer(tree, spec, caller)
    except (InvalidSpec, TooManyChildren) as error:
        draft.reply([caller], error=error)
        return draft.done()
    if tree.dynamic:
        draft.tree = replace(tree, last_dynamic=tree.last_dynamic + 1)
    return _perform(draft, Call("start", child.id, caller, child))


def terminate_child(tree: Tree, id: str, caller: Hashable, now: float) -> Decision:
    """Stop a child, if it is up, coming up or about to be restarted. Its specification stays, unless it is temporary
    or dynamic. Reply when it is down (as for a dynamic child that has ended already); NotFound; NotForDynamic for a
    template."""
    return _perform(Draft(tree, now), Call("terminate", id, caller))


def restart_child(tree: Tree, id: str, caller: Hashable, now: float) -> Decision:
    """Start a stopped child again. Reply: its id, or None (IGNORE); ChildRunning, ChildRestarting, NotFound,
    NotForDynamic; StartFailed (it stays stopped)."""
    return _perform(Draft(tree, now), Call("restart", id, caller))


def delete_child(tree: Tree, id: str, caller: Hashable, now: float) -> Decision:
    """Drop a stopped child's specification. Reply; ChildRunning, ChildRestarting, NotFound, NotForDynamic."""
    return _perform(Draft(tree, now), Call("delete", id, caller))


def update(tree: Tree, spec: Supervisor, caller: Hashable, now: float) -> Decision:
    """Give the supervisor a new specification (OTP: code_change).

    Children it names stay as they are and have their new specification from their next start on; new ones are added,
    stopped; those it does not name are kept, after the others. Order, strategy and intensity are the new ones at once.
    Its restart, shutdown_s, significant and placement are its parent's affair: see `update_child`.
    Reply; InvalidSpec, with nothing changed: another id, or from or to simple_one_for_one.
    """
    draft = Draft(tree, now)
    try:
        _check_update(tree, spec)
    except InvalidSpec as error:
        draft.reply([caller], error=error)
        return draft.done()
    if not draft.alive:
        draft.reply([caller], error=draft.gone())
        return draft.done()
    new = spec.child_specs
    if tree.dynamic:
        draft.children = {id: replace(child, spec=new[0]) for id, child in draft.children.items()}
    else:
        named = {s.id: replace(draft.children.get(s.id) or Child(s.id, s), spec=s) for s in new}
        draft.children = named | {id: child for id, child in draft.children.items() if id not in named}
    draft.tree = replace(tree, spec=spec)
    draft.reply([caller])
    draft.advance()
    return draft.done()


def update_child(tree: Tree, id: str, spec: Supervisor) -> Tree:
    """Note that the child supervisor `id` has been given a new specification: its next start will be by that one.

    Only a static child's is kept in `tree.spec`, too, which the supervisor's own parent wants to know then.
    """
    child = find_child(tree, id)
    inner = child.spec.actor_class_or_manager
    if tree.dynamic or not isinstance(inner, Supervisor):
        return tree
    as_before = {name: getattr(inner, name) for name in ("restart", "shutdown_s", "significant", "placement")}
    spec = dataclasses.replace(spec, **as_before)
    kept = dataclasses.replace(child.spec, actor_class_or_manager=spec)
    children = {**tree.children, id: replace(child, spec=kept)}
    static = [spec if c is inner else children[id].spec if c is child.spec else c for c in tree.spec.children]
    return replace(tree, spec=dataclasses.replace(tree.spec, children=static), children=children)


# -- questions -----------------------------------------------------------------------------------------------------


class Counts(NamedTuple):
    """specs: specifications, of living and dead children; active: running children; the rest by their type."""

    specs: int
    active: int
    supervisors: int
    workers: int


def which_children(tree: Tree) -> list[Child]:
    """All children, newest first, as OTP lists them. Any time, at once."""
    return list(reversed(tree.children.values()))


def count_children(tree: Tree) -> Counts:
    """How many there are. Any time, at once. Under simple_one_for_one specs is 1, the template."""
    children = tree.children.values()
    supervisors = sum(child.spec.type == "supervisor" for child in children)
    active = sum(child.state == "running" for child in children)
    return Counts(1 if tree.dynamic else len(children), active, supervisors, len(children) - supervisors)


def get_childspec(tree: Tree, id: str) -> ChildSpec:
    """The specification of a child; of a dynamic one with its own id and all its arguments, by the template's id the
    template.

    Raises:
        NotFound: there is no such child.
    """
    if tree.dynamic and id == tree.template.id:
        return tree.template
    return find_child(tree, id).start_spec


def find_child(tree: Tree, id: str) -> Child:
    """The child of that id.

    Raises:
        NotFound: naming the supervisor, the id and the children there are.
    """
    child = tree.children.get(id)
    if child is None:
        raise _not_found(tree, id)
    return child


# -- how the calls are done ----------------------------------------------------------------------------------------


def replay(draft: Draft, calls: Sequence[Call]) -> None:
    """Do the calls that waited for a child's start or stop to end."""
    for call in calls:
        _do(draft, call)


def _perform(draft: Draft, call: Call) -> Decision:
    _do(draft, call)
    draft.advance()
    return draft.done()


def _do(draft: Draft, call: Call) -> None:
    child = draft.children.get(call.id)
    if not draft.alive:
        draft.reply([call.caller], error=draft.gone())
    elif call.kind in ("restart", "delete") and draft.tree.dynamic:
        error = NotForDynamic(f"{call.kind}_child({call.id!r}): {draft.tree.path} is simple_one_for_one", id=call.id)
        draft.reply([call.caller], error=error)
    elif call.kind == "start" and child is None:
        assert call.child is not None
        draft.due(draft.put(call.child))
    elif child is None:
        draft.reply([call.caller], error=_absent(draft.tree, call.id))
    elif call.kind == "terminate":
        _terminate(draft, child, call.caller)
    else:
        _do_when_settled(draft, child, call)


def _do_when_settled(draft: Draft, child: Child, call: Call) -> None:
    standing = _standing(child)
    if standing is None:
        draft.put(child, waiting=(*child.waiting, call))
    elif standing != "stopped" or call.kind == "start":
        draft.reply([call.caller], error=_refusal(draft, child, call, standing))
    elif call.kind == "restart":
        draft.due(draft.put(child, why=Why.MANUAL, attempts=0, starters=(call.caller,)))
    else:
        draft.down(replace(child, why=Why.NEW), "deleted")
        draft.reply([call.caller])


def _terminate(draft: Draft, child: Child, caller: Hashable) -> None:
    if child.starters:
        draft.reply(child.starters, error=draft.start_error(child, "terminate_child() ended it"))
        child = draft.put(child, starters=())
    match child.phase:
        case Phase.STOPPED if not draft.forgets(child):
            draft.reply([caller])
        case Phase.DUE | Phase.STOPPED:  # a temporary one can be stopped already if it came with an update
            draft.down(child, "stopped")
            draft.reply([caller])
            replay(draft, child.waiting)
        case Phase.STARTING | Phase.RUNNING | Phase.CONDEMNED:
            draft.stop(draft.put(child, stoppers=(caller,)))
        case Phase.RECYCLING | Phase.STOPPING:
            draft.put(child, phase=Phase.STOPPING, stoppers=(*child.stoppers, caller))


def _standing(child: Child) -> Literal["running", "restarting", "stopped"] | None:
    """What a call finds; None: wait for its end, a start or stop that somebody asked for goes on."""
    match child.phase:
        case Phase.STOPPED:
            return "stopped"
        case Phase.RUNNING:
            return "running"
        case Phase.STOPPING:
            return None
        case _:
            return "restarting" if child.why is Why.RESTART else None


def _refusal(draft: Draft, child: Child, call: Call, standing: str) -> RrError:
    who = f"{call.kind}_child({child.id!r})"
    path = f"{draft.tree.path}/{child.id}"
    match call.kind, standing:
        case "start", "running":
            return AlreadyStarted(f"{who}: {path} is running", id=child.id)
        case "start", "stopped":
            return AlreadyPresent(
                f"{who}: {path} exists and is stopped: call restart_child or delete_child", id=child.id
            )
        case "start", _:
            return AlreadyPresent(
                f"{who}: {path} exists and is being restarted: call terminate_child first", id=child.id
            )
        case _, "running":
            return ChildRunning(f"{who}: {path} is running: call terminate_child first", id=child.id)
        case _:
            return ChildRestarting(f"{who}: {path} is being restarted: call terminate_child first", id=child.id)


def _not_found(tree: Tree, id: str) -> NotFound:
    known = ", ".join(list(tree.children)[:10]) or "none"
    more = ", ..." if len(tree.children) > 10 else ""
    return NotFound(f"supervisor {tree.path} has no child {shown(id)} (it has: {known}{more})", id=id)


def _absent(tree: Tree, id: str) -> RrError | None:
    """What terminate_child is answered about a child that is not there: as in OTP, None for a dynamic one of old."""
    if tree.dynamic and id == tree.template.id:
        return NotForDynamic(f"terminate_child({id!r}): this is the template of {tree.path}; name a child", id=id)
    if tree.dynamic and id.startswith(stem := tree.dynamic_id("")):
        number = id.removeprefix(stem)
        if number.isdecimal() and 1 <= int(number) <= tree.last_dynamic:
            return None
    return _not_found(tree, id)


def _newcomer(tree: Tree, spec: ChildSpec | Supervisor | Sequence[Any], caller: Hashable) -> Child:
    """The child that start_child is about.

    Raises:
        InvalidSpec: not what this supervisor takes.
        TooManyChildren: it has max_children.
    """
    who = f"start_child of {tree.path}"
    if tree.dynamic:
        if not isinstance(spec, list | tuple):
            expected = "a list of additional arguments, as it is simple_one_for_one"
            text = f"{who}: expected {expected}, got a {type(spec).__name__}"
            raise InvalidSpec(text, field="args", expected=expected, got=spec)
        limit = tree.spec.max_children
        if limit is not None and len(tree.children) >= limit:
            text = f"{who}: it has {len(tree.children)} children, and max_children is {limit}: terminate one first"
            raise TooManyChildren(text, id=tree.path, limit=limit)
        id = tree.dynamic_id(str(tree.last_dynamic + 1))
        child = Child(id, tree.template, tuple(spec), why=Why.NEW, starters=(caller,))
        _ = child.start_spec  # raises what is wrong with the arguments
        return child
    if not isinstance(spec, ChildSpec | Supervisor):
        expected = "a ChildSpec or Supervisor"
        # What it is and not what it says: this is on the loop, and a user's repr may do anything.
        text = f"{who}: expected {expected}, got a {type(spec).__name__}"
        raise InvalidSpec(text, field="spec", expected=expected, got=spec)
    check_significant(spec, tree.spec, spec.id)
    return Child(spec.id, as_child_spec(spec), why=Why.NEW, starters=(caller,))


def _check_update(tree: Tree, spec: object) -> None:
    who = f"update of {tree.path}"
    if not isinstance(spec, Supervisor):
        raise invalid(who, "spec", "a Supervisor", spec)
    if spec.id != tree.spec.id:
        expected = f"{tree.spec.id!r}, its id"
        raise invalid(who, "id", expected, spec.id)
    if (spec.strategy == "simple_one_for_one") != tree.dynamic:
        expected = "simple_one_for_one" if tree.dynamic else "any but simple_one_for_one"
        text = (
            f"{who}: strategy: expected {expected} (children of the other kind cannot be kept), "
            f"got {shown(spec.strategy)}"
        )
        raise InvalidSpec(text, field="strategy", expected=expected, got=spec.strategy)
