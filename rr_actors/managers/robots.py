"""Robots: the manager that loads a robot as its description says: driver, controller, sensors.

The descriptions are a TOML file. Each part names a type, and any component of that type will do::

    [[robot]]
    name = "rover"
    driver = { type = "motor-driver", parameters = { wheels = 4 } }
    controller = { type = "pilot" }
    sensors = [{ type = "lidar" }, { type = "imu" }]
"""

from __future__ import annotations

from pathlib import Path

import msgspec

from rr_actors.base.errors import ConfigError, LoadFailed, RrError, UnknownQuery
from rr_actors.base.names import new_id
from rr_actors.base.reporting.log import Log
from rr_actors.base.toml import parse_typed, raise_faults, wrong
from rr_actors.managers.components import Component, LoadComponent
from rr_actors.managers.planning.blame import is_own_failure, part_of
from rr_actors.managers.planning.hedging import HEDGE_S
from rr_actors.managers.planning.last_good import last_good_file, path_of
from rr_actors.managers.planning.retries import Retries
from rr_actors.managers.planning.searches import CandidateLoad, Search, release_soon, release_strays
from rr_actors.managers.templates import Parameter, Parameters, check_unique, fill_all, with_parameters
from rr_actors.registrar.declarations import server
from rr_actors.registrar.manager import Beginning, Manager
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query, Status
from rr_actors.registrar.servers.callback_context import current

logger = Log("rr_actors.managers.robots")

_LOAD_LIMIT_S = 60.0


