"""What cannot start of a tree, as far as the source of its classes says. Nothing of them is called."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterator
from typing import NamedTuple

from rr_actors.registrar.declarations import cost_from
from rr_actors.registrar.manager import Manager, declared_servers
from rr_actors.supervision.core.specs import Supervisor, starting_with

_LOADS = frozenset({"load", "load_async", "load_all", "load_all_async"})
_GETS = frozenset({"get", "result", "exception"})


class Wait(NamedTuple):
    """What an on_start waits for.

    Attributes:
        verb: "load" or "ask".
        target: "registrar/server", or what ref() finds an actor by.
        where: the file and the line.
    """

    verb: str
    target: str
    where: str


def misordered(root: Supervisor) -> list[str]:
    """Return, for each on_start of a tree that waits for a child which starts later, a sentence with the mend.

    The children of a simple_one_for_one supervisor are not known, and left out.
    """
    children = [found for child in root.child_specs for found in starting_with(child, f"{root.id}/{child.id}")]
    paths = [path for path, _ in children]
    found: list[str] = []
    for at, (path, child) in enumerate(children):
        cls = child.actor_class_or_manager
        if not isinstance(cls, type):
            continue
        for wait in _waits_of(cls):
            for name, why in _needed(cls, child.id, wait):
                later = [other for other in paths if other.endswith(f"/{name}")]
                if len(later) == 1 and paths.index(later[0]) > at and not later[0].startswith(f"{path}/"):
                    found.append(_sentence(path, later[0], wait, why))
    return found


def _needed(cls: type, id: str, wait: Wait) -> Iterator[tuple[str, str]]:
    """Yield the ids or paths of children that a wait needs, each with what is wanted there."""
    if wait.verb == "ask":
        yield wait.target, "asks it"
        return
    registrar, _, server = wait.target.partition("/")
    if registrar != id:
        yield registrar, f"loads {wait.target}"
        return
    declared = declared_servers(cls).get(server) if issubclass(cls, Manager) else None
    if declared is not None and (budgets := cost_from(declared)):
        yield budgets, f"loads {wait.target}, which has a cost there"


def _sentence(path: str, later: str, wait: Wait, why: str) -> str:
    mine, theirs = path.split("/"), later.split("/")
    same = next(at for at, (one, other) in enumerate(zip(mine, theirs, strict=False)) if one != other)
    return (
        f"{later} starts after {path}, whose on_start {why} ({wait.where}): put {theirs[same]!r} before "
        f"{mine[same]!r} in the list of {'/'.join(mine[:same])}, or {wait.verb} after on_start, in a thread"
    )


# -- the source of on_start --------------------------------------------------------------------------------------------


def _waits_of(cls: type) -> list[Wait]:
    """Return what on_start of a class waits for, and the methods that it calls: what has its name written there."""
    found: list[Wait] = []
    seen, names = set[str](), ["on_start"]
    while names:
        name = names.pop()
        method = inspect.getattr_static(cls, name, None)
        if name in seen or not inspect.isfunction(method) or method.__module__.startswith("rr_actors."):
            continue
        seen.add(name)
        try:
            lines, first = inspect.getsourcelines(method)
            tree = ast.parse(textwrap.dedent("".join(lines)))
        except (OSError, SyntaxError):  # no source, or a lambda within a line
            continue
        reader = _Reader(f"{inspect.getsourcefile(method)}:", first)
        for statement in getattr(tree.body[0], "body", ()):
            reader.visit(statement)
        found += reader.waits
        names += reader.called
    return found


class _Reader(ast.NodeVisitor):
    """Reads the body of one method.

    Attributes:
        waits: what it waits for.
        called: the methods of self that it calls.
    """

    def __init__(self, file: str, first: int) -> None:
        self.waits: list[Wait] = []
        self.called: list[str] = []
        self._file, self._first = file, first
        self._awaited = set[ast.AST]()  # calls whose result the method waits for

    def visit(self, node: ast.AST) -> None:
        """Read a node, unless it runs elsewhere, in a thread or a task."""
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            super().visit(node)

    def visit_Await(self, node: ast.Await) -> None:
        """Note which call is awaited."""
        self._awaited.add(node.value)
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        """Note a load, an ask, or a call of another method."""
        if isinstance(node.func, ast.Attribute):
            whose, name = node.func.value, node.func.attr
            if name in _GETS:
                self._awaited.add(whose)
            elif isinstance(whose, ast.Name) and whose.id == "self":
                self.called.append(name)
            elif name in _LOADS and isinstance(whose, ast.Attribute) and whose.attr == "registrar":
                self._note("load", node, name.endswith("_async"))
            elif name == "ask" and isinstance(whose, ast.Call) and _is_ref(whose):
                self._note("ask", node, False, whose.args)
        self.generic_visit(node)

    def _note(self, verb: str, node: ast.Call, is_async: bool, args: list[ast.expr] | None = None) -> None:
        blocks = not (is_async or any(_is_false(word) for word in node.keywords if word.arg == "block"))
        if blocks or node in self._awaited:
            where = f"{self._file}{self._first + node.lineno - 1}"
            self.waits += [Wait(verb, target, where) for target in _texts(args or node.args)]


def _is_ref(call: ast.Call) -> bool:
    return isinstance(call.func, ast.Attribute) and call.func.attr == "ref"


def _is_false(word: ast.keyword) -> bool:
    return isinstance(word.value, ast.Constant) and word.value.value is False


def _texts(args: list[ast.expr]) -> list[str]:
    """Return the names that a call has as its first argument, or in the pairs of a list there."""
    first = args[0] if args else None
    elements = first.elts if isinstance(first, ast.List | ast.Tuple) else [first]
    firsts = [one.elts[0] if isinstance(one, ast.Tuple) and one.elts else one for one in elements]
    return [one.value for one in firsts if isinstance(one, ast.Constant) and isinstance(one.value, str)]
