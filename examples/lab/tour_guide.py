"""A tour guide: programs that are needed now and then.

A use case, such as "drive", is a resource, and the programs that it needs are its parts. Nobody pauses or ends a
program by hand: one that nobody holds is idle, and its manager does what you choose, after as long as you choose.

Look for: the programs that are there when the guide does not drive, and how soon they answer when it drives again.

Why: a program that is paused is there again at once, and keeps its memory. One that was ended frees its memory, and
has to start again. What lingers longer than the pause between two drives is not touched.
"""

# /// lab
# place = 15
# question = "The guide has driven, and now explains. What has become of the laser's program?"
# levers = [
#     {name = "idle", label = "what becomes of an idle program", choices = ["pause", "unload"]},
#     {name = "linger_s", label = "seconds until that", choices = [0.5, 30.0]},
# ]
# [answers]
# "it is paused" = {prints = "explain: laser is paused"}
# "it has been ended" = {prints = "explain: laser is not there"}
# "it runs on" = {prints = "explain: laser is loaded"}
# ///

from __future__ import annotations

import time

import rr_actors as rr
from rr_actors.managers import Programs, RunProgram

NEEDS = {"drive": ("laser", "wheels"), "explain": ("camera", "voice")}


def program(name: str) -> tuple[str, RunProgram]:
    return "programs/program", RunProgram("sh", ("-c", "while :; do sleep 0.05; done"), instance=name)


class Guide(rr.Manager):
    @rr.server("use_case")
    def begin(self, name: str) -> str:
        self.registrar.load_all([program(needed) for needed in NEEDS[name]])
        return name


def main(state_dir: str, idle: str = "pause", linger_s: float = 0.5) -> None:
    programs = rr.ChildSpec(Programs, id="programs", kwargs={"idle": idle, "linger_s": linger_s})
    with rr.System([programs, rr.ChildSpec(Guide, id="guide")], state_dir=state_dir) as system:
        app, provider = system.open_registrar("app"), system.registrar("programs")
        time.sleep(2)
        for step in ("drive", "explain", "drive"):
            began = time.monotonic()
            with app.load("guide/use_case", step):
                print(f"{step}: begins after {(time.monotonic() - began) * 1000:.0f} ms", flush=True)
                time.sleep(5)
                phases = {info.request.instance: info.phase for info in provider.resources()}
                for name in ("laser", "wheels", "camera", "voice"):
                    print(f"{step}: {name} is {phases.get(name, 'not there')}", flush=True)
