"""Planning: what each choice has, what could be better, and when to try that. Without IO, clock or thread.

An alternative that has failed is tried again after a while, by a load beside the one that is in use. If it stays well
for `settle_s`, it takes its place. So nothing that works is given up for something that has not been seen to work.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence

import msgspec

RETRY_LEAST_S = 0.1
RETRY_LIMIT_S = 60.0
_FORGIVEN_AFTER = 10.0  # times the last delay: what has been well for so long begins with the shortest again


class Standing(msgspec.Struct, frozen=True):
    """What is known of an alternative.

    Attributes:
        failed_at: when it failed last; None: never.
        delay_s: how long after that it is tried again.
        trial: "" for none, "loading", or "loaded" since `well_since`.
    """

    failed_at: float | None = None
    delay_s: float = 0.0
    trial: str = ""
    well_since: float = 0.0

    @property
    def retry_at(self) -> float:
        """When it may be tried again: at once, if it never failed."""
        return 0.0 if self.failed_at is None else self.failed_at + self.delay_s


UNKNOWN = Standing()


class ChoiceState(msgspec.Struct, frozen=True):
    """One choice: what it allows, the best first, and what it has.

    Attributes:
        ranked: the keys of the alternatives.
        present: the key of the one in use.
        fixed: keys to which it does not return by itself, because they cannot be tried beside the present one.
        failing: whether the one in use has said ERROR. Then every other one is better.
    """

    ranked: tuple[str, ...]
    present: str
    fixed: frozenset[str] = frozenset()
    failing: bool = False

    def better(self) -> tuple[str, ...]:
        """Return the alternatives that would be better than the one in use, the best first."""
        others = self.ranked
        if self.present in others and not self.failing:
            others = others[: others.index(self.present)]
        return tuple(key for key in others if key != self.present and key not in self.fixed)


class Plan(msgspec.Struct, frozen=True):
    """What to do now: alternatives to load on trial, trials to end, choices that take a better one; when to look again.

    Attributes:
        take: the key that each choice is to have, by the choice's id.
        look_at: the next time at which something is due; None: nothing will be, unless something happens.
    """

    load: tuple[str, ...]
    end: tuple[str, ...]
    take: dict[str, str]
    look_at: float | None


def failed(standing: Standing, now: float, settle_s: float) -> Standing:
    """Return what is known of an alternative after a failure: each soon after another doubles the delay."""
    soon = standing.failed_at is not None and now < standing.failed_at + _FORGIVEN_AFTER * standing.delay_s
    shortest, longest = max(RETRY_LEAST_S, settle_s), max(RETRY_LIMIT_S, settle_s)
    trial = "loading" if standing.trial == "loading" else ""  # that load will end, and says so
    return Standing(now, min(2 * standing.delay_s, longest) if soon else shortest, trial)


def in_turn(
    ranked: Sequence[str],
    standings: Mapping[str, Standing],
    without: Collection[str],
    now: float,
    loaded: Collection[str] = (),
) -> list[str]:
    """Return the alternatives to try, in this order.

    First those that are `loaded` and well, as they can be had at once; last those that failed a short while ago.
    """
    others = [key for key in ranked if key not in without]
    return sorted(others, key=lambda key: (key not in loaded, standings.get(key, UNKNOWN).retry_at > now))


def plan(choices: Mapping[str, ChoiceState], standings: Mapping[str, Standing], now: float, settle_s: float) -> Plan:
    """Say what to do for all choices together: one trial serves each choice for which it would be better."""
    better = {id: choice.better() for id, choice in choices.items()}
    wanted = list(dict.fromkeys(key for keys in better.values() for key in keys))
    of = {key: standings.get(key, UNKNOWN) for key in wanted}
    settled = {key for key, one in of.items() if one.trial == "loaded" and now >= one.well_since + settle_s}
    take = {id: best for id, keys in better.items() if (best := _first(keys, settled)) is not None}
    load = tuple(key for key, one in of.items() if not one.trial and now >= one.retry_at)
    end = tuple(key for key, one in standings.items() if one.trial == "loaded" and key not in of)
    due = [_due(one, settle_s) for one in of.values()]
    return Plan(load, end, take, min((at for at in due if at is not None and at > now), default=None))


def _first(keys: Iterable[str], settled: Collection[str]) -> str | None:
    return next((key for key in keys if key in settled), None)


def _due(standing: Standing, settle_s: float) -> float | None:
    if standing.trial:
        return standing.well_since + settle_s if standing.trial == "loaded" else None
    return standing.retry_at
