"""Supervisor calls: the messages of a SupervisorRef, and the error of other actors."""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from rr_actors.base.errors import NotFound
from rr_actors.supervision.core.specs import Supervisor


class SupervisorCall(msgspec.Struct, frozen=True):
    """A message that only a supervisor understands. Handlers of other actors never get it."""


class Change(SupervisorCall, frozen=True):
    """A call that is answered when a child has started or stopped. core/child_calls.py has the function `name`."""

    name: Literal["start_child", "terminate_child", "restart_child", "delete_child", "update"]
    subject: Any


class Question(SupervisorCall, frozen=True):
    """A call that is answered at once."""

    name: Literal["which_children", "which_child", "count_children", "get_childspec", "history", "describe"]
    id: str = ""


class ChildUpdated(SupervisorCall, frozen=True):
    """The child supervisor `id` has been given a new specification."""

    id: str
    spec: Supervisor


class NoSupervisor(NotFound):
    """The call went to an actor that is no supervisor."""


def check_for_actor(message: object, actor: object) -> None:
    """Check that a message to `actor`, which is no supervisor, is not a call for one.

    Raises:
        NoSupervisor: the message is one.
    """
    if isinstance(message, SupervisorCall):
        raise NoSupervisor(f"it is no supervisor, but a child of class {type(actor).__qualname__}")
