"""Files of checked records: a record that is read was written whole, and behind the one that is read before it.

A record's checksum goes on from that of the record before it, the first one's from the file's header.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

_RECORD = struct.Struct("<II")  # length of what follows, checksum


class Place(NamedTuple):
    """Where a file ends, or a record in it: the byte after it, its checksum."""

    at: int
    checksum: int


def record(body: bytes, before: int) -> tuple[bytes, int]:
    """Return a record as it is written, and its checksum. `before`: that of the one before it."""
    checksum = zlib.crc32(body, before)
    return _RECORD.pack(len(body), checksum) + body, checksum


def records(data: bytes, begin: Place) -> Iterator[tuple[bytes, Place]]:
    """Yield the whole records behind `begin`, and where each ends, up to the first that is not as it was written."""
    at, checksum = begin
    while at + _RECORD.size <= len(data):
        length, expected = _RECORD.unpack_from(data, at)
        start = at + _RECORD.size
        body = data[start : start + length]
        if not length or len(body) < length or zlib.crc32(body, checksum) != expected:
            return  # never finished, and so never acknowledged
        at, checksum = start + length, expected
        yield body, Place(at, checksum)


def is_more_than_torn(data: bytes, at: int) -> bool:
    """Whether there is more behind the last good record than the beginning of one, or zeros."""
    if len(data) - at < _RECORD.size:
        return False
    length: int = _RECORD.unpack_from(data, at)[0]
    return at + _RECORD.size + length <= len(data) and any(data[at:])


def append(fd: int, body: bytes, begin: int, before: int) -> tuple[int, int]:
    """Write a record at the end of a file, as write_whole; return where the file ends then, and its checksum.

    In one, as each commit does it. `before`: the checksum of the record before it.

    Raises:
        OSError: it could not be written.
    """
    checksum = zlib.crc32(body, before)
    data = _RECORD.pack(len(body), checksum) + body
    end = begin + len(data)
    try:
        whole = begin + os.pwrite(fd, data, begin) == end
    except BaseException:
        _cut_off(fd, begin)
        raise
    if not whole:  # the disk was full there
        write_whole(fd, data, begin)
    return end, checksum


def write_whole(fd: int, data: bytes, begin: int) -> int:
    """Write all of it at the end of a file, which is at `begin`, or nothing; return where the file ends then.

    What a failed attempt leaves is cut off, or else written over or ignored.

    Raises:
        OSError: it could not be written.
    """
    end = begin + len(data)
    try:
        at = begin + os.pwrite(fd, data, begin)
        while at < end:  # the disk was full there
            at += os.pwrite(fd, data[at - end :], at)
    except BaseException:
        _cut_off(fd, begin)
        raise
    return end


def _cut_off(fd: int, end: int) -> None:
    with contextlib.suppress(OSError):
        os.ftruncate(fd, end)
