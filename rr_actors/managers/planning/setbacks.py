"""Setbacks: what has failed, how often, and when it may be tried again. Pure: the caller passes the time.

There is one policy for all managers, `BACKOFF`: each failure in a row waits longer, up to a limit. What has run
well for as long as the limit begins anew. While something waits, its manager tells the holders WARNING.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from typing import TypeVar

import msgspec

from rr_actors.supervision.core.specs import Backoff

K = TypeVar("K")

BACKOFF = Backoff(delay_s=0.1, factor=2.0, maximum_s=5.0, jitter=0.0)
"""The waiting times of what is loaded, replaced or chosen again."""


class Setback(msgspec.Struct, frozen=True):
    """That something has failed `count` times in a row. It may be tried again at `retry_at`.

    Attributes:
        retry_at: on the clock whose times the caller passes.
        reason: the kind of failure, for a program. `text`: the failure, for people.
        failure_id: identifies the failure; the same failure counts once.
    """

    count: int
    retry_at: float
    reason: str = ""
    text: str = ""
    failure_id: str = ""


def next_setback(
    before: Setback | None,
    now: float,
    backoff: Backoff = BACKOFF,
    *,
    ran_s: float = 0.0,
    reason: str = "",
    text: str = "",
    failure_id: str = "",
) -> Setback:
    """Return the setback after `before`.

    Args:
        ran_s: how many seconds it had run well; 0: it did not run. From `backoff.maximum_s` on the waiting times begin
            anew.
        failure_id: of the failure, if several may report it; one that is `before` already does not count again.
    """
    if before is not None and failure_id and before.failure_id == failure_id:
        return before
    has_run_well = 0.0 < ran_s >= backoff.maximum_s
    count = 0 if before is None or has_run_well else before.count
    return Setback(count + 1, now + backoff.delay(count, 0.0), reason, text, failure_id)


class Setbacks(Mapping[K, Setback]):
    """The setbacks of one manager, by what has failed. It has no lock: use it on one thread, or under a lock."""

    def __init__(self, backoff: Backoff = BACKOFF) -> None:
        self._backoff = backoff
        self._of: dict[K, Setback] = {}

    def note(
        self, key: K, now: float, *, ran_s: float = 0.0, reason: str = "", text: str = "", failure_id: str = ""
    ) -> Setback:
        """Note a failure, as next_setback() says, and return what holds now."""
        before = self._of.get(key)
        made = next_setback(before, now, self._backoff, ran_s=ran_s, reason=reason, text=text, failure_id=failure_id)
        self._of[key] = made
        return made

    def __getitem__(self, key: K) -> Setback:
        return self._of[key]

    def __iter__(self) -> Iterator[K]:
        return iter(self._of)

    def __len__(self) -> int:
        return len(self._of)

    def may_try(self, key: K, now: float) -> bool:
        """Return whether it may be tried now."""
        return key not in self._of or self._of[key].retry_at <= now

    def next_at(self, now: float) -> float | None:
        """Return when the next of those that wait may be tried; None if none waits."""
        return min((one.retry_at for one in self._of.values() if one.retry_at > now), default=None)

    def ready_first(self, keys: Iterable[K], now: float, is_well: Callable[[K], bool] = lambda _: False) -> list[K]:
        """Return the keys in the order in which to try them, each group in the order given.

        First what `is_well` says is loaded and well, then what may be tried, then what still waits, as a last resort.
        """
        return sorted(keys, key=lambda key: (not is_well(key), not self.may_try(key, now)))

    def forget(self, key: K) -> None:
        """Forget what is known of one: it begins anew."""
        self._of.pop(key, None)

    def keep_only(self, keys: Container[K]) -> None:
        """Forget all others."""
        self._of = {key: one for key, one in self._of.items() if key in keys}

    def clear(self) -> None:
        """Forget all: each may be tried at once."""
        self._of.clear()
