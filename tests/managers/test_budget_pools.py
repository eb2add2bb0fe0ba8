"""The pools of budgets: what a file and a program may say, and how what is wrong is named."""

from __future__ import annotations

import math
from pathlib import Path

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
        ("capacity = 2.5", "capcity = 2.5", "pool[1].capcity", "one of name, capacity, policy, reserve", "capcity"),
        ("capacity = 2.5", "", "pool[1]", "the key capacity", {"name": "lanes", "policy": ["wait"]}),
        ("capacity = 2.5", 'capacity = "2"', "pool[1].capacity", "`float`", "2"),
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


@pytest.mark.parametrize(
    ("pools", "key"),
    [
        ([Pool("watts", math.nan)], "pool[0].capacity"),
        ([Pool("", 1)], "pool[0].name"),
        ([Pool("watts", 1), Pool("watts", 1)], "pool[1].name"),
        ([Pool("watts", 1, ("preemt",))], "pool[0].policy"),  # type: ignore[arg-type]
    ],
)
def test_what_is_wrong_in_a_program_is_named(pools: list[Pool], key: str) -> None:
    with pytest.raises(rr.ConfigError, match="Budgets: pool") as raised:
        read_pools(pools)
    assert raised.value.key == key
