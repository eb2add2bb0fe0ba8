"""The robot manager: a robot from its description, its parts replaced when they fail."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors.managers import Components, LoadRobot, Programs, Robots
from rr_actors.managers.robots import read_robots
from support import Calls, eventually, kill, wait_respawned
from support_programs import running_programs

Start = Callable[..., rr.System]

ROBOTS = """
[[robot]]
name = "rover"
driver = { type = "driver", parameters = { wheels = 4 } }
controller = { type = "pilot" }
sensors = [{ type = "lidar" }, { type = "lidar" }]

[[robot]]
name = "cart"
driver = { type = "driver", parameters = { wheels = "${wheels}" } }
"""
COMPONENT = """
[[component]]
name = "{name}"
type = "{type}"
parameters = {parameters}
[component.program]
command = "${{python}}"
arguments = ["-u", "-c", "import time; print('ready'); time.sleep(600)"]
ready = {{ line = "ready", timeout_s = 5 }}
grace_s = 1
"""
COMPONENTS = "".join(
    COMPONENT.format(name=f"a-{type}", type=type, parameters=parameters)
    for type, parameters in (("driver", '{ motors = "${wheels}" }'), ("pilot", "{}"), ("lidar", "{}"))
)


@pytest.fixture
def begin(start: Start, tmp_path: Path) -> Callable[..., tuple[rr.System, rr.Registrar]]:
    def begin(**options: dict[str, object]) -> tuple[rr.System, rr.Registrar]:
        (tmp_path / "components.toml").write_text(COMPONENTS)
        (tmp_path / "robots.toml").write_text(ROBOTS)
        components = {"registry": str(tmp_path / "components.toml"), **options.get("components", {})}
        robots = {"descriptions": str(tmp_path / "robots.toml"), **options.get("robots", {})}
        system = start(
            rr.ChildSpec(Programs, id="programs"),
            rr.ChildSpec(Components, id="components", kwargs=components),
            rr.ChildSpec(Robots, id="robots", kwargs=robots),
        )
        return system, system.open_registrar("app")

    return begin


Begin = Callable[..., tuple[rr.System, rr.Registrar]]


def test_a_robot_has_the_parts_of_its_description(begin: Begin) -> None:
    _, app = begin()
    with app.load("robots/robot", LoadRobot("rover")) as rover:
        robot = rover.response
        assert robot.driver.name == "a-driver"
        assert robot.driver.parameters["motors"] == "4"
        assert robot.controller.name == "a-pilot"
        assert [sensor.name for sensor in robot.sensors] == ["a-lidar", "a-lidar"]
        pids = {robot.driver.pid, robot.controller.pid, *(sensor.pid for sensor in robot.sensors)}
        assert set(running_programs()) == pids
        assert len(pids) == 4
    assert not running_programs()


def test_robots_share_no_part_whatever_they_are_called(begin: Begin, tmp_path: Path) -> None:
    twin = '[[robot]]\nname = "rover-2"\ndriver = { type = "pilot" }\nsensors = [{ type = "lidar" }]\n'
    (tmp_path / "twins.toml").write_text(ROBOTS + twin)
    _, app = begin(robots={"descriptions": str(tmp_path / "twins.toml")})
    with app.load("robots/robot", LoadRobot("rover")) as rover, app.load("robots/robot", LoadRobot("rover-2")) as other:
        pids = {sensor.pid for sensor in (*rover.response.sensors, *other.response.sensors)}
        assert len(pids) == 3


def test_parameters_of_the_request_reach_the_parts(begin: Begin) -> None:
    _, app = begin()
    with app.load("robots/robot", LoadRobot("cart", {"wheels": 3})) as cart:
        assert cart.response.driver.parameters["motors"] == "3"
        assert cart.response.controller is None
        assert cart.response.sensors == []


def test_an_unknown_robot_is_an_error_that_names_the_known_ones(begin: Begin) -> None:
    _, app = begin()
    with pytest.raises(rr.LoadFailed, match=r"no robot 'plane'.*expected one of rover, cart"):
        app.load("robots/robot", LoadRobot("plane"))


def test_a_driver_that_fails_is_restarted_and_the_robots_holders_hear_update(begin: Begin) -> None:
    _, app = begin()
    heard = Calls()
    with app.load("robots/robot", LoadRobot("rover"), on_status=heard) as rover:
        before = rover.response
        os.kill(before.driver.pid, signal.SIGKILL)
        (status,) = heard.wait()
        assert status.state is rr.State.UPDATE
        assert rover.response.driver.pid != before.driver.pid
        assert rover.response.controller == before.controller
        assert rover.response.sensors == before.sensors
    assert len(heard) == 1
    assert not running_programs()


def test_a_part_the_component_manager_gives_up_is_loaded_again_by_the_robot_manager(begin: Begin) -> None:
    _, app = begin(components={"replace": False})
    heard = Calls()
    with app.load("robots/robot", LoadRobot("rover"), on_status=heard) as rover:
        before = rover.response
        os.kill(before.sensors[1].pid, signal.SIGKILL)
        (status,) = heard.wait()
        assert status.state is rr.State.UPDATE
        assert rover.response.sensors[1].pid != before.sensors[1].pid
        assert rover.response.sensors[0] == before.sensors[0]
        eventually(lambda: len(running_programs()) == 4)
    assert not running_programs()


def test_without_any_replacement_the_holders_hear_fatal(begin: Begin) -> None:
    _, app = begin(components={"replace": False}, robots={"replace": False})
    with app.load("robots/robot", LoadRobot("rover")) as rover:
        os.kill(rover.response.driver.pid, signal.SIGKILL)
        assert rover.wait_status(timeout_s=10).state is rr.State.FATAL


def test_a_robot_lives_on_while_each_of_its_managers_is_killed(begin: Begin) -> None:
    system, app = begin()
    with app.load("robots/robot", LoadRobot("rover")) as rover:
        before = rover.response
        for manager in ("programs", "components", "robots"):
            wait_respawned(system, manager, kill(system, manager))
        assert rover.response == before
        os.kill(before.driver.pid, signal.SIGKILL)
        rover.wait_status(rr.State.UPDATE, timeout_s=10)
        assert rover.response.driver.pid != before.driver.pid
    assert not running_programs()


def test_a_replacement_is_heard_of_once_also_when_the_managers_are_killed_afterwards(begin: Begin) -> None:
    system, app = begin()
    heard = Calls()
    with app.load("robots/robot", LoadRobot("rover"), on_status=heard) as rover:
        os.kill(rover.response.driver.pid, signal.SIGKILL)
        heard.wait()
        driver = rover.response.driver
        for manager in ("programs", "components", "robots"):
            wait_respawned(system, manager, kill(system, manager))
        os.kill(driver.pid, signal.SIGKILL)  # the next thing to be heard of
        heard.wait(2)
        assert rover.response.driver != driver
    assert len(heard) == 2


@pytest.mark.parametrize(
    ("text", "key", "says"),
    [
        ("[[robot]]\nname = 'a'\n", "robot[0]", "driver"),
        ("[[robot]]\nname = 'a'\ndriver = 'x'\n", "robot[0].driver", "expected a table, got 'x' (str)"),
        ("[[robot]]\nname = 'a'\ndriver = { kind = 'x' }\n", "robot[0].driver.kind", "one of type, parameters"),
        (ROBOTS + ROBOTS, "robot[2].name", "'rover' again"),
    ],
)
def test_a_wrong_description_is_an_error_with_file_and_key(tmp_path: Path, text: str, key: str, says: str) -> None:
    path = tmp_path / "robots.toml"
    path.write_text(text)
    with pytest.raises(rr.ConfigError) as caught:
        read_robots(path)
    assert says in str(caught.value)
    assert caught.value.details["key"] == key
    assert caught.value.details["file"] == str(path)
