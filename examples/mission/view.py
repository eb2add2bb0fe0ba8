"""What is shown while the mission runs: the tree, the resources and the robot on a terminal, plain lines elsewhere."""

from __future__ import annotations

import contextlib
import threading
from typing import Any, Self

from rich.columns import Columns
from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.panel import Panel
from rich.table import Table
from rich.text import Text
from rich.tree import Tree

import rr_actors as rr
from mission.corridor import GOAL, OUTLINE, Point, is_inside
from mission.record import Record

_LINE_EVERY_S = 5.0
_DRAW_EVERY_S = 0.1
_COLUMNS_PER_M, _ROWS_PER_M = 4, 2
_MARGIN_M = 0.75  # of wall around the corridor
_LOG_LINES = 8


class PlainView:
    """A line for each thing that happens, and one now and then for the robot."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._due_s = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        pass

    def say(self, text: str) -> None:
        self._console.print(text, highlight=False, markup=False, soft_wrap=True)

    def look(self, record: Record, system: rr.System, state: str) -> None:
        if not record.samples:
            self._due_s = 0.0
        elif record.samples[-1].time_s >= self._due_s:
            self._due_s = record.samples[-1].time_s + _LINE_EVERY_S
            self.say(progress(record, state))


class LiveView:
    """A picture drawn again and again at the same place, by a thread of its own: the drive does not wait for it."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._log: list[str] = []
        self._seen: tuple[Record, rr.System, str] | None = None
        self._snapshot: dict[str, Any] = {"tree": {"id": "root", "children": []}, "registrars": {}}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._draw, name="live-view", daemon=True)

    def __enter__(self) -> Self:
        self._live.start()
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._over.set()
        self._thread.join()
        self._live.stop()
        for line in self._log:  # the picture is gone, what happened stays
            self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    def say(self, text: str) -> None:
        self._log.extend(text.splitlines())

    def look(self, record: Record, system: rr.System, state: str) -> None:
        self._seen = record, system, state

    def _draw(self) -> None:
        while not self._over.wait(_DRAW_EVERY_S):
            if self._seen is not None:
                record, system, state = self._seen
                with contextlib.suppress(rr.RrError):  # it is just starting or stopping: the last one will do
                    self._snapshot = system.snapshot()
                self._live.update(self._picture(record, state), refresh=True)

    def _picture(self, record: Record, state: str) -> Group:
        system = Group(draw_tree(self._snapshot), Text(), draw_resources(self._snapshot))
        return Group(
            Columns([Panel(draw_map(record), title=record.title), Panel(system, title="the system")]),
            Text(progress(record, state)),
            Panel(Text("\n".join(self._log[-_LOG_LINES:])), title="what happened", height=_LOG_LINES + 2),
        )


def progress(record: Record, state: str) -> str:
    """How far the robot is."""
    if not record.samples:
        return state
    last = record.samples[-1]
    return (
        f"{last.time_s:5.1f} s  {last.driven_m:5.1f} m  at ({last.x:.1f}, {last.y:.1f})  {last.speed:.2f} m/s  {state}"
    )


def draw_map(record: Record) -> Text:
    """The corridor from above: the way so far, the faults and the robot in it."""
    left, right = min(point.x for point in OUTLINE) - _MARGIN_M, max(point.x for point in OUTLINE) + _MARGIN_M
    bottom, top = min(point.y for point in OUTLINE) - _MARGIN_M, max(point.y for point in OUTLINE) + _MARGIN_M
    columns, rows = int((right - left) * _COLUMNS_PER_M), int((top - bottom) * _ROWS_PER_M)
    cells = [
        [
            " " if is_inside(Point(left + (c + 0.5) / _COLUMNS_PER_M, top - (r + 0.5) / _ROWS_PER_M)) else "░"
            for c in range(columns)
        ]
        for r in range(rows)
    ]

    def put(x: float, y: float, text: str) -> None:
        column, row = int((x - left) * _COLUMNS_PER_M), int((top - y) * _ROWS_PER_M)
        for i, letter in enumerate(text):
            if 0 <= row < rows and 0 <= column + i < columns:
                cells[row][column + i] = letter

    put(*GOAL, "★")
    for sample in record.samples[:: max(1, len(record.samples) // 400)]:
        put(sample.x, sample.y, "·")
    for fault in record.faults:
        put(fault.x, fault.y, fault.name)
    if record.samples:
        put(record.samples[-1].x, record.samples[-1].y, "●")
    return Text("\n".join("".join(row) for row in cells))


def draw_tree(snapshot: dict[str, Any]) -> Tree:
    """The supervisor and its children, with what they do now."""
    tree = Tree(snapshot["tree"]["id"])
    for child in snapshot["tree"]["children"]:
        colour = "green" if child["state"] == "running" else "red"
        tree.add(f"{child['id']}  [{colour}]{child['state']}[/]  [dim]pid {child['pid'] or '-'}[/]")
    return tree


def draw_resources(snapshot: dict[str, Any]) -> Table:
    """Every resource, and who holds it."""
    table = Table("resource", "what", "state", "held by", box=None)
    for name, registrar in snapshot["registrars"].items():
        for resource in registrar.get("resources", []):
            colour = "green" if resource["state"] in ("OK", "UPDATE") else "red"
            what, holders = escape(_what(resource)), ", ".join(resource["holders"])
            table.add_row(f"{name}/{resource['server']}", what, f"[{colour}]{resource['state']}[/]", holders)
    return table


def _what(resource: dict[str, Any]) -> str:
    """A robot or a component by its name, a program by its module."""
    found: dict[str, Any] = resource["response"] or resource["request"]
    return found.get("name") or " ".join(resource["request"].get("arguments", [])[1:2])
