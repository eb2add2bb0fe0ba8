"""The administrative calls of a supervisor (OTP: start_child, terminate_child, restart_child, delete_child ...).

The performer knows by `caller` where an answer goes. Each call is answered by exactly one Reply(caller), at once or
when the start or stop that it needs is done. OTP's answers are errors here:

    {error, {already_started, Pid}}  AlreadyStarted      {error, running}             ChildRunning
    {error, already_present}         AlreadyPresent      {error, restarting}          ChildRestarting
    {error, not_found}               NotFound            {error, simple_one_for_one}  NotForDynamic
    {error, Reason}                  StartFailed

Calls on a supervisor that is stopping or has stopped are answered with NotFound. Manual starts and stops never count as
restarts. A call about a child that a caller is starting or stopping waits until that is done. A call about a child that
is being restarted does not. Under one_for_all and rest_for_one a start waits for its turn while the group restarts.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Sequence
from typing import Any, Literal, NamedTuple

from msgspec.structs import replace

from rr_actors.base.checks import SupervisorCall, SupervisorLook, invalid
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
    with_article,
)
from rr_actors.supervision.core.children import Children
from rr_actors.supervision.core.specs import ChildSpec, Supervisor, as_child_spec, check_significant
from rr_actors.supervision.core.state import Call, ChildPhase, Decision, SupervisedChild, SupervisorState, Why
from rr_actors.supervision.core.transition import Draft

# -- messages ------------------------------------------------------------------------------------------------------


class Change(SupervisorCall, frozen=True):
    """A call that is answered when a child has started or stopped. The function `name` below decides it."""

    name: Literal["start_child", "terminate_child", "restart_child", "delete_child", "update"]
    subject: Any
    id: str = ""
    """Of the dynamic child that start_child adds; "": one is made up."""


class Question(SupervisorLook, frozen=True):
    """A call that is answered at once."""

    name: Literal["which_children", "which_child", "count_children", "get_childspec", "history", "describe"]
    id: str = ""


class Foresee(SupervisorLook, frozen=True):
    """A question that is answered at once: what would happen if the child `id` was killed, stopped or restarted?"""

    id: str
    what: Literal["kill", "stop", "restart"]


class ChildUpdated(SupervisorCall, frozen=True):
    """The child supervisor `id` has been given a new specification."""

    id: str
    spec: Supervisor


# -- changes -------------------------------------------------------------------------------------------------------


def start_child(
    tree: SupervisorState, spec: ChildSpec | Supervisor | Sequence[Any], caller: Hashable, now: float, id: str = ""
) -> Decision:
    """Add a child after the others and start it; under simple_one_for_one `spec` is a list of additional arguments.

    A dynamic child with an `id` is kept, unless it is temporary. If it is there and stopped, it starts with these
    arguments.

    Reply: the child's id, or None if its on_start returned IGNORE. (The specification is kept then, unless it is
    temporary or dynamic.) Errors: AlreadyStarted, AlreadyPresent, StartFailed (nothing is added), InvalidSpec,
    TooManyChildren.
    """
    draft = Draft(tree, now)
    try:
        child = _newcomer(tree, spec, caller, id)
    except (InvalidSpec, TooManyChildren) as error:
        draft.reply([caller], error=error)
        return draft.done()
    if tree.dynamic and not id:
        draft.tree = replace(tree, last_dynamic=tree.last_dynamic + 1)
    return _perform(draft, Call("start", child.id, caller, child))


def terminate_child(tree: SupervisorState, id: str, caller: Hashable, now: float) -> Decision:
    """Stop a child that runs, starts or is about to be restarted.

    Its specification stays, unless it is temporary or dynamic. Reply when the child is down, at once for a dynamic
    child that has ended already. Errors: NotFound, NotForDynamic for a template.
    """
    return _perform(Draft(tree, now), Call("terminate", id, caller))


def restart_child(tree: SupervisorState, id: str, caller: Hashable, now: float) -> Decision:
    """Start a stopped child again. Of dynamic children only a kept one can be stopped.

    Reply: its id, or None (IGNORE). Errors: ChildRunning, ChildRestarting, NotFound, NotForDynamic, StartFailed (the
    child stays stopped).
    """
    return _perform(Draft(tree, now), Call("restart", id, caller))


def delete_child(tree: SupervisorState, id: str, caller: Hashable, now: float) -> Decision:
    """Drop a stopped child's specification. Errors: ChildRunning, ChildRestarting, NotFound, NotForDynamic."""
    return _perform(Draft(tree, now), Call("delete", id, caller))


