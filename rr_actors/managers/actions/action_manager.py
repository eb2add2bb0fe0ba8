"""Actions: the manager that runs actions, and the graphs made of them (thesis 2.5).

`actions/action` runs one action: its load callback is the action's run(). `actions/graph` runs a graph: its response is
the graph's JSON object with the states, and changes with each transition.
"""

from __future__ import annotations

import functools
import os
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import PurePath
from typing import Any, Literal

from rr_actors.actors.actor_tables import TableColumn, table
from rr_actors.base import pickling
from rr_actors.base.checks import is_number
from rr_actors.base.errors import (
    CatalogError,
    LoadFailed,
    LoadTimeout,
    NotFound,
    RegistrarDown,
    RrError,
    Unavailable,
    UnknownRegistrar,
    UsageError,
    is_a,
    shown,
)
from rr_actors.base.names import is_planned, new_id, short_id
from rr_actors.base.reporting.log import Log
from rr_actors.managers.actions.action import Action, RunControl, Word, bind, given_to, name_of, result_of, run_alone
from rr_actors.managers.actions.graph_checks import checked_inputs
from rr_actors.managers.actions.graph_documents import document_in, feedback, read_graph, run_in
from rr_actors.managers.actions.graph_engine import GraphEngine
from rr_actors.managers.actions.graph_library import GraphLibrary, Shelf
from rr_actors.managers.actions.graph_log import GraphLog, logged
from rr_actors.managers.actions.graph_model import ActionGraph, flat, wrong_graph
from rr_actors.managers.actions.graph_runs import (
    ENDED,
    LIVE,
    OVER,
    Begin,
    Change,
    Event,
    GraphRun,
    Halt,
    NodeEnded,
    NodeRun,
    Pause,
    Restored,
    Resume,
    first_run,
)
from rr_actors.registrar.declarations import server
from rr_actors.registrar.manager import Manager
from rr_actors.registrar.model.rows import LOADED, State
from rr_actors.registrar.queries import Query, Status
from rr_actors.registrar.registrar import begin_planned
from rr_actors.registrar.servers.callback_context import current
from rr_actors.runtime.processes.isolated import Events, run_isolated

logger = Log("rr_actors.managers.actions")

INTERRUPTED = "interrupted"
_OVER = ("FINISHED", "BYPASSED", "STOPPED", "ERROR")  # an action that has ended


@dataclass(frozen=True)
class RunAction:
    """The request to run one action.

    Attributes:
        action: the action's name.
        inputs: by flat names, "nav_goal::x".
        run: identifies the run: each has its own.
        attempt: of this run, if a crash has interrupted earlier ones.
        engine: the manager whose graph runs it; "": none.
    """

    action: str
    inputs: dict[str, Any] = field(default_factory=dict[str, Any])
    run: str = field(default_factory=new_id)
    attempt: int = 1
    engine: str = ""

    def __rr_title__(self) -> str:
        return f"{self.action}, attempt {self.attempt}"


@dataclass(frozen=True)
class ControlRun:
    """The request to tell a run what holds for it, or, if `ask`, to say that of a run of one of the graphs here.

    Attributes:
        run: identifies the run.
        word: "run", "pause" or "stop"; "over": stop, and answer when the run has ended.
        step: of its graph.
    """

    run: str
    word: Literal["run", "pause", "stop", "over", "ask"]
    step: int = 0
    id: str = field(default_factory=new_id)

    def __rr_title__(self) -> str:
        return f"{self.word} run {short_id(self.run)}"


@dataclass(frozen=True)
class RunControlled:
    """The response: what holds for the run, and since which step of its graph."""

    word: str
    step: int


@dataclass(frozen=True)
class ActionEnd:
    """The response: `result` is on_true or on_false; `outputs` by flat names.

    To an engine in another manager it is `INTERRUPTED` if the manager of the action stops: the action runs again.
    """

    result: str
    outputs: dict[str, Any]


@dataclass(frozen=True)
class RunGraph:
    """The request to run a graph.

    Attributes:
        graph: the name of a graph of the manager's folder, or a graph as a JSON object.
        inputs: of the entries, nested or by flat names.
        instance: identifies the run: each has its own.
        file: where the JSON object was read, for errors.
    """

    graph: str | dict[str, Any]
    inputs: dict[str, Any] = field(default_factory=dict[str, Any])
    instance: str = field(default_factory=new_id)
    file: str = ""

    def __rr_title__(self) -> str:
        if isinstance(self.graph, str):
            return self.graph
        return str(self.graph.get("graph_name") or PurePath(self.file).name.partition(".")[0] or "graph")


