"""Each script in tests/registrar/protocol is what happens, step by step (tests/support_protocol.py)."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from support_protocol import STEPS, run

SCRIPTS = sorted((Path(__file__).parent / "protocol").glob("*.txt"))


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_what_follows_from_each_step(path: Path) -> None:
    assert run(path.read_text()) == path.read_text()


def test_each_step_is_in_a_script() -> None:
    steps = [line[2:] for path in SCRIPTS for line in path.read_text().splitlines() if line.startswith("> ")]
    assert [pattern for pattern in STEPS if not any(re.fullmatch(pattern, step) for step in steps)] == []


def test_what_is_no_step_is_refused() -> None:
    with pytest.raises(ValueError, match="not a step: 'app sings'"):
        run("A song.\n\n> app sings\n")
