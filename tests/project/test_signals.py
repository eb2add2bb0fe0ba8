"""No signal goes to a process id that may be 0: kill(0, ...) is the whole process group of the caller."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PLACES = ("rr_actors", "examples", "docs", "benchmarks", "tests", "fuzz")


def may_be_zero(tree: ast.AST) -> Iterator[int]:
    """The lines of calls of os.kill() or os.killpg() whose process id is `... or 0`, also by way of a name."""
    zero = {
        target.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Assign) and falls_back_on_zero(node.value)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("os.kill", "os.killpg") and node.args:
            pid = node.args[0]
            if falls_back_on_zero(pid) or (isinstance(pid, ast.Name) and pid.id in zero):
                yield node.lineno


def falls_back_on_zero(value: ast.expr) -> bool:
    return isinstance(value, ast.BoolOp) and isinstance(value.op, ast.Or) and ast.unparse(value.values[-1]) == "0"


@pytest.mark.parametrize("place", PLACES)
def test_no_process_id_of_a_signal_falls_back_on_zero(place: str) -> None:
    texts = {path: path.read_text() for path in sorted((ROOT / place).rglob("*.py"))}
    found = [
        f"{path.relative_to(ROOT)}:{line}"
        for path, text in texts.items()
        if "os.kill" in text  # as os.killpg: only these files are read as Python
        for line in may_be_zero(ast.parse(text))
    ]
    assert not found, "os.kill(0, ...) kills the caller's own process group; child.kill() is safe"


@pytest.mark.parametrize("place", ["README.md", "docs"])
def test_no_page_shows_a_signal_to_a_process_id_that_may_be_zero(place: str) -> None:
    pages = [ROOT / place] if place.endswith(".md") else sorted((ROOT / place).rglob("*.md"))
    assert pages
    assert not [page.name for page in pages if "pid or 0" in page.read_text()]


@pytest.mark.parametrize(
    "text",
    ["os.kill(child.pid or 0, 9)", "pid = child.pid or 0\nos.kill(pid, 9)", "os.killpg(found or 0, signal.SIGKILL)"],
)
def test_the_check_finds_what_it_looks_for(text: str) -> None:
    assert list(may_be_zero(ast.parse(text)))
