"""A ring of loads: a map needs a camera, and that camera needs the same map.

Each would wait for the other. They are in two processes.

Look for: the states of the two resources; what is printed, and when.

Why: the registrars see the ring when its last load is asked for, also across processes. This load fails at once, with
an error that names all loads of the ring, and so both resources fail in place of waiting for ever.
"""

# /// lab
# place = 11
# question = "The map loads the camera, and the camera loads the map. What will the consumer get?"
# [answers]
# "nothing: it waits for ever" = {}
# "an error that names the ring" = {prints = "refused: "}
# "the map" = {prints = "loaded: the map"}
# ///

from __future__ import annotations

import time

import rr_actors as rr


class Maps(rr.Manager):
    @rr.server("map")
    def load_map(self, request: str) -> str:
        time.sleep(3)
        return f"the map of {request}, by {self.registrar.load('cameras/camera', request).response}"


class Cameras(rr.Manager):
    @rr.server("camera")
    def load_camera(self, request: str) -> str:
        time.sleep(3)
        return f"a camera that knows {self.registrar.load('maps/map', request).response}"


def main(state_dir: str) -> None:
    with rr.System([rr.ChildSpec(Maps, id="maps"), rr.ChildSpec(Cameras, id="cameras")], state_dir=state_dir) as system:
        app = system.open_registrar("app")
        time.sleep(2)
        print("the consumer loads the map of the kitchen", flush=True)
        try:
            print("loaded:", app.load("maps/map", "kitchen", timeout_s=40).response, flush=True)
        except rr.RrError as error:
            print(f"refused: {error}", flush=True)
        time.sleep(5)