class RobotPart(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A part of a robot: a component of this type, with these parameters besides those of the request."""

    type: str
    parameters: dict[str, Parameter] = {}


class RobotDescription(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One robot as the file describes it."""

    name: str
    driver: RobotPart
    controller: RobotPart | None = None
    sensors: list[RobotPart] = []

    def parts(self) -> list[RobotPart]:
        """Return all parts, in the order in which they are loaded."""
        return [self.driver, *([self.controller] if self.controller else []), *self.sensors]


class RobotFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole file of descriptions."""

    robot: list[RobotDescription]


class LoadRobot(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The request to run the robot of this name; `parameters` fill the templates of all its parts."""

    name: str
    parameters: Parameters = {}

    def __rr_title__(self) -> str:
        return with_parameters(self.name, self.parameters)


class Robot(msgspec.Struct, frozen=True):
    """The response: the robot's components. When one is replaced, the response changes, with an UPDATE status."""

    name: str
    driver: Component
    controller: Component | None
    sensors: list[Component]


class UnknownRobot(LoadFailed):
    """The file describes no robot of that name. `.name`, `.known`"""


class Robots(Manager):
    """Serves `robot`: loads its parts as components, and loads a part again when no component could replace it.

    The holders of a robot hear UPDATE when a part was replaced. They hear FATAL only if no component could replace it.
    """

    _rr_side_by_side = True

    def __init__(self, descriptions: str, components: str = "components/component", replace: bool = True) -> None:
        """Read the robots from the TOML file `descriptions`.

        `components` is the component manager's server. With `replace` off the holders hear of a failure at once.

        Raises:
            ConfigError: the file cannot be read, or is wrong. `.file`, `.key`, `.expected`, `.got`
        """
        self._path = path_of(descriptions, "Robots", "descriptions")
        self._robots = read_robots(self._path, self._rr_beginning())
        self._components = components
        self._replace = replace
        self._retries = Retries[tuple[str, str, str]]()  # of parts, by the id of the robot, the type and the number

    def on_start(self) -> None:
        """Release the components that the process before has loaded in the place of others, and had not put there."""
        release_strays(self.registrar, self._components, new_id())

    def on_stop(self) -> None:
        """Wait for no part that has failed any more."""
        self._retries.stop()

    @server("robot", recovery="keep")
    def load_robot(self, request: LoadRobot) -> Robot:
        """Load every part of the robot, the driver first."""
        orders = self._orders(request)
        return self._assembled(request, [self._load(order) for order in orders])

    @load_robot.status
    def robot_status(self, request: LoadRobot, status: Status) -> None:
        """Pass a part's new component on (UPDATE), or load a failed part again in its place (FATAL)."""
        try:
            about = part_of(self.registrar, status)
            if about.is_whole:
                return  # its holders hear it
            if status.state is State.UPDATE:
                self._update(request, self.registrar.children(current().resource_id), status.message)
            elif status.state is not State.FATAL or not self._replace:
                return
            elif about.part is not None:  # else a run before a crash has replaced it
                if not is_own_failure(status):
                    return  # the component manager has found no other
                self._replace_part(request, about.part, status)
        except UnknownQuery:
            pass  # it is being unloaded
        except RrError as error:
            logger.warning("%s: nothing takes the place of a part that failed: %s", request.name, error)
            return
        status.handled()

    # -- parts -----------------------------------------------------------------------------------------------------

    def _replace_part(self, request: LoadRobot, failed: Query, status: Status) -> None:
        id = current().resource_id
        others = [part for part in self.registrar.children(id) if part.request != failed.request]
        what = failed.request.type
        key = id, what, failed.request.instance
        self._retries.failed(key, status.resource_id)
        search = Search[LoadComponent](
            self.registrar,
            self._retries,
            key=lambda _: key,
            name=lambda order: order.type,
            text=lambda said: f"{said}: {status.message}",
        )

        load = CandidateLoad(failed.server_id, failed.request, _LOAD_LIMIT_S)

        def made(spare: Query) -> Robot:
            return self._assembled(request, self._in_order(request, [*others, spare]))

        def take(order: LoadComponent, query: Query) -> str:
            search.swap(status, failed, load, made)
            self._retries.used(key)
            release_soon(query)
            return query.response.name

        def one_pass() -> str | None:
            return search.first(
                [failed.request], lambda _: search.beside(load), take, _blame_nobody, check=search.check_wanted
            )

        with search.telling(HEDGE_S, f"{what} has failed, and another one is being started"):
            name = search.until_had(one_pass)
        if name is None:
            raise LoadFailed("\n".join(search.tried))
        logger.warning("%s: %s takes the place of a part that failed: %s", request.name, name, status.message)

    def _update(self, request: LoadRobot, parts: list[Query], why: str) -> None:
        """Give the robot's holders its present parts as the new response."""
        newest = self._in_order(request, parts)
        if len(newest) == len(self._orders(request)):  # else it is still loading, and its first response will have them
            self.registrar.update_response(current().resource_id, self._assembled(request, newest), why)

    def _in_order(self, request: LoadRobot, parts: list[Query]) -> list[Query]:
        """Return the newest part for each order, in the description's order."""
        newest: list[Query] = []
        for order in self._orders(request):
            newest += [part for part in parts if part.request == order][-1:]
        return newest

    def _load(self, order: LoadComponent) -> Query:
        return self.registrar.load(self._components, order, timeout_s=_LOAD_LIMIT_S)

    def _orders(self, request: LoadRobot) -> list[LoadComponent]:
        """Return the requests to the component manager, one for each part. A number distinguishes equal parts.

        Every part has a number: else the second part of "rover" would be the first one of a robot "rover-2".
        """
        orders: list[LoadComponent] = []
        for part in self._describe(request.name).parts():
            where = f"{self._path}: robot {request.name!r}: {part.type}: parameters"
            parameters = fill_all(part.parameters, request.parameters, where)
            same = sum(part.type == other.type and parameters == other.parameters for other in orders)
            orders.append(LoadComponent(part.type, parameters, f"{request.name}-{same + 1}"))
        return orders

    def _assembled(self, request: LoadRobot, parts: list[Query]) -> Robot:
        driver, *rest = [part.response for part in parts]
        controller = rest.pop(0) if self._describe(request.name).controller else None
        return Robot(request.name, driver, controller, rest)

    def _describe(self, name: str) -> RobotDescription:
        found = next((robot for robot in self._robots if robot.name == name), None)
        if found is None:
            known = tuple(robot.name for robot in self._robots)
            text = f"no robot {name!r} in {self._path}: expected one of {', '.join(known) or 'none'}"
            raise UnknownRobot(text, name=name, known=known)
        return found


def _blame_nobody(order: LoadComponent, error: Exception) -> None:
    """Lower nothing: the component manager has."""


def read_robots(path: Path, beginning: Beginning | None = None) -> list[RobotDescription]:
    """Read the descriptions, after a crash the last good ones, and check that the names in them are different.

    Raises:
        ConfigError: the file cannot be read, or is wrong. `.file`, `.key`, `.expected`, `.got`
    """
    return last_good_file(beginning, path, _parse_robots).now


def _parse_robots(data: bytes, file: str) -> list[RobotDescription]:
    robots = parse_typed(data, file, RobotFile).robot
    check_unique(Path(file), "robot", [robot.name for robot in robots])
    faults: list[ConfigError] = []
    for i, robot in enumerate(robots):
        parts = {"driver": robot.driver, "controller": robot.controller}
        parts |= {f"sensors[{j}]": sensor for j, sensor in enumerate(robot.sensors)}
        for field, part in parts.items():
            if part is not None and not part.type:
                faults.append(wrong(file, f"robot[{i}].{field}.type", "the type of a component", part.type))
    raise_faults(faults)
    return robots
