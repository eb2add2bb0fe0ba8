"""RunNode: the request for a node, and the command that runs it. Where a package has its executables. ROS 2."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated

import msgspec

from rr_actors.base.errors import InvalidRequest, MissingDependency, did_you_mean, few, shown
from rr_actors.managers.program_conditions import ProgramHealth
from rr_actors.managers.programs import RunProgram
from rr_actors.managers.ros.ros_config import NAME_RULE, is_ros_name
from rr_actors.registrar.model.health import Health

Plain = bool | int | float | str
Parameter = Plain | list[Plain]

DOMAIN = "ROS_DOMAIN_ID"
_PREFIXES = "AMENT_PREFIX_PATH"
_SOURCE = "run `source /opt/ros/DISTRIBUTION/setup.bash` and that of your workspace in the shell that starts the system"
_PARAMETER = re.compile(r"[A-Za-z_][A-Za-z0-9_.\-/]*\Z")
_REMAPPED = re.compile(r"[^:=\s]+\Z")


class RunNode(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The request to run this node of ROS 2.

    Attributes:
        executable: of the package, "talker"; or without a package a program, looked up in PATH.
        name: of the node in the graph, "front_camera". The program has one node, which gets this name.
        package: where the executable is, "demo_nodes_py".
        namespace: of the node, "/" or "/robot".
        arguments: of the program, before those of ROS.
        parameters: by name: a bool, a number, a text, or a list of one of these.
        parameter_file: a YAML file with parameters, which those above go before.
        remappings: names of topics and services in the program, and what they are in the graph.
        lifecycle: whether it is a lifecycle node: it is configured and activated.
        environment, directory, stop_signal, grace_s, cost: as for RunProgram. SIGINT is how `ros2 launch` ends nodes.
        program_health: what is expected of the program while it runs, as `health` of RunProgram.
        health: how a lifecycle node is asked for its state while it runs; None: it is not.
        timeout_s: seconds until the node is in the graph; as many again until a lifecycle node is active.
    """

    executable: str
    name: str
    package: str = ""
    namespace: str = "/"
    arguments: tuple[str, ...] = ()
    parameters: dict[str, Parameter] = {}
    parameter_file: str | None = None
    remappings: dict[str, str] = {}
    lifecycle: bool = False
    environment: dict[str, str] = {}
    directory: str | None = None
    stop_signal: str = "SIGINT"
    grace_s: Annotated[float, msgspec.Meta(ge=0)] = 5.0
    cost: dict[str, float] = {}
    program_health: ProgramHealth | None = None
    health: Health | None = Health(timeout_s=2.0)
    timeout_s: Annotated[float, msgspec.Meta(gt=0)] = 10.0

    def __rr_title__(self) -> str:
        return f"{self.full_name}: {f'{self.package} ' if self.package else ''}{self.executable}"

    @property
    def full_name(self) -> str:
        """The node's name with its namespace, "/robot/front_camera"."""
        return f"{self.namespace.rstrip('/')}/{self.name}"


def check_node(request: RunNode, domain: int) -> None:
    """Check what the types of the fields do not say.

    Args:
        domain: that of the manager. A node of another one would never be in its graph.

    Raises:
        InvalidRequest: a name or a parameter is wrong, or the node would be in another domain. `.path`, `.expected`
    """
    if "/" in request.name or not is_ros_name(request.name):
        raise _invalid("name", f"a name without '/': {NAME_RULE}", request.name)
    if request.namespace != "/" and not (request.namespace.startswith("/") and is_ros_name(request.namespace[1:])):
        raise _invalid("namespace", f"'/', or '/' and {NAME_RULE}", request.namespace)
    for name, value in request.parameters.items():
        path = f"parameters.{name}"
        if not _PARAMETER.match(name):
            raise _invalid(path, "a name of ASCII letters, digits, '_', '.', '-' and '/'", name)
        if isinstance(value, list) and len({type(one) for one in value}) != 1:
            raise _invalid(path, "a list of at least one value, and all of one type", value)
    for old, new in request.remappings.items():
        if not _REMAPPED.match(old) or not _REMAPPED.match(new):
            raise _invalid(f"remappings.{old}", "two names without ':', '=' and spaces", f"{old}:={new}")
    given = request.environment.get(DOMAIN)
    if given is not None and given.strip() != str(domain):
        expected = f"{domain}, the domain of its manager, which sees no node of another one"
        raise _invalid(f"environment.{DOMAIN}", expected, given)


