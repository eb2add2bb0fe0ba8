"""Pipes: the manager that builds the most reliable chain of components, and replaces a segment that fails.

A pipe is a resource whose parts are the programs of its components. chains.py says which components; this module runs
them with the calls that every manager has. The addresses at which two neighbours meet are made of the pipe's id, so
another component in the same place has the same ones, and its neighbours run on.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import msgspec

from rr_actors.base.errors import LoadFailed, UnknownQuery, did_you_mean, shown
from rr_actors.base.names import new_id
from rr_actors.base.reporting.log import Log
from rr_actors.base.scarcity import wanted_by
from rr_actors.base.toml import wrong
from rr_actors.managers.components import (
    LOAD_MARGIN_S,
    Component,
    ComponentDescription,
    Components,
    ComponentStart,
    LoadComponent,
    component_of,
)
from rr_actors.managers.pipes.chains import ChainComponent, Goal, best_chain, substitutes, why_none
from rr_actors.managers.pipes.pipe_files import PipeDescription, read_pipe_file
from rr_actors.managers.planning.blame import is_own_fault
from rr_actors.managers.planning.searches import release
from rr_actors.managers.programs import RunProgram
from rr_actors.managers.templates import Parameters, with_parameters
from rr_actors.registrar.declarations import server
from rr_actors.registrar.queries import Query, Status
from rr_actors.registrar.servers.callback_context import current

logger = Log("rr_actors.managers.pipes")


class Pipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The request for a pipe.

    Attributes:
        of_type: a pipe that the registry describes, or else a type of data: any chain may end in it.
        parameters: values for the templates of all its components.
        instance: a name that distinguishes requests that are otherwise the same: each name gets its own pipe.
    """

    of_type: str
    parameters: Parameters = {}
    instance: str = ""

    def __rr_title__(self) -> str:
        return with_parameters(self.of_type, self.parameters, self.instance)


class BuiltPipe(msgspec.Struct, frozen=True):
    """The response: the components of a pipe, in the order of the data, and the addresses of what the last one gives.

    When a component takes the place of one that failed, the response changes, and its holders hear an UPDATE status.
    The addresses stay the same.
    """

    of_type: str
    segments: list[Component]
    outputs: dict[str, str]


class NoPipe(LoadFailed):
    """No chain of components could be run, or nothing can take the place of a segment. The text says why for each."""


