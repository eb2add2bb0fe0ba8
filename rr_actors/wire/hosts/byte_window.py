"""The numbers of a link between hosts: packets that count bytes, and how many bytes may be in flight.

No I/O, and no knowledge of the network below. A network that breaks may lose packets without an error. So each packet
carries the number of bytes that were sent before it: the receiver finds a gap, or a packet that came twice.
"""

from __future__ import annotations

import struct

from rr_actors.base.errors import Unavailable
from rr_actors.wire.frames import GOODBYE

DATA = 0
"""The kind of a packet with a part of the stream; its number is how many bytes were sent before it."""
ACKNOWLEDGED = 1
"""The kind of a packet that says how many bytes have arrived."""
BROKEN = 2
"""The kind of a packet that ends the link at once; its rest is the reason, in UTF-8."""

PACKET_BYTES = 256 * 1024
"""The most bytes of the stream in one packet."""
WINDOW_BYTES = 4 * 1024 * 1024
"""The most bytes that may be sent and not acknowledged."""

_HEAD = struct.Struct(">BQ")


def packet(kind: int, number: int, rest: bytes = b"") -> bytes:
    """Return the bytes of a packet."""
    return _HEAD.pack(kind, number) + rest


def read_packet(data: bytes) -> tuple[int, int, bytes]:
    """Return a packet's kind, number and rest; raise Unavailable if the bytes are no packet."""
    if len(data) < _HEAD.size:
        raise Unavailable(f"a packet of {len(data)} bytes: expected {_HEAD.size} at least")
    kind, number = _HEAD.unpack_from(data)
    if kind not in (DATA, ACKNOWLEDGED, BROKEN):
        raise Unavailable(f"a packet of kind {kind}: expected {DATA}, {ACKNOWLEDGED} or {BROKEN}")
    if len(data) > _HEAD.size + PACKET_BYTES:
        raise Unavailable(f"a packet of {len(data)} bytes: expected {_HEAD.size + PACKET_BYTES} at most")
    return kind, number, data[_HEAD.size :]


def is_stray(data: bytes) -> bool:
    """Return whether a packet that came for no open link shows that the other side believes in that link."""
    return len(data) > _HEAD.size and data[0] == DATA and data[_HEAD.size :] != GOODBYE


class SendWindow:
    """The sending half of a link: what waits, and what is in flight.

    Attributes:
        sent: how many bytes have been handed to the network.
        acknowledged: how many of them the other side has.
    """

    def __init__(self) -> None:
        self.sent = 0
        self.acknowledged = 0
        self._waiting = bytearray()

    @property
    def waiting(self) -> int:
        """The number of bytes that wait for room in the window."""
        return len(self._waiting)

    @property
    def empty(self) -> bool:
        """Whether the other side has acknowledged everything."""
        return not self._waiting and self.sent == self.acknowledged

    def add(self, data: bytes | bytearray) -> None:
        """Put bytes at the end of those that wait."""
        self._waiting += data

    def take(self) -> list[bytes]:
        """Return the packets that may be sent now."""
        packets: list[bytes] = []
        start = 0
        room = WINDOW_BYTES - (self.sent - self.acknowledged)
        while start < len(self._waiting) and room > 0:
            part = bytes(self._waiting[start : start + min(PACKET_BYTES, room)])
            packets.append(packet(DATA, self.sent, part))
            self.sent += len(part)
            start += len(part)
            room -= len(part)
        del self._waiting[:start]
        return packets

    def acknowledge(self, number: int) -> None:
        """Note that `number` bytes have arrived; raise Unavailable if they were not sent, or are fewer than before."""
        if not self.acknowledged <= number <= self.sent:
            raise Unavailable(
                f"the other side acknowledges {number} bytes: expected {self.acknowledged} to {self.sent}"
            )
        self.acknowledged = number


class ReceivedBytes:
    """The receiving half of a link.

    Attributes:
        total: how many bytes have arrived, without a gap.
    """

    def __init__(self) -> None:
        self.total = 0

    def take(self, number: int, data: bytes) -> None:
        """Count a packet's bytes; raise Unavailable if one is missing before it, or if it came twice."""
        if number != self.total:
            raise Unavailable(f"a gap in the link: expected byte {self.total}, got byte {number}")
        self.total += len(data)