def update(tree: SupervisorState, spec: Supervisor, caller: Hashable, now: float) -> Decision:
    """Give the supervisor a new specification (OTP: code_change).

    Children that it names stay as they are, and get their new specification at their next start. New children are
    added, stopped. Children that it does not name are kept, after the others. Order, strategy and intensity change at
    once. The parent decides on restart, shutdown_s, significant and placement: `update_child` keeps them.
    Error: InvalidSpec, with nothing changed, for another id, or a change from or to simple_one_for_one.
    """
    draft = Draft(tree, now)
    error = _update_error(tree, spec) or (None if draft.alive else draft.gone())
    if error is not None:
        draft.reply([caller], error=error)
        return draft.done()
    new = spec.child_specs
    if tree.dynamic:
        draft.children = Children({id: replace(child, spec=new[0]) for id, child in draft.children.items()})
    else:
        named = {s.id: replace(draft.children.get(s.id) or SupervisedChild(s.id, s), spec=s) for s in new}
        draft.children = Children(named | {id: child for id, child in draft.children.items() if id not in named})
    draft.tree = replace(tree, spec=spec)
    draft.reply([caller])
    draft.advance()
    return draft.done()


def update_child(tree: SupervisorState, id: str, spec: Supervisor) -> SupervisorState:
    """Note that the child supervisor `id` has been given a new specification, and use that one at its next start.

    The specification of a static child is also kept in `tree.spec`. The supervisor's own parent must hear of that.
    """
    child = find_child(tree, id)
    inner = child.spec.actor_class_or_manager
    if tree.dynamic or not isinstance(inner, Supervisor):
        return tree
    as_before = {name: getattr(inner, name) for name in ("restart", "shutdown_s", "significant", "placement")}
    spec = dataclasses.replace(spec, **as_before)
    kept = dataclasses.replace(child.spec, actor_class_or_manager=spec)
    children = Children.of(tree.children).put(id, replace(child, spec=kept))
    static = [spec if c is inner else children[id].spec if c is child.spec else c for c in tree.spec.children]
    return replace(tree, spec=dataclasses.replace(tree.spec, children=static), children=children)


# -- questions, answered at once in every mode ----------------------------------------------------------------------


class Counts(NamedTuple):
    """How many children a supervisor has, as count_children() returns it.

    Attributes:
        specs: specifications, of living and dead children; under simple_one_for_one 1, the template.
        active: children that run.
        supervisors, workers: children of each type, living and dead.
    """

    specs: int
    active: int
    supervisors: int
    workers: int


def which_children(tree: SupervisorState) -> list[SupervisedChild]:
    """Return all children, newest first, as OTP lists them."""
    return list(tree.children.values())[::-1]


def count_children(tree: SupervisorState) -> Counts:
    """Count the children."""
    children = tree.children.values()
    supervisors = sum(child.spec.type == "supervisor" for child in children)
    active = sum(child.state == "running" for child in children)
    return Counts(1 if tree.dynamic else len(children), active, supervisors, len(children) - supervisors)


def get_childspec(tree: SupervisorState, id: str) -> ChildSpec:
    """Return the specification of a child, or the template for the template's id; raise NotFound if there is none.

    The specification of a dynamic child has the child's own id and all its arguments.
    """
    if tree.dynamic and id == tree.template.id:
        return tree.template
    return find_child(tree, id).start_spec


