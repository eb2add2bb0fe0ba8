"""The configuration of a bridge: what it exposes to ROS. Nothing is exposed that is not listed.

It is a TOML file, or the same classes in Python::

    [[switch]]                              # one fixed request as one service, /front_camera/hold
    name = "front_camera"
    server = "cameras/camera"
    request = "/dev/video0"

    [json]                                  # any request to what is allowed, as JSON on topics
    namespace = "/rr"
    allow = ["cameras/*"]
    max_priority = 0
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Annotated, Any

import msgspec

from rr_actors.base.errors import ConfigError, InvalidName
from rr_actors.base.names import parse_server_id
from rr_actors.base.toml import parse_typed, raise_faults, wrong

_RELATIVE = re.compile(r"(?!.*__)[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*\Z")
_PATTERN = re.compile(r"[A-Za-z0-9_\-.*?]+/[A-Za-z0-9_\-.*?]+\Z")
NAME_RULE = "ASCII letters, digits and '_' between '/', without '__', no part of it beginning with a digit"

Priority = Annotated[int, msgspec.Meta(ge=-1000, le=1000)]


class Switch(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One fixed request as one service of ROS: SetBool `/NAME/hold`, true to load, false to unload.

    Attributes:
        name: "front_camera" gives `/front_camera/hold`, `/front_camera/status` and `/front_camera/available`.
        server: "registrar/server".
        request: as for Registrar.load().
        priority: as for Registrar.load(); None: on standby.
    """

    name: str
    server: str
    request: Any = {}
    priority: Priority | None = 0


class Json(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The topics by which any node loads, with requests in JSON.

    Attributes:
        namespace: of the topics: "/rr" gives `/rr/load`, `/rr/answers` and others.
        allow: the servers that nodes may load from, `cameras/camera` or `cameras/*`.
        max_priority: the highest priority that a node may ask for.
    """

    allow: tuple[str, ...]
    namespace: str = "/rr"
    max_priority: Priority = 0


class Exposed(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Everything that a bridge exposes: the whole file."""

    switch: tuple[Switch, ...] = ()
    json: Json | None = None


def is_ros_name(text: str) -> bool:
    """Return whether a text is a name of ROS without a "/" in front."""
    return _RELATIVE.match(text) is not None


def hold_service(switch: str) -> str:
    """Return the name of the service of a switch."""
    return f"/{switch}/hold"


def status_topic(switch: str) -> str:
    """Return the topic on which a switch says how its resource is."""
    return f"/{switch}/status"


def available_topic(switch: str) -> str:
    """Return the topic on which a switch says whether its resource can be used."""
    return f"/{switch}/available"


def offered_by(exposed: Exposed) -> list[str]:
    """Return the names of all services and topics that a bridge offers, which nobody else may offer."""
    names = [name(one.name) for one in exposed.switch for name in (hold_service, status_topic, available_topic)]
    if exposed.json is not None:
        names += [f"{exposed.json.namespace}/{topic}" for topic in ("answers", "status", "servers")]
    return names


def parse_exposed(data: bytes, file: str) -> Exposed:
    """Read the configuration from the bytes of a TOML file.

    Raises:
        ConfigError: it is wrong; the text has all faults. `.file`, `.key`, `.expected`, `.got` are of the first.
    """
    exposed = parse_typed(data, file, Exposed)
    check_exposed(exposed, file)
    return exposed


def check_exposed(exposed: Exposed, file: str | None = None) -> None:
    """Check what the types of the fields do not say.

    Raises:
        ConfigError: a name, a server or a pattern is wrong, or a name is given twice.
    """
    raise_faults([*_faults(exposed, file)])


def _faults(exposed: Exposed, file: str | None) -> Iterator[ConfigError]:
    def fault(key: str, expected: str, got: object, said: str | None = None) -> ConfigError:
        return wrong(file, key, expected, got, where="Bridge", said=said)

    if not exposed.switch and exposed.json is None:
        yield fault("", "a [[switch]] or [json]", None, "neither")
    known = set[str]()
    if exposed.json is not None:
        if not exposed.json.namespace.startswith("/") or not is_ros_name(exposed.json.namespace[1:]):
            yield fault("json.namespace", f"'/' and {NAME_RULE}", exposed.json.namespace)
        if not exposed.json.allow:
            yield fault("json.allow", "at least one server, such as 'cameras/*'", exposed.json.allow, "none")
        for i, pattern in enumerate(exposed.json.allow):
            if not _PATTERN.match(pattern):
                yield fault(f"json.allow[{i}]", "'registrar/server', in which * stands for any text", pattern)
        known = set(offered_by(Exposed(json=exposed.json)))
    for i, switch in enumerate(exposed.switch):
        key, names = f"switch[{i}]", set(offered_by(Exposed((switch,))))
        if not is_ros_name(switch.name):
            yield fault(f"{key}.name", NAME_RULE, switch.name)
        elif known & names:
            yield fault(f"{key}.name", "a name whose topics no other part of the bridge has", switch.name)
        known |= names
        try:
            parse_server_id(switch.server)
        except InvalidName:
            yield fault(f"{key}.server", "'registrar/server'", switch.server)
