"""Hosts: what a system shares with systems on other hosts, and how they find each other."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Self, TypeVar, cast

from rr_actors.base.checks import examined, invalid
from rr_actors.base.errors import InvalidName, InvalidSpec, is_a
from rr_actors.base.names import check_name
from rr_actors.base.toml import FilePath, check_keys, file_name, read_toml, wrong
from rr_actors.wire.hosts.host_names import ENDPOINT, HostNames, is_endpoint

_T = TypeVar("_T")

LEASE_LEAST_S = 1.0
LEASE_MOST_S = 3600.0


@dataclass(frozen=True)
class Export:
    """Which hosts may load from a registrar, and what becomes of what they hold.

    Args:
        to: the names of these hosts. Default: None, all hosts of the group. Name them where not all of them may.
        on_lost: what is done with what a host holds when its lease is over (Hosts.lease_s). Default: "keep", it is kept
            until that host is back. Set "release" where others need it meanwhile: that host takes it as lost.

    Raises:
        InvalidSpec: `.field`, `.expected`, `.got`.
    """

    to: Sequence[str] | None = None
    on_lost: Literal["keep", "release"] = "keep"

    def __post_init__(self) -> None:
        if self.to is not None:
            object.__setattr__(self, "to", tuple(_names(self.to, "Export", "to", "host")))
        if self.on_lost not in ("keep", "release"):
            raise invalid("Export", "on_lost", "'keep' or 'release'", self.on_lost)


@dataclass(frozen=True)
class Hosts:
    """The settings for System(hosts=...): the system's part in a group of hosts (docs/hosts.md).

    Args:
        name: this host's name in the group. No other system of the group has it. It has no default.
        listen: where others connect to this host: Zenoh endpoints on loopback, "tcp/127.0.0.1:7447". Default: (), it
            only connects. Give one of two hosts an endpoint.
        connect: the endpoints of other hosts. Default: (), it only listens. Name those that listen.
        exports: the registrars that other hosts may load from, by name. Default: {}, none. Name those that others need.
        routes: the registrars here for which another host's are meant, as {"maps": "hostb/maps"}: then
            load("maps/map") loads from there. Default: {}, none. Name one when a manager moves to another host.
        lease_s: for so many seconds after it was last heard another host has what it holds here, 1 to 3600. It tries to
            reach this one again for as long (docs/hosts.md). Default: 10.0. Set a longer one to outlast longer outages,
            and a shorter one to give sooner to others what Export(on_lost="release") says.
        group: hosts of one group see each other. Default: "rr". Set another for a second group on the same network.

    Raises:
        InvalidSpec: `.field`, `.expected`, `.got`.
    """

    name: str
    listen: Sequence[str] = ()
    connect: Sequence[str] = ()
    exports: Mapping[str, Export] = field(default_factory=dict[str, Export])
    routes: Mapping[str, str] = field(default_factory=dict[str, str])
    lease_s: float = 10.0
    group: str = "rr"

    def __post_init__(self) -> None:
        with examined("Hosts"):
            self._check()

    @classmethod
    def from_toml(cls, path: FilePath) -> Self:
        """Read the table [hosts] of a TOML file, which may have a tree or a SystemConfig, too.

        Its keys are the attributes; [hosts.exports.cameras] is one Export.

        Raises:
            ConfigError: the file cannot be read, is not TOML, has no such table, or has an unknown key or a wrong value
                in it. `.file`, `.key`, `.expected`, `.got`
        """
        file = file_name(path)
        table: object = read_toml(file).get("hosts")
        fields = _table(table, file, "hosts", "a table [hosts]")
        if "exports" in fields:
            exports = _table(fields["exports"], file, "hosts.exports", "tables [hosts.exports.NAME]")
            expected = "a table, such as { to = ['hostb'] }"
            fields["exports"] = {
                name: _made(Export, file, key, _table(entry, file, key, expected))
                for name, entry in exports.items()
                for key in [f"hosts.exports.{name}"]
            }
        if "routes" in fields:
            _table(fields["routes"], file, "hosts.routes", "a table of registrars and 'host/registrar'")
        if "name" not in fields:
            raise wrong(file, "hosts.name", "the name of this host", None)
        return _made(cls, file, "hosts", fields)

    def _check(self) -> None:
        _name(self.name, "Hosts", "name", "the name of a host")
        who = f"Hosts {self.name!r}"
        _name(self.group, who, "group", "a name")
        lease_s = cast(object, self.lease_s)
        if not (is_a(lease_s, (int, float)) and not is_a(lease_s, bool) and LEASE_LEAST_S <= lease_s <= LEASE_MOST_S):
            raise invalid(who, "lease_s", f"a number from {LEASE_LEAST_S:g} to {LEASE_MOST_S:g}", lease_s)
        for part in ("listen", "connect"):
            given = _strings(getattr(self, part), who, part, "a list of endpoints")
            for endpoint in given:
                if not is_endpoint(endpoint):
                    raise invalid(who, part, ENDPOINT, endpoint)
            object.__setattr__(self, part, tuple(given))
        if not self.listen and not self.connect:
            raise invalid(who, "listen", "an endpoint in listen or in connect, or no host is ever reached", self.listen)
        self._check_exports(who)
        self._check_routes(who)

    def _check_exports(self, who: str) -> None:
        exports = cast(object, self.exports)
        if not is_a(exports, Mapping):
            raise invalid(who, "exports", "a dict of registrars and Exports", exports)
        for name, export in cast("Mapping[object, object]", exports).items():
            _name(name, who, "exports", "the name of a registrar")
            if not is_a(export, Export):
                raise invalid(who, f"exports[{name!r}]", "an Export", export)
        object.__setattr__(self, "exports", dict(self.exports))

    def _check_routes(self, who: str) -> None:
        routes = cast(object, self.routes)
        if not is_a(routes, Mapping):
            raise invalid(who, "routes", "a dict of registrars and the 'host/registrar' that is meant", routes)
        for name, target in cast("Mapping[object, object]", routes).items():
            _name(name, who, "routes", "the name of a registrar")
            where = f"routes[{name!r}]"
            expected = "'host/registrar'"
            if not is_a(target, str) or target.count("/") != 1:
                raise invalid(who, where, expected, target)
            for part in target.split("/"):
                _name(part, who, where, expected)
            host, _, registrar = target.partition("/")
            if host == self.name and registrar in cast("Mapping[object, object]", routes):
                raise invalid(who, where, "no route to a registrar of this host that has a route itself", target)
        object.__setattr__(self, "routes", dict(self.routes))


def is_for(export: Export, host: str) -> bool:
    """Return whether that host may load from the registrar."""
    return export.to is None or host in export.to


def names_of(hosts: Hosts) -> HostNames:
    """Return what each process of the system has to know of the settings."""
    return HostNames(hosts.name, dict(hosts.routes))


def named_in(hosts: Hosts) -> set[str]:
    """Return the other hosts that the settings name."""
    named = {target.partition("/")[0] for target in hosts.routes.values()}
    return named.union(*(export.to or () for export in hosts.exports.values())) - {hosts.name}


def _table(value: object, file: str, key: str, expected: str) -> dict[str, Any]:
    if not is_a(value, dict):
        raise wrong(file, key, expected, value)
    return dict(cast("dict[str, Any]", value))


def _made(cls: type[_T], file: str, key: str, fields: dict[str, Any]) -> _T:
    """Make the settings in the table at this key of a file."""
    known = [one.name for one in dataclasses.fields(cast("Any", cls))]
    check_keys(fields, known, file, f"{key}.")
    try:
        return cls(**fields)
    except InvalidSpec as error:
        details = error.details
        within = re.sub(r"\['(.*)'\]", r".\1", details["field"])  # "exports['cameras']"
        raise wrong(file, f"{key}.{within}", details["expected"], details["got"]) from error


def _name(value: object, who: str, field: str, expected: str) -> None:
    try:
        check_name(value)
    except InvalidName as error:
        raise invalid(who, field, expected, value) from error


def _strings(given: object, who: str, field: str, expected: str) -> list[str]:
    if not is_a(given, (list, tuple)):
        raise invalid(who, field, expected, given)
    values = list(cast("Sequence[object]", given))
    for value in values:
        if not is_a(value, str):
            raise invalid(who, field, expected, value)
    return cast("list[str]", values)


def _names(given: object, who: str, field: str, what: str) -> list[str]:
    values = _strings(given, who, field, f"a list of {what} names")
    for value in values:
        _name(value, who, field, f"the name of a {what}")
    return values
