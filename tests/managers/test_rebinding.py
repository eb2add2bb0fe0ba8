"""Rebinding, an example: one loop reads from a camera, from a lidar after its end, and from the camera again."""

from __future__ import annotations

import re
from pathlib import Path

from support import REPOSITORY, run_example


def test_one_loop_reads_from_whatever_gives_ranges(tmp_path: Path) -> None:
    said = run_example(tmp_path, REPOSITORY / "examples" / "rebinding.py", limit_s=60)
    *table, camera, lidar = said.splitlines()
    rows = [re.fullmatch(r" *\d+\.\d s  (camera|lidar) +after +\d+ ms", line) for line in table]
    assert [row and row[1] for row in rows] == ["camera", "lidar", "camera"], said
    assert re.fullmatch(r"camera  █[█ ]* +[█ ]*█", camera)
    assert re.fullmatch(r"lidar    +█[█ ]*", lidar)
