"""Simulation: run worlds by seed, and when a promise is broken, find the shortest history that still breaks it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from simulation.oracle import Violation
from simulation.quiescence import come_to_rest
from simulation.scheduler import Chance
from simulation.sim_registrar import SimRegistrar
from simulation.world import Step, World, describe

Factory = Callable[..., SimRegistrar]


class Outcome(NamedTuple):
    """How a run ended: `violation` is None if every promise was kept."""

    seed: int
    steps: int
    history: list[Step]
    violation: Exception | None


def run(seed: int, steps: int = 400, factory: Factory = SimRegistrar) -> Outcome:
    """Run one world: chance for so many steps, then rest and checks."""
    chance = Chance(seed)
    history: list[Step] = []
    try:
        world = World(chance.layout, factory, chance.hasty, chance.rates)
        for _ in range(steps):
            step = chance.next(world)
            if step is not None:
                history.append(step)
                world.apply(step)
        come_to_rest(world)
    except Exception as error:  # a Violation, or a defect that raised
        return Outcome(seed, len(history), history, error)
    return Outcome(seed, len(history), history, None)


def replay(seed: int, history: Sequence[Step], factory: Factory = SimRegistrar, trace: list[str] | None = None) -> Any:
    """Run a history in that seed's layout; the violation, or None. Steps that cannot happen are left out."""
    world: World | None = None
    try:
        chance = Chance(seed)
        world = World(chance.layout, factory, chance.hasty, chance.rates)
        world.trace = trace
        for step in history:
            world.apply(step)
        if trace is not None:
            trace.append("-- everything is mended, and comes to rest --")
        come_to_rest(world)
    except Exception as error:
        return error
    return None


def shrink(outcome: Outcome, factory: Factory = SimRegistrar, limit: int = 10_000) -> list[Step]:
    """The shortest history found within `limit` replays that breaks the same promise (delta debugging)."""
    wanted = kind_of(outcome.violation)
    history = list(outcome.history)
    size = max(1, len(history) // 2)
    while size:
        at = 0
        found = False
        while at < len(history) and limit > 0:
            shorter = history[:at] + history[at + size :]
            limit -= 1
            if kind_of(replay(outcome.seed, shorter, factory)) == wanted:
                history = shorter
                found = True
            else:
                at += size
        if not found or size > 1:
            size //= 2
    return history


def kind_of(error: Exception | None) -> str:
    """Which promise was broken."""
    if error is None:
        return ""
    return error.kind if isinstance(error, Violation) else type(error).__name__


def report(outcome: Outcome, factory: Factory = SimRegistrar) -> str:
    """The seed, the shortest history and its timeline."""
    history = shrink(outcome, factory)
    timeline: list[str] = []
    violation = replay(outcome.seed, history, factory, timeline)
    lines = [
        f"seed {outcome.seed}: {outcome.violation!r}",
        f"after {len(outcome.history)} steps; {len(history)} are enough:",
        *(f"    {step!r}," for step in history),
        "timeline:",
        *timeline,
        f"=> {violation!r}",
        f"servers: {Chance(outcome.seed).layout}",
        f"first step: {describe(history[0]) if history else 'none'}",
    ]
    return "\n".join(lines)
