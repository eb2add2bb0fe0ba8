"""Follow a first load, a status and a restore, and print the files that each passes, as JSON.

A load and a status are followed through both processes, a restore as the application sees it. trips() in
tests/project/package_figures.py runs this, with the sitecustomize.py that lies beside it.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import threading
import time
from pathlib import Path

import sitecustomize

import rr_actors as rr

ROOT = f"{Path(rr.__file__).parent.parent}/"
ACKNOWLEDGED_S = 0.05
"""A consumer's acknowledgement of a status follows within a few milliseconds; nothing public says when.

Each process folds its journal 0.1 s after its last commit. That is no part of a status.
"""


class Cameras(rr.Manager):
    """Serves one kind of resource, and sends a status when the shared byte says so."""

    def _send_status(self, resource_id: str, status: rr.Status) -> None:
        while not sitecustomize.shared[1]:
            time.sleep(0.002)
        sitecustomize.shared[1] = 0
        self.registrar.send_status(resource_id, status)

    @rr.server("camera")
    def open_camera(self, device: str) -> str:
        return f"open {device}"

    @open_camera.recover
    def recover_camera(self, device: str, response: str) -> str:
        return f"{response} again"

    @rr.server("noted")
    def noted(self, _number: int) -> list[list[str]]:
        return [list(pair) for pair in _here()]

    @rr.server("sender")
    def start_sender(self, resource_id: str) -> None:
        status = rr.Status(rr.State.WARNING, "blurred")
        threading.Thread(target=self._send_status, args=(resource_id, status), daemon=True).start()


def _below(noted: set[tuple[str, str]]) -> list[tuple[str, str]]:
    return sorted((file.removeprefix(ROOT), caller.removeprefix(ROOT)) for file, caller in noted)


def _here() -> set[tuple[str, str]]:
    noted = set(sitecustomize.entered)
    sitecustomize.entered.clear()
    return noted


def _noted_there(app: rr.Registrar) -> set[tuple[str, str]]:
    """What the manager's process has noted. A load brings it: an ask would leave a link between the actors."""
    with app.load("cameras/noted", 0) as query:
        return {(file, caller) for file, caller in query.response}


def main() -> None:
    trips: dict[str, list[tuple[str, str]]] = {}
    heard = threading.Event()
    with (
        tempfile.TemporaryDirectory() as folder,
        rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir=Path(folder) / "state") as system,
    ):
        app = system.open_registrar("app")
        for device in ("one", "two", "three"):  # the connection is made, and what each load needs once
            app.load("cameras/camera", device).unload()
        _noted_there(app)

        sitecustomize.shared[0] = 1
        query = app.load("cameras/camera", "/dev/video0", on_status=lambda _status: heard.set())
        sitecustomize.shared[0] = 0
        trips["load"] = _below(_here() | _noted_there(app))

        app.load("cameras/sender", query.resource_id).unload()
        sitecustomize.shared[0] = sitecustomize.shared[1] = 1
        assert heard.wait(10)
        time.sleep(ACKNOWLEDGED_S)
        sitecustomize.shared[0] = 0
        trips["status"] = _below(_here() | _noted_there(app))

        heard.clear()
        child = system.supervisor().which_children()[0]
        assert child.pid is not None
        sitecustomize.shared[0] = 1
        os.kill(child.pid, signal.SIGKILL)
        assert heard.wait(10)
        sitecustomize.shared[0] = 0
        trips["restore"] = _below(_here())
        query.unload()
    json.dump(trips, sys.stdout)


if __name__ == "__main__":
    main()
