"""The shape of the package: imports point downward, each library has its one place, the core is pure."""

from __future__ import annotations

import ast
import functools
import graphlib
import importlib
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "rr_actors"
MODULES = sorted(PACKAGE.rglob("*.py"))

# Where each library may be imported: a file, or a folder ending in "/".
PLACES = {
    "pykka": ("actors/", "supervision/", "registrar/", "system/snapshots.py"),
    "cloudpickle": ("base/pickling.py",),
    "multiprocessing": (
        "runtime/processes/forked_process.py",
        "runtime/processes/child_bootstrap.py",
        "runtime/processes/fork_server.py",
    ),
    "sqlite3": ("storage/",),
    "psutil": ("managers/",),
    "uvloop": ("runtime/user_loop.py",),
    "typer": (
        "tools/cli_commands.py",
        "tools/learn/learn_session.py",
        "tools/terminal/action_graphs.py",
        "tools/verbs/",
    ),
    "rich": (
        "registrar/progress_bar.py",
        "tools/cli_commands.py",
        "tools/terminal/attention_lines.py",
        "tools/terminal/terminal_pane.py",
        "tools/verbs/state_verbs.py",
    ),
    "textual": (
        "tools/terminal/attention_lines.py",
        "tools/terminal/rewind_screen.py",
        "tools/terminal/terminal_app.py",
        "tools/terminal/terminal_pane.py",
    ),
    "nicegui": ("tools/web/",),
    "opentelemetry": ("system/recording/otel_export.py",),
    "yaml": ("managers/pipes/temoto_files.py",),
    "matplotlib": (),
    "tomllib": (),  # read by way of msgspec.toml
}

# What the pure core may import besides the words below it: nothing that does I/O, reads a clock, starts a thread or
# draws a random number.
PURE = {
    "__future__", "abc", "bisect", "collections", "contextlib", "copy", "dataclasses", "datetime", "difflib", "enum",
    "decimal", "errno", "functools", "hashlib", "heapq", "html", "inspect", "itertools", "math", "msgspec", "operator",
    "pathlib", "re", "types", "typing", "uuid", "weakref",
    "sys",  # codecs.py looks whether numpy and pydantic are imported
}  # fmt: skip
PURE_PACKAGES = ("registrar/core", "registrar/model", "supervision/core")
PURE_WORDS = tuple(
    f"rr_actors.{name}"
    for name in (
        "registrar.core", "registrar.model", "supervision.core",
        "base.errors", "base.names", "base.values", "base.checks", "base.toml", "base.scarcity",
        "base.notebook", "base.svg_pictures",
    )
)  # fmt: skip


