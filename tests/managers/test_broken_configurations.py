"""A configuration that is wrong at the moment of a SIGKILL ends nothing, whatever the manager and the way."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.managers import Actions, Budgets, Choices, Components, Keeper, Pipes, Robots
from support import kill, wait_respawned
from support_cli import run_cli

POOLS = '[[pool]]\nname = "watts"\ncapacity = 100\n'
CHOICES = '[[alternative]]\nkind = "range"\nserver = "cameras/camera"\n'
COMPONENTS = '[[component]]\nname = "lidar"\ntype = "lidar"\nprogram = { command = "sleep" }\n'
ROBOTS = '[[robot]]\nname = "rover"\ndriver = { type = "lidar" }\n'
KEEP = '[[keep]]\nname = "camera"\nserver = "cameras/camera"\n'
GRAPH = '{"graph_name": "survey", "actions": [{"name": "Look"}]}'


class Look(rr.Action):
    """Do nothing."""

    def run(self) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Do nothing."""


MANAGERS: dict[str, tuple[type[rr.Manager], str]] = {
    "Budgets": (Budgets, POOLS),
    "Choices": (Choices, CHOICES),
    "Components": (Components, COMPONENTS),
    "Pipes": (Pipes, COMPONENTS),
    "Robots": (Robots, ROBOTS),
    "Keeper": (Keeper, KEEP),
    "Actions": (Actions, GRAPH),
}


def make_missing(file: Path) -> None:
    file.unlink()


def cut_in_half(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: len(file.read_bytes()) // 2])


def make_a_directory(file: Path) -> None:
    file.unlink()
    file.mkdir()


def make_unreadable(file: Path) -> None:
    """Make it a link to itself, which root cannot read either."""
    file.unlink()
    file.symlink_to(file.name)


def make_a_pipe(file: Path) -> None:
    """Put something there whose reader would wait for ever."""
    file.unlink()
    os.mkfifo(file)


def make_not_utf8(file: Path) -> None:
    file.write_bytes(b"\xff\xfe")


def remove_the_folder(file: Path) -> None:
    shutil.rmtree(file.parent)


WAYS: tuple[Callable[[Path], None], ...] = (
    make_missing,
    cut_in_half,
    make_a_directory,
    make_unreadable,
    make_a_pipe,
    make_not_utf8,
    remove_the_folder,
)


def restore(file: Path, text: str) -> None:
    if file.is_dir():
        file.rmdir()
    file.unlink(missing_ok=True)
    file.parent.mkdir(exist_ok=True)
    file.write_text(text)


@pytest.mark.parametrize("name", MANAGERS)
def test_a_configuration_that_is_wrong_at_the_moment_of_a_sigkill_ends_nothing(
    start: Callable[..., rr.System], tmp_path: Path, name: str
) -> None:
    kind, text = MANAGERS[name]
    file = tmp_path / "configuration" / ("given.json" if kind is Actions else "given.toml")
    restore(file, text)
    arguments: tuple[Any, ...] = ([Look], os.fspath(file.parent)) if kind is Actions else (os.fspath(file),)
    system = start(rr.Supervisor([rr.ChildSpec(kind, id="planner", args=arguments)], max_restarts=100))
    for wrong in WAYS:
        wrong(file)
        wait_respawned(system, "planner", kill(system, "planner"))
        restore(file, text)
    system.supervisor().terminate_child("planner")
    cut_in_half(file)
    with pytest.raises(rr.RrError, match=r"given\.(json|toml)"):  # somebody asks for this start
        system.supervisor().restart_child("planner")
    restore(file, text)
    system.supervisor().restart_child("planner")


def test_a_manager_that_goes_on_with_its_last_good_configuration_is_shown(
    start: Callable[..., rr.System], tmp_path: Path
) -> None:
    file = tmp_path / "pools.toml"
    file.write_text(POOLS)
    system = start(rr.Supervisor([rr.ChildSpec(Budgets, id="budgets", args=(os.fspath(file),))]))

    def shown(*verb: str) -> str:
        ran = run_cli(*verb, "--state", system.state_dir)
        assert ran.returncode == 0, ran.stderr
        return " ".join(ran.stdout.split())

    said = f"goes on with its last good configuration: {file}"
    assert "last good" not in shown("ps")
    file.write_text(POOLS.replace("100", '"much"'))
    wait_respawned(system, "budgets", kill(system, "budgets"))
    assert said in shown("ps")
    assert said in shown("ps", "--json")
    assert said in shown("status", "budgets")
    restore(file, POOLS)
    system.supervisor().terminate_child("budgets")
    system.supervisor().restart_child("budgets")
    assert "last good" not in shown("ps")
