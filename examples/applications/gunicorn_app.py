"""A system in each worker of gunicorn: gunicorn --config gunicorn_hooks.py gunicorn_app:application"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable
from typing import Any

import rr_actors as rr


class Cameras(rr.Manager):
    @rr.server("camera", recovery="keep")
    def open_camera(self, device: str) -> str:
        return f"/images/{device}"


class Worker:
    """What the hooks start in each worker. With --preload this module is imported in the parent: start nothing here."""

    system: rr.System
    registrar: rr.Registrar


def start() -> None:
    for number in itertools.count():
        try:
            Worker.system = rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir=f"rr_state/worker{number}")
            Worker.system.start()
            break
        except rr.CatalogLocked:  # another worker's
            continue
    Worker.registrar = Worker.system.open_registrar("web")


def stop() -> None:
    Worker.system.stop()


def application(environ: dict[str, Any], start_response: Callable[..., Any]) -> Iterable[bytes]:
    with Worker.registrar.load("cameras/camera", environ["PATH_INFO"].rpartition("/")[2]) as camera:
        start_response("200 OK", [("Content-Type", "text/plain")])
        return [f"{camera.response} {os.getpid()}".encode()]
