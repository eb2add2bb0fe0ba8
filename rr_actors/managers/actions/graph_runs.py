"""Graph runs: what happens in a graph next. One run of a graph is a value; each event makes the next one, and effects.

The engine carries the effects out when the value that they belong to is on disk. After a crash it goes on from there.

What an action does when a parent ends is the response of its relation to that parent's result. "run" waits for all
required parents; what they have said is forgotten when the action runs, so that joins in cycles join again. The other
responses do not wait.

A run can go on with another graph (Change). What the new graph does not have is stopped. Nothing begins until that has
ended, so that an action finds free what the one in its place has held.
"""

from __future__ import annotations

from typing import Any, Literal

import msgspec

from rr_actors.managers.actions.graph_checks import checked_inputs
from rr_actors.managers.actions.graph_model import EXIT, ActionGraph, ActionNode, ParentRelation, wrong_graph

MOST_ATTEMPTS = 3

LIVE = ("RUNNING", "PAUSED", "STOPPING")  # an action that runs
_NOTHING = object()
ENDED = ("FINISHED", "STOPPED", "ERROR")  # a graph that nothing changes any more
OVER = (*ENDED, "HALTED")  # a graph in which nothing runs


class NodeRun(msgspec.Struct, frozen=True, omit_defaults=True):
    """One action in a run of a graph.

    Attributes:
        state: UNINITIALIZED, RUNNING, PAUSED, STOPPING, FINISHED, BYPASSED or ERROR; INITIALIZED: it will run when the
            graph is resumed, or when the actions have ended that a change of the graph stops.
        number: of its newest run, which has a higher one than those before.
        attempt: of that run: more than 1 after a crash.
        heard: the required parents that have ended since it last began: the result that meant "run", or "".
        given: what parents have given it since then.
        inputs: what it runs with, while it runs.
        again: whether it runs again when it has stopped.
        why: the error that it ended with.
        result: how its newest run has ended.
        actor: the manager that runs it; "": that of the graph.
        lost: whether a crash has ended its run while it was paused: it begins anew when it is resumed.
    """

    state: str = "UNINITIALIZED"
    number: int = 0
    attempt: int = 1
    heard: dict[str, str] = {}
    given: dict[str, Any] = {}
    inputs: dict[str, Any] = {}
    again: bool = False
    why: str = ""
    result: str = ""
    actor: str = ""
    lost: bool = False


class GraphRun(msgspec.Struct, frozen=True):
    """One run of a graph.

    Attributes:
        state: INITIALIZED, RUNNING, PAUSED, STOPPING, FINISHED, STOPPED, ERROR or HALTED.
        nodes: by the name in the graph.
        result: how it has ended: on_true, on_false, on_stopped or on_error.
        outputs: what the exits have given.
        heard: the required exits that have ended: the result that meant "run", or "".
        ending: the state that it will have when nothing runs.
        why: the error that it ended with.
        steps: how many events have changed it.
        leaving: the actions that a change of the graph stops, by their names in the graph that they ran in.
    """

    state: str = "INITIALIZED"
    nodes: dict[str, NodeRun] = {}
    result: str = ""
    outputs: dict[str, Any] = {}
    heard: dict[str, str] = {}
    ending: str = ""
    why: str = ""
    steps: int = 0
    leaving: dict[str, NodeRun] = {}

    def node(self, name: str) -> NodeRun:
        """Return the action of this name that may run: beside one that leaves, none of the same name does."""
        return self.leaving.get(name) or self.nodes[name]


class Begin(msgspec.Struct, frozen=True):
    """Run the entries, with these inputs by flat names; if it begins in a pause, when that is over."""

    inputs: dict[str, Any] = {}
    in_pause: bool = False


class NodeEnded(msgspec.Struct, frozen=True):
    """A run of an action has ended; `why`: with this error."""

    node: str
    number: int
    result: str
    outputs: dict[str, Any] = {}
    why: str = ""