def find_child(tree: SupervisorState, id: str) -> SupervisedChild:
    """Return the child of that id; raise NotFound, with the existing children, if there is none."""
    child = tree.children.get(id)
    if child is None:
        raise _not_found(tree, id)
    return child


# -- how the calls are done ----------------------------------------------------------------------------------------


def replay(draft: Draft, calls: Sequence[Call]) -> None:
    """Do the calls that waited until a child's start or stop had ended."""
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
    elif draft.tree.dynamic and (call.kind == "delete" or (call.kind == "restart" and not (child and child.kept))):
        error = NotForDynamic(f"{call.kind}_child({call.id!r}): {draft.tree.path} is simple_one_for_one", id=call.id)
        draft.reply([call.caller], error=error)
    elif call.kind == "start" and child is None:
        assert call.child is not None
        draft.due(call.child)
    elif child is None:
        draft.reply([call.caller], error=_absent(draft.tree, call.id))
    elif call.kind == "terminate":
        _terminate(draft, child, call.caller)
    else:
        _do_when_settled(draft, child, call)


def _do_when_settled(draft: Draft, child: SupervisedChild, call: Call) -> None:
    standing = _standing(child)
    if standing is None:
        draft.put(child, waiting=(*child.waiting, call))
    elif standing == "stopped" and call.kind == "start" and child.kept:
        assert call.child is not None
        draft.due(replace(child, extra=call.child.extra, lost=None, why=Why.MANUAL, starters=(call.caller,)))
    elif standing != "stopped" or call.kind == "start":
        draft.reply([call.caller], error=_refusal(draft, child, call, standing))
    elif call.kind == "restart" and child.lost is not None:
        draft.reply([call.caller], error=draft.start_error(child, child.lost))
    elif call.kind == "restart":
        draft.due(replace(child, why=Why.MANUAL, attempts=0, starters=(call.caller,)))
    else:
        draft.down(replace(child, why=Why.NEW), "deleted")
        draft.reply([call.caller])


def _terminate(draft: Draft, child: SupervisedChild, caller: Hashable) -> None:
    if child.starters:
        draft.reply(child.starters, error=draft.start_error(child, "terminate_child() ended it"))
        child = draft.put(child, starters=())
    match child.phase:
        case ChildPhase.STOPPED if not draft.forgets(child):
            draft.reply([caller])
        case ChildPhase.DUE | ChildPhase.STOPPED:  # a temporary child is STOPPED only if an update added it
            draft.down(child, "stopped")
            draft.reply([caller])
            replay(draft, child.waiting)
        case ChildPhase.STARTING | ChildPhase.RUNNING | ChildPhase.CONDEMNED:
            draft.stop(draft.put(child, stoppers=(caller,)))
        case ChildPhase.RECYCLING | ChildPhase.STOPPING:
            draft.put(child, phase=ChildPhase.STOPPING, stoppers=(*child.stoppers, caller))


def _standing(child: SupervisedChild) -> Literal["running", "restarting", "stopped"] | None:
    """Return a child's state for a call; None if the call must wait for a start or stop that a caller asked for."""
    match child.phase:
        case ChildPhase.STOPPED:
            return "stopped"
        case ChildPhase.RUNNING:
            return "running"
        case ChildPhase.STOPPING:
            return None
        case _:
            return "restarting" if child.why is Why.RESTART else None


def _refusal(draft: Draft, child: SupervisedChild, call: Call, standing: str) -> RrError:
    match call.kind, standing:
        case "start", "running":
            error, what = AlreadyStarted, "is running"
        case "start", "stopped":
            error, what = AlreadyPresent, "exists and is stopped: call restart_child or delete_child"
        case "start", _:
            error, what = AlreadyPresent, "exists and is being restarted: call terminate_child first"
        case _, "running":
            error, what = ChildRunning, "is running: call terminate_child first"
        case _:
            error, what = ChildRestarting, "is being restarted: call terminate_child first"
    return error(f"{call.kind}_child({child.id!r}): {draft.tree.path}/{child.id} {what}", id=child.id)


