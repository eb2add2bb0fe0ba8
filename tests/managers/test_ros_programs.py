"""The command that runs a node of ROS 2: where its package has it, what ROS is told, and what is not there."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors import ros2
from rr_actors.managers.ros.ros2_graph import check_domain
from rr_actors.managers.ros.ros_programs import program_of


@pytest.fixture
def prefix(tmp_path: Path) -> Path:
    """A prefix with the package `cameras`, which has two executables, and one without any."""
    index = tmp_path / "share" / "ament_index" / "resource_index" / "packages"
    index.mkdir(parents=True)
    for package in ("cameras", "camera_msgs"):
        (index / package).touch()
    folder = tmp_path / "lib" / "cameras"
    folder.mkdir(parents=True)
    for name, mode in (("front", 0o755), ("rear", 0o755), ("notes.txt", 0o644)):
        (folder / name).touch(mode)
    return tmp_path


def environment_of(*prefixes: Path) -> dict[str, str]:
    return {"AMENT_PREFIX_PATH": os.pathsep.join(map(str, prefixes))}


def test_an_executable_is_found_in_the_first_prefix_that_has_its_package(prefix: Path) -> None:
    request = ros2.RunNode("front", "camera", package="cameras")
    environment = environment_of(prefix / "another", prefix)
    assert program_of(request, 7, environment).command == str(prefix / "lib" / "cameras" / "front")


def test_ros_is_told_the_name_parameters_and_remappings() -> None:
    request = ros2.RunNode(
        "camera_program",
        "camera",
        namespace="/robot",
        arguments=("--fast",),
        parameters={"frame": "lens: 'é'", "on": True, "rate": 30.0, "sizes": [1, 2], "gain": float("inf")},
        parameter_file="camera.yaml",
        remappings={"image": "/front/image"},
        grace_s=1.0,
    )
    program = program_of(request, 7, {})
    words = " ".join(program.arguments)
    assert words.startswith("--fast --ros-args -r __node:=camera -r __ns:=/robot -r image:=/front/image")
    assert words.endswith(" --")
    assert "--params-file camera.yaml -p " in words
    for parameter in ("frame:=\"lens: 'é'\"", "on:=true", "rate:=30.0", "sizes:=[1, 2]", "gain:=.inf"):
        assert f"-p {parameter}" in words
    assert (program.command, program.stop_signal, program.grace_s) == ("camera_program", "SIGINT", 1.0)
    assert program.environment == {"ROS_DOMAIN_ID": "7"}


def test_two_nodes_of_one_executable_are_two_programs() -> None:
    first, second = (program_of(ros2.RunNode("camera_program", name), 0, {}) for name in ("left", "right"))
    assert first.instance != second.instance


@pytest.mark.parametrize(
    ("package", "executable", "path", "expected"),
    [
        ("camera", "front", "package", "did you mean 'cameras'"),
        ("cameras", "frnt", "executable", "front, rear; did you mean 'front'"),
        ("cameras", "notes.txt", "executable", "front, rear"),
        ("cameras", "../cameras/front", "executable", "front, rear"),
        ("camera_msgs", "front", "executable", "it has none"),
    ],
)
def test_what_is_not_there_is_named_with_what_is(
    prefix: Path, package: str, executable: str, path: str, expected: str
) -> None:
    with pytest.raises(rr.InvalidRequest) as caught:
        program_of(ros2.RunNode(executable, "camera", package=package), 0, environment_of(prefix))
    assert caught.value.path == path
    assert expected in str(caught.value)


def test_without_a_sourced_ros_the_error_says_what_to_do() -> None:
    with pytest.raises(rr.MissingDependency, match=r"AMENT_PREFIX_PATH is not set, so ROS is not sourced; run `source"):
        program_of(ros2.RunNode("front", "camera", package="cameras"), 0, {})


@pytest.mark.parametrize("given", ["robot", "-1", "233", "1.5"])
def test_a_domain_that_ros_does_not_have_is_an_error_before_ros_ends_the_process(given: str) -> None:
    with pytest.raises(rr.ConfigError, match="ROS_DOMAIN_ID: expected a whole number from 0 to 232") as caught:
        check_domain(given)
    assert caught.value.key == "ROS_DOMAIN_ID"


@pytest.mark.parametrize("given", ["", "0", " 7 ", "232"])
def test_a_domain_that_ros_has_is_none(given: str) -> None:
    check_domain(given)
