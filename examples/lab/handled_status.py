"""A status on its way up: a lens becomes dirty, and a camera stands on it.

A status goes from a part to the resource that stands on it, and from there to its holders. A manager can call
`status.handled()` in its status callback.

Look for: the warning at the lens, and whether the camera gets it, too; who prints that it heard.

Why: `status.handled()` says that the manager in the middle has dealt with the status, so it goes no further. Without
it the holders of the camera hear it as well.
"""

# /// lab
# place = 10
# question = "The lens becomes dirty. Who will hear of it?"
# levers = [
#     {name = "handled", label = "the cameras' manager handles the status", choices = ["yes", "no"]},
# ]
# [answers]
# "the cameras' manager" = {prints = "the cameras' manager hears"}
# "the consumer" = {prints = "the consumer hears"}
# ///

from __future__ import annotations

import time

import rr_actors as rr


class Lenses(rr.Manager):
    @rr.server("lens")
    def load_lens(self, request: str) -> str:
        return f"{request}, 50 mm"


class Cameras(rr.Manager):
    def __init__(self, handled: str) -> None:
        super().__init__()
        self.handled = handled

    @rr.server("camera")
    def load_camera(self, request: str) -> str:
        return f"/camera/{request}: {self.registrar.load('lenses/lens', 'glass').response}"

    @load_camera.status
    def hear(self, request: str, status: rr.Status) -> None:
        print(f"the cameras' manager hears {status.state} {status.message}", flush=True)
        if self.handled == "yes":
            print("it wipes the lens, and nobody above needs to know", flush=True)
            status.handled()


def main(state_dir: str, handled: str = "yes") -> None:
    cameras = rr.ChildSpec(Cameras, id="cameras", args=(handled,))
    with rr.System([rr.ChildSpec(Lenses, id="lenses"), cameras], state_dir=state_dir) as system:
        app = system.open_registrar("app")
        app.load(
            "cameras/camera", "front", on_status=lambda status: print("the consumer hears", status.message, flush=True)
        )
        time.sleep(3)
        lenses = system.registrar("lenses")
        print("the lens is dirty", flush=True)
        lenses.send_status(lenses.resources()[0].id, rr.Status("WARNING", "dirty"))
        time.sleep(6)
