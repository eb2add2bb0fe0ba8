"""What docs/recipes.md shows: each program says what it should, beside one without this package, as long as it says."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from support import REPOSITORY

RECIPES = REPOSITORY / "examples" / "recipes"
EXPECTED = {
    "serial_lab.py": ["multimeter 7: 1.25 V", "after kill -9: 1.25 V, OK", "one line for both: True"],
    "pipeline.py": ["UPDATE with a spare"],
    "classroom.py": [
        "right: 30",
        "robots: 1",
        "student7 crashes each time",
        "the next try of student7: 4950",
        "as before: 30",
    ],
    "without/serial_lines.py": ["multimeter 7: 1.25 V", "after kill -9: "],
    "without/three_programs.py": ["with a spare"],
    "without/class_pool.py": ["right: 30", "student7 crashes", "and nobody can go on: the pool is broken"],
}


@pytest.mark.parametrize("name", sorted(EXPECTED))
def test_the_recipe_runs_and_says_what_it_shows(name: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, RECIPES / name],
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=50,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == len(EXPECTED[name])
    assert [line for line, start in zip(lines, EXPECTED[name], strict=True) if not line.startswith(start)] == []
    assert list(tmp_path.iterdir()) == []


def test_every_recipe_is_run() -> None:
    assert {str(path.relative_to(RECIPES)) for path in RECIPES.rglob("*.py")} == set(EXPECTED)


def test_the_page_says_how_long_each_program_is() -> None:
    page = (REPOSITORY / "docs" / "recipes.md").read_text()
    said = dict(re.findall(r"`(examples/[\w/]+\.py)`, (\d+) lines", page))
    assert {f"examples/recipes/{name}" for name in EXPECTED} < set(said)
    assert {
        name: len([line for line in (REPOSITORY / name).read_text().splitlines() if line.strip()]) for name in said
    } == {name: int(count) for name, count in said.items()}