def program_of(request: RunNode, domain: int, environment: Mapping[str, str]) -> RunProgram:
    """Return the program that is the node.

    Args:
        environment: in which packages are looked up: that of the manager.

    Raises:
        InvalidRequest: there is no such package or executable. `.path`, `.expected`
        MissingDependency: no package can be found: ROS is not sourced. `.module`, `.install`
    """
    command = request.executable
    if request.package:
        command = str(_executable(request.package, command, {**environment, **request.environment}))
    return RunProgram(
        command,
        (*request.arguments, *_arguments_of_ros(request)),
        environment={**request.environment, DOMAIN: str(domain)},
        directory=request.directory,
        stop_signal=request.stop_signal,
        grace_s=request.grace_s,
        instance=f"node {request.full_name}",
        cost=request.cost,
        health=request.program_health,
    )


def _arguments_of_ros(request: RunNode) -> Iterator[str]:
    yield "--ros-args"
    rules = {"__node": request.name, "__ns": request.namespace, **request.remappings}
    for old, new in rules.items():
        yield from ("-r", f"{old}:={new}")
    if request.parameter_file is not None:
        yield from ("--params-file", request.parameter_file)
    for name, value in request.parameters.items():
        yield from ("-p", f"{name}:={_yaml(value)}")
    yield "--"


def _yaml(value: Parameter) -> str:
    """Return a value as ROS reads it."""
    if isinstance(value, list):
        return f"[{', '.join(_yaml(one) for one in value)}]"
    if isinstance(value, float) and not math.isfinite(value):
        return ".nan" if math.isnan(value) else ".inf" if value > 0 else "-.inf"
    return json.dumps(value, ensure_ascii=False)


# -- packages ----------------------------------------------------------------------------------------------------------


def _executable(package: str, name: str, environment: Mapping[str, str]) -> Path:
    """Return an executable of a package, as `ros2 run` finds it: PREFIX/lib/PACKAGE/NAME."""
    prefixes = [Path(prefix) for prefix in environment.get(_PREFIXES, "").split(os.pathsep) if prefix]
    if not prefixes:
        text = f"package {shown(package)} cannot be found: {_PREFIXES} is not set, so ROS is not sourced; {_SOURCE}"
        raise MissingDependency(text, module=package, install=_SOURCE)
    prefix = next((one for one in prefixes if (_index(one) / package).is_file()), None)
    if prefix is None:
        known = {found.name for one in prefixes for found in _files(_index(one))}
        expected = f"a package below one of {few(map(str, prefixes))}{did_you_mean(package, known)}"
        raise _invalid("package", expected, package)
    folder = prefix / "lib" / package
    found = folder / name
    if "/" not in name and os.access(found, os.X_OK) and found.is_file():
        return found
    known = sorted(one.name for one in _files(folder) if os.access(one, os.X_OK))
    expected = f"an executable of {package}: {few(known) or 'it has none'}{did_you_mean(name, known)}"
    raise _invalid("executable", expected, name)


def _index(prefix: Path) -> Path:
    return prefix / "share" / "ament_index" / "resource_index" / "packages"


def _files(folder: Path) -> list[Path]:
    try:
        return [one for one in folder.iterdir() if one.is_file()]
    except OSError:  # there is no such folder
        return []


def _invalid(path: str, expected: str, got: object) -> InvalidRequest:
    text = f"{path}: expected {expected}, got {shown(got)}"
    return InvalidRequest(text, path=path, expected=expected, got=shown(got))
