"""Pools: what a file or a program says about each, and the checks of that.

A file has one table for each pool::

    [[pool]]
    name = "watts"
    capacity = 100
    policy = ["reclaim", "supply", "preempt", "wait"]    # the default: in this order they make room

    [[pool.reserve]]                                     # what can be loaded to add to the capacity
    server = "power/generator"
    request = "diesel"
    amount = 50

    [[pool.sink]]                                        # what is loaded while there is too much
    server = "heaters/boiler"

    [pool.measure]                                       # what the capacity follows; see measures.py
    probe = "psi:cpu"
    shed_at = 60
    restore_at = 30
    step = 5
    surplus_at = 5
    settled_at = 20
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast, get_args

import msgspec

from rr_actors.base.checks import is_number
from rr_actors.base.errors import ConfigError, InvalidName, is_a, shown
from rr_actors.base.names import parse_server_id
from rr_actors.base.toml import parse_typed, raise_faults, wrong
from rr_actors.managers.budgets.measures import Measure, faults
from rr_actors.managers.budgets.planner import Step
from rr_actors.managers.planning.last_good import last_good_file
from rr_actors.managers.planning.probes import NoProbe, probe_of
from rr_actors.registrar.manager import Beginning

POLICY: tuple[Step, ...] = get_args(Step)


class Reserve(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A resource that adds `amount` to the capacity by a supply of its own, and is loaded when that is needed.

    Without a `request` it is loaded as `load(server)` does: each field of its request has its default. Its priority is
    that of the most urgent share that would not fit without it.

    Attributes:
        least_on_s: seconds for which it stays on at least, so that what goes on and off does not switch it, too.
    """

    server: str
    amount: float
    request: Any = None
    least_on_s: float = 5.0


class Sink(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A resource that is loaded while the pool's measure says that there is too much, and takes some of it.

    Its load has the lowest priority, -1000: its share takes what is free, and gives way to all others.

    Attributes:
        request: as of a Reserve.
        least_on_s: seconds for which it stays on at least.
    """

    server: str
    request: Any = None
    least_on_s: float = 5.0


class Pool(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A quantity that resources share.

    Attributes:
        name: such as "watts".
        capacity: how much there is without supplies. With a measure, at most.
        policy: what makes room for a share that does not fit, in this order. "reclaim": revoke shares that are idle.
            "supply": load a reserve. "preempt": revoke shares of lower priority. "wait": wait until others release
            theirs; what comes after it is done when the share may not wait any longer. What is left out is not done.
        reserve: what can be loaded to add to the capacity, the preferred first.
        sink: what is loaded while there is too much, the first first; with a measure that has `surplus_at`.
        measure: how the capacity is measured.
    """

    name: str
    capacity: float
    policy: tuple[Step, ...] = POLICY
    reserve: tuple[Reserve, ...] = ()
    sink: tuple[Sink, ...] = ()
    measure: Measure | None = None


class PoolFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file."""

    pool: list[Pool]


def read_pools(
    file_or_pools: str | os.PathLike[str] | Sequence[Pool], beginning: Beginning | None = None
) -> dict[str, Pool]:
    """Return the pools by name, from a TOML file or as they are given; after a crash from the last good file.

    Raises:
        ConfigError: the file cannot be read, or a pool is wrong. `.file`, `.key`, `.expected`, `.got`
    """
    if isinstance(file_or_pools, (str, os.PathLike)):
        return last_good_file(beginning, Path(file_or_pools).absolute(), _parse_pools).now
    return _checked(None, _given(file_or_pools))


def _parse_pools(data: bytes, file: str) -> dict[str, Pool]:
    return _checked(file, parse_typed(data, file, PoolFile).pool)


def _checked(file: str | None, pools: Sequence[Pool]) -> dict[str, Pool]:
    found: dict[str, Pool] = {}
    faults: list[ConfigError] = []
    for i, pool in enumerate(pools):
        key = f"pool[{i}]"
        try:
            if pool.name in found or not pool.name:
                said = f"{shown(pool.name)} again" if pool.name else None
                raise wrong(file, f"{key}.name", "a name that no other pool has", pool.name, where="Budgets", said=said)
            _check_pool(file, key, pool)
        except ConfigError as error:
            faults.append(error)
        found[pool.name] = pool
    raise_faults(faults)
    return found


def _check_pool(file: str | None, key: str, pool: Pool) -> None:
    check_amount(file, f"{key}.capacity", pool.capacity)
    for j, reserve in enumerate(pool.reserve):
        _check_server(file, f"{key}.reserve[{j}].server", reserve.server)
        check_amount(file, f"{key}.reserve[{j}].amount", reserve.amount)
        check_amount(file, f"{key}.reserve[{j}].least_on_s", reserve.least_on_s)
    for j, sink in enumerate(pool.sink):
        _check_server(file, f"{key}.sink[{j}].server", sink.server)
        check_amount(file, f"{key}.sink[{j}].least_on_s", sink.least_on_s)
    if pool.sink and (pool.measure is None or pool.measure.surplus_at is None):
        raise wrong(file, f"{key}.sink", "a measure with surplus_at, or no sink", len(pool.sink), where="Budgets")
    if unknown := [step for step in pool.policy if step not in POLICY]:
        raise wrong(file, f"{key}.policy", f"of {', '.join(POLICY)}", unknown[0], where="Budgets")
    if again := [step for i, step in enumerate(pool.policy) if step in pool.policy[:i]]:
        said = f"{again[0]} again"
        raise wrong(file, f"{key}.policy", "each step once", pool.policy, where="Budgets", said=said)
    _check_measure(file, f"{key}.measure", pool.measure)


def _given(pools: object) -> Sequence[Pool]:
    """Return what a program has given, if it is pools; a type checker sees most of this, and not all use one."""
    if not is_a(pools, (list, tuple)):
        raise wrong(
            None, "pools", "a list of rr_actors.managers.Pool, or the path of a TOML file", pools, where="Budgets"
        )
    for i, pool in enumerate(cast("Sequence[object]", pools)):
        if not is_a(pool, Pool):
            raise wrong(None, f"pool[{i}]", "an rr_actors.managers.Pool", pool, where="Budgets")
        if not is_a(pool.name, str):
            raise wrong(None, f"pool[{i}].name", "a str", pool.name, where="Budgets")
        for field, kind in (("reserve", Reserve), ("sink", Sink)):
            for j, one in enumerate(getattr(pool, field)):
                if not is_a(one, kind):
                    expected = f"an rr_actors.managers.{kind.__name__}"
                    raise wrong(None, f"pool[{i}].{field}[{j}]", expected, one, where="Budgets")
    return cast("Sequence[Pool]", pools)


def _check_server(file: str | None, key: str, server: str) -> None:
    try:
        parse_server_id(server)
    except InvalidName as error:
        raise wrong(file, key, "a server, 'registrar/server'", server, where="Budgets") from error


def _check_measure(file: str | None, key: str, measure: Measure | None) -> None:
    if measure is None:
        return
    for field, expected in faults(measure):
        raise wrong(file, f"{key}.{field}", expected, getattr(measure, field), where="Budgets")
    try:
        probe_of(measure.probe)
    except NoProbe as error:
        raise wrong(file, f"{key}.probe", error.expected, measure.probe, where="Budgets", said=error.found) from error


def check_amount(file: str | None, key: str, amount: float) -> None:
    """Raise ConfigError for an amount that is no number of at least 0."""
    if not is_number(amount) or amount < 0:
        raise wrong(file, key, "a number of at least 0", amount, where="Budgets")