class Halt(msgspec.Struct, frozen=True):
    """Stop what runs, and end the graph."""


class Pause(msgspec.Struct, frozen=True):
    """Pause what runs, and begin nothing until Resume."""


class Resume(msgspec.Struct, frozen=True):
    """Go on after a pause, or in a halted graph; with `start`, run this action now."""

    start: str = ""


class Change(msgspec.Struct, frozen=True):
    """Go on with another graph, which has been checked; with `start`, run this action of it.

    An action that runs goes on if the new graph has the same, whatever its relations are there; else it is stopped.
    What is ready runs: an action whose required parents have all ended, as the new graph says. Without `start`, so
    does an action that was running otherwise than the new graph says. If nothing runs then, the entries do that are
    new.
    """

    graph: ActionGraph
    start: str = ""


class Restored(msgspec.Struct, frozen=True):
    """A crash, or a restart, has ended the runs of these actions before their end was on disk.

    `number`: of the run of the only one; 0: the newest run of each.
    """

    lost: tuple[str, ...]
    number: int = 0


Event = Begin | NodeEnded | Halt | Pause | Resume | Change | Restored


class NodeEffect(msgspec.Struct, frozen=True):
    """What to do for one action: run it, or tell its run to stop, to pause, or to resume."""

    do: Literal["run", "stop", "pause", "resume"]
    node: str


def first_run(graph: ActionGraph) -> GraphRun:
    """Return the run of a graph in which nothing has happened."""
    return GraphRun(nodes={name: NodeRun() for name in graph.nodes})


def decide(graph: ActionGraph, run: GraphRun, event: Event) -> tuple[GraphRun, tuple[NodeEffect, ...]]:
    """Return what a run becomes by an event, and what is to be done when that is on disk.

    An event that does not concern the run, such as the end of a run that is over, changes nothing. After Change, the
    run belongs to the graph of that event.

    Raises:
        GraphError: a required input has no value; Resume or Change starts an action that is not there; or the run of
            which the graph is changed has ended.
    """
    decision = _Decision(graph, run)
    match event:
        case Begin():
            decision.begin(event.inputs, event.in_pause)
        case NodeEnded():
            decision.ended(event)
        case Halt():
            decision.end("STOPPED", "on_stopped")
        case Pause():
            decision.pause()
        case Resume():
            decision.resume(event.start)
        case Change():
            decision.change(event.graph, event.start)
        case Restored():
            decision.restored(event.lost, event.number)
    decision.settle()
    return decision.outcome()


