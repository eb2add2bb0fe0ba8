"""The managers that the pages and examples show: each with what it needs, as a module of its own."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from support import REPOSITORY

_SNIPPET = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
_FILES = [REPOSITORY / "README.md", *(REPOSITORY / "docs").glob("*.md"), *(REPOSITORY / "examples").rglob("*.py")]


def _source(file: Path) -> str:
    text = file.read_text()
    return "\n".join(_SNIPPET.findall(text)) if file.suffix == ".md" else text


def _is_manager(node: ast.stmt) -> bool:
    if not isinstance(node, ast.ClassDef) or not any("Manager" in ast.unparse(base) for base in node.bases):
        return False
    methods = [each for each in node.body if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef)]
    return any("server(" in ast.unparse(decorator) for each in methods for decorator in each.decorator_list)


def shown_managers() -> Iterator[str]:
    """Yield "file Class", and "file Class 2" for a second one of the name, for each class with a server."""
    for file in sorted(_FILES):
        seen: dict[str, int] = {}
        for node in ast.parse(_source(file)).body:
            if isinstance(node, ast.ClassDef) and _is_manager(node):
                seen[node.name] = seen.get(node.name, 0) + 1
                number = f" {seen[node.name]}" if seen[node.name] > 1 else ""
                yield f"{file.relative_to(REPOSITORY)} {node.name}{number}"


def module_of(shown: str, more: tuple[str, ...] = ()) -> str:
    """Return the source of a module with one of these classes, and what it and `more` use."""
    path, name, *number = shown.split()
    body = ast.parse(_source(REPOSITORY / path)).body
    same = [node for node in body if isinstance(node, ast.ClassDef) and node.name == name]
    wanted: list[ast.stmt] = [same[int(number[0]) - 1 if number else 0]]
    here = body.index(wanted[0])
    defined: dict[str, ast.stmt] = {}
    for node in [*reversed(body[here + 1 :]), *body[:here]]:  # what stands before the class, and nearest, counts
        defined |= dict.fromkeys(_names(node), node)
    defined[name] = wanted[0]
    left = [wanted[0], *(defined[each] for each in more)]
    kept = list(left)
    while left:
        used = {each.id for each in ast.walk(left.pop()) if isinstance(each, ast.Name)}
        found = [defined[each] for each in sorted(used & defined.keys()) if defined[each] not in kept]
        kept += found
        left += found
    kept_names = {each for node in kept for each in _names(node)}
    codecs = [node for node in body if isinstance(node, ast.Expr) and ast.unparse(node).startswith("rr.codec(")]
    calls = [
        node
        for node in codecs
        if kept_names & {each.id for each in ast.walk(node) if isinstance(each, ast.Name)} - {"rr"}
    ]
    lines = [ast.unparse(node) for node in sorted({*kept, *calls}, key=body.index)]
    return "\n".join(["from __future__ import annotations", *lines]) + "\n"


def _names(node: ast.stmt) -> list[str]:
    match node:
        case ast.Import() | ast.ImportFrom():
            return [(alias.asname or alias.name).partition(".")[0] for alias in node.names]
        case ast.ClassDef() | ast.FunctionDef() | ast.AsyncFunctionDef():
            return [node.name]
        case ast.Assign():
            return [each.id for target in node.targets for each in ast.walk(target) if isinstance(each, ast.Name)]
        case ast.AnnAssign(target=ast.Name(id=id)):
            return [id]
        case _:
            return []
