"""The last log lines of children, which the system keeps for people."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rr_actors.hosting import forwarded_logs
from rr_actors.hosting.forwarded_logs import BYTES_LIMIT, LINES_LIMIT, KeptLogs, LogLine

TEXTS = st.builds(lambda text, times: text * times, st.text(min_size=1, max_size=3), st.integers(0, 40_000))


def record(path: str, text: str, pid: int = 1, **facts: Any) -> dict[str, Any]:
    """A record as the process of a child sends it."""
    known = {"msg": text, "exc_text": None, "stack_info": None, "levelname": "INFO", "name": "n", "created": 1.0}
    return known | {"processName": path, "process": pid} | facts


def size_of(lines: list[LogLine]) -> int:
    return sum(len(msgspec.msgpack.encode(line)) for line in lines)


@settings(max_examples=30)
@given(st.lists(st.tuples(st.sampled_from(["root/a", "root/b"]), TEXTS, st.integers(1, 300)), max_size=8))
def test_the_newest_lines_of_each_child_are_kept_within_the_limits(bursts: list[tuple[str, str, int]]) -> None:
    kept = KeptLogs()
    said: dict[str, list[str]] = {"root/a": [], "root/b": []}
    for path, text, times in bursts:
        for _ in range(times):
            kept.take(record(path, text))
            said[path].append(text)

    for path, texts in said.items():
        lines = kept.lines(path)
        assert len(lines) <= LINES_LIMIT
        assert size_of(lines) <= BYTES_LIMIT
        assert bool(lines) == bool(texts)
        newest = texts[len(texts) - len(lines) :]
        assert all(said == line.text or "characters)" in line.text for said, line in zip(newest, lines, strict=True))
        assert [line.seq for line in lines] == sorted({line.seq for line in lines})
        after = lines[len(lines) // 2].seq if lines else 0
        assert kept.lines(path, after) == [line for line in lines if line.seq > after]


def test_a_line_has_the_message_its_traceback_and_its_process() -> None:
    kept = KeptLogs()
    kept.take(record("root/a", "it failed", 7, exc_text="Traceback:\n  boom", levelname="ERROR", name="x" * 1000))
    (line,) = kept.lines("root/a")
    assert (line.pid, line.level, line.text, line.logger) == (7, "ERROR", "it failed\nTraceback:\n  boom", "x" * 200)


@pytest.fixture
def little_room(monkeypatch: pytest.MonkeyPatch) -> None:
    """Room for the lines of three children or so."""
    monkeypatch.setattr(forwarded_logs, "ALL_BYTES_LIMIT", 3 * BYTES_LIMIT)


@pytest.mark.usefixtures("little_room")
def test_of_many_children_those_that_have_been_silent_for_longest_lose_their_lines() -> None:
    kept = KeptLogs()
    for number in range(10):
        for _ in range(20):
            kept.take(record(f"root/{number}", "x" * 30_000))
            kept.take(record("root/busy", "still here"))
    paths = kept.paths()
    assert paths[-2:] == ["root/9", "root/busy"]
    assert "root/0" not in paths
    assert sum(size_of(kept.lines(path)) for path in paths) <= 3 * BYTES_LIMIT
