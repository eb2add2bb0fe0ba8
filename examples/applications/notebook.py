"""A notebook: each cell is below a line that begins it. The first cell may be run again."""

# %% start, or find what an earlier run of this cell has started
import rr_actors as rr


class Cameras(rr.Manager):
    @rr.server("camera", recovery="keep")
    def open_camera(self, device: str) -> str:
        return f"/images/{device}"


system = rr.System.running("rr_state") or rr.System([rr.ChildSpec(Cameras, id="cameras")], state_dir="rr_state").start()

# %% use
app = system.open_registrar("notebook")
camera = app.load("cameras/camera", "front")
print(camera.response, camera.state)

# %% stop
app.close()
system.stop()
