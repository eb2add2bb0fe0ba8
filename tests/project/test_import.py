"""`import rr_actors` is light: the core dependencies alone, nothing started."""

from __future__ import annotations

import json
import subprocess
import sys
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
}

SELDOM = {
    "argparse", "pkgutil", "tomllib", "psutil", "email", "html", "http", "xml", "unittest", "logging.handlers",
    "shutil", "tempfile", "random", "secrets", "runpy", "multiprocessing.spawn", "multiprocessing.util",
}  # fmt: skip
"""What only some programs need, or only the command line, the managers for external programs, a file to be read."""

MOST_MODULES = 332
"""Each takes a quarter of a millisecond. Ten are the console's, which each system has by default; one is the web
page's, four draw pictures for notebooks. 128 of them come with asyncio, sqlite3, msgspec, pykka and cloudpickle."""


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
    modules = imported_by("import rr_actors as rr; rr.System; rr.Manager")["modules"]

    assert OPTIONAL.intersection(modules) == set()


def test_importing_the_package_starts_no_thread() -> None:
    assert imported_by("import rr_actors")["threads"] == []


def test_importing_the_package_imports_nothing_that_is_seldom_needed() -> None:
    assert SELDOM.intersection(imported_by("import rr_actors")["all"]) == set()


def test_importing_the_package_imports_no_more_modules_than_it_must() -> None:
    assert len(imported_by("import rr_actors")["all"]) <= MOST_MODULES


def test_the_ready_made_managers_are_imported_when_they_are_asked_for() -> None:
    assert "rr_actors.managers" not in imported_by("import rr_actors")["all"]
    assert "rr_actors.managers" in imported_by("import rr_actors as rr; rr.managers.Choices")["all"]


def test_what_the_package_does_not_have_is_named_with_what_is_near() -> None:
    with pytest.raises(AttributeError, match="module 'rr_actors' has no attribute 'mangers'") as raised:
        rr.mangers  # type: ignore[attr-defined]  # noqa: B018
    assert raised.value.name == "mangers"


@pytest.mark.parametrize(("setup", "collects"), [("", True), ("gc.disable()", False)])
def test_importing_the_package_is_no_work_for_the_garbage_collector_and_leaves_it_as_it_was(
    setup: str, collects: bool
) -> None:
    """What modules are made of stays. To look at it again and again took a tenth of the time."""
    imported = imported_by("import rr_actors", setup)

    assert len(imported["collections"]) <= 2  # before it is left alone, and when it begins again
    assert imported["collects"] is collects


def test_on_another_system_than_linux_the_import_says_what_is_needed() -> None:
    script = "import sys; sys.platform = 'darwin'; import rr_actors"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == (
        "ImportError: rr_actors needs Linux, this is darwin: run it in a Linux container or virtual machine"
    )
