"""An ask of an Actor whose handler only answers: in another process, beside a raw pipe; in this process, beside
Pykka."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Literal

import rr_actors as rr
from benchmarks import placement as placement_of
from benchmarks.measure import interleaved
from benchmarks.table import Row
from benchmarks.workload import PAYLOAD
from benchmarks.yardsticks import pipe_echo, pykka_ask


class Parrot(rr.Actor):
    """Answers with what it is asked."""

    def on_receive(self, message: Any) -> Any:
        return message


def other_process(times: int) -> list[Row]:
    """One ask at a time, with both sides on one core and on two."""
    rows: list[Row] = []
    for placement in placement_of.placements():
        with placement_of.here(placement), pipe_echo(PAYLOAD) as echo, _parrot("process") as ask:
            placement_of.part(placement)
            rows += _rows(f"raw pipe echo, {placement}", echo, "ask of an Actor, other process", ask, "pipe", times)
    return rows


def same_process(times: int) -> list[Row]:
    """One ask at a time, of an actor in this process."""
    rows: list[Row] = []
    for placement in placement_of.placements():
        if placement == placement_of.TWO_CORES:
            continue  # its threads cannot be told apart from outside
        with placement_of.here(placement), pykka_ask(PAYLOAD) as theirs, _parrot("thread") as ours:
            rows += _rows(f"pykka ask, this process, {placement}", theirs, "ask of an Actor", ours, "ask", times)
    return rows


def _rows(
    yardstick: str, theirs: Callable[[], Any], name: str, ours: Callable[[], Any], against: str, times: int
) -> list[Row]:
    measured = interleaved({"theirs": theirs, "ours": ours}, times=times)
    mine, yours = measured["ours"], measured["theirs"]
    return [
        Row(yardstick, yours.median * 1e6, "µs", yours.p99 * 1e6),
        Row(name, mine.median * 1e6, "µs", mine.p99 * 1e6, mine.median / yours.median, against),
    ]


@contextmanager
def _parrot(placement: Literal["process", "thread"]) -> Iterator[Callable[[], Any]]:
    spec = rr.ChildSpec(Parrot, id="parrot", placement=placement)
    with (
        tempfile.TemporaryDirectory(prefix="rr-bench-") as state_dir,
        rr.System([spec], name="bench", state_dir=state_dir) as system,
    ):
        actor = system.ref("parrot")
        yield lambda: actor.ask(PAYLOAD)