class Actions(Manager):
    """Serves `action` and `graph`: runs actions, and graphs of them in the Unified Meaning Representation Format.

    The holders of a graph hear UPDATE at each transition, and ERROR if it ends with on_error. To release it stops it. A
    graph goes on after a crash of this manager: no action runs again whose end is on disk.
    """

    _rr_side_by_side = True

    def __init__(
        self,
        actions: Sequence[type[Action] | str] = (),
        graphs: str | os.PathLike[str] | None = None,
        stop_s: float = 5.0,
        action_folder: str | os.PathLike[str] | None = None,
    ) -> None:
        """Take the classes of actions, or their names as "module:class", and a folder with graphs in ``*.json`` files.

        Args:
            stop_s: seconds that actions have to end when their graph is released.
            action_folder: a folder with further classes of actions in ``*.py`` files. They are code that runs in this
                manager's process. Each load of a graph, and of an action alone, finds what has changed there. What runs
                goes on with the classes that it began with.

        Raises:
            GraphError: a graph is wrong. `.file`, `.path`, `.expected`, `.got`
            ConfigError: a file of `action_folder` is wrong. `.file`, `.key` has the line, `.expected`, `.got`
            UsageError: an action is none, or `stop_s` is no number of at least 0.
        """
        if not is_number(stop_s) or stop_s < 0:
            raise UsageError(f"Actions: stop_s: expected a number of at least 0, got {shown(stop_s)}")
        self._library = GraphLibrary(actions, graphs, action_folder, self._rr_beginning())
        self._stop_s = stop_s
        self._lock = threading.Lock()
        self._engines: dict[str, GraphEngine] = {}
        self._instances: dict[str, str] = {}  # ids of graphs, by what their requests identify them by
        self._controls: dict[str, RunControl] = {}  # of the runs that are here, by their keys
        self._acting: set[Action] = set()
        self._closing = False

    def on_start(self) -> None:
        """Go on with the graphs that a crash, or the end of the system, has interrupted.

        A graph whose load was interrupted is loaded again, and may run already.
        """
        for query in self.registrar.queries():
            if is_planned(query.id):  # the crash came between an answer of another manager and its release
                threading.Thread(target=query.unload, kwargs={"timeout_s": None}, daemon=True).start()
        logs = logged(self.registrar.directory)
        resources = self.registrar.resources()
        for id in logs - {info.id for info in resources}:  # a crash came before it was removed
            GraphLog(self.registrar.directory, id).remove()
        found = [info for info in resources if info.server == "graph" and info.phase == LOADED]
        graphs = [info for info in found if info.id not in self._engines]
        lost: list[tuple[str, Status]] = []
        begun = [info for info in graphs if run_in(info.response).steps]
        engines = {info.id: self._restored(info.id, info.request, info.response, lost) for info in begun}
        ends = self._ends()
        for id, engine in engines.items():  # all of them are there: a graph tells its sub-graphs what it had told them
            if engine is not None:
                engine.restore(self.registrar.children(id), _key_of, ends)
        for info in graphs:  # one that has not begun asks the graph around it: that would wait for it if it told it
            if info.id not in engines and (engine := self._restored(info.id, info.request, info.response, lost)):
                self._begin_graph(engine, info.request, _flat_inputs(engine.graph, info.request.inputs))
        for id, status in lost:
            self.registrar.send_status(id, status)

    def on_stop(self) -> None:
        """Tell all actions to end. Those whose graph is not released run again when the manager starts again."""
        with self._lock:
            self._closing = True
            acting = list(self._acting)
        for action in acting:
            action.stopping.set()

    @table(
        "graphs",
        TableColumn("graph"),
        TableColumn("id", kind="id"),
        TableColumn("state"),
        TableColumn("ended", kind="bar", of="actions"),
        TableColumn("running", kind="long"),
        TableColumn("why", kind="problem"),
    )
    def graph_rows(self) -> list[dict[str, Any]]:
        """Return the graphs that are loaded: the state of each, what runs, and how many of its actions have ended."""
        with self._lock:
            engines = dict(self._engines)
        rows: list[dict[str, Any]] = []
        for id, engine in engines.items():
            graph, run = engine.graph, engine.run
            states = {name: node.state for name, node in run.nodes.items()}
            rows.append(
                {
                    "graph": graph.name,
                    "id": id,
                    "state": run.state,
                    "ended": sum(state in _OVER for state in states.values()),
                    "actions": len(states),
                    "running": [name for name, state in states.items() if state in LIVE],
                    "states": states,
                    "why": run.why,
                }
            )
        return rows

    # -- messages --------------------------------------------------------------------------------------------------

    def on_receive(self, message: Any) -> None:
        """Do what `rr-actors graph change` asks."""
        match message:
            case {"change_graph": str(graph), "new": dict() | str(), "start": str(start), "file": str(file)}:
                self.change_graph(graph, message["new"], start, file)
            case _:
                raise UsageError(f"{self.registrar.name}: expected a message to Actions, got {shown(message)}")

    def stop_graph(self, graph: str) -> None:
        """End a graph: stop its actions. Its state is STOPPED when they have ended. No action begins after the return.

        Args:
            graph: the id of the graph's resource.

        Raises:
            NotFound: no graph of this id runs here. `.id`, `.known`
            Unavailable: the manager of an action has not confirmed within 5 s that the action is to stop, so it may run
                on. That manager hears it when it answers again.
            CatalogError: the disk refuses to write it. The actions have heard it all the same, and none begins while
                this process lives; after a crash before there is room the graph goes on.
        """
        self._say(graph, Halt())

    def pause_graph(self, graph: str) -> None:
        """Pause a graph: no action begins until it is resumed, and `pausing` is set in those that run.

        Raises:
            NotFound: no graph of this id runs here. `.id`, `.known`
            GraphError: it has ended.
            Unavailable, CatalogError: as for stop_graph().
        """
        if (state := self._engine(graph).run.state) in ENDED:
            raise wrong_graph("", "graph_state", "one of RUNNING, PAUSED, HALTED", state)
        self._say(graph, Pause())

    def resume_graph(self, graph: str, start: str = "") -> None:
        """Resume a graph that is paused or halted.

        Args:
            start: an action of it that runs now, "TaNavigate_0".

        Raises:
            NotFound: no graph of this id runs here. `.id`, `.known`
            GraphError: it has no such action, or has ended; or it runs, and `start` is given.
            Unavailable: as for stop_graph().
        """
        state = self._engine(graph).run.state
        if state in ENDED or (start and state not in ("PAUSED", "HALTED")):
            raise wrong_graph("", "graph_state", "one of PAUSED, HALTED", state)
        self._say(graph, Resume(start))

    def change_graph(self, graph: str, new: str | dict[str, Any], start: str = "", file: str = "") -> None:
        """Go on with another graph: one commit puts it in the place of the one that runs.

        Actions that run go on if the new graph has the same. The others are stopped, and what they have loaded is
        released, before anything begins. If the new graph is wrong, nothing changes.

        Args:
            graph: the id of the graph's resource.
            new: the name of a graph of the folder, or a graph as a JSON object.
            start: an action of the new graph that runs then, "TaNavigate_0". Without it, actions that ran otherwise
                than the new graph says begin again. If nothing runs then, the entries do that are new.
            file: where the JSON object was read, for errors.

        Raises:
            NotFound: no graph of this id runs here. `.id`, `.known`
            GraphError: the new graph is wrong, or has no action `start`, or that lacks an input; or the graph that is
                to be changed has ended. `.file`, `.path`, `.expected`, `.got`
        """
        engine, shelf = self._engine(graph), self._library.look()
        change, before = Change(shelf.find(new, file), start), engine.shelf
        engine.shelf = shelf
        try:
            unconfirmed = engine.tell(change)
        except RrError:  # nothing has changed
            engine.shelf = before
            raise
        _raise_unconfirmed(unconfirmed)

    def _say(self, graph: str, event: Event) -> None:
        _raise_unconfirmed(self._engine(graph).tell(event))

    def _engine(self, graph: str) -> GraphEngine:
        with self._lock:
            engine, known = self._engines.get(graph) if is_a(graph, str) else None, tuple(self._engines)
        if engine is None:
            raise NotFound(
                f"no graph {shown(graph)}: expected one of {', '.join(known) or 'none'}", id=graph, known=known
            )
        return engine

    # -- servers ---------------------------------------------------------------------------------------------------

    @server("action", recovery="keep")
    def run_action(self, request: RunAction) -> ActionEnd:
        """Run an action until its end."""
        is_own = request.engine == self.registrar.name
        shelf = self._shelf_of(request.run) if is_own else self._library.look()
        kind = shelf.action(request.action)
        if is_own and current().attempt > 1:
            text = f"{request.action}: a crash has interrupted it, and its graph runs it again as the next attempt"
            raise LoadFailed(text, server=f"{self.registrar.name}/action")
        action = kind()
        bind(action, self.registrar, request.attempt + current().attempt - 1)
        control = RunControl(action)
        with self._lock:
            self._controls[request.run] = control
            self._acting.add(action)
            closing = self._closing
        try:
            if closing:
                action.stopping.set()
            if request.engine:
                self._ask(control, request)
            end = ActionEnd(*self._run(kind, action, request.inputs, control))
        finally:
            with self._lock:
                self._acting.discard(action)
                if self._controls.get(request.run) is control:
                    del self._controls[request.run]
            control.over.set()
        if self._closing and action.stopping.is_set():
            if request.engine not in ("", self.registrar.name):
                return ActionEnd(INTERRUPTED, {})
            raise LoadFailed(f"{request.action}: its manager stops", server=f"{self.registrar.name}/action")
        return end

    def _ask(self, control: RunControl, request: RunAction) -> None:
        """Ask the engine whether a run may begin: it may have been stopped or paused on the way here."""
        if request.engine == self.registrar.name:
            control.tell(*self._said(request.run))
            return
        ask = ControlRun(request.run, "ask")
        with self.registrar.load(f"{request.engine}/control", ask, timeout_s=None, response_type=RunControlled) as said:
            control.tell(_WORDS[said.response.word], said.response.step)

    def _said(self, key: str) -> tuple[Word, int]:
        engine = self._engine_of(key)
        return ("stop", 0) if engine is None else engine.said(key)

    def _engine_of(self, key: str) -> GraphEngine | None:
        """Return the engine of the graph that a run is of, by the key of the run."""
        with self._lock:
            return self._engines.get(key.partition("/")[0])

    @server("control", recovery="keep")
    def control_run(self, request: ControlRun) -> RunControlled:
        """Tell a run of this manager what holds for it, or say that of a run of one of its graphs."""
        if request.word == "ask":
            return RunControlled(*self._said(request.run))
        control = self._control_of(request.run)
        if control is not None:
            control.tell("stop" if request.word == "over" else _WORDS[request.word], request.step)
        while request.word == "over" and control is not None and not control.over.wait(0.1):
            if current().stopping.is_set():
                raise LoadFailed(f"{request.run}: it has not ended", server=f"{self.registrar.name}/control")
        return RunControlled(request.word, request.step)

    def _control_of(self, key: str) -> RunControl | None:
        with self._lock:
            return self._controls.get(key)

    def _run(
        self, kind: type[Action], action: Action, inputs: dict[str, Any], control: RunControl
    ) -> tuple[str, dict[str, Any]]:
        """Run an action here or in a process of its own, and return its result and outputs."""
        if not kind.isolate:
            if not control.begin():
                text = f"{name_of(kind)}: it was told to stop before it began"
                raise LoadFailed(text, server=f"{self.registrar.name}/action")
            return result_of(kind, action.run(given_to(kind, inputs)))
        name = f"{self.registrar.name}/{name_of(kind)}"
        call = pickling.dumps(functools.partial(run_alone, kind, inputs, action.attempt), f"the isolated action {name}")
        events, spawner = Events(action.stopping, action.pausing), self._rr_node.spawner
        ended = run_isolated(
            spawner, call, events, control.begin, name=name, timeout_s=kind.timeout_s, grace_s=self._stop_s
        )
        if ended.why:
            error = LoadFailed(f"{name_of(kind)}: {ended.why}", server=f"{self.registrar.name}/action")
            if ended.trace:
                error.add_note(f"In the process of {name}:\n{ended.trace}")
            raise error
        return ended.value

    @run_action.status
    def action_status(self, request: RunAction, status: Status) -> None:
        """Keep the statuses of what an action has loaded from its graph: the action itself decides, and has heard."""
        if status.query_id:
            status.handled()

    @server("graph", recovery="keep")
    def load_graph(self, request: RunGraph) -> dict[str, Any]:
        """Check a graph, and begin it."""
        shelf = self._library.look()
        graph = shelf.find(request.graph, request.file)
        inputs = checked_inputs(graph, _flat_inputs(graph, request.inputs))
        run = first_run(graph)
        engine = self._add(current().resource_id, request.instance, graph, run, shelf)
        self._begin_graph(engine, request, inputs, current().loaded)
        return feedback(graph, run)

    def _begin_graph(
        self, engine: GraphEngine, request: RunGraph, inputs: dict[str, Any], loaded: threading.Event | None = None
    ) -> None:
        """Have a graph begin in a thread of its own, as the graph around it says."""

        def around() -> Word:
            return self._said(request.instance)[0] if request.instance.partition("/")[0] in self._engines else "run"

        begins = Begin(inputs), loaded, around
        threading.Thread(target=engine.begin, args=begins, name=f"graph {engine.graph.name}", daemon=True).start()

    @load_graph.status
    def graph_status(self, request: RunGraph, status: Status) -> None:
        """Keep the statuses of actions from the holders: they hear how the graph ends."""
        if status.query_id:
            status.handled()

    @load_graph.unload
    def unload_graph(self, request: RunGraph, response: dict[str, Any] | None) -> None:
        """Stop what runs."""
        with self._lock:
            engine = self._engines.pop(current().resource_id, None)
            self._instances.pop(request.instance, None)
        if engine is not None:
            engine.close(self._stop_s)
        GraphLog(self.registrar.directory, current().resource_id).remove()

    def _add(self, id: str, instance: str, graph: ActionGraph, run: GraphRun, shelf: Shelf) -> GraphEngine:
        log = GraphLog(self.registrar.directory, id) if self.registrar.config.durability == "process" else None
        engine = GraphEngine(self, id, graph, run, shelf, self._stop_s, log)
        engine.replay()
        with self._lock:
            self._engines[id] = engine
            self._instances[instance] = id
        return engine

    def _restored(
        self, id: str, request: RunGraph, response: dict[str, Any], lost: list[tuple[str, Status]]
    ) -> GraphEngine | None:
        """Make the engine of a graph again; None: it does not fit, and is put to what is lost."""
        try:
            run = run_in(response)
            shelf = self._library.now
            graph = shelf.complete(read_graph(document_in(response)))
            if not run.steps:
                checked_inputs(graph, _flat_inputs(graph, request.inputs))
            return self._add(id, request.instance, graph, run, shelf)
        except CatalogError as error:
            lost.append((id, Status(State.FATAL, f"the graph cannot go on: {error}")))
        except RrError as error:
            text = f"the graph does not fit the actions of this version: {error}"
            lost.append((id, Status(State.FATAL, text)))
        return None

    def _ends(self) -> dict[str, tuple[str, dict[str, Any]]]:
        """Return the ends of actions that are on disk here."""
        infos = [info for info in self.registrar.resources() if info.server == "action" and info.phase == LOADED]
        return {info.request.run: (info.response.result, info.response.outputs) for info in infos}

    # -- for the engines -------------------------------------------------------------------------------------------

    def is_closing(self) -> bool:
        """Return whether this manager stops, so that ends of actions mean nothing."""
        return self._closing

    def _shelf_of(self, key: str) -> Shelf:
        """Return the actions and graphs that a graph runs with, by its id or by the key of one of its runs."""
        engine = self._engine_of(key)
        return self._library.now if engine is None else engine.shelf

    def begin_run(self, graph_id: str, graph: ActionGraph, node: str, run: NodeRun, key: str) -> Query:
        """Run an action or a sub-graph; return its query when that has ended, or when the sub-graph has begun."""
        action = graph.nodes[node]
        if not action.actor and action.action not in self._shelf_of(graph_id).actions:
            request: RunGraph | RunAction = RunGraph(action.action, run.inputs, key)
            return self.registrar.load(f"{self.registrar.name}/graph", request, parent=graph_id, timeout_s=None)
        request = RunAction(action.action, run.inputs, key, run.attempt, self.registrar.name)
        actor = action.actor or self.registrar.name
        return self.registrar.load(f"{actor}/action", request, parent=graph_id, timeout_s=None)

    def end_of(self, query: Query, node: str, run: NodeRun) -> NodeEnded | Restored:
        """Return how a run has ended whose query is held; of a sub-graph, wait for that."""
        response = query.response
        if isinstance(response, ActionEnd):
            if response.result == INTERRUPTED:
                return Restored((node,), run.number)
            return NodeEnded(node, run.number, response.result, response.outputs)
        ended = wait_ended(query, None)
        result = "on_error" if ended.result == "on_halted" else ended.result
        return NodeEnded(node, run.number, result, ended.outputs, ended.why)

    def tell_run(self, actor: str, key: str, word: Word, step: int) -> Callable[[float], str]:
        """Tell a run what holds for it, here or in another manager. Return a function that waits until the run has it.

        The manager of the run may not answer now. A run that begins there later asks first, and one that runs hears it
        when the manager answers: each word has its step, so that none comes too late.
        """
        if actor and actor != self.registrar.name:
            told = threading.Event()
            threading.Thread(target=self._tell_there, args=(actor, key, word, step, told), daemon=True).start()
            text = f"{actor} has not confirmed that {key.partition('/')[2]} is to {word}"
            return lambda within_s: "" if told.wait(within_s) else text
        if (control := self._control_of(key)) is not None:
            control.tell(word, step)
        with self._lock:
            sub_graph = self._engines.get(self._instances.get(key, ""))
        try:
            said = sub_graph.tell(_EVENTS[word]) if sub_graph is not None else []
        except CatalogError as error:
            said = [str(error)]
        return lambda within_s: "; ".join(said)

    def _tell_there(self, actor: str, key: str, word: Word | Literal["over"], step: int, told: threading.Event) -> None:
        try:
            told_there = begin_planned(self.registrar, f"{actor}/control", ControlRun(key, word, step), timeout_s=None)
            told_there.get().unload_if_held()
        except (RegistrarDown, UnknownRegistrar):  # it is gone, and with it its runs
            logger.info("%s: %s is gone", key, actor)
        except RrError as error:
            logger.warning("%s: %s cannot be told to %s: %s", key, actor, word, error)
            return
        told.set()

    def wait_over(self, actor: str, key: str) -> None:
        """Stop a run of another manager that a crash of this one has left there, and wait until it has ended."""
        if actor != self.registrar.name:
            self._tell_there(actor, key, "over", sys.maxsize, threading.Event())


