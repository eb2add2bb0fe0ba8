"""The messages between the actors of two processes, on links of kind "actors".

The process that dialled sends Ask, Tell, Inquire, Halt, Watch and Unwatch; the other one answers with Answered, Raised,
Dead, Watching or Over. Bodies are pickled (the channel is private and authenticated) and are opened in a worker, or in
the thread that asked. A large body is a Parcel, which says where in shared memory it is.
"""

from __future__ import annotations

from typing import Any

import msgspec

from rr_actors.actors.messaging.ask_cycles import Chain
from rr_actors.actors.messaging.message_notes import Stamp
from rr_actors.wire.segments import Parcel

KIND = "actors"
"""The Hello.kind of these links."""

ASKS = "asks"
"""The Hello.kind of a thread's connection: one Ask at a time, and its answer."""

PATH_URN = "urn:rr-actor:"
"""The URN of a supervised actor is this and its path."""


class Ask(msgspec.Struct, frozen=True, array_like=True, tag=1):
    """A message for the actor with the URN `to`; the answer has the number `call`. `chain`: the blocked askers."""

    call: int
    to: str
    body: bytes | Parcel
    chain: Chain
    stamp: Stamp | None = None


class Tell(msgspec.Struct, frozen=True, array_like=True, tag=2):
    """A message for the actor `to`, without an answer."""

    to: str
    body: bytes | Parcel
    stamp: Stamp | None = None


class Inquire(msgspec.Struct, frozen=True, array_like=True, tag=3):
    """A question about the actor: "alive", "class" or "attributes"; or an order to its mailbox (mailbox_looks.py)."""

    call: int
    to: str
    what: str


class Halt(msgspec.Struct, frozen=True, array_like=True, tag=4):
    """A stop for the actor; the answer comes when it has ended."""

    call: int
    to: str
    reason: str
    final: bool
    stamp: Stamp | None = None


class Answered(msgspec.Struct, frozen=True, array_like=True, tag=5):
    """The answer to a call."""

    call: int
    body: bytes | Parcel


class HandlerRaised(msgspec.Struct, frozen=True, array_like=True, tag=6):
    """The handler raised. `error`: the pickled exception, or b"" if it cannot be pickled; `text` is its text."""

    call: int
    error: bytes
    text: str
    trace: str


class Dead(msgspec.Struct, frozen=True, array_like=True, tag=7):
    """There is no such actor, or it ended before it handled the message; if `taken`, perhaps while it handled it."""

    call: int
    taken: bool = False


class Watch(msgspec.Struct, frozen=True, array_like=True, tag=8):
    """A watch of the actor `to`; the answers: Watching, then Over when it has ended; or Dead if there is none."""

    call: int
    to: str


class Unwatch(msgspec.Struct, frozen=True, array_like=True, tag=9):
    """The end of the Watch with this number."""

    call: int


class Over(msgspec.Struct, frozen=True, array_like=True, tag=10):
    """The watched actor has ended, for this reason."""

    call: int
    reason: str
    detail: str


class Watching(msgspec.Struct, frozen=True, array_like=True, tag=11):
    """The actor is watched from now on."""

    call: int


Letter = Ask | Tell | Inquire | Halt | Answered | HandlerRaised | Dead | Watch | Unwatch | Watching | Over


CODECS: dict[str, Any] = {KIND: Letter, ASKS: Letter}
"""The message type of each kind of these links, for the transport."""
