"""Graph library: the actions and graphs that an Actions manager has, by name."""

from __future__ import annotations

import functools
import importlib
import inspect
import os
import threading
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from rr_actors.base.errors import ConfigError, GraphError, UsageError, is_a, shown, text_of
from rr_actors.base.folder import may_block
from rr_actors.managers.actions.action import Action, check_isolation, name_of, signature_of_class
from rr_actors.managers.actions.action_folder import ActionFolder, Kinds
from rr_actors.managers.actions.graph_checks import Signature, completed, signature_of
from rr_actors.managers.actions.graph_documents import parse_graph, read_graph, read_graph_bytes
from rr_actors.managers.actions.graph_model import ActionGraph, wrong_graph
from rr_actors.managers.planning.last_good import LastGood, Sources, path_of
from rr_actors.registrar.manager import Beginning


class Shelf:
    """The actions and graphs that are there at one time.

    Attributes:
        actions: the classes, by the names that graphs call them by.
        graphs: the graphs of the folder, with the parameters of their actions, by name.
        misfits: why other graphs of the folder cannot run, by name.
    """

    def __init__(self, actions: Kinds, unread: Mapping[str, ActionGraph], faults: Iterable[ConfigError] = ()) -> None:
        """Complete the graphs. `faults`: of files with actions; the errors for unknown actions name them."""
        self.actions = actions
        self.graphs: dict[str, ActionGraph] = {}
        self.misfits: dict[str, GraphError] = {}
        self._faults = [str(fault) for fault in faults]
        self._known: dict[str, Signature] = {name: signature_of_class(kind) for name, kind in actions.items()}
        for name in unread:
            try:
                self._complete(name, unread, ())
            except GraphError as error:
                self.misfits[name] = error

    def _complete(self, name: str, unread: Mapping[str, ActionGraph], inside: tuple[str, ...]) -> None:
        """Complete a graph after its sub-graphs."""
        if name in self.graphs:
            return
        graph = unread[name]
        for node in graph.nodes.values():
            if node.action in inside or node.action == name:
                expected = f"a graph that is not inside itself, as {node.action} is"
                raise wrong_graph(graph.file, f"{node.place}.name", expected, node.action)
            if node.action in unread and node.action not in self.actions:
                self._complete(node.action, unread, (*inside, name))
        self.graphs[name] = self.complete(graph)
        self._known.setdefault(name, signature_of(self.graphs[name]))

    def complete(self, graph: ActionGraph) -> ActionGraph:
        """Return a graph with the parameters of its actions, and check it.

        Raises:
            GraphError: it cannot run here.
        """
        try:
            return completed(graph, self._known)
        except GraphError as error:
            if not self._faults or not error.path.endswith(".name"):
                raise
            raise GraphError("; ".join([str(error), *self._faults]), **error.details) from error

    def find(self, graph: str | dict[str, Any], file: str = "") -> ActionGraph:
        """Return the graph of this name, or the one that this JSON object is, which was read in `file`.

        Raises:
            GraphError: there is none of this name, or the object is none that can run here.
        """
        if isinstance(graph, dict):
            return self.complete(read_graph(graph, file))
        if graph in self.misfits:
            misfit = self.misfits[graph]
            raise GraphError(str(misfit), **misfit.details)  # each caller's own: a traceback grows with each raise
        if graph not in self.graphs:
            known = ", ".join(sorted(self.graphs)) or "none"
            raise wrong_graph("", "graph", f"a graph: one of {known}", graph)
        return self.graphs[graph]

    def action(self, name: str) -> type[Action]:
        """Return the class of an action.

        Raises:
            GraphError: there is none of this name.
        """
        if name not in self.actions:
            known = ", ".join(sorted(self.actions)) or "none"
            raise wrong_graph("", "action", f"an action: one of {known}", name)
        return self.actions[name]


