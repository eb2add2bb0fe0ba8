"""The pages can be read by a student who is not a native speaker: short sentences, and no private words."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from support import REPOSITORY

LIMIT = 30  # words; 25 is the rule
PAGES = [REPOSITORY / "README.md", REPOSITORY / "CHANGELOG.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
PRIVATE = re.compile(
    r"\b(whoever|let go|lets go|letting go|is told|are told|taken up|takes up|under way)\b", re.IGNORECASE
)

FENCED = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\([^)]*\)")
ITEM = re.compile(r"^\s*(?:[-*]|\d+\.)\s", re.MULTILINE)
END = re.compile(r"(?<=[.!?:;])\s+")


def sentences(text: str) -> list[str]:
    """The sentences of a page, its code, tables and headings left out."""
    prose = LINK.sub("]", FENCED.sub("", text))
    lines = [line if not line.startswith(("|", "#", "<!--")) else "" for line in prose.splitlines()]
    blocks = re.split(r"\n\s*\n", "\n".join(lines))
    return [sentence for block in blocks for item in ITEM.split(block) for sentence in END.split(item.strip())]


def words(sentence: str) -> int:
    return sum(1 for word in sentence.split() if re.search(r"\w", word.replace("[test]", "")))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_sentence_is_short(page: Path) -> None:
    text = page.read_text()
    assert [sentence for sentence in sentences(text) if words(sentence) > LIMIT] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_page_uses_standard_words(page: Path) -> None:
    text = page.read_text()
    assert PRIVATE.findall(re.sub(r"`[^`]*`", "", FENCED.sub("", text))) == []


def test_a_long_sentence_would_be_found() -> None:
    text = "# A page\n\n- Short.\n- " + "word " * 31 + "end.\n\n| " + "cell " * 40 + "|\n"

    assert [words(sentence) for sentence in sentences(text) if words(sentence) > LIMIT] == [32]
