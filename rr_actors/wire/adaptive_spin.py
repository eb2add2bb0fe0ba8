"""Spin, then park: whether a thread that waits for an answer is to look for it for a moment before it sleeps.

To be woken costs more than a quick answer takes. To look for it meanwhile takes a core, and is in vain if the answer
takes longer, or if others have got the core or Python's lock. So what it was good for lately is remembered, as adaptive
mutexes do.
"""

from __future__ import annotations

SPIN_LIMIT_S = 200e-6

_QUICK_S = 2 * SPIN_LIMIT_S  # a parked thread hears of the answer when it has been woken
_EARNED_SPINNING_S = 50e-6  # two wake-ups are saved
_EARNED_PARKED_S = 6e-6
_BUDGET_MAX_S = 2 * SPIN_LIMIT_S
_BUDGET_MIN_S = -20e-3


class AdaptiveSpin:
    """The spinning of one thread at a time, for answers that come one at a time.

    An account of time. What was spun in vain is taken from it, with all that others took meanwhile; an answer that came
    while spinning earns 50 µs, one that came quickly to a parked thread 6 µs, one that took long nothing. Nobody spins
    who has nothing left. So answers that take long cost SPIN_LIMIT_S twice, and no more however many come; those that
    are always a little late, or that wait for others each time that somebody spins, cost 6 µs each.

    Attributes:
        worthwhile: whether to spin for the next answer, for SPIN_LIMIT_S at most.
    """

    __slots__ = ("_budget_s", "worthwhile")

    def __init__(self) -> None:
        self._budget_s = SPIN_LIMIT_S
        self.worthwhile = True

    def spun(self, took_s: float, answered: bool) -> None:
        """Note the end of spinning: after how many seconds, and whether the answer was there by then."""
        if answered and took_s <= SPIN_LIMIT_S:
            self._budget_s = min(_BUDGET_MAX_S, self._budget_s + _EARNED_SPINNING_S)
        else:
            self._budget_s = max(_BUDGET_MIN_S, self._budget_s - took_s)
            self.worthwhile = self._budget_s > 0

    def parked(self, took_s: float) -> None:
        """Note that an answer has come after so many seconds to a thread that found it not worthwhile to spin."""
        if took_s <= _QUICK_S:
            self._budget_s += _EARNED_PARKED_S
            self.worthwhile = self._budget_s > 0
