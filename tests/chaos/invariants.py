"""Checks of the catalogs and of the house: when nothing is in flight any more, and when everything is released."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping

from rr_actors.registrar.model.rows import Hold, Phase
from rr_actors.registrar.queries import ResourceInfo
from rr_actors.tools.inspection import Contents, check, check_delivered

_LOOK_S = 0.1


def settled(look: Callable[[], list[str]], timeout_s: float) -> list[str]:
    """Call `look` until it finds nothing, for `timeout_s` at most; return its last findings."""
    deadline = time.monotonic() + timeout_s
    while (found := look()) and time.monotonic() < deadline:
        time.sleep(_LOOK_S)
    return found


def check_at_rest(state: Mapping[str, Contents]) -> list[str]:
    """Return the errors of a system at rest: those that inspection finds, and rows of anything still in flight."""
    moving = (wrong for contents in state.values() for wrong in _moving(contents))
    return [*check(state), *check_delivered(state), *moving]


def check_empty(state: Mapping[str, Contents]) -> list[str]:
    """Return the rows that are left in a system in which everything is released."""
    return [
        f"{contents.name}: {kind} {id} is left"
        for contents in state.values()
        for kind, rows in (
            ("resource", contents.resources),
            ("query", contents.queries),
            ("held query", contents.held),
            ("notice", contents.notices),
        )
        for id in rows
    ]


def check_told(state: Mapping[str, Contents], told: Mapping[str, Iterable[str]]) -> list[str]:
    """Return the queries in which a consumer and its catalog differ. `told`: the consumer's query ids by registrar."""
    violations: list[str] = []
    for name, ids in told.items():
        held, expected = set(state[name].held), set(ids)
        violations += [f"{name}: heard of query {id}, which its catalog lacks" for id in expected - held]
        violations += [f"{name}: its catalog has query {id}, of which it was not told" for id in held - expected]
    return violations


def check_house(
    devices: Iterable[ResourceInfo],
    budgets: Iterable[ResourceInfo],
    programs: Iterable[ResourceInfo],
    stands: Callable[[int], bool],
) -> list[str]:
    """Return what is wrong in a house at rest: shares without their wholes, and programs that stand, or do not.

    Args:
        devices, budgets, programs: the resources of the three managers, at one moment.
        stands: whether the program of this pid stands still.
    """
    on = sorted(info.request.watts for info in devices if info.server == "device")
    shares = sorted(info.request.amount for info in budgets if info.server == "share")
    found = [] if shares == on else [f"the shares are {shares}, and the devices need {on}"]
    found += [f"{info.request} is {info.phase}" for info in (*devices, *budgets) if info.phase != "loaded"]
    for info in programs:
        is_needed = info.priority is not None
        if info.phase != ("loaded" if is_needed else "paused") or stands(info.response.pid) == is_needed:
            found.append(f"{info.request.instance}: priority {info.priority}, {info.phase}, needed: {is_needed}")
    return found


def used_by(devices: Iterable[ResourceInfo]) -> float:
    """Return the watts of all devices that are on."""
    return sum(info.request.watts for info in devices if info.server == "device" and info.phase == "loaded")


def _moving(contents: Contents) -> Iterator[str]:
    held = {query.resource_id for query in contents.queries.values()}
    for resource in contents.resources.values():
        what = f"{contents.name}: resource {resource.id}"
        if resource.phase not in (Phase.LOADED, Phase.PAUSED):
            yield f"{what} is {resource.phase}"
        elif resource.id not in held:
            yield f"{what} is held by nobody"
    for row in contents.held.values():
        if row.hold is Hold.PENDING:
            yield f"{contents.name}: its query {row.id} at {row.registrar} is {row.hold}"
