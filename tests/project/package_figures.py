"""Print the counts that say how large and how tangled the package is, each with its aim.

    make figures

Most counts come from the source, as text and as syntax trees. Those of paths come from a run: trips() follows a first
load, a status and a restore. tests/project/test_package_figures.py holds what has been reached.
"""

from __future__ import annotations

import ast
import functools
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

from rr_actors.runtime import thread_rules

REPOSITORY = Path(__file__).resolve().parents[2]
PACKAGE = "rr_actors"

# Low rooms first. A room may import rooms of its own line and of lines above it in this list.
ROOMS = (
    ("base",),
    ("runtime",),
    ("wire",),
    ("actors",),
    ("hosting",),
    ("registrar",),
    ("storage",),
    ("supervision",),
    ("system",),
    ("managers",),
    ("tools",),
    ("testing",),
)
TYPED_ROOMS = ("registrar", "hosting", "system", "supervision", "actors")
MACHINERY = ("base", "runtime", "wire", "actors", "hosting", "registrar", "storage", "supervision")
"""The rooms of which the others are made. The managers, the tools and the console have words of their own."""
HUB_WORDS = ("registrar", "provider", "node", "state", "resource", "actor")


def sources(below: str = PACKAGE) -> list[Path]:
    """The Python files below a folder of the repository."""
    return sorted((REPOSITORY / below).rglob("*.py"))


def trees(below: str = PACKAGE) -> Iterator[tuple[Path, ast.Module]]:
    """Each Python file below a folder, with its syntax tree."""
    for path in sources(below):
        yield path, ast.parse(path.read_text())


def lines() -> int:
    """How many lines the package has."""
    return sum(len(path.read_text().splitlines()) for path in sources())


def function_lengths() -> list[int]:
    """How many lines each function has, from its def to its end."""
    functions = (ast.FunctionDef, ast.AsyncFunctionDef)
    return sorted(
        (node.end_lineno or 0) - node.lineno + 1
        for _, tree in trees()
        for node in ast.walk(tree)
        if isinstance(node, functions)
    )


def _is_any(annotation: ast.expr | None) -> bool:
    return annotation is not None and "Any" in re.findall(r"\w+", ast.unparse(annotation))


def untyped_hubs() -> list[str]:
    """The parameters and attributes that hold a registrar, provider, node, state or resource, typed as Any."""
    found: list[str] = []
    for room in TYPED_ROOMS:
        for path, tree in trees(f"{PACKAGE}/{room}"):
            for node in ast.walk(tree):
                if isinstance(node, ast.arg):
                    name, annotation = node.arg, node.annotation
                elif isinstance(node, ast.AnnAssign):
                    name, annotation = ast.unparse(node.target).rpartition(".")[2], node.annotation
                else:
                    continue
                if name.strip("_") in HUB_WORDS and annotation is not None and ast.unparse(annotation) == "Any":
                    found.append(f"{path.relative_to(REPOSITORY)}:{node.lineno} {name}")
    return found


def imports_up() -> list[str]:
    """The imports of a room from a higher one, as "module -> module"."""
    height = {room: line for line, rooms in enumerate(ROOMS) for room in rooms}
    found: list[str] = []
    for path, tree in trees():
        room = path.relative_to(REPOSITORY / PACKAGE).parts[0]
        for node in ast.walk(tree):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            for name in names:
                parts = name.split(".")
                if parts[0] == PACKAGE and len(parts) > 1 and height.get(parts[1], -1) > height.get(room, 99):
                    found.append(f"{path.relative_to(REPOSITORY)} -> {name}")
    return sorted(set(found))


def shared_class_names(*rooms: str) -> dict[str, int]:
    """The names that two or more classes of these rooms have, or of the package, and how many."""
    below = [f"{PACKAGE}/{room}" for room in rooms] or [PACKAGE]
    nodes = (node for folder in below for _, tree in trees(folder) for node in ast.walk(tree))
    counted = Counter(node.name for node in nodes if isinstance(node, ast.ClassDef))
    return {name: count for name, count in sorted(counted.items()) if count > 1 and not name.startswith("_")}


