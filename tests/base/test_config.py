"""Configuration from code and from TOML: what it may be, and what the error says when it is something else."""

from __future__ import annotations

import dataclasses
import math
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr
from rr_actors.base.config import RegistrarConfig, SystemConfig
from rr_actors.base.errors import ConfigError


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "robot.toml"


def refused(made: Any) -> ConfigError:
    with pytest.raises(ConfigError) as caught:
        made()
    return caught.value


@dataclasses.dataclass
class PathOf(os.PathLike[Any]):
    """A path that is spelled in this way."""

    text: object

    def __fspath__(self) -> Any:
        if isinstance(self.text, Exception):
            raise self.text
        return self.text

    def __bool__(self) -> bool:
        raise RuntimeError("nobody may ask")


NO_PATHS = [PathOf(""), PathOf(b"bytes"), PathOf(7), PathOf(RuntimeError("nowhere"))]


# -- from code -----------------------------------------------------------------------------------------------------


def test_a_registrars_defaults_are_those_of_the_thesis() -> None:
    assert RegistrarConfig() == RegistrarConfig(
        name="untitled",
        location=None,
        save_interval_s=60.0,
        save_on_modify=True,
        erase_on_destruct=False,
        durability="process",
        on_damage="refuse",
    )


def test_a_systems_defaults() -> None:
    config = SystemConfig()
    assert (config.frame_limit_bytes, config.mailbox_limit, config.workers_limit) == (16 * 2**20, 100_000, 4096)
    assert (config.ask_timeout_s, config.start_timeout_s, config.stop_timeout_s) == (30.0, 30.0, 10.0)
    assert (config.preload, config.durability, config.registrars) == ((), "process", {})
    assert (config.console, config.connections_limit) == (True, 128)


REGISTRAR_MISTAKES = [
    ("name", "two words", "1 to 64 ASCII letters"),
    ("name", 7, "1 to 64 ASCII letters"),
    ("location", 7, "a directory's path"),
    ("location", "", "a directory's path"),
    *(("location", path, "a directory's path") for path in NO_PATHS),
    ("location", PathOf("a\0b"), "a directory's path"),
    ("save_interval_s", "60", "a number of seconds greater than 0"),
    ("save_interval_s", 0, "a number of seconds greater than 0"),
    ("save_interval_s", True, "a number of seconds greater than 0"),
    ("save_interval_s", math.inf, "a number of seconds greater than 0"),
    ("save_interval_s", math.nan, "a number of seconds greater than 0"),
    ("save_on_modify", 1, "true or false"),
    ("erase_on_destruct", "no", "true or false"),
    ("durability", "fsync", '"process" or "power" or "none"'),
    ("durability", None, '"process" or "power" or "none"'),
    ("on_damage", ["aside"], '"refuse" or "aside"'),
]
SYSTEM_MISTAKES = [
    ("frame_limit_bytes", 1.5, "a whole number greater than 0"),
    ("mailbox_limit", 0, "a whole number greater than 0"),
    ("workers_limit", True, "a whole number greater than 0"),
    ("connections_limit", 0, "a whole number greater than 0"),
    ("ask_timeout_s", -1, "a number of seconds greater than 0"),
    ("start_timeout_s", None, "a number of seconds greater than 0"),
    ("stop_timeout_s", "10", "a number of seconds greater than 0"),
    ("preload", "numpy", "a list of module names"),
    ("preload", [1], "a list of module names"),
    ("durability", "disk", '"process" or "power" or "none"'),
    ("registrars", [], "a mapping from registrar names to RegistrarConfig"),
    ("registrars", {"cameras": {}}, "a mapping from registrar names to RegistrarConfig"),
    ("registrars", {"two words": RegistrarConfig()}, "a mapping from registrar names to RegistrarConfig"),
]


@pytest.mark.parametrize(("key", "got", "expected"), REGISTRAR_MISTAKES)
def test_a_wrong_value_for_a_registrar_is_refused_where_it_is_made(key: str, got: Any, expected: str) -> None:
    error = refused(lambda: RegistrarConfig(**{key: got}))
    assert str(error).startswith(f"RegistrarConfig: {key}: expected ")
    assert expected in str(error)
    assert (error.details["key"], error.details["file"]) == (key, None)
    assert repr(got) in str(error)


@pytest.mark.parametrize(("key", "got", "expected"), SYSTEM_MISTAKES)
def test_a_wrong_value_for_a_system_is_refused_where_it_is_made(key: str, got: Any, expected: str) -> None:
    error = refused(lambda: SystemConfig(**{key: got}))
    assert str(error).startswith(f"SystemConfig: {key}: expected {expected}, got {got!r}")
    assert error.details["expected"] == expected


