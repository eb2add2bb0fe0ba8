"""Configuration of a registrar and of a system: from code, or from a TOML file.

Both are checked when they are made, so a wrong value is reported where it is written, not where it is used. A TOML file
for a system has a table for each registrar that differs from the defaults::

    frame_limit_bytes = 16777216
    durability = "process"

    [registrars.cameras]
    durability = "power"
    save_interval_s = 10
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self, TypeGuard, cast

import msgspec

from rr_actors.base.checks import has_home, is_number, path_text
from rr_actors.base.errors import InvalidName
from rr_actors.base.names import NAME_RULE, check_name
from rr_actors.base.toml import check_keys, file_name, read_toml, wrong

Durability = Literal["process", "power", "none"]
OnDamage = Literal["refuse", "aside"]
CATALOG_FILE = "catalog.sqlite3"
_UNTITLED = "untitled"


@dataclass(frozen=True)
class RegistrarConfig:
    """The configuration of one registrar and its catalog (the first five attributes are the thesis's properties).

    Attributes:
        name: the registrar's name. Default: "untitled", which every name replaces. Set it in a file, so that no other
            registrar uses the file.
        location: the directory of the catalog; a relative one is below the system's state_dir, and "~" is the user's
            home. Default: None, the name. Set it to keep a catalog on another disk.
        save_interval_s: the seconds between two saves, with save_on_modify off. Default: 60.0. Lower it to lose less at
            a crash.
        save_on_modify: write each change before it is acknowledged. Default: True. Turn it off where speed matters
            more: a crash then loses the changes since the last save.
        erase_on_destruct: remove the catalog when the registrar is closed for good, and owes no release to a provider
            that is down. Default: False. Turn it on for a registrar that runs once, such as a script's.
        durability: what a change survives. "process": SIGKILL. "power": a power cut (fsync before the answer). "none":
            nothing, for benchmarks. Default: "process". Set "power" where power may fail while resources outlive it.
        on_damage: "refuse" a damaged or foreign catalog, or rename it and start empty ("aside"). Default: "refuse". Set
            "aside" where nobody is there to repair it, and a start matters more than what was held.
        max_priority: the highest priority that a load of this registrar may have; the parts of its resources inherit no
            higher one. Default: 1000, as for all. Lower it for a registrar whose loads must not come before others.

    Raises:
        ConfigError: a value is of the wrong type or out of range. `.key`, `.expected`, `.got`
    """

    name: str = _UNTITLED
    location: str | os.PathLike[str] | None = None
    save_interval_s: float = 60.0
    save_on_modify: bool = True
    erase_on_destruct: bool = False
    durability: Durability = "process"
    on_damage: OnDamage = "refuse"
    max_priority: int = 1000

    def __post_init__(self) -> None:
        _check_fields(self, _REGISTRAR_RULES)

    @classmethod
    def from_toml(cls, path: str | os.PathLike[str]) -> Self:
        """Read a configuration from a TOML file whose keys are the attributes above.

        Raises:
            ConfigError: the file cannot be read, is not TOML, or has an unknown key or a wrong value. `.file`, `.key`,
                `.expected`, `.got`
        """
        file = file_name(path)
        return cls(**_checked_table(read_toml(file), _REGISTRAR_RULES, file))

    def catalog_path(self, state_dir: str | os.PathLike[str]) -> Path:
        """Return the catalog's file below the system's state directory."""
        location = self.name if self.location is None else self.location
        return Path(state_dir, os.path.expanduser(location), CATALOG_FILE)


def called(config: RegistrarConfig, name: str) -> RegistrarConfig:
    """Return the configuration for the registrar `name`; raise ConfigError if `config` is another registrar's."""
    if config.name not in (name, _UNTITLED):
        expected = f"{name!r}, as the registrar is called, or none"
        raise wrong(None, "name", expected, config.name, where=type(config).__name__)
    return config if config.name == name else dataclasses.replace(config, name=name)


@dataclass(frozen=True)
class SystemConfig:
    """Limits and defaults of a system, the same in all its processes.

    Attributes:
        frame_limit_bytes: the size of the largest message on the connection between two processes. The sender refuses
            a larger one. Values of 192 KiB and more that actors send go through shared memory instead, and have no such
            limit. Default: 16,777,216. Raise it where there is no shared memory.
        segments_limit_bytes: the shared memory that one process may use for the large values that it sends. Default:
            None, a quarter of the machine's memory. Lower it if others need the memory; 0: use none.
        mailbox_limit: the loads that one registrar may have in flight before MailboxFull. An actor's class has its own.
            Default: 100,000. Lower it to hear earlier that a provider is too slow.
        ask_timeout_s: seconds that an `ask` without a timeout waits for its answer. Default: 30.0. Raise it if handlers
            take longer.
        start_timeout_s: seconds that a child has until its on_start has returned. Default: 30.0. Raise it for slow
            imports or devices; for one child, use ChildSpec.start_timeout_s.
        stop_timeout_s: seconds that a `System.stop` without a timeout takes before it kills. Default: 10.0. Lower it
            below the patience of your service manager; raise it for slow unload callbacks.
        workers_limit: the callbacks that may run at once in one process. Each has a thread. Default: 4096. Lower it
            where threads are scarce; more callbacks wait then.
        preload: modules that the fork server imports once for all children. What they register with atexit then runs
            when the fork server ends, not in each child. Default: (), none. Name those that take long to import.
        logging: whether records that child processes log reach the application's loggers of the same names. A child
            whose code configures handlers of its own, say by logging.basicConfig, keeps its records in any case.
            Default: True. Turn it off if each process has a log of its own.
        durability: the durability of registrars that `registrars` does not name. Default: "process". Set "power" where
            power may fail.
        console: whether other processes of this user can look at the system and drive it, as the command rr-actors.
            Default: True. Turn it off if nobody but the application may.
        connections_limit: the connections (rr.connect) and consoles that may be open at once, however many sockets
            each has. Default: 128. Raise it for a larger pool of workers.
        events_limit_bytes: the size of the files in which the system remembers what happened. Default: 16,777,216.
            Raise it if a day does not fit; lower it on a small disk.
        events_kept_s: for how many seconds the system remembers what happened. Default: 86400.0, a day. Raise it to
            ask on Monday about the weekend.
        registrars: other configurations, by the registrar's name. Default: {}, none. Name a registrar that differs from
            the others.

    Raises:
        ConfigError: a value is of the wrong type or out of range. `.key`, `.expected`, `.got`
    """

    frame_limit_bytes: int = 16 * 2**20
    segments_limit_bytes: int | None = None
    mailbox_limit: int = 100_000
    ask_timeout_s: float = 30.0
    start_timeout_s: float = 30.0
    stop_timeout_s: float = 10.0
    workers_limit: int = 4096
    preload: tuple[str, ...] = ()
    logging: bool = True
    durability: Durability = "process"
    console: bool = True
    connections_limit: int = 128
    events_limit_bytes: int = 16 * 2**20
    events_kept_s: float = 86_400.0
    registrars: Mapping[str, RegistrarConfig] = field(default_factory=dict[str, RegistrarConfig])

    def __post_init__(self) -> None:
        _check_fields(self, _SYSTEM_RULES)
        object.__setattr__(self, "preload", tuple(self.preload))
        object.__setattr__(self, "registrars", dict(self.registrars))

    @classmethod
    def from_toml(cls, path: str | os.PathLike[str]) -> Self:
        """Read a configuration from a TOML file; `[registrars.NAME]` configures one registrar.

        Hosts.from_toml() reads the table [hosts] of the same file.

        Raises:
            ConfigError: the file cannot be read, is not TOML, or has an unknown key or a wrong value. `.file`, `.key`,
                `.expected`, `.got`
        """
        file = file_name(path)
        table = read_toml(file)
        table.pop("hosts", None)  # Hosts.from_toml() reads it
        registrars = table.pop("registrars", {})
        if not _is_table(registrars):
            raise wrong(file, "registrars", "tables [registrars.NAME]", registrars)
        table = _checked_table(table, _SYSTEM_RULES, file)
        defaults = {"durability": table.get("durability", "process")}
        return cls(
            **table, registrars={name: _registrar_of(name, entry, defaults, file) for name, entry in registrars.items()}
        )

    def registrar(self, name: str) -> RegistrarConfig:
        """Return the configuration of the registrar called `name`."""
        found = self.registrars.get(name)
        return RegistrarConfig(name, durability=self.durability) if found is None else called(found, name)


# -- the values that each key accepts ------------------------------------------------------------------------------


class _Rule(msgspec.Struct, frozen=True):
    expected: str
    accepts: Callable[[Any], bool]


def _is_name(value: object) -> bool:
    try:
        check_name(value)
    except InvalidName:
        return False
    return True


def _is_location(value: object) -> bool:
    if value is None:
        return True
    text = path_text(value)
    return text != "" and "\0" not in text and has_home(text)


def _is_modules(value: object) -> bool:
    if not isinstance(value, (list, tuple)):
        return False
    return all(isinstance(item, str) and item != "" for item in cast("list[object]", value))


def _is_registrars(value: object) -> bool:
    if not isinstance(value, Mapping):
        return False
    items = cast("Mapping[object, object]", value).items()
    return all(_is_name(name) and isinstance(config, RegistrarConfig) for name, config in items)


def _is_table(value: object) -> TypeGuard[dict[str, Any]]:
    return isinstance(value, dict)


def _one_of(*texts: str) -> _Rule:
    return _Rule(" or ".join(f'"{text}"' for text in texts), lambda value: isinstance(value, str) and value in texts)


_SECONDS = _Rule("a number of seconds greater than 0", lambda value: is_number(value) and value > 0)
_COUNT = _Rule(
    "a whole number greater than 0", lambda value: isinstance(value, int) and value is not True and value > 0
)
_SIZE = _Rule(
    "a whole number from 0, or none",
    lambda value: value is None or (isinstance(value, int) and value is not True and value is not False and value >= 0),
)
_BOOL = _Rule("true or false", lambda value: isinstance(value, bool))
_DURABILITY = _one_of("process", "power", "none")

_REGISTRAR_RULES: dict[str, _Rule] = {
    "name": _Rule(f"a name: {NAME_RULE}", _is_name),
    "location": _Rule("a directory's path", _is_location),
    "save_interval_s": _SECONDS,
    "save_on_modify": _BOOL,
    "erase_on_destruct": _BOOL,
    "durability": _DURABILITY,
    "on_damage": _one_of("refuse", "aside"),
    "max_priority": _Rule(
        "a whole number from 0 to 1000",
        lambda value: isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= 1000,
    ),
}
_SYSTEM_RULES: dict[str, _Rule] = {
    "frame_limit_bytes": _COUNT,
    "segments_limit_bytes": _SIZE,
    "mailbox_limit": _COUNT,
    "ask_timeout_s": _SECONDS,
    "start_timeout_s": _SECONDS,
    "stop_timeout_s": _SECONDS,
    "workers_limit": _COUNT,
    "preload": _Rule("a list of module names", _is_modules),
    "logging": _BOOL,
    "durability": _DURABILITY,
    "console": _BOOL,
    "connections_limit": _COUNT,
    "events_limit_bytes": _COUNT,
    "events_kept_s": _SECONDS,
    "registrars": _Rule("a mapping from registrar names to RegistrarConfig", _is_registrars),
}


def _check_fields(config: RegistrarConfig | SystemConfig, rules: Mapping[str, _Rule]) -> None:
    for key, rule in rules.items():
        value = getattr(config, key)
        if not rule.accepts(value):
            raise wrong(None, key, rule.expected, value, where=type(config).__name__)


def _checked_table(table: dict[str, Any], rules: Mapping[str, _Rule], file: str, prefix: str = "") -> dict[str, Any]:
    check_keys(table, rules, file, prefix)
    for key, value in table.items():
        if not rules[key].accepts(value):
            raise wrong(file, prefix + key, rules[key].expected, value)
    return table


def _registrar_of(name: str, entry: object, defaults: dict[str, Any], file: str) -> RegistrarConfig:
    key = f"registrars.{name}"
    if not _is_name(name):
        raise wrong(file, key, _REGISTRAR_RULES["name"].expected, name)
    if not _is_table(entry):
        raise wrong(file, key, f"a table [{key}]", entry)
    table = _checked_table(entry, _REGISTRAR_RULES, file, key + ".")
    if table.get("name", name) != name:
        raise wrong(file, f"{key}.name", f"{name!r}, as the table is called", table["name"])
    values: dict[str, Any] = {**defaults, **table, "name": name}
    return RegistrarConfig(**values)