_WORDS: dict[str, Word] = {"run": "run", "pause": "pause", "stop": "stop"}
_EVENTS: dict[Word, Event] = {"run": Resume(), "pause": Pause(), "stop": Halt()}


def wait_ended(query: Query, timeout_s: float | None, whole_s: float | None = None) -> GraphRun:
    """Return the run of a graph when it has ended or is halted.

    Args:
        whole_s: the time limit that errors name; None: `timeout_s`.

    Raises:
        LoadFailed: the graph is lost.
        LoadTimeout: it has not ended in time.
    """
    deadline = None if timeout_s is None else time.monotonic() + timeout_s
    while (run := run_in(query.response)).state not in OVER:
        left_s = None if deadline is None else max(0.0, deadline - time.monotonic())
        try:
            status = query.wait_status(timeout_s=left_s)
        except LoadTimeout as error:
            raise _not_ended(query, run_in(query.response), whole_s or timeout_s or 0.0) from error
        if status.state is State.FATAL:
            raise LoadFailed(f"{query.server_id}: the graph is lost: {status.message}", server=query.server_id)
    return run


def _not_ended(query: Query, run: GraphRun, timeout_s: float) -> LoadTimeout:
    live = ", ".join(f"{name} {node.state}" for name, node in run.nodes.items() if node.state in LIVE) or "none"
    text = f"{query.server_id}: the graph has not ended within {timeout_s:g} s: {run.state}, running: {live}"
    return LoadTimeout(text, server=query.server_id, timeout_s=timeout_s)


def _flat_inputs(graph: ActionGraph, inputs: dict[str, Any]) -> dict[str, Any]:
    leaves = [name for entry in graph.entry for name in graph.nodes[entry].inputs]
    return flat(inputs, leaves)


def _key_of(part: Query) -> str:
    request = part.request
    return request.instance if isinstance(request, RunGraph) else request.run


def _raise_unconfirmed(unconfirmed: Sequence[str]) -> None:
    if unconfirmed:
        raise Unavailable("; ".join(unconfirmed))
