"""Ids: UUIDv7, increasing in a thread also when the clock is set back, and not repeated by a forked child."""

from __future__ import annotations

import os
import time
import uuid

import pytest

from rr_actors.base.names import new_id, planned_id, time_in


def test_ids_are_uuid7_of_the_present_time() -> None:
    before_ms = time.time_ns() // 1_000_000
    id = uuid.UUID(new_id())
    assert (id.version, id.variant) == (7, uuid.RFC_4122)
    assert before_ms <= id.int >> 80 <= time.time_ns() // 1_000_000


def test_ids_increase_though_the_clock_is_set_back(monkeypatch: pytest.MonkeyPatch) -> None:
    ids = [new_id() for _ in range(10_000)]
    with monkeypatch.context() as clock:
        clock.setattr(time, "time_ns", lambda: 1_000_000)
        ids += [new_id(), new_id()]
    assert ids == sorted(set(ids))


def test_a_forked_child_repeats_no_id() -> None:
    before = int(new_id(), 16) % 2**80
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.write(writer, new_id().encode())
        os._exit(0)
    os.waitpid(child, 0)
    os.close(writer)
    with os.fdopen(reader) as answer:
        theirs = int(answer.read(), 16) % 2**80
    assert abs(theirs - before) > 1000


def test_an_id_has_the_time_at_which_it_was_made() -> None:
    for id in (new_id(), planned_id()):
        at = time_in(id)
        assert at is not None
        assert abs(time.time() - at) < 60


@pytest.mark.parametrize("id", ["", "mine", "f81d4fae7dec41d0a76500a0c91e6bf6", "0" * 12 + "7" + "0" * 19, "7" * 33])
def test_an_id_of_another_kind_has_no_time(id: str) -> None:
    assert time_in(id) is None
