"""`rr-actors verify TREE.toml` says what cannot start of a tree, before anything starts."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from support import REPOSITORY

MODULE = '''
import threading
import rr_actors as rr

class Cameras(rr.Manager):
    def __init__(self):
        raise RuntimeError("made")

    @rr.server("camera")
    def load_camera(self, name: str) -> str:
        return name

class Loads(rr.Manager):
    def on_start(self):
        self.begin()

    def begin(self):
        self.registrar.load("cameras/camera", "front")

class LoadsAll(rr.Manager):
    async def on_start(self):
        await self.registrar.load_all_async([("cameras/camera", "front")])

class Gets(rr.Manager):
    def on_start(self):
        self.registrar.load("cameras/camera", "front", block=False).get()

class Asks(rr.Actor):
    def on_start(self):
        self.ref("cameras").ask("how many?")

class Costs(rr.Manager):
    @rr.server("map", cost={"watts": 4}, cost_from="cameras")
    def load_map(self, name: str) -> str:
        return name

    def on_start(self):
        self.registrar.load("first/map", "hall")

class Later(rr.Manager):
    """Waits for nothing in on_start."""

    def on_start(self):
        self.camera = self.registrar.load("cameras/camera", "front", block=False)
        self.ref("cameras").tell("I am up")

        def work():
            self.registrar.load("cameras/camera", "back")

        threading.Thread(target=work).start()
'''
WAITS = ["Loads", "LoadsAll", "Gets", "Asks", "Costs"]


def verify(place: Path, *children: str) -> tuple[int, str]:
    """Verify a tree of these classes of MODULE, each with its id, and return the exit code and what was said."""
    (place / "robots.py").write_text(MODULE)
    entries = (child.split() for child in children)
    tree = "".join(f'[[children]]\nactor = "robots:{cls}"\nid = "{id}"\n' for cls, id in entries)
    return verify_text(place, tree)


def verify_text(place: Path, tree: str) -> tuple[int, str]:
    """Verify a tree of these lines, beside MODULE."""
    (place / "tree.toml").write_text(tree)
    program = "from rr_actors.tools.cli import main; main()"
    command = [sys.executable, "-c", program, "verify", "tree.toml"]
    done = subprocess.run(
        command, cwd=place, env={"PYTHONPATH": str(REPOSITORY)}, capture_output=True, text=True, timeout=60, check=False
    )
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize("cls", WAITS)
def test_an_on_start_that_waits_for_a_later_child_is_found_with_both_names_and_the_mend(
    tmp_path: Path, cls: str
) -> None:
    code, said = verify(tmp_path, f"{cls} first", "Cameras cameras")
    assert code == 1
    assert "root/cameras starts after root/first, whose on_start" in said
    assert "put 'cameras' before 'first' in the list of root" in said
    line = next(at for at, text in enumerate(MODULE.splitlines(), 1) if f"class {cls}(" in text)
    assert f"{tmp_path}/robots.py:" in said
    assert int(said.partition("robots.py:")[2].partition(")")[0]) > line


@pytest.mark.parametrize("cls", WAITS)
def test_a_tree_in_its_right_order_is_not_complained_of(tmp_path: Path, cls: str) -> None:
    assert verify(tmp_path, "Cameras cameras", f"{cls} first") == (0, "")


def test_an_on_start_in_a_nested_supervisor_is_compared_with_what_its_uncles_have(tmp_path: Path) -> None:
    (tmp_path / "robots.py").write_text(MODULE)
    group = '[[children]]\nid = "{0}"\n[[children.children]]\nactor = "robots:{1}"\nid = "{2}"\n'
    first, later = group.format("inner", "Loads", "maps"), group.format("later", "Cameras", "cameras")
    code, said = verify_text(tmp_path, first + later)
    assert code == 1
    assert "root/later/cameras starts after root/inner/maps, whose on_start loads cameras/camera" in said
    assert "put 'later' before 'inner' in the list of root" in said
    assert verify_text(tmp_path, later + first) == (0, "")


def test_what_on_start_begins_and_does_not_wait_for_is_not_complained_of(tmp_path: Path) -> None:
    assert verify(tmp_path, "Later first", "Cameras cameras") == (0, "")


def test_a_wrong_key_or_an_unknown_class_is_named_as_run_names_it(tmp_path: Path) -> None:
    code, said = verify(tmp_path, "Cameros cameras")
    assert code != 0
    assert "children[0].actor" in said
    assert "Cameros" in said
