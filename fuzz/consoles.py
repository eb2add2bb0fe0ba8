"""A console's socket: what connections say, as frames of requests, and what a connection takes for answers."""

from __future__ import annotations

from typing import Any

import msgspec

from fuzz.packed import framed, in_frames, samples
from fuzz.target import Target, pieces
from rr_actors.base.errors import RrError, Unavailable
from rr_actors.base.values.failure import error_of
from rr_actors.system.console import console_messages
from rr_actors.system.console.console_messages import Refused
from rr_actors.system.console.console_protocol import ANSWERS, REQUESTS, decoder_of
from rr_actors.wire.frames import FrameReader

_SIDES: list[tuple[msgspec.msgpack.Decoder[Any], int, tuple[type, ...]]] = [
    (decoder_of(REQUESTS), console_messages.REQUEST_LIMIT_BYTES, REQUESTS),
    (decoder_of(ANSWERS), console_messages.ANSWER_LIMIT_BYTES, ANSWERS),
]


def _seeds() -> list[bytes]:
    sides = [
        (bytes([side]), [body for kind in kinds for body in samples(kind)]) for side, (_, _, kinds) in enumerate(_SIDES)
    ]
    single = [side + b"\0" + framed(body) for side, some in sides for body in some]
    return [*single, *(side + b"\5" + b"".join(map(framed, some[:6])) for side, some in sides)]


def _feed(data: bytes) -> None:
    """Byte 0: which side reads; byte 1: how the rest arrives. Only declared messages come out, or a named error."""
    if len(data) < 2:
        return
    decoder, limit, kinds = _SIDES[data[0] % 2]
    reader = FrameReader[Any](decoder, limit)
    for piece in pieces(data[2:], data[1]):
        for message in reader.feed(piece):
            assert isinstance(message, kinds)
            assert type(decoder.decode(msgspec.msgpack.encode(message))) is type(message)
            if isinstance(message, Refused):
                assert isinstance(error_of(message.failure), RrError)
    assert reader.error is None or type(reader.error) is Unavailable


CONSOLE = Target(
    "what connections of a console say, and what a connection is answered",
    lambda directory: _feed,
    _seeds,
    in_frames(2),
    words=(b"is", b"listchildren", b"load", b"server", b"request", b"dry_run", b"limit", b"offset"),
)
