"""What a consumer is told in place of a message that is over the limit of a frame, so that its link can stay.

A message of the same meaning, as far as it goes. It is needed where the limit has been lowered since something was
loaded, where an error has come by very many registrars, or where a class brings half a program along.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from rr_actors import pickling
from rr_actors.messages import Described, Failure, Fetched, LoadRefused, Message, Noticed, UnloadRefused

_replace = msgspec.structs.replace
_PLAIN_TYPES = pickling.dumps((None, None), "no types")
_CHARACTER = 4  # bytes, at most


def fitting(message: Message, limit: int) -> Sequence[Message]:
    """What is to be sent in place of it, in this order; nothing if there is nothing to say without what is too long.

    Args:
        limit: bytes that a frame may have.
    """
    match message:
        case Fetched(queries=[_, _, *_] as rows):
            half = len(rows) // 2
            return _replace(message, queries=rows[:half], more=True), _replace(message, queries=rows[half:])
        case Fetched(queries=[row]) if row.response is not None:
            return (_replace(message, queries=[_replace(row, response=None)]),)  # whoever holds it has it
        case Fetched(queries=[row]) if row.request:
            return (_replace(message, queries=[_replace(row, request=b"")]),)
        case LoadRefused() | UnloadRefused() if (shorter := _shortened(message.failure, limit)) != message.failure:
            return (_replace(message, failure=shorter),)
        case Described() if message.blob != _PLAIN_TYPES:
            return (Described(message.server, _PLAIN_TYPES),)
        case Noticed(notice=notice) if notice.response is not None:
            return (_replace(message, notice=_replace(notice, response=None)),)
        case _:
            return ()


def _shortened(failure: Failure, limit: int) -> Failure:
    """Its text, and the first of the registrars that it came by, within half of a frame."""
    room = limit // (2 * _CHARACTER)
    message = failure.message[: room // 2]
    room -= len(message)
    trace: list[tuple[str, str]] = []
    for frame in failure.trace:
        room -= sum(map(len, frame))
        if room < 0:
            break
        trace.append(frame)
    return Failure(failure.kind, message, {}, trace)