class _Decision:
    """The consequences of one event."""

    def __init__(self, graph: ActionGraph, run: GraphRun) -> None:
        self.graph, self.before = graph, run
        self.state, self.result, self.ending, self.why = run.state, run.result, run.ending, run.why
        self.nodes, self.outputs, self.heard = dict(run.nodes), run.outputs, run.heard
        self.leaving = dict(run.leaving)
        self.effects: list[NodeEffect] = []
        self.bypassed: set[str] = set()
        self.has_other_graph = False

    def outcome(self) -> tuple[GraphRun, tuple[NodeEffect, ...]]:
        changed = msgspec.structs.replace(
            self.before,
            state=self.state,
            nodes=self.nodes,
            result=self.result,
            outputs=self.outputs,
            heard=self.heard,
            ending=self.ending,
            why=self.why,
            leaving=self.leaving,
        )
        if changed == self.before and not self.has_other_graph:
            return self.before, ()
        return msgspec.structs.replace(changed, steps=self.before.steps + 1), tuple(self.effects)

    def put(self, name: str, **changes: Any) -> None:
        self.nodes[name] = msgspec.structs.replace(self.nodes[name], **changes)

    def live(self) -> list[str]:
        return [name for name, node in self.nodes.items() if node.state in LIVE]

    # -- events ----------------------------------------------------------------------------------------------------

    def begin(self, inputs: dict[str, Any], in_pause: bool) -> None:
        if self.state != "INITIALIZED":
            return
        checked_inputs(self.graph, inputs)
        self.state = "PAUSED" if in_pause else "RUNNING"
        for name in self.graph.entry:
            known = self.graph.nodes[name].inputs
            self.put(name, given={key: value for key, value in inputs.items() if key in known})
            self.start(name)

    def ended(self, event: NodeEnded) -> None:
        if event.node in self.leaving:
            self.left(event)
            return
        node = self.nodes.get(event.node)
        if node is None or node.state not in LIVE or node.number != event.number:
            return
        result = "on_stopped" if node.state == "STOPPING" else event.result
        failed = result == "on_error"
        state, why = ("ERROR", event.why) if failed else ("FINISHED", "")
        self.put(event.node, state=state, why=why, inputs={}, result=result, lost=False)
        if self.ending:
            return
        if node.again:
            self.put(event.node, again=False)
            self.start(event.node)
        else:
            self.tell_children(event.node, result, event.outputs, event.why)
            if self.graph.nodes[event.node].spontaneous and result in ("on_true", "on_false") and not self.ending:
                self.put(event.node, given=self._given_before(event.node, node))
                self.start(event.node)

    def _given_before(self, name: str, node: NodeRun) -> dict[str, Any]:
        """Return what a spontaneous action was given for its last run: the next has the same, or what is newer."""
        inputs = self.graph.nodes[name].inputs
        return {key: value for key, value in node.inputs.items() if key in inputs} | self.nodes[name].given

    def end(self, state: str, result: str) -> None:
        """Stop what runs; the graph has ended when nothing runs."""
        if self.ending or self.state in ENDED:
            return
        self.ending, self.result = state, result
        for name in self.nodes:
            self.stop(name)

    def pause(self) -> None:
        if self.state != "RUNNING":
            return
        self.state = "PAUSED"
        for name in self.live():
            self.pause_node(name)

    def resume(self, start: str) -> None:
        if start and start not in self.nodes:
            raise wrong_graph(self.graph.file, "start", f"one of {', '.join(self.nodes)}", start)
        if self.state not in ("PAUSED", "HALTED"):
            return
        self.state, self.result, self.why = "RUNNING", "", ""
        for name in [name for name, node in self.nodes.items() if node.state == "PAUSED"]:
            self.resume_node(name)
        self.start_waiting()
        if start:
            self.start_named(start)

    def restored(self, lost: tuple[str, ...], number: int) -> None:
        for name in lost:
            node = self.leaving.get(name) or self.nodes.get(name)
            if node is None or number not in (0, node.number):
                continue
            if node.state == "STOPPING":
                self.ended(NodeEnded(name, node.number, "on_stopped"))
            elif node.state == "PAUSED":  # nothing begins in a pause, and what a crash ends there is no attempt
                self.put(name, lost=True)
            elif node.state in LIVE and node.attempt >= MOST_ATTEMPTS:
                why = f"a crash has interrupted {name} in {MOST_ATTEMPTS} attempts"
                self.ended(NodeEnded(name, node.number, "on_error", why=why))
            elif node.state in LIVE:
                self.put(name, attempt=node.attempt + 1)
                self.effects.append(NodeEffect("run", name))

    def settle(self) -> None:
        """See whether the graph has come to its end, or cannot go on."""
        if self.ending:
            self.state = "STOPPING" if self.live() or self.leaving else self.ending
        elif self.state == "RUNNING" and not (self.live() or self.leaving or self.waiting()):
            failed = [name for name, node in self.nodes.items() if node.state == "ERROR"]
            if self.graph.dialect == 2:
                self.state, self.result = "HALTED", "on_halted"
                self.why = self.nodes[failed[0]].why if failed else self.why_halted()
            else:
                self.state, self.result = ("ERROR", "on_error") if failed else ("FINISHED", "on_true")
                self.why = self.nodes[failed[0]].why if failed else ""

    def why_halted(self) -> str:
        """Return what the actions that have not run wait for."""
        for name, node in self.nodes.items():
            required = [parent for parent, one in self.graph.nodes[name].parents.items() if one.required]
            waits_for = [parent for parent in required if parent not in node.heard]
            if node.heard and waits_for:
                return f"nothing runs: {name} waits for {', '.join(waits_for)}"
            if self.is_ready(name) and (lacks := self.graph.nodes[name].lacking(node.given)):
                return f"nothing runs: {name} has no value for {', '.join(lacks)}"
        return "every child ignores the result, and nothing runs"

    # -- another graph ---------------------------------------------------------------------------------------------

    def change(self, graph: ActionGraph, start: str) -> None:
        if self.ending or self.state == "INITIALIZED":
            raise wrong_graph(graph.file, "graph_state", "one of RUNNING, PAUSED, HALTED", self.state)
        if start and start not in graph.nodes:
            raise wrong_graph(graph.file, "start", f"one of {', '.join(graph.nodes)}", start)
        stay, before = graph.unchanged(self.graph), self.graph
        ready_before = {name for name in (*self.nodes, EXIT) if self.is_ready(name)}
        again = [name for name in self.nodes if name not in stay and self.leave(name)]
        if self.state == "HALTED":
            self.state, self.result, self.why = "RUNNING", "", ""
        self.graph, self.has_other_graph = graph, True
        self.nodes = {name: self.taken_over(name, before, stay) for name in graph.nodes}
        self.heard = _still_heard(self.ended_before(graph.exit, before.exit) | self.heard, graph.exit, stay)
        ready = [name for name in (*graph.nodes, EXIT) if self.is_ready(name)]
        new = [name for name in ready if name not in ready_before or name not in (*stay, EXIT)]
        self.start_in_other(start, [name for name in again if name in graph.nodes], new)

    def start_in_other(self, start: str, again: list[str], ready: list[str]) -> None:
        """Begin what is to begin in a graph that is new."""
        if start:
            self.start_named(start)
        elif EXIT in ready:
            result = [*filter(None, self.heard.values())][-1]
            self.finish(result, "")
            return
        for name in ready if start else [*again, *ready]:
            if name != EXIT:
                self.start(name)
        if not (self.live() or self.waiting()):
            for name in self.graph.entry:
                if self.nodes[name].state == "UNINITIALIZED":
                    self.start_named(name)

    def leave(self, name: str) -> bool:
        """Stop an action that the new graph does not have; return whether it is to run there as that says."""
        node = self.nodes[name]
        if node.lost:
            return True
        if node.state in LIVE:
            self.leaving[name] = msgspec.structs.replace(node, state="STOPPING", again=False)
        if node.state in ("RUNNING", "PAUSED"):
            self.effects.append(NodeEffect("stop", name))
        return node.again or node.state in ("RUNNING", "PAUSED", "INITIALIZED")

    def taken_over(self, name: str, before: ActionGraph, stay: set[str]) -> NodeRun:
        """Return an action of the new graph with what it has heard, and been given, in the graph before."""
        node, definition = self.nodes.get(name, NodeRun()), self.graph.nodes[name]
        known = self.ended_before(definition.parents, before.nodes[name].parents if name in before.nodes else {})
        heard = _still_heard(known | node.heard, definition.parents, stay)
        if name in stay:
            return msgspec.structs.replace(node, heard=heard)
        given = _given(before.nodes[name], node) if name in before.nodes else {}
        taken = {key: value for key, value in given.items() if definition.takes(key, value)}
        left = self.leaving.get(name, node)
        return NodeRun(number=1 + max(self.before.steps, node.number, left.number), heard=heard, given=taken)

    def ended_before(self, relations: dict[str, ParentRelation], before: dict[str, ParentRelation]) -> dict[str, str]:
        """Return what the parents that are new to an action would have told it when they ended."""
        results = {name: self.before.nodes[name].result for name in relations if name in self.before.nodes}
        responses = {
            name: (relations[name].conditions[result], result)
            for name, result in results.items()
            if result and name not in before and self.before.nodes[name].state not in LIVE
        }
        runs = {name: result for name, (response, result) in responses.items() if response in ("run", "restart")}
        return runs | {name: "" for name, (response, _) in responses.items() if response == "ignore"}

    def left(self, event: NodeEnded) -> None:
        """Take the end of an action that the graph does not have any more: it means nothing to the others."""
        if self.leaving[event.node].number != event.number:
            return
        del self.leaving[event.node]
        if not self.leaving and not self.ending and self.state == "RUNNING":
            self.start_waiting()

    def is_ready(self, name: str) -> bool:
        """Return whether all required parents of an action, or of the exit, have ended, and it is to run."""
        heard = self.heard if name == EXIT else self.nodes[name].heard
        required = [parent for parent, one in self.graph.parents_of(name).items() if one.required]
        return bool(required) and all(parent in heard for parent in required) and any(heard.values())

    # -- one action ------------------------------------------------------------------------------------------------

    def waiting(self) -> list[str]:
        return [name for name, node in self.nodes.items() if node.state == "INITIALIZED"]

    def start_waiting(self) -> None:
        for name in self.waiting():
            self.start(name)

    def start_named(self, name: str) -> None:
        """Run an action that was named; one that runs goes on, and one that stops runs again when it has stopped.

        Raises:
            GraphError: a required input has no value.
        """
        node = self.graph.nodes[name]
        lacks = node.lacking(self.nodes[name].given)
        if lacks and self.nodes[name].state not in LIVE:
            raise wrong_graph(self.graph.file, f"{node.place}.input_parameters.{lacks[0]}", "a value", None)
        if self.nodes[name].state == "STOPPING" and not lacks:
            self.put(name, again=True)
        self.start(name)

    def start(self, name: str) -> None:
        """Run an action with what it was given, or note that it will run."""
        node = self.nodes[name]
        definition = self.graph.nodes[name]
        if definition.lacking(node.given) or node.state in LIVE:
            return
        if self.state == "PAUSED" or self.leaving:
            self.put(name, state="INITIALIZED", heard={})
            return
        self.put(
            name,
            state="RUNNING",
            number=node.number + 1,
            attempt=1,
            heard={},
            given={},
            inputs=definition.values(node.given),
            again=False,
            why="",
            result="",
            actor=self.graph.nodes[name].actor,
        )
        self.effects.append(NodeEffect("run", name))

    def stop(self, name: str) -> None:
        node = self.nodes[name]
        if node.lost:
            self.put(name, state="STOPPING", again=False, lost=False)
            self.ended(NodeEnded(name, node.number, "on_stopped"))
        elif self.nodes[name].state in ("RUNNING", "PAUSED"):
            self.put(name, state="STOPPING", again=False)
            self.effects.append(NodeEffect("stop", name))
        elif self.nodes[name].state in ("INITIALIZED", "STOPPING"):
            state = "STOPPING" if self.nodes[name].state == "STOPPING" else "UNINITIALIZED"
            self.put(name, state=state, again=False)

    def restart(self, name: str) -> None:
        if self.nodes[name].lost:
            self.put(name, state="UNINITIALIZED", lost=False)
        self.stop(name)
        if self.nodes[name].state == "STOPPING":
            self.put(name, again=True)
        else:
            self.start(name)

    def pause_node(self, name: str) -> None:
        if self.nodes[name].state == "RUNNING":
            self.put(name, state="PAUSED")
            self.effects.append(NodeEffect("pause", name))

    def resume_node(self, name: str) -> None:
        node = self.nodes[name]
        self.effects.append(NodeEffect("run" if node.lost else "resume", name))
        self.put(name, state="RUNNING", number=node.number + node.lost, lost=False)

    # -- relations -------------------------------------------------------------------------------------------------

    def tell_children(self, name: str, result: str, outputs: dict[str, Any], why: str = "") -> None:
        """Let each child, and the exit, respond to the end of an action."""
        if self.graph.nodes[name].spontaneous:
            for below in self.graph.below(name) - {name} - set(self.graph.nodes[name].children):
                self.stop(below)
        for child, relation in self.graph.exits_of(name):
            if self.ending:
                return
            response = relation.conditions[result]
            if child == EXIT:
                self.tell_exit(name, response, result, outputs, why)
            else:
                self.tell(name, child, response, result, outputs, why)

    def tell(self, parent: str, child: str, response: str, result: str, outputs: dict[str, Any], why: str) -> None:
        match response:
            case "run" | "restart":
                self.hear(parent, child, response, result, outputs)
            case "ignore":
                if self.are_all_heard(parent, child, ""):
                    self.start(child)
            case "stop":
                self.stop(child)
            case "pause":
                self.pause_node(child)
            case _:
                self.bypass(child, result, why)

    def hear(self, parent: str, child: str, response: str, result: str, outputs: dict[str, Any]) -> None:
        """Take a parent's outputs, and run the child if all its required parents have ended."""
        given = self.graph.nodes[parent].handed_to(self.graph.nodes[child], outputs)
        if given is None:
            return  # a value that it does not accept: the parent means another child
        self.put(child, given={**self.nodes[child].given, **given})
        all_heard, state = self.are_all_heard(parent, child, result), self.nodes[child].state
        if state == "PAUSED" and self.state == "RUNNING":
            self.resume_node(child)
        elif all_heard and (response == "restart" or state == "STOPPING" or self.graph.nodes[parent].spontaneous):
            self.restart(child)
        elif all_heard:
            self.start(child)

    def are_all_heard(self, parent: str, child: str, result: str) -> bool:
        """Note the end of a parent; return whether all required ones have ended, and the child, or the exit, runs."""
        relations = self.graph.parents_of(child)
        heard = self.heard if child == EXIT else self.nodes[child].heard
        if relations[parent].required:
            heard = {**heard, parent: result}
        all_heard = all(name in heard for name, relation in relations.items() if relation.required)
        runs = bool(result) or any(heard.values())
        if all_heard and not runs:
            heard = {}  # none of them wants it: the next round begins
        if child == EXIT:
            self.heard = heard
        else:
            self.put(child, heard=heard)
        return all_heard and runs

    def bypass(self, name: str, result: str, why: str) -> None:
        """Leave an action out: its children respond to its parent's result."""
        if self.nodes[name].state in LIVE or name in self.bypassed:
            return
        self.bypassed.add(name)
        self.put(name, state="BYPASSED", heard={}, given={})
        self.tell_children(name, result, {}, why)

    def tell_exit(self, name: str, response: str, result: str, outputs: dict[str, Any], why: str) -> None:
        if response == "bypass":
            self.finish(result, why)
        elif response in ("run", "restart", "ignore"):
            runs = response != "ignore"
            if runs:
                self.outputs = {**self.outputs, **outputs}
            if self.are_all_heard(name, EXIT, result if runs else ""):
                self.finish(result if runs else [*filter(None, self.heard.values())][-1], why)

    def finish(self, result: str, why: str) -> None:
        self.why = why if result == "on_error" else ""
        self.end("ERROR" if result == "on_error" else "FINISHED", result)


def _given(definition: ActionNode, node: NodeRun) -> dict[str, Any]:
    """Return what an action has been given besides the values of its graph, also for the run that goes on."""
    own = {name: one.value for name, one in definition.inputs.items() if one.has_value}
    return {key: value for key, value in node.inputs.items() if own.get(key, _NOTHING) != value} | node.given


def _still_heard(heard: dict[str, str], relations: dict[str, ParentRelation], stay: set[str]) -> dict[str, str]:
    """Return what has been heard of parents that another graph has as well; none if none of all wants the child."""
    required = [name for name, relation in relations.items() if relation.required]
    found = {name: result for name, result in heard.items() if name in required and name in stay}
    return found if any(found.values()) or len(found) < len(required) else {}
