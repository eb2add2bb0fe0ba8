"""`rr-actors simulate TREE.toml` says what a tree does while children die, and starts nothing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from support_cli import run_cli

TREE = """
id = "robot"
max_restarts = 3

[[children]]
actor = "robot_parts:Lidar"
id = "lidar"

[[children]]
actor = "robot_parts:Maps"
id = "maps"
"""
PARTS = """
import rr_actors as rr

class Lidar(rr.Manager):
    def __init__(self):
        raise RuntimeError("made")

class Maps(rr.Manager):
    pass
"""


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    (tmp_path / "robot_parts.py").write_text(PARTS)
    file = tmp_path / "robot.toml"
    file.write_text(TREE)
    return file


def test_it_prints_a_row_for_each_child(tree: Path) -> None:
    ran = run_cli("simulate", tree, "--life", "lidar=5m", "--start", "robot/lidar=2s", "--until", "2h")

    lines = ran.stdout.splitlines()
    assert ran.returncode == 0, ran.stderr
    assert lines[0].split() == ["child", "available", "deaths", "restarts", "longest", "outage"]
    lidar, maps = lines[1].split(), lines[2].split()
    assert lidar[0] == "robot/lidar"
    assert 98.5 < float(lidar[1].rstrip("%")) < 99.7
    assert lidar[4] == "2.00"
    assert maps[2:4] == ["0", "0"]


def test_it_compares_settings_and_prints_rows_for_programs(tree: Path) -> None:
    ran = run_cli("simulate", tree, "--life", "lidar=30s", "--vary", "max_restarts=0,9", "--runs", "3", "--json")

    rows = [json.loads(line) for line in ran.stdout.splitlines()]
    assert [row["max_restarts"] for row in rows] == [0, 9]
    assert [row["ended"] for row in rows] == [1.0, 0.0]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--life", "lidar"], "--life: expected NAME=VALUE, got 'lidar'"),
        (["--life", "lidar=-3"], "--life lidar: expected a time (90s, 10m, 2h), got '-3'"),
        (["--life", "lidar=nan"], "--life lidar: expected a time (90s, 10m, 2h), got 'nan'"),
        (["--life", "lidra=3s"], "'lidra': there is no child of this path or id; did you mean 'lidar'?"),
        (["--until", "0"], "until_s: expected a number greater than 0"),
        (["--vary", "max_restart=1"], "vary['max_restart']: expected one of strategy, max_restarts"),
        (["--vary", "strategy=none"], "vary['strategy']: expected one of 'one_for_one'"),
    ],
)
def test_a_wrong_option_is_named(tree: Path, arguments: list[str], text: str) -> None:
    ran = run_cli("simulate", tree, *arguments)

    assert ran.returncode != 0
    assert text in ran.stderr
