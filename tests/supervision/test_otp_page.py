"""The conformance page names tests that exist."""

from __future__ import annotations

import re
from pathlib import Path

TESTS = Path(__file__).resolve().parents[1]
PAGE = TESTS.parent / "docs" / "otp.md"


def test_every_test_that_the_conformance_page_names_exists() -> None:
    text = "".join(path.read_text() for path in TESTS.rglob("test_*.py"))
    there = set(re.findall(r"^(?:async )?def (test_\w+)", text, re.MULTILINE))
    named = set(re.findall(r"`(test_\w+)`", PAGE.read_text()))

    assert named - there == set()
    assert len(named) > 50


def test_every_clause_on_the_conformance_page_has_a_test_or_says_that_it_does_not_apply() -> None:
    rows = [line for line in PAGE.read_text().splitlines() if line.startswith("| ") and "| test |" not in line]
    without = [row for row in rows if "`test_" not in row and "there is none" not in row and "no such" not in row]

    assert without == []
