"""StatusMessage: a message of an owner about a resource, as its holders hear it."""

from __future__ import annotations

import itertools
from typing import Any, TypeVar

from rr_actors.base.errors import UsageError, exact_text, is_a, readable, shown, text_of
from rr_actors.registrar.model.rows import Notice, State

_SHORT = 1000  # characters: readable() changes nothing in such a text of ASCII


def state_of(state: object, what: str) -> State:
    """Return the State that is given as such, or by its name in upper or lower case.

    Raises:
        UsageError: `state` is no State; `what`, the name of the call, begins the text.
    """
    if type(state) is State:
        return state
    found = State.__members__.get(exact_text(state).upper()) if is_a(state, str) else None
    if found is None:
        raise UsageError(f"{what}: expected a state of {', '.join(State)}, got {shown(state)} ({type(state).__name__})")
    return found


class StatusMessage:
    """A Status (registrar/queries.py) without the query that it is of: what the engine knows of one."""

    __slots__ = (
        "_event",
        "_handled",
        "_spares",
        "deadline_s",
        "message",
        "query_id",
        "reason",
        "repeated",
        "resource_id",
        "source",
        "state",
    )

    def __init__(
        self,
        state: State | str,
        message: str = "",
        *,
        resource_id: str = "",
        query_id: str = "",
        source: str = "",
        repeated: bool = False,
    ) -> None:
        self.state = state_of(state, "status")
        self.message = message_text(message)
        self.resource_id = resource_id
        self.query_id = query_id
        self.source = source
        self.repeated = repeated
        self.reason = ""
        self.deadline_s: float | None = None
        self._handled = False
        self._event = ""  # the same for all receivers of the status, and after a crash
        self._spares = itertools.count()

    def handled(self) -> None:
        """Say in a callback that this status has been dealt with, so that it goes no further up.

        From a server's status callback it does not go beyond the server's resource. If it is about that resource, the
        holders do not hear it. From `on_status` of a part, it does not even go to the server's status callback.
        """
        self._handled = True

    @property
    def is_handled(self) -> bool:
        """Whether handled() was called."""
        return self._handled

    def __repr__(self) -> str:
        source = f" from {self.source}" if self.source else ""
        return f"<Status {self.state}{source}: {self.message}>"

    def __str__(self) -> str:
        return f"{self.state}: {self.message}" if self.message else str(self.state)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StatusMessage) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple[Any, ...]:
        return (self.state, self.message, self.resource_id, self.query_id, self.source)

    def __reduce__(self) -> tuple[Any, ...]:
        return (_remake, (type(self), *self._key(), self.repeated, self.reason, self.deadline_s))


S = TypeVar("S", bound=StatusMessage)


def status_of(notice: Notice, kind: type[S], *, repeated: bool = False) -> S:
    """Return the status that a notice carries."""
    place = {"resource_id": notice.resource_id, "query_id": notice.query_id, "source": notice.source}
    status = kind(notice.state, notice.message, **place, repeated=repeated)
    status._event = notice.event  # pyright: ignore[reportPrivateUsage]  # same file
    if notice.reason:
        status.reason, status.deadline_s = notice.reason, notice.grace_ms / 1000
    return status


def next_spare(status: StatusMessage) -> str:
    """Return a name for the next spare part that a status needs: the same if a crash repeats the status."""
    return f"{status._event} {next(status._spares)}"  # pyright: ignore[reportPrivateUsage]  # same file


def message_text(message: object) -> str:
    """Return a message for people as text that can be sent.

    Raises:
        UsageError: str() of the message raises: it is nested too deeply, say.
    """
    if type(message) is str and len(message) < _SHORT and message.isascii():
        return message
    try:
        return readable(str(message))
    except Exception as error:
        raise UsageError(f"message: expected text, got {shown(message)}, whose str() raised {text_of(error)}") from None


def _remake(
    kind: type[S], state: State, message: str, resource_id: str, query_id: str, source: str, repeated: bool, *more: Any
) -> S:
    status = kind(state, message, resource_id=resource_id, query_id=query_id, source=source, repeated=repeated)
    status.reason, status.deadline_s = more
    return status
