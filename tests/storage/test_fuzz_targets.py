"""The targets of `make fuzz`, without atheris: good inputs pass, worse ones too, and what is wrong comes out."""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from fuzz import target
from fuzz.__main__ import Result, again, judged, take
from fuzz.packed import changed
from fuzz.targets import TARGETS
from rr_actors.wire.frames import FrameReader


@pytest.mark.parametrize("name", TARGETS)
def test_a_target_takes_its_seeds_and_what_is_made_of_them(name: str, tmp_path: Path) -> None:
    one, chance = TARGETS[name], random.Random(4)
    feed = one.prepare(tmp_path)
    mutate = one.mutate or _a_byte_changed
    end = time.monotonic() + 0.3
    try:
        feed(b"")  # with which libFuzzer begins
        for seed in one.seeds():
            feed(seed)
            assert len(seed) <= one.longest
            worse = seed
            while time.monotonic() < end and len(worse) <= one.longest and chance.random() < 0.9:
                worse = mutate(worse, chance)
                feed(worse)
    finally:
        one.end(feed)


def _a_byte_changed(data: bytes, chance: random.Random) -> bytes:
    at = chance.randrange(len(data) + 1)
    return data[:at] + bytes([chance.randrange(256)]) + data[at + 1 :]


def test_a_broken_promise_comes_out(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / "input"
    file.write_bytes(TARGETS["frames"].seeds()[-1])
    again("frames", file)
    feed: Callable[[FrameReader[object], bytes], list[object]] = FrameReader.feed
    monkeypatch.setattr(FrameReader, "feed", lambda reader, data: feed(reader, data)[:1])
    with pytest.raises(AssertionError):
        again("frames", file)


def test_a_stream_is_cut_in_pieces_and_none_is_lost() -> None:
    for seed in range(20):
        assert b"".join(target.pieces(bytes(range(256)) * 4, seed)) == bytes(range(256)) * 4
    assert list(target.pieces(b"", 0)) == []


def test_a_changed_value_is_still_messagepack_and_what_is_none_stays() -> None:
    chance = random.Random(1)
    assert {changed(b"\x92\x01\xa1a", chance) for _ in range(200)} > {b"\x92\x01\xa1a", b"\x91\x01"}
    assert changed(b"\xc1", chance) == b"\xc1"


def test_what_libfuzzer_says_is_counted() -> None:
    result = Result()
    for line in (
        "INFO: Using built-in libfuzzer",
        "#32\tINITED cov: 40 ft: 96 corp: 9/1kb exec/s: 0 rss: 60Mb",
        "#4096\tpulse  cov: 45 ft: 99 corp: 9/1kb lim: 98 exec/s: 2048 rss: 63Mb",
        "#5000\tDONE   cov: 47 ft: 99 corp: 9/1kb lim: 98 exec/s: 2048 rss: 62Mb",
    ):
        take(line, result)
    assert result == Result(inputs=5000, mb_before=60, mb=63, cover_before=40, cover=47)
    assert judged(result, 0, "log").failing == ""
    take("artifact_prefix='x-'; Test unit written to x-crash-1", result)
    assert judged(result, 77, "log").failing == "x-crash-1"


@pytest.mark.parametrize(
    ("result", "code"), [(Result(), 1), (Result(inputs=9, mb_before=60, mb=200), 0), (Result(), 0)],
    ids=["it ended", "it grew", "it did nothing"],
)  # fmt: skip
def test_without_a_failing_input_the_log_is_named(result: Result, code: int) -> None:
    assert judged(result, code, "log").failing == "log"
