"""The results: one row a figure, with its aim where there is one; a table for people, JSON for programs."""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path


@dataclass(frozen=True)
class Row:
    """One figure. `ratio` compares it with `against`; `aim` bounds `ratio` where it has one, else `value`."""

    name: str
    value: float
    unit: str
    p99: float | None = None
    ratio: float | None = None
    against: str = ""
    at_most: float | None = None
    at_least: float | None = None

    @property
    def met(self) -> bool | None:
        """Whether the aim is met; None where there is none."""
        figure = self.value if self.ratio is None else self.ratio
        if self.at_most is not None:
            return figure <= self.at_most
        if self.at_least is not None:
            return figure >= self.at_least
        return None

    @property
    def aim(self) -> str:
        """The aim, in words."""
        unit = f" × {self.against}" if self.ratio is not None else f" {self.unit}"
        if self.at_most is not None:
            return f"≤ {self.at_most:,g}{unit}"
        if self.at_least is not None:
            return f"≥ {self.at_least:,g}{unit}"
        return ""


def machine() -> dict[str, str | int]:
    """What the figures were taken on: nothing that names the machine."""
    versions = {}
    for package in ("msgspec", "pykka", "uvloop"):
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return {"python": platform.python_version(), "system": sys.platform, "cores": os.cpu_count() or 0, **versions}


def text(rows: Iterable[Row]) -> str:
    """The table."""
    lines = [("", "median", "p99", "ratio", "aim", ""), *map(_cells, rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    out: list[str] = []
    for row, line in enumerate(lines):
        cells = [line[0].ljust(widths[0])]
        cells += [cell.rjust(width) for cell, width in zip(line[1:4], widths[1:4], strict=True)]
        cells += [cell.ljust(width) for cell, width in zip(line[4:], widths[4:], strict=True)]
        out.append("  ".join(cells).rstrip())
        if row == 0:
            out.append("─" * (sum(widths) + 2 * (len(widths) - 1)))
    return "\n".join(out)


def write(path: Path, rows: Iterable[Row]) -> None:
    """Write everything to `path` as JSON."""
    results = [asdict(row) | {"met": row.met} for row in rows]
    path.write_text(json.dumps({"machine": machine(), "results": results}, indent=2) + "\n")


def _cells(row: Row) -> tuple[str, ...]:
    return (
        row.name,
        f"{number(row.value)} {row.unit}",
        "" if row.p99 is None else f"{number(row.p99)} {row.unit}",
        "" if row.ratio is None else f"{row.ratio:.2f} × {row.against}",
        row.aim,
        {True: "met", False: "MISSED", None: ""}[row.met],
    )


def number(value: float) -> str:
    """Three digits, or all of a large number's, in groups of three."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
