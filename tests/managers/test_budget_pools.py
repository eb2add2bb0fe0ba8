"""The pools of budgets: what a file and a program may say, and how what is wrong is named."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.managers.budgets.pools import Pool, Reserve, read_pools

GOOD = """
[[pool]]
name = "watts"
capacity = 100

[[pool.reserve]]
server = "power/generator"
request = "diesel"
amount = 50

[[pool]]
name = "lanes"
capacity = 2.5
policy = ["wait"]
"""


def test_pools_are_read_from_a_file_or_taken_as_they_are(tmp_path: Path) -> None:
    (tmp_path / "pools.toml").write_text(GOOD)
    watts = Pool("watts", 100, reserve=(Reserve("power/generator", 50, "diesel"),))
    lanes = Pool("lanes", 2.5, ("wait",))

    assert read_pools(tmp_path / "pools.toml") == {"watts": watts, "lanes": lanes}
    assert read_pools([watts, lanes]) == {"watts": watts, "lanes": lanes}


@pytest.mark.parametrize(
    ("old", "new", "key", "expected", "got"),
    [
        ('"lanes"', '"watts"', "pool[1].name", "a name that no other pool has", "watts"),
        ("capacity = 100", "capacity = -1", "pool[0].capacity", "a number of at least 0", -1),
        ("capacity = 100", "capacity = inf", "pool[0].capacity", "a number of at least 0", math.inf),
        ("amount = 50", "amount = -5", "pool[0].reserve[0].amount", "a number of at least 0", -5),
        (
            "amount = 50",
            "amont = 50",
            "pool[0].reserve[0].amont",
            "one of server, amount, request, least_on_s",
            "amont",
        ),
        ("amount = 50", 'amount = "5"', "pool[0].reserve[0].amount", "`float`", "5"),
        (
            "capacity = 2.5",
            "capcity = 2.5",
            "pool[1].capcity",
            "one of name, capacity, policy, reserve, measure",
            "capcity",
        ),
        ("capacity = 2.5", "", "pool[1]", "the key capacity", {"name": "lanes", "policy": ["wait"]}),
        ("capacity = 2.5", 'capacity = "2"', "pool[1].capacity", "`float`", "2"),
        ('["wait"]', '["wait", "wiat"]', "pool[1].policy[1]", "one of reclaim, supply, preempt, wait", "wiat"),
        ('"power/generator"', '"power"', "pool[0].reserve[0].server", "a server, 'registrar/server'", "power"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(
    tmp_path: Path, old: str, new: str, key: str, expected: str, got: object
) -> None:
    file = tmp_path / "pools.toml"
    file.write_text(GOOD.replace(old, new))
    with pytest.raises(rr.ConfigError) as raised:
        read_pools(str(file))
    error = raised.value
    assert (error.file, error.key, error.expected, error.got) == (str(file), key, expected, got)


PSI = "a function, its name 'package.module:function', or one of psi:cpu, psi:memory, psi:io"


@pytest.mark.parametrize(
    ("measure", "key", "expected", "got"),
    [
        ('probe = "math:nothing"', "probe", PSI, "math:nothing"),
        ('probe = "no_module:probe"', "probe", PSI, "no_module:probe"),
        ('probe = "psi:disk"', "probe", PSI, "psi:disk"),
        ("probe = 7", "probe", PSI, 7),
        ('probe = "os:getpid"\nevery_s = 0', "every_s", "a number above 0", 0.0),
        ('probe = "os:getpid"\ntimeout_s = inf', "timeout_s", "a number above 0", math.inf),
        ('probe = "os:getpid"\nstep = -1', "step", "a number of at least 0", -1.0),
        ('probe = "os:getpid"\nshed_at = nan', "shed_at", "a number", math.nan),
        ('probe = "os:getpid"\nshed_at = 3', "restore_at", "another number than shed_at; both or neither", None),
        ('probe = "os:getpid"\nshed_at = 3\nrestore_at = 4', "step", "a number above 0", 0.0),
        (
            'probe = "os:getpid"\nstepp = 1',
            "stepp",
            "one of probe, every_s, timeout_s, shed_at, restore_at, step, surplus_at, settled_at",
            "stepp",
        ),
    ],
)
def test_what_is_wrong_in_a_measure_is_named(
    tmp_path: Path, measure: str, key: str, expected: str, got: object
) -> None:
    file = tmp_path / "pools.toml"
    file.write_text(f'[[pool]]\nname = "watts"\ncapacity = 100\n[pool.measure]\n{measure}\n')
    with pytest.raises(rr.ConfigError) as raised:
        read_pools(file)
    error = raised.value
    assert (error.file, error.key, error.expected) == (str(file), f"pool[0].measure.{key}", expected)
    assert repr(error.got) == repr(got)


@pytest.mark.parametrize(
    ("pools", "key"),
    [
        ([Pool("watts", math.nan)], "pool[0].capacity"),
        ([Pool("", 1)], "pool[0].name"),
        ([Pool("watts", 1), Pool("watts", 1)], "pool[1].name"),
        ([Pool("watts", 1, ("preemt",))], "pool[0].policy"),  # type: ignore[arg-type]
        (Pool("watts", 1), "pools"),
        (None, "pools"),
        ([{"name": "watts", "capacity": 1}], "pool[0]"),
        ([Pool(7, 1)], "pool[0].name"),  # type: ignore[arg-type]
        ([Pool("watts", 1, reserve=("power/generator",))], "pool[0].reserve[0]"),  # type: ignore[arg-type]
        ([Pool("watts", 1, reserve=(Reserve("power", 1),))], "pool[0].reserve[0].server"),
    ],
)
def test_what_is_wrong_in_a_program_is_named(pools: Any, key: str) -> None:
    with pytest.raises(rr.ConfigError, match="Budgets: pool") as raised:
        read_pools(pools)
    assert raised.value.key == key
    assert raised.value.expected
