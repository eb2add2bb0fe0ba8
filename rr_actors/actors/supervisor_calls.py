"""Supervisor calls: what a SupervisorRef asks, and what it hears if there is no supervisor where it asks."""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from rr_actors.core.specs import Supervisor
from rr_actors.errors import NotFound


class SupervisorCall(msgspec.Struct, frozen=True):
    """What only a supervisor understands: no other actor is bothered with it."""


class Change(SupervisorCall, frozen=True):
    """A call that is answered when a child has started or stopped. `name`: of the function in core/admin.py."""

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
    """An actor of another class was asked."""


def check_for_actor(message: object, actor: object) -> None:
    """That a message is not one for a supervisor; `actor` is none.

    Raises:
        NoSupervisor: it is.
    """
    if isinstance(message, SupervisorCall):
        raise NoSupervisor(f"it is no supervisor, but a child of class {type(actor).__qualname__}")