@functools.cache
def imports_of(path: Path) -> list[tuple[str, int]]:
    """Every module that a file imports, at its top or inside a function."""
    found: list[tuple[str, int]] = []
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            found += [(alias.name, node.lineno) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.append((node.module, node.lineno))
            found += [(f"{node.module}.{alias.name}", node.lineno) for alias in node.names]
    return found


def name_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(("rr_actors", *parts[: -1 if parts[-1] == "__init__" else None]))


def layers(contract: int) -> list[str]:
    """The names in the layers of a contract: 0 is that of the modules, 1 that of the rooms."""
    config = tomllib.loads((ROOT / "pyproject.toml").read_text())
    found = config["tool"]["importlinter"]["contracts"][contract]["layers"]
    return [name.strip(" ()") for layer in found for name in str(layer).split(":")]


def test_imports_point_downward() -> None:
    ran = subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache"], cwd=ROOT, capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr


def test_every_module_has_its_layer() -> None:
    named = layers(0)
    packages = {f"rr_actors{name}" for name in ("", ".registrar", ".supervision", ".system", ".tools")}  # one by one

    left_out = [
        name
        for name in map(name_of, MODULES)
        if name not in packages and not any(name == layer or name.startswith(f"{layer}.") for layer in named)
    ]

    assert left_out == []


def test_every_room_has_its_layer() -> None:
    rooms = {f"rr_actors.{path.parent.name}" for path in PACKAGE.glob("*/__init__.py")}

    assert rooms | {"rr_actors.__main__"} == set(layers(1))


def private_names_of_multiprocessing() -> set[str]:
    """The private names in its modules, and of the classes there."""
    names = ("process", "util", "spawn", "context", "reduction", "resource_tracker", "forkserver", "popen_forkserver")
    modules = [importlib.import_module(f"multiprocessing.{name}") for name in names]
    classes = [one for module in modules for one in vars(module).values() if isinstance(one, type)]
    found = {name for one in (*modules, *classes) for name in vars(one)}
    return {name for name in found if name.startswith("_") and not name.startswith("__")} - vars(subprocess).keys()


def test_two_private_names_of_multiprocessing_are_used_and_in_one_file() -> None:
    used: set[tuple[str, str]] = set()
    for place in PLACES["multiprocessing"]:
        for node in ast.walk(ast.parse((PACKAGE / place).read_text())):
            match node:
                case ast.Attribute(value=owner, attr=name) if not (isinstance(owner, ast.Name) and owner.id == "self"):
                    used.add((place, name))
                case ast.Constant(value=str(name)) | ast.FunctionDef(name=name):
                    used.add((place, name))
                case _:
                    continue
    private = private_names_of_multiprocessing()
    where = "runtime/processes/forked_process.py"
    assert {one for one in used if one[1] in private} == {(where, "_Popen"), (where, "_exit_function")}


@pytest.mark.parametrize("library", sorted(PLACES))
def test_a_library_is_imported_in_its_one_place(library: str) -> None:
    elsewhere = [
        f"{path.relative_to(PACKAGE)}:{line}"
        for path in MODULES
        for name, line in imports_of(path)
        if (name == library or name.startswith(f"{library}."))
        and not any(
            str(path.relative_to(PACKAGE)) == place
            or (place.endswith("/") and str(path.relative_to(PACKAGE)).startswith(place))
            for place in PLACES[library]
        )
    ]

    assert elsewhere == []


def test_the_core_does_no_io_and_reads_no_clock() -> None:
    impure = [
        f"{path.relative_to(PACKAGE)}:{line}: {name}"
        for path in MODULES
        if any(path.is_relative_to(PACKAGE / package) for package in PURE_PACKAGES)
        for name, line in imports_of(path)
        if not (
            any(word.startswith(name) or name.startswith(word) for word in PURE_WORDS)
            if name.startswith("rr_actors")
            else name.split(".")[0] in PURE
        )
    ]

    assert impure == []


def test_no_module_imports_the_package_from_within() -> None:
    """It would make what works depend on the order in which the modules happen to be imported.

    The lab's experiments are programs: nothing imports them, and they are written as their readers would write them.
    """
    guilty = [
        f"{path.relative_to(PACKAGE)}:{line}"
        for path in MODULES
        if not path.is_relative_to(PACKAGE / "tools" / "experiments")
        for name, line in imports_of(path)
        if name == "rr_actors" and not is_submodule_import(path, line)
    ]

    assert guilty == []


def is_submodule_import(path: Path, line: int) -> bool:
    """`from rr_actors import errors` imports the module rr_actors.base.errors, not a name of the package."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.lineno == line and node.module == "rr_actors":
            return all((PACKAGE / f"{a.name}.py").exists() or (PACKAGE / a.name).is_dir() for a in node.names)
    return False


def test_no_modules_import_each_other_in_a_circle() -> None:
    """Within a room, too: the layers say nothing of modules that stand side by side."""
    modules = {name_of(path): path for path in MODULES}
    imports = {
        name: {other for other, _ in imports_of(path) if other in modules and modules[other].stem != "__init__"}
        for name, path in modules.items()
        if path.stem != "__init__"
    }
    graphlib.TopologicalSorter(imports).prepare()  # raises CycleError, which names the circle


def test_no_module_needs_another_for_its_types_alone() -> None:
    """An import below TYPE_CHECKING hides a circle: an interface is missing there. None imports the package's."""
    for root in (PACKAGE, ROOT / "tests" / "simulation"):
        for path in set(root.rglob("*.py")) - {PACKAGE / "__init__.py"}:
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
                    names = [part.module for part in node.body if isinstance(part, ast.ImportFrom)]
                    ours = [name for name in names if name and name.split(".")[0] in ("rr_actors", "simulation")]
                    assert ours == [], path
