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

from rr_actors.base.errors import CatalogError, RrError, Unavailable, UnknownQuery, text_of
from rr_actors.base.reporting.log import Log
from rr_actors.managers.actions.action import Word
from rr_actors.managers.actions.graph_documents import feedback
from rr_actors.managers.actions.graph_library import Shelf
from rr_actors.managers.actions.graph_log import GraphLog
from rr_actors.managers.actions.graph_model import ActionGraph
from rr_actors.managers.actions.graph_runs import (
    ENDED,
    LIVE,
    Begin,
    Change,
    Event,
    GraphRun,
    Halt,
    NodeEffect,
    NodeEnded,
    NodeRun,
    Pause,
    Restored,
    decide,
)
from rr_actors.registrar.model.rows import State
from rr_actors.registrar.queries import Query, Status
from rr_actors.registrar.registrar import Registrar

logger = Log("rr_actors.managers.actions")

_NO_ROOM_S = 0.1  # how soon it tries again to write what the disk has refused
_SMALL = 20
_RESPONSE_S = 0.005
"""The response of a graph with more actions than _SMALL is written at most once in so many seconds for each action."""
_AGAIN_S = 1.0
_KILLED_S = 2.0  # the kill of an isolated run that does not stop begins when its time is over; it is waited for
_MOST_TEXTS = 10  # the newest, of the transitions that one status is about
CONFIRMED_S = 5.0
"""How long a message waits until the managers of the runs have confirmed what they were told."""
_WORDS: dict[str, Word] = {"RUNNING": "run", "PAUSED": "pause", "STOPPING": "stop"}


class ActionRunner(Protocol):
    """What the manager does for an engine."""

    registrar: Registrar

    def is_closing(self) -> bool:
        """Return whether the manager stops, so that ends of actions mean nothing."""
        ...

    def begin_run(self, graph_id: str, graph: ActionGraph, node: str, run: NodeRun, key: str) -> Query:
        """Run an action, and return its query when it has ended."""
        ...

    def end_of(self, query: Query, node: str, run: NodeRun) -> NodeEnded | Restored:
        """Return how a run has ended whose query is held, or that it is to run again; of a sub-graph, wait for that."""
        ...

    def tell_run(self, actor: str, key: str, word: Word, step: int) -> Callable[[float], str]:
        """Tell a run what holds for it. Return a function that waits for so many seconds until the run has it.

        The function returns what is wrong if the manager of the run has not confirmed it by then, or else "".
        """
        ...

    def wait_over(self, actor: str, key: str) -> None:
        """Stop a run of another manager that a crash of this one has left there, and wait until it has ended."""
        ...


