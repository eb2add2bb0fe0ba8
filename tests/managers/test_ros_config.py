"""What a bridge exposes, as its file says it: each fault is named, with its key, and what was expected and got."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import rr_actors as rr
from rr_actors import ros2

GOOD = """
[[switch]]
name = "front_camera"
server = "cameras/camera"
request = { device = "/dev/video0" }

[[switch]]
name = "arm/gripper"
server = "arms/gripper"
priority = 7

[json]
allow = ["cameras/*"]
max_priority = 5
"""


def switch(name: str = '"lamp"', server: str = '"lamps/lamp"', more: str = "") -> str:
    return f"[[switch]]\nname = {name}\nserver = {server}\n{more}\n"


def test_a_file_says_what_is_exposed(tmp_path: Path) -> None:
    (tmp_path / "ros.toml").write_text(GOOD)
    assert ros2.Bridge(tmp_path / "ros.toml") is not None


@pytest.mark.parametrize(
    ("text", "key", "expected", "got"),
    [
        ("", "", "a [[switch]] or [json]", "neither"),
        (switch('"1st"'), "switch[0].name", "ASCII letters", "'1st'"),
        (switch('"/lamp"'), "switch[0].name", "ASCII letters", "'/lamp'"),
        (switch('"lamp__a"'), "switch[0].name", "ASCII letters", "'lamp__a'"),
        (switch() * 2, "switch[1].name", "a name whose topics no other part of the bridge has", "'lamp'"),
        (switch(server='"lamps"'), "switch[0].server", "'registrar/server'", "'lamps'"),
        (switch(more="priority = 2000"), "switch[0].priority", "<= 1000", "2000"),
        (switch(more="requst = 1"), "switch[0].requst", "one of name, server, request, priority", "request"),
        ("[[switch]]\nname = 'a'", "switch[0]", "the key server", "none"),
        ("[json]\nallow = []", "json.allow", "at least one server", "none"),
        ("[json]\nallow = ['cameras']", "json.allow[0]", "'registrar/server', in which * stands", "'cameras'"),
        ("[json]\nallow = ['a/b']\nnamespace = 'rr'", "json.namespace", "'/' and ASCII letters", "'rr'"),
        (switch('"rr"') + "[json]\nallow = ['a/b']", "switch[0].name", "a name whose topics no other", "'rr'"),
    ],
)
def test_what_is_wrong_in_the_file_is_named(tmp_path: Path, text: str, key: str, expected: str, got: str) -> None:
    file = tmp_path / "ros.toml"
    file.write_text(text)
    with pytest.raises(rr.ConfigError) as caught:
        ros2.Bridge(file)
    assert (caught.value.file, caught.value.key) == (str(file), key)
    assert expected in str(caught.value.expected)
    assert got in str(caught.value)


def test_all_faults_of_a_file_are_in_one_error(tmp_path: Path) -> None:
    file = tmp_path / "ros.toml"
    file.write_text(switch('"1st"', '"lamps"') + "[json]\nallow = ['cameras']")
    with pytest.raises(rr.ConfigError, match="3 faults") as caught:
        ros2.Bridge(file)
    assert all(key in str(caught.value) for key in ("json.allow[0]", "switch[0].name", "switch[0].server"))


def test_arguments_are_checked_as_a_file_is() -> None:
    with pytest.raises(rr.ConfigError, match=r"Bridge: switch\[0\].server: expected 'registrar/server', got 'lamps'"):
        ros2.Bridge(switches=[ros2.Switch("lamp", "lamps")])
    with pytest.raises(rr.UsageError, match="expected a file, or switches and json, got both"):
        ros2.Bridge("ros.toml", json=ros2.Json(allow=("a/b",)))


def test_without_ros_the_error_says_what_to_install(
    rr_system: Callable[..., rr.System], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)  # an import of it fails
    spec = rr.ChildSpec(ros2.Bridge, id="ros", kwargs={"json": ros2.Json(allow=("a/b",))}, placement="thread")
    with pytest.raises(rr.StartFailed, match="source /opt/ros/DISTRIBUTION/setup") as caught:
        rr_system([spec])
    cause = caught.value.__cause__
    assert isinstance(cause, ros2.MissingDependency)
    assert cause.module == "rclpy"
    assert cause.install.startswith("ROS is not sourced")
