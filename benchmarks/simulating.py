"""How long an hour of crashes takes in virtual time, beside the events of that hour as JSON."""

from __future__ import annotations

import statistics

import msgspec

import rr_actors as rr
from benchmarks.measure import time_each
from benchmarks.table import Row

_CHILDREN = 20
_EVERY_S = 300.0
_AIM_MS = 50.0


class Idle(rr.Actor):
    """A child that is never started."""


def simulating(times: int) -> list[Row]:
    """Simulate an hour in which each of 20 children dies every five minutes in the mean."""
    tree = rr.Supervisor([rr.ChildSpec(Idle, id=f"child{n}") for n in range(_CHILDREN)], max_restarts=100)
    lives = {f"child{n}": rr.Child.fails(rr.Exponential(_EVERY_S)) for n in range(_CHILDREN)}
    events = rr.simulate(tree, lives).events
    encode = msgspec.json.Encoder().encode
    hour_s = statistics.median(time_each(lambda: rr.simulate(tree, lives), times))
    json_s = statistics.median(time_each(lambda: [encode(event) for event in events], times))
    return [
        Row(
            f"an hour with {_CHILDREN} children in virtual time ({len(events)} events)",
            hour_s * 1e3,
            "ms",
            at_most=_AIM_MS,
        ),
        Row("the same events as JSON", json_s * 1e3, "ms"),
    ]
