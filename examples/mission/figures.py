"""The two figures of the thesis, the path with the faults marked and distance over time; and a timeline of each run."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mission.corridor import GOAL, OUTLINE, START
from mission.record import Fault, Record

mpl.use("Agg")  # no display needed
_LINES = (("lightgreen", 7.0), ("tab:blue", 3.0), ("tab:red", 1.5))  # thinner and thinner: they lie on one another


def draw(records: Sequence[Record], directory: Path) -> list[Path]:
    """Write path.png, distance.png and each run's timeline into the directory; return where they are."""
    directory.mkdir(parents=True, exist_ok=True)
    drawings = {"path.png": _draw_path, "distance.png": _draw_distance}
    for name, drawing in drawings.items():
        figure = Figure(figsize=(8, 6), layout="constrained")
        drawing(figure.subplots(), records)
        figure.savefig(directory / name, dpi=120)
    timelines = {record.title: record.timeline.svg() for record in records if record.timeline is not None}
    pictures = {f"timeline-{title.replace(' ', '-')}.svg": picture for title, picture in timelines.items()}
    for name, picture in pictures.items():
        (directory / name).write_text(picture)
    return [directory / name for name in (*drawings, *pictures)]


def _draw_path(axes: Axes, records: Sequence[Record]) -> None:
    axes.plot(*zip(*OUTLINE, OUTLINE[0], strict=True), color="black", linewidth=2)
    axes.plot(*START, marker="o", color="black", markersize=8)
    axes.annotate("start", START, xytext=(-6, 10), textcoords="offset points", ha="right")
    axes.plot(*GOAL, marker="*", color="black", markersize=12)
    axes.annotate("goal", GOAL, xytext=(-8, 8), textcoords="offset points", ha="right")
    for record, (colour, width) in zip(records, _LINES, strict=False):
        xs, ys = [sample.x for sample in record.samples], [sample.y for sample in record.samples]
        axes.plot(xs, ys, color=colour, linewidth=width, label=f"{record.title}: {record.outcome}")
        for fault in record.faults:
            _mark(axes, fault, fault.x, fault.y, colour)
    axes.set(title="Path of the robot, faults marked", xlabel="x (m)", ylabel="y (m)", aspect="equal")
    axes.legend(loc="upper left")


def _draw_distance(axes: Axes, records: Sequence[Record]) -> None:
    for record, (colour, width) in zip(records, _LINES, strict=False):
        times, driven = [sample.time_s for sample in record.samples], [sample.driven_m for sample in record.samples]
        axes.plot(times, driven, color=colour, linewidth=width, label=f"{record.title}: {record.time_s:.1f} s")
        for fault in record.faults:
            _mark(axes, fault, fault.time_s, fault.driven_m, colour)
    axes.set(title="Distance over time", xlabel="time (s)", ylabel="distance driven (m)")
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left")


def _mark(axes: Axes, fault: Fault, x: float, y: float, colour: str) -> None:
    recovered = fault.serving_s is not None
    label = f"{fault.name}: {fault.what} {fault.done}" if recovered else None
    axes.plot(x, y, marker="x", color=colour, markersize=9, markeredgewidth=2, linestyle="", label=label)
    offset = (8, -14) if recovered else (-8, 8)
    axes.annotate(fault.name, (x, y), xytext=offset, textcoords="offset points", color=colour, fontsize=9)
