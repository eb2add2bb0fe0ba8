"""The errors of nodes: one has ended, is not in the graph or does not answer, or refuses a transition."""

from __future__ import annotations

from rr_actors.base.errors import RrError


class NodeFailed(RrError):
    """The program of a node has ended before the node was ready, or nobody waits for it any more."""


class RosTimeout(RrError):
    """A node was not in the graph in time, or has not answered. `.node`; `.expected`: what was waited for"""

    node: str
    expected: str


class TransitionFailed(RrError):
    """A lifecycle node has refused a transition, or cannot make it. `.node`, `.transition`; `.state`: what it is in"""

    node: str
    transition: str
    state: str
