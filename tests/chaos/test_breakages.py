"""The product broken on purpose: chaos notices each breakage within a minute, and nothing where there is none.

The slow tests try two of them, others each day but where a change is judged; `make breakages` tries all.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path
from typing import Any

import pytest

from chaos.breakages import BREAKAGES
from rr_actors.managers.process_marks import find_processes
from support import REPOSITORY

LIMIT_S = 60.0
SEEDS = (1, 2, 3)
_EACH_DAY = 2
_RUN = "RR_ACTORS_TEST_BREAKAGE_RUN"


def _of_today() -> list[str]:
    """Return those to try: with RR_ACTORS_BREAKAGES=all all, else the next ones of the table each day."""
    names = [*BREAKAGES]
    if os.environ.get("RR_ACTORS_BREAKAGES") == "all":
        return names
    day = 0 if "CI" in os.environ else int(time.time() // 86_400)  # a change is judged by the same ones each time
    first = day * _EACH_DAY
    return [names[(first + number) % len(names)] for number in range(_EACH_DAY)]


def _run(name: str, seed: int, directory: Path, limit_s: float) -> dict[str, Any] | None:
    """Return the report of one run; None if it has not ended in time."""
    report = directory / f"{seed}.json"
    state = directory / str(seed)
    command = [sys.executable, "-m", "chaos.breakages", name, str(seed), str(state), str(report)]
    mark = uuid.uuid4().hex
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), _RUN: mark}
    try:
        subprocess.run(  # no pipes: what a breakage lets live would hold them
            command,
            cwd=REPOSITORY / "tests",
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=limit_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return None
    finally:
        for pid in find_processes(_RUN, mark):  # what a breakage lets live
            os.kill(pid, signal.SIGKILL)
        shutil.rmtree(state, ignore_errors=True)  # with its sockets: a run that failed leaves it to be looked into
    return json.loads(report.read_text())


def test_what_each_of_them_breaks_is_there() -> None:
    program = "from chaos.breakages import BREAKAGES\nfor breakage in BREAKAGES.values():\n    breakage.apply()"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    subprocess.run([sys.executable, "-c", program], cwd=REPOSITORY / "tests", env=environment, check=True)


@pytest.mark.slow
@pytest.mark.timeout(180)
@pytest.mark.parametrize("name", _of_today())
def test_chaos_notices_it_within_a_minute(name: str, tmp_path: Path) -> None:
    until = time.monotonic() + LIMIT_S
    for seed in SEEDS:
        report = _run(name, seed, tmp_path, 2 * LIMIT_S)
        assert report is not None, "chaos itself has not ended"
        if not report["passed"]:
            said = "\n".join(report["violations"])
            assert any(words in said for words in BREAKAGES[name].caught_by), said
            return
        if time.monotonic() > until:
            break
    pytest.fail(f"{name}: not noticed")


@pytest.mark.slow
@pytest.mark.timeout(120)
def test_chaos_with_as_little_patience_finds_nothing_where_nothing_is_broken(tmp_path: Path) -> None:
    report = _run("", 1, tmp_path, LIMIT_S)
    assert report is not None
    assert report["violations"] == []
    assert report["passed"]


def test_there_are_twenty_breakages_of_every_part() -> None:
    parts = {breakage.where for breakage in BREAKAGES.values()}
    assert len(BREAKAGES) >= 20
    assert parts >= {
        "journal",
        "commit order",
        "recovery",
        "sweep",
        "fencing",
        "supervision",
        "actions",
        "choices",
        "keeper",
    }
