"""How a lifecycle node is brought to a state: which transition follows, and what is done if no answer comes.

A request to a service of ROS is lost if the node is not known yet, or is new and its predecessor was killed. So it is
sent again. A transition is sent again only when the node has said meanwhile that it is still in the state before.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Literal, Protocol, TypeVar

from rr_actors.managers.ros.ros_errors import RosTimeout, TransitionFailed

Transition = Literal["configure", "activate", "deactivate", "cleanup"]
Goal = Literal["active", "inactive", "unconfigured"]

STILL = frozenset(("unconfigured", "inactive", "active", "finalized"))
"""The states in which a lifecycle node stays. Any other is one between two of them."""

_NEXT: dict[Goal, dict[str, Transition]] = {
    "active": {"unconfigured": "configure", "inactive": "activate"},
    "inactive": {"active": "deactivate", "unconfigured": "configure"},
    "unconfigured": {"active": "deactivate", "inactive": "cleanup"},
}
_POLL_S = 0.02
_ASKED_AGAIN_S = 0.5  # a node that is asked for its state
_SENT_AGAIN_S = 2.0  # a transition

T = TypeVar("T")


class Lifecycle(Protocol):
    """The services of one lifecycle node. From any thread; nothing here waits."""

    def ask_state(self) -> Future[str]:
        """Ask for its state, "active". A future that is cancelled is not waited for any more."""
        ...

    def ask_transition(self, transition: Transition) -> Future[bool]:
        """Ask for a transition; the answer is whether it has succeeded."""
        ...

    def close(self) -> None:
        """Ask nothing more."""
        ...


def state_of(node: str, lifecycle: Lifecycle, timeout_s: float, check: Callable[[], object] = lambda: None) -> str:
    """Return the state of a lifecycle node.

    Args:
        node: its full name, for the error.
        check: called again and again; what it raises ends the wait.

    Raises:
        RosTimeout: it has not answered within the time. `.node`, `.expected`
    """
    limit = time.monotonic() + timeout_s
    while (left_s := limit - time.monotonic()) > 0:
        state = _answer(lifecycle.ask_state(), min(left_s, _ASKED_AGAIN_S), check)
        if state is not None:
            return state
    expected = f"an answer of {node}/get_state"
    text = f"node {node}: expected {expected} within {timeout_s:g} s, got none: it hangs, or is no lifecycle node"
    raise RosTimeout(text, node=node, expected=expected)


def bring(
    node: str, lifecycle: Lifecycle, goal: Goal, timeout_s: float, check: Callable[[], object] = lambda: None
) -> None:
    """Bring a lifecycle node to a state, by as many transitions as it takes.

    Raises:
        RosTimeout: it was not there within the time.
        TransitionFailed: it has refused a transition, or is finalized. `.node`, `.transition`, `.state`
    """
    limit = time.monotonic() + timeout_s
    sent: Transition | None = None
    while True:
        left_s = limit - time.monotonic()
        if left_s <= 0:
            expected = f"an answer of {node}/change_state to {sent!r}" if sent else f"the state {goal}"
            raise RosTimeout(f"node {node}: expected {expected} within {timeout_s:g} s", node=node, expected=expected)
        state = state_of(node, lifecycle, left_s, check)
        if state == goal:
            return
        if state not in STILL:
            check()
            time.sleep(_POLL_S)
            continue
        transition = _NEXT[goal].get(state)
        if transition is None:
            raise _refused(node, goal, state, f"expected {goal}, got {state}, in which it stays until it is ended")
        sent = transition
        left_s = max(_POLL_S, limit - time.monotonic())
        if _answer(lifecycle.ask_transition(transition), min(left_s, _SENT_AGAIN_S), check) is False:
            state = state_of(node, lifecycle, max(_ASKED_AGAIN_S, limit - time.monotonic()), check)
            raise _refused(node, transition, state, f"it has refused {transition!r}, and is {state}")


def _refused(node: str, transition: str, state: str, said: str) -> TransitionFailed:
    return TransitionFailed(f"node {node}: {said}", node=node, transition=transition, state=state)


def _answer(asked: Future[T], timeout_s: float, check: Callable[[], object]) -> T | None:
    """Return the answer; None if there is none within the time."""
    limit = time.monotonic() + timeout_s
    try:
        while not asked.done():
            check()
            left_s = limit - time.monotonic()
            if left_s <= 0:
                return None
            wait((asked,), min(_POLL_S, left_s))
        return asked.result()
    finally:
        asked.cancel()
