"""Put the results of `make bench` into docs/performance.md: `python -m benchmarks.page bench.json`.

The page has one table, between two marks. The rest of the page is written by hand.
"""

from __future__ import annotations

import argparse
import re
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec

from benchmarks.table import Row, number

PAGE = Path(__file__).parents[1] / "docs" / "performance.md"
BEGIN, END = "<!-- figures: begin -->", "<!-- figures: end -->"
_SIZE = re.compile(r"[\d,]+(?= held:| queries$)")


class Results(msgspec.Struct):
    """The content of the file that `benchmarks.run` writes.

    Attributes:
        machine: versions and cores.
        results: a Row each, and whether its aim is met.
    """

    machine: dict[str, str | int]
    results: list[dict[str, Any]]


def markdown(results: Results, day: str, commit: str) -> str:
    """Return the table: the figures that have an aim, each group after its yardstick, and when they were taken.

    Of figures that differ only by how many queries are held, it has the one farthest from its aim.
    """
    rows = [Row(**{name: value for name, value in result.items() if name != "met"}) for result in results.results]
    left_out = _less_telling(rows)
    yardsticks = {row.against for row in rows if row.against}
    unused: dict[str, Row] = {}  # by what the figures after it are compared with
    machine = ", ".join(f"{name} {value}" for name, value in results.machine.items())
    lines = [
        f"Taken on {day} at commit {commit} by `make bench`; {machine}.",
        "",
        "| what | median | 99th percentile | ratio | aim |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        if row in left_out:
            continue
        if row.met is not None:
            if yardstick := unused.pop(row.against, None):
                lines.append(_line(yardstick))
            lines.append(_line(row))
        elif row.ratio is None:
            unused |= {against: row for against in yardsticks if against in row.name}
    return "\n".join(lines)


def _less_telling(rows: list[Row]) -> list[Row]:
    """Return the rows that differ from one with a worse figure only by how many queries are held."""
    of_sizes = [row for row in rows if row.at_most is not None and _SIZE.search(row.name)]
    worst = {_SIZE.sub("", row.name): row for row in sorted(of_sizes, key=lambda row: row.ratio or row.value)}
    return [row for row in of_sizes if row not in worst.values()]


def _line(row: Row) -> str:
    cells = (
        row.name.strip(),
        f"{number(row.value)} {row.unit}".strip(),
        "" if row.p99 is None else number(row.p99),
        "" if row.ratio is None else f"{row.ratio:.2f}",
        f"{row.aim}, **missed**" if row.met is False else row.aim,
    )
    return f"| {' | '.join(cells)} |"


def put(page: str, table: str) -> str:
    """Return the page with `table` between its marks.

    Raises:
        ValueError: the page lacks a mark.
    """
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{PAGE.name}: expected the marks {BEGIN} and {END} in this order, one is missing")
    return f"{before}{BEGIN}\n{table}\n{END}{after}"


def main() -> None:
    """Read the results and rewrite the page."""
    parser = argparse.ArgumentParser(prog="benchmarks.page", description="Put results into docs/performance.md.")
    parser.add_argument("results", type=Path, nargs="?", default=Path("bench.json"), help="default: bench.json")
    results = msgspec.json.decode(parser.parse_args().results.read_bytes(), type=Results)
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=PAGE.parent, capture_output=True, text=True, check=True
    )
    table = markdown(results, f"{datetime.now(UTC):%Y-%m-%d}", commit.stdout.strip())
    PAGE.write_text(put(PAGE.read_text(), table))


if __name__ == "__main__":
    main()
