"""The tour guide, an example: each program runs while its use case needs it, and is paused or ended meanwhile."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from support import REPOSITORY
from support_programs import running_programs


def test_on_demand_a_program_runs_only_in_the_steps_that_need_it(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(REPOSITORY / "examples" / "tour_guide.py")],
        env=dict(os.environ, PYTHONPATH=str(REPOSITORY)),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=150,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    all_on, on_demand, answer, *picture = done.stdout.splitlines()
    assert re.fullmatch(r"all on +\d+% of one CPU +\d+ MiB", all_on)
    assert re.fullmatch(r"on demand +\d+% of one CPU +\d+ MiB", on_demand)
    assert re.fullmatch(r"a paused program answers after \d+\.\d ms", answer)
    rows = {line[:12].strip(): line[12:] for line in picture}
    assert len(rows) == 12
    for name, times in (("path", 3), ("camera", 1), ("voice", 2), ("words", 1)):
        assert len(re.findall("█+", rows[name])) == times, done.stdout
    assert not running_programs()
