"""python -m simulation.small_worlds: walk small worlds to the end, as far as time allows, and show what breaks.

In each a provider has a whole and its part, and two consumers ask for them. The worlds differ in what people do and in
what goes wrong.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import sys
import time
from typing import NamedTuple

from rr_actors.registrar.model.catalog import Server
from rr_actors.registrar.model.rows import STANDBY
from simulation.budgets import Budget
from simulation.explore import Person, SmallWorld, Walk, picture, walk

_WHOLE, _PART = Person("a", "r", "whole"), Person("b", "r", "part")
_BOTH = (_WHOLE, _PART)
_PARTS = {"whole": ("r", "part")}
_SERVERS = (Server("whole"), Server("part"))
_HEARING = (Server("whole", has_status=True), Server("part", has_status=True))
_PAUSING = (Server("whole", pauses=True, paused_s=1.0), Server("part", pauses=True, paused_s=1.0))
_AT_TIMES = (STANDBY, 5, "unload")
"""A query that is not needed for some time."""

_TWO = SmallWorld({"a": (), "b": (), "r": _SERVERS}, _PARTS, _BOTH, hasty=frozenset("abr"))
"""Two consumers: one has the whole, one its part."""
_ONE = SmallWorld({"a": (), "r": _SERVERS}, _PARTS, (_WHOLE,), hasty=frozenset("ar"), linked=True)
"""One consumer, with the whole."""
_LEAST = SmallWorld({"a": (), "r": _SERVERS}, {}, (Person("a", "r", "part"),), hasty=frozenset("ar"), linked=True)
"""One consumer, with something that has no parts."""
_LAMP, _FAN = (Person("a", "budgets", "share", (STANDBY,), request=each) for each in (b"2 lamp", b"2 fan"))
_PUMP = Person("a", "budgets", "share", request=b"2 pump")
_SHARES = SmallWorld(
    {"a": (), "budgets": (Server("share"),)},
    {},
    (_LAMP, _FAN, _PUMP),
    hasty=frozenset(("a", "budgets")),
    linked=True,
    budget=Budget(4.0),
)
"""Three shares of two, where there is room for two. The lamp and the fan are not needed later, the pump is."""
_HOUSE = {"a": (), "house": (Server("device"),), "budgets": (Server("share"),)}
_DEVICES = tuple(each._replace(provider="house", server="device") for each in (_LAMP, _PUMP))
_HOSTS = SmallWorld(
    {"h0/a": (), "h1/r": (Server("part"),)},
    {},
    (Person("h0/a", "h1/r", "part"),),
    hasty=frozenset(("h0/a", "h1/r")),
    linked=True,
    rates={"h0": 0.96, "h1": 1.04},
    ticks=3,
    rounds=1,
    partings=1,
)
"""Two hosts, one lease, and one resource, which a consumer of the other host holds."""
_DIRECT = tuple(each._replace(then=("owe",), direct=True) for each in _BOTH)

WORLDS = {
    "at once": _TWO,
    "in batches": _TWO._replace(hasty=frozenset()),
    "errors": _ONE._replace(raises=1, tires=1),
    "lost link": _ONE._replace(cuts=1),
    "crash": _LEAST._replace(crashes=1, linked=False),
    "crash and lost link": _LEAST._replace(crashes=1, cuts=1),
    "two crashes": _LEAST._replace(crashes=2),
    "statuses": _ONE._replace(
        layout={"a": (), "r": _HEARING}, statuses=(("r", "WARNING"), ("r", "FATAL")), crashes=0, raises=1
    ),
    "priorities": _TWO._replace(
        people=(_WHOLE._replace(then=(5, STANDBY, "unload")), _PART._replace(then=(3, "unload"))), linked=True
    ),
    "pauses": _ONE._replace(layout={"a": (), "r": _PAUSING}, people=(_WHOLE._replace(then=_AT_TIMES),)),
    "pauses and revocation": _ONE._replace(
        layout={"a": (), "r": _PAUSING}, people=(_WHOLE._replace(then=_AT_TIMES),), statuses=(("r", "revoke"),)
    ),
    "crash and pauses": _LEAST._replace(
        layout={"a": (), "r": _PAUSING}, people=(Person("a", "r", "part", _AT_TIMES),), crashes=1
    ),
    "crash with a part": _ONE._replace(crashes=1),
    "crash and statuses": _LEAST._replace(
        layout={"a": (), "r": _HEARING}, statuses=(("r", "WARNING"), ("r", "FATAL")), crashes=1
    ),
    "reload": _ONE._replace(statuses=(("r", "reload"),), raises=1),
    "crash and reload": _LEAST._replace(statuses=(("r", "reload"),), crashes=1),
    "two crashes and reload": _LEAST._replace(
        statuses=(("r", "reload"),), crashes=2, people=(Person("a", "r", "part"),)
    ),
    "reload and unload": _LEAST._replace(
        statuses=(("r", "reload"), ("r", "reload")), people=(Person("a", "r", "part", ("unload",)),), raises=1
    ),
    "reload of a paused": _LEAST._replace(
        layout={"a": (), "r": _PAUSING}, people=(Person("a", "r", "part", _AT_TIMES),), statuses=(("r", "reload"),)
    ),
    "crash and priorities": _LEAST._replace(people=(Person("a", "r", "part", (5, STANDBY, "unload")),), crashes=1),
    "direct lines": _TWO._replace(people=_DIRECT, linked=True),
    "direct lines and errors": _LEAST._replace(
        people=(Person("a", "r", "part", ("owe",), direct=True),), crashes=1, tires=1, raises=1
    ),
    "budget": _SHARES._replace(people=(_LAMP, _PUMP), budget=Budget(2.0)),
    "budget for two": _SHARES,
    "budget of wholes": _SHARES._replace(
        layout=_HOUSE,
        parts={"device": ("budgets", "share")},
        people=_DEVICES,
        budget=Budget(2.0),
        hasty=frozenset(_HOUSE),
    ),
    "lease": _HOSTS,
    "lease and direct lines": _HOSTS._replace(people=(Person("h0/a", "h1/r", "part", ("owe",), direct=True),)),
    "lease and crash": _HOSTS._replace(crashes=1),
    "lease and killed gateway": _HOSTS._replace(stumbles=1),
    "crash with two holders": _TWO._replace(
        people=(Person("a", "r", "part"), Person("b", "r", "part")), parts={}, crashes=1, linked=True
    ),
}
"""Those that end within seconds first."""


class _Task(NamedTuple):
    name: str
    seconds: float


def main(arguments: list[str] | None = None) -> int:
    """Walk the worlds of these names, or all; 1 if a promise was broken."""
    parser = argparse.ArgumentParser(prog="python -m simulation.small_worlds", description="Small worlds, walked.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(WORLDS)} (default: all)")
    parser.add_argument("--seconds", type=float, default=120.0, help="for all of them together (default: 120)")
    options = parser.parse_args(arguments)
    names: list[str] = options.names or [*WORLDS]
    if unknown := sorted({*names} - {*WORLDS}):
        parser.error(f"no world {', '.join(unknown)}: there are {', '.join(WORLDS)}")
    cores = len(os.sched_getaffinity(0))
    tasks = [_Task(name, options.seconds * cores / len(names)) for name in names]
    broken = False
    with multiprocessing.Pool(min(cores, len(tasks))) as pool:
        for name, lines, found in pool.imap(_walked, tasks):
            sys.stdout.write(f"{name.ljust(max(map(len, WORLDS)))}  {lines[0]}\n")
            sys.stdout.writelines(f"{line}\n" for line in lines[1:])
            sys.stdout.flush()
            broken = broken or found
    return int(broken)


def _walked(task: _Task) -> tuple[str, list[str], bool]:
    until = time.monotonic() + task.seconds
    done = walk(WORLDS[task.name], go_on=lambda _: time.monotonic() < until)
    return task.name, told(WORLDS[task.name], done), done.violation is not None


def told(small: SmallWorld, done: Walk) -> list[str]:
    """Say how far a walk came; of a broken promise also the shortest history, step by step and as a picture."""
    how = "to the end" if done.ended else "as far as time allowed"
    if done.violation is not None:
        how = f"{done.violation!r}, after {len(done.history)} steps"
    first = f"{done.states:>8} states, {done.steps:>8} steps, {done.depth:>3} deep: {how}"
    return [
        first,
        *(f"    {step!r}," for step in done.history),
        *(picture(small, done.history) if done.history else ()),
    ]


if __name__ == "__main__":
    sys.exit(main())
