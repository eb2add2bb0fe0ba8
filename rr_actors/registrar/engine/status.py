"""Status: what an owner says of a resource, and what its holders hear."""

from __future__ import annotations

import itertools
from typing import Any, cast

from rr_actors.base.errors import UsageError, exact_text, is_a, shown, text_of
from rr_actors.registrar.model.messages import readable
from rr_actors.registrar.model.rows import Notice, State


def state_of(state: object, what: str) -> State:
    """Return the State that is given as such, or by its name in upper or lower case.

    Raises:
        UsageError: it is none; `what` is the call that it was given to.
    """
    if is_a(state, State):
        return cast("State", state)
    found = State.__members__.get(exact_text(cast("str", state)).upper()) if is_a(state, str) else None
    if found is None:
        raise UsageError(f"{what}: expected a state of {', '.join(State)}, got {shown(state)} ({type(state).__name__})")
    return found


class Status:
    """A word on how a resource is (thesis: status message).

    To send one, make it with a state and a message. One that is heard also says whose it is.

    Attributes:
        state: OK, UPDATE, WARNING, ERROR or FATAL. To make one, its name will do, in any case: Status("fatal").
        message: for people.
        resource_id: the resource the receiver holds that the status reached it by; in a server's status callback its
            own, if its owner has said it.
        query_id: the receiver's query on it; "" if it is the receiver's own.
        source: the server it began at, "registrar/server".
        repeated: a crash made it uncertain whether it was heard before.
    """

    __slots__ = (
        "_event",
        "_handled",
        "_spares",
        "message",
        "query_id",
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
        self._handled = False
        self._event = ""  # the same for all its receivers, and after a crash
        self._spares = itertools.count()

    def handled(self) -> None:
        """Say that this status has been dealt with, in a callback: it goes no further up.

        In a server's status callback: than its resource; if it is about that resource, its holders do not hear it. In
        `on_status` of a part: not even to the server's status callback.
        """
        self._handled = True

    @property
    def is_handled(self) -> bool:
        """Whether handled() was called."""
        return self._handled

    def _next_spare(self) -> str:
        """Return a name for the next spare part that is asked for because of it: the same when a crash repeats it."""
        return f"{self._event} {next(self._spares)}"

    def __repr__(self) -> str:
        source = f" from {self.source}" if self.source else ""
        return f"<Status {self.state}{source}: {self.message}>"

    def __str__(self) -> str:
        return f"{self.state}: {self.message}" if self.message else str(self.state)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Status) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple[Any, ...]:
        return (self.state, self.message, self.resource_id, self.query_id, self.source)

    def __reduce__(self) -> tuple[Any, ...]:
        return (_remake, (*self._key(), self.repeated))


def status_of(notice: Notice, *, repeated: bool = False) -> Status:
    """Return the status that a notice carries."""
    place = {"resource_id": notice.resource_id, "query_id": notice.query_id, "source": notice.source}
    status = Status(notice.state, notice.message, **place, repeated=repeated)
    status._event = notice.event  # pyright: ignore[reportPrivateUsage]  # same file
    return status


# For the package's own modules; people who complete a name see nothing of it.
next_spare = Status._next_spare  # pyright: ignore[reportPrivateUsage]  # same file


def message_text(message: object) -> str:
    """A message for people as text that can be sent.

    Raises:
        UsageError: it is something whose text cannot be had: nested too deeply, say.
    """
    try:
        return readable(str(message))
    except Exception as error:
        raise UsageError(f"message: expected text, got {shown(message)}, whose str() raised {text_of(error)}") from None


def _remake(state: State, message: str, resource_id: str, query_id: str, source: str, repeated: bool) -> Status:
    return Status(state, message, resource_id=resource_id, query_id=query_id, source=source, repeated=repeated)
