"""Graph engine: carries out one run of a graph. Each transition is on disk before anything is done for it.

A run of an action is a load, and a part of the graph's resource. Its end is on disk when the load is answered. So
after a crash there are three kinds of actions that ran. The load is held: the action has ended. It is not held: the
action runs again. Or the graph has its end already: the load is released.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Set
from typing import Any, Protocol

from rr_actors.base.errors import CatalogError, RrError, Unavailable, UsageError
from rr_actors.base.reporting.log import Log
from rr_actors.managers.actions.graph_model import ActionGraph
from rr_actors.managers.actions.graph_runs import (
    ENDED,
    LIVE,
    Begin,
    Change,
    Effect,
    Ended,
    Event,
    GraphRun,
    NodeRun,
    Restored,
    decide,
    feedback,
)
from rr_actors.managers.actions.run_controls import RunControl
from rr_actors.registrar.engine.status import Status
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query
from rr_actors.registrar.registrar import Registrar

logger = Log("rr_actors.managers.actions")

_NO_ROOM_S = 0.1  # how soon it tries again to write what the disk has refused
_TOLD = {"STOPPING": "stop", "PAUSED": "pause"}


class Runner(Protocol):
    """What the manager does for an engine."""

    registrar: Registrar

    def is_closing(self) -> bool:
        """Return whether the manager stops, so that ends of actions mean nothing."""
        ...

    def begin_run(self, graph_id: str, graph: ActionGraph, node: str, run: NodeRun, control: RunControl) -> Query:
        """Run an action, and return its query when it has ended."""
        ...

    def end_of(self, query: Query, node: str, run: NodeRun, control: RunControl) -> Ended:
        """Return how a run has ended whose query is held; of a sub-graph, wait for that."""
        ...


class GraphEngine:
    """One run of a graph. From any thread.

    Attributes:
        graph_id: the id of the resource.
    """

    def __init__(self, runner: Runner, graph_id: str, graph: ActionGraph, run: GraphRun) -> None:
        self.graph_id = graph_id
        self._runner, self._graph, self._run = runner, graph, run
        self._controls: dict[str, RunControl] = {}
        self._kept: dict[str, Query] = {}
        self._threads: set[threading.Thread] = set()
        self._changing = threading.RLock()
        self._closed = False
        self._begun = threading.Event()  # the first event is on disk: messages wait for that
        if run.steps:
            self._begun.set()

    @property
    def run(self) -> GraphRun:
        """The run as it is on disk."""
        return self._run

    def begin(self, event: Begin, loaded: threading.Event | None = None) -> None:
        """Tell the first event, when the load of the graph itself is on disk. In a thread of the engine's own.

        Args:
            loaded: says that it is; None: it was on disk before.
        """
        if loaded is not None:
            loaded.wait()
        try:
            self._insist(event)
        except (UsageError, Unavailable) as error:  # the load has failed, or the process stops
            logger.info("%s: %s", self._graph.name, error)
        finally:
            self._begun.set()

    def restore(
        self, parts: list[Query], key_of: Callable[[Query], str], ends: dict[str, tuple[str, dict[str, Any]]]
    ) -> None:
        """Go on after a crash with the parts that are held.

        Args:
            ends: the results and outputs of actions whose end is on disk, by the keys of their runs. The answer to the
                engine may have been lost.
        """
        held = {key_of(part): part for part in parts}
        lost: list[str] = []
        for name, node in [*self._run.nodes.items(), *self._run.leaving.items()]:
            query = held.pop(self._key(name, node), None)
            if node.state not in LIVE:
                if query is not None and self._run.state not in ENDED:
                    self._release_all(self._replaced(name, query))
                elif query is not None:
                    self._release(query)
            elif query is not None:
                self._in_thread(name, self._follow, node, self._told_again(name, node), query)
            elif (end := ends.get(self._key(name, node))) is not None:
                self.tell(Ended(name, node.number, *end))
            else:
                lost.append(name)
        for query in held.values():
            self._release(query)
        if lost:
            self.tell(Restored(tuple(lost)))

    def tell(self, event: Event, query: Query | None = None) -> None:
        """Take an event: decide, commit, and do what follows from it.

        Args:
            query: of the run that has ended. What it has loaded is released after the commit, and before others begin,
                or kept.

        Raises:
            GraphError: the event is none that the graph can have.
            UnknownQuery: the graph is not there any more.
            CatalogError: it cannot be written, and nothing has happened.
        """
        if not isinstance(event, Begin):
            self._begun.wait()
        with self._changing:
            if self._closed:
                return
            graph = event.graph if isinstance(event, Change) else self._graph
            left = self._run.leaving
            run, effects = decide(self._graph, self._run, event)
            stale: list[Query] = []
            is_new = run is not self._run
            if is_new:
                self._commit(graph, run, event)
                if graph is not self._graph:
                    stale += self._take_kept(self._kept.keys() - graph.unchanged(self._graph))
                self._graph, self._run = graph, run
            if query is not None and isinstance(event, Ended):
                stale += [query] if event.node in left else self._replaced(event.node, query)
            controls = [self._control(effect.node, run.node(effect.node), effect) for effect in effects]
        self._release_all(stale)
        for effect, control in zip(effects, controls, strict=True):
            self._carry_out(graph, effect, run.node(effect.node), control)
        if is_new and run.state in ENDED:
            self._end_of_all()

    def _insist(self, event: Event, query: Query | None = None) -> None:
        """Tell an event that has happened already. While the disk refuses it, try again: nobody else tells it."""
        while True:
            try:
                self.tell(event, query)
                return
            except CatalogError as error:
                logger.warning("%s: waits until it can be written: %s", self._graph.name, error)
                time.sleep(_NO_ROOM_S)

    def close(self, stop_s: float) -> None:
        """Stop what runs, and wait so many seconds for that and for releases: the graph is being unloaded."""
        with self._changing:
            self._closed = True
            controls, threads = list(self._controls.values()), list(self._threads)
        for control in controls:
            control.tell("stop")
        deadline = time.monotonic() + stop_s
        for thread in threads:
            thread.join(max(0.0, deadline - time.monotonic()))
            if thread.is_alive():
                logger.warning("%s: %s has not ended within %g s of stopping", self._graph.name, thread.name, stop_s)

    # -- on disk ---------------------------------------------------------------------------------------------------

    def _commit(self, graph: ActionGraph, run: GraphRun, event: Event) -> None:
        text = f"{event.node}: {event.result}" if isinstance(event, Ended) else type(event).__name__.lower()
        self._runner.registrar.update_response(self.graph_id, feedback(graph, run), text)

    def _end_of_all(self) -> None:
        """Release what is kept, and say so if the graph has ended with an error."""
        with self._changing:
            kept = self._take_kept(set(self._kept))
        self._release_all(kept)
        if self._run.state == "ERROR":
            self._quietly(self._say_error)

    def _say_error(self) -> None:
        self._runner.registrar.send_status(self.graph_id, Status(State.ERROR, self._run.why))

    # -- one action ------------------------------------------------------------------------------------------------

    def _key(self, name: str, node: NodeRun) -> str:
        return f"{self.graph_id}/{name}/{node.number}"

    def _control(self, name: str, node: NodeRun, effect: Effect | None = None) -> RunControl:
        """Return the control of the run that goes on, or make one."""
        key = self._key(name, node)
        control = self._controls.get(name)
        if control is None or control.key != key or (effect is not None and effect.do == "run"):
            control = self._controls[name] = RunControl(key)
        return control

    def _told_again(self, name: str, node: NodeRun) -> RunControl:
        """Return the control of a run after a crash, with what the run was told before."""
        control = self._control(name, node)
        if node.state in _TOLD:
            control.tell(_TOLD[node.state])
        return control

    def _carry_out(self, graph: ActionGraph, effect: Effect, node: NodeRun, control: RunControl) -> None:
        if effect.do == "run":
            self._in_thread(effect.node, self._act, graph, node, control)
        else:
            control.tell(effect.do)

    def _act(self, name: str, graph: ActionGraph, node: NodeRun, control: RunControl) -> None:
        """Run an action of a graph until its end."""
        try:
            query = self._runner.begin_run(self.graph_id, graph, name, node, control)
        except RrError as error:
            if not self._runner.is_closing():
                self._insist(Ended(name, node.number, "on_error", why=str(error)))
            return
        self._follow(name, node, control, query)

    def _follow(self, name: str, node: NodeRun, control: RunControl, query: Query) -> None:
        """Take the end of an action whose load is held, and release what it has loaded."""
        try:
            end = self._runner.end_of(query, name, node, control)
        except RrError as error:
            end = Ended(name, node.number, "on_error", why=str(error))
        if not self._runner.is_closing():
            self._insist(end, query)

    def _replaced(self, name: str, query: Query) -> list[Query]:
        """Keep what an action has loaded until the graph ends, or it has run again; return what is to be released."""
        if not self._graph.nodes[name].kept:
            return [query]
        before = self._take_kept({name})
        self._kept[name] = query
        return before

    def _take_kept(self, names: Set[str]) -> list[Query]:
        """Return what is kept of these actions, and keep it no longer."""
        return [self._kept.pop(name) for name in list(self._kept) if name in names]

    def _release_all(self, queries: list[Query]) -> None:
        for query in reversed(queries):
            self._release(query)

    def _release(self, query: Query) -> None:
        self._quietly(query.unload)

    def _quietly(self, do: Callable[[], None]) -> None:
        try:
            do()
        except RrError as error:
            logger.info("%s: %s", self._graph.name, error)

    def _in_thread(self, name: str, do: Callable[..., None], *args: Any) -> None:
        """Run what waits for an action in a thread of its own; it ends early if the graph or the process ends.

        When the graph is closed, nothing begins: close() knows each thread that it has to wait for.
        """

        def run() -> None:
            self._quietly(lambda: do(name, *args))
            with self._changing:
                self._threads.discard(thread)

        thread = threading.Thread(target=run, name=name, daemon=True)
        with self._changing:
            if not self._closed:
                self._threads.add(thread)
                thread.start()
