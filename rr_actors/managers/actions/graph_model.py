"""A graph of actions, as both published dialects of UMRF describe one: the actions, their parameters and relations.

Names of actions in a graph are "TaNavigate_0": the name of the action, and a number that distinguishes its instances.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any, cast

import msgspec

from rr_actors.base.errors import GraphError, did_you_mean, shortened, shown

RESULTS = ("on_true", "on_false", "on_stopped", "on_error")
RESPONSES = ("run", "pause", "restart", "stop", "bypass", "ignore")
DEFAULT_CONDITIONS: dict[str, str] = dict(zip(RESULTS, ("run", "run", "ignore", "bypass"), strict=True))
ENTRY, EXIT = "graph_entry", "graph_exit"


class Parameter(msgspec.Struct, frozen=True):
    """One value that an action takes or gives.

    Attributes:
        type: "string", "number", "bool", their plurals, or another word, of which nothing is known.
        value: the value that the graph gives, if `has_value`.
        required: whether the action cannot run without it.
        updatable: whether a parent's output may replace `value`.
        allowed: the only values that are accepted from a parent; none: all of its type.
    """

    type: str
    value: Any = None
    has_value: bool = False
    required: bool = True
    updatable: bool = True
    allowed: tuple[Any, ...] = ()


class ParentRelation(msgspec.Struct, frozen=True):
    """What a parent's end means to an action: a response to each result."""

    required: bool = True
    conditions: dict[str, str] = msgspec.field(default_factory=DEFAULT_CONDITIONS.copy)


class ActionNode(msgspec.Struct, frozen=True):
    """One action of a graph.

    Attributes:
        name: the name in the graph.
        action: the name of the action's class, or of a graph.
        place: where the file has it, "actions[2]".
        spontaneous: whether it runs again and again.
        kept: whether what it has loaded is kept until the graph ends.
        actor: the manager that runs it; "": the manager of the graph.
        parents: by the name in the graph.
        children: by the name in the graph: the names that outputs have there, by their names here.
    """

    name: str
    action: str
    place: str
    spontaneous: bool = False
    kept: bool = False
    actor: str = ""
    inputs: dict[str, Parameter] = {}
    outputs: dict[str, Parameter] = {}
    parents: dict[str, ParentRelation] = {}
    children: dict[str, dict[str, str]] = {}

    def values(self, given: Mapping[str, Any]) -> dict[str, Any]:
        """Return what it runs with: the values that its graph has, and what it has been given."""
        return {name: one.value for name, one in self.inputs.items() if one.has_value} | dict(given)

    def lacking(self, given: Mapping[str, Any]) -> list[str]:
        """Return the required inputs that have no value then."""
        values = self.values(given)
        return [name for name, one in self.inputs.items() if one.required and name not in values]

    def takes(self, name: str, value: object) -> bool:
        """Return whether an input of it can be given this value."""
        one = self.inputs.get(name)
        return one is not None and (one.updatable or not one.has_value) and accepts(one, value)

    def handed_to(self, child: ActionNode, outputs: Mapping[str, Any]) -> dict[str, Any] | None:
        """Return the outputs that a child takes, by its names; None if it does not accept one of them."""
        names = self.children[child.name]
        taken: dict[str, Any] = {}
        for name, value in outputs.items():
            to = names.get(name, name)
            one = child.inputs.get(to)
            if one is None or (one.has_value and not one.updatable):
                continue
            if not accepts(one, value):
                return None
            taken[to] = value
        return taken


