"""The log of `rr-actors run`: lines for people, JSON for machines."""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Iterator

import pytest

from rr_actors.tools.log_lines import JsonLines, Lines, begin_logging


def record(message: str, *args: object, level: int = logging.WARNING, **more: object) -> logging.LogRecord:
    made = logging.LogRecord("rr_actors.supervision", level, "x.py", 1, message, args, None)
    made.__dict__.update(more)
    return made


def test_a_line_has_time_level_place_and_message_in_columns() -> None:
    lines = Lines(colour=False)
    one = lines.format(record("exited %s", "root/cameras"))
    other = lines.format(record("opened", level=logging.INFO, processName="root/cameras"))

    assert one[12:] == " WARNING  supervision      exited root/cameras"
    assert other[12:] == " INFO     root/cameras     opened"
    assert one.index("exited") == other.index("opened")


def test_a_terminal_shows_the_level_in_colour_and_obeys_no_message() -> None:
    line = Lines(colour=True).format(record("a\x1b[2Jb\nc"))

    assert "\x1b[33mWARNING \x1b[0m" in line
    assert line.endswith("a\\x1b[2Jb\\nc")


def test_a_traceback_follows_its_line_indented() -> None:
    lines = Lines(colour=False).format(record("failed", exc_text="Traceback\nValueError: no")).splitlines()

    assert lines[1:] == ["    Traceback", "    ValueError: no"]


def test_json_is_one_object_a_line_with_the_facts_of_the_tree() -> None:
    line = JsonLines().format(record("a\nb", supervision={"event": "exited", "pid": 7}, processName="root/cameras"))
    facts = json.loads(line)

    assert "\n" not in line
    assert facts["message"] == "a\nb"
    assert facts["process"] == "root/cameras"
    assert facts["level"] == "warning"
    assert facts["supervision"] == {"event": "exited", "pid": 7}


@pytest.fixture
def root() -> Iterator[logging.Logger]:
    """The root logger, as it was after the test."""
    logger = logging.getLogger()
    handlers, level = logger.handlers[:], logger.level
    yield logger
    logger.handlers[:] = handlers
    logger.setLevel(level)


def test_what_is_below_the_level_is_not_written_and_a_file_has_no_colour(root: logging.Logger) -> None:
    out = io.StringIO()
    root.handlers.clear()  # those that pytest has added for this test
    begin_logging("warning", as_json=False, stream=out)
    root.info("quiet")
    root.warning("loud")

    assert "quiet" not in out.getvalue()
    assert "loud" in out.getvalue()
    assert "\x1b" not in out.getvalue()
