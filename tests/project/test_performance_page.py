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
        "| raw pipe echo, on one core | 16.8 µs | 20 |  |  |",
        "| warm load, durability process | 40.2 µs | 119 | 2.40 | ≤ 2.5 × pipe |",
        "| its p99 | 140 µs |  | 3.50 | ≤ 3 × median, **missed** |",
    ]


def test_of_figures_for_several_sizes_the_table_has_the_worst(tmp_path: Path) -> None:
    rows = [
        Row("100 held: unload", 30.0, "µs"),
        Row("1,000 held: unload", 36.0, "µs", None, 1.2, "at 100", at_most=1.25),
        Row("10,000 held: unload", 33.0, "µs", None, 1.1, "at 100", at_most=1.25),
        Row("memory: one of 10,000 queries", 539.0, "B", at_most=1_000),
        Row("memory: one of 100,000 queries", 603.0, "B", at_most=1_000),
    ]
    write(tmp_path / "bench.json", rows)
    results = msgspec.json.decode((tmp_path / "bench.json").read_bytes(), type=Results)

    lines = markdown(results, "2026-11-23", "abc1234").splitlines()

    assert [line.split(" | ")[0] for line in lines[4:]] == ["| 1,000 held: unload", "| memory: one of 100,000 queries"]


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
