"""Checks of the mission: nothing is held by nobody, nothing is there twice, and no action has run after its end."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence

import msgspec

from chaos.callback_log import Line
from chaos.mission.mission_managers import ACT, ACTED, ALTERNATIVES, RELEASED, SEEN, STEPS
from rr_actors.base.values.canonical import shown_plain
from rr_actors.managers import Choose, Kept
from rr_actors.managers.actions.graph_documents import run_in
from rr_actors.managers.actions.graph_runs import LIVE, MOST_ATTEMPTS
from rr_actors.managers.choices.alternatives import key_of
from rr_actors.managers.choices.matching import ranked
from rr_actors.registrar.model.rows import Held, Phase, Resource, State
from rr_actors.registrar.queries import ResourceInfo
from rr_actors.tools.inspection import Contents

_PLACES = {step.__name__: place for place, step in enumerate(STEPS)}
_PLACES["Look"] = _PLACES["Fetch"]  # they run side by side


# -- actions -----------------------------------------------------------------------------------------------------------


def check_acts(lines: Iterable[Line]) -> list[str]:
    """Return each action that has run again although its end was on disk, or otherwise than it was told.

    The end of an action is on disk before an action after it begins, and before anybody sees that the graph has ended.
    """
    of: dict[str, list[Line]] = defaultdict(list)
    for line in lines:
        if line.what in (ACT, ACTED, SEEN, RELEASED):
            of[line.subject.partition("/")[0]].append(line)
    return [f"mission {mission}: {wrong}" for mission, history in of.items() for wrong in _wrong_acts(history)]


def _wrong_acts(history: Sequence[Line]) -> Iterator[str]:
    attempts: dict[str, int] = {}
    running: dict[str, int] = {}
    furthest, furthest_action, over = (0, 0), "", ""
    for line in history:
        if line.what in (SEEN, RELEASED):
            over = line.what
        elif line.what == ACTED:
            running.pop(line.subject, None)
        else:
            action, before = line.subject.partition("/")[2], attempts.get(line.subject, 0)
            place = _place(action)
            if over:
                yield f"action {action} runs after its end was on disk: {over}"
            elif place < furthest:
                yield f"action {action} runs after its end was on disk: {furthest_action} has begun"
            if line.attempt <= before or line.attempt > MOST_ATTEMPTS:
                yield f"action {action} runs as attempt {line.attempt} after {before}"
            if running.get(line.subject) == line.pid:
                yield f"action {action} runs twice at once"
            attempts[line.subject], running[line.subject] = line.attempt, line.pid
            if place > furthest:
                furthest, furthest_action = place, action


def _place(action: str) -> tuple[int, int]:
    """Return when in a graph an action's turn is: those of equal places run side by side."""
    number, _, name = action.partition("/")
    round = 10**6 if name == "Finish" else int(number) if name != "Start" else 0
    return round, _PLACES[name]


def check_graphs(actions: Contents) -> list[str]:
    """Return the parts of graphs that no action needs: what an action has loaded is released when it has ended."""
    found = [f"actions: query {row.id} is held by nobody" for row in actions.held.values() if not row.parent]
    for row in actions.resources.values():
        if row.server == "graph" and row.phase is Phase.LOADED and row.response is not None:
            run = run_in(shown_plain(row.response))
            live = {f"{row.id}/{name}/{node.number}" for name, node in run.nodes.items() if node.state in LIVE}
            parts = [_run_of(shown_plain(part.request)) for part in actions.parts(row.id)]
            found += [
                f"actions: {part} of a graph that is {run.state} is held by nobody"
                for part in parts
                if part not in live
            ]
    return found


def _run_of(request: Mapping[str, str]) -> str:
    """Return which run an action, or a graph that is a part of another, was loaded for."""
    return request["run" if "run" in request else "instance"]


# -- what is kept ------------------------------------------------------------------------------------------------------


def check_replicas(infos: Iterable[ResourceInfo]) -> list[str]:
    """Return the replicas of which there are two: never, not for a moment."""
    slots = Counter((info.request.keep, info.request.instance) for info in infos if info.server == "replica")
    return [f"keeper: there are {count} replicas of {slot}" for slot, count in slots.items() if count > 1]


def check_kept(kept: Iterable[Kept], differences: Iterable[str], keeper: Contents) -> list[str]:
    """Return what is not as it is wanted, when nothing is harmed any more. `kept`, `differences`: as a Keeper says."""
    found = [f"keeper: {one}" for one in differences]
    replicas = {row.id for row in keeper.resources.values() if row.server == "replica"}
    wanted = sum(one.wanted for one in kept)
    if len(replicas) != wanted:
        found.append(f"keeper: there are {len(replicas)} replicas of {wanted}")
    own = Counter(row.resource_id for row in keeper.held.values() if not row.parent)
    found += [f"keeper: resource {id} is held {count} times" for id, count in own.items() if count > 1]
    return [*found, *(f"keeper: a query of {id} is held by nobody" for id in own if id not in replicas)]


# -- what is chosen ----------------------------------------------------------------------------------------------------


def check_choices(choices: Contents, providers: Mapping[str, Contents]) -> list[str]:
    """Return the choices without a part that works, and trials that none of them wants."""
    found: list[str] = []
    better = set[str]()
    for row in choices.resources.values():
        if row.phase is Phase.LOADED and row.state is not State.FATAL and row.response is not None:
            present, parts = shown_plain(row.response), choices.parts(row.id)
            key = key_of(present["server"], present["request"])
            better.update(_better(msgspec.convert(shown_plain(row.request), Choose), key, parts))
            found += _wrong_part(row, key, parts, providers)
    trials = Counter(_key(row) for row in choices.held.values() if not row.parent)
    found += [f"choices: there are {count} trials of {key}" for key, count in trials.items() if count > 1]
    return [*found, *(f"choices: the trial of {key} is held by nobody" for key in trials if key not in better)]


def allowed(request: Choose) -> list[str]:
    """Return the keys of the alternatives that a choice allows, the best first."""
    return [one.key for one in ranked(ALTERNATIVES, request.kind, request.where, request.prefer, lambda _: 1.0)]


def _better(request: Choose, present: str, parts: Iterable[Held]) -> list[str]:
    """Return the alternatives that a choice has on trial: all others, if the one in use has failed."""
    keys = allowed(request)
    failing = any(part.state is State.ERROR for part in parts)
    return [key for key in keys if key != present] if failing else keys[: keys.index(present)]


def _wrong_part(row: Resource, key: str, parts: Sequence[Held], providers: Mapping[str, Contents]) -> Iterator[str]:
    if [_key(part) for part in parts] != [key]:
        yield f"choices: choice {row.id} has {[_key(part) for part in parts]}, and says {key}"
    for part in parts:
        resource = providers[part.registrar].resources.get(part.resource_id)
        if resource is None or resource.phase is not Phase.LOADED or resource.state is State.FATAL:
            state = "gone" if resource is None else f"{resource.phase}, {resource.state}"
            yield f"choices: choice {row.id} has no working alternative: {key} is {state}"


def _key(row: Held) -> str:
    return key_of(f"{row.registrar}/{row.server}", shown_plain(row.request))


def wrong_fatal(request: Choose, message: str) -> str:
    """Return what is wrong with the message that a choice is lost: it says of each alternative why; "" if nothing."""
    missing = [key for key in allowed(request) if f"\n{key}: " not in message]
    return f"a choice of {request.kind} is lost, and does not say why of {missing}: {message!r}" if missing else ""
