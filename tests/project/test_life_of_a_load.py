"""A load passes few files of the registrar, and docs/life-of-a-load.md names each of them."""

from __future__ import annotations

import re
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import pykka

import rr_actors as rr
from support import REPOSITORY
from support_inside import actor_of

MOST_FILES = 16
ROOM = "rr_actors/registrar/"
PAGE = REPOSITORY / "docs" / "life-of-a-load.md"

_entered: set[str] = set()


def _note(frame: FrameType, event: str, _arg: object) -> None:
    if event == "call" and frame.f_code.co_name != "<module>":
        _entered.add(frame.f_code.co_filename)


def files() -> set[str]:
    """The files of the package whose functions were called, as paths below the repository."""
    root = str(REPOSITORY) + "/"
    return {name.removeprefix(root) for name in _entered if name.startswith(f"{root}rr_actors/")}


class Cameras(rr.Manager):
    """Serves one kind of resource, and can note what its process calls."""

    @rr.server("camera")
    def open_camera(self, device: str) -> str:
        return f"open {device}"

    def watch(self, begin: bool) -> None:
        """Begin, or end, to note calls on the loop and in threads that start from now on."""
        profile: Callable[..., Any] | None = _note if begin else None
        threading.setprofile(profile)
        done = threading.Event()

        def on_loop() -> None:
            sys.setprofile(profile)
            done.set()

        actor_of(self.registrar).node.dispatcher.call(on_loop)
        done.wait(5.0)

    def noted(self) -> set[str]:
        return files()


def test_a_first_load_passes_sixteen_files_of_the_registrar_and_the_page_names_them(tmp_path: Path) -> None:
    with rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir=tmp_path / "state") as system:
        app = system.open_registrar("app")
        for device in ("one", "two", "three"):  # the connection is made, and what each load needs once
            app.load("cameras/camera", device)
        cameras: pykka.ActorProxy[Cameras] = system.ref("cameras").proxy()
        cameras.watch(True).get()
        sys.setprofile(_note)
        try:
            app.load("cameras/camera", "/dev/video0")
        finally:
            sys.setprofile(None)
        passed = files() | cameras.noted().get()
        cameras.watch(False).get()

    registrar = {name for name in passed if name.startswith(ROOM)}
    assert f"{ROOM}core/loading.py" in registrar  # the provider was watched, too
    assert f"{ROOM}loads.py" in registrar
    named = re.findall(rf"^\d+\. `({ROOM}[\w/]+\.py)`", PAGE.read_text(), re.MULTILINE)
    assert sorted(registrar) == sorted(named)
    assert len(named) <= MOST_FILES
