"""docs/life-of-a-load.md follows the files that a load, a status and a restore really pass."""

from __future__ import annotations

import re

import pytest
from package_figures import passed

from support import REPOSITORY

PAGE = REPOSITORY / "docs" / "life-of-a-load.md"


def section(title: str) -> str:
    """The text of the page below a heading, up to the next heading."""
    return PAGE.read_text().partition(f"\n## {title}\n")[2].partition("\n## ")[0]


def named(text: str) -> list[str]:
    """The files of the package that a text names."""
    return re.findall(r"`(rr_actors/[\w/]+\.py)`", text)


@pytest.mark.parametrize(("trip", "title"), [("load", "The files of a load"), ("status", "The life of a status")])
def test_the_page_names_each_file_of_a_load_and_of_a_status_and_no_other(trip: str, title: str) -> None:
    assert sorted(set(named(section(title)))) == sorted(passed(trip))


def test_a_restore_passes_each_file_that_the_page_names() -> None:
    """It takes most of a second, so files of other work come in between: the page leaves those out."""
    assert set(named(section("The life of a restore"))) - passed("restore") == set()


def test_a_load_passes_the_file_of_each_step() -> None:
    steps = re.findall(r"^\d+\. `(rr_actors/[\w/]+\.py)`", PAGE.read_text(), re.MULTILINE)
    assert len(steps) >= 15
    assert set(steps) - passed("load") == set()
