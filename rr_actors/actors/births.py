"""Birth: what an actor's creator knows and its __init__ does not pass on, and what the creator hears if it fails."""

from __future__ import annotations

from collections.abc import Callable
from contextvars import ContextVar
from typing import Any, TypeVar

import msgspec

from rr_actors.actors.exits import OnExit
from rr_actors.errors import StartFailed, text_of

A = TypeVar("A")


class Birth(msgspec.Struct, frozen=True):
    """What an actor's creator gives to it; nothing by default, as by an ordinary call of its class.

    Attributes:
        path: the actor's path in its tree.
        place: what its host has for it.
        on_exit: called on the loop, once, when the actor has ended.
    """

    path: str | None = None
    place: Any = None
    on_exit: OnExit | None = None

    def of(self, cls: Callable[..., A], args: tuple[Any, ...], kwargs: dict[str, Any]) -> A:
        """Make the actor cls(*args, **kwargs). To be called in a context of its own, which ends with this call."""
        _given.set(self)
        return cls(*args, **kwargs)


_given: ContextVar[Birth | None] = ContextVar("rr_actors_birth", default=None)
_ORDINARY = Birth()


def take() -> Birth:
    """What the creator has given to the actor that is being made now; for its __new__, once."""
    birth = _given.get()
    if birth is None:
        return _ORDINARY
    _given.set(None)  # an actor that __init__ starts is not the one meant
    return birth


def as_heard(failure: BaseException, name: str) -> Exception:
    """What the creator of the actor `name` hears of what its on_start raised."""
    if isinstance(failure, Exception):
        return failure
    # SystemExit is this actor's, not that of whoever started it.
    heard = StartFailed(f"{name}: on_start raised {text_of(failure)}", id=name)
    heard.__cause__ = failure
    return heard