class ActionGraph(msgspec.Struct, frozen=True):
    """A graph that has been read.

    Attributes:
        file: where it was read, for errors; "" if it was no file.
        dialect: 1: of 2019 to 2022, without an exit. 2: since 2023.
        entry: the actions that run first.
        exit: the actions whose end ends the graph.
        document: the JSON object.
    """

    name: str
    file: str
    dialect: int
    nodes: dict[str, ActionNode]
    entry: tuple[str, ...]
    exit: dict[str, ParentRelation]
    document: dict[str, Any]

    def exits_of(self, name: str) -> Iterator[tuple[str, ParentRelation]]:
        """Return the children of an action, and the end of the graph, with what the action's end means to them."""
        for child in self.nodes[name].children:
            yield child, self.nodes[child].parents[name]
        if name in self.exit:
            yield EXIT, self.exit[name]

    def parents_of(self, name: str) -> dict[str, ParentRelation]:
        """Return the relations to the parents of an action, or of the end of the graph."""
        return self.exit if name == EXIT else self.nodes[name].parents

    def unchanged(self, before: ActionGraph) -> set[str]:
        """Return the actions that are the same in an earlier graph, whatever their relations are."""
        return {name for name, node in self.nodes.items() if _alone(node) == _alone(before.nodes.get(name))}

    def below(self, name: str) -> set[str]:
        """Return all actions that come after this one. In a cycle it is one of them."""
        found: set[str] = set()
        left = [name]
        while left:
            new = set(self.nodes[left.pop()].children) - found
            found |= new
            left += new
        return found


def _alone(node: ActionNode | None) -> ActionNode | None:
    """Return an action without what the graph around it says."""
    return node and msgspec.structs.replace(node, place="", parents={}, children={})


def wrong_graph(file: str, path: str, expected: str, got: object, said: str | None = None) -> GraphError:
    """Return the error for one place of a graph; the text shows `said`, or else the value and its type."""
    if said is None:
        said = "none" if got is None else f"{shown(got)} ({type(got).__name__})"
    place = ": ".join(filter(None, (file or "graph", shortened(path))))
    text = f"{place}: expected {expected}, got {said}"
    return GraphError(text, server="", file=file or None, path=path, expected=expected, got=got)


# -- parameters -------------------------------------------------------------------------------------------------------
#
# Values by flat names, "nav_goal::x", in the place of nested ones, and the types that UMRF knows.

SEPARATOR = "::"
_KINDS: dict[str, type | tuple[type, ...]] = {"string": str, "number": (int, float), "bool": bool}
_OTHER_WORDS = ("boolean", "booleans")  # types of which nothing is known, although they look like one of the known


def is_of_type(value: object, type_name: str) -> bool:
    """Return whether a value is of a UMRF type. Of types that it does not know, every value is."""
    if type_name.removesuffix("s") in _KINDS and type_name.endswith("s"):
        return isinstance(value, list) and all(is_of_type(item, type_name[:-1]) for item in cast("list[object]", value))
    kind = _KINDS.get(type_name)
    return kind is None or (isinstance(value, kind) and (kind is bool or not isinstance(value, bool)))


def known_types(type_name: str) -> bool:
    """Return whether this is a type whose values can be told apart."""
    return type_name in _KINDS or (type_name.endswith("s") and type_name[:-1] in _KINDS)


def likely_type(type_name: str) -> str:
    """Return "; did you mean 'string'?" for a misspelt type, else ""."""
    known = [*_KINDS, *(f"{kind}s" for kind in _KINDS)]
    return "" if type_name in _OTHER_WORDS or known_types(type_name) else did_you_mean(type_name, known)


def flat(values: Mapping[str, Any], leaves: Collection[str] = (), prefix: str = "") -> dict[str, Any]:
    """Return nested values by their flat names. A mapping whose name is one of `leaves` is a value itself."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        name = prefix + key
        if isinstance(value, dict) and value and name not in leaves:
            found |= flat(cast("dict[str, Any]", value), leaves, name + SEPARATOR)
        else:
            found[name] = value
    return found


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of flat names, nested."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        *above, last = name.split(SEPARATOR)
        place = found
        for key in above:
            place = place.setdefault(key, {})
        place[last] = value
    return found


def accepts(parameter: Parameter, value: object) -> bool:
    """Return whether an input may have this value."""
    return is_of_type(value, parameter.type) and (not parameter.allowed or value in parameter.allowed)