def private_uses() -> list[str]:
    """The lines of tests that use a private attribute: one that neither the test nor a support module defines."""
    own: defaultdict[Path, set[str]] = defaultdict(set)
    shared: set[str] = set()
    uses: list[tuple[Path, str, str]] = []
    for path, tree in trees("tests"):
        is_support = path.stem.startswith("support") or path.parent.name in ("simulation", "chaos")
        defined = shared if is_support else own[path]
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                defined.add(node.name)
            elif isinstance(node, ast.Attribute) and re.match(r"_(?!_)", node.attr):
                of_self = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls")
                if of_self and isinstance(node.ctx, ast.Store):
                    defined.add(node.attr)
                if not of_self:
                    uses.append((path, node.attr, f"{path.relative_to(REPOSITORY)}:{node.lineno}"))
    known = shared | STANDARD
    return sorted({f"{where} {name}" for path, name, where in uses if name not in known and name not in own[path]})


_TRIPS = 4


@functools.cache
def trips() -> dict[str, list[tuple[str, str]]]:
    """The files that a first load, a status and a restore pass, each with the file from which it was called.

    Heartbeats and looks at the disk come in between by chance, so only what is passed each time counts.
    """
    traced = [_traced() for _ in range(_TRIPS)]
    always = {trip: set.intersection(*({file for file, _ in run[trip]} for run in traced)) for trip in traced[0]}
    return {
        trip: [(file, caller) for file, caller in pairs if file in always[trip]] for trip, pairs in traced[0].items()
    }


def _traced() -> dict[str, list[tuple[str, str]]]:
    tracing = Path(__file__).parent / "tracing"
    with tempfile.NamedTemporaryFile() as shared:
        shared.write(bytes(2))
        shared.flush()
        environment = os.environ | {
            "RR_TRACING": shared.name,
            "PYTHONPATH": os.pathsep.join([str(tracing), str(REPOSITORY)]),
        }
        environment.pop(thread_rules.CHECK, None)  # tests check the rules in each call; users' processes do not
        command = [sys.executable, str(tracing / "trips.py")]
        run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    if run.returncode:
        raise RuntimeError(run.stderr)
    return {trip: [(file, caller) for file, caller in pairs] for trip, pairs in json.loads(run.stdout).items()}


def passed(trip: str) -> set[str]:
    """The files of the package that a load, status or restore passes."""
    return {file for file, _ in trips()[trip]}


def registrar_entries(trip: str) -> set[str]:
    """The files that call functions of the registrar's turn on this trip."""
    base = f"{PACKAGE}/registrar/engine/registrar_base.py"
    return {caller for file, caller in trips()[trip] if file == base != caller}


STANDARD = {
    "_exit",
    "_replace",
    "_asdict",
    "_fields",
    "_getframe",
    "_make",
    "_current_frames",
    "_MEIPASS",
    "_repr_mimebundle_",
    "_repr_svg_",
}
"""Names that begin with an underscore and are documented: the standard library's, and IPython's for rich display."""


def main() -> None:
    """Print the counts."""
    lengths = function_lengths()
    rows = [
        ("lines of the package", lines(), "40,800"),
        ("files", len(sources()), ""),
        ("longest file", max(len(path.read_text().splitlines()) for path in sources()), ""),
        ("function lines, median", int(statistics.median(lengths)), "7"),
        ("function lines, 90th percentile", lengths[len(lengths) * 9 // 10], "18"),
        ("hubs typed Any", len(untyped_hubs()), "0"),
        ("imports up", len(imports_up()), "0"),
        ("public class names used twice", len(shared_class_names()), ""),
        ("  of those, within the machinery", len(shared_class_names(*MACHINERY)), "0"),
        ("lines of tests with a private attribute", len(private_uses()), "0"),
        ("files of a first load, both processes", len(passed("load")), "24"),
        ("files that call its handlers on it", len(registrar_entries("load")), "3"),
        ("files of a status up, both processes", len(passed("status")), "24"),
        ("files of a restore, application", len(passed("restore")), "45"),
    ]
    for what, count, aim in rows:
        print(f"{what:<42}{count:>8,}   {f'aim {aim}' if aim else ''}".rstrip())
    if "--list" in sys.argv:
        for title, found in (
            ("hubs typed Any", untyped_hubs()),
            ("imports up", imports_up()),
            ("private", private_uses()),
        ):
            print(f"\n{title}", *found, sep="\n  ")
        print("\nclass names used twice", shared_class_names())


if __name__ == "__main__":
    main()