def test_a_configuration_cannot_be_changed_and_travels_to_other_processes() -> None:
    config = SystemConfig(preload=["json"], registrars={"cameras": RegistrarConfig(location=Path("x"))})  # type: ignore[arg-type]
    assert config.preload == ("json",)
    assert pickle.loads(pickle.dumps(config)) == config
    with pytest.raises(dataclasses.FrozenInstanceError):
        config.mailbox_limit = 1  # type: ignore[misc]


def test_a_catalog_is_below_the_state_directory_unless_its_location_is_elsewhere() -> None:
    assert RegistrarConfig(name="cameras").catalog_path("/state") == Path("/state/cameras/catalog.sqlite3")
    assert RegistrarConfig(location="disk2").catalog_path("/state") == Path("/state/disk2/catalog.sqlite3")
    assert RegistrarConfig(location=PathOf("disk2")).catalog_path("/state") == Path("/state/disk2/catalog.sqlite3")
    assert RegistrarConfig(location=Path("/ssd/c")).catalog_path(Path("/state")) == Path("/ssd/c/catalog.sqlite3")


def test_a_tilde_in_a_location_is_the_users_home(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert RegistrarConfig(location="~/c").catalog_path("/state") == tmp_path / "c/catalog.sqlite3"
    assert RegistrarConfig(location="./~").catalog_path("/state") == Path("/state/~/catalog.sqlite3")
    with pytest.raises(ConfigError, match="location: expected a directory's path, got '~nobody-of-that-name/c'"):
        RegistrarConfig(location="~nobody-of-that-name/c")


def test_a_registrar_that_is_not_named_has_the_systems_durability() -> None:
    config = SystemConfig(durability="power", registrars={"cameras": RegistrarConfig(save_on_modify=False)})
    assert config.registrar("hub") == RegistrarConfig(name="hub", durability="power")
    assert config.registrar("cameras") == RegistrarConfig(name="cameras", save_on_modify=False)


# -- from TOML -----------------------------------------------------------------------------------------------------


def test_a_registrars_file_gives_what_it_names_and_defaults_for_the_rest(file: Path) -> None:
    file.write_text(
        'name = "cameras"\nlocation = "/ssd"\nsave_interval_s = 5\nsave_on_modify = false\n'
        'erase_on_destruct = true\ndurability = "power"\non_damage = "aside"\n'
    )
    assert RegistrarConfig.from_toml(file) == RegistrarConfig(
        name="cameras",
        location="/ssd",
        save_interval_s=5,
        save_on_modify=False,
        erase_on_destruct=True,
        durability="power",
        on_damage="aside",
    )
    file.write_text("")
    assert RegistrarConfig.from_toml(str(file)) == RegistrarConfig()


def test_a_systems_file_has_a_table_for_each_registrar(file: Path) -> None:
    file.write_text(
        'mailbox_limit = 50\npreload = ["numpy"]\ndurability = "power"\n'
        "[registrars.cameras]\nsave_interval_s = 10\n"
        '[registrars.hub]\nname = "hub"\ndurability = "process"\n'
    )
    assert SystemConfig.from_toml(file) == SystemConfig(
        mailbox_limit=50,
        preload=("numpy",),
        durability="power",
        registrars={
            "cameras": RegistrarConfig(name="cameras", save_interval_s=10, durability="power"),
            "hub": RegistrarConfig(name="hub"),
        },
    )


TOML_MISTAKES = [
    ("save_interval = 5", "save_interval", "'save_interval_s'"),
    ("Durability = 'power'", "Durability", "'durability'"),
    ("colour = 5", "colour", "expected one of name, location, save_interval_s"),
    ("save_interval_s = '5'", "save_interval_s", "expected a number of seconds greater than 0, got '5' (str)"),
    ("save_on_modify = 1", "save_on_modify", "expected true or false, got 1 (int)"),
    ("location = ['a']", "location", "expected a directory's path, got ['a'] (list)"),
    ("durability = 'fsync'", "durability", 'expected "process" or "power" or "none", got \'fsync\' (str)'),
    ("[name]\nfirst = 1", "name", "expected a name: 1 to 64 ASCII letters"),
]


@pytest.mark.parametrize(("text", "key", "says"), TOML_MISTAKES)
def test_a_mistake_in_a_registrars_file_is_named_with_file_key_expected_and_got(
    file: Path, text: str, key: str, says: str
) -> None:
    file.write_text(text)
    error = refused(lambda: RegistrarConfig.from_toml(file))
    assert str(error).startswith(f"{file}: {key}: expected ")
    assert says in str(error)
    assert (error.details["file"], error.details["key"]) == (str(file), key)


SYSTEM_TOML_MISTAKES = [
    ("mailbox = 5", "mailbox", "did you mean 'mailbox_limit'?"),
    ("ask_timeout_s = true", "ask_timeout_s", "expected a number of seconds greater than 0, got True (bool)"),
    ("preload = 'numpy'", "preload", "expected a list of module names, got 'numpy' (str)"),
    ("registrars = 3", "registrars", "expected tables [registrars.NAME], got 3 (int)"),
    ("[registrars]\ncameras = 3", "registrars.cameras", "expected a table [registrars.cameras], got 3 (int)"),
    ("[registrars.'a b']", "registrars.a b", "expected a name: 1 to 64 ASCII letters"),
    ("[registrars.cam]\nsave_intervall_s = 1", "registrars.cam.save_intervall_s", "did you mean 'save_interval_s'?"),
    ("[registrars.cam]\nsave_interval_s = -1", "registrars.cam.save_interval_s", "greater than 0, got -1 (int)"),
    ("[registrars.cam]\nname = 'hub'", "registrars.cam.name", "expected 'cam', as the table is called, got 'hub'"),
]


@pytest.mark.parametrize(("text", "key", "says"), SYSTEM_TOML_MISTAKES)
def test_a_mistake_in_a_systems_file_is_named_with_file_key_expected_and_got(
    file: Path, text: str, key: str, says: str
) -> None:
    file.write_text(text)
    error = refused(lambda: SystemConfig.from_toml(file))
    assert str(error).startswith(f"{file}: {key}: expected ")
    assert says in str(error)
    assert (error.details["file"], error.details["key"]) == (str(file), key)


@pytest.mark.parametrize(
    ("data", "line"),
    [
        (b"name = 'a'\nsave_interval_s = = 3\n", "line 2"),
        (b"name = 'a'\nname = 'b'\n", "line 2"),
        (b"name = 'a'\nlocation = [", "line 2, end of the file"),
        (b"name = 'a'\n\nlocation = '\xff'\n", "line 3"),
    ],
)
def test_a_file_that_is_not_toml_is_refused_with_its_line(file: Path, data: bytes, line: str) -> None:
    file.write_bytes(data)
    for read in (RegistrarConfig.from_toml, SystemConfig.from_toml):
        error = refused(lambda read=read: read(file))
        assert str(error).startswith(f"{file}: not valid TOML: ")
        assert f"(at {line}" in str(error)
        assert error.details["file"] == str(file)


def test_a_file_that_cannot_be_read_is_refused_by_name(file: Path, tmp_path: Path) -> None:
    for path in (file, tmp_path):
        error = refused(lambda path=path: SystemConfig.from_toml(path))
        assert str(error).startswith(f"{path}: cannot be read: ")
        assert error.details["file"] == os.fspath(path)


def test_a_configuration_without_a_name_is_that_of_the_registrar_it_is_given_to(state_dir: Path) -> None:
    with rr.System(state_dir=state_dir) as system:
        for name in ("a", "b"):
            registrar = system.open_registrar(name, rr.RegistrarConfig(save_interval_s=5))
            assert registrar.directory == state_dir / name
            assert registrar.config == rr.RegistrarConfig(name=name, save_interval_s=5)
        with pytest.raises(rr.ConfigError, match=r"RegistrarConfig: name: expected 'c', .* got 'a' \(str\)") as caught:
            system.open_registrar("c", rr.RegistrarConfig(name="a"))
        assert (caught.value.key, caught.value.got) == ("name", "a")
        wrong: Any = "c"
        with pytest.raises(rr.ConfigError, match=r"open_registrar\('c'\): config: expected a RegistrarConfig, got str"):
            system.open_registrar("c", wrong)
        assert system.open_registrar("c", rr.RegistrarConfig(name="c")).directory == state_dir / "c"


def test_a_path_that_no_file_can_have_is_refused_where_it_is_given() -> None:
    with pytest.raises(ConfigError, match="location: expected a directory's path"):
        RegistrarConfig(location="a\0b")
    with pytest.raises(ConfigError, match="cannot be read: embedded null byte"):
        RegistrarConfig.from_toml("a\0b")
    with pytest.raises(ConfigError, match="state_dir: expected a directory's path"):
        rr.System(state_dir="a\0b")


@pytest.mark.parametrize("path", [None, 3, b"app.toml", ["app.toml"], "", *NO_PATHS])
@pytest.mark.parametrize("read", [RegistrarConfig.from_toml, SystemConfig.from_toml, rr.Supervisor.from_toml])
def test_what_is_no_path_is_refused_by_name(read: Callable[[Any], object], path: object) -> None:
    error = refused(lambda: read(path))
    assert (error.key, error.expected, error.got) == ("path", "the path of a TOML file", path)
