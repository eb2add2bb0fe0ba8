"""Components: a manager that knows which programs can do a job, runs the most reliable one, and replaces it.

The registry is a TOML file::

    [[component]]
    name = "front-lidar"
    type = "lidar"
    reliability = 0.9                                    # 0 to 1; a failure halves it
    defaults = { run = "/run/robot" }                    # for what the request does not give
    parameters = { scans = "${run}/front-lidar.sock" }   # ${...}: from the request, and `here`, `python`, `name`
    break_first = true                                   # it cannot run beside another one; may be left out

    [component.program]                                  # as RunProgram, see programs.py
    command = "${python}"
    arguments = ["-m", "robot.lidar", "--publish", "${scans}"]
    directory = "${here}/.."                             # `here`: the directory of this file
    ready = { line = "scanning", timeout_s = 5 }

    [component.health]                                   # as ProgramHealth, see program_conditions.py; may be left out
    line_every_s = 1.0                                   # a component that is silent is replaced as one that has ended
"""

from __future__ import annotations

import contextlib
import functools
import signal
import string
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import msgspec

from rr_actors.actors.messaging.futures import Reply
from rr_actors.base.checks import is_number
from rr_actors.base.errors import ConfigError, LoadError, LoadFailed, LoadTimeout, RrError, UnknownQuery, shown
from rr_actors.base.names import new_id
from rr_actors.base.reporting.log import Log
from rr_actors.base.scarcity import wanted_by
from rr_actors.base.toml import parse_typed, raise_faults, wrong
from rr_actors.managers.planning.blame import is_own_failure, is_own_fault, part_of
from rr_actors.managers.planning.hedging import HEDGE_S
from rr_actors.managers.planning.last_good import last_good_file, path_of
from rr_actors.managers.planning.reliability import Reliabilities
from rr_actors.managers.planning.retries import Retries
from rr_actors.managers.planning.searches import CandidateLoad, Search, groups, release_soon, release_strays
from rr_actors.managers.program_conditions import ProgramHealth
from rr_actors.managers.programs import RunProgram
from rr_actors.managers.templates import Parameter, Parameters, check_unique, fill, fill_all, with_parameters
from rr_actors.registrar.declarations import server
from rr_actors.registrar.manager import Beginning, Manager
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query, Status
from rr_actors.registrar.servers.callback_context import current
from rr_actors.system.registrar_lookup import registrar_in

logger = Log("rr_actors.managers.components")

R = TypeVar("R")

LOAD_MARGIN_S = 20.0  # added to the program's own limit: its manager may be restarting after a crash
_FIRST_HEDGE_S = 5.0  # nobody uses anything that has failed yet, and devices are slow to start


