"""`import rr_actors` is light: the core dependencies alone, nothing started."""

from __future__ import annotations

import ast
import importlib
import inspect
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr

OPTIONAL = {
    "uvloop",
    "rich",
    "textual",
    "typer",
    "click",
    "matplotlib",
    "nicegui",
    "fastapi",
    "numpy",
    "attrs",
    "attr",
    "hypothesis",
    "pytest",
    "zenoh",
}

SELDOM = {
    "argparse", "pkgutil", "tomllib", "psutil", "email", "html", "http", "xml", "unittest", "logging.handlers",
    "shutil", "tempfile", "random", "secrets", "runpy", "multiprocessing.spawn",
}  # fmt: skip
"""What only some programs need, or only the command line, the managers for external programs, a file to be read."""

MOST_MODULES = 385
"""Each takes a quarter of a millisecond. Ten are the console's, which each system has by default; one is the web
page's, four draw pictures for notebooks, ten are the two ends of streams, six are a registrar's servers with their
room, two are the backup's, one notes the messages between actors, four look at mailboxes and pause them, two make
children processes of multiprocessing, with its `util`, and one remembers what happened. Two are for loads that wait
in line, with their room, three for what is asked from outside, with theirs, and one is for systemd. Six say what needs
attention, and what a kill would do. Two are for tables that actors declare, one keeps the times of loads, and one says
what a registrar would do. Three are for the notes of what registrars decide, with their room. One is `_tokenize`, of
Python 3.12 and later. 128 of them come with asyncio, sqlite3, msgspec, pykka and cloudpickle."""

BARE_MODULES = 12
"""Of the import alone: what decides which module a name is in, and leaves the garbage collector alone meanwhile."""

HELP_MODULES = 127
"""Of `rr-actors --help`, and a TAB for a verb: typer's, msgspec's, and a few of the base."""

PS_MODULES = 427
"""Of `rr-actors ps`, and a TAB for one of its options: these and the console's, which are nearly all of a system."""

USED = "import rr_actors as rr; rr.System; rr.Manager; rr.Supervisor; rr.Actor; rr.connect"
"""What a program does with it at least."""


def imported_by(statement: str, setup: str = "") -> dict[str, Any]:
    script = f"""
import contextlib, gc, json, sys, threading
{setup}
collections = []
gc.callbacks.append(lambda phase, info: collections.append(phase) if phase == "start" else None)
before = set(sys.modules)
{statement}
print(json.dumps({{
    "collections": collections,
    "collects": gc.isenabled(),
    "modules": sorted({{name.partition(".")[0] for name in set(sys.modules) - before}}),
    "all": sorted(set(sys.modules) - before),
    "threads": [thread.name for thread in threading.enumerate() if thread is not threading.main_thread()],
}}))
"""
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return json.loads(ran.stdout)


def test_importing_the_package_imports_no_optional_dependency() -> None:
    modules = imported_by(USED)["modules"]

    assert OPTIONAL.intersection(modules) == set()


def test_the_settings_for_other_hosts_import_no_zenoh() -> None:
    made = imported_by('import rr_actors as rr; rr.System([], hosts=rr.Hosts("a", listen=["tcp/127.0.0.1:7447"]))')

    assert "rr_actors.system.hosts.gateway" in made["all"]
    assert "zenoh" not in made["modules"]


def test_importing_the_package_starts_no_thread() -> None:
    assert imported_by(USED)["threads"] == []


def test_importing_the_package_imports_nothing_that_is_seldom_needed() -> None:
    assert SELDOM.intersection(imported_by(USED)["all"]) == set()


def test_what_a_program_uses_of_the_package_imports_no_more_modules_than_it_must() -> None:
    assert len(imported_by(USED)["all"]) <= MOST_MODULES


def test_the_import_alone_imports_next_to_nothing() -> None:
    assert len(imported_by("import rr_actors")["all"]) <= BARE_MODULES
    assert "rr_actors.system.system" not in imported_by("import rr_actors as rr; rr.Manager; rr.Registrar")["all"]


def test_each_public_name_is_what_type_checkers_and_freezers_take_it_for() -> None:
    tree = ast.parse(inspect.getsource(rr))
    static = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]
    shown = {alias.name: node.module or "" for node in static for alias in node.names if alias.name in rr.__all__}
    assert sorted(shown) == sorted(rr.__all__)
    for name, where in shown.items():
        assert getattr(rr, name) is getattr(importlib.import_module(where), name)


def test_a_child_finds_the_modules_of_all_names_in_its_fork_server() -> None:
    """But those of ready-made managers, which most need none of; of pytest's fixture; simulations; and other hosts."""
    setup = "import importlib; from rr_actors.runtime.processes.child_bootstrap import PRELOAD; "
    setup += "list(map(importlib.import_module, PRELOAD)); import rr_actors as rr"
    left_out = ("Action", "GraphResult", "StartSystem", "run_graph")
    left_out += ("ChildOutcome", "SimulatedRun", "TreeExperiment", "experiment", "simulate", "Export", "Hosts")
    own = f"[getattr(rr, name) for name in rr.__all__ if name not in {left_out}]"
    assert imported_by(own, setup)["all"] == []