class Pipes(Components):
    """Serves `pipe`: runs the most reliable chain of components that ends in what is asked for.

    It serves `component`, too, as Components does, and has one reliability for both. The holders of a pipe hear UPDATE
    when a failed segment was replaced; the others run on. They hear FATAL only if nothing fits in its place.
    """

    def _read(self) -> list[ComponentDescription]:
        file = read_pipe_file(self._path, self._rr_beginning())
        self._described = {component.name: component for component in file.component}
        self._pipes: list[PipeDescription] = file.pipe
        return [*file.component]

    @server("pipe", recovery="keep")
    def load_pipe(self, request: Pipe) -> BuiltPipe:
        """Run the best chain of components that can be run, from the first segment to the last."""
        return self._built(request, self._build(request, self._goal(request.of_type)))

    @load_pipe.status
    def pipe_status(self, request: Pipe, status: Status) -> None:
        """Put another component in the place of one whose program has ended. Only its own fault lowers it.

        A crash may repeat this. The failure counts once, so the same component is chosen again.
        """
        part = self._failed_part(status)
        if part is None:
            return
        try:
            segments, place = self._segments(), _place_of(part)
        except UnknownQuery:
            status.handled()  # the pipe is being unloaded
            return

        def fitting() -> list[ComponentDescription]:
            return [self._described[link.name] for link in self._fitting(request, segments, place)]

        def start(one: ComponentDescription) -> ComponentStart:
            program, parameters = self._segment(request, one.name, place)

            def made(spare: Query) -> BuiltPipe:
                new = component_of(one, parameters, spare)
                return self._built(request, [*segments[:place], new, *segments[place + 1 :]])

            return ComponentStart(self._loading(program), made)

        failed = self._described.get(segments[place].name)
        self._replace_part(request.of_type, failed, status, part, fitting, start)

    # -- building --------------------------------------------------------------------------------------------------

    def _build(self, request: Pipe, goal: Goal) -> list[Component]:
        """Load the segments of the best chain; if one fails, those of the best chain without that component.

        Raises:
            NoPipe: there is no chain, or none that can be run.
        """
        held: list[tuple[Query, Component]] = []
        failures: dict[str, str] = {}
        wanted = ""
        while (chain := best_chain(self._links(failures), goal)) is not None:
            self._keep_common(held, chain)
            try:
                for link in chain[len(held) :]:
                    held.append(self._load_segment(request, link.name, len(held)))
                return [component for _, component in held]
            except LoadFailed as error:
                if current().stopping.is_set():
                    raise
                name = chain[len(held)].name
                failures[name], wanted = str(error), wanted or wanted_by(error)
                if is_own_fault(error):
                    self._lower(self._described[name], new_id())
        if failures:
            why = [f"{name}: {text}" for name, text in failures.items()]
            raise NoPipe("\n".join([f"no pipe for {request.of_type!r} could be run:", *why]), wanted=wanted)
        raise NoPipe("\n".join([f"no pipe for {request.of_type!r} can be built:", *why_none(self._links(), goal)]))

    def _keep_common(self, held: list[tuple[Query, Component]], chain: Sequence[ChainComponent]) -> None:
        """Release what is held beyond the first segments that another chain has as well."""
        same = 0
        while same < len(held) and same < len(chain) and held[same][1].name == chain[same].name:
            same += 1
        while len(held) > same:
            query, _ = held.pop()
            release(query)  # if it cannot be released, it stays a part, and is released with the pipe

    def _load_segment(self, request: Pipe, name: str, place: int) -> tuple[Query, Component]:
        program, parameters = self._segment(request, name, place)
        query = self.registrar.load(self._programs, program, timeout_s=program.ready.timeout_s + LOAD_MARGIN_S)
        return query, component_of(self._described[name], parameters, query)

    def _segment(self, request: Pipe, name: str, place: int) -> tuple[RunProgram, dict[str, str]]:
        """Return the program of a component in a place of the pipe, and its parameters with the addresses."""
        component, id = self._described[name], current().resource_id
        taken = {f"input_{type}": _address(id, place - 1, type) for type in component.inputs}
        given = {f"output_{type}": _address(id, place, type) for type in component.outputs}
        parameters = {**request.parameters, **taken, **given}
        return self._filled(component, LoadComponent(component.type, parameters, f"{id}.{place}"))

    def _built(self, request: Pipe, segments: list[Component]) -> BuiltPipe:
        last, place = self._described[segments[-1].name], len(segments) - 1
        id = current().resource_id
        return BuiltPipe(request.of_type, segments, {type: _address(id, place, type) for type in last.outputs})

    # -- replacing -------------------------------------------------------------------------------------------------

    def _fitting(self, request: Pipe, segments: Sequence[Component], place: int) -> list[ChainComponent]:
        links = {link.name: link for link in self._links()}
        others = [one.name for i, one in enumerate(segments) if i != place]
        if not links.keys() >= set(others):  # the registry has changed since the pipe was built
            return []
        around = [links[name] for name in others]
        return substitutes(links.values(), around[:place], around[place:], self._goal(request.of_type))

    def _segments(self) -> list[Component]:
        """Return the present segments of the pipe whose callback runs."""
        id = current().resource_id
        response = next((info.response for info in self.registrar.resources() if info.id == id), None)
        if response is None:
            raise UnknownQuery(f"resource {id}: unloaded already", query_id=id)
        return response.segments

    # -- choosing --------------------------------------------------------------------------------------------------

    def _links(self, without: Collection[str] = ()) -> list[ChainComponent]:
        described = self._described.values()
        return [one.link(self.reliability(one)) for one in described if one.name not in without]

    def _goal(self, of_type: str) -> Goal:
        """Return what a pipe of the type is to be.

        Raises:
            ConfigError: nothing gives that. `.key`, `.expected`, `.got`
        """
        ways = tuple(pipe.way() for pipe in self._pipes if pipe.type == of_type)
        outputs = {type for component in self._described.values() for type in component.outputs}
        if not ways and of_type not in outputs:
            known = sorted({pipe.type for pipe in self._pipes} | outputs)
            said = f"{shown(of_type)}, which no pipe and no component gives{did_you_mean(of_type, known)}"
            raise wrong(None, "of_type", f"one of {', '.join(known) or 'none'}", of_type, where="Pipe", said=said)
        return Goal(of_type, ways)


def _address(id: str, place: int, type: str) -> str:
    return f"pipe_{id}_{place}_{type}"


def _place_of(part: Query) -> int:
    """Return which segment a part is: its program's instance ends in that."""
    return int(part.request.instance.rpartition(".")[2])
