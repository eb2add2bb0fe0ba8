"""Operators: threads of this process that choose, run graphs, harm sensors, and change what is to be kept."""

from __future__ import annotations

import functools
import uuid
from collections.abc import Callable
from typing import NamedTuple

from chaos.callback_log import Journal
from chaos.load_threads import LoadThread
from chaos.mission.mission_checks import wrong_fatal
from chaos.mission.mission_managers import CHOICES, DESIRED, GRAPH, RELEASED, SEEN, SENSORS
from chaos.report import Tally
from rr_actors.base.errors import RrError
from rr_actors.managers import Choose, RunGraph
from rr_actors.managers.actions.graph_documents import run_in
from rr_actors.managers.actions.graph_runs import ENDED, OVER
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query, Status
from rr_actors.registrar.registrar import Registrar
from rr_actors.system.system import System

LIMIT_S = 10.0
"""How long a call of an operator may take."""
_MOST = 3  # choices, and graphs, of one operator
_STATES = (State.OK, State.WARNING, State.ERROR, State.FATAL)


class Running(NamedTuple):
    """A graph that an operator holds, and its mission."""

    query: Query
    mission: str


class Operator(LoadThread):
    """A thread that chooses, runs graphs, and changes what is kept.

    Attributes:
        graphs: those that it holds, by its registrar's answers.

    Args:
        apply: gives the keeper the file of this name.
    """

    _refusals = (RrError, TimeoutError)  # the second: of a message to a manager that is being respawned
    _release_s = LIMIT_S

    def __init__(
        self, system: System, app: Registrar, journal: Journal, apply: Callable[[str], None], seed: int, tally: Tally
    ) -> None:
        super().__init__(app, seed, tally, ("operator", "of the mission"), 0.1)
        self.graphs: list[Running] = []
        self._choices: list[Query] = []
        self._fatal: dict[str, str] = {}
        self._system, self._journal, self._apply = system, journal, apply

    def unfinished(self) -> list[str]:
        """Have the graphs that it holds go on, and return those that have not ended. When nothing is harmed."""
        found: list[str] = []
        for graph in self.graphs:
            run = run_in(graph.query.response)
            if run.state == "PAUSED":
                self._tell(graph, "resume_graph")
            if run.state not in OVER and graph.query.state is not State.FATAL:
                states = {name: f"{node.state}/{node.number}" for name, node in run.nodes.items()}
                found.append(f"{self.app.name}: graph {graph.query.resource_id} does not end: {run.state}, {states}")
            elif run.state in ENDED:
                self._note_end(graph)
        return found

    def wrong_fatals(self) -> list[str]:
        """Return the choices that it has lost without being told why for each alternative."""
        found = [wrong_fatal(query.request, self._fatal.get(query.id, "")) for query in self._lost()]
        return [f"{self.app.name}: {wrong}" for wrong in found if wrong]

    def release(self) -> None:
        """Unload all that it holds."""
        super().release()
        for graph in self.graphs:
            self._journal.note(self.app.name, RELEASED, graph.mission)

    def _lost(self) -> list[Query]:
        return [query for query in self._choices if query.state is State.FATAL]

    def _next(self) -> tuple[str, Callable[[], object]]:
        chance = self._plan.random()
        if chance < 0.25:
            return self._next_choice()
        if chance < 0.6:
            return self._next_graph()
        if chance < 0.93:
            return "status of a sensor", self._harm
        return "change of what is kept", lambda: self._apply(self._plan.choice([*DESIRED]))

    # -- choices ---------------------------------------------------------------------------------------------------

    def _next_choice(self) -> tuple[str, Callable[[], object]]:
        if self._choices and (lost := self._lost() or (len(self._choices) >= _MOST and self._choices)):
            return "release of a choice", functools.partial(self._release, self._plan.choice(lost))
        return "choice", functools.partial(self._choose, self._plan.choice(CHOICES))

    def _choose(self, request: Choose) -> None:
        self._choices.append(self.app.load("choices/choice", request, on_status=self._hear, timeout_s=LIMIT_S))

    def _hear(self, status: Status) -> None:
        if status.state is State.FATAL:
            self._fatal[status.query_id] = status.message

    def _release(self, query: Query) -> None:
        self._tally.violation(*self.wrong_fatals())
        self._choices.remove(query)
        query.unload_if_held(timeout_s=LIMIT_S)

    # -- graphs ----------------------------------------------------------------------------------------------------

    def _next_graph(self) -> tuple[str, Callable[[], object]]:
        if not self.graphs:
            return "begin of a graph", self._begin
        graph = self._plan.choice(self.graphs)
        state = run_in(graph.query.response).state
        if state in OVER or graph.query.state is State.FATAL or self._plan.random() < 0.1:
            return "release of a graph", functools.partial(self._end, graph)
        if len(self.graphs) < _MOST:
            return "begin of a graph", self._begin
        what = "resume_graph" if state == "PAUSED" else self._plan.choice(["pause_graph", "pause_graph", "stop_graph"])
        return what.replace("_", " of a "), functools.partial(self._tell, graph, what)

    def _begin(self) -> None:
        mission = uuid.uuid4().hex[:12]
        inputs = {"mission": mission, "round": 1, "rounds": self._plan.randrange(1, 6)}
        query = self.app.load("actions/graph", RunGraph(GRAPH, inputs, mission), timeout_s=LIMIT_S)
        self.graphs.append(Running(query, mission))

    def _end(self, graph: Running) -> None:
        self._note_end(graph)
        self.graphs.remove(graph)
        graph.query.unload_if_held(timeout_s=LIMIT_S)
        self._journal.note(self.app.name, RELEASED, graph.mission)

    def _note_end(self, graph: Running) -> None:
        """Note that the end of a graph, and so of its actions, is on disk."""
        if run_in(graph.query.response).state in ENDED:
            self._journal.note(self.app.name, SEEN, graph.mission)

    def _tell(self, graph: Running, what: str) -> None:
        proxy = self._system.ref("root/actions").proxy()
        getattr(proxy, what)(graph.query.resource_id).get(timeout=LIMIT_S)

    # -- harm ------------------------------------------------------------------------------------------------------

    def _harm(self) -> None:
        """Send a status of a sensor."""
        sensors = self._system.registrar(self._plan.choice(SENSORS))
        infos = sensors.resources()
        if infos:
            (state,) = self._plan.choices(_STATES, (40, 20, 20, 20))
            sensors.send_status(self._plan.choice(infos), Status(state, f"told {state}"))
