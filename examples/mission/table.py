"""The table at the end: the figures of these runs beside those of the thesis."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table

from mission.record import Fault, Record

THESIS_S = {"without faults": "32 s", "with faults": "43 s", "without recovery": "stops at F1"}
THESIS_STANDING_S = {"F1": "3 s", "F2": "5 s", "F3": "0 s", "F4": "0 s", "F5": "0 s"}
WHAT_IS_COMPARED = "here: simulated robot; start-up of real devices not included"


def make_table(records: Sequence[Record], speed: float) -> Table:
    title = "The mission" if speed == 1.0 else f"The mission, the robot {speed:g} times as fast as in the thesis"
    table = Table(title=f"{title}\n{WHAT_IS_COMPARED}", title_justify="left")
    table.add_column("")
    for name in ("thesis", "here", "fault to serving again"):
        table.add_column(name, justify="right")
    for record in records:
        table.add_row(f"time {record.title}", THESIS_S.get(record.title, ""), _outcome(record), "")
    for record in records:
        if any(fault.serving_s is not None for fault in record.faults):
            table.add_section()
            for fault in record.faults:
                table.add_row(*_fault_row(fault))
    table.add_section()
    table.add_row("resources still allocated", "0", _total([record.resources_left for record in records]), "")
    table.add_row("processes left", "0", _total([record.processes_left for record in records]), "")
    return table


def _outcome(record: Record) -> str:
    return f"{record.time_s:.1f} s" if record.arrived else f"{record.outcome} after {record.time_s:.1f} s"


def _fault_row(fault: Fault) -> tuple[str, str, str, str]:
    serving = "never" if fault.serving_s is None else f"{fault.serving_s * 1000:.0f} ms"
    standing = f"{fault.standing_s:.2f} s"
    title = f"{fault.name} {fault.what} {fault.done}: standing"
    return title, THESIS_STANDING_S.get(fault.name, "not tried"), standing, serving


def _total(counts: Sequence[int | None]) -> str:
    return "?" if None in counts else str(sum(count or 0 for count in counts))
