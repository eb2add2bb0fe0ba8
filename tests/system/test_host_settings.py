"""The settings for other hosts, in Python and in a TOML file: what is wrong is named with its file, key and value."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import rr_actors as rr
from support import TEST_PATHS
from support_cli import run_cli
from support_hosts import Cameras, endpoint

LIMIT_S = 150.0

TREE = """
id = "robot"

[[children]]
actor = "support_hosts:Cameras"
id = "cameras"
"""

HOSTS = """
[hosts]
name = "hostb"
listen = ["{listen}"]

[hosts.exports.cameras]
to = ["hosta"]

[hosts.routes]
maps = "hosta/maps"
"""


@pytest.mark.parametrize(
    ("wrong", "field"),
    [
        ({"name": "a/b"}, "name"),
        ({"listen": ["tcp/0.0.0.0:7447"]}, "listen"),
        ({"listen": "tcp/127.0.0.1:7447"}, "listen"),
        ({"connect": ["tls/hostb:7447"]}, "connect"),
        ({"listen": []}, "listen"),
        ({"exports": ["cameras"]}, "exports"),
        ({"exports": {"cameras": None}}, "exports['cameras']"),
        ({"routes": {"maps": "maps"}}, "routes['maps']"),
        ({"routes": {"maps": "hosta/maps"}}, "routes['maps']"),
        ({"routes": {"maps": 7}}, "routes['maps']"),
        ({"group": ""}, "group"),
    ],
)
def test_wrong_settings_name_the_field(wrong: dict[str, object], field: str) -> None:
    given: dict[str, object] = {"name": "hosta", "listen": ["tcp/127.0.0.1:7447"], **wrong}
    with pytest.raises(rr.InvalidSpec) as raised:
        rr.Hosts(**given)  # pyright: ignore[reportArgumentType]
    assert raised.value.field == field


def test_a_root_that_would_restart_others_with_the_gateway_is_refused() -> None:
    hosts = rr.Hosts("hosta", listen=["tcp/127.0.0.1:7447"])
    root = rr.Supervisor([rr.ChildSpec(Cameras, id="cameras")], strategy="one_for_all")
    with pytest.raises(rr.InvalidSpec) as raised:
        rr.System(root, hosts=hosts)
    assert raised.value.field == "root.strategy"
    with pytest.raises(rr.InvalidSpec, match=r"rr\.Hosts"):
        rr.System([], hosts="hosta")  # pyright: ignore[reportArgumentType]


def test_the_settings_are_read_from_the_file_of_a_tree_or_of_a_configuration(tmp_path: Path) -> None:
    expected = rr.Hosts(
        "hostb",
        listen=["tcp/127.0.0.1:7447"],
        exports={"cameras": rr.Export(to=["hosta"])},
        routes={"maps": "hosta/maps"},
    )
    settings = HOSTS.format(listen="tcp/127.0.0.1:7447")
    tree, config = tmp_path / "robot.toml", tmp_path / "config.toml"
    tree.write_text(TREE + settings)
    config.write_text("mailbox_limit = 9\n" + settings)
    assert rr.Hosts.from_toml(tree) == rr.Hosts.from_toml(config) == expected
    assert [child.id for child in rr.Supervisor.from_toml(tree).child_specs] == ["cameras"]
    assert rr.SystemConfig.from_toml(config).mailbox_limit == 9


@pytest.mark.parametrize(
    ("text", "key", "expected"),
    [
        ("", "hosts", "a table [hosts]"),
        ("hosts = 3", "hosts", "a table [hosts]"),
        ("[hosts]\nlisten = []", "hosts.name", "the name of this host"),
        ("[hosts]\nname = 7", "hosts.name", "the name of a host"),
        ("[hosts]\nname = 'a'", "hosts.listen", "an endpoint in listen or in connect, or no host is ever reached"),
        ("[hosts]\nname = 'a'\nlisten = ['tcp/0.0.0.0:1']", "hosts.listen", "not encrypted yet"),
        (
            "[hosts]\nname = 'a'\nexport = {}",
            "hosts.export",
            "one of name, listen, connect, exports, routes, lease_s, group",
        ),
        ("[hosts]\nname = 'a'\nexports = ['cameras']", "hosts.exports", "tables [hosts.exports.NAME]"),
        ("[hosts]\nname = 'a'\nexports.cameras = 1", "hosts.exports.cameras", "a table, such as { to = ['hostb'] }"),
        ("[hosts]\nname = 'a'\nexports.cameras.too = []", "hosts.exports.cameras.too", "one of to, on_lost"),
        ("[hosts]\nname = 'a'\nexports.cameras.on_lost = 'x'", "hosts.exports.cameras.on_lost", "'keep' or 'release'"),
        ("[hosts]\nname = 'a'\nlease_s = 0", "hosts.lease_s", "a number from 1 to 3600"),
        ("[hosts]\nname = 'a'\nlease_s = true", "hosts.lease_s", "a number from 1 to 3600"),
        ("[hosts]\nname = 'a'\nexports.cameras.to = 'b'", "hosts.exports.cameras.to", "a list of host names"),
        ("[hosts]\nname = 'a'\nexports.cameras.to = ['b/']", "hosts.exports.cameras.to", "the name of a host"),
        ("[hosts]\nname = 'a'\nlisten = ['tcp/[::1]:1']\nroutes.maps = 'maps'", "hosts.routes.maps", "host/registrar"),
        ("[hosts]\nname = 'a'\nroutes = []", "hosts.routes", "a table of registrars and 'host/registrar'"),
    ],
)
def test_what_is_wrong_in_a_file_is_named_with_file_and_key(tmp_path: Path, text: str, key: str, expected: str) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(text)
    with pytest.raises(rr.ConfigError) as raised:
        rr.Hosts.from_toml(file)
    assert (raised.value.file, raised.value.key) == (str(file), key)
    assert expected in (raised.value.expected or "")
    assert f"{file}: {key}: expected" in str(raised.value)


def test_a_fault_of_toml_is_named_with_its_line(tmp_path: Path) -> None:
    file = tmp_path / "robot.toml"
    file.write_text("[hosts]\nname = 'a'\nlisten = [\n")
    with pytest.raises(rr.ConfigError, match=r"not valid TOML: .*line"):
        rr.Hosts.from_toml(file)


def test_verify_finds_what_is_wrong_and_two_tables_are_one_too_many(tmp_path: Path) -> None:
    tree, config = tmp_path / "robot.toml", tmp_path / "config.toml"
    tree.write_text(TREE + HOSTS.format(listen="tcp/127.0.0.1:7447"))
    config.write_text("[hosts]\nname = 'a'\n")
    assert run_cli("verify", tree).returncode == 0
    ran = run_cli("verify", tree, "--config", config)
    assert ran.returncode != 0
    assert f"{config}: hosts: expected one table [hosts], as {tree} has one, got a second one" in ran.stderr
    tree.write_text(TREE + HOSTS.format(listen="tcp/10.0.0.1:7447"))
    assert "hosts.listen: expected an endpoint on loopback" in run_cli("verify", tree).stderr


@pytest.mark.timeout(300)
def test_run_joins_the_group_that_the_file_names(tmp_path: Path) -> None:
    listen = endpoint()
    (tmp_path / "robot.toml").write_text(TREE + HOSTS.format(listen=listen))
    (tmp_path / "config.toml").write_text("start_timeout_s = 120.0\nstop_timeout_s = 60.0\n")  # for a busy machine
    where = ["--config", "config.toml", "--state", "b", "--log", "error"]
    command = [sys.executable, "-m", "rr_actors", "run", "robot.toml", *where]
    other = subprocess.Popen(command, cwd=tmp_path, env=os.environ | {"PYTHONPATH": TEST_PATHS})
    try:
        hosts = rr.Hosts("hosta", connect=[listen], routes={"cameras": "hostb/cameras"})
        with rr.System([], state_dir=tmp_path / "a", hosts=hosts) as a:
            camera = a.open_registrar("app").load("cameras/camera", "front", timeout_s=LIMIT_S)
            assert camera.server_id == "hostb/cameras/camera"
            camera.unload(timeout_s=LIMIT_S)
    finally:
        other.terminate()
        assert other.wait(LIMIT_S) == 0
