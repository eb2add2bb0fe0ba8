"""The wake of a reader: a flag with a descriptor."""

from __future__ import annotations

import os

from rr_actors.streams.wake import Wake


def test_a_wake_that_is_finalized_first_does_not_write_to_a_descriptor_of_others() -> None:
    wake = Wake()
    before = set(os.listdir("/proc/self/fd"))

    wake.__del__()  # as the garbage collector does for a cycle, in any order

    (gone,) = before - set(os.listdir("/proc/self/fd"))
    read, write = os.pipe()
    try:
        assert int(gone) in (read, write)  # its number is another's now
        os.set_blocking(read, False)
        wake.set()
        assert not wake.take()
    finally:
        os.close(read)
        os.close(write)
