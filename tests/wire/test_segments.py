"""Large values in shared memory: both ends of a connection, here of one process, and ends that lie."""

from __future__ import annotations

import array
import errno
import fcntl
import gc
import os
import pickle
import resource
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from rr_actors.base import pickling
from rr_actors.base.errors import MailboxFull, Unavailable
from rr_actors.wire.segment_slots import PAGE_BYTES
from rr_actors.wire.segments import Lie, Parcel, Parcels, Segments
from support import descriptors
from support_cycles import leaves_cycle

LARGE = pickling.LARGE_BYTES


class Box:
    """Has a buffer that pickle hands out of band, as numpy's arrays do."""

    def __init__(self, data: Any) -> None:
        self.data = data

    def __reduce_ex__(self, protocol: Any) -> Any:
        return Box, (pickle.PickleBuffer(self.data),)

    @property
    def bytes(self) -> bytes:
        return bytes(self.data)


def box(size: int, seed: int = 7) -> Box:
    return Box(bytearray((index * seed + seed) % 251 for index in range(251)) * (size // 251 + 1))


class Ends:
    """Both ends of a connection."""

    def __init__(self, limit: int | None = 2**24, frame_limit: int = 2**20) -> None:
        self.segments = Segments(limit, frame_limit)
        self.here = self.segments.parcels(os.getpid())
        self.there = Segments(2**24).parcels(os.getpid())

    def pack(self, value: Any) -> bytes | Parcel:
        packed = self.here.pack(pickling.dumps_large(value, "value"))
        if isinstance(packed, Parcel):
            self.fd = packed.fd
        return packed

    def parcel(self, value: Any) -> Parcel:
        packed = self.pack(value)
        assert type(packed) is Parcel
        return packed

    def send(self, value: Any) -> Any:
        packed = self.pack(value)
        return pickling.loads(packed) if isinstance(packed, bytes) else self.there.claim(packed)()

    @property
    def resident(self) -> int:
        """The memory that the kernel counts."""
        return os.fstat(self.fd).st_blocks * 512

    def close(self) -> None:
        self.here.close()
        self.there.close()


def memfds() -> set[tuple[str, str, int]]:
    return descriptors("memfd:rr_actors")


def test_a_buffer_arrives_writable_and_is_the_receivers_own() -> None:
    ends = Ends()
    sent = box(300_000)
    before = sent.bytes
    arrived = ends.send(sent)
    sent.data[:] = bytes(len(sent.data))
    assert arrived.bytes == before
    view = memoryview(arrived.data)
    assert not view.readonly
    view[0] = 1
    assert sent.data[0] == 0
    ends.close()
    assert arrived.bytes[1:] == before[1:]  # after the connection, too


@pytest.mark.parametrize("size", [LARGE - 1, LARGE, LARGE + 1, 3 * LARGE + 17])
def test_every_kind_of_value_arrives_as_it_was_around_the_threshold(size: int) -> None:
    ends = Ends()
    data = os.urandom(size)
    values: list[Any] = [
        data,
        bytearray(data),
        "é" * size,
        array.array("B", data),
        {"a": [data, "x", (bytearray(data), list(range(size // 50)))]},
    ]
    for value in values:
        assert ends.send(value) == value
    for data_of_box in (bytearray(data), array.array("B", data), memoryview(bytearray(data))):
        assert ends.send(Box(data_of_box)).bytes == data
    assert ends.send([Box(bytearray(data)), Box(bytearray(data[::-1]))])[1].bytes == data[::-1]
    ends.close()


@pytest.mark.parametrize(("size", "kind"), [(LARGE - 1, bytes), (LARGE, Parcel)])
def test_a_buffer_of_64_kib_goes_through_a_segment_and_a_shorter_one_does_not(size: int, kind: type) -> None:
    ends = Ends()
    overhead = len(pickle.dumps(Box(bytearray()), 5))
    short = size if kind is Parcel else size - overhead - 100
    assert type(ends.pack(Box(bytearray(short)))) is kind
    ends.close()


def test_a_read_only_buffer_stays_read_only() -> None:
    ends = Ends()
    assert memoryview(ends.send(Box(bytes(LARGE))).data).readonly
    ends.close()


def test_a_slot_is_used_again_when_its_value_is_dropped_and_not_before() -> None:
    ends = Ends()
    held = ends.send(box(LARGE))
    content = held.bytes
    second = ends.parcel(box(LARGE, 11))
    third = ends.parcel(box(LARGE, 13))
    assert held.bytes == content
    place = second.start
    ends.there.claim(second)  # not opened: nobody wanted it
    gc.collect()
    assert ends.parcel(box(LARGE, 17)).start == place
    assert ends.there.claim(third)().bytes == box(LARGE, 13).bytes
    view = memoryview(held.data)[5:9]
    del held
    assert ends.parcel(box(LARGE, 19)).start > place  # a part of it is still in use
    assert bytes(view) == content[5:9]
    ends.close()


def test_thousands_of_values_take_one_descriptor_and_bounded_memory() -> None:
    gc.collect()
    before = memfds()  # a test before this one may have left some to the collector
    ends = Ends(limit=2**22)
    for number in range(3_000):
        assert ends.send(box(LARGE, number % 100 + 1)).bytes == box(LARGE, number % 100 + 1).bytes
    assert ends.resident <= 3 * LARGE
    assert len(memfds() - before) <= 3
    ends.close()


def test_free_pages_are_given_back_to_the_machine() -> None:
    ends = Ends()
    first, second = ends.send(box(2**20)), ends.send(box(2**20))
    content = second.bytes
    assert ends.resident > 2 * 2**20
    del first
    ends.segments.give_back()
    assert ends.resident < 1.1 * 2**20
    assert second.bytes == content
    del second
    assert ends.segments.give_back(PAGE_BYTES) == PAGE_BYTES  # in pieces
    ends.segments.give_back()
    assert ends.resident <= PAGE_BYTES
    assert ends.send(box(2**20)).bytes == box(2**20).bytes
    ends.close()


def test_when_the_segments_are_full_a_value_goes_in_band_or_the_error_says_who_holds_what() -> None:
    ends = Ends(limit=2**20, frame_limit=2**18)
    held = [ends.send(box(LARGE)) for _ in range(5)]
    assert type(ends.pack(box(LARGE))) is bytes
    with pytest.raises(MailboxFull, match="segments_limit_bytes") as caught:
        ends.pack(box(2**19))
    assert str(os.getpid()) in str(caught.value)
    held.clear()
    assert type(ends.pack(box(2**19))) is Parcel
    ends.close()


def test_the_limit_holds_for_all_connections_together() -> None:
    ends = Ends(limit=2**20)
    other = ends.segments.parcels(os.getpid())
    held = ends.send(box(2**19))
    assert type(other.pack(pickling.dumps_large(box(2**19 + 2**18), "value"))) is bytes
    del held
    assert type(other.pack(pickling.dumps_large(box(2**19 + 2**18), "value"))) is Parcel
    ends.close()
    other.close()


def test_without_memfd_create_values_go_in_band(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "memfd_create")
    ends = Ends()
    assert ends.send(box(2**18)).bytes == box(2**18).bytes
    assert type(ends.pack(box(2**18))) is bytes


@pytest.mark.parametrize("code", [errno.EMFILE, errno.ENOMEM, errno.ENFILE, errno.ENOSYS])
def test_when_memfd_create_fails_a_value_goes_in_band_or_the_error_names_what_is_wanting(
    monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    def fail(*_: Any) -> int:
        raise OSError(code, os.strerror(code))

    ends = Ends()
    with monkeypatch.context() as patch:
        patch.setattr(os, "memfd_create", fail)
        assert ends.send(box(2**18)).bytes == box(2**18).bytes
        if code != errno.ENOSYS:
            with pytest.raises(Unavailable, match=errno.errorcode[code]):
                ends.pack(box(2**21))
    assert type(ends.pack(box(2**18))) is Parcel  # it may be possible later
    ends.close()


def test_when_the_machine_has_no_memory_for_a_slot_the_value_goes_in_band(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> int:
        raise OSError(errno.ENOSPC, "full")

    ends = Ends()
    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", fail)
        assert type(ends.pack(box(2**18))) is bytes
    assert ends.send(box(2**18)).bytes == box(2**18).bytes
    ends.close()


def test_a_receiver_without_descriptors_gets_an_error_that_says_so() -> None:
    ends = Ends()
    parcel = ends.parcel(box(2**18))
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    lowest = os.dup(0)
    os.close(lowest)
    resource.setrlimit(resource.RLIMIT_NOFILE, (lowest, hard))
    try:
        opens = ends.there.claim(parcel)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    with pytest.raises(Unavailable, match="EMFILE"):
        opens()
    assert ends.there.claim(parcel)().bytes == box(2**18).bytes
    ends.close()


def test_a_process_whose_id_is_not_known_gets_values_in_band() -> None:
    for pid in (0, None):
        nobody = Segments().parcels(pid)
        assert type(nobody.pack(pickling.dumps_large(box(2**18), "value"))) is bytes


def test_the_error_of_full_segments_names_the_process_that_keeps_values() -> None:
    ends = Ends(limit=2**20, frame_limit=2**18)
    held = ends.send(box(640 * 1024))
    other = ends.segments.parcels(os.getppid())
    with pytest.raises(MailboxFull, match=f"bytes in use: 6[0-9]{{5}} by process {os.getpid()}$"):
        other.pack(pickling.dumps_large(box(2**19), "value"))
    del held
    ends.close()


def test_a_segment_takes_address_space_as_far_as_it_is_used() -> None:
    before = address_space()
    ends = Ends(limit=2**40)
    assert ends.send(box(2**18)).bytes == box(2**18).bytes
    assert address_space() - before < 2**28

    large = [ends.send(bytearray(40 * 2**20)) for _ in range(4)]  # more than was mapped at first
    more = [ends.send(box(2**20)) for _ in range(3)]

    assert all(value == bytes(40 * 2**20) for value in large)
    assert [value.bytes for value in more] == [box(2**20).bytes] * 3
    ends.close()


def address_space() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def test_a_limit_of_the_length_of_files_limits_segments_and_no_value_is_lost() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**22, hard))
    try:
        ends = Ends(limit=2**30, frame_limit=2**20)
        assert type(ends.pack(box(2**21))) is Parcel
        with pytest.raises(MailboxFull):
            ends.pack(box(2**23))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    ends.close()


def test_more_values_than_a_page_has_bytes_are_in_use_at_once() -> None:
    ends = Ends(limit=2**30)
    held = [ends.send(box(LARGE)) for _ in range(PAGE_BYTES + 1000)]
    assert type(ends.pack(box(LARGE))) is Parcel
    del held
    ends.close()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can change its user")
def test_a_process_that_has_changed_its_user_sends_values_through_the_connection() -> None:
    program = (
        "import os; from rr_actors.wire.segments import can_open; "
        "print(can_open(os.getpid())); os.setgid(65534); os.setuid(65534); print(can_open(os.getpid()))"
    )
    shown = subprocess.run([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True, check=True).stdout
    assert shown.split() == ["True", "False"]


def test_the_default_limit_is_a_quarter_of_what_the_process_may_have(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rr_actors.wire.segments.memory_bytes", lambda: 400 * 2**20)
    assert Segments().limit_bytes == 100 * 2**20


# -- fork --------------------------------------------------------------------------------------------------------------


def in_fork(run: Callable[[], object]) -> Callable[[], str]:
    """Run a function in a child of fork; return a function that waits for what it returned, as text."""
    read, write = os.pipe()
    pid = os.fork()
    if not pid:
        try:
            os.write(write, repr(run()).encode())
        finally:
            os._exit(0)
    os.close(write)

    def result() -> str:
        with os.fdopen(read) as pipe:
            shown = pipe.read()
        os.waitpid(pid, 0)
        return shown

    return result


def test_a_child_of_fork_has_values_of_its_own() -> None:
    ends = Ends()
    held = [ends.send(box(LARGE))]
    content = held[0].bytes
    go_on, told = os.pipe()

    def look() -> tuple[bool, bool]:
        os.read(go_on, 1)
        unchanged = held[0].bytes == content
        held[0].data[:] = bytes(len(content))
        return unchanged, held[0].bytes == bytes(len(content))

    shown = in_fork(look)
    held.clear()
    for seed in range(30):  # in the same memory
        assert ends.send(box(LARGE, seed)).bytes == box(LARGE, seed).bytes
    kept = ends.send(box(LARGE, 99))
    os.write(told, b"0")
    assert shown() == "(True, True)"
    assert kept.bytes == box(LARGE, 99).bytes
    for fd in (go_on, told):
        os.close(fd)
    ends.close()


def test_a_child_of_fork_frees_nothing_of_its_parent() -> None:
    ends = Ends()
    held = [ends.send(box(LARGE))]
    content = held[0].bytes
    assert in_fork(lambda: (held.clear(), gc.collect()))()
    for seed in range(5):
        ends.send(box(LARGE, seed))
    assert held[0].bytes == content
    ends.close()


def test_what_is_dropped_while_a_process_forks_is_freed_afterwards() -> None:
    ends = Ends(limit=2**20)
    stop = threading.Event()

    def drop() -> None:
        while not stop.is_set():
            assert ends.send(box(2**18)).bytes[:5] == box(2**18).bytes[:5]

    dropping = threading.Thread(target=drop)
    dropping.start()
    for _ in range(20):
        in_fork(lambda: 0)()
    stop.set()
    dropping.join()
    gc.collect()
    assert [type(ends.pack(box(2**18))) for _ in range(3)] == [Parcel] * 3
    ends.close()


# -- ends that lie -----------------------------------------------------------------------------------------------------


def lies(true: Parcel) -> list[Parcel]:
    size = true.segment_bytes
    changed = msgspec.structs.replace
    return [
        changed(true, key=true.key ^ 1),
        changed(true, segment_bytes=size - PAGE_BYTES),
        changed(true, segment_bytes=2**62),
        changed(true, start=0),
        changed(true, start=-PAGE_BYTES),
        changed(true, start=size - 64),
        changed(true, start=2**62),
        changed(true, lengths=()),
        changed(true, lengths=(-1,)),
        changed(true, lengths=(size,)),
        changed(true, lengths=(2**63 - 1, 2**63 - 1)),
        changed(true, lengths=(true.lengths[0], -5, *true.lengths[1:])),
        changed(true, slot=0),
        changed(true, slot=-1),
        changed(true, slot=PAGE_BYTES),
        changed(true, slot=true.slot + 1),
    ]


@pytest.mark.parametrize("number", range(16))
@pytest.mark.parametrize("mapped", [False, True])
def test_a_parcel_that_cannot_be_true_is_a_lie(number: int, mapped: bool) -> None:
    ends = Ends()
    if mapped:
        ends.send(box(2**18))
    parcel = ends.parcel(box(2**18))
    with pytest.raises(Lie):
        ends.there.claim(lies(parcel)[number])
    ends.close()


def test_what_is_no_sealed_segment_is_not_mapped(tmp_path: Path) -> None:
    ends = Ends()
    true = ends.parcel(box(2**18))
    file = tmp_path / "file"
    file.write_bytes(bytes(true.segment_bytes))
    read, write = os.pipe()
    unsealed = os.memfd_create("rr_actors_unsealed", os.MFD_ALLOW_SEALING)
    os.ftruncate(unsealed, true.segment_bytes)
    with file.open("r+b") as opened:
        for fd in (opened.fileno(), read, unsealed):
            with pytest.raises(Lie):
                ends.there.claim(msgspec.structs.replace(true, fd=fd))
    for fd in (read, write, unsealed):
        os.close(fd)
    ends.close()


def test_a_segment_cannot_be_made_shorter() -> None:
    ends = Ends()
    ends.parcel(box(2**18))
    assert fcntl.fcntl(ends.fd, fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK
    with pytest.raises(PermissionError):
        os.ftruncate(ends.fd, PAGE_BYTES)
    ends.close()


def test_nothing_is_left_when_both_ends_are_closed_and_the_values_dropped() -> None:
    gc.collect()
    before = memfds()
    ends = Ends()
    values = [ends.send(box(2**18)) for _ in range(5)]
    assert memfds() - before
    ends.close()
    del values
    gc.collect()
    assert not memfds() - before
    closed: Parcels = ends.here
    assert type(closed.pack(pickling.dumps_large(box(2**18), "value"))) is bytes


def test_a_value_that_goes_through_the_connection_leaves_nothing_to_the_collector() -> None:
    ends = Ends(limit=0)
    assert not leaves_cycle(lambda: ends.send(box(2**18)))
