"""Cells that are edited and run again: the program hears that a child still runs the code from before."""

from __future__ import annotations

import sys
import types
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import rr_actors as rr

CELL = """
import rr_actors as rr

class Cameras(rr.Manager):
    @rr.server("camera")
    def open_camera(self, device: str) -> str:
        return "v1 " + device

system = rr.System.running(PLACE) or rr.System(
    [rr.ChildSpec(Cameras, id="cameras", placement="thread")], state_dir=PLACE
).start()
"""
AGAIN = "Cameras was defined anew, and the system still runs the code from before"

Run = Callable[[str], list[str]]


@pytest.fixture
def cells(tmp_path: Path) -> Iterator[dict[str, Any]]:
    """The namespace of a notebook."""
    module = types.ModuleType("cells")
    module.__dict__["PLACE"] = str(tmp_path / "state")
    sys.modules["cells"] = module
    yield module.__dict__
    module.__dict__["system"].stop()
    del sys.modules["cells"]


@pytest.fixture
def run(cells: dict[str, Any]) -> Run:
    """Run a cell; return the warnings."""

    def run(code: str) -> list[str]:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("default")
            exec(compile(code, "<cell>", "exec"), cells)
        return [str(one.message) for one in caught]

    return run


def test_each_edit_of_a_class_that_runs_is_named_until_it_is_brought_in(run: Run, cells: dict[str, Any]) -> None:
    assert run(CELL) == []
    assert run(CELL) == []  # the same code is no news
    assert run("# moved\n\n" + CELL) == []
    for edited in ("v2", "v3", "v3"):
        (said,) = run(CELL.replace("v1", edited))
        assert said.startswith(AGAIN)
        assert "system.stop()" in said
    run("system.stop()")
    assert run(CELL.replace("v1", "v3")) == []
    assert run('app = system.open_registrar("app"); answer = app.load(Cameras.open_camera, "a").response') == []
    assert cells["answer"] == "v3 a"


def test_a_load_by_the_method_of_an_edited_class_says_so_once(run: Run, cells: dict[str, Any]) -> None:
    run(CELL)
    run('app = system.open_registrar("app")')
    edited = CELL.partition("system =")[0].replace("v1", "v2")
    assert run(edited) == []
    load = 'answer = app.load(Cameras.open_camera, "a").response'
    (said,) = run(load)
    assert said.startswith(AGAIN)
    assert cells["answer"] == "v1 a"
    assert run(load) == []


def test_new_code_that_the_supervisor_is_given_is_no_edit_any_more(run: Run, cells: dict[str, Any]) -> None:
    run(CELL)
    edited = CELL.replace("v1", "v2")
    assert len(run(edited)) == 1
    new = rr.Supervisor([rr.ChildSpec(cells["Cameras"], id="cameras", placement="thread")])
    supervisor = cells["system"].supervisor()
    supervisor.update(new)
    supervisor.terminate_child("cameras")
    supervisor.restart_child("cameras")
    assert run(edited) == []
    assert run('app = system.open_registrar("app"); answer = app.load(Cameras.open_camera, "a").response') == []
    assert cells["answer"] == "v2 a"


EDITS = [
    ("device: str) -> str", "device: str, mode: int = 1) -> str"),
    ('@rr.server("camera")', '@rr.server("camera", linger_s=2)'),
    ('    @rr.server("camera")', '    WIDTH = 640\n    @rr.server("camera")'),
    (
        'return "v1 " + device',
        'return "v1 " + device\n    @open_camera.unload\n    def close(self, request, response): ...',
    ),
    ('return "v1 " + device', 'return (lambda: "v1 " + device + ".")()'),
]


@pytest.mark.parametrize(("before", "after"), EDITS)
def test_each_kind_of_edit_is_seen(run: Run, before: str, after: str) -> None:
    assert run(CELL) == []
    assert len(run(CELL.replace(before, after))) == 1
