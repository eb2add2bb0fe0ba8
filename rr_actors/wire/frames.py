"""Frames: messages on a stream, as bytes in and bytes out, without any I/O.

A frame is its body's length (4 bytes, big-endian) and its body, one MessagePack message. A frame of length 0 is the
goodbye of a side that closes on purpose: an end of the stream without it means that the peer died.
"""

from __future__ import annotations

import struct
from typing import Any, Generic, TypeVar

import msgspec

from rr_actors.base.errors import NotSerializable, Unavailable

T = TypeVar("T")

FRAME_LIMIT_BYTES = 16 * 1024 * 1024
"""The default limit for the body of a frame."""

_LENGTH = struct.Struct(">I")
_pack_length = _LENGTH.pack
_unpack_length = _LENGTH.unpack_from
_encode = msgspec.msgpack.Encoder().encode

GOODBYE = _pack_length(0)

_SHORT_BYTES = 4096
"""A shorter body is copied for the decoder, which takes less time than a view of it."""

# The errors of the encoder: for a type, an int over 64 bits, half a character, too deep a nesting. An exception that a
# signal handler raises meanwhile is none of these.
_NOT_ENCODED = (TypeError, OverflowError, UnicodeEncodeError, RecursionError)


_decoders: dict[int, tuple[Any, msgspec.msgpack.Decoder[Any]]] = {}  # by the identity of the types, which it keeps


def decoder_of(messages: Any) -> msgspec.msgpack.Decoder[Any]:
    """Return the decoder of these message types, a class or a union, which all connections share.

    Some take milliseconds to be made. So a fork server makes those that its children need (child_main.py). They are
    found by identity: to hash a union goes through all its types, whose memory a child would copy.
    """
    if (made := _decoders.get(id(messages))) is None:
        made = _decoders[id(messages)] = messages, msgspec.msgpack.Decoder(messages)
    return made[1]


class FrameReader(Generic[T]):
    """Cuts a stream into messages, whatever pieces it arrives in.

    Attributes:
        error: the error in the stream, if there was one; the rest of the stream is not read.
        ended: the peer has said goodbye.
    """

    __slots__ = ("_decode", "_limit", "_pieces", "_size", "_wanted", "ended", "error")

    def __init__(self, decoder: msgspec.msgpack.Decoder[T], limit: int) -> None:
        self._decode = decoder.decode
        self._limit = limit
        self._pieces: list[bytes] = []  # of an incomplete frame, as they arrived
        self._size = 0  # how many bytes these are
        self._wanted = 0  # the length of that frame, as far as it is known
        self.error: Unavailable | None = None
        self.ended = False

    @property
    def is_waiting(self) -> bool:
        """Whether a frame has begun and is not complete."""
        return bool(self._pieces)

    def feed(self, data: bytes) -> list[T]:
        """Return the messages that `data` completes; none after an `error`, or when the stream has `ended`."""
        if self.error is not None or self.ended:
            return []
        length = len(data) - 4
        if 0 < length <= self._limit and not self._pieces and _unpack_length(data)[0] == length:  # the common case
            try:
                return [self._decode(data[4:] if length < _SHORT_BYTES else memoryview(data)[4:])]
            except Exception as error:  # msgspec's own, UnicodeDecodeError, RecursionError, MemoryError
                self._not_a_message(length, error)
                return []
        if self._pieces:
            if len(self._pieces[-1]) < _SHORT_BYTES:  # a piece takes memory of its own, however short it is
                self._pieces[-1] += data
            else:
                self._pieces.append(data)
            self._size += len(data)
            if self._size < self._wanted:
                return []
            data = b"".join(self._pieces)
            self._pieces.clear()
        messages: list[T] = []
        decode = self._decode
        limit = self._limit
        size = len(data)
        start = 4
        wanted = 4
        while start <= size:
            length = _unpack_length(data, start - 4)[0]
            end = start + length
            if length > limit:
                self.error = Unavailable(f"a frame of {length} bytes, over the limit of {limit} (frame_limit_bytes)")
                return messages
            if end > size:
                wanted += length
                break
            try:
                messages.append(decode(data[start:end] if length < _SHORT_BYTES else memoryview(data)[start:end]))
            except Exception as error:  # as above
                self._not_a_message(length, error)
                return messages
            start = end + 4
        if start - 4 < size:
            self._wanted = wanted
            self._size = size - start + 4
            self._pieces.append(data[start - 4 :])
        return messages

    def _not_a_message(self, length: int, error: Exception) -> None:
        if length == 0:
            self.ended = True
            return
        self.error = Unavailable(f"a frame of {length} bytes that is no message: {type(error).__name__}: {error}")


ADVICE = (
    "send the name of a file, pictures and scans by a stream, or raise the limit; a request or a response is to be"
    " small: it is a row on disk"
)
"""What to do instead of sending what is too long for a frame."""


def framed(message: Any, limit: int, key: str = "frame_limit_bytes") -> bytes:
    """Return a message's frame; raise NotSerializable if it has none, or is longer than `limit`, the setting `key`."""
    try:
        body = _encode(message)
    except _NOT_ENCODED as error:
        raise NotSerializable(
            f"{type(message).__name__} cannot travel: {error}", path=type(message).__name__
        ) from error
    if len(body) > limit:
        raise NotSerializable(
            f"{type(message).__name__} of {len(body)} bytes is over the limit of {limit} ({key}): {ADVICE}",
            path=type(message).__name__,
            limit=limit,
            size=len(body),
        )
    return _pack_length(len(body)) + body
