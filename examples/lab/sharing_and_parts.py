"""Sharing and dependencies: a camera stands on a lens, and two consumers want it.

The load callback of the camera loads a lens. The mapper and the guard both load the front camera. Then the lens becomes
dirty, and the two release the camera one after the other.

Look for: how many cameras and lenses there are, and who holds them; how far the warning about the lens travels; when
the camera goes, and what goes with it.

Why: a resource that is asked for twice is loaded once. If a load callback loads another resource, that becomes a part,
and is unloaded with it. A status of a part travels to what stands on it, and from there to all its holders. The last
release unloads the camera.
"""

# /// lab
# place = 8
# question = "Two consumers load the same camera. How many cameras will be loaded?"
# [answers]
# one = {prints = "one resource: True"}
# two = {prints = "one resource: False"}
# ///

from __future__ import annotations

import time

import rr_actors as rr


class Lenses(rr.Manager):
    @rr.server("lens")
    def load_lens(self, request: str) -> str:
        return f"{request}, 50 mm"


class Cameras(rr.Manager):
    @rr.server("camera")
    def load_camera(self, request: str) -> str:
        return f"/camera/{request}: {self.registrar.load('lenses/lens', 'glass').response}"


def main(state_dir: str) -> None:
    children = [rr.ChildSpec(Lenses, id="lenses"), rr.ChildSpec(Cameras, id="cameras")]
    with rr.System(children, state_dir=state_dir) as system:
        mapper, guard = system.open_registrar("mapper"), system.open_registrar("guard")
        time.sleep(2)
        print("the mapper loads the front camera", flush=True)
        first = mapper.load("cameras/camera", "front")
        time.sleep(3)
        print("the guard loads the same one", flush=True)
        second = guard.load("cameras/camera", "front")
        print("one resource:", first.resource_id == second.resource_id, flush=True)
        time.sleep(3)
        lenses = system.registrar("lenses")
        print("the lens is dirty", flush=True)
        lenses.send_status(lenses.resources()[0].id, rr.Status("WARNING", "dirty"))
        time.sleep(6)
        print("the mapper releases it", flush=True)
        first.unload()
        time.sleep(3)
        print("the guard releases it", flush=True)
        second.unload()
        time.sleep(4)