class GraphEngine:
    """One run of a graph. From any thread.

    Attributes:
        graph_id: the id of the resource.
        shelf: the actions and graphs that it runs with. The manager puts another one here when the graph changes.
    """

    def __init__(
        self,
        runner: ActionRunner,
        graph_id: str,
        graph: ActionGraph,
        run: GraphRun,
        shelf: Shelf,
        stop_s: float = 5.0,
        log: GraphLog | None = None,
    ) -> None:
        self.graph_id = graph_id
        self.shelf = shelf
        self._stop_s = stop_s
        self._log = log
        self._texts: list[str] = []  # of the transitions that are in the log alone
        self._write_at = 0.0  # when the next transition is written with the response
        self._writing: threading.Timer | None = None  # writes the response if no other transition does
        self._runner, self._graph, self._run = runner, graph, run
        self._kept: dict[str, Query] = {}
        self._stops: dict[str, threading.Timer] = {}  # of the runs that were told to stop, by their keys
        self._threads: set[threading.Thread] = set()
        self._changing = threading.RLock()
        self._closed = False
        self._unwritten: Halt | Pause | None = None  # the runs have it; the disk has refused it, and takes nothing else
        self._begun = threading.Event()  # the first event is on disk: messages wait for that
        if run.steps:
            self._begun.set()

    def replay(self) -> None:
        """Take the ends that are in the log alone, after a crash.

        Raises:
            CatalogError: the log is damaged.
        """
        for event in self._log.since(self._run.steps) if self._log is not None else []:
            self._run, _ = decide(self._graph, self._run, event)
            self._texts.append(f"{event.node}: {event.result}")

    @property
    def graph(self) -> ActionGraph:
        """The graph that is run now."""
        return self._graph

    @property
    def run(self) -> GraphRun:
        """The run as it is on disk. It waits while a transition is written: who has heard of that finds it here."""
        with self._changing:
            return self._run

    def begin(
        self, event: Begin, loaded: threading.Event | None = None, word: Callable[[], Word] = lambda: "run"
    ) -> None:
        """Tell the first event, when the load of the graph itself is on disk. In a thread of the engine's own.

        Args:
            loaded: says that it is; None: it was on disk before.
            word: returns what holds for a sub-graph in the graph around it.
        """
        if loaded is not None:
            loaded.wait()
        try:
            match word():
                case "stop":
                    self._begun.set()
                    self._insist(Halt())
                    return
                case "pause":
                    event = Begin(event.inputs, in_pause=True)
                case _:
                    pass
            self._insist(event)
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
                self._in_thread(name, self._follow, node, query)
                self._tell_run(name, node)
            elif (end := ends.get(self._key(name, node))) is not None:
                self._in_thread(name, self._take_end, NodeEnded(name, node.number, *end))
            elif node.actor:
                self._in_thread(name, self._wait_over, node)
            else:
                lost.append(name)
        for query in held.values():
            self._release(query)
        if lost:
            self._in_thread("restored", self._take_end, Restored(tuple(lost)))
        with self._changing:
            if self._texts and self._writing is None:
                self._write_later(0.0)

    def said(self, key: str) -> tuple[Word, int]:
        """Return what holds for the run with this key, and since which step of the graph."""
        run = self._run
        runs = {self._key(name, node): node for some in (run.nodes, run.leaving) for name, node in some.items()}
        state = runs[key].state if key in runs and not self._closed else ""
        word = _WORDS.get(state, "stop")
        if self._unwritten is not None and word == "run":
            word = _word_of(self._unwritten)
        return word, run.steps

    def tell(self, event: Event, query: Query | None = None) -> list[str]:
        """Take an event: decide, commit, and do what follows from it.

        Return what the managers of runs have not confirmed in time: they hear it later.

        Args:
            query: of the run that has ended. What it has loaded is released after the commit, and before others begin,
                or kept.

        Raises:
            GraphError: the event is none that the graph can have.
            UnknownQuery: the graph is not there any more.
            CatalogError: it cannot be written, and nothing has happened. Only a Halt or a Pause reaches what runs all
                the same: a robot stops also if the disk is full. It is written when there is room, before all else.
        """
        if not isinstance(event, Begin):
            self._begun.wait()
        with self._changing:
            if self._closed:
                return []
            graph = event.graph if isinstance(event, Change) else self._graph
            if isinstance(event, NodeEnded) and (
                timer := self._stops.pop(self._run_key(event.node, event.number), None)
            ):
                timer.cancel()
            left = self._run.leaving
            stale: list[Query] = []
            try:
                self._write_unwritten()
                run, effects = decide(self._graph, self._run, event)
                is_new = run is not self._run
                if is_new:
                    self._commit(graph, run, event)
            except CatalogError as error:
                if not isinstance(event, Halt | Pause):
                    raise
                raise self._tell_unwritten(event, error) from error
            if is_new:
                if graph is not self._graph:
                    stale += self._take_kept(self._kept.keys() - graph.unchanged(self._graph))
                self._graph, self._run = graph, run
            if query is not None and isinstance(event, NodeEnded):
                stale += [query] if event.node in left else self._replaced(event.node, query)
        self._release_all(stale)
        waits = [self._carry_out(graph, effect, run.node(effect.node), run.steps) for effect in effects]
        if not is_new and isinstance(event, Pause | Halt):  # asked again: not all may have confirmed it before
            waits = [self._tell_run(name, node) for name, node in _live(run) if node.state != "RUNNING"]
        if is_new and run.state in ENDED:
            self._end_of_all()
        deadline = time.monotonic() + CONFIRMED_S
        return [*filter(None, (wait(max(0.0, deadline - time.monotonic())) for wait in waits))]

    def _tell_unwritten(self, event: Halt | Pause, error: CatalogError) -> CatalogError:
        """Tell what runs to stop or to pause, although the disk has refused to write that. The caller has the lock.

        Return the error for the caller.
        """
        is_first = self._unwritten is None
        if not isinstance(self._unwritten, Halt):
            self._unwritten = event
        word = _word_of(self._unwritten or event)
        for name, node in _live(self._run):
            self._runner.tell_run(node.actor, self._key(name, node), word, self._run.steps + 1)
        if is_first:
            self._in_thread(f"{word} later", self._insist_unwritten)
        text = f"{error}; its actions {word} all the same; the graph goes on if a crash comes before there is room"
        return CatalogError(text, **error.details)

    def _write_unwritten(self) -> None:
        """Write what was told before it was written. The caller has the lock.

        Raises:
            CatalogError: there is no room yet.
        """
        event = self._unwritten
        if event is None:
            return
        run, effects = decide(self._graph, self._run, event)
        if run is not self._run:
            self._commit(self._graph, run, event)
            self._run = run
        self._unwritten = None
        for effect in effects:
            self._carry_out(self._graph, effect, run.node(effect.node), run.steps)
        if run.state in ENDED:
            self._in_thread("end", self._end_later)

    def _end_later(self, name: str) -> None:
        self._end_of_all()

    def _insist_unwritten(self, name: str) -> None:
        """Write what was told before it was written, as soon as there is room."""
        while self._unwritten is not None:
            try:
                with self._changing:
                    if self._closed:
                        return
                    self._write_unwritten()
            except CatalogError as error:
                logger.warning("%s: waits until it can be written: %s", self._graph.name, error)
                time.sleep(_NO_ROOM_S)

    def _insist(self, event: Event, query: Query | None = None) -> None:
        """Tell an event that has happened already. While the disk refuses it, try again: nobody else tells it.

        If it cannot be told for another reason, the action ends with on_error, or else the graph is lost: no state on
        disk waits for what nobody tells.
        """
        while True:
            try:
                for unconfirmed in self.tell(event, query):
                    logger.warning("%s: %s", self._graph.name, unconfirmed)
                return
            except CatalogError as error:
                logger.warning("%s: waits until it can be written: %s", self._graph.name, error)
                time.sleep(_NO_ROOM_S)
            except (UnknownQuery, Unavailable) as error:  # the graph is released, or the process ends
                logger.info("%s: %s", self._graph.name, error)
                return
            except Exception as error:
                if not isinstance(event, NodeEnded) or event.result == "on_error":
                    self._lose(error)
                    return
                logger.warning("%s: %s: its end cannot be kept", self._graph.name, event.node, exc_info=error)
                event = NodeEnded(event.node, event.number, "on_error", why=f"its end cannot be kept: {text_of(error)}")

    def _lose(self, error: Exception) -> None:
        logger.error("%s: it cannot go on", self._graph.name, exc_info=error)
        status = Status(State.FATAL, f"the graph cannot go on: {text_of(error)}")
        self._quietly(lambda: self._runner.registrar.send_status(self.graph_id, status))

    def close(self, stop_s: float) -> None:
        """Stop what runs, and wait so many seconds for that and for releases: the graph is being unloaded."""
        with self._changing:
            self._closed = True
            threads, run = list(self._threads), self._run
            for timer in [*self._stops.values(), *filter(None, [self._writing])]:
                timer.cancel()
            if self._log is not None:
                self._log.close()
        for name, node in _live(run):
            self._runner.tell_run(node.actor, self._key(name, node), "stop", run.steps + 1)
        is_any_isolated = any(self._is_isolated(name, node) for name, node in _live(run))
        deadline = time.monotonic() + stop_s + (_KILLED_S if is_any_isolated else 0.0)
        for thread in threads:
            thread.join(max(0.0, deadline - time.monotonic()))
            if thread.is_alive():
                logger.warning("%s: %s has not ended within %g s of stopping", self._graph.name, thread.name, stop_s)

    def _is_isolated(self, name: str, node: NodeRun) -> bool:
        """Return whether an action runs here in a process of its own, which is killed if it does not stop."""
        known = self._graph.nodes.get(name)
        kind = None if known is None or node.actor else self.shelf.actions.get(known.action)
        return kind is not None and kind.isolate

    # -- on disk ---------------------------------------------------------------------------------------------------

    def _commit(self, graph: ActionGraph, run: GraphRun, event: Event) -> None:
        text = f"{event.node}: {event.result}" if isinstance(event, NodeEnded) else type(event).__name__.lower()
        if not (isinstance(event, NodeEnded) and run.state == self._run.state and self._note(run.steps, event)):
            self._write(graph, run, text)
            return
        self._texts.append(text)
        if self._writing is None:
            self._write_later(self._write_at - time.monotonic())

    def _note(self, step: int, event: NodeEnded) -> bool:
        """Write the end of an action to the log, if the response was written a short while ago."""
        return self._log is not None and time.monotonic() < self._write_at and self._log.append(step, event)

    def _write(self, graph: ActionGraph, run: GraphRun, text: str = "") -> None:
        """Write the response: the whole graph, with all that the log has."""
        texts = [*self._texts, *([text] if text else [])]
        said = f"... {'; '.join(texts[-_MOST_TEXTS:])}" if len(texts) > _MOST_TEXTS else "; ".join(texts)
        self._runner.registrar.update_response(self.graph_id, feedback(graph, run), said)
        self._texts.clear()
        if self._log is not None:
            self._log.clear()
            self._write_at = time.monotonic() + _RESPONSE_S * len(run.nodes) if len(run.nodes) > _SMALL else 0.0

    def _write_later(self, after_s: float) -> None:
        self._writing = threading.Timer(max(0.0, after_s), self._write_now)
        self._writing.daemon = True
        self._writing.start()

    def _write_now(self) -> None:
        with self._changing:
            self._writing = None
            if self._closed or not self._texts:
                return
            try:
                self._write(self._graph, self._run)
            except CatalogError as error:
                logger.info("%s: %s", self._graph.name, error)
                self._write_later(_AGAIN_S)
            except RrError as error:  # it has become too long: the next transition hears it
                logger.info("%s: %s", self._graph.name, error)
                self._write_at = 0.0

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
        return self._run_key(name, node.number)

    def _run_key(self, name: str, number: int) -> str:
        return f"{self.graph_id}/{name}/{number}"

    def _carry_out(self, graph: ActionGraph, effect: NodeEffect, node: NodeRun, step: int) -> Callable[[float], str]:
        if effect.do == "run":
            self._in_thread(effect.node, self._act, graph, node)
            return _confirmed
        if effect.do == "stop":
            self._watch_stop(effect.node, node)
        word: Word = "run" if effect.do == "resume" else effect.do
        return self._runner.tell_run(node.actor, self._key(effect.node, node), word, step)

    def _tell_run(self, name: str, node: NodeRun) -> Callable[[float], str]:
        """Tell a run again what holds for it."""
        return self._runner.tell_run(node.actor, self._key(name, node), _WORDS[node.state], self._run.steps)

    def _watch_stop(self, name: str, node: NodeRun) -> None:
        """Say so if an action has not ended some time after it was told to stop."""

        def look() -> None:
            now = self._run.leaving.get(name) or self._run.nodes.get(name)
            if self._closed or now is None or (now.state, now.number) != ("STOPPING", node.number):
                return
            text = f"{name} has not ended within {self._stop_s:g} s of stopping"
            logger.warning("%s: %s", self._graph.name, text)
            self._quietly(lambda: self._runner.registrar.send_status(self.graph_id, Status(State.WARNING, text)))

        timer = threading.Timer(self._stop_s, look)
        timer.daemon = True
        with self._changing:
            if not self._closed:
                self._stops[self._key(name, node)] = timer
                timer.start()

    def _act(self, name: str, graph: ActionGraph, node: NodeRun) -> None:
        """Run an action of a graph until its end."""
        try:
            query = self._runner.begin_run(self.graph_id, graph, name, node, self._key(name, node))
        except Exception as error:
            if not self._runner.is_closing():
                self._insist(NodeEnded(name, node.number, "on_error", why=_why(error)))
            return
        self._follow(name, node, query)

    def _follow(self, name: str, node: NodeRun, query: Query) -> None:
        """Take the end of an action whose load is held, and release what it has loaded."""
        try:
            end = self._runner.end_of(query, name, node)
        except Exception as error:
            end = NodeEnded(name, node.number, "on_error", why=_why(error))
        if self._runner.is_closing():
            return
        if isinstance(end, Restored):
            self._release(query)
            self._insist(end)
        else:
            self._insist(end, query)

    def _wait_over(self, name: str, node: NodeRun) -> None:
        """Wait until a run in another manager has ended, which lives on after a crash of this one."""
        self._runner.wait_over(node.actor, self._key(name, node))
        self._insist(Restored((name,)))

    def _take_end(self, name: str, event: Event) -> None:
        self._insist(event)

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
            try:
                self._quietly(lambda: do(name, *args))
            except Exception as error:
                self._lose(error)
            with self._changing:
                self._threads.discard(thread)

        thread = threading.Thread(target=run, name=name, daemon=True)
        with self._changing:
            if not self._closed:
                self._threads.add(thread)
                thread.start()


def _live(run: GraphRun) -> list[tuple[str, NodeRun]]:
    """Return the actions that run, with those that leave."""
    return [(name, node) for some in (run.nodes, run.leaving) for name, node in some.items() if node.state in LIVE]


def _word_of(event: Halt | Pause) -> Word:
    return "stop" if isinstance(event, Halt) else "pause"


def _confirmed(within_s: float) -> str:
    """Return that nothing is wrong: nobody has to confirm it."""
    return ""


def _why(error: Exception) -> str:
    return str(error) if isinstance(error, RrError) else text_of(error)