def test_all_names_can_be_imported_at_once() -> None:
    names = "from rr_actors import *; import rr_actors; assert set(rr_actors.__all__) <= set(globals())"
    assert "rr_actors.managers" in imported_by(names)["all"]


def test_threads_that_use_names_at_once_all_have_them() -> None:
    """Each first use imports, and the others wait for a module that is not whole yet."""
    program = """
from concurrent.futures import ThreadPoolExecutor
import rr_actors as rr
gate = threading.Barrier(12)
def use(name):
    gate.wait()
    return getattr(rr, name)
with ThreadPoolExecutor(12) as pool:
    names = ["System", "connect", "Manager", "Registrar", "read_recording", "Supervisor"] * 2
    assert [one.__name__ for one in pool.map(use, names)] == names
"""
    assert "rr_actors.system.system" in imported_by(program)["all"]


def test_a_library_that_lacks_something_does_not_look_like_a_name_that_does_not_exist() -> None:
    program = "import sys, types; sys.modules['msgspec'] = types.ModuleType('msgspec'); import rr_actors; "
    for use in ("hasattr(rr_actors, 'RrError')", "exec('from rr_actors import RrError')"):
        done = subprocess.run([sys.executable, "-c", program + use], capture_output=True, text=True, check=False)
        assert done.returncode == 1
        assert done.stderr.splitlines()[-1].startswith("ImportError: "), done.stderr
        assert "module 'msgspec' has no attribute" in done.stderr


def test_the_ready_made_managers_are_imported_when_they_are_asked_for() -> None:
    assert "rr_actors.managers" not in imported_by("import rr_actors")["all"]
    assert "rr_actors.managers" in imported_by("import rr_actors as rr; rr.managers.Choices")["all"]


def test_what_the_package_does_not_have_is_named_with_what_is_near() -> None:
    with pytest.raises(AttributeError, match="module 'rr_actors' has no attribute 'mangers'") as raised:
        rr.mangers  # type: ignore[attr-defined]  # noqa: B018
    assert raised.value.name == "mangers"


@pytest.mark.parametrize(("setup", "collects"), [("gc.collect()", True), ("gc.disable()", False)])
def test_importing_the_package_is_no_work_for_the_garbage_collector_and_leaves_it_as_it_was(
    setup: str, collects: bool
) -> None:
    """What modules are made of stays. To look at it again and again took a tenth of the time."""
    imported = imported_by(USED, setup)

    assert len(imported["collections"]) <= 2  # when it begins again after System, and after connect
    assert imported["collects"] is collects


def test_on_another_system_than_linux_the_import_says_what_is_needed() -> None:
    script = "import sys; sys.platform = 'darwin'; import rr_actors"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == (
        "ImportError: rr_actors needs Linux, this is darwin: run it in a Linux container or virtual machine"
    )


def command(*arguments: str, **environment: str) -> str:
    """A statement that runs `rr-actors` with these."""
    return f"""
import os
from rr_actors.tools.cli import main
sys.argv = {["rr-actors", *arguments]!r}
os.environ |= {environment!r}
with contextlib.redirect_stdout(open(os.devnull, "w")), contextlib.suppress(SystemExit):
    main()
"""


def tab(*words: str) -> str:
    """A statement that completes the last of these words, as a shell does."""
    told = {"COMP_WORDS": " ".join(("rr-actors", *words)), "COMP_CWORD": str(len(words))}
    return command(_RR_ACTORS_COMPLETE="complete_bash", **told)


@pytest.mark.parametrize("statement", [command("--help"), command(), tab("p"), tab("")])
def test_the_help_and_the_completion_of_verbs_import_no_verb(statement: str) -> None:
    imported = imported_by(statement)
    assert len(imported["all"]) <= HELP_MODULES
    assert {"asyncio", "pydantic", "rich"}.intersection(imported["modules"]) == set()
    assert "rr_actors.tools.verbs.console_verbs" not in imported["all"]


def test_a_verb_imports_what_it_needs_and_no_more(tmp_path: Path) -> None:
    state = ("--state", str(tmp_path))
    for statement in (
        command("ps", *state),
        command("ps", "--help"),
        tab("ps", *state, "--s"),
        tab("kill", *state, "c"),
    ):
        imported = imported_by(statement)
        assert len(imported["all"]) <= PS_MODULES
        assert {"pydantic", "psutil", "textual", "nicegui"}.intersection(imported["modules"]) == set()
        assert {"rich.console", "rr_actors.system.system"}.intersection(imported["all"]) == set()
        assert [name for name in imported["all"] if name.startswith("rr_actors.tools.web")] == []
    for statement in (command("new", "Not-A-Name"), command("version")):
        assert "asyncio" not in imported_by(statement)["modules"]