class ComponentDescription(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One component as the registry describes it.

    Attributes:
        break_first: it cannot run beside another component of its type, as two drivers of one device cannot. So it is
            started when those before it have ended, and none is started beside it.
    """

    name: str
    type: str
    program: RunProgram
    reliability: Annotated[float, msgspec.Meta(ge=0, le=1)] = 1.0
    parameters: dict[str, Parameter] = {}
    defaults: dict[str, Parameter] = {}
    health: ProgramHealth | None = None
    break_first: bool = False


class RegistryFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The whole registry file."""

    component: list[ComponentDescription]


class LoadComponent(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The request to run a component of this type.

    Attributes:
        type: the job; any component of that type can do it.
        parameters: values for the templates in the component's description.
        instance: a name that distinguishes requests that are otherwise the same: each name gets its own component.
    """

    type: str
    parameters: Parameters = {}
    instance: str = ""

    def __rr_title__(self) -> str:
        return with_parameters(self.type, self.parameters, self.instance)


class Component(msgspec.Struct, frozen=True):
    """The response: the component that does the job, the pid of its program, and its parameters with filled templates.

    When another component replaces this one, the response changes, and its holders hear an UPDATE status.
    """

    name: str
    type: str
    pid: int
    parameters: dict[str, str]


class ComponentStart(NamedTuple):
    """How to start a component for a request: its program, and what makes the response of that program's query."""

    program: CandidateLoad
    made: Callable[[Query], Any]


class NoComponent(LoadFailed):
    """The registry has no component of the type, or none of them could be loaded."""


class Components(Manager):
    """Serves `component`: runs the most reliable component of a type, and the next best when that one fails.

    One that is silent by its `health` has failed. A holder that finds one silent says so:
    `system.registrar("components").send_status(query, FATAL)` has it replaced.
    The holders of a replaced component hear UPDATE. They hear FATAL only if no other component could replace it. One
    that fails again and again waits longer each time, with a WARNING, and is given up after ten failures in a row.
    """

    _rr_side_by_side = True

    def __init__(self, registry: str, programs: str = "programs/program", replace: bool = True) -> None:
        """Read the components from the TOML file `registry`.

        `programs` is the program manager's server. With `replace` off the holders hear of a failure at once.

        Raises:
            ConfigError: the registry cannot be read, or is wrong. `.file`, `.key`, `.expected`, `.got`
        """
        self._path = path_of(registry, type(self).__name__, "registry")
        self._registry = self._read()
        self._programs = programs
        self._replace = replace
        self._retries = Retries[tuple[str, str]]()  # of components, by the id of the resource that has them and by name

    def on_start(self) -> None:
        """Release the programs that the process before has started in the place of others, and had not put there."""
        release_strays(self.registrar, self._programs, new_id())

    def on_stop(self) -> None:
        """Wait for no component that has failed any more."""
        self._retries.stop()

    def _read(self) -> list[ComponentDescription]:
        return read_registry(self._path, self._rr_beginning())

    @server("component", recovery="keep")
    def load_component(self, request: LoadComponent) -> Component:
        """Run the most reliable component of the type whose program can be run."""
        candidates, search = self.candidates(request.type), self._search()
        start, is_over = functools.partial(self._start_of, request), current().stopping.is_set
        hedge_s = max([_FIRST_HEDGE_S, *(one.program.ready.timeout_s / 2 for one in candidates)])

        def begin(one: ComponentDescription) -> Reply[Query]:
            return search.as_part(start(one).program)

        def take(one: ComponentDescription, query: Query) -> Component:
            return start(one).made(query)

        found = self._first(search, candidates, begin, take, is_over=is_over, hedge_s=hedge_s)
        if found is not None:
            return found
        if candidates:
            text = f"no component of type {request.type!r} could be loaded:"
            raise NoComponent("\n".join([text, *search.tried]), wanted=search.wanted)
        known = ", ".join(sorted({component.type for component in self._registry})) or "none"
        raise NoComponent(f"no component of type {request.type!r} in {self._path}: expected one of {known}")

    @load_component.status
    def component_status(self, request: LoadComponent, status: Status) -> None:
        """Put the next best component in the place of one that has failed: its program ends, or a holder says FATAL.

        Only its own fault lowers it. A crash may repeat this. The failure counts once, so the same component is chosen
        again.
        """
        part = self._failed_part(status)
        if part is None and status.resource_id == current().resource_id:
            part = self._part_called_lost(status)
        if part is not None:
            failed, start = self._component_of(request, part.request), functools.partial(self._start_of, request)
            self._replace_part(request.type, failed, status, part, lambda: self.candidates(request.type), start)

    # -- replacing -------------------------------------------------------------------------------------------------

    def _part_called_lost(self, status: Status) -> Query | None:
        """Return the program of a component that a holder has called lost; None if there is nothing to replace.

        The program is called lost, too: else the same component would get the same program again.
        """
        me = current()
        if status.state is not State.FATAL or not self._replace:
            return None
        if not any(info.id == me.resource_id and info.state == State.FATAL for info in self.registrar.resources()):
            status.handled()  # another status, or a run before a crash, has had it replaced
            return None
        part = next(iter(self.registrar.children(me.resource_id)), None)
        if part is not None and part.state is not State.FATAL:
            programs = registrar_in(self._rr_node, part.registrar, patient=True, owner=self)
            with contextlib.suppress(UnknownQuery):  # it is gone
                programs.send_status(part.resource_id, Status(State.FATAL, status.message))
        return part

    def _failed_part(self, status: Status) -> Query | None:
        """Return the part of which a status says that it has failed; None if there is nothing to replace."""
        if status.state is not State.FATAL or not self._replace:
            return None
        about = part_of(self.registrar, status)
        if about.part is None and not about.is_whole:
            status.handled()  # a run before a crash has replaced it, or it was released while loading
        return about.part

    def _replace_part(
        self,
        what: str,
        failed: ComponentDescription | None,
        status: Status,
        part: Query,
        fitting: Callable[[], Sequence[ComponentDescription]],
        start: Callable[[ComponentDescription], ComponentStart],
    ) -> None:
        """Blame what has failed, and put the first of those that fit in the place of its program.

        Those that have to rest come last.
        """
        search, name = self._search(status), failed.name if failed else what
        if failed is not None and is_own_failure(status):
            self._lower(failed, part.resource_id)  # the same for all statuses of this failure

        def begin(one: ComponentDescription) -> Reply[Query]:
            return search.beside(start(one).program)

        def take(one: ComponentDescription, query: Query) -> str:
            search.swap(status, part, *start(one))
            release_soon(query)
            return one.name

        def one_pass() -> str | None:
            in_turn = sorted(fitting(), key=lambda one: not self._retries.is_ready((search.id, one.name)))
            if failed in in_turn and status.reason == "revoked":
                in_turn.remove(failed)  # it would wait for the end of this one
            return self._first(search, in_turn, begin, take, check=search.check_wanted)

        try:
            with search.telling(HEDGE_S, f"{name} has failed, and another one is being started"):
                if part.state is not State.FATAL:  # a holder has called it lost: its program is being ended
                    with contextlib.suppress(UnknownQuery, LoadTimeout):  # it is gone, or its grace is long
                        part.wait_status(State.FATAL, timeout_s=LOAD_MARGIN_S)
                found = search.until_had(one_pass)
        except UnknownQuery:
            status.handled()  # it is being unloaded
            return
        except RrError as error:
            search.tried.append(str(error))
            found = None
        if found is None:
            why = "\n".join(search.tried or ["none fits there"])
            logger.warning("%s: nothing takes the place of %s: %s", what, name, why)
        else:
            logger.warning("%s: %s takes the place of %s: %s", what, found, name, status.message)

    def _search(self, status: Status | None = None) -> Search[ComponentDescription]:
        id, message = current().resource_id, "" if status is None else status.message
        return Search(
            self.registrar,
            self._retries,
            key=lambda one: (id, one.name),
            name=lambda one: one.name,
            text=lambda said: f"{said}: {message}",
        )

    def _first(
        self,
        search: Search[ComponentDescription],
        in_turn: Sequence[ComponentDescription],
        begin: Callable[[ComponentDescription], Reply[Query]],
        take: Callable[[ComponentDescription, Query], R],
        *,
        is_over: Callable[[], bool] = lambda: False,
        check: Callable[[], object] = lambda: None,
        hedge_s: float = HEDGE_S,
    ) -> R | None:
        """Return what `take` makes of the program of the first candidate that can be run; None if there is none."""

        def use(one: ComponentDescription, query: Query) -> R:
            taken = take(one, query)
            self._retries.used((search.id, one.name))
            return taken

        def failed(one: ComponentDescription, error: Exception) -> None:
            if is_over() or not (isinstance(error, LoadError) or wanted_by(error)):
                raise error
            if is_own_fault(error):
                self._lower(one, new_id())

        for group in groups(in_turn, lambda one: one.break_first):
            found = search.first(group, begin, use, failed, check=check, hedge_s=hedge_s)
            if found is not None:
                return found
        return None

    def _lower(self, component: ComponentDescription, failure_id: str) -> None:
        """Note a failure that is a component's own fault."""
        self._reliabilities.lower(component.name, component.reliability, failure_id)
        self._retries.failed((current().resource_id, component.name), failure_id)

    # -- choosing --------------------------------------------------------------------------------------------------

    def candidates(self, type: str) -> list[ComponentDescription]:
        """Return the components of a type, the most reliable first; equally reliable ones in the registry's order."""
        of_type = [component for component in self._registry if component.type == type]
        return sorted(of_type, key=lambda component: -self.reliability(component))

    def reliability(self, component: ComponentDescription) -> float:
        """Return how far a component is trusted now, from 0 to 1."""
        return self._reliabilities.of(component.name, component.reliability)

    @functools.cached_property
    def _reliabilities(self) -> Reliabilities:
        return Reliabilities(self.registrar.directory / "reliability.json")

    def _start_of(self, request: LoadComponent, candidate: ComponentDescription) -> ComponentStart:
        program, parameters = self._filled(candidate, request)
        return ComponentStart(self._loading(program), functools.partial(component_of, candidate, parameters))

    def _loading(self, program: RunProgram) -> CandidateLoad:
        return CandidateLoad(self._programs, program, program.ready.timeout_s + LOAD_MARGIN_S)

    def _component_of(self, request: LoadComponent, program: RunProgram) -> ComponentDescription | None:
        """Return the component that runs this program; None if the registry has changed since the program started."""
        for component in self.candidates(request.type):
            if self._filled(component, request)[0] == program:
                return component
        return None

    def _filled(self, component: ComponentDescription, request: LoadComponent) -> tuple[RunProgram, dict[str, str]]:
        """Fill the component's templates; return its program and parameters."""
        where = f"{self._path}: component {component.name!r}"
        given: Parameters = {"here": str(self._path.parent), "python": sys.executable, "name": component.name}
        given = {**given, **component.defaults, **request.parameters}
        parameters = fill_all(component.parameters, given, f"{where}: parameters")
        program = component.program
        name = component.name.replace("%", "%25").replace(":", "%3A")  # so the first ":" below is the one in between

        def filled(text: str, key: str) -> str:
            return fill(text, parameters, f"{where}: program.{key}")

        ready_file, health = program.ready.file, component.health
        if health is not None and health.socket is not None:
            health = msgspec.structs.replace(health, socket=fill(health.socket, parameters, f"{where}: health.socket"))
        return msgspec.structs.replace(
            program,
            command=filled(program.command, "command"),
            arguments=tuple(filled(text, "arguments") for text in program.arguments),
            environment={key: filled(text, f"environment.{key}") for key, text in program.environment.items()},
            directory=str(self._path.parent / filled(program.directory or ".", "directory")),
            ready=msgspec.structs.replace(program.ready, file=ready_file and filled(ready_file, "ready.file")),
            instance=f"{name}:{request.instance}",  # two components never share a program
            health=health,
        ), parameters


def component_of(description: ComponentDescription, parameters: dict[str, str], query: Query) -> Component:
    """Return the component whose program the query has."""
    return Component(description.name, description.type, query.response.pid, parameters)


def read_registry(path: Path, beginning: Beginning | None = None) -> list[ComponentDescription]:
    """Read the registry, after a crash the last good one, and check that the names in it are different.

    Raises:
        ConfigError: the registry cannot be read, or is wrong. `.file`, `.key`, `.expected`, `.got`
    """
    return last_good_file(beginning, path, _parse_registry).now


def _parse_registry(data: bytes, file: str) -> list[ComponentDescription]:
    components = parse_typed(data, file, RegistryFile).component
    check_components(file, components)
    return components


def check_components(file: str, components: Sequence[ComponentDescription]) -> None:
    """Check what the types of the fields do not say.

    Raises:
        ConfigError: a name is not its own, or a program cannot be run as it is described.
    """
    check_unique(Path(file), "component", [component.name for component in components])
    faults: list[ConfigError] = []
    for i, component in enumerate(components):
        key = f"component[{i}]"
        if not component.type:
            faults.append(wrong(file, f"{key}.type", "the name of a type", component.type))
        faults += _parameter_faults(file, f"{key}.parameters", component.parameters)
        faults += _program_faults(file, f"{key}.program", component.program)
        if component.program.health is not None:
            expected = f"none here, but at {key}.health"
            faults.append(wrong(file, f"{key}.program.health", expected, component.program.health, said="one"))
        if component.health is not None:
            faults += _template_faults(file, f"{key}.health", [("socket", component.health.socket or "")])
    raise_faults(faults)


# -- what is wrong with the programs of a registry, as far as its file alone says it -----------------------------------

_TEMPLATE = "text in which ${name} or $$ follows each dollar sign"


def _program_faults(file: str, key: str, program: RunProgram) -> Iterator[ConfigError]:
    """Yield what would be wrong at each load of a program that stands at `key` in a file."""
    if not program.command:
        yield wrong(file, f"{key}.command", "the name of a program", program.command)
    if program.stop_signal not in signal.Signals.__members__:
        said = f"{shown(program.stop_signal)}"
        yield wrong(
            file, f"{key}.stop_signal", "the name of a signal, such as 'SIGTERM'", program.stop_signal, said=said
        )
    for name, amount in program.cost.items():
        if not is_number(amount) or amount < 0:
            yield wrong(file, f"{key}.cost.{name}", "a number of at least 0", amount)
    texts = [("command", program.command), ("directory", program.directory or "")]
    texts += [(f"arguments[{i}]", text) for i, text in enumerate(program.arguments)]
    texts += [(f"environment.{name}", text) for name, text in program.environment.items()]
    yield from _template_faults(file, key, texts)


def _parameter_faults(file: str, key: str, parameters: Parameters) -> Iterator[ConfigError]:
    """Yield which parameters that stand at `key` in a file are no templates."""
    yield from _template_faults(file, key, ((name, str(value)) for name, value in parameters.items()))


def _template_faults(file: str, key: str, texts: Iterable[tuple[str, str]]) -> Iterator[ConfigError]:
    """Yield which texts, by their keys below `key`, have a dollar sign that begins nothing."""
    for name, text in texts:
        if not string.Template(text).is_valid():
            yield wrong(file, f"{key}.{name}", _TEMPLATE, text)
