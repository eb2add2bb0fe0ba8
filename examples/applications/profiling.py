"""The profile of a callback, in whichever process it runs: python profiling.py, then python -m pstats camera.prof"""

from __future__ import annotations

import cProfile
import threading
from pathlib import Path

import rr_actors as rr

PROFILE = Path("camera.prof").absolute()


def calibrate(steps: int) -> int:
    return sum(n * n for n in range(steps))


class Cameras(rr.Manager):
    def on_start(self) -> None:
        self.profiling = threading.Lock()  # Python profiles one thread at a time

    @rr.server("camera", recovery="keep")
    def open_camera(self, device: str) -> int:
        with self.profiling, cProfile.Profile() as profile:
            answer = calibrate(100_000)
        profile.dump_stats(PROFILE)
        return answer


if __name__ == "__main__":
    with rr.System([rr.ChildSpec(Cameras, id="cameras")]) as system:
        system.open_registrar("app").load("cameras/camera", "front")
        print("profile in", PROFILE.name)
