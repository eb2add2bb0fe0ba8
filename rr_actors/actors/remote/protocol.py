"""What the actors of two processes say to each other, on links of kind "actors".

The process that dialled sends Ask, Tell, Inquire, Halt, Watch and Unwatch; the other one answers with Answered, Raised,
Dead, Watching or Over. Bodies are pickled (the channel is private and authenticated) and are opened in a worker, or in
the thread that asked.
"""

from __future__ import annotations

from typing import Any

import msgspec

KIND = "actors"
"""Hello.kind of these links."""

ASKS = "asks"
"""Hello.kind of those on which a thread asks: one Ask at a time, and its answer."""


class Ask(msgspec.Struct, frozen=True, array_like=True, tag=1):
    """A message for the actor `to` (its URN); answer with this number. `chain`: who is blocked until then."""

    call: int
    to: str
    body: bytes
    chain: list[tuple[str, str]]


class Tell(msgspec.Struct, frozen=True, array_like=True, tag=2):
    """A message for the actor `to`; no answer."""

    to: str
    body: bytes


class Inquire(msgspec.Struct, frozen=True, array_like=True, tag=3):
    """About the actor, not for it: "alive", "class" or "attributes"."""

    call: int
    to: str
    what: str


class Halt(msgspec.Struct, frozen=True, array_like=True, tag=4):
    """Stop the actor; answer when it has."""

    call: int
    to: str
    reason: str
    final: bool


class Answered(msgspec.Struct, frozen=True, array_like=True, tag=5):
    """The answer to a call."""

    call: int
    body: bytes


class Raised(msgspec.Struct, frozen=True, array_like=True, tag=6):
    """The handler raised. `error`: the exception, pickled, or empty if it does not pickle; `text` names it anyway."""

    call: int
    error: bytes
    text: str
    trace: str


class Dead(msgspec.Struct, frozen=True, array_like=True, tag=7):
    """There is no such actor, or it stopped before it handled the message; `taken`: or ended while it handled it."""

    call: int
    taken: bool = False


class Watch(msgspec.Struct, frozen=True, array_like=True, tag=8):
    """Say Watching, and Over when the actor `to` has ended; or Dead if it is not there."""

    call: int
    to: str


class Unwatch(msgspec.Struct, frozen=True, array_like=True, tag=9):
    """Forget the Watch with this number."""

    call: int


class Over(msgspec.Struct, frozen=True, array_like=True, tag=10):
    """The watched actor has ended, in this way."""

    call: int
    reason: str
    detail: str


class Watching(msgspec.Struct, frozen=True, array_like=True, tag=11):
    """The actor is watched from now on."""

    call: int


Letter = Ask | Tell | Inquire | Halt | Answered | Raised | Dead | Watch | Unwatch | Watching | Over


CODECS: dict[str, Any] = {KIND: Letter, ASKS: Letter}
"""The messages of these links, for the transport."""
