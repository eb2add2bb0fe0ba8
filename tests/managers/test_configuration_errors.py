"""Errors of configuration files: each names its key, all of them are said at once, at the start and not at a load."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.managers import Budgets, Choices, Components, Keeper, Pipes, Robots
from rr_actors.managers.budgets.pools import read_pools
from rr_actors.managers.choices.alternatives import read_alternatives
from rr_actors.managers.components import read_registry
from rr_actors.managers.pipes.pipe_files import read_pipe_file
from rr_actors.managers.robots import read_robots

POOL = '[[pool]]\nname = "watts"\ncapacity = 100\n'
CHOICE = '[[alternative]]\nkind = "range"\nserver = "cameras/camera"\n'
COMPONENT = '[[component]]\nname = "a"\ntype = "lidar"\n%s\n[component.program]\ncommand = "sleep"\n%s\n'
ROBOT = '[[robot]]\nname = "rover"\ndriver = { type = "lidar" }\n'

Read = Callable[[Path], object]

WRONG: list[tuple[Read, str, dict[str, str]]] = [
    (read_registry, COMPONENT % ("", "environment = { HOME = 3 }"), {"component[0].program.environment.HOME": "`str`"}),
    (read_registry, COMPONENT % ("parameters = { to = [] }", ""), {"component[0].parameters.to": "`str`"}),
    (read_registry, COMPONENT % ("", 'stop_signal = "SIGFOO"'), {"component[0].program.stop_signal": "a signal"}),
    (read_registry, COMPONENT % ("", "cost = { cpu = -1 }"), {"component[0].program.cost.cpu": "at least 0"}),
    (read_registry, COMPONENT % ("", "cost = { cpu = nan }"), {"component[0].program.cost.cpu": "at least 0"}),
    (read_registry, COMPONENT % ('parameters = { a = "$" }', ""), {"component[0].parameters.a": "${name} or $$"}),
    (read_registry, COMPONENT % ("", 'arguments = ["a", "$ b"]'), {"component[0].program.arguments[1]": "${name} or"}),
    (read_registry, (COMPONENT % ("", "")).replace('"sleep"', '""'), {"component[0].program.command": "a program"}),
    (read_registry, (COMPONENT % ("", "")).replace('"a"', '""'), {"component[0].name": "no other component"}),
    (read_registry, (COMPONENT % ("", "")).replace('"lidar"', '""'), {"component[0].type": "a type"}),
    (read_pipe_file, COMPONENT % ("", 'stop_signal = "SIGFOO"'), {"component[0].program.stop_signal": "a signal"}),
    (read_robots, ROBOT.replace('"lidar"', '""'), {"robot[0].driver.type": "the type of a component"}),
    (read_robots, ROBOT.replace('"rover"', '""'), {"robot[0].name": "no other robot"}),
    (read_pools, POOL + "measure = 3\n", {"pool[0].measure": "expected a table, got 3"}),
    (read_pools, POOL + 'policy = ["wait", "wait"]\n', {"pool[0].policy": "each step once, got wait again"}),
    (
        read_pools,
        POOL + POOL.replace("100", "-1") + POOL.replace("watts", "volts").replace("100", "-2"),
        {"pool[1].name": "no other pool", "pool[2].capacity": "at least 0"},
    ),
    (
        read_pools,
        POOL.replace("100", '"much"') + "polici = []\n" + '[[pool]]\nname = 3\n[[pools]]\nname = "x"\n',
        {
            "pool[0].capacity": "`float`",
            "pool[0].polici": "did you mean 'policy'?",
            "pool[1].name": "`str`",
            "pool[1]": "the key capacity",
            "pools": "did you mean 'pool'?",
        },
    ),
    (
        read_alternatives,
        CHOICE.replace("cameras/", "") + CHOICE + CHOICE + "timeout_s = 0\n",
        {"alternative[0].server": "'registrar/server'", "alternative[2].timeout_s": "over 0"},
    ),
]


@pytest.mark.parametrize(("read", "text", "faults"), WRONG)
def test_each_fault_of_a_file_is_named_with_its_key(
    tmp_path: Path, read: Read, text: str, faults: dict[str, str]
) -> None:
    file = tmp_path / "wrong.toml"
    file.write_text(text)
    with pytest.raises(rr.ConfigError) as caught:
        read(file)
    lines = [line for line in str(caught.value).splitlines() if str(file) in line]
    assert len(lines) == len(faults)
    for line, (key, says) in zip(lines, faults.items(), strict=True):
        assert f"{file}: {key}: " in line
        assert says in line
    assert caught.value.file == str(file)
    assert caught.value.key == next(iter(faults))


@pytest.mark.parametrize("manager", [Keeper, Budgets, Choices, Components, Pipes, Robots])
@pytest.mark.parametrize("given", [None, 3, b"file.toml"], ids=["none", "number", "bytes"])
def test_what_is_no_path_is_refused_by_name(manager: Any, given: object) -> None:
    with pytest.raises(rr.ConfigError, match=f"{manager.__name__}.*expected .*file.*, got"):
        manager(given)


def test_a_manager_with_a_wrong_file_says_all_its_faults_when_it_does_not_start(
    start: Callable[..., rr.System], tmp_path: Path
) -> None:
    file = tmp_path / "pools.toml"
    file.write_text(POOL.replace("100", "-1") + POOL.replace("watts", "volts").replace("100", "-2"))
    with pytest.raises(rr.StartFailed) as caught:
        start(rr.ChildSpec(Budgets, id="budgets", args=(str(file),)))
    for key in ("pool[0].capacity", "pool[1].capacity"):
        assert f"{key}: expected a number of at least 0" in str(caught.value)