def _not_found(tree: SupervisorState, id: str) -> NotFound:
    known = ", ".join(child.id for child in Children.of(tree.children).first(10, *ChildPhase)) or "none"
    more = ", ..." if len(tree.children) > 10 else ""
    return NotFound(f"supervisor {tree.path} has no child {shown(id)} (it has: {known}{more})", id=id)


def _absent(tree: SupervisorState, id: str) -> RrError | None:
    """Return the answer to terminate_child for an unknown id: an error, or None for a past dynamic child, as in OTP."""
    if tree.dynamic and id == tree.template.id:
        return NotForDynamic(f"terminate_child({id!r}): this is the template of {tree.path}; name a child", id=id)
    if tree.dynamic and id.startswith(stem := tree.dynamic_id("")):
        number = id.removeprefix(stem)
        if number.isdecimal() and 1 <= int(number) <= tree.last_dynamic:
            return None
    return _not_found(tree, id)


def _newcomer(
    tree: SupervisorState, spec: ChildSpec | Supervisor | Sequence[Any], caller: Hashable, id: str
) -> SupervisedChild:
    """Return the child that start_child adds; raise InvalidSpec or TooManyChildren if there must not be one."""
    who = f"start_child of {tree.path}"
    if tree.dynamic:
        if not isinstance(spec, list | tuple):
            raise _wrong_type(who, "args", "a list of additional arguments, as it is simple_one_for_one", spec)
        if id:
            check_kept_id(id, tree)
        limit = tree.spec.max_children
        if limit is not None and len(tree.children) >= limit and id not in tree.children:
            text = f"{who}: it has {len(tree.children)} children, and max_children is {limit}: terminate one first"
            raise TooManyChildren(text, id=tree.path, limit=limit)
        kept = bool(id) and tree.template.restart != "temporary"
        id = id or tree.dynamic_id(str(tree.last_dynamic + 1))
        child = SupervisedChild(id, tree.template, tuple(spec), kept, why=Why.NEW, starters=(caller,))
        _ = child.start_spec  # raises InvalidSpec if the arguments are wrong
        return child
    if not isinstance(spec, ChildSpec | Supervisor):
        raise _wrong_type(who, "spec", "a ChildSpec or Supervisor", spec)
    if id:
        raise invalid(who, "id", "none, as the ChildSpec has one", id)
    check_significant(spec, tree.spec, spec.id)
    return SupervisedChild(spec.id, as_child_spec(spec), why=Why.NEW, starters=(caller,))


def check_kept_id(id: str, tree: SupervisorState) -> None:
    """Raise InvalidSpec if no dynamic child of this supervisor may have the id."""
    if id == tree.template.id:
        raise invalid(f"start_child of {tree.path}", "id", "another id than the template's", id)


def _wrong_type(who: str, field: str, expected: str, got: object) -> InvalidSpec:
    # The text has the type, not the repr: this runs on the loop, and a user's repr may do anything.
    text = f"{who}: expected {expected}, got {with_article(type(got).__name__)}"
    return InvalidSpec(text, field=field, expected=expected, got=got)


def _update_error(tree: SupervisorState, spec: object) -> InvalidSpec | None:
    who = f"update of {tree.path}"
    if not isinstance(spec, Supervisor):
        return invalid(who, "spec", "a Supervisor", spec)
    if spec.id != tree.spec.id:
        return invalid(who, "id", f"{tree.spec.id!r}, its id", spec.id)
    if (spec.strategy == "simple_one_for_one") != tree.dynamic:
        expected = "simple_one_for_one" if tree.dynamic else "any but simple_one_for_one"
        text = (
            f"{who}: strategy: expected {expected} (children of the other kind cannot be kept), "
            f"got {shown(spec.strategy)}"
        )
        return InvalidSpec(text, field="strategy", expected=expected, got=spec.strategy)
    return None
