"""The tour guide, an example: each program runs while its use case needs it, and is paused or ended meanwhile."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from support import REPOSITORY, run_example
from support_programs import running_programs


@pytest.mark.slow
def test_on_demand_a_program_runs_only_in_the_steps_that_need_it(tmp_path: Path) -> None:
    said = run_example(tmp_path, REPOSITORY / "examples" / "tour_guide.py", limit_s=150)
    all_on, on_demand, answer, *picture = said.splitlines()
    assert re.fullmatch(r"all on +\d+% of one CPU +\d+ MiB", all_on)
    assert re.fullmatch(r"on demand +\d+% of one CPU +\d+ MiB", on_demand)
    assert re.fullmatch(r"a paused program answers after \d+\.\d ms", answer)
    rows = {line[:12].strip(): line[12:] for line in picture}
    assert len(rows) == 12
    for name, times in (("path", 3), ("camera", 1), ("voice", 2), ("words", 1)):
        assert len(re.findall("█+", rows[name])) == times, said
    assert not running_programs()
