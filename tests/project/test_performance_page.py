"""docs/performance.md: its table is made of the results of the benchmarks."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from benchmarks.page import BEGIN, END, PAGE, Results, markdown, put
from benchmarks.table import Row, write

ROWS = [
    Row("raw pipe echo, as the kernel places them", 57.0, "µs", 90.0),  # nothing with an aim is compared with it
    Row("raw pipe echo, on one core", 16.8, "µs", 20.0),
    Row("warm load, durability process", 40.2, "µs", 119.0, 2.4, "pipe", at_most=2.5),
    Row("  its p99", 140.0, "µs", None, 3.5, "median", at_most=3.0),
    Row("threads in each process", 1234.0, ""),
]


def test_figures_with_an_aim_and_their_yardsticks_become_a_table_with_one_figure_a_cell(tmp_path: Path) -> None:
    write(tmp_path / "bench.json", ROWS)
    results = msgspec.json.decode((tmp_path / "bench.json").read_bytes(), type=Results)

    lines = markdown(results, "2026-11-23", "abc1234").splitlines()

    assert lines[0].startswith("Taken on 2026-11-23 at commit abc1234 by `make bench`; python 3.")
    assert lines[4:] == [
        "| raw pipe echo, on one core | 16.8 | µs | 20 |  |  |  |",
        "| warm load, durability process | 40.2 | µs | 119 | 2.40 | ≤ 2.5 × pipe | yes |",
        "| its p99 | 140 | µs |  | 3.50 | ≤ 3 × median | no |",
    ]


def test_only_what_is_between_the_marks_changes() -> None:
    page = PAGE.read_text()

    changed = put(page, "| a | table |")

    before, _, _ = page.partition(BEGIN)
    _, _, after = page.partition(END)
    assert changed == f"{before}{BEGIN}\n| a | table |\n{END}{after}"
    assert put(changed, "| b | c |") == put(page, "| b | c |")


@pytest.mark.parametrize("page", ["no marks", f"{BEGIN} only", f"{END} before {BEGIN}"])
def test_a_page_without_its_marks_is_refused(page: str) -> None:
    with pytest.raises(ValueError, match="figures: begin"):
        put(page, "")
