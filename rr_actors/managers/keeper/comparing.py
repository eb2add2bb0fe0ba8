"""The comparison of what is wanted with what is there, and the reasons for what is not there. Pure.

Only the two states count, never the events between them. So the steps are right from any state and after any order of
events: when they have been carried out and nothing more happens, what is there is what is wanted.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Literal

import msgspec

from rr_actors.managers.planning.setbacks import Setback
from rr_actors.registrar.model.rows import State

Slot = tuple[str, int]
"""The name of a kind of thing that is kept, and the number of the replica."""
NONE_REGISTERED = "none registered"
OVER_CAPACITY = "over capacity"
FAILING = "failing"
ALL_FAILING = "all failing"
LOADING = "loading"
UNLOAD_FAILED = "unload failed"
NO_READING = "no reading"
_HINDERED = (NONE_REGISTERED, OVER_CAPACITY, FAILING, ALL_FAILING, UNLOAD_FAILED)


class WantedReplica(msgspec.Struct, frozen=True):
    """A replica that is wanted. `what`: the canonical bytes of its request, equal for equal things."""

    keep: str
    instance: int
    what: bytes
    priority: int | None = 0
    after: tuple[str, ...] = ()

    @property
    def slot(self) -> Slot:
        """Whose place it takes."""
        return self.keep, self.instance


class SeenReplica(msgspec.Struct, frozen=True):
    """A replica that is there.

    Attributes:
        phase: "loading": the load has not been answered. "held": query `id` holds it. "releasing": its release has not
            been answered. "ending": nobody holds it, and it has not been unloaded yet.
        state, message: of its last status.
        not_before: while it is held: the time before which it is not released, as a release has failed.
        stuck: why its last release has failed: it may be running still, so no second one is loaded. "": it has not.
        is_slow: whether it has been loading for a while, so that the failure before is not the reason any more.
    """

    keep: str
    instance: int
    what: bytes
    phase: Literal["loading", "held", "releasing", "ending"] = "held"
    id: str = ""
    state: State = State.OK
    priority: int | None = 0
    message: str = ""
    not_before: float = 0.0
    stuck: str = ""
    is_slow: bool = False

    @property
    def slot(self) -> Slot:
        """Whose place it takes."""
        return self.keep, self.instance

    @property
    def is_ready(self) -> bool:
        """Whether it can be used."""
        return self.phase == "held" and self.state not in (State.ERROR, State.FATAL)


class ReplicaSteps(msgspec.Struct):
    """What to do.

    Attributes:
        load: what is missing.
        withdraw: loads that nobody needs any more.
        release: what is not wanted, or is lost, by what was seen.
        prioritise: what has another priority than is wanted.
        next_at: when there will be more to do if nothing happens; None: never.
    """

    load: list[WantedReplica] = []
    withdraw: list[SeenReplica] = []
    release: list[SeenReplica] = []
    prioritise: list[tuple[SeenReplica, int | None]] = []
    next_at: float | None = None


class KeptReport(msgspec.Struct, frozen=True):
    """How one kind of thing is: how many replicas are wanted and ready, and why others are not.

    `why` is "" if all are ready; `detail` is the text of the first failure. `is_hindered`: a failure is the reason, and
    not only that time has to pass. `least`, `most`: of what scales, how many may be wanted; `scaled`: the reason of the
    last change of that.
    """

    name: str
    wanted: int
    ready: int
    why: str = ""
    detail: str = ""
    is_hindered: bool = False
    least: int | None = None
    most: int | None = None
    scaled: str = ""


def compare(
    wanted: Sequence[WantedReplica], seen: Iterable[SeenReplica], failures: Mapping[Slot, Setback], now: float
) -> ReplicaSteps:
    """Return the steps from what is seen to what is wanted.

    A slot is loaded only when nothing else is left in it, so there is never a second one of a replica.
    """
    steps, due = ReplicaSteps(), list[float]()
    there = _by_slot(seen)
    waiting = unready(wanted, there)
    for one in wanted:
        found = there.pop(one.slot, [])
        right = _right(one, found)
        _give_up([other for other in found if other is not right], steps, due, now)
        if right is not None:
            if right.phase == "held" and right.priority != one.priority:
                steps.prioritise.append((right, one.priority))
        elif not any(_is_in_the_way(other, one) for other in found) and not waiting.intersection(one.after):
            retry_at = failures[one.slot].retry_at if one.slot in failures else now
            if retry_at <= now:
                steps.load.append(one)
            else:
                due.append(retry_at)
    for found in reversed(there.values()):
        _give_up(found, steps, due, now)
    steps.next_at = min(due, default=None)
    return steps


def unready(wanted: Iterable[WantedReplica], there: Mapping[Slot, Sequence[SeenReplica]]) -> set[str]:
    """Return the names of what is wanted and not ready in all its replicas."""
    return {one.keep for one in wanted if not _is_ready(one, there.get(one.slot, ()))}


def report(
    names: Iterable[str], wanted: Iterable[WantedReplica], seen: Iterable[SeenReplica], failures: Mapping[Slot, Setback]
) -> dict[str, KeptReport]:
    """Return how each of the names is."""
    of_name: dict[str, list[WantedReplica]] = {name: [] for name in names}
    for one in wanted:
        of_name[one.keep].append(one)
    there = _by_slot(seen)
    waiting = unready([one for ones in of_name.values() for one in ones], there)
    return {name: _report(name, ones, there, failures, waiting) for name, ones in of_name.items()}


def _report(
    name: str,
    wanted: Sequence[WantedReplica],
    there: Mapping[Slot, Sequence[SeenReplica]],
    failures: Mapping[Slot, Setback],
    waiting: set[str],
) -> KeptReport:
    missing = [one for one in wanted if not _is_ready(one, there.get(one.slot, ()))]
    reasons = [_reason(one, there.get(one.slot, ()), failures.get(one.slot), waiting) for one in missing]
    whys = list(dict.fromkeys(why for why, _ in reasons))
    if missing and len(missing) == len(wanted) and whys == [FAILING]:
        whys = [ALL_FAILING]
    detail = next((text for why, text in reasons if why in _HINDERED and text), "")
    is_hindered = any(why in _HINDERED for why in whys)
    return KeptReport(name, len(wanted), len(wanted) - len(missing), ", ".join(whys), detail, is_hindered)


def _reason(
    one: WantedReplica, found: Sequence[SeenReplica], failed: Setback | None, waiting: set[str]
) -> tuple[str, str]:
    """Return why a replica is not ready, and the text of the failure."""
    right = _right(one, found)
    if right is None and (stuck := next((other.stuck for other in found if other.stuck), "")):
        return UNLOAD_FAILED, stuck
    if right is not None and right.phase == "held":
        return FAILING, right.message
    if right is None and (before := [name for name in one.after if name in waiting]):
        return f"waits for {before[0]}", ""
    if failed is None or (right is not None and right.is_slow):
        return LOADING, ""
    return failed.reason, failed.text


def _by_slot(seen: Iterable[SeenReplica]) -> dict[Slot, list[SeenReplica]]:
    there: dict[Slot, list[SeenReplica]] = {}
    for one in seen:
        there.setdefault(one.slot, []).append(one)
    return there


def _right(one: WantedReplica, found: Iterable[SeenReplica]) -> SeenReplica | None:
    """Return what is there for a replica that is wanted, and is to stay."""
    for other in found:
        if other.what == one.what and other.phase in ("loading", "held") and other.state is not State.FATAL:
            return other
    return None


def _is_ready(one: WantedReplica, found: Iterable[SeenReplica]) -> bool:
    right = _right(one, found)
    return right is not None and right.is_ready


def _is_in_the_way(other: SeenReplica, one: WantedReplica) -> bool:
    """Return whether a replica cannot be loaded yet: a load of what is ending is answered after its end by itself."""
    return other.phase != "ending" or other.what != one.what


def _give_up(found: Iterable[SeenReplica], steps: ReplicaSteps, due: list[float], now: float) -> None:
    for one in found:
        if one.phase == "loading":
            steps.withdraw.append(one)
        elif one.phase == "held" and one.not_before > now:
            due.append(one.not_before)
        elif one.phase == "held":
            steps.release.append(one)