class GraphLibrary:
    """All of it is read and checked when it is made, so that a manager with a wrong graph does not start.

    Attributes:
        now: the actions and graphs that were there at the last look.
    """

    def __init__(
        self,
        actions: Sequence[type[Action] | str],
        graphs: str | os.PathLike[str] | None = None,
        action_folder: str | os.PathLike[str] | None = None,
        beginning: Beginning | None = None,
    ) -> None:
        """Read the graphs in the files ``*.json`` of a folder, and the actions in the files ``*.py`` of another.

        After a crash take the last good ones.

        Raises:
            GraphError: a graph is wrong, or its folder cannot be read.
            ConfigError: a file with actions is wrong, or their folder cannot be read.
            UsageError: one of `actions` is no subclass of Action, or has no run(), or two have the same name,
                or `isolate` or `timeout_s` is wrong.
        """
        self._given: Kinds = _by_name(actions)
        self._note = beginning.note if beginning is not None else _unnoted
        self._looking = threading.Lock()
        self._folder: ActionFolder | None = None
        self._unread: Mapping[str, ActionGraph] = {}
        self._problem = ""
        if action_folder is not None:
            self._folder = ActionFolder(path_of(action_folder, "Actions", "action_folder"), beginning, self._given)
        self.now = self._filled()
        if graphs is not None:
            path = Path(graphs).absolute()
            configuration = LastGood(beginning, lambda: _read_folder(path), self._parsed)
            self._unread, self.now = configuration.now
            if configuration.problem:
                self._problem = f"goes on with its last good configuration: {configuration.problem}"
        if self._folder is not None:
            self._tell(self._folder)

    def look(self) -> Shelf:
        """Return what is there now: files with actions that have changed since the last look are run."""
        with self._looking:
            if self._folder is not None and self._folder.look():
                self.now = self._filled()
                self._tell(self._folder)
            return self.now

    def _tell(self, folder: ActionFolder) -> None:
        """Have the console show what is wrong beside the manager."""
        self._note("; ".join(filter(None, [self._problem, *map(str, folder.faults.values())])))

    def _filled(self) -> Shelf:
        if self._folder is None:
            return Shelf(self._given, self._unread)
        return Shelf({**self._given, **self._folder.kinds}, self._unread, self._folder.faults.values())

    def _parsed(self, sources: Sources) -> tuple[Mapping[str, ActionGraph], Shelf]:
        self._unread = _parse_folder(sources)
        shelf = self._filled()
        for misfit in shelf.misfits.values():
            raise misfit
        return self._unread, shelf


def _unnoted(_text: str) -> None:
    pass


def is_action(given: object) -> bool:
    """Return whether this is a subclass of Action."""
    return isinstance(given, type) and issubclass(given, Action)


def _imported(name: str) -> object:
    """Return what "module:class" names."""
    expected = "subclasses of rr.Action, or their names as 'module:class'"
    module, colon, path = name.partition(":")
    if not (module and colon and path):
        raise UsageError(f"Actions: actions: expected {expected}, got {shown(name)}")
    try:
        return functools.reduce(getattr, path.split("."), cast("object", importlib.import_module(module)))
    except (Exception, SystemExit) as error:  # importing runs the module: it may raise anything
        raise UsageError(f"Actions: actions: expected {expected}, got {shown(name)}: {text_of(error)}") from error


def _by_name(actions: Sequence[type[Action] | str]) -> dict[str, type[Action]]:
    found: dict[str, type[Action]] = {}
    for given in actions:
        kind = cast("type[Action]", _imported(given) if is_a(given, str) else given)
        if not is_action(kind):
            raise UsageError(f"Actions: actions: expected subclasses of rr.Action, got {shown(cast('object', kind))}")
        if inspect.isabstract(kind):
            raise UsageError(f"Actions: actions: expected a class with a method run(), got {kind.__name__} without one")
        check_isolation(kind)
        if name_of(kind) in found:
            raise UsageError(f"Actions: actions: expected different names, got {name_of(kind)!r} again")
        found[name_of(kind)] = kind
    return found


def _read_folder(folder: Path) -> Sources:
    if not folder.is_dir():
        raise wrong_graph(str(folder), "", "a folder with graphs", None, "none")
    files = sorted(folder.glob("*.json"))
    if special := next((file for file in files if may_block(file)), None):
        raise wrong_graph(str(special), "", "a file", None, "a pipe, a socket or a device")
    return {str(file): read_graph_bytes(str(file)) for file in files}


def _parse_folder(sources: Sources) -> dict[str, ActionGraph]:
    found: dict[str, ActionGraph] = {}
    for file, data in sources.items():
        graph = parse_graph(data, file)
        if graph.name in found:
            raise wrong_graph(graph.file, "graph_name", f"another name than in {found[graph.name].file}", graph.name)
        found[graph.name] = graph
    return found
